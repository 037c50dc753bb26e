"""Roots, quotients and rows of bytes of loops bound by instructions, against NumPy."""

import numpy as np
import warp as wp

from warpcage.core import array_view
from warpcage.kernels.core.loads import near_exp, near_reciprocal, near_root, reciprocal_root, row_has_zero

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Two units in the last place of float32.
TWO_UNITS = 2.0**-22


@wp.kernel
def fill(x: wp.array(dtype=float), found: wp.array2d(dtype=float)):
    n = wp.tid()
    found[n, 0] = near_root(x[n])
    found[n, 1] = near_reciprocal(x[n])
    found[n, 2] = reciprocal_root(x[n])
    found[n, 3] = near_exp(x[n])


def filled(x, device):
    found = wp.zeros((len(x), 4), dtype=float, device=device)
    wp.launch(fill, len(x), inputs=[wp.array(x, dtype=float, device=device), found], device=device)
    return found.numpy()


def test_roots_are_exact_to_two_units(device):
    x = np.concatenate([10.0 ** np.linspace(-30, 30, 4001), np.arange(1, 257)]).astype(np.float32)
    exact = x.astype(np.float64)
    expected = np.stack([np.sqrt(exact), 1 / exact, 1 / np.sqrt(exact)], axis=1)
    assert np.abs(filled(x, device)[:, :3] / expected - 1).max() <= TWO_UNITS
    assert filled(np.zeros(1, dtype=np.float32), device).tolist() == [[0.0, np.inf, np.inf, 1.0]]


def test_exponentials(device):
    """To 2 + 1.2 |x| units in the last place, and without an end below: nought of what is left."""
    x = np.concatenate([np.linspace(-80, 0, 4001), -(10.0 ** np.linspace(-30, 30, 601)), [0.0]]).astype(np.float32)
    found, exact = filled(x, device)[:, 3], np.exp(x.astype(np.float64))
    units = 2.0**-23 * np.maximum(exact, 2.0**-126)
    assert (np.abs(found - exact) <= (2 + 1.2 * np.abs(np.maximum(x, -200))) * units).all()
    assert (found[x == 0] == 1.0).all()


@wp.kernel
def fill_zeros(bytes_of_rows: wp.array3d(dtype=wp.uint8), places: wp.array(dtype=wp.vec4i), found: wp.array(dtype=int)):
    n = wp.tid()
    place = places[n]
    found[n] = row_has_zero(bytes_of_rows, place[0], place[1], place[2], place[3])


def test_rows_of_bytes_with_a_zero(device):
    """One to four bytes, at any offset from four, up to the last of the array."""
    random = np.random.default_rng(0)
    values = random.choice([0, 0, 1, 7, 127, 128, 129, 255], (4, 5, 13)).astype(np.uint8)
    held = wp.zeros(values.size + 3, dtype=wp.uint8, device=device)
    held[: values.size].assign(values.ravel())
    rows = array_view(held, wp.uint8, values.shape)
    places = [(i, j, k, last) for i in range(4) for j in range(5) for k in range(13) for last in range(min(4, 13 - k))]
    found = wp.zeros(len(places), dtype=int, device=device)
    inputs = [rows, wp.array(places, dtype=wp.vec4i, device=device), found]
    wp.launch(fill_zeros, len(places), inputs=inputs, device=device)
    expected = [int((values[i, j, k : k + last + 1] == 0).any()) for i, j, k, last in places]
    assert found.numpy().tolist() == expected and 0 < sum(expected) < len(expected)
