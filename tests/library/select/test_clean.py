"""Fields of voxels without floaters, and without what no view shows."""

import numpy as np
import pytest
from scenes import FRAGMENT, TableScene

from warpcage import Camera, VoxelField
from warpcage.select import CleanOptions, clean_voxels
from warpcage.select.clean import voxel_weights
from warpcage.studio.cli import main


@pytest.fixture(scope="module")
def scene():
    return TableScene()


def kept(field):
    return field.node_densities() > 0.0


def test_fragments_go_and_the_rest_stays_to_the_bit(scene, device):
    field = scene.field.to(device)
    cleaned = clean_voxels(field, CleanOptions())
    labels = scene.labels.reshape(field.resolution)
    held = (labels > 0) & (labels != FRAGMENT)
    left = kept(cleaned.field)
    assert left[held].all()
    fragments = np.argwhere(left & (labels == FRAGMENT))  # those that touch something, or nearly
    away = [np.linalg.norm(np.argwhere(held) - each, axis=1).min() for each in fragments]
    assert len(fragments) < 12 and all(distance < 7 for distance in away)
    np.testing.assert_array_equal(cleaned.field.node_densities()[left], field.node_densities()[left])
    assert cleaned.field.resolution == field.resolution and (cleaned.field.bounds == field.bounds).all()
    assert len(cleaned.notes) == 1 and "detached parts" in cleaned.notes[0]
    assert clean_voxels(field, CleanOptions(floaters=0.0)).notes == ()
    alone = kept(clean_voxels(field, CleanOptions(parts=1)).field)
    assert alone[held].all() and (alone & (labels == FRAGMENT)).sum() <= len(fragments)


def test_a_thin_pole_stays_and_floaters_go(device):
    """A pole of one voxel with a gap of two, that hangs together with nothing above it, and floaters larger than it."""
    density = np.zeros((48, 48, 48))
    density[8:40, 8:40, 4:16] = 30.0
    pole = [*range(16, 28), *range(30, 36)]
    density[24, 24, pole] = 30.0
    floaters = np.zeros(density.shape, bool)
    floaters[2:4, 2:4, 38:41] = floaters[40:43, 5:7, 30:32] = True
    density[floaters] = 30.0
    field = VoxelField.from_dense(density, np.zeros((48, 48, 48, 9, 3)), [[-1] * 3, [1] * 3], device=device)
    left = kept(clean_voxels(field, CleanOptions()).field)
    assert left[24, 24, pole].all() and not left[floaters].any() and left[8:40, 8:40, 4:16].all()


def test_views_keep_what_they_show(scene, device):
    field = scene.field.to(device)
    camera = scene.camera(size=128)
    cleaned = clean_voxels(field, CleanOptions(floaters=0.0, cameras=[camera]))
    assert cleaned.gone.sum() > 2000 and cleaned.notes[0].endswith("that none of 1 view show")
    before, after = field.render(camera), cleaned.field.render(camera)
    assert np.abs(before.rgb - after.rgb).max() < 0.02 and np.abs(before.alpha - after.alpha).max() < 0.02
    with pytest.raises(ValueError, match="nothing would be left"):
        away = Camera.look_at((9, 9, 9), (20, 20, 20), up=(0, 0, 1), width=16, height=16)
        clean_voxels(field, CleanOptions(cameras=[away]))


def test_weights_are_what_a_ray_leaves(device):
    """A wall of one opacity a voxel: the first of its voxels gets most."""
    density = np.zeros((16, 16, 16))
    density[:, 6:10] = 20.0
    field = VoxelField.from_dense(density, np.zeros((16, 16, 16, 9, 3)), [[-1] * 3, [1] * 3], device=device)
    camera = TableScene.camera(TableScene(8), eye=(0, -6, 0.01), size=32)
    weights, links = voxel_weights(field, camera), field.grid.links.numpy()
    along = weights[links[8, 6:10, 8]]
    assert along[0] > 0.2 and (np.diff(along) < 0).all() and along[-1] < 0.05
    assert weights.max() <= 1.0 and weights.min() >= 0.0


def test_the_command(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scene.field.save("room.npz")
    scene.camera(size=64).save("view.json")
    assert main(["clean", "room.npz", "-o", "clean.npz", "--camera", "view.json", "--preview", "gone.png"]) == 0
    said = capsys.readouterr().out
    assert "removed" in said and "wrote clean.npz" in said and (tmp_path / "gone.png").exists()
    expected = clean_voxels(scene.field, CleanOptions()).field
    assert VoxelField.load("clean.npz").voxel_count == expected.voxel_count < scene.field.voxel_count
