"""Commands of the editor from document to document, carried poses, and documents as JSON; against plain NumPy."""

import dataclasses
import itertools
import json
import re

import numpy as np
import pytest
from editor_pages import BOX, new_session
from hypothesis import given, settings
from hypothesis import strategies as st
from messages import MESSAGES
from polygon_cages import mixed_prism, triangulated
from scipy.spatial.transform import Rotation

from warpcage import Cage
from warpcage.core import error_line
from warpcage.studio.editor import (
    COMMANDS,
    MAX_ID,
    MAX_PLACE,
    Document,
    Key,
    Timeline,
    View,
    checked_view,
    frozen_vertices,
    moved_keys,
    moved_rest,
    new_edit,
    parsed_json,
    preset_pose,
    read_history,
    replace_cage,
    run_command,
)

REST = BOX.vertices
AFFINE, OFFSET = np.array([[1.2, 0.3, 0.0], [-0.1, 0.9, 0.2], [0.0, 0.1, 1.1]]), np.array([0.1, -0.2, 0.3])


def document(*edits, **changes):
    return dataclasses.replace(new_session(cages=edits or (BOX,)).document, **changes)


def done(start, **message):
    return run_command(start, message)[1]


def refused(start, **message):
    with pytest.raises(ValueError) as raised:
        run_command(start, message)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def moved(vertices):
    return vertices @ AFFINE.T + OFFSET


def with_key(start, vertices, number=50, time=1.0):
    return start.with_key(Key(number, time, f"key {number}", poses={1: frozen_vertices(vertices)}))


# -- Poses


def test_a_pose_is_what_was_given_and_no_argument_is_touched():
    start = document()
    wanted = moved(REST)
    after = done(start, do="pose.set", edit=1, vertices=wanted.tolist())
    np.testing.assert_array_equal(after.edits[0].posed, wanted)
    np.testing.assert_array_equal(start.edits[0].posed, REST)
    assert not after.edits[0].posed.flags.writeable and after.edits[0].rest is start.edits[0].rest
    for vertices in ([], [[0, 0, 0]], [[0, 0]] * 8, None, "x", [[np.inf] * 3] * 8, [[2 * MAX_PLACE] * 3] * 8, [1] * 24):
        refused(start, do="pose.set", edit=1, vertices=vertices)


@pytest.mark.parametrize("chosen", [None, [0], [1, 5, 7]])
def test_reset_brings_back_what_was_chosen(chosen):
    after = done(document(), do="pose.set", edit=1, vertices=moved(REST).tolist())
    back = done(after, do="pose.reset", edit=1, vertices=chosen)
    rows = slice(None) if chosen is None else chosen
    expected = moved(REST)
    expected[rows] = REST[rows]
    np.testing.assert_array_equal(back.edits[0].posed, expected)
    assert "nothing is selected" in refused(after, do="pose.reset", edit=1, vertices=[])


def test_presets_start_from_the_pose_and_move_the_chosen_alone():
    edit = new_edit(1, BOX, "Box", posed=moved(REST))
    chosen = [1, 3, 5, 7]
    low, high = edit.posed[chosen].min(axis=0), edit.posed[chosen].max(axis=0)
    stretched = preset_pose(edit, chosen, {"preset": "stretch", "amount": 2.0, "axis": "x", "limits": [0, 1]})
    others = np.setdiff1d(np.arange(8), chosen)
    np.testing.assert_array_equal(stretched[others], edit.posed[others])
    expected = edit.posed[chosen].copy()
    expected[:, 0] = low[0] + 2.0 * (expected[:, 0] - low[0])
    shift = stretched[chosen, 0] - expected[:, 0]
    np.testing.assert_allclose(shift, shift[0], atol=1e-12)  # stretched from wherever it is held
    np.testing.assert_array_equal(stretched[chosen, 1:], edit.posed[chosen, 1:])
    turned = preset_pose(edit, None, {"preset": "twist", "amount": 90.0, "axis": "z"})
    np.testing.assert_array_equal(turned[:, 2], edit.posed[:, 2])
    center = (edit.posed.min(axis=0) + edit.posed.max(axis=0))[:2] / 2
    radii = [np.linalg.norm(array[:, :2] - center, axis=1) for array in (turned, edit.posed)]
    np.testing.assert_allclose(*radii, atol=1e-12)
    assert preset_pose(edit, None, {"preset": "bend", "amount": 0, "axis": "x"}) is edit.posed
    assert high[0] > low[0]


# -- Edits


@pytest.mark.parametrize("shape", ["box", "cylinder", "icosphere"])
def test_a_new_edit_is_active_and_its_cage_lies_about_the_corners(shape):
    after = done(document(), do="edit.add", kind="copy", shape=shape, lower=[0, 0, 0], upper=[1, 2, 3])
    edit = after.edits[-1]
    assert (edit.id, edit.kind, edit.name, after.selection.edit, after.next_id) == (2, "copy", "Copy 2", 2, 3)
    np.testing.assert_allclose((edit.rest.min(axis=0) + edit.rest.max(axis=0)) / 2, [0.5, 1, 1.5], atol=1e-9)
    assert np.ptp(edit.rest, axis=0)[2] >= 2.5
    edit.rest_cage.require_usable("it")
    assert "lower corner" in refused(after, do="edit.add", lower=[0, 0, 0], upper=[1, 0, 1])


def test_a_box_may_have_eight_corners_and_axes_of_its_own():
    low, high, turn = [0.1, 0.2, 0.3], [1, 2, 3], Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix()
    plain = done(document(), do="edit.add", lower=low, upper=high, segments=1).edits[-1]
    np.testing.assert_array_equal(plain.rest, Cage.box(low, high).vertices)
    turned = done(document(), do="edit.add", lower=low, upper=high, segments=1, axes=turn.T.tolist()).edits[-1]
    np.testing.assert_allclose(turned.rest, plain.rest @ turn.T, atol=1e-12)
    turned.rest_cage.require_usable("it")
    mirrored, skewed = np.diag([1, 1, -1]).tolist(), [[1, 0, 0], [0.1, 1, 0], [0, 0, 1]]
    for axes in (
        mirrored,
        skewed,
        [],
        [[1, 0, 0]] * 3,
        np.eye(2).tolist(),
        np.eye(4).tolist(),
        "xyz",
        [[None] * 3] * 3,
    ):
        refused(document(), do="edit.add", lower=low, upper=high, axes=axes)
    for segments in (0, 9, 1.5, True, None):
        refused(document(), do="edit.add", lower=low, upper=high, segments=segments)


def test_deleting_an_edit_takes_its_poses_out_of_all_keys():
    start = document(BOX, Cage.box((0, 0, 0), (1, 1, 1)))
    view = start.view
    both = {1: start.edits[0].posed, 2: start.edits[1].posed}
    start = start.with_key(Key(10, 0.0, "both", poses=both)).with_key(Key(11, 1.0, "one", poses={1: both[1]}))
    start = start.with_key(Key(12, 2.0, "seen", poses={1: both[1]}, view=view))
    after = done(start, do="edit.delete", id=1)
    assert [(key.id, key.poses and list(key.poses), key.view is None) for key in after.timeline.keys] == [
        (10, [2], True),
        (12, None, False),
    ]
    assert after.selection.edit == 2 and [edit.id for edit in after.edits] == [2]
    assert "may have been deleted" in refused(after, do="edit.delete", id=1)
    empty = done(after, do="edit.delete", id=2)
    assert empty.edits == () and empty.selection.edit is None
    assert "pose" in refused(empty, do="key.add", time=3.0, pose=True)


def test_the_poses_of_a_key_belong_to_edits_whatever_their_order():
    start = document(BOX, Cage.box((0, 0, 0), (1, 1, 1), segments=2))
    start = done(start, do="key.add", time=1.0, pose=True)
    after = done(start, do="edit.order", ids=[2, 1])
    assert [edit.id for edit in after.edits] == [2, 1]
    assert after.timeline is start.timeline
    assert {number: len(pose) for number, pose in after.timeline.keys[0].poses.items()} == {1: 8, 2: 26}
    for ids in ([1], [1, 1], [1, 2, 2], ["1", "2"], [True, 2], [1.0, 2], None, "12", [[1], 2]):
        refused(start, do="edit.order", ids=ids)


def test_numbers_of_edits_and_keys_are_numbers():
    start = with_key(document(), REST, number=9)
    for odd in (True, 1.0, "1", [1], {}, None, 0, -1, 10**30, np.inf):
        for command in ("pose.reset", "cage.subdivide", "cage.box"):
            refused(start, do=command, edit=odd, vertices=[0, 7])
        for command in ("edit.delete", "edit.change", "key.change", "key.delete"):
            refused(start, do=command, id=odd)
        if odd is not None:
            refused(start, do="select", edit=odd, mode="vertex", vertices=[])


def test_a_change_of_nothing_is_no_change():
    start = with_key(document(), REST, number=9)
    for command in (
        {"do": "edit.change", "id": 1},
        {"do": "timeline"},
        {"do": "settings"},
        {"do": "key.change", "id": 9},
    ):
        assert "nothing to change" in refused(start, **command)


@pytest.mark.parametrize(
    ("command", "step"),
    [
        ({"do": "edit.change", "id": 1, "visible": False}, "visibility of Move 1"),
        ({"do": "edit.change", "id": 1, "falloff": 0.1, "fragments": 0.1}, "fade, loose pieces of Move 1"),
        ({"do": "settings", "supersampling": 2}, "change samples"),
        ({"do": "timeline", "fps": 12}, "film frame rate"),
    ],
)
def test_steps_are_named_as_on_the_page(command, step):
    assert COMMANDS[command["do"]](document(), command)[0] == step


def test_names_are_one_line_that_can_be_printed():
    start = document()
    assert done(start, do="edit.change", id=1, name="  Left \n arm ").edits[0].name == "Left arm"
    assert done(start, do="edit.change", id=1, name="Ärmel 🦾").edits[0].name == "Ärmel 🦾"
    for name in ("", " \n", "x" * 101, "a\0b", "a\x1b[31m", "\ud800", None, 5, ["a"]):
        refused(start, do="edit.change", id=1, name=name)


# -- Cages


def test_subdividing_puts_new_vertices_in_the_middle_of_edges_also_in_poses():
    start = with_key(done(document(), do="pose.set", edit=1, vertices=moved(REST).tolist()), REST * 2)
    after = done(start, do="cage.subdivide", edit=1)
    edit = after.edits[0]
    edges = {tuple(sorted(pair)) for face in BOX.faces for pair in itertools.combinations(face, 2)}
    middles = np.array([(REST[a] + REST[b]) / 2 for a, b in sorted(edges)])
    expected = np.concatenate([REST, middles])
    assert sorted(map(tuple, edit.rest)) == sorted(map(tuple, expected))
    np.testing.assert_allclose(edit.posed, moved(edit.rest), atol=1e-12)
    np.testing.assert_allclose(after.timeline.keys[0].poses[1], edit.rest * 2, atol=1e-12)
    assert len(edit.faces) == 4 * len(BOX.faces)


def test_faces_at_some_vertices_are_cut_in_poses_and_keys_too():
    start = with_key(done(document(), do="pose.set", edit=1, vertices=moved(REST).tolist()), REST * 2)
    after = done(start, do="cage.subdivide", edit=1, vertices=[0])
    edit, finer = after.edits[0], start.edits[0].rest_cage.subdivide(vertices=[0])
    assert edit.rest_cage.polygons == finer.polygons and len(REST) < len(edit.rest) < len(BOX.subdivide().vertices)
    np.testing.assert_allclose(edit.posed, moved(edit.rest), atol=1e-12)
    np.testing.assert_allclose(after.timeline.keys[0].poses[1], edit.rest * 2, atol=1e-12)
    assert after.selection.vertices == ()
    assert "nothing is selected" in refused(start, do="cage.subdivide", edit=1, vertices=[])


def test_another_cage_takes_the_pose_and_the_keys_along():
    start = with_key(done(document(), do="pose.set", edit=1, vertices=moved(REST).tolist()), REST * 2, time=0.5)
    start = with_key(start, REST, number=51)
    inner = Cage.box((-0.5, -0.4, -0.3), (0.6, 0.5, 0.4), segments=2)
    label, after = replace_cage(start, 1, inner, "another")
    assert label == "another"
    edit = after.edits[0]
    np.testing.assert_allclose(edit.posed, moved(inner.vertices), atol=1e-4)  # coordinates keep affine maps
    np.testing.assert_allclose(after.timeline.keys[0].poses[1], inner.vertices * 2, atol=1e-4)
    np.testing.assert_array_equal(after.timeline.keys[1].poses[1], inner.vertices)
    assert after.selection.vertices == () and (edit.name, edit.kind, edit.visible) == ("Move 1", "move", True)


def test_poses_and_keys_keep_their_distance_from_a_cage_at_rest_that_moves():
    start = with_key(done(document(), do="pose.set", edit=1, vertices=moved(REST).tolist()), REST * 2)
    rest = REST + np.linspace(0, 0.3, 24).reshape(8, 3)
    after = moved_keys(moved_rest(start, start.edits[0], rest), start.edits[0])
    edit = after.edits[0]
    np.testing.assert_array_equal(edit.rest, rest)
    np.testing.assert_allclose(edit.posed - edit.rest, moved(REST) - REST, atol=1e-12)
    np.testing.assert_allclose(after.timeline.keys[0].poses[1] - rest, REST, atol=1e-12)


def test_a_box_goes_about_what_is_selected():
    after = done(document(), do="cage.box", edit=1, vertices=[0, 1], margin=0.1)
    size = 1.4
    low, high = REST[[0, 1]].min(axis=0) - 0.1 * size, REST[[0, 1]].max(axis=0) + 0.1 * size
    np.testing.assert_allclose([after.edits[1].rest.min(axis=0), after.edits[1].rest.max(axis=0)], [low, high])


# -- Film


@pytest.mark.parametrize(("axis", "place"), [("x", 0.4), ("z", -1.5)])
def test_a_mirrored_edit_is_the_other_one_on_the_other_side_with_its_keys(axis, place):
    before = done(document(), do="pose.set", edit=1, vertices=moved(REST).tolist())
    before = done(before, do="key.add", time=0.5, pose=True)
    before = done(before, do="edit.change", id=1, name="Arm", kind="copy", falloff=0.2)
    after = done(before, do="cage.mirror", edit=1, axis=axis, place=place)
    first, second = after.edits
    k, middle = "xyz".index(axis), np.zeros(3)
    middle["xyz".index(axis)] = place
    sides = np.where(np.arange(3) == k, -1.0, 1.0)
    for one, two in ((first.rest, second.rest), (first.posed, second.posed)):
        np.testing.assert_allclose((two - middle) * sides, one - middle, atol=1e-12)
    (key,) = after.timeline.keys
    np.testing.assert_array_equal(key.poses[second.id], second.posed)
    assert (second.kind, second.falloff, second.name) == ("copy", 0.2, "Arm mirrored")
    assert second.rest_cage.volume == pytest.approx(first.rest_cage.volume)  # not inside out
    assert after.selection.edit == second.id and first is before.edits[0]
    assert "place" in refused(after, do="cage.mirror", edit=1, axis=axis, place="far")


def test_keys_hold_copies_by_time_and_fill_those_of_the_same_time():
    start = document()
    one = done(start, do="key.add", time=1.0, pose=True)
    two = done(done(one, do="pose.set", edit=1, vertices=(REST * 2).tolist()), do="key.add", time=0.5, pose=True)
    three = done(two, do="key.add", time=1.0 + 0.4 / 24, camera=True)
    keys = three.timeline.keys
    assert [(key.time, key.poses is not None, key.view is not None) for key in keys] == [
        (0.5, True, False),
        (1.0, True, True),
    ]
    np.testing.assert_array_equal(keys[0].poses[1], REST * 2)
    np.testing.assert_array_equal(keys[1].poses[1], REST)
    later = done(three, do="key.change", id=keys[1].id, time=9.0, easing="hold", name="last")
    assert later.timeline.length == 9.0 and later.timeline.keys[-1].easing == "hold"
    curved = done(later, do="key.change", id=keys[1].id, easing={"bezier": [0.3, -1, 1, 2]})
    assert curved.timeline.keys[-1].easing == {"bezier": [0.3, -1.0, 1.0, 2.0]}
    again = Document.from_json(json.loads(json.dumps(curved.to_json())))
    assert again.timeline.keys[-1].easing == curved.timeline.keys[-1].easing
    for easing in ({"bezier": [1.1, 0, 0, 1]}, {"bezier": [0, 0, 1]}, {"bezier": None}, {}, [0, 0, 1, 1], 3, "bezier"):
        refused(later, do="key.change", id=keys[1].id, easing=easing)
    assert len({key.id for key in keys}) == 2 and three.next_id == 4
    refused(three, do="key.add", time=2.0)
    refused(later, do="timeline", length=8.9)
    for time in (-1, 3601, True, None, "1", [1], np.nan):
        refused(three, do="key.add", time=time, pose=True)
    for odd in (1, "yes", None, []):
        refused(three, do="key.add", time=2.0, pose=odd)


def test_every_command_without_its_values_says_what_is_missing():
    for name in COMMANDS:
        assert refused(document(), do=name)


# -- Documents as JSON

numbers = st.floats(-MAX_PLACE, MAX_PLACE, allow_nan=False)
triples = st.tuples(numbers, numbers, numbers)


@st.composite
def documents(draw):
    count = draw(st.integers(0, 3))
    edits = []
    for number in draw(st.permutations(range(1, count + 1))):
        posed = draw(st.none() | st.lists(triples, min_size=8, max_size=8))
        kind = draw(st.sampled_from(["move", "copy", "remove"]))
        edit = new_edit(number, BOX, draw(st.sampled_from(["Arm", "Ärmel", "a 'b' \"c\""])), kind, posed)
        edits.append(dataclasses.replace(edit, visible=draw(st.booleans())))
    start = dataclasses.replace(document(), edits=tuple(edits))
    view = View(draw(triples), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), draw(st.floats(1, 150)))
    try:
        view = checked_view(dataclasses.asdict(view))
    except ValueError:
        view = start.view
    keys = []
    for number in range(draw(st.integers(0, 3))):
        poses = {edit.id: edit.posed for edit in edits if draw(st.booleans())} or None
        seen = view if poses is None or draw(st.booleans()) else None
        keys.append(Key(100 + number, draw(st.floats(0, 100)), f"key {number}", "linear", poses, seen))
    film = Timeline(tuple(sorted(keys, key=lambda key: (key.time, key.id))), 100.0, draw(st.floats(0.01, 240)), "loop")
    active = draw(st.sampled_from([None, *[edit.id for edit in edits]]))
    selection = dataclasses.replace(start.selection, edit=active, vertices=(0, 3) if active else ())
    chosen = dataclasses.replace(start.settings, background=draw(st.sampled_from([None, "white", (0.1, 0.5, 1.0)])))
    return dataclasses.replace(
        start, timeline=film, view=view, selection=selection, settings=chosen, time=1.5, next_id=200
    )


@settings(max_examples=60, deadline=None)
@given(documents())
def test_a_document_comes_back_from_json_with_every_bit(start):
    text = json.dumps(start.to_json(), allow_nan=False)
    again = Document.from_json(parsed_json(text))
    for part in ("selection", "settings", "view", "time", "next_id"):
        assert getattr(again, part) == getattr(start, part)
    for one, two in zip(again.edits, start.edits, strict=True):
        assert (one.id, one.name, one.kind, one.visible) == (two.id, two.name, two.kind, two.visible)
        for part in ("faces", "rest", "posed"):
            np.testing.assert_array_equal(getattr(one, part), getattr(two, part))
            assert getattr(one, part).dtype == getattr(two, part).dtype and not getattr(one, part).flags.writeable
    for one, two in zip(again.timeline.keys, start.timeline.keys, strict=True):
        assert dataclasses.replace(one, poses=None) == dataclasses.replace(two, poses=None)
        assert (one.poses or {}).keys() == (two.poses or {}).keys()
        assert all(np.array_equal(one.poses[number], two.poses[number]) for number in one.poses or {})
    assert json.dumps(again.to_json()) == text


def places(content, path=()):
    """The ways to all values inside a nested JSON value."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        yield (*path, key)
        if path[-1:] not in (("rest",), ("posed",), ("faces",)) or key == 0:
            yield from places(value, (*path, key))


ODD = (None, True, -1, 0.5, 10**400, 2**31, 1e308, float("nan"), "x", "\ud800", [], [1], [[1, 2]], {}, {"a": 1})


def test_a_damaged_document_is_one_line_or_a_document():
    start = with_key(document(), REST * 2)
    start = start.with_key(Key(60, 2.0, "seen", view=start.view))
    text = json.dumps(start.to_json())
    tried = 0
    for path in places(json.loads(text)):
        for odd in (*ODD, "delete"):
            content = json.loads(text)
            inner = content
            for key in path[:-1]:
                inner = inner[key]
            if odd == "delete":
                del inner[path[-1]]
            else:
                inner[path[-1]] = odd
            try:
                again = Document.from_json(content)
            except ValueError as error:
                assert "\n" not in str(error) and len(str(error)) < 500
            else:
                json.dumps(again.to_json(), allow_nan=False)
                Document.from_json(json.loads(json.dumps(again.to_json())))
            tried += 1
    assert tried > 500
    for odd in ODD:
        with pytest.raises(ValueError):
            Document.from_json(odd)


def test_a_foreign_document_cannot_use_up_the_numbers():
    content = document().to_json()
    for number in (2**31 - 2, 2**31, MAX_ID):
        content["edits"][0]["id"] = content["selection"]["edit"] = number
        start = Document.from_json(content)
        if number < 2**31 - 1:
            start = done(start, do="edit.add", lower=[0, 0, 0], upper=[1, 1, 1])
        assert "no numbers left" in refused(start, do="edit.add", lower=[0, 0, 0], upper=[1, 1, 1])
        assert "no numbers left" in refused(start, do="key.add", time=0.0, pose=True)
        again = Document.from_json(json.loads(json.dumps(start.to_json())))
        assert again.next_id == start.next_id > start.edits[-1].id


@pytest.mark.parametrize("text", ["NaN", "[Infinity]", '{"a": -Infinity}', "[" * 100_000, "{", "", "1 2"])
def test_what_is_no_json_is_refused(text):
    with pytest.raises(ValueError):
        parsed_json(text)


def test_an_error_is_one_line_without_folders():
    full = OSError(28, "No space left on device", "/user/secret/lego.session.json")
    assert re.fullmatch(MESSAGES["core.no_space_for_file"], error_line(full, folders=False))
    assert error_line(KeyError("edit")) == "'edit' is missing"
    assert error_line(MemoryError()) == "not enough memory" and error_line(ValueError("a\n b")) == "a b"
    assert error_line(ValueError()) == "ValueError" and len(error_line(ValueError("x" * 9999), 500)) == 500


# -- History


def test_walls_and_fragments_of_an_edit_are_changed_kept_and_checked():
    start = document()
    after = done(start, do="edit.change", id=1, falloff=0.25, held="still", fragments=0.5)
    edit = after.edits[0]
    assert (edit.falloff, edit.held, edit.fragments) == (0.25, "still", 0.5)
    made = edit.cage_edit
    assert (made.falloff, made.held, made.fragments, made.remove) == (0.25, "still", 0.5, False)
    finer = done(after, do="cage.subdivide", edit=1).edits[0]
    assert (finer.falloff, finer.held, finer.fragments) == (0.25, "still", 0.5)
    removed = done(after, do="edit.change", id=1, kind="remove").edits[0].cage_edit
    assert removed.remove and removed.falloff == 0.0 and removed.fragments == 0.5  # what is removed has nothing to fade
    again = Document.from_json(json.loads(json.dumps(after.to_json())))
    assert again.edits[0].cage_edit.held == "still" and again.edits[0].fragments == 0.5
    for bad in ({"falloff": -1}, {"falloff": "wide"}, {"fragments": np.inf}, {"held": "all"}, {"held": 3}):
        refused(start, do="edit.change", id=1, **bad)
    old = start.to_json()
    for name in ("falloff", "held", "fragments"):
        del old["edits"][0][name]
    del old["settings"]["fill"]
    older = Document.from_json(old)  # a session of a version before these
    assert (older.edits[0].falloff, older.edits[0].held, older.edits[0].fragments) == (0.0, "cut", 0.0)
    assert older.settings.fill is False and done(start, do="settings", fill=True).settings.fill is True
    refused(start, do="settings", fill="yes")


# -- Cages of polygons


def test_polygons_stay_in_documents_commands_and_undo_steps():
    cage = mixed_prism()
    start = done(document(cage), do="pose.set", edit=1, vertices=moved(cage.vertices).tolist())
    assert start.edits[0].rest_cage.polygons == start.edits[0].posed_cage.polygons == cage.polygons
    again = Document.from_json(parsed_json(json.dumps(start.to_json())))
    assert again.edits[0].rest_cage.polygons == cage.polygons and again.edits[0].faces.dtype == np.int32
    finer = done(start, do="cage.subdivide", edit=1).edits[0]
    assert finer.rest_cage.polygons == cage.subdivide().polygons
    np.testing.assert_allclose(finer.posed, moved(finer.rest), atol=1e-12)
    other = done(start, do="cage.mirror", edit=1, axis="x", place=0.5).edits[1]
    assert other.rest_cage.polygons == tuple(face[::-1] for face in cage.polygons) and other.rest_cage.volume > 0.0
    _, replaced = replace_cage(start, 1, triangulated(cage.translate((0.1, 0.0, 0.0))), "the same, cut")
    assert replaced.edits[0].rest_cage.polygons == cage.polygons
    session = new_session(cages=(cage,))
    session.run({"do": "pose.set", "edit": 1, "vertices": moved(cage.vertices).tolist()})
    session.run({"do": "cage.subdivide", "edit": 1})
    kept = json.loads(json.dumps(session.history.to_json(session.document, session.fields)))
    steps, lost = read_history(kept, session.fields, None)
    assert lost is None and len(steps.undo_steps) == 2
    assert [step.edits[0].rest_cage.polygons for _, step in steps.undo_steps] == [cage.polygons] * 2
