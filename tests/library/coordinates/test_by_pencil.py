"""Coordinates of shapes so plain that a reader finds the numbers with a pencil."""

import numpy as np
import pytest
import warp as wp

from warpcage import Cage, green_coordinates, harmonic_coordinates, mean_value_coordinates
from warpcage.kernels.core.loads import trilinear_entry

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Corners on the half axes +x, -x, +y, -y, +z, -z, in this order, at these distances from the origin.
FACES = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]


def octahedron(*distances):
    directions = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    return Cage(np.array(distances)[:, None] * directions, FACES)


def test_in_a_tetrahedron_weights_are_the_coordinates_of_the_point(device):
    """Four weights that sum to one and give the point back: x, y and z belong to the corners on the axes."""
    cage = Cage([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    expected = [0.4, 0.1, 0.2, 0.3]  # 1 - 0.1 - 0.2 - 0.3 is left for the origin
    for weigh in (mean_value_coordinates, lambda *given, **options: harmonic_coordinates(*given, 16, **options)):
        assert weigh([[0.1, 0.2, 0.3]], cage, device=device)[0] == pytest.approx(expected, abs=1e-5)


def test_mean_values_fall_with_the_distance_of_corners(device):
    """From the origin all eight faces are the same octant of a sphere, so weights are as 1 / distance."""
    weights = mean_value_coordinates([[0, 0, 0]], octahedron(1, 2, 4, 1, 2, 4), device=device)[0]
    # 1 + 1/2 + 1/4 + 1 + 1/2 + 1/4 = 7/2, and 1 / (7/2) = 2/7
    assert weights == pytest.approx([2 / 7, 1 / 7, 1 / 14, 2 / 7, 1 / 7, 1 / 14], abs=1e-6)


def test_green_at_the_middle_of_an_octahedron(device):
    phi, psi = green_coordinates([[0, 0, 0]], octahedron(1, 1, 1, 1, 1, 1), device=device)
    assert phi[0] == pytest.approx(6 * [1 / 6], abs=1e-6)
    # A face has sides of sqrt(2), and its foot, its middle, is 1/sqrt(3) off and 1/sqrt(6) from each side. The integral
    # of 1 / r over it is 3 sides * 1/sqrt(6) * 2 ln(1 + sqrt(2)) - 1/sqrt(3) * 4 pi / 8, which is
    # 2.449490 * 0.881374 - 0.577350 * 1.570796 = 2.158916 - 0.906900 = 1.252016; divided by 4 pi:
    assert psi[0] == pytest.approx(8 * [0.099632], abs=1e-6)


def test_harmonic_at_the_middle_of_an_octahedron(device):
    """A corner goes to every other one by turns that leave the octahedron as it is, but its lattice not quite."""
    weights = harmonic_coordinates([[0, 0, 0]], octahedron(1, 1, 1, 1, 1, 1), 32, device=device)[0]
    assert weights == pytest.approx(6 * [1 / 6], abs=2e-4)


@wp.kernel
def look_up(grid: wp.array3d(dtype=float), places: wp.array(dtype=wp.vec3), found: wp.array(dtype=float)):
    n = wp.tid()
    found[n] = trilinear_entry(grid, places[n], -1.0)


def test_a_cell_with_eight_corners(device):
    corners = np.array([1.0, 2, 4, 8, 16, 32, 64, 128]).reshape(2, 2, 2)  # twice along z, 4 times along y, 16 along x
    places, found = [[0.25, 0.5, 0.75], [0, 0, 0.5], [0, 0.5, 0], [0.5, 0, 0]], wp.empty(4, dtype=float, device=device)
    inputs = [wp.array(corners, dtype=float, device=device), wp.array(places, dtype=wp.vec3, device=device)]
    wp.launch(look_up, 4, inputs, [found], device=device)
    # (0.75 + 0.25 * 16) * (0.5 + 0.5 * 4) * (0.25 + 0.75 * 2) = 4.75 * 2.5 * 1.75, and halfway along each axis
    assert found.numpy().tolist() == [20.78125, 1.5, 2.5, 8.5]
