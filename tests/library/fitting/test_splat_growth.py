"""Splats that begin anew and that are added: against the equations of Kheradmand et al. 2024 in float64."""

import math

import numpy as np
import pytest
import warp as wp

from warpcage import Camera, SplatField
from warpcage.fitting.splats import GrowingSplats
from warpcage.splats import SplatContents


def shared(opacity, copies):
    """Opacity and factor on scales of each copy: the paper's double sum (Eq. 9)."""
    part = 1 - (1 - opacity) ** (1 / copies)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * part ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, copies + 1)
        for k in range(i)
    )
    return part, opacity / total


@pytest.mark.parametrize(
    ("opacity", "copies", "expected"),
    [
        (0.5, 2, (0.29289, 0.95215)),
        (0.99, 2, (0.9, 0.80669)),
        (0.1, 2, (0.05132, 0.99235)),
        (0.5, 3, (0.2063, 0.93688)),
        (0.9, 5, (0.36904, 0.79712)),
    ],
)
def test_the_oracle_has_the_values_that_are_known(opacity, copies, expected):
    assert np.allclose(shared(opacity, copies), expected, atol=1e-5)


def contents_of(opacities, seed=0, degree=1):
    rng, count = np.random.default_rng(seed), len(opacities)
    opacities = np.asarray(opacities, np.float64)
    return SplatContents(
        rng.normal(size=(count, 3)).astype(np.float32),
        rng.normal(-3, 0.3, (count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        np.log(opacities / (1 - opacities)).astype(np.float32),
        rng.normal(size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def sources_of(before, after):
    """Row of `before` of which each row of `after` has the colours."""
    rows = {colors.tobytes(): row for row, colors in enumerate(before.harmonics)}
    return np.array([rows[colors.tobytes()] for colors in after["harmonics"]])


def revived(before, device, seed):
    """Values of splats after those that are almost nothing begin anew."""
    growing = grown(before, 0, device)
    growing.revive(seed)
    return growing.to_contents(1)


def grown(contents, most, device, degree=1):
    return GrowingSplats(contents, most, degree, wp.get_device(device))


def opacities_of(after):
    return 1 / (1 + np.exp(-after["logits"].astype(np.float64)))


@pytest.mark.parametrize("opacity", [0.02, 0.3, 0.8, 0.99])
def test_copies_share_opacity_and_size(opacity, device):
    """One living splat among dead ones: all become it, as the equations say for so many copies."""
    for dead in (1, 2, 7, 30):
        before = contents_of([opacity] + [0.004] * dead)
        after = revived(before, device, seed=3)
        part, factor = shared(opacity, dead + 1)
        assert np.allclose(opacities_of(after), max(part, 0.005), rtol=2e-4)
        assert np.allclose(after["log_scales"], before.log_scales[0] + np.log(factor), atol=2e-4)
        for name in ("centers", "quaternions", "harmonics"):
            assert (after[name] == getattr(before, name)[:1]).all()


def test_fifty_one_copies_are_the_most_that_are_counted(device):
    before = contents_of([0.9] + [0.001] * 80)
    after = revived(before, device, seed=0)
    part, factor = shared(0.9, 51)
    assert np.allclose(opacities_of(after), part, rtol=1e-3)
    assert np.allclose(after["log_scales"], before.log_scales[0] + np.log(factor), atol=1e-3)


def test_places_are_drawn_by_opacity_and_the_dead_are_none_of_them(device):
    opacities = np.concatenate([[0.9, 0.45, 0.1], np.full(3000, 0.003)])
    before = contents_of(opacities)
    drawn = np.bincount(sources_of(before, revived(before, device, seed=5)), minlength=3003)
    assert (drawn[3:] == 0).all() and drawn.sum() == 3003
    shares = opacities[:3] / opacities[:3].sum()
    assert np.abs((drawn[:3] - 1) / 3000 - shares).max() < 4 * np.sqrt(0.25 / 3000)


def test_sources_are_drawn_by_what_the_picture_changes_as_they_move(device):
    """By the fourth root of the size times the slope, and opacity."""
    opacities, slopes = np.array([0.9, 0.6, 0.3, 0.3]), np.array([1e-6, 1.6e-5, 1e-5, 0.0])
    before = contents_of(np.concatenate([opacities, np.full(4000, 0.003)]))
    growing = grown(before, 0, device)
    state = growing.state()
    state["squares"]["centers"][:4] = (slopes**2 / 3)[:, None]
    growing.restore(state)
    growing.revive(seed=5)
    drawn = np.bincount(sources_of(before, growing.to_contents(1)), minlength=4)
    sizes = np.exp(before.log_scales[:4].astype(np.float64).mean(axis=1))
    weights = opacities * np.maximum(1e8 * slopes * sizes, 1e-8) ** 0.25
    assert np.abs((drawn[:4] - 1) / 4000 - weights / weights.sum()).max() < 4 * np.sqrt(0.25 / 4000)


def test_growth_keeps_what_is_there_and_copies_the_rest(device):
    before = contents_of(np.random.default_rng(1).uniform(0.01, 0.95, 200))
    growing = grown(before, 300, device)
    growing.grow(260, seed=2)
    assert growing.count == 260
    after = growing.to_contents(1)
    sources = sources_of(before, after)
    assert (sources[:200] == np.arange(200)).all()
    copies = np.bincount(sources, minlength=200)
    opacities = 1 / (1 + np.exp(-before.logits.astype(np.float64)))
    for row, source in enumerate(sources):
        part, factor = shared(opacities[source], copies[source])
        assert abs(1 / (1 + math.exp(-after["logits"][row])) - max(part, 0.005)) < 1e-4
        assert np.allclose(after["log_scales"][row], before.log_scales[source] + np.log(factor), atol=1e-3)
    growing.grow(1000, seed=3)
    assert growing.count == 300  # the room there is


def test_the_picture_stays_when_splats_are_copied(device):
    """What the equations are for: from straight ahead a splat and its copies look the same, nearly."""
    before = contents_of([0.7, 0.001, 0.001], degree=0)
    growing = grown(before, 0, device, degree=0)
    camera = Camera.look_at(before.centers[0] + (0, -1.0, 0), before.centers[0], width=60, height=60)
    growing.revive(seed=0)
    fields = [
        SplatField.from_contents(each, device=device) for each in (before, SplatContents(**growing.to_contents(0)))
    ]
    first, second = (field.render(camera).alpha for field in fields)
    assert first.max() > 0.6 and np.abs(first - second).mean() < 0.01 * first.mean() + 0.004


def test_where_nothing_lives_nothing_is_copied(device):
    before = contents_of([0.001] * 20)
    growing = grown(before, 30, device)
    growing.revive(seed=0)
    after = growing.to_contents(1)
    assert (after["centers"] == before.centers).all() and (after["logits"] == before.logits).all()
    growing.grow(30, seed=1)
    assert growing.count == 30 and np.isfinite(growing.to_contents(1)["log_scales"]).all()


def test_the_same_seed_draws_the_same(device):
    before = contents_of(np.random.default_rng(1).uniform(0.001, 0.95, 500))
    found = []
    for seed in (4, 4, 5):
        growing = grown(before, 700, device)
        growing.revive(seed)
        growing.grow(650, seed + 1)
        found.append(growing.to_contents(1))
    assert all((found[0][name] == found[1][name]).all() for name in found[0])
    assert (found[0]["centers"] != found[2]["centers"]).any()
