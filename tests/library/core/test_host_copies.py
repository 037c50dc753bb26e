"""Copies of frames that come to the host while the device is given other work."""

import gc

import numpy as np
import pytest
import warp as wp

from warpcage import Frame
from warpcage.core import arrays
from warpcage.view import to_uint8

SIDE = 37


def colors(seed=0):
    """Colours in and out of range, and all that lie halfway between two bytes."""
    rng = np.random.default_rng(seed)
    found = rng.uniform(-0.2, 1.2, (SIDE, SIDE, 3)).astype(np.float32)
    halves = (np.arange(255, dtype=np.float32) + np.float32(0.5)) / np.float32(255)
    near = np.concatenate([halves, np.nextafter(halves, np.float32(0)), np.nextafter(halves, np.float32(1))])
    found.reshape(-1)[: near.size] = near
    return found


def frame_of(rgb, device, alpha=1.0):
    pixels = rgb.shape[0] * rgb.shape[1]
    ones = wp.full(pixels, alpha, dtype=wp.float32, device=device)
    return Frame(rgb.shape[1], rgb.shape[0], wp.array(rgb.reshape(-1, 3), dtype=wp.vec3, device=device), ones, ones)


@pytest.mark.parametrize("early", [True, False])
def test_bytes_are_those_of_the_colors(device, early):
    ones, rgb = np.ones((SIDE, SIDE)), colors()
    for frame in (frame_of(rgb, device), Frame(SIDE, SIDE, rgb, ones, ones)):
        if early:
            frame.begin_copies("rgb", "rgb_bytes", "depth")
        assert frame.rgb_bytes.dtype == np.uint8 and frame.rgb_bytes is frame.rgb_bytes
        np.testing.assert_array_equal(frame.rgb_bytes, to_uint8(rgb))
        np.testing.assert_array_equal(frame.rgb, rgb)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_bytes_of_what_is_not_finite_are_refused(device, wrong):
    rgb = colors()
    rgb[3, 4, 1] = wrong
    frame = frame_of(rgb, device)
    for _ in range(2):
        with pytest.raises(ValueError, match="not finite"):
            _ = frame.rgb_bytes


def test_copies_hold_what_was_there_when_they_were_begun(device):
    first, second = colors(1), colors(2)
    frame = frame_of(first, device, alpha=0.25)
    if not wp.get_device(device).is_cuda:
        frame.begin_copies("rgb", "alpha", "rgb_bytes")  # nothing to copy
        np.testing.assert_array_equal(frame.rgb, first)
        return
    frame.begin_copies("rgb", "alpha", "rgb_bytes")
    frame.arrays["rgb"].assign(second.reshape(-1, 3))
    frame.arrays["alpha"].fill_(0.75)
    np.testing.assert_array_equal(frame.rgb, first)
    np.testing.assert_array_equal(frame.rgb_bytes, to_uint8(first))
    np.testing.assert_array_equal(frame.alpha, np.full((SIDE, SIDE), 0.25, np.float32))
    np.testing.assert_array_equal(frame.depth, np.full((SIDE, SIDE), 0.75, np.float32))


@pytest.mark.parametrize("room", [1 << 28, 5 * arrays.PIECE, 0])
def test_memory_of_copies_is_used_again_and_what_somebody_holds_is_not(device, room, monkeypatch):
    monkeypatch.setattr(arrays, "MAX_STAGED", room)
    arrays.staging_memory.cache_clear()
    held = []
    for seed in range(12):
        frame = frame_of(colors(seed), device)
        frame.begin_copies("rgb", "rgb_bytes", "alpha")
        if seed % 3 == 0:
            held.append((seed, frame.rgb, frame.rgb_bytes))
        elif seed % 3 == 1:
            np.testing.assert_array_equal(frame.rgb, colors(seed))
        del frame  # every third one before its copy has ended
    gc.collect()
    for seed, rgb, packed in held:
        np.testing.assert_array_equal(rgb, colors(seed))
        np.testing.assert_array_equal(packed, to_uint8(colors(seed)))
    if wp.get_device(device).is_cuda:
        assert arrays.staging_memory(0).held_bytes <= room
    arrays.staging_memory.cache_clear()
