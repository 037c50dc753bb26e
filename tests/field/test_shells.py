"""Nested cubes around a box: against a plain NumPy version in float64, and finite differences."""

from types import SimpleNamespace

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fit_oracles import photometric_gradient, training_rays

import warpcage
from warpcage.field import BrickLayout, ShellField
from warpcage.kernels.fitting import shells_loss

HALF = np.array([1.0, 0.7, 1.3])
CUBES, SIDE = 3, 4

#: Weight of the front's opacity.
BY_FRONT = 0.002


def random_places(random):
    """(bricks, 4) of two sizes: of each eight entries, one large brick, or some of eight small ones."""
    places = []
    for cube, i, j, k in np.ndindex(CUBES, SIDE // 2, SIDE // 2, SIDE // 2):
        corner = np.array([cube * SIDE + 2 * i, 2 * j, 2 * k])
        if random.random() < 0.4:
            places.append([*corner, 2])
        else:
            places += [[*(corner + at), 1] for at in np.ndindex(2, 2, 2) if random.random() < 0.6]
    return np.array(places, np.int32)


def node_key(place, node):
    """(cube, size, i, j, k) that nodes of one size at one place have in common."""
    cube = place[0] // SIDE
    corner = place[:3] - [cube * SIDE, 0, 0]
    return (cube, place[3], *(8 * corner // place[3] + node))


def random_shells(device, center=(0.0, 0.0, 0.0), density=4.0, seed=0):
    """A ShellField of random values, some densities below zero; the key of each row; and (bricks, 9, 9, 9, 8) float64
    numbers of all nodes, 0 where they have none."""
    random = np.random.default_rng(seed)
    places = random_places(random)
    marks = (random.random((len(places), 729)) < 0.7).astype(np.uint8)
    layout = BrickLayout(CUBES, SIDE, places, wp.array(marks, dtype=wp.uint8, device=device))
    links, table, rows = layout.links.numpy(), {}, {}
    numbers, dense = np.zeros((layout.rows, 8)), np.zeros((len(places), 9, 9, 9, 8))
    for brick, node in np.argwhere(links >= 0):
        at = np.unravel_index(node, (9, 9, 9))
        key = node_key(places[brick], np.array(at))
        if key not in table:
            drawn = [*random.random(3), density * random.normal(0.4, 0.5), *random.normal(0, 0.2, 3), 0.0]
            table[key] = np.array(drawn, np.float32).astype(float)
        numbers[links[brick, node]], rows[links[brick, node]] = table[key], key
        dense[(brick, *at)] = table[key]
    sky = random.random((6 * 3**2 + 2, 3))
    return ShellField(center, HALF, layout, numbers[:, :4], numbers[:, 4:], sky=sky), rows, dense


def samples(shells, origin, direction, begin, end):
    """(brick, place in its cells, length over half the side of its cube) of each sample of a ray outside the box, which
    is cut at the planes of all cubes and entries."""
    o = np.asarray(origin, float) - shells.center
    largest, places, where = HALF.max(), shells.layout.places.numpy(), shells.layout.table.numpy()
    faces = np.concatenate([unit * np.linspace(-1, 1, SIDE + 1) for unit in largest * 2.0 ** np.arange(CUBES)])
    with np.errstate(divide="ignore", invalid="ignore"):
        cuts = np.concatenate([([*faces, -HALF[a], HALF[a]] - o[a]) / direction[a] for a in range(3)])
    last = 1e3 if np.isinf(end) else end
    cuts = np.sort(cuts[np.isfinite(cuts) & (cuts > begin) & (cuts < last)])
    parts = []
    for near, far in zip([begin, *cuts], [*cuts, last], strict=True):
        middle = o + 0.5 * (near + far) * direction
        cube = max(0, int(np.ceil(np.log2(np.abs(middle).max() / largest))))
        if far - near < 1e-9 or cube >= CUBES or (np.abs(middle) < HALF).all():
            continue
        entry = np.floor((middle / (largest * 2.0**cube) + 1) * SIDE / 2).astype(int)
        brick = where[cube * SIDE + entry[0], entry[1], entry[2]]
        if brick >= 0 and parts and parts[-1][0] == brick and abs(parts[-1][2] - near) < 1e-9:
            parts[-1][2] = far
        elif brick >= 0:
            parts.append([brick, near, far])
    for brick, near, far in parts:
        place = places[brick]
        cube = place[0] // SIDE
        unit = largest * 2.0**cube
        count = max(1, int(np.ceil((far - near) / (2 * unit / SIDE * place[3] / 8) / 0.5 - 1e-3)))
        for k in range(count):
            x = o + (near + (k + 0.5) * (far - near) / count) * direction
            entries = (x / unit + 1) * SIDE / 2 - [place[0] - cube * SIDE, place[1], place[2]]
            yield brick, np.clip(entries * 8 / place[3], 0, 8), (far - near) / count / unit


def march(shells, dense, origin, direction, begin=0.0, end=np.inf):
    """(rgb, light) of a ray outside the box, dense: of random_shells."""
    found = list(samples(shells, origin, direction, begin, end))
    if not found:
        return np.zeros(3), 1.0
    bricks, places, lengths = (np.array(each) for each in zip(*found, strict=True))
    low = np.minimum(np.floor(places).astype(int), 7)
    numbers = np.zeros((len(bricks), 8))
    for corner in np.ndindex(2, 2, 2):
        weights = np.where(corner, places - low, 1 - (places - low)).prod(axis=1)
        numbers += weights[:, None] * dense[(bricks, *(low + corner).T)]
    kept = np.exp(-np.maximum(numbers[:, 3], 0) * lengths)
    light = np.concatenate([[1.0], np.cumprod(kept)])
    colors = np.maximum(numbers[:, :3] + (numbers[:, 4:7] @ direction)[:, None], 0)
    return (light[:-1] * (1 - kept)) @ colors, light[-1]


def seen(shells, dense, origin, direction):
    color, light = march(shells, dense, origin, direction)
    return color + light * oracle.sky_color(shells, direction)


def test_bricks_of_one_size_share_the_nodes_at_which_they_meet(device):
    """One row for each node that any of them has, and none for others."""
    random = np.random.default_rng(3)
    places = random_places(random)
    marks = (random.random((len(places), 729)) < 0.3).astype(np.uint8)
    layout = BrickLayout(CUBES, SIDE, places, wp.array(marks, dtype=wp.uint8, device=device))
    nodes = np.stack(np.unravel_index(np.arange(729), (9, 9, 9)), axis=1)
    keys = [[node_key(place, node) for node in nodes] for place in places]
    wanted = {keys[brick][node] for brick, node in np.argwhere(marks)}
    links, rows = layout.links.numpy(), {}
    for brick, node in np.ndindex(links.shape):
        key = keys[brick][node]
        assert (links[brick, node] >= 0) == (key in wanted)
        if key in wanted:
            assert rows.setdefault(key, links[brick, node]) == links[brick, node]
    assert sorted(rows.values()) == list(range(layout.rows))
    assert all(layout.sizes.numpy()[row] == key[1] for key, row in rows.items())


def test_colors_match_numpy(device):
    """Rays from within the box, in each cube and beyond all, straight along axes and along faces too."""
    shells, _, dense = random_shells(device, center=(0.3, -0.2, 0.5))
    random = np.random.default_rng(1)
    directions = random.normal(size=(150, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = shells.center + random.uniform(-1, 1, (150, 3)) * 8 * random.random((150, 1))
    directions[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    found = shells.sample(origins, directions)
    expected = [seen(shells, dense, *ray) for ray in zip(origins, directions, strict=True)]
    error = np.abs(found - expected).max(axis=1)
    # where a length is a whole number of steps, float32 may take one sample more
    assert np.quantile(error, 0.95) < 1e-4 and error.max() < 2e-2
    assert np.abs(found - [oracle.sky_color(shells, d) for d in directions]).max() > 0.3


def test_views_are_put_between_what_is_before_and_behind(device):
    shells, _, dense = random_shells(device)
    camera = warpcage.Camera.look_at([3.0, 1.4, 0.8], [0, 0, 0], fov_degrees=70, width=8, height=6)
    random = np.random.default_rng(1)
    alpha = random.random(48) * (random.random(48) > 0.3)
    depth = np.where(alpha > 0, random.uniform(0.5, 6.0, 48), np.inf)  # also before the box, as an edit may move things
    rgb, mask = random.random((48, 3)) * alpha[:, None], random.random(48)
    kinds = wp.vec3, wp.float32, wp.float32, wp.float32
    arrays = [
        wp.array(each, dtype=kind, device=device) for each, kind in zip((rgb, alpha, depth, mask), kinds, strict=True)
    ]
    shells.add_around(camera, *arrays[:3], [arrays[3]])
    origins, directions = (each.reshape(-1, 3) for each in camera.rays())
    errors = []
    for n in range(48):
        cut = depth[n] if alpha[n] > 0 else 0.0
        front, light = march(shells, dense, origins[n], directions[n], 0.0, cut) if cut else (np.zeros(3), 1.0)
        back, left = march(shells, dense, origins[n], directions[n], cut)
        behind = back + left * oracle.sky_color(shells, directions[n])
        expected = front + light * (rgb[n] + (1 - alpha[n]) * behind)
        errors.append(np.abs(arrays[0].numpy()[n] - expected).max())
        assert arrays[1].numpy()[n] == pytest.approx(light * alpha[n], abs=5e-3)
        assert arrays[3].numpy()[n] == pytest.approx(light * mask[n], abs=5e-3)
    assert np.quantile(errors, 0.95) < 2e-4 and max(errors) < 2e-2


def whole_loss(device, by_sky):
    """A field, nested cubes and pictures, and the gradients of the whole loss by them."""
    field, density, sh = oracle.random_field(
        device, resolution=(4, 4, 4), keep=0.5, density_scale=0.5, bounds=(-HALF, HALF), numbers=(24,)
    )
    shells, rows, dense = random_shells(device, density=2.0)
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
    inputs = [0, shells.grid, rays]
    wp.launch(shells_loss.gather_shells, dim=count, inputs=inputs, outputs=[front, behind], device=device)
    scale = 1 / (3 * count)
    around = dict(own_background=behind, grad_background=grad_behind, front=front, grad_front=grad_front)
    photometric_gradient(field, rays, count, scale=scale, by_warps=not wp.get_device(device).is_cpu, **around)
    by_value, by_slope = (wp.zeros(shells.voxel_count, dtype=wp.vec4, device=device) for _ in range(2))
    earned = wp.zeros(shells.brick_count, dtype=wp.float32, device=device)
    grad_sky = wp.zeros_like(shells.grid.sky.values)
    wp.launch(
        shells_loss.accumulate_shell_gradient,
        dim=count,
        device=device,
        inputs=[0, shells.grid, rays, front, behind, grad_front, grad_behind, BY_FRONT, by_sky],
        outputs=[by_value, by_slope, earned, grad_sky],
    )
    gradients = np.concatenate([by_value.numpy(), by_slope.numpy()], axis=1)
    return SimpleNamespace(**locals())


def test_gradients_match_finite_differences(device):
    """Of the whole loss, by colours, densities and slopes before and behind the box, and by the sky."""
    whole = whole_loss(device, by_sky=0.0)
    shells, field, found = whole.shells, whole.field, whole.gradients

    def loss(dense):
        total = 0.0
        for camera, image in zip(whole.cameras, whole.images, strict=True):
            origins, directions = camera.rays()
            for row, column in np.ndindex(6, 8):
                ray = origins[row, column], directions[row, column]
                between = oracle.front_end(shells, *ray)
                front, light = march(shells, dense, *ray, 0.0, between) if between > 0 else (np.zeros(3), 1.0)
                back, left = march(shells, dense, *ray, between)
                behind = back + left * oracle.sky_color(shells, ray[1])
                inner = oracle.render_ray(field, whole.density, whole.sh, *ray, field.step, behind, 6.0)[0]
                total += whole.scale * ((front + light * inner - image[row, column]) ** 2).sum()
                total += BY_FRONT * (1 - light)
        return total

    random, links = np.random.default_rng(0), shells.layout.links.numpy().reshape(-1, 9, 9, 9)
    for number in range(7):
        largest = np.abs(found[:, number]).max()
        assert largest > 0
        row = random.permutation(np.flatnonzero(np.abs(found[:, number]) > 0.2 * largest))[0]
        ends = []
        for sign in (1, -1):
            moved = whole.dense.copy()
            moved[links == row, number] += sign * 1e-4
            ends.append(loss(moved))
        expected = (ends[0] - ends[1]) / 2e-4
        assert abs(found[row, number] - expected) < 5e-3 * largest + 3e-3 * abs(expected)
    assert (found[:, 7] == 0).all()
    earned = whole.earned.numpy()
    touched = [(np.abs(found[rows[rows >= 0], 3]).max(initial=0.0) > 0) for rows in links.reshape(-1, 729)]
    assert (earned > 0).sum() > 5 and not (earned[~np.array(touched)] > 0).any()


def test_variation_gradient_matches_finite_differences(device):
    shells, _, _ = random_shells(device)
    links = shells.layout.links.numpy().reshape(-1, 9, 9, 9)
    scales = np.array([0.2, 0.2, 0.2, 0.7, 0.3, 0.3, 0.3, 0.0])
    by_value, by_slope = (wp.zeros(shells.voxel_count, dtype=wp.vec4, device=device) for _ in range(2))
    inputs = [0, shells.grid, 777, 0.2, 0.7, 0.3]
    count = len(links) * 512
    kernel = shells_loss.accumulate_shell_variation
    wp.launch(kernel, dim=count, inputs=inputs, outputs=[by_value, by_slope], device=device)
    numbers = np.concatenate([shells.values, np.pad(shells.slopes, ((0, 0), (0, 1)))], axis=1).astype(float)
    here = links[:, :8, :8, :8]
    others = [links[:, 1:, :8, :8], links[:, :8, 1:, :8], links[:, :8, :8, 1:]]

    def variation(numbers):
        squares = np.full((*here.shape, 8), 1e-9)
        for other in others:
            difference = numbers[other] - numbers[here]
            squares += np.where(((other >= 0) & (here >= 0))[..., None], difference**2, 0.0)
        faces = shells.layout.places.numpy()[:, 3].astype(float) ** 2
        return (np.where((here >= 0)[..., None], np.sqrt(squares), 0.0) @ scales).sum(axis=(1, 2, 3)) @ faces

    found = np.concatenate([by_value.numpy(), by_slope.numpy()], axis=1)
    at = np.argwhere(np.abs(found) > 0)
    for place in map(tuple, np.random.default_rng(0).permutation(at)[:12]):
        ends = []
        for sign in (1, -1):
            moved = numbers.copy()
            moved[place] += sign * 1e-6
            ends.append(variation(moved))
        assert found[place] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-2)
