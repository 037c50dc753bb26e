"""The map of lattice cells as polynomials, against float64 NumPy and the nodes."""

import numpy as np
import pytest
import warp as wp
from fields import BOX, marches, shiny_field, slotted, use_march, view

from warpcage import CageEdit, Deformer
from warpcage.core import launch, recorded_launches
from warpcage.kernels.edits.nodes import CELL_VEC4S, cell_place_slope, expand_map_cells, node_distance, vec6
from warpcage.kernels.edits.structs import LOOK_SKIP
from warpcage.render import tables

COUNTS = (4, 5, 6)


@wp.kernel
def place_slopes(
    first: int,
    polynomials: wp.array(dtype=wp.vec4),
    nodes: wp.array(dtype=wp.vec4),
    cells: wp.array(dtype=int),
    places: wp.array(dtype=wp.vec3),
    rates: wp.array(dtype=wp.vec3),
    counts: wp.vec3i,
    found: wp.array(dtype=vec6),
    distances: wp.array(dtype=float),
):
    n = first + wp.tid()
    found[n] = cell_place_slope(polynomials, cells[n], places[n], rates[n])
    distances[n] = node_distance(nodes, cells[n], counts[1] * counts[2], counts[2], places[n])


def trilinear(values, f):
    """Values (n, 2, 2, 2, c) of corners at places f (n, 3), and their gradient (n, c, 3), in float64."""
    shares = [np.stack([1 - f[:, axis], f[:, axis]], axis=1) for axis in range(3)]
    slopes = np.tile([-1.0, 1.0], (len(f), 1))
    value = np.einsum("ni,nj,nk,nijkc->nc", *shares, values)
    gradient = [np.einsum("ni,nj,nk,nijkc->nc", *(slopes if a == b else shares[b] for b in range(3)), values)
                for a in range(3)]  # fmt: skip
    return value, np.stack(gradient, axis=-1)


def test_places_and_slopes_are_those_of_the_nodes(device):
    random = np.random.default_rng(3)
    nodes = random.normal(size=(*COUNTS, 4)).astype(np.float32)
    look = np.zeros(COUNTS, np.uint8)
    look[-1], look[:, -1], look[:, :, -1] = [int(LOOK_SKIP) + 1] * 3
    count = 500
    cells = np.stack([random.integers(0, n - 1, count) for n in COUNTS], axis=1)
    places, rates = random.uniform(0, 1, (count, 3)), random.normal(size=(count, 3))
    numbers = np.ravel_multi_index(tuple(cells.T), COUNTS).astype(np.int32)
    send = lambda array, dtype: wp.array(array, dtype=dtype, device=device)  # noqa: E731
    flat = send(nodes.reshape(-1, 4), wp.vec4)
    polynomials = wp.zeros(int(CELL_VEC4S) * look.size, dtype=wp.vec4, device=device)
    inputs = [flat, send(look.reshape(-1), wp.uint8), wp.vec3i(*COUNTS)]
    launch(expand_map_cells, look.size, inputs, [polynomials], device=device)
    found = wp.zeros(count, dtype=vec6, device=device)
    distances = wp.zeros(count, dtype=wp.float32, device=device)
    inputs = [polynomials, flat, send(numbers, int), send(places, wp.vec3), send(rates, wp.vec3), wp.vec3i(*COUNTS)]
    launch(place_slopes, count, inputs, [found, distances], device=device)
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1)
    around = nodes.astype(float)[tuple(np.moveaxis(cells[:, None, None, None] + corners, -1, 0))]
    value, gradient = trilinear(around, places.astype(np.float32).astype(float))
    slope = np.einsum("nca,na->nc", gradient, rates.astype(np.float32).astype(float))
    assert np.allclose(found.numpy()[:, :3], value[:, :3], atol=5e-6)
    assert np.allclose(found.numpy()[:, 3:], slope[:, :3], atol=3e-5)
    assert np.allclose(distances.numpy(), value[:, 3], atol=5e-6)


def test_cells_that_are_skipped_have_none(device):
    nodes = wp.array(np.ones((8, 4), np.float32), dtype=wp.vec4, device=device)
    look = wp.array(np.full(8, int(LOOK_SKIP) + 1, np.uint8), dtype=wp.uint8, device=device)
    polynomials = wp.full(int(CELL_VEC4S) * 8, value=wp.vec4(7.0, 7.0, 7.0, 7.0), dtype=wp.vec4, device=device)
    launch(expand_map_cells, 8, [nodes, look, wp.vec3i(2, 2, 2)], [polynomials], device=device)
    assert (polynomials.numpy() == 7.0).all()


@pytest.mark.parametrize("march", ["rows", "shaded"])
@pytest.mark.parametrize("case", ["bend", "narrow slot", "removed"])
def test_pictures_without_polynomials_are_the_same(case, march, device, monkeypatch):
    """Lattices that are too large for them are marched by their nodes."""
    use_march(march, device, monkeypatch)
    rest, pose, options = {
        "bend": (BOX, BOX.bend(50, axis="x", towards="z"), {}),
        "narrow slot": (slotted(0.3), slotted(0.02), {}),
        "removed": (BOX, None, {"remove": True}),
    }[case]
    field = shiny_field(device, resolution=48)
    frames = []
    for most in (tables.MAX_ENTRIES, 0):
        monkeypatch.setattr(tables, "MAX_ENTRIES", most)
        deformer = Deformer(field, CageEdit(rest, **options), resolution=10).pose(pose)
        frames.append(deformer.render(view()))
        (edit,) = deformer.posed_edits().tables.edits
        assert edit.by_nodes == (most == 0 and case != "removed")
        sides = "+sides" if edit.by_nodes or case == "narrow slot" else ""
        with recorded_launches() as launched:
            deformer.render(view())
        assert marches(launched) == [f"views.{'shaded' if march == 'shaded' else 'rows'}{sides}"]
    for name in ("rgb", "alpha", "reveal", "fold"):
        assert np.allclose(*(getattr(frame, name) for frame in frames), atol=1e-4), name
    assert np.median(np.abs(frames[0].rgb - frames[1].rgb)) < 1e-6
