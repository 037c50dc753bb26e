import functools
import json

import numpy as np
import pytest
from oracles import shuffled_cage
from refusals import refused

from warpcage import Cage, PoseFile
from warpcage.cage import cage_hash, poses
from warpcage.demo import scene_field


def test_subdivision_keeps_the_surface_and_the_first_vertices():
    cage = Cage.cylinder([0, 0, 0], 1.0, 3.0, sides=7)
    fine = cage.subdivide(2)
    fine.require_usable()
    assert len(fine.faces) == 16 * len(cage.faces) and fine.volume == pytest.approx(cage.volume)
    assert np.array_equal(fine.vertices[: len(cage.vertices)], cage.vertices)
    assert fine.check().genus == 0
    refused(lambda: cage.subdivide(0), match="times")


@pytest.mark.parametrize("scene", ["concave", pytest.param("tall", marks=pytest.mark.nightly)])
def test_a_thousand_vertices_become_few_and_still_enclose(scene):
    field = scene_field(scene, 32)
    fine = Cage.from_field(field, 1000, method="shell")
    for count in (150, 60):
        cage = fine.simplify(count, field=field)
        report = cage.check(field=field)
        assert report.usable and report.intersecting_faces == () and report.field_enclosed == 1.0
        assert abs(report.vertex_count - count) <= 0.1 * count
        assert cage.volume < 3.0 * fine.volume


def test_simplified_without_an_object_the_cage_lies_around_itself():
    fine = Cage.icosphere([1, 2, 3], 1.0, 3)
    cage = fine.simplify(60)
    assert abs(len(cage.vertices) - 60) <= 6 and cage.contains(fine.vertices).all()
    assert cage.volume < 1.5 * fine.volume
    refused(lambda: cage.simplify(100), match="ask for fewer")
    refused(lambda: fine.simplify(60, mesh=Cage.icosphere([1, 2, 3], 1.2)), match="does not enclose the object")
    refused(lambda: fine.simplify(60, margin=-1.0), match="margin")


@pytest.mark.parametrize("axis", "xyz")
def test_symmetrise(axis):
    along = "xyz".index(axis)
    box = Cage.box([0, 0, 0], [1, 2, 3], segments=2)
    uneven = box.with_vertices(box.vertices + np.random.default_rng(0).normal(0, 0.03, box.vertices.shape))

    def mirrored(cage, middle):
        image = cage.vertices.copy()
        image[:, along] = 2 * middle - image[:, along]
        return np.linalg.norm(image[:, None] - cage.vertices[None], axis=2).min(axis=1)

    even = uneven.symmetrise(axis)
    assert mirrored(uneven, uneven.bounds[:, along].mean()).max() > 0.01
    assert mirrored(even, uneven.bounds[:, along].mean()).max() < 1e-12
    middle = box.bounds[:, along].mean()
    for keep, sign in (("+", 1), ("-", -1)):
        half = uneven.symmetrise(axis, center=middle, keep=keep)
        assert mirrored(half, middle).max() < 1e-12
        side = sign * (box.vertices[:, along] - middle) > 0.1
        assert np.array_equal(half.vertices[side], uneven.vertices[side])
    refused(lambda: box.symmetrise(axis, center=box.bounds[1, along] + 0.2), match="no partner")
    refused(lambda: box.symmetrise(axis, keep="left"), match="keep")


def test_move_with_falloff():
    line = np.stack([np.arange(11.0), np.zeros(11), np.zeros(11)], axis=1)
    moved = poses.move(line, [0, 2, 0], group=[5], radius=4.0)
    assert moved[5].tolist() == [5, 2, 0] and np.array_equal(moved[[0, 1, 9, 10]], line[[0, 1, 9, 10]])
    assert moved[7, 1] == pytest.approx(1.0) and (np.diff(moved[5:10, 1]) < 0).all()
    assert np.allclose(moved[:, 1], moved[::-1, 1]) and np.array_equal(moved[:, 0], line[:, 0])
    assert np.allclose(poses.move(line, [0, 2, 0], center=[5, 0, 0], radius=4.0), moved)
    alone = poses.move(line, [0, 2, 0], group=[2, 3])
    assert np.flatnonzero(alone[:, 1]).tolist() == [2, 3]
    cage = Cage.box([0, 0, 0], [1, 1, 1])
    assert cage.move([1, 0, 0], group=[0]).faces is cage.faces
    for options in (
        {},
        {"group": [0], "center": [0, 0, 0]},
        {"group": [11]},
        {"group": []},
        {"group": [0.5]},
        {"center": [0, 0, 0]},
        {"group": [0], "radius": 0.0},
    ):
        refused(functools.partial(poses.move, line, [0, 2, 0], **options))


def keyframes():
    rest = Cage.box([0, 0, 0], [1, 1, 4], segments=(1, 1, 4))
    poses = {"bent": rest.bend(40), "twisted": shuffled_cage(rest.twist(30)), "long": rest.stretch(2).vertices}
    return PoseFile(rest, poses)


def test_keyframes_blend():
    file = keyframes()
    rest = file.rest
    assert np.array_equal(file["twisted"].vertices, rest.twist(30).vertices) and len(file) == 3
    assert np.array_equal(file.blend({}).vertices, rest.vertices)
    assert np.allclose(file.blend({"bent": 1.0}).vertices, rest.bend(40).vertices)
    both = file.blend({"bent": 0.5, "long": -1.0})
    expected = 0.5 * (rest.vertices + rest.bend(40).vertices) - (rest.stretch(2).vertices - rest.vertices)
    assert np.allclose(both.vertices, expected)
    for k, name in enumerate(file.names):
        assert np.allclose(file.at(k).vertices, file[name].vertices)
    before, after = file.at(1 - 1e-6).vertices, file.at(1 + 1e-6).vertices
    here = file.at(1).vertices
    assert np.allclose(here - before, after - here, atol=1e-10)  # no kink
    assert np.allclose(file.at(0, ["long"]).vertices, file["long"].vertices)


def test_pose_files_survive(tmp_path):
    file = keyframes()
    file.save(tmp_path / "poses.json")
    back = PoseFile.load(tmp_path / "poses.json")
    assert back.names == file.names and cage_hash(back.rest) == cage_hash(file.rest)
    for name in file.names:
        assert np.array_equal(back[name].vertices, file[name].vertices)

    # the cage was exported anew, in another order
    other = shuffled_cage(file.rest, seed=5)
    again = PoseFile.load(tmp_path / "poses.json", other)
    assert again["bent"].faces is other.faces
    assert again["bent"].volume == pytest.approx(file["bent"].volume)
    assert np.allclose(other.match(file["bent"]).vertices, again["bent"].vertices)

    document = json.loads((tmp_path / "poses.json").read_text())
    changed = {
        "newer": document | {"later": 1},
        "version": document | {"version": 2},
        "format": document | {"format": "poses"},
        "hash": document | {"cage": document["cage"] | {"sha256": "0"}},
        "short": {"format": "warpcage poses"},
    }
    for name, content in changed.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    assert PoseFile.load(tmp_path / "newer.json").names == file.names
    broken = {"version": "upgrade", "format": "format is", "hash": "hash", "short": "not a pose file"}
    for name, message in broken.items():
        refused(functools.partial(PoseFile.load, tmp_path / f"{name}.json"), message, f"{name}.json")
    with pytest.raises(ValueError, match="keyframe 'bent': the pose has"):
        PoseFile.load(tmp_path / "poses.json", Cage.icosphere([0, 0, 0], 1.0))
    refused(lambda: PoseFile.load(tmp_path / "nothing.json"), error=FileNotFoundError)


def test_keyframes_refuse():
    file = keyframes()
    for call in (
        lambda: file["none"],
        lambda: file.blend({"none": 1.0}),
        lambda: file.blend({"bent": np.nan}),
        lambda: file.at(2.5),
        lambda: PoseFile(file.rest, {"": file.rest}),
        lambda: PoseFile(file.rest, {"few": file.rest.vertices[:3]}),
    ):
        refused(call)
