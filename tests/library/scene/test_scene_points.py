"""Points of a reconstruction and their colours: how scenes come by them, and what becomes of them in other scenes."""

import pickle

import numpy as np
import pytest
from refusals import refused
from scene_writers import brick_pictures, write_colmap, write_transforms

from warpcage import Camera, Scene, load_scene, turntable
from warpcage.view.motion import axis_rotation

POINTS = np.random.default_rng(0).uniform(-0.5, 0.8, (400, 3))
COLORS = np.random.default_rng(1).integers(0, 256, (400, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def bricks():
    return brick_pictures(9)


def write_ply_points(path, kind, *, text=False, points=POINTS, colors=COLORS, faces=False):
    """points.ply with colours of a type of PLY, None for none."""
    names = [] if kind is None else ["red", "green", "blue"]
    types = {"uchar": "u1", "ushort": "<u2", "float": "<f4", "double": "<f8", "int": "<i4"}
    rows = np.zeros(len(points), [(axis, "<f8") for axis in "xyz"] + [(name, types[kind]) for name in names])
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    for channel, name in enumerate(names):
        rows[name] = colors[:, channel]
    properties = "".join(f"property double {axis}\n" for axis in "xyz")
    properties += "".join(f"property {kind} {name}\n" for name in names)
    form = "ascii" if text else "binary_little_endian"
    more = "element face 0\nproperty list uchar int vertex_indices\n" if faces else ""
    header = f"ply\nformat {form} 1.0\nelement vertex {len(points)}\n{properties}{more}end_header\n"
    body = "".join(" ".join(map(repr, row.tolist())) + "\n" for row in rows).encode() if text else rows.tobytes()
    path.write_bytes(header.encode() + body)


def require_points(scene, points=POINTS, colors=COLORS):
    assert scene.points.dtype == np.float64 and np.array_equal(scene.points, points)
    if colors is None:
        assert scene.point_colors is None
    else:
        assert scene.point_colors.dtype == np.float32
        np.testing.assert_allclose(scene.point_colors, colors / 255.0, atol=1e-6)


@pytest.mark.parametrize("binary", [False, True])
def test_points_of_colmap_come_with_their_colors(tmp_path, bricks, binary):
    write_colmap(tmp_path, bricks, binary=binary, points=POINTS, colors=COLORS)
    for split in ("train", "test", "all"):
        require_points(load_scene(tmp_path, split=split, downscale=2))
    scene, straight = load_scene(tmp_path), load_scene(tmp_path, orient="up")
    np.testing.assert_allclose(pixels(straight), pixels(scene), atol=1e-8)
    write_colmap(tmp_path / "none", bricks, binary=binary)
    scene = load_scene(tmp_path / "none")
    assert scene.points is None and scene.point_colors is None and scene.straightened().points is None


def test_points_of_colmap_without_colors(tmp_path, bricks):
    write_colmap(tmp_path, bricks, binary=False, points=POINTS, colors=COLORS)
    path = tmp_path / "sparse" / "0" / "points3D.txt"
    before = load_scene(tmp_path).bounds
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:-1], " ".join(lines[-1].split()[:4])]))  # of one they are not known
    require_points(load_scene(tmp_path), colors=None)
    assert np.array_equal(load_scene(tmp_path).bounds, before)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    "kind, factor", [("uchar", 1), ("ushort", 257), ("float", 1 / 255), ("double", 1), ("int", 1), (None, 1)]
)
def test_points_of_a_ply(tmp_path, bricks, kind, factor, text):
    write_transforms(tmp_path, bricks, ply_file_path="points.ply")
    write_ply_points(tmp_path / "points.ply", kind, colors=COLORS * np.float64(factor), text=text, faces=True)
    scene = load_scene(tmp_path)
    require_points(scene, colors=None if kind is None else COLORS)
    write_ply_points(tmp_path / "points.ply", None)
    assert np.array_equal(load_scene(tmp_path).bounds, scene.bounds)


@pytest.mark.parametrize("color", ["256 0 0", "0 -1 0", "0 0 nan", "0 red 0"])
def test_colors_that_are_none_are_refused(tmp_path, bricks, color):
    write_colmap(tmp_path, bricks, binary=False, points=POINTS[:1])
    (tmp_path / "sparse" / "0" / "points3D.txt").write_text(f"# points\n1 0.5 0.5 0.5 {color} 0.5\n")
    refused(lambda: load_scene(tmp_path), match="points3D.txt:2")


@pytest.mark.parametrize("kind, value", [("float", np.nan), ("float", -0.5), ("double", 256.0), ("int", -1)])
def test_bad_colors_of_a_ply_are_refused(tmp_path, bricks, kind, value):
    colors = COLORS.astype(np.float64)
    colors[7, 1] = value
    write_transforms(tmp_path, bricks, ply_file_path="points.ply")
    write_ply_points(tmp_path / "points.ply", kind, colors=colors)
    refused(lambda: load_scene(tmp_path), match="points.ply: the colour of PLY vertex 7")


def test_a_mesh_does_not_ask_for_colors(tmp_path):
    from warpcage.mesh import read_ply

    write_ply_points(tmp_path / "mesh.ply", "int", colors=np.full((400, 3), -1), faces=True)
    assert np.array_equal(read_ply(tmp_path / "mesh.ply")[0], POINTS)


def made_scene(**options):
    cameras = turntable((0, 0, 0), 3.0, 20, 4, up=(0.3, -0.4, -1), width=4, height=4)
    return Scene(np.zeros((4, 4, 4, 3)), None, cameras, points=POINTS, point_colors=COLORS / 255.0, **options)


def pixels(scene):
    return np.stack([camera.project(scene.points)[0] for camera in scene.cameras])


def test_points_move_with_the_world():
    scene = made_scene()
    straight = scene.straightened()
    assert not np.allclose(straight.points, scene.points, atol=0.1)
    np.testing.assert_allclose(pixels(straight), pixels(scene), atol=1e-9)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = axis_rotation(np.array([0, 0, 1.0]), 1.0), (5, 0, -2)
    moved = straight.moved(motion)
    np.testing.assert_allclose(pixels(moved), pixels(scene), atol=1e-9)
    assert np.array_equal(moved.point_colors, scene.point_colors)
    back = moved.moved(np.linalg.inv(moved.straightening))
    np.testing.assert_allclose(back.points, POINTS, atol=1e-12)


def test_points_are_kept_with_other_cameras_and_by_pickles():
    scene = made_scene()
    others = [camera.moved(np.eye(4)) for camera in scene.cameras]
    require_points(scene.with_cameras(others))
    require_points(pickle.loads(pickle.dumps(scene)))


def test_points_that_do_not_fit_are_refused():
    parts = (np.zeros((1, 4, 4, 3)), None, [Camera.look_at([3, 0, 0], [0, 0, 0], width=4, height=4)])
    for options, said in (
        ({"points": np.zeros((5, 2))}, r"points must be finite and \(m, 3\)"),
        ({"points": [[0, 0, np.inf]]}, "points must be finite"),
        ({"points": "abc"}, "points must be real numbers"),
        ({"point_colors": np.zeros((5, 3))}, "need points"),
        ({"points": np.zeros((5, 3)), "point_colors": np.zeros((4, 3))}, r"must be \(5, 3\)"),
        ({"points": np.zeros((1, 3)), "point_colors": [[0, 0, 2.0]]}, r"from 0 to 2: they must lie in \[0, 1\]"),
        ({"points": np.zeros((1, 3)), "point_colors": [[0, 0, np.nan]]}, r"must lie in \[0, 1\]"),
    ):
        with pytest.raises(ValueError, match=said):
            Scene(*parts, **options)
