"""Colors laid out by nodes: what is written to a layer is read between its nodes, by texture units on CUDA."""

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fields import BOX, shiny_field, use_march, view

from warpcage import Cage, Deformer
from warpcage.field import ColumnTable
from warpcage.field.bricks import ColorBricks, brick_counts, texture_bytes, texture_shape
from warpcage.kernels.render.volume import COLOR_LAYERS, ShadedVolume, shaded_value, write_shaded_volume

COUNTS = (5, 18, 26)  # the second axis ends in a brick's first node, the third one has four bricks
LAYERS = int(COLOR_LAYERS)


@wp.kernel
def write_all(laid: ShadedVolume, values: wp.array2d(dtype=wp.vec4)):
    layer, node = wp.tid()
    write_shaded_volume(laid, node, 1 << layer, values[layer, node])


@wp.kernel
def read_all(laid: ShadedVolume, places: wp.array(dtype=wp.vec3), layer: int, found: wp.array(dtype=wp.vec4)):
    found[wp.tid()] = shaded_value(laid, places[wp.tid()], layer)


def every_node(device):
    return wp.array(np.arange(np.prod(COUNTS)), dtype=wp.int32, device=device)


def marked(bricks, kept):
    """Marks of the bricks (layers, ...) that are kept."""
    return wp.array(np.broadcast_to(kept, bricks.numbers.shape).astype(np.int32), device=bricks.device)


def written(values, device, kept=True):
    """ShadedVolume of values (layers, nodes, 4) in the bricks that are kept, and what must be kept alive."""
    bricks, laid, texture = ColorBricks(COUNTS, every_node(device)), ShadedVolume(), None
    bricks.add(marked(bricks, kept))
    laid.node_counts, laid.numbers = wp.vec3i(*COUNTS), bricks.numbers
    laid.pages, laid.first_page = bricks.pages, bricks.first_page
    if wp.get_device(device).is_cpu:
        laid.colors = bricks.new_colors()
    else:
        texture = bricks.new_texture()
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
    near = 1e-5 if wp.get_device(device).is_cpu else 3 * np.abs(values).max() / 256 + 2e-3
    np.testing.assert_allclose(read(laid, inside, layer, device), oracle.trilinear(grid, inside), atol=near)
    exact = 1e-5 if wp.get_device(device).is_cpu else 2e-3
    np.testing.assert_allclose(read(laid, at_nodes, layer, device), oracle.trilinear(grid, at_nodes), atol=exact)


def test_numbers_beyond_halves_are_the_largest(device):
    values = np.zeros((LAYERS, np.prod(COUNTS), 4))
    values[:, :] = [1e9, -1e9, np.inf, -np.inf]
    laid, _kept = written(values, device)
    found = read(laid, np.full((1, 3), 1.0), 1, device)[0]
    np.testing.assert_array_equal(found, [65504, -65504, 65504, -65504])


def test_bricks_that_are_not_kept_are_empty(device):
    """And the others hold what they would with all of them."""
    random = np.random.default_rng(1)
    values = random.normal(size=(LAYERS, np.prod(COUNTS), 4))
    kept = random.random((LAYERS, *brick_counts(COUNTS))) < 0.5
    laid, _kept = written(values, device, kept)
    whole, _all = written(values, device)
    inside = random.random((800, 3)) * (np.array(COUNTS) - 1.001)
    for layer in range(LAYERS):
        has_brick = kept[layer][tuple((inside // 8).astype(int).T)]
        assert 100 < has_brick.sum() < 700
        found = read(laid, inside, layer, device)
        np.testing.assert_array_equal(found[~has_brick], 0)
        near = 0 if wp.get_device(device).is_cpu else 3 * np.abs(values).max() / 256  # other texels round places anew
        np.testing.assert_allclose(found[has_brick], read(whole, inside, layer, device)[has_brick], atol=near)


def test_bricks_keep_their_numbers_when_others_are_added(device):
    bricks = ColorBricks(COUNTS, every_node(device))
    assert bricks.count == 1 and bricks.numbers.shape == (LAYERS, 1, 3, 4)
    one, other = np.zeros((2, LAYERS, 1, 3, 4), bool)
    one[0, 0, 1, 2] = one[1, 0, 0, 0] = True
    other[0, 0, 1, 2] = other[0, 0, 2, 3] = True
    bricks.add(marked(bricks, one))
    before = bricks.numbers.numpy()
    bricks.add(marked(bricks, other))
    numbers = bricks.numbers.numpy()
    np.testing.assert_array_equal(numbers[one], before[one])
    np.testing.assert_array_equal(numbers > 0, one | other)
    assert sorted(numbers[one | other]) == [1, 2, 3] and bricks.count == 4


def test_pages_lead_to_the_texels_of_bricks(device):
    """As a GPU reads them: by the bits of 2^23 + x for the page, and of 2^22 + x for where it begins."""
    bricks = ColorBricks((9, 1200, 3000), every_node(device))
    random = np.random.default_rng(3)
    bricks.add(marked(bricks, random.random(bricks.numbers.shape) < 0.3))
    counts, numbers, pages = bricks.numbers.shape, bricks.numbers.numpy(), bricks.pages.numpy().view(np.uint32)
    at = random.random((1000, 3)) * (np.array(counts[1:]) * 8)
    layer, place = random.integers(0, LAYERS, len(at)), (at // 8).astype(np.uint32)
    bits = (2.0**23 + place).astype(np.float32).view(np.uint32)
    index = layer.astype(np.uint32) * np.uint32(counts[1]) + bits[:, 0]
    index = (index * np.uint32(counts[2]) + bits[:, 1]) * np.uint32(counts[3]) + bits[:, 2]
    page = pages.reshape(-1, 2)[index - np.uint32(bricks.first_page)]
    halves = np.stack([page[:, 0] & 0xFFFF, page[:, 0] >> 16, page[:, 1]], axis=1)
    floats = (halves | np.uint32(0x4A800000)).view(np.float32)
    begins = floats - np.float32(2**22 + 2**14) - 0.5 + 8.0 * place[:, ::-1]
    number = numbers[(layer, *place.T)]
    assert 100 < (number > 0).sum() < 900
    np.testing.assert_array_equal(begins, 9 * np.stack([number % 32, number // 32 % 32, number // 1024], axis=1))


@pytest.mark.parametrize("count", [1, 31, 32, 33, 1023, 1024, 5000])
def test_textures_of_bricks_have_room_for_all(count):
    depth, height, width = texture_shape(count)
    last = count - 1
    assert depth == 9 * (last // 1024 + 1)
    assert height >= 9 * (min(last, 1023) // 32 + 1) and width >= 9 * (min(last, 31) + 1)
    assert texture_bytes(count) == 8 * depth * height * width


def test_colors_take_memory_where_rows_are(device):
    """Those of a thin sheet of nodes take two bricks across it at most, in each layer."""
    links = np.full((64, 64, 64), -1, np.int32)
    links[:, 21, :] = np.arange(64 * 64).reshape(64, 64)
    table = ColumnTable(wp.array(links, device=device))
    assert table.color_bricks.most_bytes == texture_bytes(1 + LAYERS * 8 * 8)
    assert texture_bytes(10**7) == np.inf


def test_a_field_keeps_one_texture_and_it_begins_empty(device):
    if wp.get_device(device).is_cpu:
        pytest.skip("CUDA only")
    table = ColumnTable(oracle.random_field(device, resolution=(16, 5, 7), keep=0.5)[0].grid.links)
    bricks = table.color_bricks
    bricks.add(marked(bricks, True))
    texture = table.color_texture()
    shape = texture.depth, texture.height, texture.width
    assert shape == (9, 9, 9 * (1 + LAYERS * 2))
    numbers = wp.empty(shape, dtype=wp.vec4h, device=device)
    texture.copy_to(numbers)
    assert not numbers.numpy().any()
    assert table.color_texture() is texture
    with wp.ScopedStream(wp.Stream(device)):
        assert table.color_texture() is not texture
    assert table.color_texture() is texture


def test_fields_of_several_deformers_keep_one_texture(device, monkeypatch):
    """Bricks are added for a cage that is elsewhere, and frames of the first one stay as they were."""
    use_march("shaded", device, monkeypatch)
    field, half = shiny_field(device), Cage.box([-1.0, -0.9, -0.9], [0.1, 0.9, 0.9], segments=2)
    bricks, counts, frames, deformers = field.marching.columns.color_bricks, [], [], []
    for cage in (half, BOX, None, None):  # a Deformer finds its bricks when it is made, or with its first frame
        if cage is not None:
            deformers.append(Deformer(field, cage, resolution=24).pose(cage.twist(40)))
        frames.append(deformers[len(frames) % 2].render(view()).rgb.copy())
        counts.append(bricks.count)
    assert 1 < counts[0] < counts[1] and counts[1:] == [counts[1]] * 3
    assert texture_bytes(bricks.count) <= bricks.most_bytes
    np.testing.assert_array_equal(frames[0], frames[2])
    np.testing.assert_array_equal(frames[1], frames[3])


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
