"""Films of the editor: what is where at a time, easing, looping, frames, and keys as pose files."""

import dataclasses
import json
from fractions import Fraction

import numpy as np
import pytest
from editor_pages import new_session, tiny_field
from messages import MESSAGES
from runs import succeed

from warpcage import Cage, Camera, CameraKey, PoseFile
from warpcage.core import EASINGS
from warpcage.studio.editor import (
    Document,
    Key,
    Selection,
    Settings,
    Timeline,
    View,
    document_at,
    frame_rate,
    frame_times,
    frozen_vertices,
    load_poses,
    looped_time,
    new_edit,
    pose_file,
    state_at,
    view_camera,
    ways,
    with_camera_moves,
    with_pose_file,
)
from warpcage.studio.films.moves import MovingCamera, camera_moves
from warpcage.studio.jobs import JobFile
from warpcage.view.motion import frame_count

CAGE = Cage.box([-1, -1, -1], [1, 1, 1])
VIEW = View((3.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0)
RANDOM = np.random.default_rng(5)
POSES = [frozen_vertices(CAGE.vertices + RANDOM.normal(scale=0.2, size=CAGE.vertices.shape)) for _ in range(5)]


def film(*keys, edits=None, **timeline):
    """A document with one edit, number 1, and keys (time, easing, poses or None, view or None)."""
    made = tuple(
        Key(100 + k, time, f"key {k}", easing, poses if poses is None or isinstance(poses, dict) else {1: poses}, view)
        for k, (time, easing, poses, view) in enumerate(keys)
    )
    edits = (new_edit(1, CAGE, "Cage"),) if edits is None else edits
    return Document(edits, Selection(), Settings(), VIEW, Timeline(made, **timeline), next_id=500)


def pose_at(document, time):
    return state_at(document, time)[0][1]


CURVE = {"bezier": [0.9, -0.4, 0.2, 1.3]}


@pytest.mark.parametrize("easing", [*EASINGS, CURVE], ids=str)
def test_drawn_ways_are_those_that_poses_go(easing):
    document = film((0, "smooth", POSES[0], None), (1, easing, POSES[1], None), (3, "linear", POSES[2], None))
    drawn = ways(document)
    assert list(drawn) == [100, 101]  # from the last key nothing moves
    until, shares = drawn[101]
    assert until == 3 and shares[0] == 0.0 and shares[-1] == pytest.approx(1.0)
    step = POSES[2] - POSES[1]
    for time, share in zip(np.linspace(1, 3, len(shares)), shares, strict=True):
        left = pose_at(document, time) - POSES[1] - share * step
        assert np.vdot(left, step) == pytest.approx(0.0, abs=1e-9)  # what is left is beside the way


def test_the_drawn_way_is_that_of_the_edit_that_moves_most():
    edits = (new_edit(1, CAGE, "one"), new_edit(2, CAGE, "two"), new_edit(3, CAGE, "still"))
    rest = frozen_vertices(CAGE.vertices)
    first = {1: rest, 2: rest, 3: rest}
    keys = [
        (0, "smooth", first, None),
        (1, "smooth", {1: frozen_vertices(rest * 1.1), 2: frozen_vertices(rest * 3), 3: rest}, None),
        (2, "smooth", {1: rest, 3: rest}, None),
        (4, "bounce", {1: rest, 2: rest, 3: rest}, None),
    ]
    alone = [(time, easing, {2: poses[2]}, None) for time, easing, poses, _ in keys if 2 in poses]
    drawn = ways(film(*keys, edits=edits))
    assert drawn[100] == ways(film(*alone, edits=edits))[100] and drawn[101] == ways(film(*alone, edits=edits))[101]
    assert drawn[101][0] == 4.0  # past a key that does not hold it
    assert 102 not in drawn and ways(film()) == {}


def test_edits_go_by_the_keys_that_hold_them():
    edits = (new_edit(1, CAGE, "one", posed=POSES[3]), new_edit(2, CAGE, "two"), new_edit(3, CAGE, "three"))
    document = film(
        (0.0, "linear", {1: POSES[0], 2: POSES[1]}, None),
        (1.0, "linear", {2: POSES[2]}, None),
        (2.0, "hold", {1: POSES[1], 7: POSES[0]}, None),  # 7 was deleted
        edits=edits,
    )
    poses, view = state_at(document, 1.5)
    assert sorted(poses) == [1, 2] and view is None
    np.testing.assert_allclose(poses[1], 0.25 * POSES[0] + 0.75 * POSES[1])  # past the key that does not hold it
    assert np.array_equal(poses[2], POSES[2])
    after = document_at(document, 1.5)
    assert after.edits[2].posed is edits[2].posed and after.time == 1.5 and after.view == VIEW
    assert np.array_equal(after.edit(1).posed, poses[1])
    cut = dataclasses.replace(edits[0], rest=CAGE.vertices[:4], posed=CAGE.vertices[:4])  # keys of the cage before
    assert 1 not in state_at(dataclasses.replace(document, edits=(cut, *edits[1:])), 1.0)[0]


def test_views_between_odd_ones_can_be_used():
    turned = dataclasses.replace(VIEW, up=(0.0, 0.0, -1.0), target=(6.0, 0.0, 2.0))
    middle = state_at(film((0.0, "linear", None, VIEW), (1.0, "linear", None, turned)), 0.5)[1]
    assert np.linalg.norm(middle.up) == pytest.approx(1.0) and middle.target != middle.eye
    wide = film(*((t, "smooth", None, dataclasses.replace(VIEW, fov=fov)) for t, fov in enumerate((40, 149, 149.5, 1))))
    assert max(state_at(wide, t)[1].fov for t in np.linspace(0, 3, 61)) <= 150.0


def test_looped_time():
    once, loop, swing = (Timeline(length=2.0, loop=name) for name in ("once", "loop", "ping-pong"))
    places = (0.0, 0.5, 2.0, 2.5, 4.0, 5.5)
    assert [looped_time(once, t) for t in places] == [0.0, 0.5, 2.0, 2.0, 2.0, 2.0]
    assert [looped_time(loop, t) for t in places] == [0.0, 0.5, 0.0, 0.5, 0.0, 1.5]
    assert [looped_time(swing, t) for t in places] == [0.0, 0.5, 2.0, 1.5, 0.0, 1.5]
    assert looped_time(Timeline(length=0.0, loop="loop"), 3.0) == 0.0


def test_frame_times():
    def times(length, fps, loop):
        return frame_times(Timeline(length=length, fps=fps, loop=loop))

    assert times(1.0, 4.0, "once") == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert times(1.0, 4.0, "loop") == [0.0, 0.25, 0.5, 0.75]
    assert times(1.0, 4.0, "ping-pong") == [0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25]
    assert times(0.0, 24.0, "once") == times(0.0, 24.0, "loop") == [0.0]
    assert len(times(0.7, 10.0, "once")) == 8 and times(0.7, 10.0, "once")[-1] == 0.7  # 0.7 * 10 is below 7 in floats
    rate = Timeline(length=10.01, fps=30000 / 1001)
    assert frame_rate(rate) == Fraction(30000, 1001)
    assert frame_times(rate)[-1] == 10.01 and len(frame_times(rate)) == 301
    assert times(0.25, 10.0, "loop") == [0.0, 0.1, 0.2]


FILMS = [(2.0, 24.0, "once", 49), (2.0, 24.0, "loop", 48), (1.5, 4.0, "once", 7)]


@pytest.mark.parametrize("last, fps, loop, frames", FILMS)
def test_a_film_is_as_long_as_its_last_key_and_has_the_same_frames_everywhere(tmp_path, last, fps, loop, frames):
    session = new_session(cages=(CAGE,))
    for time in (0.0, last):
        session.run({"do": "key.add", "time": time, "pose": True})
    session.run({"do": "timeline", "fps": fps, "loop": loop})
    document = session.document
    assert document.timeline.length == last
    assert session.section("timeline")["frames"] == len(frame_times(document.timeline)) == frames  # page, jobs
    pose_file(document, document.edits[0].id).save(tmp_path / "poses.json")
    file = PoseFile.load(tmp_path / "poses.json", CAGE)
    assert file.length == last and frame_count(file.length, fps, file.loop or "once") == frames  # render_film
    tiny_field().save(tmp_path / "ball.npz")
    CAGE.save(tmp_path / "cage.obj")
    arguments = ["animate", "@ball.npz", "--cage", "@cage.obj", "--posed", "@poses.json", "--size", 8, "--quiet"]
    succeed(tmp_path, *arguments, "-o", "@frames")
    assert len(list((tmp_path / "frames").glob("*.png"))) == frames
    succeed(tmp_path, *arguments, "--jobs", "@film.jsonl")
    with JobFile(tmp_path / "film.jsonl") as job:
        assert len(job) == frames
    session.run({"do": "key.delete", "id": document.timeline.keys[-1].id})
    assert session.document.timeline.length == 4.0  # as without keys
    session.run({"do": "timeline", "length": 9.0})
    session.run({"do": "key.add", "time": last, "pose": True})
    assert session.document.timeline.length == 9.0  # it was set


@pytest.mark.parametrize("easing", [*EASINGS, CURVE], ids=str)
def test_a_film_goes_as_its_pose_file_does(tmp_path, easing):
    """To the bit; whose ways are checked in tests/library/view."""
    times, views = (0.5, 1.0, 2.25, 3.0), (VIEW, None, dataclasses.replace(VIEW, eye=(0.0, 4.0, 2.0), fov=60.0), None)
    easings = (easing, "smooth", easing, "linear")  # each of the way that begins there
    made = film(*zip(times, easings, POSES, views, strict=False))
    pose_file(made, 1).save(tmp_path / "poses.json")
    file = PoseFile.load(tmp_path / "poses.json")
    for time in (0.0, *times, *np.linspace(0.1, 4.0, 14)):
        np.testing.assert_array_equal(pose_at(made, time), file.at_time(time).vertices)
        view, expected = state_at(made, time)[1], file.camera_at(time)
        looking = view_camera(view, 64, 48)
        np.testing.assert_allclose(looking.center, expected.center, atol=1e-9)
        np.testing.assert_allclose(looking.rotation[:, 2], expected.rotation[:, 2], atol=1e-9)
        assert easing != "linear" or view.fov == pytest.approx(np.interp(time, (0.5, 2.25), (40.0, 60.0)))


def test_keys_go_through_a_pose_file_to_the_bit(tmp_path):
    document = film(
        (0.1, "ease-in", {1: POSES[0], 2: POSES[4]}, None),
        (1 / 3, "hold", POSES[1], VIEW),
        (2.0, "smooth", POSES[2], None),
        edits=(new_edit(1, CAGE, "one"), new_edit(2, CAGE, "two")),
        length=3.0,
    )
    pose_file(document, 1).save(tmp_path / "poses.json")
    again = load_poses(document, 1, tmp_path / "poses.json")
    assert [(k.time, k.name, k.easing, k.view) for k in again.timeline.keys] == [
        (k.time, k.name, k.easing, k.view) for k in document.timeline.keys
    ]
    for key, before in zip(again.timeline.keys, document.timeline.keys, strict=True):
        assert list(key.poses) == list(before.poses)
        assert all(key.poses[number].tobytes() == before.poses[number].tobytes() for number in key.poses)
    empty = film(edits=document.edits, length=1.0)
    loaded = load_poses(empty, 1, tmp_path / "poses.json")
    assert loaded.timeline.length == 2.0 and loaded.next_id == empty.next_id + 3
    assert len({key.id for key in loaded.timeline.keys}) == 3
    assert [key.time for key in loaded.timeline.keys] == [0.1, 1 / 3, 2.0]
    assert all(np.array_equal(pose_at(loaded, t), pose_at(document, t)) for t in np.linspace(0, 3, 13))


def test_pose_files_without_times_are_spread_and_equal_names_get_numbers():
    plain = PoseFile(CAGE, {"a": POSES[0], "b": POSES[1], "c": POSES[2]})
    loaded = with_pose_file(film(length=3.0), 1, plain)
    assert [(k.time, k.name, k.easing) for k in loaded.timeline.keys] == [
        (0.0, "a", "smooth"),
        (1.5, "b", "smooth"),
        (3.0, "c", "smooth"),
    ]
    same = [dataclasses.replace(key, name="pose") for key in loaded.timeline.keys]
    assert pose_file(loaded.with_timeline(keys=tuple(same)), 1).names == ("pose", "pose 2", "pose 3")
    jump = PoseFile(CAGE, {"a": POSES[0], "b": POSES[1]})
    jump.times = {"a": 1.0, "b": 1.0}
    both = with_pose_file(film(length=3.0), 1, jump)
    assert np.array_equal(pose_at(both, 0.99), POSES[0]) and np.array_equal(pose_at(both, 1.0), POSES[1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.times.update(a=-1.0), MESSAGES["editor.key_before_film"]),
        (lambda file: file.easings.update(a="wobble"), MESSAGES["editor.key_easing"]),
    ],
)
def test_pose_files_that_a_film_cannot_hold(change, message):
    file = PoseFile(CAGE, {"a": POSES[0]})
    change(file)
    with pytest.raises(ValueError, match=message):
        with_pose_file(film(), 1, file)


def test_pose_files_of_other_cages_and_films_without_keys():
    with pytest.raises(ValueError, match="another cage"):
        with_pose_file(film(), 1, PoseFile(Cage.icosphere([0, 0, 0], 1.0), {"a": Cage.icosphere([0, 0, 0], 1.0)}))
    with pytest.raises(ValueError, match="no key holds a pose of 'Cage'"):
        pose_file(film(), 1)


def test_times_and_easings_of_pose_files_are_checked_and_older_files_have_none(tmp_path):
    file = PoseFile(CAGE, {"a": POSES[0], "b": POSES[1]})
    file.times["a"], file.easings["b"] = 1, "hold"
    file.save(tmp_path / "poses.json")
    again = PoseFile.load(tmp_path / "poses.json")
    assert again.times == {"a": 1.0} and again.easings == {"b": "hold"}
    file.easings["b"] = CURVE
    file.save(tmp_path / "curved.json")
    assert PoseFile.load(tmp_path / "curved.json").easings == {"b": CURVE}
    assert with_pose_file(film(), 1, PoseFile.load(tmp_path / "curved.json")).timeline.keys[-1].easing == CURVE
    content = json.loads((tmp_path / "poses.json").read_text())
    assert content["version"] == 1 and list(content["keyframes"][0]) == ["name", "vertices", "time"]
    for key, value, message in (
        ("time", "soon", MESSAGES["cage.key_time"]),
        ("time", float("inf"), MESSAGES["cage.key_time"]),
        ("easing", 3, MESSAGES["cage.key_easing"]),
        ("easing", {"bezier": [0, 0, 3, 1]}, "x2 of the easing of keyframe 'a'"),
    ):
        changed = json.loads(json.dumps(content))
        changed["keyframes"][0][key] = value
        (tmp_path / "bad.json").write_text(json.dumps(changed))
        with pytest.raises(ValueError, match=f"bad.json: {message}"):
            PoseFile.load(tmp_path / "bad.json")
    file.times["nobody"] = 1.0
    with pytest.raises(ValueError, match="there is no keyframe 'nobody'"):
        file.save(tmp_path / "worse.json")
    assert not (tmp_path / "worse.json").exists()


def test_cameras_of_pose_files_become_keys_of_the_film(tmp_path):
    """What `pose --camera` writes beside poses is loaded too, and looks at the same."""
    file = PoseFile(CAGE, {"a": POSES[0], "b": POSES[1]})
    file.times = {"a": 0.0, "b": 1.0}
    places = [(3.0, -1.0, 1.0), (0.0, 4.0, 2.0)]
    looking = [Camera.look_at(eye, (0, 0, 0.2), width=640, height=480, fov_degrees=50) for eye in places]
    rolled = dataclasses.replace(looking[1], camera_to_world=looking[1].camera_to_world @ rolled_by(30))
    file.cameras = [CameraKey(looking[0], 0.0, "front"), CameraKey(rolled, 2.0, "side", "linear")]
    file.save(tmp_path / "poses.json")
    before = film((0.5, "smooth", None, VIEW), length=1.0)
    loaded = load_poses(before, 1, str(tmp_path / "poses.json"))
    assert [(key.time, key.name, key.poses is None, key.view is None) for key in loaded.timeline.keys] == [
        (0.0, "a", False, False),
        (1.0, "b", False, True),
        (2.0, "side", True, False),
    ]  # the view that the film had is gone
    assert loaded.timeline.length == 2.0 and loaded.timeline.keys[2].easing == "linear"
    for key, wanted in ((loaded.timeline.keys[0], looking[0]), (loaded.timeline.keys[2], rolled)):
        seen = view_camera(key.view, 640, 480)
        np.testing.assert_allclose(seen.camera_to_world, wanted.camera_to_world, atol=1e-9)
        assert seen.fy == pytest.approx(wanted.fy)
    assert loaded.timeline.keys[0].view.up == before.view.up  # it stands upright by what is up
    alone = PoseFile(CAGE)
    alone.cameras = file.cameras
    kept = with_pose_file(loaded, 1, alone)
    assert [key.poses is None for key in kept.timeline.keys] == [False, False, True]
    (tmp_path / "bad.json").write_text((tmp_path / "poses.json").read_text().replace('"time": 2.0', '"time": 1e9'))
    with pytest.raises(ValueError, match="bad.json: camera 'side' is at 1e[+]09 s"):
        load_poses(before, 1, str(tmp_path / "bad.json"))


def rolled_by(degrees):
    """A turn about the line of sight."""
    a = np.radians(degrees)
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    return turn


def looked(document, time):
    """Place, axis and upward direction (3, 3) of the film's camera at a time."""
    camera = view_camera(state_at(document, time)[1], 80, 60)
    return np.stack([camera.center, camera.rotation[:, 2], -camera.rotation[:, 1]])


def test_a_camera_that_follows_looks_at_the_cage_and_poses_stay():
    here, there = frozen_vertices(CAGE.vertices), frozen_vertices(CAGE.vertices + [0.0, 2.0, 0.5])
    before = film((0.0, "linear", here, VIEW), (2.0, "linear", there, None), (1.2, "smooth", None, VIEW), length=2.0)
    before = dataclasses.replace(before, selection=Selection(edit=1))
    after = with_camera_moves(before, "follow", [])[0]
    for time in (0.0, 1.0, 2.0):
        np.testing.assert_array_equal(pose_at(after, time), pose_at(before, time))
        way = np.array([0.0, 2.0, 0.5]) * time / 2.0 - VIEW.eye
        np.testing.assert_allclose(looked(after, time)[1], way / np.linalg.norm(way), atol=1e-6)
    assert [key.time for key in after.timeline.keys if key.time == 1.2] == []  # of a camera alone, which is replaced
    assert len({key.id for key in after.timeline.keys}) == len(after.timeline.keys)


def test_a_move_goes_its_own_way_beside_keys_of_poses():
    poses = [(0.0, CURVE, POSES[0], None), (1.5, "hold", POSES[1], VIEW), (3.0, "bounce", POSES[2], None)]
    moved, alone = (with_camera_moves(one, "turn:90", [])[0] for one in (film(*poses, length=3.0), film(length=3.0)))
    for time in (0.0, 0.7, 1.5, 2.2, 3.0):
        np.testing.assert_allclose(looked(moved, time), looked(alone, time), atol=1e-9)


def test_a_turn_stays_within_what_pictures_saw():
    ways = np.radians(np.arange(-40, 81, 15))  # a third of the way round
    eyes = 3.2 * np.stack([np.cos(ways), np.sin(ways), np.full(len(ways), 0.3)], axis=1)
    seen = [Camera.look_at(eye, (0.0, 0.0, 0.0), width=80, height=60) for eye in eyes]
    moved, note = with_camera_moves(film(length=4.0), "turn", seen)
    azimuths = np.degrees([np.arctan2(*looked(moved, time)[0][1::-1]) for time in np.linspace(0, 4, 41)])
    known = np.degrees([np.arctan2(camera.center[1], camera.center[0]) for camera in seen])
    assert "no picture shows the rest" in note and 90 < np.ptp(azimuths) < 150
    assert known.min() - 10 < azimuths.min() and azimuths.max() < known.max() + 10
    np.testing.assert_allclose(looked(moved, 0.0), looked(moved, 4.0), atol=1e-6)


@pytest.mark.parametrize(
    ("move", "apart"),
    [
        ("turn:90", 1e-6),
        ("turn:-130", 1e-6),
        ("turn", 1e-6),
        ("dolly:0.5", 0.2),
        ("crane:30", 0.1),
        ("hand-held:3", 0.01),
    ],
)
def test_keys_of_a_move_take_the_camera_where_the_move_does(move, apart):
    """There at both ends, and nearly there between keys; tests/studio/films checks the moves themselves."""
    moved, note = with_camera_moves(film(length=3.0), move, [])
    assert note == "" and moved.timeline.length == 3.0
    start, pivot, up = view_camera(VIEW, 80, 60), np.array(VIEW.target), np.array(VIEW.up)
    camera = MovingCamera(start, pivot, up, camera_moves(move), 72 + (move != "turn"))
    for frame in range(0, 73, 6):
        there = camera.at(frame)
        expected = np.stack([there.center, there.rotation[:, 2], -there.rotation[:, 1]])
        near = 1e-6 if frame in (0, 72) else apart
        np.testing.assert_allclose(looked(moved, frame / 24.0), expected, atol=near)
    assert np.abs(looked(moved, 1.5) - looked(moved, 0.0)).max() > 2e-3


@pytest.mark.parametrize("text", ["spin", "turn:x", "dolly:0", "", "follow"])
def test_a_text_that_names_no_move_is_refused(text):
    with pytest.raises(ValueError, match="a move|1 to 100 letters|cage to follow"):
        with_camera_moves(film(length=4.0), text, [])


def test_a_move_of_too_many_keys_is_refused():
    with pytest.raises(ValueError, match="a film has at most"):
        with_camera_moves(film(length=3600.0), "hand-held", [])
