"""Gradients of a fit against finite differences, and the optimiser's step against NumPy."""

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fit_oracles import counted_views, gradient_rows, photometric_gradient, training_rays, two_cameras

import warpcage
from warpcage.kernels.fitting import background_loss
from warpcage.kernels.fitting import rmsprop as field_step


def small_field(device):
    size = {"resolution": (5, 5, 5), "bounds": ((-1,) * 3, (1,) * 3)}
    return oracle.random_field(device, keep=0.7, density_scale=1.0, numbers=(24,), **size)


def test_photometric_gradient_matches_finite_differences(device):
    field, density, sh = small_field(device)
    cameras = two_cameras()
    random = np.random.default_rng(0)
    images, alphas = random.random((2, 6, 8, 3)), np.ones((2, 6, 8))
    images = images.astype(np.float16).astype(np.float64)
    rays = training_rays(cameras, images, alphas, field, device)
    background = (0.3, 0.6, 0.1)
    scale = 1 / (3 * 96)
    gradients, error = photometric_gradient(field, rays, 96, background=background, scale=scale)

    def loss(density, sh):
        total = 0.0
        for camera, image in zip(cameras, images, strict=True):
            origins, directions = camera.rays()
            for pixel in np.ndindex(6, 8):
                ray = origins[pixel], directions[pixel], field.step, background
                rgb, _, _ = oracle.render_ray(field, density, sh, *ray, length=6.0)
                total += ((rgb - image[pixel]) ** 2).sum()
        return total * scale

    assert abs(error.sum() * scale - loss(density, sh)) < 1e-5
    links = field.grid.links.numpy()
    nodes = random.permutation(np.argwhere(links >= 0))[:6]
    for values, choices in (
        (density, [()] * 6),
        (sh, [(random.integers(16),), (random.integers(16, 20),), (random.integers(20, 24),)]),
    ):
        for node, choice in zip(map(tuple, nodes), choices, strict=False):
            number = 24 if choice == () else choice[0]
            difference = []
            for sign in (1, -1):
                changed = values.copy()
                changed[(*node, *choice)] += sign * 1e-4
                difference.append(loss(changed, sh) if values is density else loss(density, changed))
            expected = (difference[0] - difference[1]) / 2e-4
            largest = np.abs(gradients[:, 24] if choice == () else gradients[:, :24]).max()
            assert abs(gradients[links[node], number] - expected) < 1e-3 * largest + 1e-3 * abs(expected)


def test_gradient_of_subrays_matches_finite_differences(device):
    field, _, _ = small_field(device)
    camera = two_cameras()[0]
    random = np.random.default_rng(0)
    rays = training_rays([camera], random.random((1, 6, 8, 3)), np.ones((1, 6, 8)), field, device, 2)
    field.grid.density.assign(np.abs(field.grid.density.numpy()) + 0.2)  # differences stay clear of the ReLU's kink
    gradients, _ = photometric_gradient(field, rays, 48, seed=4)
    coefficients, density = field.grid.sh, field.grid.density
    for array, numbers in ((coefficients, [(3, 0), (10, 13), (15, 18), (20, 22)]), (density, [(5,), (16,)])):
        values = array.numpy().copy()
        for index in numbers:
            ends = []
            for sign in (1, -1):
                changed = values.copy()
                changed[index] += sign * 5e-3
                array.assign(changed)
                ends.append(photometric_gradient(field, rays, 48, seed=4)[1].astype(np.float64).sum())
            array.assign(values)
            found = gradients[index[0], index[1] if len(index) == 2 else 24]
            assert abs(found - (ends[0] - ends[1]) / 1e-2) < 2e-2 * abs(found) + 2e-3


@pytest.mark.parametrize("density_scale", [0.05, 1.5, 30.0])  # more samples of a ray than are kept, and fewer
@pytest.mark.parametrize("side", [1, 2])
def test_gradient_by_warps_is_the_same(device, side, density_scale):
    if device == "cpu":
        pytest.skip("warp shuffles: CUDA only")
    resolution = (40, 36, 44)
    options = {"resolution": resolution, "keep": 0.6, "density_scale": density_scale, "numbers": (24,)}
    field, _, _ = oracle.random_field(device, **options)
    eyes, lens = ([3.0, 0.4, 0.5], [-1.0, 2.5, 1.2], [0.1, 0.2, 0.3]), {"fov_degrees": 60, "width": 7, "height": 5}
    cameras = [warpcage.Camera.look_at(eye, [0, 0, 0.3], **lens) for eye in eyes]
    random = np.random.default_rng(0)
    rays = training_rays(cameras, random.random((3, 5, 7, 3)), random.random((3, 5, 7)), field, device, side)
    options = {"random_background": 1, "seed": 5, "stop": 1e-4}
    expected, expected_error = photometric_gradient(field, rays, 144, **options)
    found, found_error = photometric_gradient(field, rays, 144, by_warps=True, **options)
    np.testing.assert_allclose(found_error, expected_error, atol=2e-4, rtol=2e-4)  # marches end at other samples
    assert (np.abs(found - expected) < 1e-3 * np.abs(expected).max(axis=0)).all()


def test_subrays_fill_their_pixel(device):
    """Four rays a pixel are nearer to the area's average than to the middle."""
    field, _, _ = oracle.random_field(device, bounds=((-1,) * 3, (1,) * 3), density_scale=1.0, numbers=(24,))
    camera = two_cameras()[0]
    fine = warpcage.Camera.look_at([3.0, 0.4, 0.5], [0, 0, 0], fov_degrees=38, width=64, height=48)
    whole = field.render(fine, background="white").rgb.reshape(6, 8, 8, 8, 3).mean(axis=(1, 3))
    middle = field.render(camera, background="white").rgb
    assert np.abs(middle - whole).max() > 0.02
    rays = training_rays([camera], whole[None], np.ones((1, 6, 8)), field, device, 2)
    errors = np.mean([photometric_gradient(field, rays, 48, seed=seed)[1] for seed in range(40)], axis=0)
    rays = training_rays([camera], middle[None], np.ones((1, 6, 8)), field, device, 2)
    errors_of_middles = np.mean([photometric_gradient(field, rays, 48, seed=seed)[1] for seed in range(40)], axis=0)
    assert errors.mean() < 0.5 * errors_of_middles.mean()


def test_random_backgrounds_reward_the_right_alpha(device):
    """With the image's own colour and alpha rendered, no background leaves an error; with another alpha, all do."""
    field, _, _ = oracle.random_field(device, bounds=((-1,) * 3, (1,) * 3), numbers=(24,))
    cameras = [two_cameras()[0]]
    frame = field.render(cameras[0], background="black")
    seen = frame.rgb + (1 - frame.alpha[..., None])  # composited on white
    for alphas, right in ((frame.alpha, True), (0.5 * frame.alpha, False)):
        rays = training_rays(cameras, seen[None] if right else (seen - 1 + 1)[None], alphas[None], field, device)
        error = photometric_gradient(field, rays, 48, random_background=1, seed=7, stop=1e-3)[1]
        assert (error.mean() < 1e-5) == right


@pytest.mark.parametrize("counted", [False, True])
def test_variation_gradient_matches_finite_differences(device, counted):
    field, density, sh = oracle.random_field(device, resolution=(5, 4, 6), keep=0.6, numbers=(24,))
    links = field.grid.links.numpy()
    nodes = np.argwhere(links >= 0).astype(np.int32)
    rows = field.voxel_count
    gradients = wp.zeros(25 * rows, dtype=wp.float32, device=device)
    touched = wp.zeros(rows, dtype=wp.uint8, device=device)
    unit, scale_density, scale_sh, scale_high_degree = 0.7, 0.3, 0.2, 0.9
    views, factors, arrays = counted_views(rows, device)
    by_row = factors[views] if counted else np.ones((rows, 2))
    flat = np.flatnonzero(links >= 0)
    inputs = [0, field.grid, wp.array(flat, dtype=wp.int32, device=device), 3, unit, scale_density, scale_sh]
    inputs += [scale_high_degree, *(arrays if counted else (None, None))]
    kernel, outputs = field_step.accumulate_variation_gradient, [gradients, touched]
    wp.launch(kernel, dim=25 * rows, device=device, inputs=inputs, outputs=outputs)
    gradients = gradient_rows(gradients)
    assert touched.numpy().all()

    def variation(values, kind):  # values (nx, ny, nz, c): differences to nodes without a row count as zero
        total = 0.0
        for node, factor in zip(nodes, by_row[:, kind], strict=True):
            squares = 0.0
            for axis in range(3):
                other = node.copy()
                other[axis] += 1
                if other[axis] < links.shape[axis] and links[tuple(other)] >= 0:
                    squares = squares + (values[tuple(other)] - values[tuple(node)]) ** 2
            total += factor * (np.sqrt(squares + 1e-9).sum() if np.ndim(squares) else np.sqrt(1e-9) * values.shape[-1])
        return total

    for row in (0, rows // 2, rows - 1):
        node = tuple(nodes[row])
        for values, gradient, scale, index in (
            (density[..., None] / unit, gradients[row, 24], scale_density / unit, 0),
            (sh, gradients[row, 0], scale_sh, 0),
            (sh, gradients[row, 14], scale_high_degree, 14),
            (sh, gradients[row, 20], scale_sh, 20),
            (sh, gradients[row, 3], scale_sh, 3),
            (sh, gradients[row, 23], scale_sh, 23),
        ):
            difference = []
            for sign in (1, -1):
                changed = values.copy()
                changed[(*node, index)] += sign * 1e-5
                difference.append(variation(changed, 1 if values is sh else 0))
            np.testing.assert_allclose(gradient, scale * (difference[0] - difference[1]) / 2e-5, rtol=2e-3, atol=1e-4)


def test_rmsprop_step_matches_numpy(device):
    random = np.random.default_rng(0)
    values, moments = random.normal(size=(12, 25)), np.zeros((12, 25))
    density = wp.array(values[:, 24].astype(np.float32), device=device)
    coefficients = wp.array(values[:, :24].reshape(12, 6, 4).astype(np.float32), dtype=wp.vec4, device=device)
    held = [wp.zeros(12, dtype=wp.bfloat16, device=device)]
    held.append(wp.zeros((12, 6), dtype=field_step.four_bfloats, device=device))
    rates = np.full(25, 0.7)  # by degree: Y of 0 to 3, then O and G of 0 and 1; density
    degrees = [0] + [1] * 3 + [2] * 5 + [3] * 7 + [0, 1, 1, 1] * 2
    rates[:24] = np.array([0.5, 0.2, 0.1, 0.05])[degrees]
    for _ in range(3):
        g = np.where(random.random((12, 25)) < 0.3, 0.0, random.normal(size=(12, 25)))
        g[3:5] = 0
        slopes = wp.array(g[:, 24].astype(np.float32), device=device)
        gradients = wp.array(g[:, :24].reshape(12, 6, 4).astype(np.float32), dtype=wp.vec4, device=device)
        touched = wp.array((g != 0).any(axis=1).astype(np.uint8), device=device)
        numbers = [0, 0.7, wp.vec4(0.5, 0.2, 0.1, 0.05), 0.9, 1e-12, 1e-12]
        inputs, outputs = [*numbers, touched, slopes, gradients, *held], [density, coefficients]
        wp.launch(field_step.apply_rmsprop, dim=12 * 7, device=device, inputs=inputs, outputs=outputs)
        assert not (gradients.numpy().any() or slopes.numpy().any())
        v = np.where(moments == 0, g * g, 0.9 * moments + 0.1 * g * g)
        moments = np.where(g != 0, v, moments)
        values -= np.where(g != 0, rates * g / (np.sqrt(np.where(v > 0, v, 1)) + 1e-12), 0)
    np.testing.assert_allclose(coefficients.numpy().reshape(12, 24), values[:, :24], atol=1e-2)
    np.testing.assert_allclose(density.numpy(), values[:, 24], atol=1e-2)


def test_layers_and_voxels_step_alike(device):
    """Both kernels take the first step to the bit, and the layers' next ones follow NumPy."""
    random = np.random.default_rng(1)
    start, g = (random.normal(size=12).astype(np.float32) for _ in range(2))
    g[::4] = 0
    density = wp.array(start, device=device)
    inputs = [0, 0.3, wp.vec4(), 0.9, 1e-12, 1e-12, wp.ones(12, dtype=wp.uint8, device=device)]
    inputs += [wp.array(g, device=device), wp.zeros((12, 6), dtype=wp.vec4, device=device)]
    inputs += [wp.zeros(12, dtype=wp.bfloat16, device=device)]
    inputs += [wp.zeros((12, 6), dtype=field_step.four_bfloats, device=device)]
    coefficients = wp.zeros((12, 6), dtype=wp.vec4, device=device)
    wp.launch(field_step.apply_rmsprop, dim=12 * 7, device=device, inputs=inputs, outputs=[density, coefficients])
    values, held = wp.array(start, device=device), wp.zeros(12, dtype=wp.float32, device=device)
    expected, moments = start.astype(np.float64), np.zeros(12)
    for step in range(3):
        gradients = wp.array((step + 1) * g, device=device)
        outputs = [gradients, held, values]
        wp.launch(background_loss.apply_layer_rmsprop, dim=12, device=device, inputs=[0, 0.3, 0.9, 1e-12, *outputs])
        if step == 0:
            np.testing.assert_array_equal(values.numpy(), density.numpy())
        squares = ((step + 1.0) * g) ** 2
        moments = squares if step == 0 else 0.9 * moments + 0.1 * squares
        expected -= 0.3 * (step + 1) * g / (np.sqrt(moments) + 1e-12)
        assert not gradients.numpy().any()
    np.testing.assert_allclose(values.numpy(), expected, rtol=1e-5, atol=1e-6)
