"""Several edits of one scene on the command line: --edit, edits files, sessions of the editor, cages without a pose."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from messages import MESSAGES
from runs import SMALL, run, succeed, write_files

from warpcage import Cage, CageEdit, Camera, Deformer, PoseFile, VoxelField
from warpcage.edits import EditSpec
from warpcage.studio.cli.program import build_parser
from warpcage.studio.cli.shared import parse_edit
from warpcage.studio.editor import Document, Selection, Settings, Timeline, View, new_edit, write_session
from warpcage.studio.films import read_edits_file, write_edits_file
from warpcage.view import read_image

VIEW = (*SMALL, "--eye", 0, -4, 0.5, "--target", 0, 0, 0, "--background", "white")
TOP = Cage.box((-0.7, -0.7, 0.0), (0.7, 0.7, 0.7))
LEFT = Cage.box((-0.7, -0.7, -0.7), (-0.2, 0.7, 0.7))
POSED_TOP, ASIDE = TOP.translate([0.5, 0, 0.3]), LEFT.translate([-0.2, 0, -0.2])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("cli"))
    TOP.save(folder / "top.obj")
    POSED_TOP.save(folder / "top_up.obj")
    LEFT.save(folder / "left.obj")
    ASIDE.save(folder / "aside.obj")
    PoseFile(LEFT, {"near": LEFT.translate([-0.1, 0, 0]), "far": ASIDE}).save(folder / "left.json")
    return folder


def render(files, tmp_path, *argv, name="picture"):
    path = tmp_path / f"{name}.png"
    succeed(files, "render", "@ball.npz", "-o", path, *VIEW, *argv)
    return read_image(path)


def expected(files, edits, poses):
    camera = Camera.look_at([0, -4, 0.5], (0, 0, 0), width=40, height=40, fov_degrees=40)
    deformer = Deformer(VoxelField.load(files / "ball.npz"), edits, coordinates="mean_value", resolution=24)
    return deformer.pose(poses).render(camera, background="white").rgb


@pytest.mark.parametrize(
    ("text", "argv"),
    [
        ("cage.obj:posed.obj", EditSpec("cage.obj", "posed.obj")),
        ("cage.obj:posed.obj:keep", EditSpec("cage.obj", "posed.obj", keep=True)),
        ("a/cage.glb:remove", EditSpec("a/cage.glb", remove=True)),
        ("cage.PLY:bend:40:x:z:keep", EditSpec("cage.PLY", "bend:40:x:z", keep=True)),
        ("cage.obj:poses.json:wave", EditSpec("cage.obj", "poses.json:wave")),
        (r"C:\me\cage.obj:D:\posed.obj", EditSpec(r"C:\me\cage.obj", r"D:\posed.obj")),
        (r"C:cage.obj:C:poses.json:wave:keep", EditSpec("C:cage.obj", "C:poses.json:wave", keep=True)),
        ("cage.obj:posed.obj:keep:falloff=0.5", EditSpec("cage.obj", "posed.obj", keep=True, falloff=0.5)),
        ("cage.obj:remove:fragments=0.1", EditSpec("cage.obj", remove=True, fragments=0.1)),
        ("a.obj:twist:30:held=3,4:falloff=1", EditSpec("a.obj", "twist:30", falloff=1.0, held=(3, 4))),
        ("my.obj files/a.obj:b.obj", EditSpec("my.obj files/a.obj", "b.obj")),
        ("a.obj:my.obj files/b.glb:wave", EditSpec("a.obj", "my.obj files/b.glb:wave")),
    ],
)
def test_options_of_an_edit_in_one_argument(text, argv):
    assert parse_edit(text) == argv


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("posed", "names no cage file"),
        ("cage.obj", "there is no posed cage"),
        ("cage.obj:keep", "there is no posed cage"),
        ("cage.obj:keep:remove", "do not go together"),
        ("cage.obj:posed.obj:remove", "needs no 'posed'"),
        ("cage.obj:remove:falloff=0.2", "goes without 'falloff'"),
        ("cage.obj:remove:held=4,5", "goes without 'falloff'"),
        ("cage.obj:posed.obj:falloff=wide", "falloff|finite number"),
        ("cage.obj:posed.obj:kept", "'kept' is unknown in an edit"),
        ("cage.obj:posed.obj:falof=1:keep", "'falof=1' is unknown in an edit"),
        ("cage.obj:posed.obj:held=left:falloff=1", 'held must be "cut", "still", or numbers'),
    ],
)
def test_what_is_no_edit_is_refused(text, message):
    with pytest.raises(ValueError, match=message) as caught:
        parse_edit(text)
    assert text in str(caught.value) and "\n" not in str(caught.value)


def test_edits_of_one_command_act_in_their_order(files, tmp_path):
    moved, removed = "@top.obj:@top_up.obj", "@left.obj:remove"
    picture = render(files, tmp_path, "--edit", moved, "--edit", removed)
    edits = [CageEdit(TOP), CageEdit(LEFT, remove=True)]
    np.testing.assert_allclose(picture, expected(files, edits, [POSED_TOP, None]), atol=0.003)
    other = render(files, tmp_path, "--edit", removed, "--edit", moved)
    np.testing.assert_allclose(other, expected(files, edits[::-1], [None, POSED_TOP]), atol=0.003)
    assert np.abs(picture - other).mean() > 0.01  # what was moved out of the other cage is not removed
    copied = render(files, tmp_path, "--edit", "@left.obj:@aside.obj:keep")
    np.testing.assert_allclose(copied, expected(files, [CageEdit(LEFT, keep_source=True)], [ASIDE]), atol=0.003)


def test_a_part_fades_to_rest_in_a_band(files, tmp_path):
    """The overlay shows the cage with its held walls."""
    lifted = render(files, tmp_path, "--edit", "@top.obj:@top_up.obj", "--falloff", 0.3)
    over = render(files, tmp_path, "--cage", "@top.obj", "--posed", "@top_up.obj", "--falloff", 0.3, "--overlay")
    at_rest = render(files, tmp_path, "--cage", "@top.obj", "--overlay")
    drawn, rest = np.abs(over - lifted).max(axis=-1) > 0.3, np.abs(at_rest - render(files, tmp_path)).max(axis=-1) > 0.3
    assert (drawn & rest).sum() > 5  # the held wall


def test_fragments_by_their_old_name_are_taken_with_a_warning(files, tmp_path, capsys):
    assert build_parser().parse_args(["render", "a.npz", "-o", "a.png", "--fragments", "0.5"]).fragments == 0.5
    with pytest.warns(UserWarning, match="--crumbs is --fragments now"):
        old = build_parser().parse_args(["render", "a.npz", "-o", "a.png", "--crumbs", "0.5"])
    assert old.fragments == 0.5
    with pytest.warns(UserWarning, match="crumbs= is fragments= now"):
        assert parse_edit("cage.obj:remove:crumbs=0.1") == EditSpec("cage.obj", remove=True, fragments=0.1)
    assert run(files, "edits", "--edit", "@top.obj:remove:crumbs=1", "-o", tmp_path / "a.json") == 0
    (edit,) = json.loads((tmp_path / "a.json").read_text())["edits"]
    assert edit["remove"] and edit["fragments"] == 1.0
    assert capsys.readouterr().err == (
        "warpcage: warning: crumbs= is fragments= now: the old name goes with warpcage 0.4\n"
    )


def test_an_edits_file_and_its_cages_move_together(files, tmp_path, capsys):
    argv = ["--edit", "@top.obj:@top_up.obj", "--edit", "@left.obj:@left.json:far:keep", "--edit", "@other.obj:rest"]
    folder = tmp_path / "house"
    folder.mkdir()
    for name in ("top.obj", "top_up.obj", "left.obj", "left.json", "other.obj"):
        shutil.copy(files / name, folder)
    succeed(folder, "edits", "-o", "@all.edits.json", *argv)
    said = capsys.readouterr().out
    assert "3 edits, in this order" in said and "the source stays (a copy)" in said and "8 vertices" in said
    wanted = render(files, tmp_path, *argv)
    moved = folder.rename(tmp_path / "moved")
    np.testing.assert_array_equal(render(files, tmp_path, "--edits", moved / "all.edits.json"), wanted)
    succeed(moved, "info", "@all.edits.json")
    assert "edit 2  " in (said := capsys.readouterr().out) and "left.json:far" in said
    content = json.loads((moved / "all.edits.json").read_text())
    assert content["edits"][0] == {"cage": "top.obj", "posed": "top_up.obj"}
    assert content["edits"][1] == {"cage": "left.obj", "posed": "left.json:far", "keep": True}
    assert content["edits"][2]["posed"] == "rest"
    # a fourth edit, in a file in another folder
    succeed(moved, "edits", "@all.edits.json", "--edit", "@left.obj:remove", "-o", tmp_path / "more.json")
    assert read_edits_file(tmp_path / "more.json")[0].cage == str(tmp_path / "moved" / "top.obj")
    succeed(files, "edits", tmp_path / "more.json")
    assert "4. " in capsys.readouterr().out


def test_a_session_of_the_editor_is_an_edits_file(files, tmp_path, capsys):
    hidden = dataclasses.replace(new_edit(3, LEFT, "hidden", "remove"), visible=False)
    edits = (new_edit(1, TOP, "top", posed=POSED_TOP.vertices), new_edit(2, LEFT, "left", "remove"), hidden)
    session = tmp_path / "ball.session.json"
    document = Document(edits, Selection(), Settings(), View((0, -4, 0), (0, 0, 0), (0, 0, 1)), Timeline(), next_id=4)
    write_session(session, document, VoxelField.load(files / "ball.npz"), "ball.npz")
    picture = render(files, tmp_path, "--edits", session)
    argv = ["--edit", "@top.obj:@top_up.obj", "--edit", "@left.obj:remove"]
    np.testing.assert_allclose(picture, render(files, tmp_path, *argv), atol=0.003)
    succeed(files, "edits", session)
    assert "2 edits" in capsys.readouterr().out
    assert run(files, "edits", session, "-o", tmp_path / "x.json") == 2


def test_a_film_of_several_edits(files, tmp_path, capsys):
    """An edit with fewer poses than another stays in its last one; what is removed is not there from the start."""
    argv = ["animate", "@ball.npz", "-o", tmp_path / "film", *VIEW, "--turn", 0, "--motion", "once", "--quiet"]
    argv += ["--interpolation", "linear", "--frames", 3, "--edit", "@left.obj:@left.json"]
    succeed(files, *argv, "--edit", "@top.obj:@top_up.obj")
    frames = [read_image(tmp_path / "film" / f"frame_000{index}.png") for index in range(3)]
    both = ["--edit", "@left.obj:@left.json:far", "--edit", "@top.obj:@top_up.obj"]
    np.testing.assert_allclose(frames[2], render(files, tmp_path, *both), atol=0.01)
    both[1] = "@left.obj:@left.json:near"
    np.testing.assert_allclose(frames[1], render(files, tmp_path, *both), atol=0.01)
    np.testing.assert_allclose(frames[0], render(files, tmp_path), atol=0.01)
    assert run(files, *argv, "--edit", "@top.obj:remove") == 2
    assert "other cage, posed" in capsys.readouterr().err


def test_a_cage_is_seen_without_a_pose(files, tmp_path):
    plain = render(files, tmp_path)
    over = render(files, tmp_path, "--cage", "@cage.obj", "--overlay")
    drawn = np.abs(over - plain).max(axis=-1) > 0.05
    assert 0.02 < drawn.mean() < 0.6
    # several, and one whose content is removed
    assert (
        render(files, tmp_path, "--edit", "@top.obj:rest", "--edit", "@left.obj:remove", "--overlay") != plain
    ).any()


@pytest.mark.parametrize("held", ["3,4", [3, 4]])
def test_held_faces_are_read_from_a_text_or_a_list_and_written_as_a_text(tmp_path, held):
    path = tmp_path / "house.edits.json"
    edit = EditSpec(str(tmp_path / "top.obj"), "rest", falloff=0.0, held=(3, 4))
    write_edits_file(path, [edit])
    content = json.loads(path.read_text())
    assert content["edits"] == [{"cage": "top.obj", "posed": "rest", "falloff": 0.0, "held": "3,4"}]
    path.write_text(json.dumps({**content, "edits": [content["edits"][0] | {"held": held}]}))
    assert read_edits_file(path) == [edit]


def test_all_of_an_edit_is_said():
    edits = [EditSpec("a.obj", "b.obj", keep=True, falloff=0.5, held=(3, 4), fragments=0.1),
             EditSpec("a.obj", remove=True, fragments=0.1)]  # fmt: skip
    assert [str(edit) for edit in edits] == [
        "a.obj -> b.obj, the source stays (a copy), fades to rest over 0.5 (held=3,4), fragments below 0.1 go too",
        "a.obj: removed, fragments below 0.1 go too",
    ]


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        ({"cage": "top.obj"}, "edit 1: 'cage' needs 'posed'"),
        ({"posed": "rest"}, "edit 1: it names no cage"),
        ({"cage": "top.obj", "posed": "rest", "kept": True}, MESSAGES["cage.edit_keys"]),
        ("top.obj:rest", "edit 1: it must be an object"),
    ],
)
def test_bad_edits_files_say_where(tmp_path, edit, message):
    path = tmp_path / "bad.json"
    write_edits_file(path, [EditSpec("top.obj", "rest")])
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "edits": [edit]}))
    with pytest.raises(ValueError, match=message):
        read_edits_file(path)
    for changes, wrong in (
        ({"version": 3}, "version is 3"),
        ({"edits": []}, "at least one"),
        ({"format": 1}, "format"),
    ):
        path.write_text(json.dumps({**content, **changes}))
        with pytest.raises(ValueError, match=wrong):
            read_edits_file(path)
