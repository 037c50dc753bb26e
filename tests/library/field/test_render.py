"""Frames and cameras as kernels take them."""

import copy
import pickle

import numpy as np
import pytest
import warp as wp
from refusals import refused

from warpcage import Camera, Frame
from warpcage.view import camera_struct


def test_a_frame_converts_once_and_reshapes(device):
    rgb = wp.array(np.arange(18, dtype=np.float32).reshape(6, 3), dtype=wp.vec3, device=device)
    alpha = wp.array(np.arange(6, dtype=np.float32), dtype=wp.float32, device=device)
    depth = wp.array(np.array([1, 2, 4, np.inf, 0.5, np.inf], np.float32), dtype=wp.float32, device=device)
    frame = Frame(3, 2, rgb, alpha, depth, fold=alpha)
    assert frame.rgb.shape == (2, 3, 3) and frame.rgb.dtype == np.float32
    np.testing.assert_array_equal(frame.rgb[1, 0], [9, 10, 11])  # rows of pixels, one after the other
    np.testing.assert_array_equal(frame.alpha, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(frame.disparity, [[1, 0.5, 0.25], [0, 2, 0]])
    assert frame.rgb is frame.rgb
    assert frame.arrays["rgb"] is rgb
    np.testing.assert_array_equal(frame.fold, frame.alpha)
    assert frame.reveal is None and frame.outside is None


def test_a_frame_is_told_in_one_short_line():
    frame = Frame(3, 2, np.zeros((2, 3, 3)), np.zeros(6), np.zeros(6), reveal=np.zeros(6))
    assert repr(frame) == "Frame(3x2: rgb, alpha, depth, reveal)"


@pytest.mark.parametrize("again", [lambda frame: pickle.loads(pickle.dumps(frame)), copy.deepcopy])
def test_a_frame_passes_between_processes(again, device):
    random = np.random.default_rng(0)
    rgb, alpha, reveal = random.random((6, 3)), random.random(6), random.random(6)
    arrays = [
        wp.array(values.astype(np.float32), dtype=dtype, device=device)
        for values, dtype in ((rgb, wp.vec3), (alpha, float), (alpha, float), (reveal, float))
    ]
    frame = Frame(3, 2, *arrays[:3], reveal=arrays[3])
    other = again(frame)
    for name in ("rgb", "alpha", "depth", "disparity", "reveal"):
        np.testing.assert_array_equal(getattr(other, name), getattr(frame, name))
    assert other.fold is None and (other.width, other.height) == (3, 2)


def test_a_frame_takes_numpy():
    frame = Frame(2, 1, np.zeros((1, 2, 3)), np.zeros((1, 2)), np.ones(2))
    assert frame.depth.shape == (1, 2)


@pytest.mark.parametrize(
    ("size", "rgb", "masks", "message"),
    [
        ((2, 1), np.zeros((1, 3, 3)), {}, "rgb of a 2x1 frame"),
        ((0, 1), np.zeros((1, 0, 3)), {}, "whole number of at least 1"),
        ((2, 1), np.zeros((1, 2, 3)), {"shadow": np.zeros(2)}, "no mask 'shadow'"),
        ((2, 1), np.zeros((1, 2, 3)), {"fold": np.zeros(3)}, "fold of a 2x1 frame"),
    ],
)
def test_a_frame_refuses_what_does_not_fit(size, rgb, masks, message):
    refused(lambda: Frame(*size, rgb, np.zeros(size[0] * size[1]), np.zeros(size[0] * size[1]), **masks), match=message)


def test_camera_struct_subtracts_the_origin_before_float32():
    far = np.array([1e7, -3e7, 5e6])
    camera = Camera.look_at(far + [0.25, 0.5, -2.0], far, width=7, height=5)
    struct = camera_struct(camera, far)
    np.testing.assert_allclose(list(struct.center), [0.25, 0.5, -2.0], atol=1e-7)
    np.testing.assert_allclose(np.array(struct.rotation).reshape(3, 3), camera.rotation, atol=1e-7)
    assert (struct.width, struct.height) == (7, 5)
