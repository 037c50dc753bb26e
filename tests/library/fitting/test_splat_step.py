"""One step of splats that are fitted: Adam in float64 on slopes that are checked elsewhere, and how splats wander."""

import numpy as np
import pytest
import warp as wp

from warpcage import Camera, SplatField
from warpcage.core import launch
from warpcage.fitting.splats import GrowingSplats
from warpcage.kernels.fitting import splat_step
from warpcage.kernels.splats import project, project_slopes
from warpcage.splats import SplatContents, rotation_matrices, splat_lens

KINDS = ("centers", "log_scales", "quaternions", "logits", "harmonics")
RATES = {"centers": 1e-3, "log_scales": 5e-3, "quaternions": 2e-3, "logits": 3e-2, "harmonics": 4e-4}
COLORS = 7e-3


def some_contents(count=50, degree=2, seed=0, opacity=0.0):
    rng = np.random.default_rng(seed)
    return SplatContents(
        rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        rng.normal(-2, 0.4, (count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        (opacity + rng.normal(size=count)).astype(np.float32),
        (0.3 * rng.normal(size=(count, (degree + 1) ** 2, 3))).astype(np.float32),
    )


SUMS = np.random.default_rng(0).normal(size=(50, 9))


class Stepper:
    """Launches of a step on splats of which nothing else is needed."""

    def __init__(self, contents, device, degree=2, **changes):
        self.device, self.count = wp.get_device(device), contents.count
        self.growing = GrowingSplats(contents, 0, degree, self.device)
        self.growing.splats.degree = degree
        camera = Camera.look_at((0.5, -4, 0.7), (0, 0, 0), width=64, height=48)
        lens = splat_lens(camera, np.zeros(3), 0.01, 0.3, False)
        self.lens, self.held = wp.array([lens], dtype=project.Lens, device=device), lens
        numbers = {f"rate_{name}": rate for name, rate in RATES.items()} | {"rate_colors": COLORS}
        numbers |= {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-15, "every": 1, "most_log_scale": 30.0} | changes
        self.numbers = numbers
        self.colors = wp.zeros(self.count, dtype=wp.vec3, device=device)
        self.weights = wp.zeros((self.count, 16), dtype=wp.float32, device=device)
        self.missed = wp.zeros(2, dtype=wp.int32, device=device)
        self.floors = wp.zeros(0, dtype=wp.float32, device=device)

    def step(self, number, sums):
        """The slopes that the step goes by, in float64, after it was made."""
        step = splat_step.SplatStep()
        for name, value in self.numbers.items():
            setattr(step, name, value)
        step.mean_factor, step.root_factor = 1 / (1 - 0.9**number), 1 / (1 - 0.999**number) ** 0.5
        step.seed = number
        steps = wp.array([step], dtype=splat_step.SplatStep, device=self.device)
        growing, device = self.growing, self.device
        view = wp.zeros(3 * self.count, dtype=wp.vec4, device=device)
        depths, order = (wp.zeros(self.count, dtype=kind, device=device) for kind in (wp.float32, wp.int32))
        launch(project.project_splats, self.count, [growing.splats, self.held], [view, depths, order], device=device)
        unseen = ~np.isfinite(depths.numpy())
        sums = np.where(unseen[:, None], 0.0, sums).astype(np.float32)
        sums = wp.array(sums.ravel(), dtype=wp.float32, device=device)
        slopes = project_slopes.SplatValues()
        for name in KINDS:
            setattr(slopes, name, wp.zeros_like(getattr(growing.values, name)))
        held = [growing.values.log_scales, growing.values.quaternions]
        inputs = [growing.splats, self.held, *held, view, sums]
        launch(project_slopes.find_value_slopes, self.count, inputs, [slopes], device=device)
        found = {name: getattr(slopes, name).numpy().astype(np.float64) for name in KINDS}
        rows = [growing.values, growing.means, growing.squares]
        inputs = [growing.splats, self.lens, steps, self.missed, self.floors, view, sums, *rows]
        launch(splat_step.step_splats, self.count, inputs, [self.colors, self.weights], device=device)
        bases = growing.numbers // 3
        together = bases if self.device.is_cpu else 1
        inputs = [bases, together, steps, self.missed, self.colors, self.weights]
        arrays = [each.harmonics for each in rows]
        launch(splat_step.step_harmonics, self.count * bases // together, inputs, arrays, device=device)
        return found, unseen

    def values(self):
        return {name: getattr(self.growing.values, name).numpy().astype(np.float64) for name in KINDS}


@pytest.mark.parametrize("every", [0, 1])
def test_values_step_as_adam_is_written(every, device):
    weights = {"opacity_weight": 2e-3, "scale_weight": 5e-3}
    contents = some_contents()
    contents.centers[:7, 1] -= 50.0  # behind the camera
    stepper = Stepper(contents, device, every=every, **weights)
    rng = np.random.default_rng(3)
    expected = stepper.values()
    means = {name: np.zeros_like(array) for name, array in expected.items()}
    squares = {name: np.zeros_like(array) for name, array in expected.items()}
    for number in range(1, 5):
        sums = 0.1 * rng.normal(size=(50, 9))
        slopes, unseen = stepper.step(number, sums)
        opacity = 1 / (1 + np.exp(-expected["logits"]))
        slopes["logits"] += weights["opacity_weight"] * opacity * (1 - opacity)
        slopes["log_scales"] += weights["scale_weight"] * np.exp(expected["log_scales"])
        moves = np.ones(50, bool) if every else ~unseen
        for name, slope in slopes.items():
            rows = (moves, *[None] * (slope.ndim - 1))
            mean = 0.9 * means[name] + 0.1 * slope
            square = 0.999 * squares[name] + 0.001 * slope**2
            rate = np.full(slope.shape[-1] if slope.ndim > 1 else 1, RATES[name])
            if name == "harmonics":
                rate[:3] = COLORS
            rate = rate if slope.ndim > 1 else rate[0]
            change = rate * (mean / (1 - 0.9**number)) / (np.sqrt(square / (1 - 0.999**number)) + 1e-15)
            mask = moves.reshape(-1, *[1] * (slope.ndim - 1))
            assert rows[0].any()
            means[name], squares[name] = np.where(mask, mean, means[name]), np.where(mask, square, squares[name])
            expected[name] = np.where(mask, expected[name] - change, expected[name])
        found = stepper.values()
        for name in KINDS:
            assert np.abs(found[name] - expected[name]).max() < 2e-2 * RATES[name] * number + 1e-6, name
        expected = found  # so that roundings do not add up
    assert unseen[:7].all() and not unseen.all()
    assert (np.abs(found["logits"][:7] - contents.logits[:7]).max() > 0) == bool(every)


def test_splats_are_made_of_the_values_after_the_step(device):
    stepper = Stepper(some_contents(), device)
    stepper.step(1, SUMS)
    values, splats = stepper.values(), stepper.growing.splats
    factors = rotation_matrices(values["quaternions"]) * np.exp(values["log_scales"])[:, None, :]
    covariances = factors @ factors.transpose(0, 2, 1)
    found = splats.covariances.numpy()[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    assert np.abs(found - covariances).max() < 1e-5 * np.abs(covariances).max()
    assert np.allclose(splats.opacities.numpy(), 1 / (1 + np.exp(-values["logits"])), atol=1e-6)


def beyond(log_scales, most):
    """Sum of what longest axes are longer than middle ones allow, and its slopes by central differences, float64."""

    def ratios(logs):
        ordered = np.sort(logs, axis=-1)
        return np.maximum(np.exp(ordered[..., 2] - ordered[..., 1]) - most, 0.0)

    changes = 1e-6 * np.eye(3)
    ends = [ratios(log_scales[:, None, :] + side * changes) for side in (1, -1)]
    return ratios(log_scales), (ends[0] - ends[1]) / 2e-6


def test_needles_are_a_loss(device):
    """Adam's means after a first step are a tenth of the slopes."""
    contents, weight, most = some_contents(), 0.02, 1.5
    found = []
    for options in ({}, {"most_elongation": most, "elongation_weight": weight}):
        stepper = Stepper(contents, device, **options)
        stepper.step(1, SUMS)
        found.append(10 * stepper.growing.means.log_scales.numpy().astype(np.float64))
    long, slopes = beyond(contents.log_scales.astype(np.float64), most)
    assert 5 < (long > 0).sum() < 45
    assert np.abs(found[1] - found[0] - weight * slopes).max() < 1e-5 * np.abs(found[0]).max()


def test_splats_are_no_smaller_than_pixels_of_the_nearest_picture_that_has_them(device):
    rng, device = np.random.default_rng(0), wp.get_device(device)
    centers = rng.uniform(-3, 3, (400, 3)).astype(np.float32)
    cameras = [
        Camera.look_at(3 * (eye / np.linalg.norm(eye)), 0.3 * rng.normal(size=3), width=64, height=40 + 9 * number)
        for number, eye in enumerate(rng.normal(size=(3, 3)))
    ]
    lenses = wp.array([splat_lens(each, np.zeros(3), 0.01, 0.3, False) for each in cameras], dtype=project.Lens)
    floors = wp.zeros(400, dtype=wp.float32, device=device)
    inputs = [0.447, lenses.to(device), wp.array(centers, dtype=wp.vec3, device=device)]
    launch(splat_step.find_floors, 400, inputs, [floors], device=device)
    least = np.full(400, np.inf)
    for camera in cameras:
        pixels, depths = camera.project(centers.astype(np.float64))
        shares = pixels / (camera.width, camera.height)
        seen = (depths > 0.01) & (np.abs(shares - 0.5) <= 0.65).all(axis=1)
        least[seen] = np.minimum(least[seen], depths[seen] / max(camera.fx, camera.fy))
    seen = np.isfinite(least)
    assert 100 < seen.sum() < 390
    assert np.abs(floors.numpy()[seen] - np.log(0.447 * least[seen])).max() < 1e-4
    assert (floors.numpy()[~seen] == -np.inf).all()


def test_scales_stay_between_their_bounds(device):
    stepper = Stepper(some_contents(), device, most_log_scale=-2.0)
    stepper.step(1, SUMS)
    assert stepper.values()["log_scales"].max() == -2.0
    stepper = Stepper(some_contents(), device)
    floors = np.where(np.arange(50) % 2, -2.0, -np.inf).astype(np.float32)
    stepper.floors = wp.array(floors, dtype=wp.float32, device=device)
    stepper.step(1, SUMS)
    logs = stepper.values()["log_scales"]
    assert logs[1::2].min() == -2.0 and logs[::2].min() < -2.2 and (logs[1::2] > -2).any()


def test_a_picture_without_room_changes_nothing(device):
    contents = some_contents()
    stepper = Stepper(contents, device, noise=1.0)
    stepper.missed.fill_(1)
    stepper.step(1, SUMS)
    for name, values in stepper.values().items():
        assert (values == getattr(contents, name).reshape(values.shape)).all()


def test_splats_that_are_almost_nothing_wander_within_their_shape(device):
    """The mean square of the way along each axis is that of a normal number through the covariance."""
    count, noise = 20000, 3.0
    contents = some_contents(1, degree=0)
    row = {name: np.repeat(array, count, axis=0) for name, array in vars(contents).items() if array is not None}
    row["logits"][:] = np.log(0.002 / 0.998)
    row["logits"][count // 2 :] = np.log(0.3 / 0.7)
    still = {f"rate_{name}": 0.0 for name in (*KINDS, "colors")}
    stepper = Stepper(SplatContents(**row), device, degree=0, noise=noise, **still)
    stepper.step(1, np.zeros((count, 9)))
    moved = stepper.values()["centers"] - row["centers"]
    assert (moved[count // 2 :] == 0).all()
    field = SplatField.from_contents(contents, device=device)
    share = noise / (1 + np.exp(100 * (0.002 - 0.005)))
    spread = share * field.covariances[0]
    expected = spread @ spread.T
    found = moved[: count // 2].T @ moved[: count // 2] / (count // 2)
    assert np.abs(found - expected).max() < 0.06 * np.abs(expected).max()
