"""Fields as volumes: NanoVDB is read by Warp, OpenVDB by its own module, values compared with the field's."""

import sys

import numpy as np
import pytest
import warp as wp
from fields import make_field, plain
from refusals import refused
from runs import run, succeed, write_files

BOUNDS = np.array([[9.0, -2.0, 4.0], [11.0, 1.0, 5.0]])
COLOR = (0.7, 0.4, 0.1)
LINEAR = [((c + 0.055) / 1.055) ** 2.4 for c in COLOR]


@wp.kernel
def sample_density(volume: wp.uint64, points: wp.array(dtype=wp.vec3), values: wp.array(dtype=float)):
    i = wp.tid()
    values[i] = wp.volume_sample_f(volume, wp.volume_world_to_index(volume, points[i]), wp.Volume.LINEAR)


@wp.kernel
def sample_color(volume: wp.uint64, points: wp.array(dtype=wp.vec3), values: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    values[i] = wp.volume_sample_v(volume, wp.volume_world_to_index(volume, points[i]), wp.Volume.CLOSEST)


def two_blobs(x):
    """Densities in two places of a long box, with nothing between: tiles are few."""
    near = [np.linalg.norm(x - center, axis=-1) for center in ((10.0, -1.4, 4.5), (10.2, 0.5, 4.6))]
    return np.maximum(0.0, 0.4 - np.minimum(*near)) * 50.0


def field():
    return make_field(two_blobs, plain(COLOR), BOUNDS, device="cpu", resolution=(40, 60, 20))


def points():
    return np.random.default_rng(0).uniform(BOUNDS[0] + 0.1, BOUNDS[1] - 0.1, size=(500, 3))


def test_nanovdb_has_the_densities_and_colors_at_their_places(tmp_path):
    source, places = field(), points()
    source.save(tmp_path / "two.nvdb")
    density = wp.Volume.load_from_nvdb((tmp_path / "two.nvdb").read_bytes(), device="cpu")
    color = density.load_next_grid()
    assert [grid.get_grid_info().name for grid in (density, color)] == ["density", "color"]
    assert density.get_grid_info().type_str == "float" and color.get_grid_info().type_str == "Vec3f"
    np.testing.assert_allclose(density.get_voxel_size(), [0.05, 0.05, 0.05], rtol=1e-6)
    at = wp.array(places, dtype=wp.vec3, device="cpu")
    found, shown = wp.empty(500, dtype=float, device="cpu"), wp.empty(500, dtype=wp.vec3, device="cpu")
    wp.launch(sample_density, 500, [density.id, at, found], device="cpu")
    wp.launch(sample_color, 500, [color.id, at, shown], device="cpu")
    expected = source.sample(places.astype(np.float32), np.tile([[0.0, 0, 1]], (500, 1)).astype(np.float32))[1]
    np.testing.assert_allclose(found.numpy(), expected, atol=2e-3)
    full = np.asarray(expected) > 2.0
    assert full.sum() > 30
    np.testing.assert_allclose(shown.numpy()[full], np.tile(LINEAR, (full.sum(), 1)), atol=2e-3)
    # sparse: of 5 x 8 x 3 tiles those with matter alone
    assert len(density.get_tiles().numpy()) == len(occupied_tiles(source)) < 60


def occupied_tiles(source):
    return np.unique(np.argwhere(source.node_densities() > 0) // 8, axis=0)


def test_openvdb_has_the_same(tmp_path):
    vdb = pytest.importorskip("openvdb")
    source = field()
    source.save(tmp_path / "two.vdb")
    grids = {grid.name: grid for grid in vdb.readAll(str(tmp_path / "two.vdb"))[0]}
    density, color = grids.pop("density"), grids.pop("color")
    assert not grids
    nodes = source.node_densities()
    found = np.zeros_like(nodes)
    density.copyToArray(found)
    np.testing.assert_array_equal(found, nodes)
    assert density.activeVoxelCount() == np.count_nonzero(nodes)
    shown = np.zeros((*nodes.shape, 3), np.float32)
    color.copyToArray(shown)
    np.testing.assert_allclose(shown[nodes > 0], np.tile(LINEAR, (np.count_nonzero(nodes), 1)), atol=1e-5)
    np.testing.assert_allclose(density.transform.indexToWorld((0, 0, 0)), BOUNDS[0] + 0.025, rtol=1e-12)
    np.testing.assert_allclose(density.transform.indexToWorld((40, 60, 20)), BOUNDS[1] + 0.025, rtol=1e-12)


def test_commands_write_volumes_as_they_are_and_deformed(tmp_path, capsys):
    files = write_files(tmp_path)
    succeed(files, "bake", "@ball.npz", "-o", "@ball.nvdb")
    succeed(files, "bake", "@ball.npz", "--cage", "@cage.obj", "--posed", "translate:0.5:0:0", "-o", "@moved.nvdb")
    middles = []
    for name in ("ball", "moved"):
        volume = wp.Volume.load_from_nvdb((files / f"{name}.nvdb").read_bytes(), device="cpu")
        tiles = volume.get_tiles().numpy() + 4
        first = np.array(volume.get_grid_info().translation)
        middles.append((tiles * volume.get_voxel_size() + first).mean(axis=0))
    assert middles[1][0] - middles[0][0] > 0.2
    capsys.readouterr()
    assert run(files, "bake", "@ball.npz", "--format", "svox2", "-o", "@a.nvdb") == 2
    assert "--format is for .npz" in capsys.readouterr().err


def test_without_its_module_openvdb_says_how_to_get_it(tmp_path, monkeypatch):
    for name in ("openvdb", "pyopenvdb"):
        monkeypatch.setitem(sys.modules, name, None)
    refused(lambda: field().save(tmp_path / "a.vdb"), match="conda-forge", error=ImportError)
    assert not list(tmp_path.iterdir())


def test_an_empty_field_is_no_volume(tmp_path):
    empty = make_field(lambda x: np.zeros(x.shape[:3]), plain(COLOR), device="cpu", resolution=8)
    refused(lambda: empty.save(tmp_path / "a.nvdb"), match="empty")
