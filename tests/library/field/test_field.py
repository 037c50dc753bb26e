"""VoxelField: sampling, rendering and files against float64 NumPy."""

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from messages import MESSAGES
from refusals import refused

import warpcage
from warpcage.core import launch
from warpcage.deform import exact
from warpcage.field import harmonics_on_device, harmonics_on_host
from warpcage.kernels.field import harmonics as spherical_harmonics
from warpcage.kernels.field import refine


@wp.kernel
def evaluate_basis(directions: wp.array(dtype=wp.vec3), values: wp.array2d(dtype=wp.float32)):
    n = wp.tid()
    basis = spherical_harmonics.sh_basis(directions[n])
    for b in range(16):
        values[n, b] = basis[b]


def directions_of(count, seed=1):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_basis_is_the_real_spherical_harmonics(device):
    d = directions_of(200)
    values = wp.empty((200, 16), dtype=wp.float32, device=device)
    wp.launch(
        evaluate_basis, dim=200, inputs=[wp.array(d, dtype=wp.vec3, device=device)], outputs=[values], device=device
    )
    expected = oracle.basis(d, 4)
    np.testing.assert_allclose(values.numpy(), expected, atol=2e-6)


@pytest.mark.parametrize("shape", [(301, 24), (301, 9, 3), (0, 24)])
def test_halves_stay_halves_on_a_gpu(device, shape):
    """As files have them: the smallest, the largest, and without order in memory. CPUs have them as single."""
    random = np.random.default_rng(0)
    sh = (random.normal(size=shape) * 10.0 ** random.uniform(-7, 4, shape)).astype(np.float16)
    expected = harmonics_on_device(sh.astype(np.float32), wp.get_device(device))
    for given in (sh, np.asfortranarray(sh)):
        found = harmonics_on_device(given, wp.get_device(device))
        assert found.dtype == (wp.float32 if found.device.is_cpu else wp.float16)
        assert found.shape == expected.shape and str(found.device) == device
        assert np.array_equal(found.numpy(), expected.numpy())
    rows = sh.reshape(len(sh), np.prod(shape[1:]))
    runs = wp.array(rows, dtype=wp.float16, device=device)
    singles = wp.full(runs.shape, 7.0, dtype=wp.float32, device=device)
    launch(refine.widen_rows, runs.size // int(refine.RUN), [runs], [singles], device=device)
    assert np.array_equal(singles.numpy(), rows.astype(np.float32))


@oracle.both_kinds
def test_harmonics_of_files_are_the_same_as_halves_and_as_single(numbers, device, tmp_path, monkeypatch):
    """A GPU holds the halves of a file until someone asks for the grid; nothing that is seen or saved changes then."""
    monkeypatch.setattr(exact, "GUIDE_RESOLUTION", 32)  # a finer guide takes most of the time
    made, _, _ = oracle.random_field(device, numbers=numbers)
    made.save(tmp_path / "made.npz")
    field = warpcage.VoxelField.load(tmp_path / "made.npz", device=device)
    assert (field.stored.halves is None) == (field.stored.links is not None) == field.device.is_cpu
    random = np.random.default_rng(5)
    points, along = random.uniform(*field.bounds, (2000, 3)), directions_of(2000)
    camera = warpcage.Camera.look_at(field.center + 4.0, field.center, fov_degrees=20, width=32, height=32)
    near = warpcage.Camera.look_at(field.center + 0.1, field.center, fov_degrees=60, width=32, height=32)
    cage = warpcage.Cage.box(*(field.center + 0.8 * (field.bounds - field.center)))

    def seen(name):
        posed = warpcage.Deformer(field, cage, coordinates="mean_value", resolution=16).pose(cage.twist(20))
        exact = warpcage.Deformer(field, cage, coordinates="mean_value", resolution=None).pose(cage.twist(20))
        field.save(tmp_path / name)
        shown = [each.render(view).rgb for each in (field, posed) for view in (camera, near)]
        baked = warpcage.bake(posed, 12)
        return [*shown, exact.render(camera).rgb, *field.sample(points, along), baked.grid.sh.numpy()]

    before = seen("halves.npz")
    moved = field.to("cpu")
    single = field.grid
    assert single.sh.dtype == wp.float32 and field.stored.halves is None
    np.testing.assert_array_equal(moved.grid.sh.numpy(), single.sh.numpy())
    np.testing.assert_array_equal(single.sh.numpy().astype(np.float16), single.sh.numpy())
    for as_halves, as_single in zip(before, seen("single.npz"), strict=True):
        assert np.abs(as_halves).max() > 0
        np.testing.assert_allclose(as_halves, as_single, atol=1e-6)
    archives = [np.load(tmp_path / f"{name}.npz") for name in ("made", "halves", "single")]
    for name in archives[0].files:
        for archive in archives[1:]:
            np.testing.assert_array_equal(archive[name], archives[0][name])


def test_links_come_back_from_rows_as_bits(device):
    """Rows in any order, and such as several nodes share."""
    field, _, _ = oracle.random_field(device, resolution=(6, 35, 64), keep=0.4)
    links = field.grid.links.numpy()
    links[links >= 0] = np.random.default_rng(2).permutation(field.voxel_count)
    links[3, :, 7] = 5
    values = field.grid.density.numpy(), harmonics_on_host(field.grid.sh)
    whole = warpcage.VoxelField(field.bounds, wp.array(links, device=device), *values, device=device)
    skip = whole.grid.skip.numpy()
    whole.marching.drop_links()
    assert whole.stored.links is None and whole.stored.skip is None
    np.testing.assert_array_equal(whole.host_links(), links)
    np.testing.assert_array_equal(whole.host_links(3), links[::3, ::3, ::3])
    assert whole.stored.links is None
    np.testing.assert_array_equal(whole.grid.links.numpy(), links)
    np.testing.assert_array_equal(whole.grid.skip.numpy(), skip)


@oracle.both_kinds
def test_sample_matches_numpy_inside_and_outside(numbers, device):
    field, density, sh = oracle.random_field(device, numbers=numbers)
    random = np.random.default_rng(3)
    points = random.uniform(field.bounds[0] - 0.3, field.bounds[1] + 0.3, (4000, 3))
    d = directions_of(4000)
    rgb, sigma = field.sample(points, d)
    expected_rgb, expected_sigma = oracle.sample(field, density, sh, points, d)
    # a point within float32 of the outermost node planes may fall on either side
    g = (points - field.bounds[0]) / field.voxel_size - 0.5
    clear = np.abs(g - np.round(g)).min(axis=1) > 1e-5
    np.testing.assert_allclose(sigma[clear], expected_sigma[clear], atol=2e-4)
    np.testing.assert_allclose(rgb[clear], expected_rgb[clear], atol=2e-4)
    assert clear.mean() > 0.99 and (expected_sigma > 0).mean() > 0.1


def test_sample_takes_device_arrays_and_returns_them(device):
    field, _, _ = oracle.random_field(device)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (10, 3)).astype(np.float32)
    d = directions_of(10).astype(np.float32)
    rgb, sigma = field.sample(wp.array(points, dtype=wp.vec3, device=device), wp.array(d, dtype=wp.vec3, device=device))
    assert isinstance(rgb, wp.array) and isinstance(sigma, wp.array) and str(rgb.device) == device
    np.testing.assert_allclose(rgb.numpy(), field.sample(points, d)[0], atol=1e-5)


@oracle.both_kinds
@pytest.mark.parametrize("shift", [0.0, 1e5])
def test_render_matches_brute_force_march(device, shift, numbers):
    field, density, sh = oracle.random_field(device, keep=0.3, numbers=numbers)
    grid = field.grid
    moved = warpcage.VoxelField(field.bounds + shift, grid.links, grid.density, grid.sh, device=device)
    camera = warpcage.Camera.look_at(moved.center + [3.0, 1.0, 1.5], moved.center, fov_degrees=40, width=9, height=7)
    background = (0.2, 0.4, 0.9)
    frame = moved.render(camera, background=background)
    origins, d = camera.rays()
    for row, column in [(0, 0), (3, 4), (2, 5), (6, 8), (4, 2)]:
        rgb, alpha, depth = oracle.render_ray(
            moved, density, sh, origins[row, column], d[row, column], moved.step, background
        )
        # early termination leaves at most 1e-3 of the light
        np.testing.assert_allclose(frame.rgb[row, column], rgb, atol=3e-3)
        assert abs(frame.alpha[row, column] - alpha) < 2e-3
        if np.isfinite(depth):
            assert abs(frame.depth[row, column] - depth) < 2e-2
            assert abs(frame.disparity[row, column] * frame.depth[row, column] - 1) < 1e-5
    assert frame.alpha.max() > 0.5


def test_skip_distances_are_chebyshev(device):
    field, _, _ = oracle.random_field(device, resolution=(14, 11, 17), keep=0.004, seed=5)
    links = field.grid.links.numpy()
    occupied = np.zeros(tuple(n - 1 for n in links.shape), bool)
    for corner in np.ndindex(2, 2, 2):
        occupied |= links[tuple(slice(c, c + n) for c, n in zip(corner, occupied.shape, strict=True))] >= 0
    cells = np.argwhere(np.ones_like(occupied))
    nearest = np.abs(cells[:, None] - np.argwhere(occupied)[None]).max(axis=2).min(axis=1)
    assert nearest.max() > 4
    np.testing.assert_array_equal(field.grid.skip.numpy().ravel(), nearest)


@oracle.both_kinds
def test_own_file_round_trip(numbers, device, tmp_path):
    field, _, _ = oracle.random_field(device, numbers=numbers)
    field.weights = wp.array(np.random.default_rng(0).random(field.voxel_count), dtype=wp.float32, device=device)
    field.save(tmp_path / "f.npz")
    again = warpcage.VoxelField.load(tmp_path / "f.npz", device=device)
    np.testing.assert_array_equal(again.bounds, field.bounds)
    np.testing.assert_array_equal(again.background, field.background)
    np.testing.assert_array_equal(again.node_densities(), field.node_densities())
    np.testing.assert_allclose(again.grid.sh.numpy(), field.grid.sh.numpy(), rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(again.node_weights(), field.node_weights(), rtol=1e-3)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f.npz"]


@oracle.both_kinds
def test_compact_file_is_small_and_close(numbers, device, tmp_path):
    field, _, _ = oracle.random_field(device, resolution=(30, 30, 30), density_scale=1.0, numbers=numbers)
    field.weights = wp.array(np.random.default_rng(0).random(field.voxel_count), dtype=wp.float32, device=device)
    field.save(tmp_path / "f.npz")
    field.save(tmp_path / "c.npz", format="compact")
    assert (tmp_path / "c.npz").stat().st_size < 0.6 * (tmp_path / "f.npz").stat().st_size  # of random numbers
    again = warpcage.VoxelField.load(tmp_path / "c.npz", device=device)
    assert np.abs(again.grid.sh.numpy() - field.grid.sh.numpy()).max() < 1 / 256 + 1e-3
    np.testing.assert_allclose(again.node_densities(), field.node_densities(), rtol=2**-6, atol=1e-6)
    np.testing.assert_allclose(again.node_weights(), field.node_weights(), atol=5e-3)
    camera = warpcage.Camera.look_at(field.center + [3.0, 1.0, 1.5], field.center, width=32, height=32)
    assert warpcage.psnr(again.render(camera).rgb, field.render(camera).rgb) > 45


def test_a_svox2_file_of_luminance_lacks_its_third_degree_alone(device, tmp_path):
    field, density, sh = oracle.random_field(device, numbers=(24,))
    with pytest.warns(UserWarning, match="degree 3"):
        field.save(tmp_path / "p.npz", format="svox2")
    d = directions_of(300)
    points = np.random.default_rng(1).uniform(field.bounds[0], field.bounds[1], (300, 3))
    again = warpcage.VoxelField.load(tmp_path / "p.npz", device=device)
    np.testing.assert_allclose(
        again.sample(points, d)[0],
        oracle.sample(field, density, sh * ~np.isin(np.arange(24), range(9, 16)), points, d)[0],
        atol=4e-3,
    )


def test_svox2_file_round_trip_and_scene_scale(device, tmp_path):
    field, _, _ = oracle.random_field(device)
    field.save(tmp_path / "p.npz", format="svox2")
    with np.load(tmp_path / "p.npz") as archive:
        assert {"radius", "center", "links", "density_data", "sh_data", "basis_type"} <= set(archive.files)
        assert archive["sh_data"].shape == (field.voxel_count, 27) and archive["sh_data"].dtype == np.float16
        # each colour's coefficients stand together
        np.testing.assert_allclose(archive["sh_data"][:, 9:18], field.grid.sh.numpy()[:, 9:18], rtol=1e-3, atol=1e-6)
    d = directions_of(300)
    points = np.random.default_rng(1).uniform(field.bounds[0], field.bounds[1], (300, 3))
    rgb, sigma = field.sample(points, d)
    again = warpcage.VoxelField.load(tmp_path / "p.npz", device=device)
    np.testing.assert_allclose(again.bounds, field.bounds, atol=1e-6)
    np.testing.assert_allclose(again.sample(points, d)[0], rgb, atol=4e-3)
    scaled = warpcage.VoxelField.load(tmp_path / "p.npz", scene_scale=0.5, device=device)
    np.testing.assert_allclose(scaled.sample(2 * points, d)[1], 0.5 * sigma, atol=1e-2)


def test_background_layers_of_a_svox2_file_are_left_out_with_a_warning(tmp_path, device):
    field, _, _ = oracle.random_field(device)
    field.save(tmp_path / "p.npz", format="svox2")
    with np.load(tmp_path / "p.npz") as archive:
        contents = dict(archive)
    layers = {"background_links": np.zeros((8, 4), np.int32), "background_data": np.zeros((1, 16, 4), np.float32)}
    np.savez(tmp_path / "layers.npz", **contents, **layers)
    with pytest.warns(UserWarning, match=MESSAGES["field.layers_left_out"]) as caught:
        again = warpcage.VoxelField.load(tmp_path / "layers.npz", device=device)
    assert caught[0].filename == __file__
    assert again.background_model is None and again.voxel_count == field.voxel_count


def test_from_dense_keeps_what_interpolation_reaches(device):
    density = np.zeros((6, 6, 6))
    density[3, 3, 3] = 2.0
    sh = np.random.default_rng(0).normal(size=(6, 6, 6, 9, 3))
    field = warpcage.VoxelField.from_dense(density, sh, [[0, 0, 0], [6, 6, 6]], device=device)
    assert field.voxel_count == 27
    points = np.random.default_rng(1).uniform(2.6, 4.4, (500, 3))
    d = directions_of(500)
    expected = oracle.sample(field, density, sh, points, d)
    rgb, sigma = field.sample(points, d)
    np.testing.assert_allclose(sigma, expected[1], atol=1e-5)
    np.testing.assert_allclose(rgb, expected[0], atol=1e-4)


@pytest.mark.parametrize(
    "contents, message",
    [
        ({"a": np.zeros(2)}, "neither"),
        ({"format": "warpcage", "version": 99}, "version 99"),
        ({"format": "warpcage", "version": 1}, "lacks"),
    ],
)
def test_bad_files_are_named(tmp_path, contents, message):
    np.savez(tmp_path / "bad.npz", **contents)
    refused(lambda: warpcage.VoxelField.load(tmp_path / "bad.npz"), match=message)


def test_file_errors(tmp_path):
    refused(lambda: warpcage.VoxelField.load(tmp_path / "none.npz"), match="is not there", error=FileNotFoundError)
    (tmp_path / "text.npz").write_text("hello")
    refused(lambda: warpcage.VoxelField.load(tmp_path / "text.npz"), match="is not an .npz")
    field, _, _ = oracle.random_field(None)
    refused(lambda: field.save(tmp_path / "f.pt"), match="ends in .npz")
    refused(lambda: field.save(tmp_path / "f.npz", format="ply"), match="not known")
    assert [p.name for p in tmp_path.iterdir()] == ["text.npz"]


def test_bad_constructions():
    links = np.zeros((2, 2, 2), np.int32)
    refused(lambda: warpcage.VoxelField([[0, 0, 0], [1, 1, 0]], links, [1.0], np.zeros((1, 9, 3))), match="bounds")
    refused(lambda: warpcage.VoxelField([[0, 0, 0], [1, 1, 1]], links, [1.0], np.zeros((1, 4, 3))), match="9, 3")
    field, _, _ = oracle.random_field(None)
    refused(lambda: field.sample(np.zeros((2, 3)), np.ones((3, 3))), match="as many")
    refused(lambda: field.sample([[np.nan, 0, 0]], [[0, 0, 1]]), match="finite")
    refused(lambda: field.render(warpcage.Camera.look_at([3, 0, 0], [0, 0, 0]), step=0.0), match="step")
    with pytest.raises(ValueError, match="step must be positive and finite"):
        field.render(warpcage.Camera.look_at([3, 0, 0], [0, 0, 0]), step=np.inf)


@pytest.mark.parametrize("side", [2, 3])
def test_supersampling_is_the_area_average(device, side):
    field, _, _ = oracle.random_field(device)
    camera = warpcage.Camera.look_at([3.0, 0.4, 0.5], [0, 0, 0.3], fov_degrees=60, width=13, height=9)
    fine = warpcage.Camera.look_at([3.0, 0.4, 0.5], [0, 0, 0.3], fov_degrees=60, width=13 * side, height=9 * side)
    parts, whole = field.render(fine), field.render(camera, supersampling=side)
    for name in ("rgb", "alpha"):
        values = getattr(parts, name)
        expected = values.reshape(9, side, 13, side, *values.shape[2:]).mean(axis=(1, 3))
        np.testing.assert_allclose(getattr(whole, name), expected, atol=1e-6)
    depth, alpha = (
        v.reshape(9, side, 13, side).transpose(0, 2, 1, 3).reshape(9, 13, -1) for v in (parts.depth, parts.alpha)
    )
    weight = np.where(np.isfinite(depth), alpha, 0).astype(np.float64)
    seen = weight.sum(axis=-1) > 0
    expected = (weight * np.where(weight > 0, depth, 0)).sum(axis=-1)[seen] / weight.sum(axis=-1)[seen]
    np.testing.assert_allclose(whole.depth[seen], expected, rtol=1e-5)
    assert np.isinf(whole.depth[~seen]).all() and seen.any() and not seen.all()


def test_a_field_keeps_its_supersampling(device, tmp_path):
    field, _, _ = oracle.random_field(device)
    camera = warpcage.Camera.look_at([3.0, 0.4, 0.5], [0, 0, 0.3], fov_degrees=60, width=13, height=9)
    field.supersampling = 2
    for format in ("warpcage", "compact"):
        field.save(tmp_path / "f.npz", format=format)
        assert warpcage.VoxelField.load(tmp_path / "f.npz", device=device).supersampling == 2
    np.testing.assert_array_equal(field.render(camera).rgb, field.render(camera, supersampling=2).rgb)
    assert np.abs(field.render(camera).rgb - field.render(camera, supersampling=1).rgb).max() > 0.01
    cage = warpcage.Cage.box(field.bounds[0] - 1, field.bounds[1] + 1)
    deformed = warpcage.Deformer(field, cage, resolution=16).render(camera)  # at rest
    assert warpcage.psnr(deformed.rgb, field.render(camera).rgb) > 45
    for wrong in (0, 9, 1.5, True):
        with pytest.raises(ValueError, match="supersampling"):
            field.render(camera, supersampling=wrong)
    with pytest.raises(ValueError, match="antialias is for splats"):
        warpcage.Deformer(field, cage, resolution=16).render(camera, antialias=True)


def test_another_march_through_a_field_is_warned_of(device):
    """By the old `render_by`, which fills a picture by whatever march it is given."""
    field = oracle.random_field(device)[0]
    camera = warpcage.Camera.look_at([3, 0, 0], [0, 0, 0], width=5, height=4)

    def begin():
        def march(threads, pinhole, color, make_arrays):
            arrays = make_arrays()
            assert threads >= 20 and pinhole.width == 5 and set(arrays) == {"rgb", "alpha", "depth", "fold"}
            for name, array in arrays.items():
                array.fill_(wp.vec3(0.25, 0.5, 0.75) if name == "rgb" else 0.5)

        return march

    with pytest.warns(UserWarning, match="render_by goes with"):
        frame = field.render_by(begin, camera, masks=("fold",))
    np.testing.assert_array_equal(frame.rgb, np.broadcast_to(np.float32([0.25, 0.5, 0.75]), (4, 5, 3)))
    assert (frame.fold == 0.5).all() and (frame.alpha == 0.5).all()
