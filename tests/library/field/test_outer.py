"""Outer fields: against a plain NumPy version, finite differences, and a room of the project's own."""

from types import SimpleNamespace

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fit_oracles import counted_views, photometric_gradient, training_rays
from ground_truth import FLOOR, OBJECT_BOX, ROOM_HALF, object_model, room_views
from refusals import refused
from scenes import room_cameras

import warpcage
from warpcage.core.devices import octet_items
from warpcage.field import OuterField
from warpcage.kernels.field.outer import mark_outer_nodes
from warpcage.kernels.fitting import outer_loss
from warpcage.view import camera_array

HALF = np.array([1.0, 0.7, 1.3])

#: Weight of the front's opacity.
BY_FRONT = 0.002


def test_the_oracle_contracts_as_published():
    """It can be undone, leaves the box as it is, and is continuous at its faces."""
    random = np.random.default_rng(0)
    u = random.normal(size=(500, 3)) * 10 ** random.uniform(-1, 3, (500, 1))
    p = oracle.contract(u)
    assert np.abs(p).max() < 2
    np.testing.assert_allclose(oracle.expand(p), u, rtol=1e-6)
    np.testing.assert_array_equal(p[np.abs(u).max(axis=1) <= 1], u[np.abs(u).max(axis=1) <= 1])
    np.testing.assert_allclose(oracle.contract(u * (1 + 1e-9)), p, atol=1e-7)
    face = random.uniform(-1, 1, (50, 3))
    face[:, 1] = 1.0
    np.testing.assert_allclose(oracle.contract(face * 1.000001), face, atol=2e-6)


def allowed(device, error):
    """An error that is allowed: texture units of a GPU place samples to 1/256 of a voxel and hold halves."""
    return 4e-3 if wp.get_device(device).is_cuda else error


@pytest.mark.parametrize("side", [12, 35])  # one brick along an axis of a GPU's texture, and several
def test_colors_match_numpy(device, side):
    """To the cells of the seams: rays from within the box, around it, along its faces, and straight along axes."""
    outer, values = oracle.random_outer(device, side=side, center=(0.3, -0.2, 0.5), half=HALF)
    origins, directions = oracle.rays_of(250)
    directions[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    origins[6:12] = outer.center + [2.5, 0, 0]
    directions[6:9] = [[0, 0.6, 0.8], [0, -1, 0], [0, 0, 1]]
    seen = outer.sample(origins, directions)
    refused(lambda: outer.sample(origins, directions[1:]), match="as many directions as origins")
    expected = []
    for origin, direction in zip(origins, directions, strict=True):
        color, light = oracle.march_outer(outer, values, origin, direction)
        expected.append(color + light * oracle.sky_color(outer, direction))
    error = np.abs(seen - expected).max(axis=1)
    # where a length is a whole number of steps, float32 may take one sample more
    assert np.quantile(error, 0.97) < allowed(device, 3e-5) and error.max() < 2e-2


def test_views_are_put_between_what_is_before_and_behind(device):
    outer, values = oracle.random_outer(device, half=HALF)
    camera = warpcage.Camera.look_at([3.0, 1.4, 0.8], [0, 0, 0], fov_degrees=70, width=12, height=9)
    random = np.random.default_rng(1)
    alpha = random.random(108) * (random.random(108) > 0.3)
    depth = np.where(
        alpha > 0, random.uniform(0.5, 6.0, 108), np.inf
    )  # also before the box, as an edit may move objects
    rgb = random.random((108, 3)) * alpha[:, None]
    mask = random.random(108)
    arrays = [
        wp.array(each, dtype=kind, device=device)
        for each, kind in ((rgb, wp.vec3), (alpha, wp.float32), (depth, wp.float32), (mask, wp.float32))
    ]
    outer.add_around(camera, *arrays[:3], [arrays[3]])
    origins, directions = (each.reshape(-1, 3) for each in camera.rays())
    errors = []
    for n in range(108):
        cut = depth[n] if alpha[n] > 0 else 0.0
        front, light = oracle.march_outer(outer, values, origins[n], directions[n], 0.0, cut)
        back, left = oracle.march_outer(outer, values, origins[n], directions[n], cut)
        expected = front + light * (rgb[n] + (1 - alpha[n]) * (back + left * oracle.sky_color(outer, directions[n])))
        errors.append(np.abs(arrays[0].numpy()[n] - expected).max())
        assert arrays[1].numpy()[n] == pytest.approx(light * alpha[n], abs=5e-3)
        assert arrays[3].numpy()[n] == pytest.approx(light * mask[n], abs=5e-3)
    assert np.quantile(errors, 0.95) < allowed(device, 1e-4) and max(errors) < 2e-2


def whole_loss(device, by_sky, sky=None):
    """A field, an outer field and pictures, and the gradients of the whole loss by them: (SimpleNamespace).

    sky: Grey of all the sky; None is the outer field's own.
    """
    field, density, sh = oracle.random_field(
        device, resolution=(4, 4, 4), keep=0.5, density_scale=0.5, bounds=(-HALF, HALF), numbers=(24,)
    )
    outer, values = oracle.random_outer(device, side=6, half=HALF, density=0.6)
    if sky is not None:
        outer.grid.sky.values.fill_(wp.vec4(sky, sky, sky, 0.0))
    cameras = [
        warpcage.Camera.look_at(eye, [0, 0, 0], fov_degrees=70, width=8, height=6)
        for eye in ([3.0, 0.4, 0.5], [-0.3, 0.5, 0.2], [-1.4, -2.1, 0.3])
    ]
    random = np.random.default_rng(0)
    images = random.random((3, 6, 8, 3)).astype(np.float16).astype(np.float64)
    rays = training_rays(cameras, images, np.ones((3, 6, 8)), field, device)
    count = 144
    front, grad_front = (wp.zeros(count, dtype=wp.vec4, device=device) for _ in range(2))
    behind, grad_behind = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(2))
    items = octet_items(device, count)
    wp.launch(outer_loss.gather_outer, dim=items, inputs=[0, outer.grid, rays], outputs=[front, behind], device=device)
    scale = 1 / (3 * count)
    gradients, _ = photometric_gradient(
        field,
        rays,
        count,
        scale=scale,
        by_warps=not wp.get_device(device).is_cpu,
        own_background=behind,
        grad_background=grad_behind,
        front=front,
        grad_front=grad_front,
    )
    grad = wp.zeros(outer.voxel_count, dtype=wp.vec4, device=device)
    grad_sky = wp.zeros_like(outer.grid.sky.values)
    wp.launch(
        outer_loss.accumulate_outer_gradient,
        dim=items,
        device=device,
        inputs=[0, outer.grid, rays, front, behind, grad_front, grad_behind, BY_FRONT, by_sky],
        outputs=[grad, grad_sky],
    )
    parts = {
        "field": field,
        "density": density,
        "sh": sh,
        "outer": outer,
        "values": values,
        "cameras": cameras,
        "images": images,
    }
    found = {"grad": grad.numpy(), "grad_sky": grad_sky.numpy()[0], "in_box": gradients[:, 24]}
    return SimpleNamespace(**parts, **found, scale=scale, random=random)


@pytest.mark.nightly
def test_gradients_match_finite_differences(device):
    """Of the whole loss: by what is before and behind the box, and by the field in it."""
    whole = whole_loss(device, by_sky=0.0)
    field, density, sh, outer, values = whole.field, whole.density, whole.sh, whole.outer, whole.values
    cameras, images, scale, random = whole.cameras, whole.images, whole.scale, whole.random
    found, in_box = whole.grad, whole.in_box

    def loss(density, values):
        total = 0.0
        for camera, image in zip(cameras, images, strict=True):
            origins, directions = camera.rays()
            for row, column in np.ndindex(6, 8):
                ray = origins[row, column], directions[row, column]
                rgb, before = oracle.surrounded(
                    outer,
                    values,
                    *ray,
                    lambda far, ray=ray: oracle.render_ray(field, density, sh, *ray, field.step, far, 6.0)[0],
                )
                total += scale * ((rgb - image[row, column]) ** 2).sum() + BY_FRONT * before
        return total

    def slope(changed, at, which):
        ends = []
        for sign in (1, -1):
            moved = changed.copy()
            moved[at] += sign * (1e-2 if which == "sky" else 1e-4)  # the loss is square in the sky
            if which == "sky":
                outer.grid.sky.values.assign(np.pad(moved, ((0, 0), (0, 1))).astype(np.float32)[None])
                ends.append(loss(density, values))
            else:
                ends.append(loss(moved, values) if which == "density" else loss(density, moved))
        return (ends[0] - ends[1]) / (2e-2 if which == "sky" else 2e-4)

    for channel in range(4):
        largest = np.abs(found[:, channel]).max()
        seen = np.flatnonzero(np.abs(found[:, channel]) > 0.2 * largest)
        for at in random.permutation(seen)[:2]:
            expected = slope(values, (at, channel), "values")
            assert abs(found[at, channel] - expected) < 4e-3 * largest + 2e-3 * abs(expected)
    found, sky = whole.grad_sky, outer.sky.astype(float)
    for at in map(tuple, random.permutation(np.argwhere(np.abs(found) > 0.3 * np.abs(found).max()))[:2]):
        assert abs(found[at] - slope(sky, at, "sky")) < 1e-2 * np.abs(found).max()
    outer.grid.sky.values.assign(np.pad(sky, ((0, 0), (0, 1))).astype(np.float32)[None])
    links, largest = field.grid.links.numpy(), np.abs(in_box).max()
    for node in map(tuple, random.permutation(np.argwhere(links >= 0))[:2]):
        expected = slope(density, node, "density")
        assert abs(in_box[links[node]] - expected) < 2e-3 * largest + 1e-3 * abs(expected)


def test_the_sky_follows_what_is_behind_the_box(device):
    """Finite differences of by_sky / 2 * light |sky - behind|^2 by the sky alone; nothing else has another gradient."""
    by_sky = 0.05
    without, whole = whole_loss(device, 0.0), whole_loss(device, by_sky)
    outer, field = whole.outer, whole.field
    np.testing.assert_allclose(whole.grad, without.grad, atol=1e-5 * np.abs(without.grad).max())
    sky, terms = outer.sky.astype(float), []
    for camera in whole.cameras:
        origins, directions = (each.reshape(-1, 3) for each in camera.rays())
        for ray in zip(origins, directions, strict=True):
            black, light = np.zeros(3), 1.0
            between = oracle.front_end(outer, *ray)
            if between > 0:
                _, light = oracle.march_outer(outer, whole.values, *ray, 0.0, between)
            _, opacity, _ = oracle.render_ray(field, whole.density, whole.sh, *ray, field.step, black, 6.0)
            back, left = oracle.march_outer(outer, whole.values, *ray, between)
            terms.append((ray[1], light * (1 - opacity), back + left * oracle.sky_color(outer, ray[1])))

    def loss(changed):
        outer.grid.sky.values.assign(np.pad(changed, ((0, 0), (0, 1))).astype(np.float32)[None])
        skies = [oracle.sky_color(outer, direction) for direction, _, _ in terms]
        return sum(
            0.5 * by_sky * light * ((color - behind) ** 2).sum()
            for color, (_, light, behind) in zip(skies, terms, strict=True)
        )

    found = whole.grad_sky[:, :3] - without.grad_sky[:, :3]
    largest = np.abs(found).max()
    assert largest > 1e-3
    for at in map(tuple, whole.random.permutation(np.argwhere(np.abs(found) > 0.2 * largest))[:4]):
        ends = []
        for sign in (1, -1):
            moved = sky.copy()
            moved[at] += sign * 1e-2  # the loss is square in the sky
            ends.append(loss(moved))
        assert abs(found[at] - (ends[0] - ends[1]) / 2e-2) < 1e-2 * largest


def test_a_black_sky_becomes_lighter_again(device):
    """Its gradient is that of a sky a little above black, which finite differences hold."""
    black, dark = (whole_loss(device, 0.0, sky).grad_sky for sky in (0.0, 1e-5))
    assert np.abs(dark).max() > 1e-3
    np.testing.assert_allclose(black, dark, atol=1e-4 * np.abs(dark).max())


def test_colors_stay_where_files_keep_them(device):
    """Steps beyond 0 and 1 end there, and come back; densities have no upper end."""
    numbers = np.array([[0.99, 0.01, 0.5, 3.0]])
    values, moments = (wp.array(each, dtype=wp.vec4, device=device) for each in (numbers, np.zeros((1, 4))))
    for direction, expected in ((-1.0, [1.0, 0.0, 0.4, 3.1]), (1.0, [0.9, 0.1, 0.5, 3.0])):
        gradients = wp.array(direction * np.array([[1.0, -1.0, -1.0, 1.0]]), dtype=wp.vec4, device=device)
        inputs = [0, 0.1, 0.1, 0.95, 1e-12]
        outputs = [gradients, moments, values]
        wp.launch(outer_loss.apply_outer_rmsprop, dim=1, inputs=inputs, outputs=outputs, device=device)
        np.testing.assert_allclose(values.numpy()[0], expected, atol=1e-6)


@pytest.mark.parametrize("counted", [False, True])
def test_variation_gradient_matches_finite_differences(device, counted):
    outer, values = oracle.random_outer(device, side=6)
    links = outer.contents().links
    nodes = np.argwhere(links >= 0)
    grad = wp.zeros(len(values), dtype=wp.vec4, device=device)
    views, factors, arrays = counted_views(len(values), device)
    scales = np.array([0.2, 0.2, 0.2, 0.7]) * (
        factors[views][:, [1, 1, 1, 0]] if counted else np.ones((len(values), 4))
    )
    inputs = [0, outer.grid, wp.array(np.flatnonzero(links >= 0), dtype=wp.int32, device=device), 7, 0.2, 0.7]
    inputs += arrays if counted else [None, None]
    wp.launch(outer_loss.accumulate_outer_variation, dim=len(values), device=device, inputs=inputs, outputs=[grad])

    def variation(values):
        total = 0.0
        for row, node in enumerate(nodes):
            squares = np.full(4, 1e-9)
            for axis in range(3):
                other = node + np.eye(3, dtype=int)[axis]
                if other.max() < 6 and links[tuple(other)] >= 0:
                    squares += (values[links[tuple(other)]] - values[row]) ** 2
            total += scales[row] @ np.sqrt(squares)
        return total

    found = grad.numpy()
    oracle.assert_slopes(found, values, variation, every=41)


def test_voxels_that_may_hold_matter(device):
    side, cameras = 12, room_cameras(5, 20)
    mask = wp.empty((side,) * 3, dtype=wp.uint8, device=device)
    inputs = [0, wp.vec3(*HALF), camera_array(cameras, np.zeros(3), device), 1.5, 0.8, 3]
    wp.launch(mark_outer_nodes, dim=mask.size, inputs=inputs, outputs=[mask], device=device)
    places = oracle.node_places(side).reshape(-1, 3)
    u = oracle.expand(places)
    seen, front, near = np.zeros(len(u), int), np.zeros(len(u), bool), np.full(len(u), np.inf)
    for camera in cameras:
        local = (u * HALF - camera.center) @ camera.rotation
        near = np.minimum(near, np.linalg.norm(local, axis=1))
        ahead = local[:, 2] > 0
        pixel = local[:, :2] / np.where(ahead, local[:, 2], 1)[:, None] * [camera.fx, camera.fy] + [
            camera.cx,
            camera.cy,
        ]
        shown = ahead & (pixel >= 0).all(axis=1) & (pixel < 20).all(axis=1)
        seen += shown
        front |= shown & (np.linalg.norm(local, axis=1) < 0.8 * np.linalg.norm(camera.center))
    least = np.where(front, 3, 1)
    size = np.abs(places)
    in_slabs = (size.max(axis=1) > 1 - 4 / side) & ((size > 1 + 4 / side).sum(axis=1) < 2)
    expected = in_slabs & (near >= 1.5) & (seen >= least)
    order = np.sort(size, axis=1)
    clear = (order[:, 2] - order[:, 1] > 1e-6) | (order[:, 2] <= 1)  # else rounding says which slab a node is in
    assert (mask.numpy().ravel() != expected)[clear].mean() < 2e-3 and 0 < expected.sum() < len(u)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"half": (1, 0, 1)}, "positive"),
        ({"center": (0, np.inf, 0)}, "center"),
        ({"links": np.zeros((4, 4, 5))}, "links"),
        ({"links": np.full((4, 4, 4), 7)}, "one row for each"),
        ({"values": np.zeros((3, 3))}, "values"),
        ({"values": np.full((1, 4), np.nan)}, "finite"),
        ({"sky": (0, np.nan, 0)}, "sky"),
    ],
)
def test_bad_outer_fields(change, message):
    given = {
        "center": (0, 0, 0),
        "half": (1, 1, 1),
        "links": np.full((4, 4, 4), -1),
        "values": np.zeros((1, 4)),
    } | change
    refused(lambda: OuterField(**given), match=message)


def test_the_room_is_its_object_before_its_walls():
    """In whole views as in split ones; the object keeps within its box, cameras stand in the room and outside that."""
    train, test = room_views(3, 2, 16, samples=1, device="cpu")
    for views in (train, test):
        np.testing.assert_allclose(views.split.whole, views.whole.images, atol=1e-6)
        alphas = views.object.alphas
        assert 0.1 < alphas.mean() < 0.7 and views.whole.alphas is None
        np.testing.assert_allclose(views.whole.images[alphas == 1], views.object.images[alphas == 1], atol=1e-6)
        places = np.array([camera.center for camera in views.whole.cameras])
        assert (np.abs(places[:, :2]) < ROOM_HALF).all() and (places[:, 2] > FLOOR).all()
        assert (np.abs(places[:, :2]).max(axis=1) > OBJECT_BOX[1, 0]).all()
    vertices = object_model()[0]
    assert (vertices > OBJECT_BOX[0]).all() and (vertices < OBJECT_BOX[1]).all()
    refused(lambda: room_views(0, 2, 16), match="views")
