"""Roots and quotients of loops bound by instructions, against NumPy."""

import numpy as np
import warp as wp

from warpcage.kernels.core.entries import near_reciprocal, near_root, reciprocal_root

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Two units in the last place of float32.
TWO_UNITS = 2.0**-22


@wp.kernel
def fill_roots(x: wp.array(dtype=float), found: wp.array2d(dtype=float)):
    n = wp.tid()
    found[n, 0] = near_root(x[n])
    found[n, 1] = near_reciprocal(x[n])
    found[n, 2] = reciprocal_root(x[n])


def roots(x, device):
    found = wp.zeros((len(x), 3), dtype=float, device=device)
    wp.launch(fill_roots, len(x), inputs=[wp.array(x, dtype=float, device=device), found], device=device)
    return found.numpy()


def test_are_exact_to_two_units(device):
    x = np.concatenate([10.0 ** np.linspace(-30, 30, 4001), np.arange(1, 257)]).astype(np.float32)
    exact = x.astype(np.float64)
    expected = np.stack([np.sqrt(exact), 1 / exact, 1 / np.sqrt(exact)], axis=1)
    assert np.abs(roots(x, device) / expected - 1).max() <= TWO_UNITS


def test_of_zero(device):
    assert roots(np.zeros(1, dtype=np.float32), device).tolist() == [[0.0, np.inf, np.inf]]
