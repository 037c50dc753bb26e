"""Meshes, cages and poses from the command line."""

import subprocess

import imageio.v3 as iio
import numpy as np
import pytest
import trimesh
from polygon_cages import quad_cube
from runs import command, succeed

from warpcage import Cage, PoseFile, VoxelField
from warpcage.studio.cli import main


@pytest.mark.parametrize("ending", ["obj", "ply", "stl", "glb"])
def test_mesh(files, tmp_path, ending):

    succeed(files, "mesh", "@ball.npz", "-o", tmp_path / f"ball.{ending}")
    mesh = trimesh.load(tmp_path / f"ball.{ending}", force="mesh")
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert radius.min() > 0.4 and radius.max() < 0.7


def test_gltf_meshes_stand_upright(tmp_path, capsys):

    density = np.zeros((24, 24, 24))
    density[4:8, 6:18, 2:22] = 40.0  # of another size along each axis, off the middle
    field = VoxelField.from_dense(density, np.zeros((24, 24, 24, 9, 3)), [[-1, -1, -1], [1, 1, 1]])
    field.save(tmp_path / "slab.npz")
    bounds = []
    for ending in ("obj", "glb"):
        assert main(["mesh", str(tmp_path / "slab.npz"), "-o", str(tmp_path / f"slab.{ending}")]) == 0
        assert main(["cage", str(tmp_path / f"slab.{ending}"), "-o", str(tmp_path / "box.obj"), "--box"]) == 0
        bounds.append(Cage.load(tmp_path / "box.obj").bounds)
    np.testing.assert_allclose(*bounds, atol=1e-6)
    x, y, z = trimesh.load(tmp_path / "slab.obj", force="mesh").bounds.T
    there = trimesh.load(tmp_path / "slab.glb", force="mesh").bounds
    np.testing.assert_allclose(there, np.stack([x, z, -y[::-1]], axis=1), atol=1e-6)  # glTF: y up, z towards us
    said = [line.split(", from ")[1] for line in capsys.readouterr().out.splitlines() if "slab" in line]
    assert len(said) == 2 and said[0] == said[1]  # world coordinates in both


def test_a_cage_around_a_mesh_says_one_line(files, tmp_path):
    argv = f"cage {files}/posed.obj -o {tmp_path}/cage.obj --vertices 30 --method shell --quiet".split()
    done = subprocess.run(command(*argv), capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("wrote ") and done.stdout.count("\n") == 1


@pytest.mark.parametrize(
    "shape",
    [
        ["--box"],
        ["--box", "--segments", 2, 3, 1],
        ["--box", "--margin", 0.2],
        ["--box", "--margin", 0],
        ["--cylinder"],
        ["--cylinder", "--axis", "x", "--sides", 7, "--rings", 2],
    ],
)
@pytest.mark.parametrize("source", ["@ball.npz", "@posed.obj"])
def test_simple_cages_hold_the_object(files, tmp_path, shape, source):
    succeed(files, "cage", source, "-o", tmp_path / "cage.ply", *shape)
    cage = Cage.load(tmp_path / "cage.ply")
    cage.require_usable()
    ball = np.random.default_rng(0).normal(size=(200, 3))
    points = 0.54 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    points = Cage.load(files / "posed.obj").vertices if source == "@posed.obj" else points
    assert cage.contains(points).all()


def test_wrapped_cage_holds_the_object(files, tmp_path):
    pytest.importorskip("pymeshlab")
    succeed(files, "cage", "@ball.npz", "-o", tmp_path / "cage.obj", "--vertices", 60)
    cage = Cage.load(tmp_path / "cage.obj")
    cage.require_usable()
    assert 30 <= len(cage.vertices) <= 90
    directions = np.random.default_rng(0).normal(size=(200, 3))
    assert cage.contains(0.53 * directions / np.linalg.norm(directions, axis=1, keepdims=True)).all()


def test_cage_of_a_part_of_a_field(files, tmp_path, capsys):
    argv = "--in-box -1 -1 0 1 1 1 --floaters 0.1 --method voxel --symmetry x --vertices 60".split()
    succeed(files, "cage", "@ball.npz", "-o", tmp_path / "half.glb", *argv)
    assert "left out" in capsys.readouterr().out
    cage = Cage.load(tmp_path / "half.glb")
    cage.require_usable()
    assert cage.bounds[0, 2] > -0.35 and cage.contains([[0, 0, 0.4]])[0]
    succeed(files, "cage", "@ball.npz", "-o", tmp_path / "box.ply", "--box", "--in-box", -1, -1, 0, 1, 1, 1)
    assert Cage.load(tmp_path / "box.ply").bounds[0, 2] > -0.1


def test_pose_keeps_the_cage_at_rest(tmp_path, capsys):
    Cage.box([[-1, -1, -1], [1, 1, 1]]).save(tmp_path / "cage.obj")
    before = (tmp_path / "cage.obj").read_bytes()
    argv = ["pose", str(tmp_path / "cage.obj"), "-o", str(tmp_path / "." / "cage.obj"), "--twist", "9"]
    assert main(argv) == 2 and "is the cage at rest itself" in capsys.readouterr().err
    assert (tmp_path / "cage.obj").read_bytes() == before


def test_pose_takes_steps_in_their_order(files, tmp_path, capsys):
    rest = Cage.load(files / "cage.obj")
    out = tmp_path / "posed.off"
    succeed(files, "pose", "@cage.obj", "-o", out, "--translate", 1, 0, 0, "--scale", 2, "--centre", 0, 0, 0)
    np.testing.assert_allclose(Cage.load(out).vertices, 2 * (rest.vertices + [1, 0, 0]))
    succeed(files, "pose", "@cage.obj", "-o", out, "--scale", 2, "--translate", 1, 0, 0, "--centre", 0, 0, 0)
    np.testing.assert_allclose(Cage.load(out).vertices, 2 * rest.vertices + [1, 0, 0])
    argv = ["--bend", -40, "--axis", "x", "--towards=-y", "--limits", 0.2, 0.9]
    succeed(files, "pose", "@cage.obj", "-o", out, *argv)
    np.testing.assert_allclose(
        Cage.load(out).vertices, rest.bend(-40, axis="x", towards="-y", limits=(0.2, 0.9)).vertices
    )
    succeed(files, "pose", "@cage.obj", "-o", out, "--twist", 30, "--taper", 0.5, "--stretch", 1.5, "--rotate", 20)
    expected = rest.twist(30).taper(0.5).stretch(1.5).rotate(20)
    np.testing.assert_allclose(Cage.load(out).vertices, expected.vertices)
    np.testing.assert_array_equal(Cage.load(out).faces, rest.faces)
    rest.save(tmp_path / "y.obj", up="y")
    succeed(files, "pose", tmp_path / "y.obj", "-o", tmp_path / "y.ply", "--stretch", 2, "--cage-up", "y")
    np.testing.assert_allclose(Cage.load(tmp_path / "y.ply", up="y").vertices, rest.stretch(2.0).vertices)
    assert "twist 30.0, taper 0.5" in capsys.readouterr().out


def test_quads_go_through_all_commands(files, tmp_path, capsys):
    """From a cage of quads to pictures of mirrored poses, which mirror each other; check and info count quads."""
    rest = quad_cube().scale(0.8)
    rest.save(tmp_path / "rest.obj")
    pictures = []
    for side, corner in (("left", 4), ("right", 5)):  # at x < 0 and x > 0
        posed = tmp_path / f"{side}.obj"
        rest.move((0.0, 0.0, 0.5), group=[corner]).save(posed)
        view = "--eye 0 -3 0.5 --target 0 0 0 --size 64 64 --device cpu --background white".split()
        argv = ["@ball.npz", "--cage", tmp_path / "rest.obj", "--posed", posed, "-o", tmp_path / f"{side}.png"]
        succeed(files, "render", *argv, *view)
        pictures.append(iio.imread(tmp_path / f"{side}.png").min(axis=2) < 200)  # on white
    assert (pictures[0] != pictures[1]).mean() > 0.01
    assert (pictures[0] != pictures[1][:, ::-1]).mean() < 0.002
    film = ["@ball.npz", "--cage", tmp_path / "rest.obj", "--posed", tmp_path / "left.obj", "-o", tmp_path / "film"]
    succeed(files, "animate", *film, *view, "--frames", 2, "--quiet")
    assert len(list((tmp_path / "film").glob("*.png"))) == 2
    succeed(files, "animate", *film[:-2], *view, "--frames", 2, "--jobs", tmp_path / "film.jsonl")
    np.testing.assert_array_equal(np.load(tmp_path / "film.faces.npy"), rest.face_array)
    succeed(files, "run", tmp_path / "film.jsonl", "-o", tmp_path / "run", "--quiet")
    for name in ("frame_0000", "frame_0001"):
        (found,) = (tmp_path / "run").rglob(f"{name}*.png")
        np.testing.assert_array_equal(iio.imread(found), iio.imread(tmp_path / "film" / f"{name}.png"))
    capsys.readouterr()
    succeed(files, "check", tmp_path / "rest.obj", "--object", "@ball.npz", "--posed", tmp_path / "left.obj")
    said = capsys.readouterr().out
    assert "8, 6" in said and "usable" in said
    succeed(files, "info", tmp_path / "rest.obj")
    assert "6" in next(line for line in capsys.readouterr().out.splitlines() if line.startswith("faces"))
    succeed(files, "pose", tmp_path / "rest.obj", "-o", tmp_path / "bent.ply", "--bend", 30)
    assert Cage.load(tmp_path / "bent.ply").polygons == rest.polygons


def test_cages_of_quads_with_a_focus_say_what_they_are_made_of(tmp_path, capsys):
    trimesh.creation.box([2.0, 1.0, 0.6]).export(tmp_path / "brick.obj")
    rest = Cage.box([-1.1, -0.6, -0.4], [1.1, 0.6, 0.4], segments=(4, 1, 1))
    PoseFile(rest, {"up": rest.bend(50, axis="x", limits=(0.5, 1), towards="z")}).save(tmp_path / "poses.json")
    call = ["cage", str(tmp_path / "brick.obj"), "-o", str(tmp_path / "cage.obj"), "--vertices", "30"]
    assert main([*call, "--faces", "quads", "--symmetry", "auto"]) == 0
    said, cage = capsys.readouterr().out, Cage.load(tmp_path / "cage.obj")
    quads = sum(len(face) == 4 for face in cage.polygons)
    assert f"{cage.face_count} faces, {100 * quads / cage.face_count:.0f} % of them quads, symmetric across " in said
    assert main([*call, "--focus", str(tmp_path / "poses.json"), "--finer", "2"]) == 0
    finer = Cage.load(tmp_path / "cage.obj").vertices[:, 0]
    assert (finer > 0).sum() > (finer < 0).sum()
    assert main([*call, "--focus", str(tmp_path / "brick.obj")]) == 2
    assert "holds poses alone: give the cage at rest, or a pose file" in capsys.readouterr().err
    assert main([*call, "--faces", "quads", "-o", str(tmp_path / "cage.glb")]) == 0
    said = capsys.readouterr().out
    assert f"{Cage.load(tmp_path / 'cage.glb').face_count} faces, 0 % of them quads" in said
    assert main([*call, "--focus", str(tmp_path / "part.npz")]) == 2
    assert "is a selection, which is of a field" in capsys.readouterr().err
    assert main([*call, "--finer", "3"]) == 2
    assert "--finer says how much finer" in capsys.readouterr().err
    assert main([*call, "--box", "--faces", "quads"]) == 2
