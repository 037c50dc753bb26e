"""Cages whose files have another axis up than is expected: found from their object and from their rest cage."""

import functools
import types
import warnings

import numpy as np
import pytest
import trimesh
from messages import MESSAGES
from refusals import refused
from runs import run, succeed

from warpcage import Cage, VoxelField, select_nodes
from warpcage.cage import restood, standing_of_rest
from warpcage.select import some_visible_nodes, visible_nodes
from warpcage.view import read_image

VIEW = ("--size", "40", "--coordinates", "mean_value", "--resolution", "24", "--eye", 0, -5, 1, "--target", 0, 0, 0)

#: A tall post on a long foot, off the origin, and its cage.
POST, FOOT = ((-0.3, -0.2, -0.9), (0.3, 0.2, 0.8)), ((-0.3, -0.5, -0.9), (0.3, 0.7, -0.6))


@functools.cache
def post():
    """A field of the two boxes."""
    places = np.stack(np.meshgrid(*[(np.arange(32) + 0.5) / 16 - 1] * 3, indexing="ij"), axis=-1)
    inside = [((places > low) & (places < high)).all(axis=-1) for low, high in (POST, FOOT)]
    sh = np.zeros((32, 32, 32, 9, 3))
    sh[..., 0, :] = np.where(places[..., 2:] > 0, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])
    return VoxelField.from_dense(np.where(inside[0] | inside[1], 40.0, 0.0), sh, [[-1, -1, -1], [1, 1, 1]])


def whole(segments=3):
    return Cage.box((-0.4, -0.6, -1.0), (0.4, 0.8, 0.9), segments=segments)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The field; its cage at rest and posed as each program may write them."""
    folder = tmp_path_factory.mktemp("upright")
    post().save(folder / "post.npz")
    rest = whole()
    posed = rest.bend(50, axis="z", towards="x", limits=(0.3, 1.0))
    for name, cage in (("rest", rest), ("posed", posed)):
        for up in "yz":
            for ending in ("obj", "glb"):
                cage.save(folder / f"{name}_{up}.{ending}", up=up)
    extract = trimesh.creation.box(bounds=[[-0.3, -0.5, -0.9], [0.3, 0.7, 0.8]])
    extract.export(folder / "mesh.obj")
    return folder


@pytest.fixture(scope="module")
def right(files):
    """The picture by cages that stand as their files say."""
    cages = ["--cage", "@rest_z.obj", "--posed", "@posed_z.obj"]
    succeed(files, "render", "@post.npz", "-o", "@right.png", *VIEW, *cages)
    return read_image(files / "right.png")


@pytest.mark.parametrize("rest", ["rest_z.obj", "rest_y.obj", "rest_y.glb", "rest_z.glb"])
@pytest.mark.parametrize("posed", ["posed_z.obj", "posed_y.obj", "posed_z.glb"])
def test_each_file_is_turned_to_the_object(files, right, tmp_path, capsys, rest, posed):
    cages = ["--cage", f"@{rest}", "--posed", f"@{posed}"]
    succeed(files, "render", "@post.npz", "-o", tmp_path / "found.png", *VIEW, *cages)
    said = capsys.readouterr().err
    usual = {"obj": "z", "glb": "y"}
    for name, option in ((rest, "--cage-up"), (posed, "--posed-up")):
        up, ending = name[-5], name[-3:]
        line = f"{name}' has {up} up, and is turned"
        assert (line in said) == (option in said) == (up != usual[ending])
        usual[ending] = up  # the axis of a rest cage is expected of poses of the same format
    assert np.abs(read_image(tmp_path / "found.png") - right).max() < 0.02


def test_a_given_axis_is_obeyed_and_doubted(files, right, tmp_path, capsys):
    capsys.readouterr()
    argv = ["render", "@post.npz", "-o", tmp_path / "x.png", *VIEW, "--cage", "@rest_y.obj", "--posed", "@posed_y.obj"]
    succeed(files, *argv, "--cage-up", "z")
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "warning: cage" in said and "seems to have y up" in said
    succeed(files, *argv, "--cage-up", "y")
    assert capsys.readouterr().err == "" and np.abs(read_image(tmp_path / "x.png") - right).max() < 0.02
    succeed(files, *argv, "--cage-up", "y", "--posed-up", "z")
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "would lie much nearer to its rest cage with another axis up" in said


def test_animate_bake_and_check_find_it_too(files, tmp_path, capsys):
    cages = ["--cage", "@rest_y.obj", "--posed", "@posed_z.obj"]
    right = ["--cage", "@rest_z.obj", "--posed", "@posed_z.obj"]
    film = [*VIEW, "--frames", 2, "--motion", "hold", "--turn", 0, "--quiet"]
    for name, argv in (("found", cages), ("right", right)):
        succeed(files, "animate", "@post.npz", "-o", tmp_path / name, *film, *argv)
        succeed(files, "bake", "@post.npz", "-o", tmp_path / f"{name}.npz", *argv, "--voxels", 16)
    found, wanted = (read_image(tmp_path / name / "frame_0001.png") for name in ("found", "right"))
    assert np.abs(found - wanted).max() < 0.02
    found, wanted = (VoxelField.load(tmp_path / f"{name}.npz").bounds for name in ("found", "right"))
    np.testing.assert_allclose(found, wanted, atol=1e-5)
    capsys.readouterr()

    for scene_object in ("@post.npz", "@mesh.obj"):
        succeed(files, "check", "@rest_y.obj", "--object", scene_object, "--posed", "@posed_y.obj")
        out, err = capsys.readouterr()
        assert "100.000" in next(row for row in out.splitlines() if " enclosed " in row)
        assert "has y up, and is turned" in err
        assert run(files, "check", "@rest_y.obj", "--object", scene_object, "--cage-up", "z") == 1
        out, err = capsys.readouterr()
        assert "stands around its object" in out and "seems to have y up" in out
        assert out.splitlines()[-1].split("  ")[-1].strip() == "not as it stands"


def test_a_cage_that_holds_nothing_is_refused(files, tmp_path, capsys):
    whole().translate((5, 5, 5)).save(tmp_path / "far.obj")
    argv = ["render", "@post.npz", "-o", tmp_path / "x.png", *VIEW, "--cage", tmp_path / "far.obj", "--posed", "rest"]
    assert run(files, *argv) == 2
    said = capsys.readouterr().err
    assert "far.obj: holds nothing of the object" in said and said.count("\n") == 1
    assert not (tmp_path / "x.png").exists()
    succeed(files, *argv, "--cage-up", "z")
    assert "warning: cage" in capsys.readouterr().err
    assert run(files, "check", tmp_path / "far.obj", "--object", "@post.npz") == 1
    assert "holds nothing of the object" in capsys.readouterr().out


def test_cages_of_a_part_stay_as_they_are(files, tmp_path, capsys):
    """Of parts at all corners of the object, whatever another axis would hold."""
    low, high = whole().bounds
    middle = 0.5 * (low + high)
    count = 0
    for corner in np.indices((2, 2, 2)).reshape(3, 8).T:
        ends = np.where(corner, middle, low), np.where(corner, high, middle)
        part = Cage.box(*ends, segments=2)
        if part.contains(visible_nodes(post())).mean() < 0.01:
            continue
        count += 1
        part.save(tmp_path / "part.obj")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            np.testing.assert_array_equal(Cage.load(tmp_path / "part.obj", reference=post()).vertices, part.vertices)
    assert count >= 4
    succeed(
        files,
        "render",
        "@post.npz",
        "-o",
        tmp_path / "x.png",
        *VIEW,
        "--cage",
        tmp_path / "part.obj",
        "--posed",
        "rest",
    )
    said = capsys.readouterr().err
    assert "warning" not in said and " % of what can be seen: the rest of it stays where it is" in said
    # one of several cages holds a part as it should: a word only where another axis would hold far more
    for top, message in ((-0.5, "has y up, and is turned"), (-0.3, "with y up it would hold")):
        foot = Cage.box((-0.4, -0.6, -1.0), (0.4, 0.8, top), segments=2)
        for up in "zy":
            foot.save(tmp_path / f"{up}.obj", up=up)
            edit = f"{tmp_path / up}.obj:translate:0:0:0.1"
            succeed(files, "render", "@post.npz", "-o", tmp_path / "x.png", *VIEW, "--edit", edit)
            assert (message in capsys.readouterr().err) == (up == "y")


@pytest.mark.parametrize(
    "low, high, times", [((-0.5, -0.45, -0.55), (0.5, 0.5, 0.1), 1.08), ((-0.5, -0.5, -0.9), (0.5, 0.5, 0.1), 1.67)]
)
def test_another_axis_is_mentioned_where_it_would_hold_clearly_more(low, high, times):
    """Of a plate of 2 x 2 x 1, where every part holds a little more or less when it is turned."""
    across, up = np.linspace(-1, 1, 40), np.linspace(-0.5, 0.5, 40)
    plate = types.SimpleNamespace(vertices=np.stack(np.meshgrid(across, across, up), axis=-1).reshape(-1, 3))
    cage = Cage.box(low, high, segments=2)
    here, there = (each.contains(plate.vertices).mean() for each in (cage, restood(cage, "z", "y")))
    assert there / here == pytest.approx(times, abs=0.01)
    note = standing_of_rest(cage, "z", plate).note
    assert "the rest of it stays where it is" in note
    assert ("; with y up it would hold" in note) == (times > 1.25)


def test_a_cage_that_holds_all_either_way_is_kept_and_doubted(tmp_path):
    mesh = trimesh.creation.box(bounds=[[-1, -0.9, -0.9], [1, 0.9, 0.8]])
    cage = Cage.box((-1.1, -1.0, -1.0), (1.1, 1.0, 0.9))
    cage.save(tmp_path / "y.obj", up="y")
    with pytest.warns(UserWarning, match="would fit it closer with y up"):
        kept = Cage.load(tmp_path / "y.obj", reference=mesh)
    np.testing.assert_array_equal(kept.vertices, Cage.load(tmp_path / "y.obj").vertices)
    cage.save(tmp_path / "z.obj")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Cage.load(tmp_path / "z.obj", reference=mesh)


LARGE = {
    "rotate:90:x": lambda cage: cage.rotate(90, axis="x"),
    "about the origin": lambda cage: cage.rotate(90, axis="x", center=(0, 0, 0)),
    "the other way": lambda cage: cage.rotate(-90, axis="x", center=(0, 0, 0)),
    "turned and moved": lambda cage: cage.rotate(90, axis="x").translate((1, 2, 3)),
    "turned and scaled": lambda cage: cage.rotate(-90, axis="x").scale(1.5),
    "a half turn": lambda cage: cage.rotate(180, axis="y"),
} | {
    f"{kind} {degrees} {axis}": lambda cage, kind=kind, degrees=degrees, axis=axis: getattr(cage, kind)(
        degrees, axis=axis, **({"towards": "y" if axis != "y" else "z"} if kind == "bend" else {})
    )
    for kind in ("bend", "twist", "rotate")
    for degrees in (-180, -120, -90, 90, 120, 180, 270)
    for axis in "xyz"
}


@pytest.mark.parametrize("name", LARGE)
def test_large_poses_are_not_turned(tmp_path, name):
    for rest in (whole(), Cage.cylinder((0.3, -0.8, 1.0), 0.4, 2.0, sides=8, rings=4)):
        pose = LARGE[name](rest)
        pose.save(tmp_path / "pose.ply")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            np.testing.assert_array_equal(Cage.load(tmp_path / "pose.ply", reference=rest).vertices, pose.vertices)


@pytest.mark.parametrize("name", ["obj", "glb"])
def test_poses_with_another_axis_up_are_turned(tmp_path, name):
    rest = Cage.cylinder((0.3, -0.8, 1.0), 0.4, 2.0, sides=8, rings=4)
    rng = np.random.default_rng(0)
    poses = [rest.bend(40), rest.twist(60), rest.taper(0.5), rest.stretch(1.5), rest.move((0.4, 0.2, 0), group=[3, 4])]
    poses += [rest.with_vertices(rest.vertices + 0.1 * rng.normal(size=rest.vertices.shape))]
    for pose in poses:
        pose.save(tmp_path / f"pose.{name}", up="y" if name == "obj" else "z")
        with pytest.warns(UserWarning, match="up, and is turned to its rest cage"):
            found = Cage.load(tmp_path / f"pose.{name}", up="auto", reference=rest)
        np.testing.assert_allclose(found.vertices, pose.vertices, atol=1e-6)


def test_a_turn_of_everything_is_kept_and_said(tmp_path):
    rest = whole()
    rest.save(tmp_path / "rest.obj", up="y")
    with pytest.warns(UserWarning, match="another axis up: y instead of z"):
        kept = Cage.load(tmp_path / "rest.obj", reference=rest)
    np.testing.assert_allclose(kept.vertices, rest.rotate(-90, axis="x", center=(0, 0, 0)).vertices, atol=1e-12)


def test_load_in_a_program(files):
    with pytest.warns(UserWarning, match=MESSAGES["cage.turned_up"]):
        rest = Cage.load(files / "rest_y.obj", up="auto", reference=post())
    np.testing.assert_allclose(rest.vertices, whole().vertices)
    part = select_nodes(post(), box=[[-1, -1, -1], [1, 1, 0]])
    with pytest.warns(UserWarning, match="turned"):
        Cage.load(files / "rest_y.obj", reference=part)
    with pytest.warns(UserWarning, match="seems to have y up"):
        given = Cage.load(files / "rest_y.obj", up="z", reference=post())
    np.testing.assert_array_equal(given.vertices, Cage.load(files / "rest_y.obj").vertices)
    refused(lambda: Cage.load(files / "rest_y.obj", up="auto"), match="needs a reference")
    assert "seems to have y up" in given.check(field=post()).standing
    assert whole().check(field=post()).standing == ""


def test_a_sample_of_visible_nodes_spreads_over_all(monkeypatch):
    every = visible_nodes(post())
    some = some_visible_nodes(post(), 500)
    assert len(some) == 500 and np.isin(some.round(6), every.round(6)).all()
    np.testing.assert_allclose(some.mean(axis=0), every.mean(axis=0), atol=0.06)
    np.testing.assert_array_equal(some, some_visible_nodes(post(), 500))
    monkeypatch.setattr("warpcage.select.selection.SAMPLED_SIDE", 8)  # every fourth node along each axis
    coarse = some_visible_nodes(post())
    assert 0.5 < 64 * len(coarse) / len(every) < 2.0
