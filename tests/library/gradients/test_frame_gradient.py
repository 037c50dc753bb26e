"""Gradients of frames of posed fields against central differences of a float64 march, and of the frames themselves."""

import dataclasses

import field_oracles as oracle
import numpy as np
import pytest
import warp as wp
from fields import BOX, ellipsoid, make_field, shiny, shiny_field, surrounded_ball, view
from refusals import refused
from scipy.spatial.transform import Rotation

from warpcage import Cage, CageEdit, Camera, Deformer, SurfaceMesh, VoxelField, deform_points, turntable
from warpcage.field.render import RenderOptions
from warpcage.gradients import frame, frame_gradient
from warpcage.gradients.frame import voxel_gradient

BACKGROUND = (0.3, 0.6, 0.1)
EYE = (3.0, 1.2, 0.8)


def on_host(values):
    return values if isinstance(values, np.ndarray) else values.numpy()


def small_camera(eye=EYE, size=(20, 16)):
    return Camera.look_at(eye, (0.1, 0, 0), width=size[0], height=size[1], fov_degrees=40)


def smooth_field(device, numbers, seed=0, shape=(11, 10, 12)):
    """A field of random values that is empty at its border, and its dense float64 arrays."""
    random = np.random.default_rng(seed)
    density = np.zeros(shape)
    density[1:-1, 1:-1, 1:-1] = random.uniform(0.2, 2.5, tuple(np.array(shape) - 2))
    sh = 0.4 * random.normal(size=(*shape, *numbers))
    links = np.arange(density.size, dtype=np.int32).reshape(shape)
    values = density.ravel(), sh.reshape(density.size, *numbers)
    field = VoxelField(((-1.0, -0.9, -1.0), (1.0, 1.0, 1.1)), links, *values, device=device)
    return field, density.astype(np.float32).astype(float), sh.astype(np.float32).astype(float)


def turned(camera, numbers):
    """A camera with its seven numbers changed: turns about its axes, shifts along them, log of its focal length."""
    pose = camera.camera_to_world.copy()
    axes = camera.camera_to_world[:3, :3]
    pose[:3, :3] = Rotation.from_rotvec(axes @ numbers[:3]).as_matrix() @ axes
    pose[:3, 3] += axes @ numbers[3:6]
    factor = np.exp(numbers[6])
    return dataclasses.replace(camera, camera_to_world=pose, fx=camera.fx * factor, fy=camera.fy * factor)


class Oracle:
    """A frame of one posed edit in float64, all its samples at once, without shortcuts."""

    def __init__(self, field, density, sh, deformer, camera, step=None):
        self.field, self.density, self.sh, self.step = field, density, sh, step or field.step
        self.is_arc = deformer.density == "opacity"
        (struct, _), center = deformer.posed_edits().lattices.posed()[0], field.center
        self.nodes = struct.deformed.positions.numpy().astype(float) + center
        origins, self.directions = (each.reshape(-1, 3) for each in camera.rays())
        self.t = (np.arange(int(1.5 / self.step), int(5.0 / self.step)) + oracle.SAMPLE_PLACE) * self.step
        self.points = (origins[:, None] + self.t[:, None] * self.directions[:, None]).reshape(-1, 3)
        self.along = np.repeat(self.directions, len(self.t), axis=0)
        self.place = (self.points - np.array(struct.deformed.lower) - center) / struct.deformed.spacing
        self.spacing, self.slack, self.rest = struct.deformed.spacing, struct.slack, struct.rest
        deformed = signed_distance(struct.deformed, self.points - center)
        self.mapped = deformed <= struct.tolerance

    def map(self, nodes):
        """Canonical positions (n, 3) of the samples, and their derivatives along the rays, world units."""
        low = np.clip(np.floor(self.place).astype(int), 0, np.array(nodes.shape[:3]) - 2)
        f, position, slope = self.place - low, 0, 0
        for corner in np.ndindex(2, 2, 2):
            shares, value = np.where(corner, f, 1 - f), nodes[tuple((low + corner).T)]
            signs = np.where(corner, self.along, -self.along) / self.spacing
            position = position + shares.prod(axis=1)[:, None] * value
            for axis in range(3):
                slope = slope + (signs[:, axis] * np.delete(shares, axis, axis=1).prod(axis=1))[:, None] * value
        return position, slope

    def __call__(self, nodes=None, density=None, sh=None):
        """Colours (n, 3), opacities (n,) and depths (n,) of all rays."""
        position, slope = self.map(self.nodes if nodes is None else nodes)
        mapped = self.mapped[:, None]
        position, slope = np.where(mapped, position, self.points), np.where(mapped, slope, self.along)
        stretch = np.linalg.norm(slope, axis=1)
        values = self.density if density is None else density, self.sh if sh is None else sh
        rgb, sigma = oracle.sample(self.field, *values, position, slope / stretch[:, None])
        rest = signed_distance(self.rest, position - self.field.center)
        sigma = np.where(np.where(self.mapped, rest > self.slack, rest <= 0), 0, sigma)
        assert stretch[sigma > 0].max() < 1.5  # longer samples would be cut
        depth = sigma * self.step * np.where(self.mapped & self.is_arc, stretch, 1)
        through = np.exp(-np.cumsum(depth.reshape(-1, len(self.t)), axis=1))
        weight = -np.diff(through, axis=1, prepend=1.0)
        color = (weight[..., None] * rgb.reshape(*weight.shape, 3)).sum(axis=1) + through[:, -1:] * BACKGROUND
        opacity = 1 - through[:, -1]
        return color, opacity, weight @ self.t / np.maximum(opacity, 1e-3)


def signed_distance(cage_map, points):
    """Distances (n,) of a lattice at points relative to the field's centre; far beside it."""
    values = cage_map.distance.numpy().astype(float)
    place = (points - np.array(cage_map.lower)) / cage_map.spacing
    among = ((place > 0) & (place < np.array(values.shape) - 1)).all(axis=1)
    return np.where(among, oracle.interpolate(values, place), 4 * cage_map.spacing)


class Loss:
    """A random linear function of a frame: colours (n, 3), opacities and depths (n,)."""

    def __init__(self, opacity, camera, seed=0):
        random = np.random.default_rng(seed)
        self.rgb, self.alpha = random.normal(size=(opacity.size, 3)), random.normal(size=opacity.size)
        self.depth = np.where(opacity > 0.3, random.normal(size=opacity.size), 0)
        self.camera = camera

    def __call__(self, rgb, alpha, depth):
        return (rgb * self.rgb).sum() + (alpha * self.alpha).sum() + (depth * self.depth).sum()

    def gradient(self, deformer, **options):
        shape = self.camera.height, self.camera.width
        losses = {"alpha_gradient": self.alpha.reshape(shape), "depth_gradient": self.depth.reshape(shape)}
        rgb = self.rgb.reshape(*shape, 3)
        return frame_gradient(deformer, self.camera, rgb, **losses, background=BACKGROUND, **options)


def central(loss, change, h):
    """Derivative of a loss of an array along a change of it, by differences."""
    return (loss(h * change) - loss(-h * change)) / (2 * h)


def relative_error(found, expected):
    return np.linalg.norm(np.subtract(found, expected)) / np.linalg.norm(expected)


AROUND = Cage.box([-1.1, -1.05, -1.15], [1.15, 1.2, 1.2], segments=2)
PART = Cage.box([-1.1, -1.05, -1.15], [0.2, 1.2, 1.2], segments=2)


def random_pose(cage, seed=0):
    random = np.random.default_rng(seed)
    bent = cage.bend(20, axis="x", towards="z").vertices
    return bent + 0.04 * random.normal(size=bent.shape)


def node_changes(shape, seed):
    """A rough change (nx, ny, nz, 3) of nodes, and a smooth one."""
    random = np.random.default_rng(seed)
    places = np.stack(np.meshgrid(*map(np.arange, shape[:3]), indexing="ij"), axis=-1)
    smooth = [np.sin(places @ random.normal(size=3) * 0.3 + random.random()) for _ in range(3)]
    return random.normal(size=shape), np.stack(smooth, axis=-1)


@pytest.mark.parametrize(
    ("cage", "density", "numbers", "step"),
    [(AROUND, "opacity", (24,), None), (AROUND, "paper", (9, 3), None), (PART, "opacity", (9, 3), None)]
    + [(AROUND, "opacity", (24,), 0.012)],  # more samples of a ray than are kept
    ids=["opacity", "paper", "part", "many samples"],
)
def test_gradients_by_nodes_and_field_are_differences_of_a_march_in_float64(cage, density, numbers, step, device):
    field, *dense = smooth_field(device, numbers)
    camera = small_camera() if step is None else small_camera(size=(4, 3))
    deformer = Deformer(field, cage, resolution=14, density=density).pose(random_pose(cage))
    exact = Oracle(field, *dense, deformer, camera, step)
    rendered = deformer.render(camera, background=BACKGROUND, step=step)
    frame = exact()
    np.testing.assert_allclose(frame[0], rendered.rgb.reshape(-1, 3), atol=6e-3)  # marches end before their light does
    loss = Loss(frame[1], camera)
    found = loss.gradient(deformer, by_field=True, step=step)
    for change in node_changes(exact.nodes.shape, seed=1):
        expected = central(lambda h: loss(*exact(nodes=exact.nodes + h)), change, 1e-6)
        assert (found.nodes.numpy() * change).sum() == pytest.approx(expected, rel=2e-3)
    random = np.random.default_rng(1)
    change = random.normal(size=dense[0].shape) * (dense[0] > 0)
    expected = central(lambda h: loss(*exact(density=dense[0] + h)), change, 1e-6)
    assert (found.density.numpy() * change.ravel()).sum() == pytest.approx(expected, rel=2e-3)
    change = random.normal(size=dense[1].shape)
    expected = central(lambda h: loss(*exact(sh=dense[1] + h)), change, 1e-6)
    by_sh = found.harmonics.numpy().reshape(*change.shape[:3], *numbers[::-1])
    by_sh = by_sh if numbers == (24,) else np.swapaxes(by_sh, -1, -2)
    assert (by_sh * change).sum() == pytest.approx(expected, rel=2e-3)


POSES = {
    "bend": BOX.bend(40, axis="x", towards="z"),
    "twist": BOX.twist(60, axis="x"),
    "squeeze, whose samples are cut": BOX.scale([0.5, 1.2, 1.0]).translate([0.2, 0, 0.1]),
}


@pytest.mark.parametrize("pose", POSES)
def test_gradients_by_nodes_and_camera_are_differences_of_frames(pose, device):
    field = make_field(lambda x: ellipsoid(x, sigma=6.0), shiny, device=device)
    camera = view(size=64)
    deformer = Deformer(field, BOX, resolution=24).pose(POSES[pose])
    places = np.stack(np.meshgrid(*2 * [np.arange(64)], indexing="ij"), axis=-1)
    loss = np.sin(places @ np.array([[0.1, 0.05, 0.02], [0.03, -0.1, 0.08]]) + [0, 1, 2])

    def rendered(camera=camera):
        return (deformer.render(camera, background=BACKGROUND).rgb * loss).sum(dtype=float)

    def differences(rendered, changes):
        # a few steps: frames jump a little, where light samples take the colour of the next
        return [np.mean([central(rendered, change, h) for h in (5e-4, 1e-3, 2e-3)]) for change in changes]

    found = frame_gradient(deformer, camera, loss, background=BACKGROUND, by_camera=True)
    expected = differences(lambda change: rendered(turned(camera, change)), np.eye(7))
    assert relative_error(found.camera, expected) < (1.5e-2 if field.device.is_cuda else 1e-2)
    if field.device.is_cuda:  # whose frames hold colours as halves, and polynomials of the nodes, made with the pose
        return
    edit = deformer.posed_edits().tables.edits[0]
    nodes = edit.nodes.numpy().copy()

    def rendered_with(change):
        edit.nodes.assign(nodes + np.pad(change.reshape(-1, 3), ((0, 0), (0, 1))).astype(np.float32))
        return rendered()

    changes = [node_changes((*found.nodes.shape, 3), seed)[1] for seed in range(4)]
    values, expected = [(found.nodes.numpy() * change).sum() for change in changes], differences(rendered_with, changes)
    assert relative_error(values, expected) < 1e-2


@pytest.mark.parametrize("kind", ["harmonic", "mean_value", "green"])
def test_gradients_by_vertices_are_differences_of_frames_of_poses(kind, device):
    field = make_field(lambda x: ellipsoid(x, sigma=6.0), shiny, device=device)
    camera, random = view(size=64), np.random.default_rng(3)
    places = np.stack(np.meshgrid(*2 * [np.arange(64)], indexing="ij"), axis=-1)
    loss = np.sin(places @ np.array([[0.1, 0.05, 0.02], [0.03, -0.1, 0.08]]) + [0, 1, 2])
    posed = BOX.scale([1.1, 0.9, 1.0]).vertices + 0.02 * random.normal(size=BOX.vertices.shape)
    deformer = Deformer(field, BOX, resolution=32, coordinates=kind).pose(posed)
    found = frame_gradient(deformer, camera, loss, background=BACKGROUND, by_vertices=True).vertices.numpy()

    def rendered(change):
        frame = deformer.posed(posed + change).render(camera, background=BACKGROUND)
        return (frame.rgb * loss).sum(dtype=float)

    shift = np.tile([1, 0.5, -0.7], (len(posed), 1))
    changes = [shift, posed - posed.mean(axis=0), *random.normal(size=(2, *posed.shape))]
    expected = [np.mean([central(rendered, change, h) for h in (1e-3, 3e-3)]) for change in changes]
    assert relative_error([(found * change).sum() for change in changes], expected) < 1e-2


def test_descent_from_rest_finds_a_small_pose(device):
    """By vertices alone, without priors, in fourteen steps."""
    field, truth = shiny_field(device), BOX.bend(12, axis="x", towards="z").translate([0.02, 0.01, -0.02])
    deformer = Deformer(field, BOX, resolution=24)
    cameras = turntable((0, 0, 0), 2.6, 25, 4, width=24, height=24)
    targets = [deformer.posed(truth).render(camera, background="white").rgb for camera in cameras]
    vertices, step, losses, rate = BOX.vertices, 0.0, [], None
    for _ in range(14):
        deformer.pose(vertices)
        total, gradient = 0.0, np.zeros_like(vertices)
        for camera, target in zip(cameras, targets, strict=True):
            difference = deformer.render(camera, background="white").rgb - target
            found = frame_gradient(deformer, camera, 2 * difference, background="white", by_vertices=True)
            total, gradient = total + (difference.astype(float) ** 2).sum(), gradient + found.vertices.numpy()
        losses.append(total)
        rate = 0.01 * BOX.size / np.abs(gradient).max() if rate is None else rate
        step = 0.75 * step - rate * gradient
        vertices = vertices + step
    points = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    points = points[ellipsoid(points) > 0]
    start, end = (
        np.linalg.norm(deform_points(points, BOX, BOX.with_vertices(pose)) - deform_points(points, BOX, truth), axis=1)
        for pose in (BOX.vertices, vertices)
    )
    assert losses[-1] < 0.1 * losses[0]
    assert np.sqrt((end**2).mean()) < 0.6 * np.sqrt((start**2).mean())


def test_a_frame_that_does_not_count_has_no_gradient(device):
    """Nor have pixels without a depth, whose derivatives may be anything."""
    deformer, camera = Deformer(shiny_field(device), BOX, resolution=16), view(size=16)
    found = frame_gradient(deformer, camera, by_camera=True, by_field=True)
    assert not any(np.abs(each).max() for each in (found.nodes.numpy(), found.camera, found.harmonics.numpy()))
    alpha = deformer.render(camera).alpha
    beside = np.where(alpha == 0, 7.0, 0.0)
    assert beside.any() and not np.abs(frame_gradient(deformer, camera, depth_gradient=beside).nodes.numpy()).max()


def test_derivatives_may_be_arrays_of_the_device(device):
    deformer, camera = Deformer(shiny_field(device), BOX, resolution=16).pose(BOX.twist(30)), view(size=16)
    frame = deformer.render(camera)
    expected = frame_gradient(deformer, camera, frame.rgb, alpha_gradient=frame.alpha)
    assert np.abs(expected.nodes.numpy()).max() > 0.1 and expected.camera is None and expected.density is None
    arrays = frame.arrays
    found = frame_gradient(deformer, camera, arrays["rgb"], alpha_gradient=arrays["alpha"])
    np.testing.assert_allclose(found.nodes.numpy(), expected.nodes.numpy(), atol=1e-5)


def test_the_gradient_of_several_views_is_the_sum(device):
    """Pictures of no whole tiles, of which one camera sees nothing."""
    deformer = Deformer(shiny_field(device), BOX, resolution=16).pose(BOX.twist(30))
    seen = [small_camera(eye, (19, 13)) for eye in (EYE, (-2.0, 1.5, 1.0), (0.5, -3.0, 0.4))]
    seen.insert(1, Camera.look_at((9, 9, 9), (20, 20, 20), width=19, height=13, fov_degrees=40))
    slopes = np.random.default_rng(4).normal(size=(4, 13, 19, 3)).astype(np.float32)
    alone = [
        frame_gradient(deformer, camera, each, background="white") for camera, each in zip(seen, slopes, strict=True)
    ]
    given = {"rgb": wp.array(slopes.reshape(-1, 3), dtype=wp.vec3, device=device)}
    with deformer.lock:
        found = voxel_gradient(deformer, seen, given, RenderOptions(background="white")).nodes.numpy()
    expected = np.sum([each.nodes.numpy() for each in alone], axis=0)
    assert np.abs(alone[1].nodes.numpy()).max() == 0.0 < np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_rays_of_many_runs_have_the_gradient_of_one(device, monkeypatch):
    field, camera = make_field(lambda x: ellipsoid(x, sigma=6.0), shiny, device=device), small_camera()
    deformer = Deformer(field, BOX, resolution=16).pose(BOX.scale([0.5, 1.2, 1.0]))  # whose samples are cut
    loss = np.random.default_rng(5).normal(size=(16, 20, 3))
    expected = frame_gradient(deformer, camera, loss, by_camera=True, step=0.02)
    for held in (3, 40):  # more runs than are known on the way, and fewer
        monkeypatch.setattr(frame, "HELD_SAMPLES", {"cpu": held, "cuda": held})
        found = frame_gradient(deformer, camera, loss, by_camera=True, step=0.02)
        for name in ("nodes", "camera"):
            one, other = (on_host(getattr(each, name)) for each in (expected, found))
            np.testing.assert_allclose(other, one, atol=1e-4 * np.abs(one).max())


@pytest.mark.parametrize("far", [0.0, 1e4])
def test_samples_that_rounding_takes_out_of_their_cell_count_for_nothing(device, monkeypatch, far):
    """Kernels round differently: a sample at the border of the field's grid for one is beyond it for another."""
    deformer = Deformer(shiny_field(device), BOX, resolution=16).pose(BOX.twist(30))
    launch = frame.launch

    def moved(kernel, dim, inputs, outputs=(), **options):
        launch(kernel, dim, inputs, outputs, **options)
        if kernel.key.startswith("keep_samples"):
            kept = outputs[0].kept.numpy()
            kept[..., 0] += far
            outputs[0].kept.assign(kept)

    monkeypatch.setattr(frame, "launch", moved)
    loss = np.random.default_rng(5).normal(size=(16, 20, 3))
    found = frame_gradient(deformer, small_camera(), loss, by_camera=True, by_field=True)
    for name in ("nodes", "camera", "harmonics", "density"):
        most = np.abs(on_host(getattr(found, name))).max()
        assert (most > 0) == (far == 0) and np.isfinite(most), name


def test_what_has_no_gradient_yet_is_refused(device):
    field, camera = shiny_field(device), view(size=8)
    for edits, options in (
        ([BOX, BOX], {}),
        (CageEdit(BOX, remove=True), {}),
        (CageEdit(Cage.box([-0.9] * 3, [0.1, 0.9, 0.9]), falloff=0.1), {}),
        (BOX, {"coordinates": "mean_value", "resolution": None}),
    ):
        deformer = Deformer(field, edits, **{"resolution": 16, **options})
        refused(lambda deformer=deformer: frame_gradient(deformer, camera), "a frame's gradient is of")
    mesh = Deformer(SurfaceMesh(BOX.vertices, BOX.faces, device=device), BOX.scale(1.2))
    refused(lambda: frame_gradient(mesh, camera), "of a VoxelField or SplatField, not of a Surf")
    deformer = Deformer(field, BOX, resolution=16)
    refused(lambda: frame_gradient(BOX, camera), "needs a Deformer, got Cage")
    refused(lambda: frame_gradient(deformer, camera, np.zeros((9, 8, 3))), "image_gradient must be (8, 8, 3)")
    refused(lambda: frame_gradient(deformer, camera, alpha_gradient=np.zeros((8, 9))), "alpha_gradient must be (64,)")
    fine = Deformer(shiny_field(device), BOX, resolution=16)
    fine.field.supersampling = 2
    refused(lambda: frame_gradient(fine, camera), "one ray a pixel, the field takes 4: set field.supersampling")
    around = Deformer(surrounded_ball(device), BOX, resolution=16)
    refused(lambda: frame_gradient(around, camera), "without surroundings: give the colour of a background")
    assert not np.abs(frame_gradient(around, camera, background="white").nodes.numpy()).max()
