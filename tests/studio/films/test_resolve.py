"""What names of the command line and of JSON files load: the same poses, read once while their files stay."""

import json
import os

import numpy as np
import pytest
from polygon_cages import mixed_prism, triangulated
from refusals import refused
from scene_writers import GltfWriter

from warpcage import Cage, PoseFile
from warpcage.cage.pose_file import MOVING_ENDINGS
from warpcage.edits.spec import EditSpec
from warpcage.studio.films import AssetResolver, EditReader, RestCage

BOX = Cage.box([-0.7, -0.7, -0.7], [0.7, 0.7, 0.7], segments=2)
BENT = BOX.bend(40, axis="x", towards="z").translate([0, 0, 0.2])


@pytest.fixture
def folder(tmp_path):
    BOX.save(tmp_path / "cage.obj")
    BENT.save(tmp_path / "posed.obj")
    BENT.save(tmp_path / "y.obj", up="y")
    Cage(BENT.vertices, np.roll(BENT.faces, 1, axis=0)).save(tmp_path / "shuffled.obj")
    poses = PoseFile(BOX, {"frame 0": BOX, "frame 1": BENT})
    poses.save(tmp_path / "poses.json")
    PoseFile(BOX, {"a": BENT}).save(tmp_path / "one.pc2")
    poses.times = {"frame 0": 0.0, "frame 1": 1 / 24}
    for ending in MOVING_ENDINGS:
        poses.save(tmp_path / f"walk{ending}")
    return tmp_path


def resolvers(folder):
    """Those of the command line and of JSON files, and the lines that the first reports."""
    lines = []
    return AssetResolver(folder, report=lines.append), AssetResolver(folder, in_json=True), lines


@pytest.mark.parametrize("file", ["poses.json", "walk.glb", "walk.pc2"])
def test_the_other_spelling_of_a_keyframe_is_named(folder, file):
    shell, in_json, _ = resolvers(folder)
    refused(lambda: shell.pose(RestCage(BOX), f"{file}#frame 1"), match=f"is named so: {file}:frame 1")
    refused(lambda: in_json.pose(RestCage(BOX), f"{file}:frame 1"), match=f"is named so: {file}#frame 1")
    refused(lambda: in_json.pose(RestCage(BOX), "none.json:frame 1"), match="must end in")


@pytest.mark.parametrize(
    "name",
    [
        "posed.obj",
        "y.obj",
        "shuffled.obj",
        "one.pc2",
        "poses.json*frame 1",
        "poses.json*1",
        "walk.pc2*frame 1",
        "walk.mdd*frame 1",
    ],
)
def test_both_ways_load_the_same_pose(folder, name):
    shell, in_json, _ = resolvers(folder)
    one, two = shell.pose(RestCage(BOX), name.replace("*", ":")), in_json.pose(RestCage(BOX), name.replace("*", "#"))
    np.testing.assert_array_equal(one.vertices, two.vertices)
    np.testing.assert_allclose(one.vertices, BENT.vertices, atol=1e-6)


@pytest.mark.parametrize("weight", [0.5, 1.0])
def test_a_gltf_file_is_taken_as_it_shows_itself(tmp_path, weight):
    """Its only shape by its own weight, as a program that opens it does; by name it is on in full."""
    y_up = np.stack([BOX.vertices[:, 0], BOX.vertices[:, 2], -BOX.vertices[:, 1]], axis=1)
    made = GltfWriter(y_up, BOX.faces)
    made.primitive["targets"] = [{"POSITION": made.add(y_up * [0, 0.5, 0])}]
    made.save(tmp_path / "tall.gltf", extras={"targetNames": ["tall"]}, weights=[weight])
    for resolver, separator in zip(resolvers(tmp_path), ":#", strict=False):
        shown = resolver.pose(RestCage(BOX), "tall.gltf")
        np.testing.assert_allclose(shown.vertices, BOX.vertices * [1, 1, 1 + 0.5 * weight], atol=1e-6)
        named = resolver.pose(RestCage(BOX), f"tall.gltf{separator}tall")
        np.testing.assert_allclose(named.vertices, BOX.vertices * [1, 1, 1.5], atol=1e-6)


@pytest.mark.parametrize("ending", [".json", *MOVING_ENDINGS])
def test_of_several_poses_one_is_to_be_named(folder, ending):
    name, rest = f"poses{ending}" if ending == ".json" else f"walk{ending}", RestCage(BOX)
    shell, in_json, _ = resolvers(folder)
    assert len(shell.poses(rest, name)) == len(in_json.poses(rest, name)) == 2
    expected = "name one, as in poses.json:frame 0" if ending == ".json" else "holds an animation of 2"
    refused(lambda: shell.pose(rest, name), match=expected)
    refused(lambda: in_json.pose(rest, name), match=f"name one, as in {name}#")
    assert (shell.film(rest, [name]) is None) == (ending == ".json")  # which has no times


def test_files_are_read_once_while_they_stay(folder, monkeypatch):
    reads, load = [], PoseFile.load.__func__
    monkeypatch.setattr(
        PoseFile, "load", classmethod(lambda cls, path, rest: reads.append(path) or load(cls, path, rest))
    )
    resolver, rest = AssetResolver(folder, in_json=True), RestCage(BOX)
    for key in ("frame 0", "frame 1", "1"):
        resolver.pose(rest, f"poses.json#{key}")
    assert len(reads) == 1
    resolver.pose(RestCage(BOX.scale(2.0)), "poses.json#1")  # another cage at rest
    content = json.loads((folder / "poses.json").read_text())
    content["keyframes"][1]["vertices"] = BOX.vertices.tolist()
    (folder / "poses.json").write_text(json.dumps(content))
    os.utime(folder / "poses.json", (1, 1))
    np.testing.assert_array_equal(resolver.pose(rest, "poses.json#1").vertices, BOX.vertices)
    assert len(reads) == 3


def test_what_was_read_differently_is_reported_and_not_printed(folder, capsys):
    shell, in_json, lines = resolvers(folder)
    for name in ("posed.obj", "y.obj", "shuffled.obj"):
        shell.pose(RestCage(BOX), name)
        in_json.pose(RestCage(BOX), name)
    assert lines == [
        "cage 'y.obj' has y up, and is turned to its rest cage (--posed-up z keeps it as it was)",
        "cage 'shuffled.obj' has another order of vertices than its rest cage: matched",
    ]
    assert capsys.readouterr() == ("", "")


def test_one_pose_is_taken_where_a_command_has_one(folder):
    reader, spec = EditReader(AssetResolver(folder)), EditSpec("cage.obj", "posed.obj")
    assert len(reader.edit(spec, ["posed.obj"], None).poses) == 1
    refused(lambda: reader.edit(spec, ["posed.obj", "rest"], None), match="one pose is needed, got 2")


def test_cages_of_polygons_in_files_arrays_and_lists_are_the_same(tmp_path):
    cage = mixed_prism()
    cage.save(tmp_path / "cage.obj")
    np.save(tmp_path / "rest.npy", cage.vertices)
    np.save(tmp_path / "faces.npy", cage.face_array)
    resolver = AssetResolver(tmp_path, in_json=True)
    lists = {"vertices": "rest.npy", "faces": [list(face) for face in cage.polygons]}
    found = [resolver.rest(each) for each in ("cage.obj", {"vertices": "rest.npy", "faces": "faces.npy"}, lists)]
    assert {rest.cage.polygons for rest in found} == {cage.polygons} and len({rest.hash for rest in found}) == 1
    split = triangulated(cage)
    assert RestCage(split).hash not in {rest.hash for rest in found}  # it makes other pictures
    split.with_vertices(cage.twist(20).vertices).save(tmp_path / "posed.obj")
    posed = resolver.pose(found[0], "posed.obj")
    assert posed.polygons == cage.polygons
    np.testing.assert_array_equal(posed.vertices, cage.twist(20).vertices)
    refused(lambda: resolver.rest(lists | {"faces": [[0, 1, 2], [0, 1, 2, "x"]]}), match="whole numbers")
