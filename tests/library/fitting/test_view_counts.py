"""Total variation by the number of views that show a voxel: counts against single views, fits, checkpoints."""

import numpy as np
import pytest
import warp as wp
from fit_oracles import finished
from scenes import room_scene

import warpcage
from warpcage import FieldOptimizer
from warpcage.fitting import Level, PictureRays, ViewCounts, batches
from warpcage.view import camera_array

SMALL = {"resolution": 24, "levels": 2, "epochs": 4, "batch_rays": 1024}


BOX = np.array([[-1.0] * 3, [1.0] * 3])
CAMERAS = warpcage.turntable((0, 0, 0), 3.0, 20, 5, fov_degrees=40, width=12, height=10)


@pytest.fixture
def level(device):
    """Every voxel of a grid, and the five cameras there."""
    level = Level(wp.full((12, 12, 12), 1, dtype=wp.uint8, device=device), BOX, np.ones(3, np.float32), 1, 4.0)
    return level, camera_array(CAMERAS, level.field.center, device)


def test_counts_are_of_the_views_that_show_a_voxel(device, level):
    """As many as views that give it the weight when their pixels alone count; few of what is behind others."""
    level, placed = level
    random = np.random.default_rng(0)
    level.field.grid.density.assign(random.uniform(0.0, 8.0, level.field.voxel_count).astype(np.float32))
    expected = np.zeros(level.field.voxel_count, int)
    for view in range(5):
        counted = np.zeros((5, 10, 12), np.uint8)
        counted[view] = 1
        alone = PictureRays(placed, 12, 10, wp.array(counted, dtype=wp.uint8, device=device))
        expected += level.measure_weights(alone).numpy() >= 0.01
    for counted in (None, wp.ones((5, 10, 12), dtype=wp.uint8, device=device)):
        level.weighty_mask(PictureRays(placed, 12, 10, counted), 0.01, counts=True)
        np.testing.assert_array_equal(level.views.counts.numpy(), expected)
    assert set(range(4)) <= set(expected)


def test_a_look_has_no_more_rays_than_a_launch_has_items(device, level, monkeypatch):
    """Of 90 pictures of 24 million pixels there are more than 2^31: the last of them wrapped around."""
    level, placed = level
    rays = PictureRays(placed, 12, 10)
    level.field.grid.density.fill_(4.0)
    found, launched, launch_shards = [], [], batches.launch_shards

    def launch(works, shards, device):
        launched.extend(work.count for work in works)
        launch_shards(works, shards, device)

    monkeypatch.setattr(batches, "launch_shards", launch)
    for most in (2**31 - 1, 300):
        monkeypatch.setattr(batches, "MAX_ITEMS", most, raising=False)
        counts = wp.zeros(level.field.voxel_count, dtype=wp.uint8, device=device)
        found.append((level.measure_weights(rays), level.measure_weights(rays, counts=counts), counts))
    assert launched == 2 * [600] + 2 * [240, 240, 120]
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one.numpy(), other.numpy())
    assert found[0][2].numpy().max() == 5


def test_factors_grow_with_how_few_views_there_are(device):
    """By the powers that the fits' own regularisers follow (benchmarks/NOTES-fit-scenes.md); 32 times fewer at most."""
    factors = ViewCounts(48.0, wp.get_device(device)).factors.numpy()
    fewer = np.array([32.0, 32.0, 24.0, 2.0, 1.0, 1.0])
    np.testing.assert_allclose(factors[[0, 1, 2, 24, 48, 255]], np.stack([fewer**1.8, fewer], axis=1), rtol=1e-5)


def test_voxels_that_few_views_show_are_smoother(device):
    """Differences of luminance from voxel to voxel, by whether a few views are few."""
    scene = room_scene(8, 24, masks=False)
    rough = []
    for views in (0.5, 1000.0):
        options = SMALL | {"background": "outer", "scarcity": 1.0, "epochs": 20}
        options |= {"variation_views": views, "variation_outer_views": views}
        optimizer = finished(FieldOptimizer(scene, device=device, **options))
        field = optimizer.field
        links, values = field.grid.links.numpy(), field.grid.sh.numpy()[:, 0]
        pairs = (links[:-1] >= 0) & (links[1:] >= 0)
        rough.append(np.abs(values[links[1:][pairs]] - values[links[:-1][pairs]]).mean())
        counts = [optimizer.current.views.counts, optimizer.background.views.counts]
        rows = [field.voxel_count, optimizer.background.outer.voxel_count]
        assert [len(each) for each in counts] == rows and all(2 < each.numpy().max() <= 8 for each in counts)
    assert rough[1] < 0.85 * rough[0]
