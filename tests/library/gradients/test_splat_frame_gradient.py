"""Gradients of frames of posed splats against central differences of the equations in float64."""

import dataclasses
import functools

import numpy as np
import pytest
import warp as wp
from polygon_cages import quad_box
from refusals import refused
from scipy.spatial.transform import Rotation
from splat_scenes import reference_view

from warpcage import Cage, CageEdit, Camera, Deformer, SplatField
from warpcage.gradients import frame_gradient
from warpcage.mesh.faces import StretchTarget, stretched_normals
from warpcage.splats import CageBinding, rotation_matrices

BACKGROUND, STEP = (0.9, 0.5, 0.2), 1e-6
NAMES = ("centers", "log_scales", "quaternions", "logits", "harmonics")
BOX = Cage.box([-1.2] * 3, [1.2] * 3, segments=2)
CAMERA = Camera.look_at((2.6, 1.3, 0.9), (0.1, 0, 0), width=30, height=24, fov_degrees=42)


def values_of(count=60, degree=2, seed=0):
    """Centres, logarithms of scales, quaternions, logits and harmonics of splats, float32 numbers, small enough that
    none is cut in pieces."""
    random = np.random.default_rng(seed)
    parts = (
        random.uniform(-0.8, 0.8, (count, 3)),
        np.log(0.03) + 0.3 * random.normal(size=(count, 3)),
        random.normal(size=(count, 4)),
        random.normal(size=count),
        0.3 * random.normal(size=(count, (degree + 1) ** 2, 3)),
    )
    return [np.clip(part, -4, 0.8).astype(np.float32).astype(float) for part in parts]


def random_pose(cage=BOX, seed=0):
    vertices = cage.bend(25, axis="x", towards="z").vertices
    return vertices + 0.03 * np.random.default_rng(seed).normal(size=vertices.shape)


class Oracle:
    """A posed frame by the equations, of the weights of the splats in a cage at rest."""

    def __init__(self, values, cage, kind, density="opacity", antialias=False):
        self.values, self.cage, self.density, self.antialias = values, cage, density, antialias
        centers, surface = values[0], cage.refined(2 if kind == "harmonic" else 1)
        binding = CageBinding(centers, surface, kind, np.zeros(3), wp.get_device("cpu"), 24, packed=False)
        rows = binding.rows.numpy().transpose(1, 0, 2).astype(float)  # (n, rows, 4)
        self.weights, self.slopes = rows[..., 0], rows[..., 1:] / surface.size
        self.surface, self.has_faces = surface, kind in ("green", "biharmonic")
        self.field = SplatField(*(part.astype(np.float32) for part in values))

    def __call__(self, vertices, camera=CAMERA, values=None):
        """Colours, opacities and depths."""
        held = [each if values is None else values[n] for n, each in enumerate(self.values)]
        moved = vertices
        if self.has_faces:
            posed = self.cage.with_vertices(vertices).refined(1)
            normals = stretched_normals(self.surface, StretchTarget.of(posed))
            moved = np.concatenate([vertices, self.surface.size * normals.T])
        jacobians = np.einsum("nja,jb->nba", self.slopes, moved)
        places = self.weights @ moved + np.einsum("nij,nj->ni", jacobians, held[0] - self.values[0])
        factors = jacobians @ (rotation_matrices(held[2]) * np.exp(held[1])[:, None, :])
        u, _, vt = np.linalg.svd(jacobians)
        opacities = 1 / (1 + np.exp(-held[3]))
        if self.density == "paper":
            opacities = 1 - (1 - opacities) ** np.sqrt((jacobians**2).sum(axis=(1, 2)) / 3)
        matter = places, factors @ factors.transpose(0, 2, 1), opacities, held[4], camera, BACKGROUND
        return reference_view(*matter, near=self.field.near, antialias=self.antialias, turns=u @ vt)


class Loss:
    """A random linear function of parts of a frame."""

    def __init__(self, frame, parts, seed=0):
        random = np.random.default_rng(seed)
        self.slopes = [random.normal(size=part.shape) if name in parts else None
                       for name, part in zip(("rgb", "alpha", "depth"), frame, strict=True)]  # fmt: skip
        if self.slopes[2] is not None:
            self.slopes[2] *= frame[1] > 0.2

    def __call__(self, frame):
        pairs = [(part, slope) for part, slope in zip(frame, self.slopes, strict=True) if slope is not None]
        return sum((np.where(slope == 0, 0, part) * slope).sum() for part, slope in pairs)

    def gradient(self, deformer, camera=CAMERA, **wanted):
        rgb, alpha, depth = self.slopes
        given = {"alpha_gradient": alpha, "depth_gradient": depth, "background": BACKGROUND}
        return frame_gradient(deformer, camera, rgb, **given, **wanted)


def central(function, change):
    return (function(STEP * change) - function(-STEP * change)) / (2 * STEP)


def relative_error(found, expected):
    return np.linalg.norm(np.subtract(found, expected)) / np.linalg.norm(expected)


def field_of(values, device, antialias=False):
    return SplatField(*(part.astype(np.float32) for part in values), antialias=antialias, device=device)


def assert_by_vertices(found, oracle, loss, posed):
    random = np.random.default_rng(1)
    changes = [np.tile([1, 0.5, -0.7], (len(posed), 1)), *random.normal(size=(5, *posed.shape))]
    expected = [central(lambda h: loss(oracle(posed + h)), change) for change in changes]
    assert relative_error([(found.vertices.numpy() * change).sum() for change in changes], expected) < 3e-3


@pytest.mark.parametrize(
    ("parts", "density", "antialias"),
    [("rgb", "opacity", False), ("alpha", "paper", False), ("depth", "opacity", True)]
    + [("rgb alpha depth", "paper", True)],
)
def test_gradients_are_differences_of_the_equations(parts, density, antialias, device):
    values, posed = values_of(), random_pose()
    oracle = Oracle(values, BOX, "mean_value", density, antialias)
    deformer = Deformer(
        field_of(values, device, antialias), BOX, coordinates="mean_value", density=density, resolution=None
    ).pose(posed)
    frame = oracle(posed)
    drawn = deformer.render(CAMERA, background=BACKGROUND)
    np.testing.assert_allclose(drawn.rgb, frame[0], atol=2e-3)
    loss = Loss(frame, parts.split())
    found = loss.gradient(deformer, by_vertices=True, by_camera=True, by_field=True)
    assert_by_vertices(found, oracle, loss, posed)

    def turned(numbers):
        axes, pose = CAMERA.camera_to_world[:3, :3], CAMERA.camera_to_world.copy()
        pose[:3, :3] = Rotation.from_rotvec(axes @ numbers[:3]).as_matrix() @ axes
        pose[:3, 3] += axes @ numbers[3:6]
        factor = np.exp(numbers[6])
        return dataclasses.replace(CAMERA, camera_to_world=pose, fx=CAMERA.fx * factor, fy=CAMERA.fy * factor)

    expected = [central(lambda h: loss(oracle(posed, turned(h))), change) for change in np.eye(7)]
    assert relative_error(found.camera, expected) < 3e-3
    random = np.random.default_rng(2)
    for number, name in enumerate(NAMES):  # centres move with the map's Jacobian held
        change = random.normal(size=values[number].shape)

        def changed(h, number=number):
            return loss(oracle(posed, values=[each + (h if n == number else 0) for n, each in enumerate(values)]))

        expected = central(changed, change)
        by_values = getattr(found, name).numpy().reshape(change.shape)
        if "rgb" in parts or name != "harmonics":
            assert (by_values * change).sum() == pytest.approx(
                expected, rel=3e-3, abs=1e-4 * float(np.abs(by_values).sum())
            )
        else:
            assert expected == 0 and not by_values.any()


@pytest.mark.parametrize("kind", ["harmonic", "green", "maximum_likelihood", "biharmonic"])
def test_gradients_by_vertices_of_other_coordinates(kind, device):
    values, posed = values_of(count=25), random_pose()
    oracle = Oracle(values, BOX, kind)
    deformer = Deformer(field_of(values, device), BOX, coordinates=kind, resolution=24).pose(posed)
    loss = Loss(oracle(posed), ["rgb"])
    assert_by_vertices(loss.gradient(deformer, by_vertices=True), oracle, loss, posed)


@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_gradients_by_vertices_of_a_cage_of_quads(kind, device):
    values, cage = values_of(count=25), quad_box(2)
    cage = cage.with_vertices(1.2 * cage.vertices)
    posed = random_pose(cage)
    oracle = Oracle(values, cage, kind)
    deformer = Deformer(field_of(values, device), cage, coordinates=kind).pose(posed)
    loss = Loss(oracle(posed), ["rgb"])
    assert_by_vertices(loss.gradient(deformer, by_vertices=True), oracle, loss, posed)


def test_at_rest_splats_have_a_gradient_and_stay_as_they_are(device):
    values = values_of()
    deformer = Deformer(field_of(values, device), BOX, coordinates="mean_value")
    oracle = Oracle(values, BOX, "mean_value")
    before = deformer.render(CAMERA).rgb
    loss = Loss(oracle(BOX.vertices), ["rgb", "alpha"])
    assert_by_vertices(loss.gradient(deformer, by_vertices=True), oracle, loss, BOX.vertices)
    np.testing.assert_array_equal(deformer.render(CAMERA).rgb, before)


def test_packed_rows_pass_back_what_whole_ones_do(device, monkeypatch):
    """As CUDA has them; here on every device, of more tiles than one."""
    values, posed, found = values_of(count=100), random_pose(), []
    for packed in (False, True):
        binding = functools.partial(CageBinding, packed=packed)
        monkeypatch.setattr("warpcage.deform.splat_edits.CageBinding", binding)
        deformer = Deformer(field_of(values, device), BOX, coordinates="mean_value").pose(posed)
        rgb = np.random.default_rng(0).normal(size=(CAMERA.height, CAMERA.width, 3))
        found.append(frame_gradient(deformer, CAMERA, rgb, by_vertices=True).vertices.numpy())
    assert relative_error(*found) < 1e-3


def test_what_has_no_gradient_yet_is_refused(device):
    field = field_of(values_of(), device)
    part = Cage.box([-0.9] * 3, [0.1, 0.9, 0.9])
    for edits in ([BOX, BOX], CageEdit(BOX, remove=True), CageEdit(part, falloff=0.1, held=[0])):
        deformer = Deformer(field, edits, coordinates="mean_value")
        refused(lambda deformer=deformer: frame_gradient(deformer, CAMERA), "a frame's gradient is of one edit")
    backward = Deformer(field, BOX, coordinates="mean_value", map="backward", resolution=16)
    refused(lambda: frame_gradient(backward, CAMERA), "splats that move forward")
    refused(lambda: frame_gradient(Deformer(field, BOX, coordinates="mean_value"), CAMERA, step=0.1), "leave step out")
    large = SplatField(
        np.zeros((1, 3)), np.full((1, 3), -0.7), [[1, 0, 0, 0]], [0.0], np.zeros((1, 1, 3)), device=device
    )
    split = Deformer(large, BOX, coordinates="mean_value").pose(BOX.bend(60, axis="x", towards="z"))
    refused(lambda: frame_gradient(split, CAMERA, np.ones((24, 30, 3)), by_field=True), "some are drawn in pieces")
