"""What a fit takes on its device: the estimate against what is allocated, and max_memory kept."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from test_fit_edges import around, seen

from warpcage import Scene, fit
from warpcage.evaluation import evaluate, mean_psnr
from warpcage.fit_memory import FitMemory, array_bytes, device_arrays, memory_size, scaled_shape
from warpcage.fit_progress import load_progress, save_progress
from warpcage.optimize import FieldOptimizer


@pytest.fixture(scope="module")
def scene():
    return seen(around(12, size=48))


@pytest.mark.parametrize("text, size", [(12345, 12345), ("4GB", 4 * 10**9), ("1.5 MiB", 3 * 2**19), ("200kb", 200_000),
                                        (".5tb", 5 * 10**11), (np.int64(7), 7), ("99", 99), (2e6, 2_000_000)])
def test_memory_sizes(text, size):
    assert memory_size(text) == size


@pytest.mark.parametrize("wrong", ["4 apples", "", "-1GB", "GB", 0, -5, np.nan, np.inf, True, [1], "1e3 MB"])
def test_wrong_memory_sizes(wrong, scene):
    with pytest.raises(ValueError, match="memory size"):
        FieldOptimizer(scene, max_memory=wrong)


def test_estimates_match_what_is_allocated(scene, device):
    """Before each refinement the next level's bytes are foretold from the counts of rows and nodes."""
    optimizer = FieldOptimizer(scene, device=device, least_steps=60)
    foretold = None
    for level in range(3):
        if level:
            memory, shape = FitMemory.of(optimizer), scaled_shape(optimizer.field.resolution, 2)
            foretold = memory, shape
            while optimizer.level < level:
                optimizer.step()
        held = array_bytes(device_arrays(optimizer))
        rows, shape = optimizer.field.voxel_count, optimizer.field.resolution
        own = FitMemory.of(optimizer)
        assert own.level_bytes(rows, shape) == pytest.approx(held, rel=0.05)
        if foretold:
            assert shape == foretold[1]
            assert held <= foretold[0].level_bytes(rows, shape) <= 1.1 * held
    # by hand: 28 numbers of gradient for each thread and of 16-bit moments, a mark, 28 of the field and 3 of its place
    assert own.row == pytest.approx(28 * 4 * optimizer.shards + 28 * 2 + 1 + 28 * 4 + 12, rel=0.05)
    assert own.node == pytest.approx(4 + 1, rel=0.1)


class Allocations:
    """Bytes that Warp's arrays hold on a device from now on, and their peak."""

    def __init__(self, monkeypatch, device):
        self.held = self.peak = 0
        allocator = wp.get_device(device).get_allocator()
        allocate, deallocate = allocator.allocate, allocator.deallocate

        def counted_allocate(size):
            self.held += size
            self.peak = max(self.peak, self.held)
            return allocate(size)

        def counted_deallocate(pointer, size):
            self.held -= size
            deallocate(pointer, size)

        monkeypatch.setattr(allocator, "allocate", counted_allocate)
        monkeypatch.setattr(allocator, "deallocate", counted_deallocate)


@pytest.mark.parametrize("limit", ["20MB", "7MB", "2MB", "1.3MB"])
def test_a_limit_is_kept(scene, device, monkeypatch, limit):
    """Every array is counted, masks in between too."""
    allocations = Allocations(monkeypatch, device)
    field = fit(scene, device=device, progress=False, max_memory=limit, least_steps=60)
    assert allocations.peak <= memory_size(limit)
    assert allocations.peak > 0.4 * min(memory_size(limit), 15e6)  # and made use of
    assert mean_psnr(evaluate(field, scene)) > {"20MB": 30, "7MB": 30, "2MB": 28, "1.3MB": 24}[limit]


def test_more_memory_is_more_detail(scene, device):
    shapes = []
    for limit in (None, "1GB", "7MB", "2MB"):
        optimizer = FieldOptimizer(scene, device=device, max_memory=limit, least_steps=9, epochs=0.1)
        while optimizer.step_count < optimizer.total_steps:
            optimizer.step()
        shapes.append(optimizer.field.resolution)
        np.testing.assert_allclose(optimizer.field.voxel_size, optimizer.field.voxel_size[0], rtol=0.1)
    assert shapes[0] == shapes[1] and shapes[1][0] > shapes[2][0] > shapes[3][0]


def test_limits_that_cannot_be_kept(scene, device):
    with pytest.raises(ValueError, match=r"images take .* MB of device memory .*max_memory.* downscale=\d"):
        FieldOptimizer(scene, max_memory="100kB")
    images = array_bytes([FieldOptimizer(scene, device=device).rays.pixels])
    tables = len(scene) * 49 * 49 * 4
    with pytest.raises(ValueError, match="not possible: the images take"):
        FieldOptimizer(scene, device=device, max_memory=images + tables + 20_000)


def test_a_small_device_is_not_overrun(scene, monkeypatch):
    """Without max_memory, what is free is the limit."""
    monkeypatch.setattr("warpcage.fit_memory.free_bytes", lambda device: 2_000_000)
    optimizer = FieldOptimizer(scene, least_steps=9, epochs=0.1)
    assert optimizer.memory_limit == 1_800_000
    while optimizer.step_count < optimizer.total_steps:
        optimizer.step()
    assert optimizer.field.resolution[0] < optimizer.shapes[0][0] * 4


def test_a_checkpoint_of_a_limited_fit_goes_on(scene, device, tmp_path):
    options = {"max_memory": "7MB", "least_steps": 60, "device": device}
    optimizer = FieldOptimizer(scene, **options)
    while optimizer.level < 2:
        optimizer.step()
    assert optimizer.field.resolution[0] < 2 * optimizer.shapes[1][0]
    save_progress(optimizer, tmp_path / "c.npz")
    resumed = FieldOptimizer(scene, **options)
    load_progress(resumed, tmp_path / "c.npz")
    assert resumed.field.resolution == optimizer.field.resolution and resumed.shapes == optimizer.shapes
    for each in (optimizer, resumed):
        each.step()
    np.testing.assert_allclose(resumed.field.grid.density.numpy(), optimizer.field.grid.density.numpy(), atol=1e-4)


def test_a_refinement_by_a_fraction_keeps_the_picture(scene, device):
    """The same field on a grid 1.4 times as fine renders about the same."""
    field = fit(scene, device=device, progress=False, resolution=16, levels=1, least_steps=80)
    optimizer = FieldOptimizer(scene, device=device, resolution=16, levels=1)
    shape = scaled_shape(field.resolution, 1.4)
    optimizer._start_level(wp.ones(shape, dtype=wp.uint8, device=device), field)
    views = dataclasses.replace(scene, images=np.clip([field.render(c).rgb for c in scene.cameras], 0, 1))
    assert mean_psnr(evaluate(optimizer.field, Scene(views.images, None, scene.cameras))) > 28
