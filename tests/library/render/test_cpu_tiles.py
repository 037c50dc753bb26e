"""Views on a CPU, whose rays go side by side, against those of the march of CUDA on the same CPU; the densities of
cells that they read."""

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fields import BOX, make_field, plain, psnr, shiny_field, view

from warpcage import Cage, CageEdit, Camera, Deformer
from warpcage.core import launch
from warpcage.field import DensityWatch, spread_along, tables
from warpcage.kernels.field.occupancy import spread_distance

CPU = wp.get_device("cpu")
PARTS = ("rgb", "alpha", "reveal", "fold", "outside")


def by_threads(monkeypatch, make):
    """What `make` returns where a CPU marches as CUDA does."""
    with monkeypatch.context() as patch:
        patch.setattr(tables, "TILES_ON_CPU", False)
        return make()


def random_field(numbers, density_scale=0.8):
    return oracle.random_field(CPU, resolution=(34, 20, 41), keep=0.6, density_scale=density_scale, numbers=numbers)[0]


@oracle.both_kinds
@pytest.mark.parametrize(("width", "height"), [(1, 1), (9, 5), (31, 2), (40, 33)])
@pytest.mark.parametrize("eye", [(3.0, 1.6, 1.8), (0.3, 0.2, 0.4)])
def test_a_field_looks_as_it_does_ray_by_ray(width, height, eye, numbers, monkeypatch):
    field = random_field(numbers)
    camera = Camera.look_at(field.center + eye, field.center, width=width, height=height, fov_degrees=50)
    tiles, threads = field.render(camera), by_threads(monkeypatch, lambda: field.render(camera))
    assert tiles.alpha.max() > 0.3
    for part in ("rgb", "alpha", "depth"):
        np.testing.assert_allclose(getattr(tiles, part), getattr(threads, part), atol=3e-5, rtol=1e-5)


@pytest.mark.parametrize("density_scale", [1e-4, 1e6])
def test_thin_fog_and_solid_matter(density_scale, monkeypatch):
    """Samples that never weigh enough for a colour of their own, and ones that let nothing through."""
    field = random_field((9, 3), density_scale)
    camera = Camera.look_at(field.center + (3.0, 1.6, 1.8), field.center, width=24, height=20, fov_degrees=50)
    tiles, threads = field.render(camera), by_threads(monkeypatch, lambda: field.render(camera))
    np.testing.assert_allclose(tiles.rgb, threads.rgb, atol=3e-5)
    np.testing.assert_allclose(tiles.alpha, threads.alpha, atol=3e-6)


SLAB = Cage.box([-0.3, -0.9, -0.9], [0.9, 0.9, 0.9], segments=2)
CASES = {
    "bend": (BOX, BOX.bend(70, axis="x", towards="z"), {}),
    "twist that folds": (BOX, BOX.twist(230, axis="x"), {}),
    "squeeze": (BOX, BOX.scale([0.2, 1.3, 1.0]).translate([0.2, 0, 0.1]), {}),
    "part of it, kept": (SLAB, SLAB.rotate(25, axis="x").translate([0.5, 0, 0.2]), {"keep_source": True}),
    "part of it, moved": (SLAB, SLAB.rotate(25, axis="x").translate([0.5, 0, 0.2]), {}),
    "part of it, removed": (SLAB, None, {"remove": True}),
    "beside the field": (BOX.translate([4, 0, 0]), BOX.translate([4, 2, 0]), {}),
}


@pytest.mark.parametrize("case", CASES)
def test_an_edit_looks_as_it_does_ray_by_ray(case, monkeypatch):
    """But for a sample here and there that lies on a wall, which rounding puts on either side of it."""
    rest, pose, options = CASES[case]
    field, camera = shiny_field(CPU), view(size=45)

    def frame():
        return Deformer(field, CageEdit(rest, **options), coordinates="green", resolution=30).pose(pose).render(camera)

    tiles, threads = frame(), by_threads(monkeypatch, frame)
    assert tiles.alpha.max() > 0.5
    for part in PARTS:
        a, b = getattr(tiles, part), getattr(threads, part)
        assert (np.abs(a - b).reshape(45 * 45, -1).max(axis=1) > 1e-3).sum() <= 4, part
    assert psnr(tiles.rgb, threads.rgb) > 70


def test_rays_whose_first_sample_is_on_a_face_of_the_grid():
    """There rounding decides whether it is in the grid; all that is behind must be seen in any case."""
    field = make_field(lambda x: np.full(x.shape[:3], 9.0), plain([0.2, 0.6, 0.3]), device=CPU, resolution=32)
    deformer = Deformer(field, Cage.box((-0.3, -0.3, 2.7), (0.3, 0.3, 3.3)), resolution=12)
    face, step = np.array([field.bounds[1, 0] - 1 / 32, 0.5, 0.5]), 1 / 32
    along = np.array([0.8, 0.4, 0.45]) / np.linalg.norm([0.8, 0.4, 0.45])
    for k in range(40):
        eye = face + (k + oracle.SAMPLE_PLACE) * step * along
        camera = Camera.look_at(eye, face - along, width=1, height=1, fov_degrees=20)
        assert deformer.render(camera, step=step).alpha[0, 0] > 0.99


def test_densities_that_are_written_in_place_are_seen(monkeypatch):
    """The cells' copies follow, by one voxel and by all, in views of the field and of an edit."""
    field = random_field((9, 3))
    camera = Camera.look_at(field.center + (3.0, 1.6, 1.8), field.center, width=24, height=20, fov_degrees=50)
    deformer = Deformer(field, BOX, resolution=16).pose(BOX.twist(40))
    before = field.render(camera).rgb, deformer.render(camera).rgb
    density = field.grid.density.numpy()
    nodes = np.argsort(-density)[:200]
    for change in (0.5 * density[nodes], -density[nodes], np.full(200, 40.0)):
        density[nodes] = change
        now = field.render(camera).rgb, deformer.render(camera).rgb
        then = by_threads(monkeypatch, lambda: field.render(camera).rgb)
        np.testing.assert_allclose(now[0], then, atol=3e-5)
        fresh = Deformer(field, BOX, resolution=16).pose(BOX.twist(40)).render(camera).rgb
        np.testing.assert_allclose(now[1], fresh, atol=3e-5)
        assert all(np.abs(a - b).max() > 1e-3 for a, b in zip(now, before, strict=True))


def test_cells_hold_the_densities_of_their_corners():
    field = random_field((9, 3))
    grid = field.marching.grid()
    cells = field.marching.cells(grid)
    skip, links = grid.skip.numpy(), grid.links.numpy()
    density = np.append(grid.density.numpy(), 0.0)  # -1: no row
    filled = np.argwhere(skip == 0)
    blocks, records = cells.blocks.numpy(), cells.densities.numpy()
    assert len(filled) == len(records) > 1000
    columns, places = filled[:, 0] * skip.shape[1] + filled[:, 1], filled[:, 2]
    entries = blocks[columns, places // 32].astype(np.int64)
    bits = entries[:, 0] & 0xFFFFFFFF
    assert ((bits >> (places % 32)) & 1).all()
    below = np.array([int(b & ((1 << int(p % 32)) - 1)).bit_count() for b, p in zip(bits, places, strict=True)])
    order = entries[:, 1] + below
    assert sorted(order) == list(range(len(records)))
    for corner in range(8):
        i, j, k = (filled + [(corner >> 1) & 1, corner & 1, corner >> 2]).T
        np.testing.assert_array_equal(records[order, corner], density[links[i, j, k]])


def test_any_bit_of_a_density_is_news():
    values = np.zeros(3000, np.float32)
    density = wp.array(values, device="cpu")
    watch = DensityWatch()
    seen = [watch.has_changed(density), watch.has_changed(density)]
    for place, value in ((0, 1e-45), (1023, 5.0), (1024, np.nan), (2999, -0.0), (2999, -0.0), (1024, 0.0)):
        density.numpy()[place] = value
        seen.append(watch.has_changed(density))
    assert seen == [True, False, True, True, True, True, False, True]
    assert watch.version == sum(seen)
    assert watch.has_changed(wp.zeros(7, dtype=wp.float32, device="cpu"))


@pytest.mark.parametrize("shape", [(1, 1, 1), (7, 1, 70), (1, 40, 3), (23, 19, 33)])
@pytest.mark.parametrize("limit", [12, 32])
def test_distances_spread_by_lines_as_by_cells(shape, limit):
    marks = np.where(np.random.default_rng(limit).random(shape) < 0.01, 0, limit).astype(np.uint8)
    lines, cells = (wp.array(marks, dtype=wp.uint8, device="cpu") for _ in range(2))
    for axis in range(3):
        targets = wp.empty_like(lines), wp.empty_like(lines)
        spread_along(axis, lines, targets[0])
        launch(spread_distance, cells.size, [axis, cells], [targets[1]], device="cpu")
        lines, cells = targets
        np.testing.assert_array_equal(lines.numpy(), cells.numpy())
    places = np.argwhere(marks == 0)
    if len(places):
        everywhere = np.argwhere(np.ones(shape))
        nearest = np.abs(everywhere[:, None] - places[None]).max(axis=2).min(axis=1)
        np.testing.assert_array_equal(lines.numpy().ravel(), np.minimum(nearest, limit))
