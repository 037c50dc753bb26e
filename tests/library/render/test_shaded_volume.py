"""Colors laid out by nodes: what is written to a layer is read between its nodes, by texture units on CUDA."""

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fields import BOX, shiny_field, view

from warpcage import Deformer
from warpcage.core import half_texture
from warpcage.field import ColumnTable
from warpcage.kernels.render.volume import COLOR_LAYERS, ShadedVolume, shaded_value, write_shaded_volume

COUNTS = (5, 7, 6)
LAYERS = int(COLOR_LAYERS)


@wp.kernel
def write_all(laid: ShadedVolume, values: wp.array2d(dtype=wp.vec4)):
    layer, node = wp.tid()
    write_shaded_volume(laid, node, layer, values[layer, node])


@wp.kernel
def read_all(laid: ShadedVolume, places: wp.array(dtype=wp.vec3), layer: int, found: wp.array(dtype=wp.vec4)):
    found[wp.tid()] = shaded_value(laid, places[wp.tid()], layer)


def written(values, device):
    """ShadedVolume of values (layers, nodes, 4), and what must be kept alive."""
    laid, texture = ShadedVolume(), None
    laid.node_counts = wp.vec3i(*COUNTS)
    if wp.get_device(device).is_cpu:
        laid.colors = wp.zeros(values.shape[0] * values.shape[1], dtype=wp.vec4, device=device)
    else:
        texture = half_texture((LAYERS * COUNTS[0], *COUNTS[1:]), device)
        laid.texture, laid.surface = texture.cuda_texture, texture.cuda_surface
    given = wp.array(values.astype(np.float32), dtype=wp.vec4, device=device)
    wp.launch(write_all, values.shape[:2], [laid, given], device=device)
    return laid, texture


def read(laid, places, layer, device):
    found = wp.empty(len(places), dtype=wp.vec4, device=device)
    given = wp.array(places.astype(np.float32), dtype=wp.vec3, device=device)
    wp.launch(read_all, len(places), [laid, given, layer], [found], device=device)
    return found.numpy()


@pytest.mark.parametrize("layer", range(LAYERS))
def test_places_between_nodes(layer, device):
    random = np.random.default_rng(0)
    values = random.normal(size=(LAYERS, np.prod(COUNTS), 4))
    laid, _kept = written(values, device)
    inside = random.random((500, 3)) * (np.array(COUNTS) - 1.001)
    at_nodes = np.argwhere(np.ones(np.array(COUNTS) - 1)).astype(float)
    grid = values[layer].reshape(*COUNTS, 4)
    # halves, and places to 1/256 of a cell along three axes
    near = 1e-6 if wp.get_device(device).is_cpu else 3 * np.abs(values).max() / 256 + 2e-3
    np.testing.assert_allclose(read(laid, inside, layer, device), oracle.trilinear(grid, inside), atol=near)
    exact = 1e-6 if wp.get_device(device).is_cpu else 2e-3
    np.testing.assert_allclose(read(laid, at_nodes, layer, device), oracle.trilinear(grid, at_nodes), atol=exact)


def test_numbers_beyond_halves_are_the_largest(device):
    values = np.zeros((LAYERS, np.prod(COUNTS), 4))
    values[:, :] = [1e9, -1e9, np.inf, -np.inf]
    laid, _kept = written(values, device)
    found = read(laid, np.full((1, 3), 1.0), 1, device)[0]
    np.testing.assert_array_equal(found, [65504, -65504, 65504, -65504])


def test_a_field_keeps_one_texture_and_it_begins_empty(device):
    if wp.get_device(device).is_cpu:
        pytest.skip("CUDA only")
    table = ColumnTable(oracle.random_field(device, resolution=(6, 5, 7), keep=0.5)[0].grid.links)
    texture = table.color_texture(LAYERS)
    assert (texture.depth, texture.height, texture.width) == (LAYERS * 6, 5, 7)
    numbers = wp.empty((LAYERS * 6, 5, 7), dtype=wp.vec4h, device=device)
    texture.copy_to(numbers)
    assert not numbers.numpy().any()
    assert table.color_texture(LAYERS) is texture
    with wp.ScopedStream(wp.Stream(device)):
        assert table.color_texture(LAYERS) is not texture
    assert table.color_texture(LAYERS) is texture


def test_frames_of_other_streams_are_the_same(device):
    """They have colors of their own."""
    if wp.get_device(device).is_cpu:
        pytest.skip("CUDA only")
    deformer = Deformer(shiny_field(device), BOX, coordinates="mean_value", resolution=24).pose(BOX.twist(40))
    expected = deformer.render(view()).rgb
    for _ in range(2):
        with wp.ScopedStream(wp.Stream(device)):
            np.testing.assert_array_equal(deformer.render(view()).rgb, expected)
        np.testing.assert_array_equal(deformer.render(view()).rgb, expected)
