"""What frames are made from instead of the field's own arrays: shaded voxels, packed rows, cells without matter."""

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fields import BOX, make_field, psnr, shiny_field, view
from ground_truth import synthetic_scene

import warpcage
from warpcage.core import launch
from warpcage.field import PACKED_UINT32S, ColumnTable, harmonics_on_host, row_table, shaded_grid, tables
from warpcage.kernels.field.densities import lay_densities

#: A camera among the voxels, one beside the field, one that looks at all of it.
EYES = {"within": (0.3, 0.2, 0.4), "beside": (1.6, 0.5, 0.3), "away": (3.0, 1.6, 1.8)}


@pytest.fixture(params=["shaded", "rows", "tiles"])
def path(request, monkeypatch):
    """All ways to a frame of the field itself, whatever its size; the third on a CPU alone."""
    shaded = request.param == "shaded"
    monkeypatch.setattr(tables, "NEAR_VOXELS", -1.0 if shaded else 1e9)
    monkeypatch.setattr(tables, "SHADED_ON_CPU", shaded)
    monkeypatch.setattr(tables, "TILES_ON_CPU", request.param == "tiles")
    return request.param


def random_field(device, numbers):
    return oracle.random_field(device, resolution=(24, 20, 22), keep=0.6, density_scale=0.8, numbers=numbers)


def camera_at(eye, field, size=9):
    return warpcage.Camera.look_at(field.center + eye, field.center, width=size, height=size, fov_degrees=50)


def brute_force(field, density, sh, camera):
    """(h, w, 3) float64 picture on black."""
    origins, d = camera.rays()
    pixels = np.ndindex(camera.height, camera.width)
    rays = [oracle.render_ray(field, density, sh, origins[p], d[p], field.step, (0, 0, 0)) for p in pixels]
    return np.array([ray[0] for ray in rays]).reshape(camera.height, camera.width, 3)


@oracle.both_kinds
@pytest.mark.parametrize("eye", ["away", "beside"])
def test_a_random_field_is_what_float64_sees(eye, numbers, path, device):
    """Colours that differ from voxel to voxel and from side to side as no scene's do."""
    field, density, sh = random_field(device, numbers)
    camera = camera_at(EYES[eye], field)
    # nearer than voxels are shaded for (NEAR_VOXELS), degree 3 changes more within one
    least = 50 if (eye, path, len(numbers)) == ("beside", "shaded", 1) else 55
    assert psnr(field.render(camera, background="black").rgb, brute_force(field, density, sh, camera)) > least


@pytest.mark.parametrize("eye", EYES)
def test_the_way_that_is_chosen_is_near_float64(eye, device):
    field, density, sh = random_field(device, (9, 3))
    camera = camera_at(EYES[eye], field)
    assert psnr(field.render(camera, background="black").rgb, brute_force(field, density, sh, camera)) > 55


@oracle.both_kinds
def test_a_deformed_frame_of_a_random_field_is_what_float64_sees(numbers, device):
    """A cage at rest: the field itself, by the kernels for one edit and for several, and evaluated at each sample."""
    field, density, sh = random_field(device, numbers)
    camera = camera_at(EYES["away"], field)
    truth = brute_force(field, density, sh, camera)
    cage = warpcage.Cage.box(*(field.bounds + [[-0.1], [0.1]]))
    for rest in (cage, [cage, cage]):
        deformer = warpcage.Deformer(field, rest, resolution=24)
        assert psnr(deformer.render(camera, background="black").rgb, truth) > 55
    precise = warpcage.Deformer(field, cage, coordinates="mean_value", resolution=None)
    assert psnr(precise.render(camera, background="black").rgb, truth) > 55


def permuted(field, seed=1):
    """The same field with its rows in another order."""
    grid, order = field.grid, np.random.default_rng(seed).permutation(field.voxel_count)
    links = grid.links.numpy()
    return warpcage.VoxelField(
        field.bounds,
        np.where(links >= 0, order[np.maximum(links, 0)], -1).astype(np.int32),
        grid.density.numpy()[np.argsort(order)],
        harmonics_on_host(grid.sh)[np.argsort(order)],
        device=field.device,
    )


def test_rows_in_any_order_make_the_same_frame(path, device):
    field = shiny_field(device)
    other = permuted(field)
    assert (
        other.marching.columns.columns.order.size == field.voxel_count and field.marching.columns.columns.order is None
    )
    np.testing.assert_array_equal(other.render(view()).rgb, field.render(view()).rgb)
    frames = [warpcage.Deformer(f, BOX, resolution=24).pose(BOX.twist(50)).render(view()) for f in (field, other)]
    np.testing.assert_array_equal(frames[0].rgb, frames[1].rgb)


# -- What was read before is not shown again


def fresh_frames(field, deformer, camera):
    """The frames of a new field that holds copies of the arrays as they are now."""
    grid = field.grid
    copies = [array.numpy() for array in (grid.links, grid.density)]
    new = warpcage.VoxelField(
        field.bounds, *copies, harmonics_on_host(grid.sh), device=field.device, **field.view_options()
    )
    posed = warpcage.Deformer(new, deformer.edits, resolution=deformer.resolution).pose(deformer.deformed)
    return new.render(camera).rgb, posed.render(camera).rgb


def lower_density(field):
    field.grid.density.assign(field.grid.density.numpy() * 0.2 - 0.4)


def raise_density(field):
    """Matter where there was none: cells that a march has skipped hold it now."""
    field.grid.density.assign(np.abs(field.grid.density.numpy()) + 2.0)


def change_colors(field):
    field.grid.sh.assign(-field.grid.sh.numpy())


def write_by_a_view(field):
    """Through an array that shares the memory, as those of other libraries do."""
    alias = wp.array(
        ptr=field.grid.density.ptr, dtype=wp.float32, shape=field.grid.density.shape, device=field.device, copy=False
    )
    alias.fill_(3.0)


def put_other_arrays(field):
    field.grid.density = wp.full(field.voxel_count, 2.5, dtype=wp.float32, device=field.device)


CHANGES = (lower_density, raise_density, change_colors, write_by_a_view, put_other_arrays)


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_a_frame_shows_the_arrays_as_they_are(change, path, device):
    """Also of a Deformer whose pose was made, and shown, before they changed."""
    field = shiny_field(device, resolution=24)
    field.grid.density.assign(field.grid.density.numpy() - 3.0)  # rows without matter, too
    camera = view(size=32)
    deformer = warpcage.Deformer(field, BOX, resolution=24).pose(BOX.bend(40))
    before = field.render(camera).rgb, deformer.render(camera).rgb
    change(field)
    after = field.render(camera).rgb, deformer.render(camera).rgb
    for old, new, truth in zip(before, after, fresh_frames(field, deformer, camera), strict=True):
        assert np.abs(new - old).max() > 0.05
        np.testing.assert_array_equal(new, truth)


def test_a_fit_shows_each_step(path, device):
    train, _ = synthetic_scene("bricks", train_views=6, test_views=1, size=24, samples=1, device=device)
    optimizer = warpcage.FieldOptimizer(train, device=device)
    camera, last = train.cameras[0], None
    for _ in range(3):
        optimizer.step()
        field = optimizer.field
        deformer = warpcage.Deformer(field, BOX, resolution=16)
        frames = field.render(camera).rgb, deformer.render(camera).rgb
        for frame, truth in zip(frames, fresh_frames(field, deformer, camera), strict=True):
            np.testing.assert_array_equal(frame, truth)
        assert last is None or np.abs(frames[0] - last).max() > 0
        last = frames[0]


# -- Fields at the edge


@pytest.mark.parametrize("value", [1e6, 1e30, -1e30, 1e-30])
def test_densities_beyond_any_half(value, path, device):
    """One voxel, opaque or nothing at all, and harmonics that no half holds."""
    density, sh = np.zeros((3, 3, 3)), np.zeros((3, 3, 3, 9, 3))
    density[1, 1, 1] = 1.0
    sh[..., 0, :] = [1.0, 0.5, -0.5]
    field = warpcage.VoxelField.from_dense(density, sh, [[-1] * 3, [1] * 3], background="black", device=device)
    seen = field.render(view(size=24)).rgb
    field.grid.density.assign(np.where(field.grid.density.numpy() > 0, np.float32(value), 0))
    frames = [field.render(view(size=24)), warpcage.Deformer(field, BOX, resolution=16).render(view(size=24))]
    for frame in frames:
        assert np.isfinite(frame.rgb).all() and np.isfinite(frame.alpha).all()
        assert frame.alpha.max() == pytest.approx(1.0 if value > 1 else 0.0, abs=2e-3)
        hit = frame.alpha > 0.99
        if value > 1:
            color = frame.rgb[hit] / frame.alpha[hit][:, None]
            assert np.abs(color - [0.5 + 0.2821, 0.5 + 0.141, 0.5 - 0.141]).max() < 4e-3
    assert seen.max() > 0.1


def test_harmonics_beyond_any_half_stay_numbers(path, device):
    field = shiny_field(device, resolution=12)
    field.grid.sh.assign(np.float32(3e5) * field.grid.sh.numpy())
    for frame in (field.render(view(size=24)), warpcage.Deformer(field, BOX, resolution=16).render(view(size=24))):
        assert np.isfinite(frame.rgb).all() and frame.rgb.max() > 1e3


@pytest.mark.parametrize("linked", [0, 1])
def test_fields_of_no_voxel_and_of_one(linked, path, device):
    links = np.full((2, 2, 2), -1, np.int32)
    links[0, 1, 0] = linked - 1
    field = warpcage.VoxelField(
        [[-1] * 3, [1] * 3], links, np.full(linked, 50.0), np.zeros((linked, 9, 3)), background="white", device=device
    )
    for frame in (field.render(view(size=24)), warpcage.Deformer(field, BOX, resolution=16).render(view(size=24))):
        assert np.isfinite(frame.rgb).all()
        assert (frame.alpha.max() > 0.9) == (linked == 1)


def test_columns_longer_than_a_block(path, device):
    """Bits of 31 nodes to a block: cells on both sides of a block's end, and a last block of one node."""
    for nz in (31, 32, 33, 63, 64):
        bounds = ((-0.15, -0.15, -1.6), (0.15, 0.15, 1.6))
        field, density, sh = oracle.random_field(device, (3, 3, nz), nz, 0.7, bounds, 3.0)
        camera = camera_at((2.5, 1.0, 0.4), field, size=13)
        truth = brute_force(field, density, sh, camera)
        assert psnr(field.render(camera, background="black").rgb, truth) > 55
        assert field.marching.columns.nodes.shape[0] == field.voxel_count


def test_densities_laid_out_by_node(device):
    """As halves of a unit, whatever the order of the rows; nodes without a row keep their 0."""
    random = np.random.default_rng(0)
    links = np.full((3, 4, 40), -1, np.int32)
    places = random.permutation(links.size)[:200]
    links.flat[places] = np.arange(200)
    density = (10.0 ** random.uniform(-3, 6, 200) * random.choice([-1, 1], 200)).astype(np.float32)
    table = ColumnTable(wp.array(links, dtype=wp.int32, device=device))
    laid = table.laid_densities()
    inputs = [wp.array(density, dtype=float, device=device), table.columns.order, table.nodes, 0.25]
    launch(lay_densities, 200, inputs, [laid], device=device)
    expected = np.zeros(links.size)
    expected[places] = np.clip(0.25 * density.astype(np.float64), -65504, 65504)
    np.testing.assert_allclose(laid.numpy(), expected, rtol=2**-11, atol=2**-25)


# -- Memory


def test_what_frames_hold_beside_the_field(device):
    """As benchmarks/NOTES-render.md has it: tables that stay, and what a frame takes for as long as it is made."""
    field = make_field(lambda x: np.ones(x.shape[:3]), lambda x: np.zeros((*x.shape[:3], 9, 3)), device=device)
    table = ColumnTable(field.grid.links)
    (nx, ny, nz), rows, is_cpu = field.resolution, field.voxel_count, field.device.is_cpu
    assert table.columns.blocks.capacity == nx * ny * -(-(nz - 1) // 31) * 8
    assert table.nodes.capacity == 4 * rows
    assert PACKED_UINT32S == 8
    rows_now = row_table(field.grid, table)
    for array, size in ((rows_now.packed, 32 * rows), (rows_now.laid, 2 * nx * ny * nz)):
        assert (array is None or array.size == 0) if is_cpu else array.capacity == size
    if not is_cpu:  # both stay
        again = row_table(field.grid, table)
        assert (again.packed.ptr, again.laid.ptr) == (rows_now.packed.ptr, rows_now.laid.ptr)
    colors = shaded_grid(field.grid, table, wp.vec3(9.0, 0.0, 0.0), field.step).colors
    assert colors.capacity == (16 if is_cpu else 8) * rows
