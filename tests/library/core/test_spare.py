"""Memory of frames that a GPU's pool keeps (warpcage/core/devices.py)."""

import gc
import types

import numpy as np
import pytest
import warp as wp
from fields import shiny_field, view

from warpcage.core import MIN_SPARE, SPARE_FRAMES, SpareMemory, devices

MIB = 1 << 20


class Pool:
    """A pool of a device that is not there."""

    def __init__(self):
        self.used, self.threshold, self.calls = 0, 0, 0

    def set(self, device, threshold):
        self.threshold, self.calls = threshold, self.calls + 1


@pytest.fixture
def pool(monkeypatch):
    made = Pool()
    monkeypatch.setattr(devices, "release_thresholds", {})
    monkeypatch.setattr(wp, "get_mempool_used_mem_current", lambda device: made.used)
    monkeypatch.setattr(wp, "get_mempool_release_threshold", lambda device: made.threshold)
    monkeypatch.setattr(wp, "set_mempool_release_threshold", made.set)
    return made


def gpu(ordinal=0, **options):
    return types.SimpleNamespace(**({"is_cuda": True, "is_mempool_enabled": True, "ordinal": ordinal} | options))


def test_the_threshold_follows_what_is_in_use_and_nothing_is_kept_for_nobody(pool):
    memory = SpareMemory(gpu())
    for used in (3000, 3050, 9000, 500):
        pool.used = used * MIB
        memory.keep(100 * MIB)
        assert abs(pool.threshold - (used + SPARE_FRAMES * 100) * MIB) <= SPARE_FRAMES * 100 * MIB // 2
    assert pool.calls == 3  # little changes are none
    memory.keep(MIB)
    assert pool.threshold == 500 * MIB + MIN_SPARE
    other = SpareMemory(gpu())
    other.keep(100 * MIB)
    del memory
    gc.collect()
    assert pool.threshold == 0
    other.keep(100 * MIB)
    assert pool.threshold > 0  # the next frame of another
    del other
    gc.collect()
    assert pool.threshold == 0


def test_a_program_that_sets_the_threshold_is_obeyed(pool):
    pool.threshold = 7 * MIB
    memory = SpareMemory(gpu())
    memory.keep(100 * MIB)
    assert pool.threshold == 7 * MIB and pool.calls == 0
    del memory
    gc.collect()
    assert pool.threshold == 7 * MIB and pool.calls == 0
    pool.threshold = 0
    memory = SpareMemory(gpu())
    memory.keep(100 * MIB)
    pool.threshold = 9 * MIB  # later than ours
    pool.used = 900 * MIB
    memory.keep(100 * MIB)
    del memory
    gc.collect()
    assert pool.threshold == 9 * MIB


@pytest.mark.parametrize("device", [gpu(is_cuda=False), gpu(is_mempool_enabled=False)], ids=["cpu", "no pool"])
def test_where_there_is_no_pool(device, pool):
    SpareMemory(device).keep(100 * MIB)
    gc.collect()
    assert pool.calls == 0


def test_devices_are_kept_apart(pool):
    one, other = SpareMemory(gpu(0)), SpareMemory(gpu(1))
    one.keep(100 * MIB)
    pool.threshold = 0  # that of the other device
    other.keep(200 * MIB)
    assert sorted(devices.release_thresholds.values()) == [200 * MIB, 400 * MIB]


def test_frames_of_a_field(device):
    """They are the same, and their memory is there for the next one; no longer than the field."""
    place = wp.get_device(device)
    field = shiny_field(device)
    first = np.array(field.render(view()).rgb)
    for _ in range(3):
        np.testing.assert_array_equal(field.render(view()).rgb, first)
    if place.is_cuda and place.is_mempool_enabled:
        assert wp.get_mempool_release_threshold(place) > wp.get_mempool_used_mem_current(place)
        del field
        gc.collect()
        assert wp.get_mempool_release_threshold(place) == 0
