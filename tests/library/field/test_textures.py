"""Light meshes with textures: read by trimesh, compared with what the field is made of."""

import sys

import numpy as np
import pytest
from runs import run, succeed, write_files

from warpcage import Cage, VoxelField
from warpcage.field.texture import simplified

RED, BLUE = (0.923, 0.077, 0.077), (0.077, 0.077, 0.923)  # 0.5 + 1.5 and - 1.5 times the first harmonic


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A ball that is red above and blue below, as a mesh of few faces with a texture."""
    pytest.importorskip("xatlas"), pytest.importorskip("fast_simplification")
    folder = write_files(tmp_path_factory.mktemp("files"))
    succeed(folder, "mesh", "@ball.npz", "--faces", "150", "--texture", "256", "-o", "@ball.glb")
    return folder


def textured(path):
    import trimesh

    (mesh,) = trimesh.load(path, process=False).geometry.values()
    return mesh


def points_on(mesh, count=400):
    """Random points, z up, and the texture's colours there (bilinear, as trimesh reads it)."""
    from trimesh.visual.color import uv_to_interpolated_color

    random = np.random.default_rng(0)
    face = random.integers(len(mesh.faces), size=count)
    share = random.dirichlet([1.0, 1, 1], size=count)[..., None]
    x, y, z = (share * mesh.vertices[mesh.faces[face]]).sum(axis=1).T
    places = (share * mesh.visual.uv[mesh.faces[face]]).sum(axis=1)
    colors = uv_to_interpolated_color(places, mesh.visual.material.baseColorTexture)
    return np.stack([x, -z, y], axis=1), colors[:, :3] / 255.0


def test_a_texture_has_the_colors_of_the_field(files):
    mesh = textured(files / "ball.glb")
    assert len(mesh.faces) == pytest.approx(150, abs=15) and mesh.visual.material.baseColorTexture.size == (256, 256)
    assert mesh.visual.uv.min() >= 0.0 and mesh.visual.uv.max() <= 1.0
    points, colors = points_on(mesh)
    clear = np.abs(points[:, 2]) > 0.1  # of the border, by a voxel; faces are up to 0.2 long
    expected = np.where(points[:, 2:] > 0, RED, BLUE)
    assert clear.sum() > 200
    np.testing.assert_allclose(colors[clear], expected[clear], atol=0.02)
    # colours of vertices would run over whole faces
    between = (np.abs(colors - RED).max(axis=1) > 0.1) & (np.abs(colors - BLUE).max(axis=1) > 0.1)
    assert np.abs(points[between, 2]).max(initial=0.0) < 0.1


def test_normals_look_outward_and_seams_join_again(files):
    mesh = textured(files / "ball.glb")

    outward = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    assert (mesh.vertex_normals * outward).sum(axis=1).min() > 0.7
    cage, whole = Cage.load(files / "ball.glb"), VoxelField.load(files / "ball.npz").extract_mesh()
    assert len(cage.vertices) < len(mesh.vertices)  # split along seams in the file
    assert cage.volume == pytest.approx(whole.volume, rel=0.05)
    cage.require_usable()


def test_a_texture_goes_with_a_film(files):
    import json

    arguments = ["--cage", "@cage.obj", "--posed", "@posed.obj", "--frames", "3", "--coordinates", "mean_value"]
    succeed(files, "mesh", "@ball.npz", "--faces", "100", "--texture", "64", *arguments, "-o", "@walk.gltf")
    document = json.loads((files / "walk.gltf").read_text())
    assert document["animations"] and document["images"][0]["mimeType"] == "image/png"
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    assert set(attributes) == {"POSITION", "NORMAL", "TEXCOORD_0"}
    assert len({document["accessors"][index]["count"] for index in attributes.values()}) == 1


def test_few_faces_keep_colors_of_vertices(files):
    import trimesh

    succeed(files, "mesh", "@ball.npz", "--faces", "200", "--colors", "-o", "@light.ply")
    mesh = trimesh.load(files / "light.ply", process=False)
    assert len(mesh.faces) == pytest.approx(200, abs=10) and mesh.is_watertight
    clear = np.abs(mesh.vertices[:, 2]) > 0.1
    expected = np.where(mesh.vertices[:, 2:] > 0, RED, BLUE)
    np.testing.assert_allclose(mesh.visual.vertex_colors[clear, :3] / 255.0, expected[clear], atol=0.02)


@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_few_faces_are_as_few_in_any_unit_of_length(files, unit):
    """fast_simplification 0.2 stops at errors of its own, in the mesh's unit."""
    whole = VoxelField.load(files / "ball.npz").extract_mesh()
    large = whole.copy().apply_scale(unit)
    light, expected = simplified(large, 200), simplified(whole, 200)
    assert len(light.faces) == len(expected.faces) == pytest.approx(200, abs=10)
    np.testing.assert_allclose(light.vertices / unit, expected.vertices, atol=1e-5)


def test_without_their_libraries_it_is_said_what_to_install(files, monkeypatch, capsys):
    for name in ("xatlas", "fast_simplification"):
        monkeypatch.setitem(sys.modules, name, None)
    for arguments in (["--texture", "64"], ["--faces", "100"]):
        assert run(files, "mesh", "@ball.npz", *arguments, "-o", "@a.glb") == 2
        assert "[texture]'" in capsys.readouterr().err
