"""Fits of splats to pictures."""

import dataclasses

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused
from splat_scenes import VALUES, scene_of

import warpcage
from warpcage import Camera, SplatField, SplatRates, fit_splats, turntable


def some_field(device, count=150, seed=0, degree=2):
    rng = np.random.default_rng(seed)
    return SplatField(
        rng.uniform(-1, 1, (count, 3)) + (3, 2, 1),
        np.log(0.08) + 0.4 * rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        2 + rng.normal(size=count),
        0.3 * rng.normal(size=(count, (degree + 1) ** 2, 3)),
        background="white",
        device=device,
    )


def perturbed(field, share=1.0, seed=1):
    """The field with noise on all its values."""
    rng, held = np.random.default_rng(seed), field.contents
    noise = {"centers": 0.02, "log_scales": 0.2, "quaternions": 0.1, "logits": 0.5, "harmonics": 0.1}
    values = [getattr(held, name) + share * noise[name] * rng.normal(size=getattr(held, name).shape) for name in VALUES]
    return SplatField(*values, device=field.device, **field.view_options())


def views(count, size=32):
    return turntable((3, 2, 1), 4.0, 20, count, width=size, height=size)


def pictures(field, cameras, **options):
    return [field.render(camera, **options).rgb for camera in cameras]


def psnr(field, cameras, images, **options):
    return np.mean([warpcage.psnr(*each) for each in zip(pictures(field, cameras, **options), images, strict=True)])


def test_a_fitted_field_is_drawn_as_it_was_fitted(device):
    """By default the field says whether splats are antialiased."""
    field, cameras = some_field(device, 40, degree=0), views(2, 16)
    for flag in (False, True):
        begin = SplatField.from_contents(field.contents, background="white", antialias=flag, device=device)
        images = pictures(begin, cameras)
        np.testing.assert_array_equal(images, pictures(field, cameras, antialias=flag))
        fits = [
            fit_splats(begin, cameras, images, steps=2, progress=False, **options)
            for options in ({}, {"antialias": True}, {"antialias": False})
        ]
        assert [each.antialias for each in fits] == [flag, True, False]
        same = fits[1 if flag else 2].contents
        np.testing.assert_allclose(fits[0].contents.log_scales, same.log_scales, atol=1e-5)
        assert begin.painted(np.ones(40, bool)).antialias is flag
    fit = warpcage.SplatFit(scene_of(field, cameras), device=device, antialias=True, most_splats=50)
    assert fit.field.antialias


@pytest.mark.parametrize("options", [{}, {"supersampling": 2, "antialias": True}])
def test_a_perturbed_field_is_found_again(options, device):
    """Also from where no picture was taken."""
    field = some_field(device)
    begin = perturbed(field)
    train, test = views(12), views(24)[1::8]
    images, others = pictures(field, train, **options), pictures(field, test, **options)
    before = psnr(begin, test, others, **options)
    fitted = fit_splats(begin, train, images, steps=400, progress=False, **options)
    assert before < 26 and psnr(fitted, test, others, **options) > before + 10
    assert psnr(fitted, train, images, **options) > before + 12
    assert (begin.contents.centers == perturbed(field).contents.centers).all()


@pytest.mark.parametrize("name", VALUES)
def test_one_kind_of_values_is_found_again(name, device):
    """With the others as they are, and held there."""
    field = some_field(device)
    values = {each: getattr(field.contents, each) for each in VALUES}
    values[name] = getattr(perturbed(field, 1.5).contents, name)
    begin = SplatField(*values.values(), device=field.device, **field.view_options())
    train = views(8)
    images = pictures(field, train)
    kinds = {"harmonics": ("colors", "harmonics")}.get(name, (name,))
    rates = {each.name: each.default * (each.name in kinds) for each in dataclasses.fields(SplatRates)}
    rates = {each: 5 * rate for each, rate in rates.items()} | {"last": 0.05}
    fitted = fit_splats(begin, train, images, steps=250, rates=SplatRates(**rates), progress=False)
    assert psnr(fitted, train, images) > psnr(begin, train, images) + 8
    for each in set(VALUES) - {name}:
        near = np.abs(getattr(fitted.contents, each) - values[each]).max()
        assert near < 1e-6


def test_the_loss_of_absolute_differences(device):
    field = some_field(device)
    begin, train = perturbed(field), views(8)
    images = pictures(field, train)
    fitted = fit_splats(begin, train, images, steps=100, loss="l1", progress=False)
    assert psnr(fitted, train, images) > psnr(begin, train, images) + 3


def test_splats_grow_as_far_as_they_may(device):
    field = some_field(device)
    centers, log_scales, *others = (getattr(field.contents, name) for name in VALUES)
    small = SplatField(centers, log_scales - 1.0, *others, device=field.device)
    train, rates = views(4), SplatRates(log_scales=0.05)
    images = pictures(field, train, background="black")
    fitted = fit_splats(small, train, images, steps=60, growth=1.2, progress=False, rates=rates)
    growth = np.exp(fitted.contents.log_scales - small.contents.log_scales)
    assert growth.max() < 1.2 + 1e-4 and (growth > 1.199).mean() > 0.2


def test_fits_are_the_same_on_a_cpu(two_threads):
    """On any number of threads, with the same seed; another order of pictures makes another field."""
    field = some_field("cpu", 100)
    begin, train = perturbed(field), views(5, 33)
    images = pictures(field, train)
    fits = [fit_splats(begin, train, images, steps=12, seed=seed, progress=False).contents for seed in (3, 3, 4)]
    assert (fits[0].harmonics == fits[1].harmonics).all() and (fits[0].centers == fits[1].centers).all()
    assert (fits[0].harmonics != fits[2].harmonics).any()


def test_pictures_of_several_sizes_and_files_with_more(device, tmp_path):
    some_field("cpu", 50).save(tmp_path / "field.ply")
    field = SplatField.load(tmp_path / "field.ply", device=device)
    train = [Camera.look_at((3, -2, 2), (3, 2, 1), width=w, height=h) for w, h in ((20, 31), (40, 17))]
    fitted = fit_splats(field, train, pictures(field, train), steps=2, progress=False)
    fitted.save(tmp_path / "fitted.ply")
    again = SplatField.load(tmp_path / "fitted.ply", device=device)
    assert (again.contents.harmonics == fitted.contents.harmonics).all() and fitted.background.tolist() == [0, 0, 0]
    assert (tmp_path / "fitted.ply").stat().st_size == (tmp_path / "field.ply").stat().st_size


def test_what_no_picture_sees_stays_to_the_bit(device):
    field, view = some_field(device, 50), [Camera.look_at((30, 2, 1), (60, 2, 1), width=16, height=16)]
    fitted = fit_splats(field, view, np.zeros((1, 16, 16, 3)), steps=5, progress=False)
    for name in VALUES:
        assert (getattr(fitted.contents, name) == getattr(field.contents, name)).all()


def test_bad_input(device):
    field = some_field(device, 10)
    view = views(1, 16)
    image = np.zeros((1, 16, 16, 3))
    for arguments, options, message in (
        (("field", view, image), {}, "SplatField"),
        ((field, [], []), {}, "pictures, a camera each"),
        ((field, view, np.zeros((2, 16, 16, 3))), {}, "2 and 1 cameras"),
        ((field, ["front"], image), {}, "Camera"),
        ((field, view[0], image), {}, MESSAGES["splats.cameras_list"]),
        ((field, view, None), {}, MESSAGES["splats.images_list"]),
        ((field, view, [field.render(view[0])]), {}, MESSAGES["splats.picture_of_frame"]),
        ((field, view, ["front.png"]), {}, MESSAGES["splats.picture_of_text"]),
        ((field, view, np.full((1, 16, 16, 3), 200, np.uint8)), {}, "picture 0 has .* 200: .*divided by 255"),
        ((field, view, np.zeros((1, 15, 16, 3))), {}, r"picture 0 must be \(16, 16, 3\)"),
        ((field, view, np.full((1, 16, 16, 3), np.nan)), {}, "finite"),
        ((field, view, image), {"steps": 0}, "steps"),
        ((field, view, image), {"loss": "l3"}, "l1, l2"),
        ((field, view, image), {"supersampling": 9}, "supersampling"),
        ((field, view, image), {"blur": 0}, "blur"),
        ((field, view, image), {"growth": 0.9}, "growth"),
        ((field, view, image), {"background": "mauve"}, "mauve"),
        ((field, view, image), {"seed": 1.5}, "seed"),
        ((field, view, image), {"rates": "high"}, "rates must be a SplatRates, got str"),
        ((field, view, image), {"rates": SplatRates(log_scales=1e4)}, "range of float32, with smaller rates"),
        ((field.chosen([]), view, image), {}, "without splats"),
    ):
        with pytest.raises(ValueError, match=message):
            fit_splats(*arguments, **{"steps": 1, "progress": False, **options})


@pytest.mark.parametrize("bad", [{"centers": -1}, {"colors": np.nan}, {"logits": "high"}, {"last": 0}, {"last": 2}])
def test_bad_rates(bad):
    refused(lambda: SplatRates(**bad), match=next(iter(bad)))
