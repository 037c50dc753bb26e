"""The order of a fit's tiles: each once, another order for each key, without a trace of where they lie."""

import itertools

import numpy as np
import pytest
import warp as wp
from fit_oracles import shuffled
from ground_truth import synthetic_scene

from warpcage import FieldOptimizer, fit
from warpcage.kernels.fitting.batches import shuffled_place

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def write_order(first: int, count: int, key: int, order: wp.array(dtype=wp.int32)):
    n = first + wp.tid()
    order[n] = shuffled_place(n, count, key)


def order_of(count, key, device):
    order = wp.empty(count, dtype=wp.int32, device=device)
    wp.launch(write_order, dim=count, inputs=[0, count, key], outputs=[order], device=device)
    return order.numpy()


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 16, 17, 1000, 4096, 4097])
def test_each_item_once_and_as_numpy_has_it(device, count):
    for key in (0, 1, 12345, 2**31 - 1):
        order = order_of(count, key, device)
        np.testing.assert_array_equal(np.sort(order), np.arange(count))
        np.testing.assert_array_equal(order, shuffled(np.arange(count), key))


def test_a_large_order_is_whole(device):
    assert np.bincount(order_of(1_500_001, 77, device), minlength=1_500_001).max() == 1


@pytest.mark.parametrize("count", [10_000, 65_536])
def test_orders_look_random(device, count):
    """What a random permutation keeps of its places: nothing. Bounds are five standard deviations."""
    orders = [order_of(count, key, device) for key in range(8)]
    for order in orders:
        assert abs(np.corrcoef(np.arange(count), order)[0, 1]) < 5 / np.sqrt(count)
        assert abs(np.corrcoef(order[:-1], order[1:])[0, 1]) < 5 / np.sqrt(count)
        tenth = np.histogram(order[: count // 10], bins=16, range=(0, count))[0] / (count / 160)
        assert np.abs(tenth - 1).max() < 5 / np.sqrt(count / 160)
        assert (np.abs(np.diff(order)) == 1).sum() < 2 + 5 * np.sqrt(2)  # two are expected
    for first, second in itertools.pairwise(orders):
        assert abs(np.corrcoef(first, second)[0, 1]) < 5 / np.sqrt(count)
        assert (first == second).sum() < 1 + 5


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene("bricks", train_views=6, test_views=1, size=24)[0]


def test_a_fit_takes_every_tile_once_before_any_twice(device, scene):
    optimizer = FieldOptimizer(scene, device=device, levels=1, resolution=16, epochs=3.0, batch_rays=256, keep_at=1.0)
    whole = optimizer.active_tiles // optimizer.batches.batch_tiles
    keys = []
    for _ in range(2):
        optimizer.step()
        keys.append(optimizer.rays.order)
        taken = [shuffled(optimizer.rays.tiles.numpy(), optimizer.rays.order)[: optimizer.batches.batch_tiles]]
        for step in range(1, whole):
            optimizer.step()
            assert optimizer.rays.order == keys[-1] and optimizer.rays.first_tile == step * len(taken[0])
            begin = optimizer.rays.first_tile
            order = shuffled(optimizer.rays.tiles.numpy(), optimizer.rays.order)
            taken.append(order[begin : begin + optimizer.batches.batch_tiles])
        assert len(np.unique(np.concatenate(taken))) == whole * len(taken[0])
    assert keys[0] != keys[1]


def test_random_colors_come_first_and_stay_now_and_then(device, scene, monkeypatch):
    """They supervise opacity alone early on; later most steps see the pictures as they are."""
    behind = []
    accumulate = FieldOptimizer.accumulate_gradients

    def watched(self):
        behind.append(self.random_background and self.schedule.supervises_opacity)
        accumulate(self)

    monkeypatch.setattr(FieldOptimizer, "accumulate_gradients", watched)
    options = {"levels": 1, "resolution": 16, "epochs": 1.0, "least_steps": 50, "progress": False, "device": device}
    fit(scene, **options)
    assert len(behind) == 50 and all(behind[:20])
    assert np.flatnonzero(behind[20:]).tolist() == [0, 4, 8, 12, 16, 20, 24, 28]
    for share, expected in ((1.0, 50), (0.0, 13)):
        behind.clear()
        fit(scene, opacity_share=share, **options)
        assert sum(behind) == expected
    behind.clear()
    fit(scene, background="constant", **options)
    assert not any(behind)
