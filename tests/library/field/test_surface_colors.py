"""Meshes with the colours of the field, in the files that Blender and others read."""

import json
import struct

import numpy as np
import pytest
import trimesh
from fields import make_field
from runs import run

from warpcage import Cage, VoxelField

#: The two halves of the ball of runs.py, sRGB: harmonics of degree 0, plus a half.
RED, BLUE = np.array([1.5, -1.5, -1.5]) * 0.28209479 + 0.5, np.array([-1.5, -1.5, 1.5]) * 0.28209479 + 0.5


def glb_parts(path):
    """The document of a .glb and the rows of its vertex colours."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + length])
    primitive = document["meshes"][0]["primitives"][0]
    if "COLOR_0" not in primitive["attributes"]:
        return document, None
    accessor = document["accessors"][primitive["attributes"]["COLOR_0"]]
    view = document["bufferViews"][accessor["bufferView"]]
    assert (accessor["componentType"], accessor["normalized"], accessor["type"]) == (5123, True, "VEC4")
    start = 28 + length + view["byteOffset"]
    return document, np.frombuffer(data, "<u2", 4 * accessor["count"], start).reshape(-1, 4) / 65535.0


def srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def check_halves(colors, height):
    """Red above, blue below, but for the voxels between."""
    assert np.abs(colors[height > 0.1] - RED).max() < 0.01 and np.abs(colors[height < -0.1] - BLUE).max() < 0.01


def test_glb_has_colors_by_default_and_y_up(files, tmp_path, capsys):
    path = tmp_path / "ball.glb"
    assert run(files, "mesh", "@ball.npz", "-o", path) == 0
    assert "with colours" in capsys.readouterr().out
    document, colors = glb_parts(path)
    mesh = trimesh.load(path, force="mesh", process=False)
    check_halves(srgb(colors[:, :3]), np.asarray(mesh.vertices)[:, 1])
    assert document["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    assert document["buffers"][0]["byteLength"] == struct.unpack_from("<I", path.read_bytes(), 20 + len_of(path))[0]
    # read as a cage's object it is the same mesh
    assert run(files, "cage", path, "-o", tmp_path / "box.obj", "--box") == 0
    np.testing.assert_allclose(Cage.load(tmp_path / "box.obj").bounds.mean(axis=0), 0.0, atol=0.02)
    assert run(files, "mesh", "@ball.npz", "-o", path, "--no-colors") == 0
    assert glb_parts(path)[1] is None


def len_of(path):
    return struct.unpack_from("<I", path.read_bytes(), 12)[0]


@pytest.mark.parametrize("ending", ["ply", "obj"])
def test_other_formats_have_colors_when_asked(files, tmp_path, ending):
    path = tmp_path / f"ball.{ending}"
    assert run(files, "mesh", "@ball.npz", "-o", path, "--colors") == 0
    mesh = trimesh.load(path, force="mesh", process=False)
    check_halves(np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0, np.asarray(mesh.vertices)[:, 2])


def test_colors_are_those_seen_from_straight_ahead(device):
    def shine(x):
        sh = np.zeros((*x.shape[:3], 9, 3))
        sh[..., 1:4, :] = np.array([[0.5, 0, 0.2], [0, 0.5, -0.2], [-0.3, 0.2, 0.4]])
        return sh

    field = make_field(lambda x: 90.0 * (np.linalg.norm(x, axis=-1) < 0.6), shine, device=device)
    mesh = field.extract_mesh(colors=True)
    points, normals = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals)
    expected, _ = VoxelField.sample(field, 0.95 * points, -normals)
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0
    assert np.abs(colors - np.clip(expected, 0, 1)).max() < 0.02 < np.std(colors)
