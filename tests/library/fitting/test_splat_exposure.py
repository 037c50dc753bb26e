"""Exposures of pictures that are learnt with the splats: slopes by differences in float64, Adam, and scenes."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from fit_oracles import finished
from splat_scenes import held_out_psnr, ring, scene_of, true_field

from warpcage.core import launch
from warpcage.fitting.splats import PictureExposures, SplatFit
from warpcage.kernels.fitting import splat_step
from warpcage.kernels.fitting.batches import Pictures

WIDTH, HEIGHT, VIEWS = 13, 9, 3


class Exposing:
    """The launches of a step on a drawn picture, view 1 of three, with random numbers."""

    def __init__(self, device, seed=0):
        self.device, self.rng, pixels = wp.get_device(device), np.random.default_rng(seed), WIDTH * HEIGHT
        self.light, self.alpha = self.rng.random((pixels, 3)), self.rng.random(pixels)
        self.weights = self.rng.normal(size=(pixels, 3))  # of the loss, a sum over what is shown
        self.behind = self.rng.random(3)
        self.exposures = PictureExposures(VIEWS, self.device)
        self.numbers = 0.3 * self.rng.normal(size=(VIEWS, 6))
        state = np.zeros((VIEWS, 19))
        state[:, :6] = self.numbers
        self.exposures.restore(state)
        self.step = splat_step.SplatStep()
        self.step.view, self.step.background = 1, wp.vec3(*self.behind)
        self.step.beta1, self.step.beta2, self.step.epsilon, self.step.rate_exposure = 0.9, 0.999, 1e-15, 1e-2
        self.missed = wp.zeros(2, dtype=wp.int32, device=device)

    def array(self, values, dtype=wp.vec3):
        return wp.array(np.asarray(values, np.float32), dtype=dtype, device=self.device)

    def take(self):
        """What was drawn and what is shown, after a step."""
        pixels = WIDTH * HEIGHT
        pictures = Pictures()
        pictures.halves = wp.zeros((VIEWS, HEIGHT, WIDTH), dtype=wp.vec4h, device=self.device)
        steps = wp.array([self.step], dtype=splat_step.SplatStep, device=self.device)
        drawn, alpha = self.array(self.light), self.array(self.alpha, wp.float32)
        truth, shown = (wp.zeros(pixels, dtype=wp.vec3, device=self.device) for _ in range(2))
        counted = wp.zeros((0, 0, 0), dtype=wp.uint8, device=self.device)
        inputs = [WIDTH, pictures, steps, self.exposures.rows, counted, alpha]
        outputs = [drawn, truth, shown, wp.zeros(0, dtype=wp.float32, device=self.device)]
        launch(splat_step.take_picture, pixels, inputs, outputs, device=self.device)
        slopes = self.array(self.weights)
        self.exposures.take_back(steps, self.missed, alpha, drawn, slopes)
        return drawn.numpy(), shown.numpy(), slopes.numpy()

    def shown(self, light, numbers):
        """What is shown, in float64."""
        offset = self.alpha[:, None] * numbers[3:] + (1 - self.alpha[:, None]) * self.behind
        return np.exp(numbers[:3]) * light + offset

    def loss(self, light, numbers):
        return (self.weights * self.shown(light, numbers)).sum()


def test_what_is_shown_and_slopes_by_what_was_drawn(device):
    exposing = Exposing(device)
    drawn, shown, slopes = exposing.take()
    numbers = exposing.numbers[1]
    assert np.abs(shown - exposing.shown(exposing.light, numbers)).max() < 1e-5
    # the rasteriser takes slopes of gain * drawn + offset back, its own background in `drawn`
    assert np.abs(shown - np.exp(numbers[:3]) * drawn - numbers[3:]).max() < 1e-5
    for pixel, channel in ((0, 0), (50, 1), (116, 2)):
        change = np.zeros_like(exposing.light)
        change[pixel, channel] = 1e-4
        ends = [exposing.loss(exposing.light + side * change, numbers) for side in (1, -1)]
        assert abs((ends[0] - ends[1]) / 2e-4 - slopes[pixel, channel]) < 1e-5 * np.abs(slopes).max()


def test_a_picture_steps_by_its_own_slopes_as_adam_is_written(device):
    """Means of slopes by central differences; pictures that are not shown stay."""
    exposing, mean, square = Exposing(device), np.zeros(6), np.zeros(6)
    expected = exposing.numbers[1].astype(np.float32).astype(np.float64)
    for number in range(1, 4):
        exposing.weights = exposing.rng.normal(size=exposing.weights.shape)
        slope = np.empty(6)
        for index, change in enumerate(1e-4 * np.eye(6)):
            ends = [exposing.loss(exposing.light, expected + side * change) for side in (1, -1)]
            slope[index] = (ends[0] - ends[1]) / 2e-4
        mean, square = 0.9 * mean + 0.1 * slope, 0.999 * square + 0.001 * slope**2
        expected -= 1e-2 * (mean / (1 - 0.9**number)) / np.sqrt(square / (1 - 0.999**number))
        exposing.take()
        state = exposing.exposures.state()
        assert np.abs(state[1, 6:12] - mean).max() < 1e-4 * np.abs(mean).max() + 1e-5
        assert np.abs(state[1, :6] - expected).max() < 2e-4 * number
        assert state[:, 18].tolist() == [0, number, 0]
        assert (state[[0, 2], :6] == exposing.numbers[[0, 2]].astype(np.float32)).all()
    exposing.exposures.center()
    state = exposing.exposures.state()[:, :6]
    assert np.abs(state.mean(axis=0)).max() < 1e-6 and np.abs(np.ptp(state, axis=0)).min() > 0


@pytest.mark.parametrize("why", ["no room", "no rate"])
def test_nothing_is_learnt_without_room_or_before_its_time(why, device):
    exposing = Exposing(device)
    if why == "no room":
        exposing.missed.fill_(1)
    else:
        exposing.step.rate_exposure = 0.0
    before = exposing.exposures.state()
    exposing.take()
    assert (exposing.exposures.state() == before).all()


def exposed(scene, seed=0):
    """The pictures as differing exposures show them, and those, whose means are 0."""
    rng = np.random.default_rng(seed)
    numbers = np.concatenate([0.25 * rng.normal(size=(len(scene), 3)), 0.05 * rng.normal(size=(len(scene), 3))], axis=1)
    numbers -= numbers.mean(axis=0)
    gains, offsets = np.exp(numbers[:, None, None, :3]), numbers[:, None, None, 3:]
    images = gains * scene.images + scene.alphas[..., None] * offsets
    return dataclasses.replace(scene, images=np.clip(images, 0, 1)), numbers


def test_exposures_are_found_and_held_out_views_gain(device):
    truth = true_field(device)
    scene, numbers = exposed(scene_of(truth, ring(8, 20, (60, 50)) + ring(8, -10, (60, 50)), alphas=True))
    options = {"device": device, "rate_exposure": 2e-2, "steps": 600, "most_splats": 1000, "pixels_per_splat": 1.0}
    fields = {}
    for learnt in (False, True):
        fit = finished(SplatFit(scene, exposure=learnt, **options))
        fields[learnt] = held_out_psnr(fit.finish(), truth)
        assert learnt or (fit.exposures == 0).all()
    found = fit.exposures
    assert found.shape == (16, 6) and np.abs(found.mean(axis=0)).max() < 1e-6
    middle, true_middle = (0.5 * np.exp(each[:, :3]) + each[:, 3:] for each in (found, numbers))  # of a middle color
    assert np.abs(middle - true_middle).mean() < 0.4 * np.abs(true_middle - 0.5).mean()
    assert fields[True] > fields[False] + 1.5
