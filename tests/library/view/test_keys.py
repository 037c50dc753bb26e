"""Keys in time: what is held stays, nothing overshoots, turned scenes move alike, loops close."""

import re
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from refusals import refused

from warpcage.core import EASINGS, checked_easing
from warpcage.view import eased_share, frame_rate, frame_times, limited_velocity, value_at

STEPS = st.floats(0.05, 3.0)
HEIGHTS = st.sampled_from([-1.0, 0.0, 0.0, 0.3, 1.0, 1.0, 7.0])


def test_keys_with_a_pencil():
    """A value of 2 at 1 s, of 6 at 3 s and of 5 at 4 s."""
    times, values = [1.0, 3.0, 4.0], [np.array([2.0]), np.array([6.0]), np.array([5.0])]

    def at(time, easing):
        return value_at(times, values, time, [easing] * 3)[0]

    assert [at(0.0, "linear"), at(9.0, "linear")] == [2.0, 5.0]  # before the first key and after the last
    assert at(1.5, "linear") == 2.0 + 0.25 * 4.0  # a quarter of two seconds
    assert at(1.5, "hold") == 2.0
    # at rest at both ends, as 6 is the highest: 3 t^2 - 2 t^3 of a quarter is 3/16 - 2/64 = 5/32 of the way of 4
    assert at(1.5, "smooth") == pytest.approx(2.0 + 5 / 32 * 4.0)
    assert at(3.5, "smooth") == pytest.approx(5.5)


def test_a_smooth_key_between_two_with_a_pencil():
    """0, 1 and 2 at 0, 1 and 2 s, at rest at both ends: the middle key is passed at 1 a second."""
    values = [np.array([float(k)]) for k in range(3)]
    # Hermite at half of the time: half of the way, less t^2 (1 - t) = 1/8 of the velocity at its end
    assert value_at([0.0, 1.0, 2.0], values, 0.5)[0] == pytest.approx(1 / 2 - 1 / 8)
    assert value_at([0.0, 1.0, 2.0], values, 1.5)[0] == pytest.approx(3 / 2 + 1 / 8)


@pytest.mark.scaled
@given(st.lists(st.tuples(STEPS, HEIGHTS), min_size=2, max_size=7), st.booleans())
def test_nothing_goes_beyond_its_keys(keys, still_ends):
    times = np.cumsum([step for step, _ in keys]).tolist()
    values = [np.array([height, -height]) for _, height in keys]
    for k in range(len(keys) - 1):
        way = [value_at(times, values, t, still_ends=still_ends) for t in np.linspace(times[k], times[k + 1], 21)]
        heights = np.array([value[0] for value in way])
        low, high = sorted((keys[k][1], keys[k + 1][1]))
        assert heights.min() >= low - 1e-12 and heights.max() <= high + 1e-12
        steps = np.diff(heights) * np.sign(keys[k + 1][1] - keys[k][1])
        assert (steps >= -1e-12).all()  # it rises where its keys do, and falls where they fall
        np.testing.assert_allclose([value[1] for value in way], -heights, atol=1e-12)


def way(easing, count=2201):
    shares = np.linspace(0.0, 1.0, count)
    return np.array([value_at([0.0, 1.0], [np.zeros(1), np.ones(1)], t, [easing] * 2)[0] for t in shares])


def test_what_eases_in_and_out_is_the_same_from_both_ends():
    np.testing.assert_allclose(way("ease-in-out"), 1.0 - way("ease-in-out")[::-1], atol=1e-12)
    np.testing.assert_allclose(way("ease-in-out")[:1101], 0.5 * way("ease-in")[::2], atol=1e-12)


def test_what_bounces_falls_with_one_gravity_and_never_beyond():
    """Four arcs of one curvature, which meet on the next key, each bounce a quarter as high as the one before."""
    found = way("bounce")
    assert found.max() <= 1.0 and found.min() >= 0.0
    gravity = np.diff(found, 2) * 2200**2
    impacts = np.flatnonzero(gravity < 0.0)
    np.testing.assert_allclose(np.delete(gravity, impacts), 2 * 2.75**2, rtol=1e-3)
    parts = np.split(found, [800, 1600, 2000])  # at 1, 2 and 2.5 of 2.75 times that of the fall
    np.testing.assert_allclose([1.0 - part.min() for part in parts], [1.0, 1 / 4, 1 / 16, 1 / 64], atol=1e-6)
    np.testing.assert_allclose(found[[800, 1600, 2000]], 1.0, atol=1e-12)


def bisected(x1, y1, x2, y2, share):
    """The height of a cubic-bezier above a share of the time, by halving alone."""

    def cubic(first, second, place):
        corners = np.array([0.0, first, second, 1.0])
        while len(corners) > 1:  # de Casteljau
            corners = corners[:-1] + place * np.diff(corners)
        return corners[0]

    low, high = 0.0, 1.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if cubic(x1, x2, middle) < share else (low, middle)
    return cubic(y1, y2, 0.5 * (low + high))


CURVES = [(0.25, 0.1, 0.25, 1.0), (0.42, 0.0, 0.58, 1.0), (0.0, 0.0, 1.0, 1.0), (0.3, -0.6, 0.7, 1.8), (0.9, 0, 1, 0.2)]
STEEP = [(1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 1.0), (1.0, 0.0, 1.0, 0.0), (0.0, -2.0, 1.0, 3.0), (1.0, 2.0, 0.0, -1.0)]


@pytest.mark.parametrize("numbers", CURVES + STEEP)
def test_curves_are_those_of_css(numbers):
    shares = np.linspace(0.0, 1.0, 101)
    expected = [bisected(*numbers, share) for share in shares[1:-1]]
    found = way({"bezier": numbers}, 101)
    assert found[0] == 0.0 and found[-1] == 1.0
    np.testing.assert_allclose(np.delete(found[1:-1], 49), np.delete(expected, 49), atol=1e-12)
    # (1, 0, 0, 1) stands upright in its middle, where 1e-16 of the time is 1e-5 of the way
    np.testing.assert_allclose(found[50], expected[49], atol=1e-4 if numbers[0] > numbers[2] else 1e-12)


@pytest.mark.scaled
@given(st.tuples(*[st.floats(0, 1), st.floats(-2, 3)] * 2), st.floats(0.001, 0.999))
def test_any_curve_is_met_at_the_time_of_its_place(numbers, share):
    (x1, y1, x2, y2), place = numbers, share
    x, y = (
        3 * (1 - place) ** 2 * place * a + 3 * (1 - place) * place**2 * b + place**3 for a, b in ((x1, x2), (y1, y2))
    )
    slope = 3 * ((1 - place) ** 2 * x1 + 2 * (1 - place) * place * (x2 - x1) + place**2 * (1 - x2))
    assume(slope > 1e-3)
    assert eased_share({"bezier": list(numbers)}, x) == pytest.approx(y, abs=1e-9)


def test_a_curve_of_one_line_is_linear_and_known_by_its_points():
    np.testing.assert_allclose(way({"bezier": [0.2, 0.2, 0.7, 0.7]}), way("linear"), atol=1e-12)
    # CSS's "ease" as browsers have it, to the digits that they print
    ease = {"bezier": [0.25, 0.1, 0.25, 1.0]}
    assert [eased_share(ease, share) for share in (0.25, 0.5, 0.75)] == pytest.approx(
        [0.408511, 0.802403, 0.960459], abs=5e-7
    )


@pytest.mark.parametrize(
    ("easing", "said"),
    [
        ({"bezier": [0.1, 0.2, 0.3]}, "must have four numbers"),
        ({"bezier": "ease"}, "must have four numbers"),
        ({"bezier": [1.2, 0, 0.5, 1]}, "x1 of it must be a number from 0 to 1"),
        ({"bezier": [0.2, 0, -0.5, 1]}, "x2 of it must be a number from 0 to 1"),
        ({"bezier": [0.2, float("nan"), 0.5, 1]}, "y1 of it must be one finite number"),
        ({"bezier": [0.2, 0, 0.5, "far"]}, "y2 of it must be one finite number"),
        ({"steps": 3}, "it must be one of smooth"),
        ({"bezier": [0, 0, 1, 1], "steps": 3}, "it must be one of smooth"),
        (3, 'or {"bezier": [x1, y1, x2, y2]}, got 3'),
        ("wobble", "it must be one of smooth"),
    ],
)
def test_wrong_easings_are_refused_in_one_line(easing, said):
    refused(lambda: checked_easing(easing, "it"), match=re.escape(said))


def test_what_is_elastic_swings_in_around_the_next_key():
    found = way("elastic") - 1.0
    crossings = np.flatnonzero(np.diff(np.sign(found)))
    assert len(crossings) >= 6 and 0.2 < found.max() < 0.4 and found.min() == -1.0
    peaks = [np.abs(part).max() for part in np.split(found, crossings + 1)]
    assert (np.diff(peaks[:6]) < 0.0).all() and abs(found[-1]) < 1e-12 and abs(found[-2]) < 1e-3


@pytest.mark.parametrize(
    "written, exact",
    [
        ("23.976", (24000, 1001)),
        ("23.98", (24000, 1001)),
        ("24", (24, 1)),
        ("25", (25, 1)),
        ("29.97", (30000, 1001)),
        ("30", (30, 1)),
        ("50", (50, 1)),
        ("59.94", (60000, 1001)),
        ("60", (60, 1)),
        ("12.5", (25, 2)),
        ("29.9", (299, 10)),
        ("999", (999, 1)),
    ],
)
def test_rates_of_film_and_television_are_exact(written, exact):
    """tests/studio/films/test_video.py reads them back of films."""
    assert frame_rate(float(written)) == frame_rate(Fraction(written)) == Fraction(*exact)


def test_what_two_keys_have_in_common_stays_still_while_the_rest_moves():
    rng = np.random.default_rng(3)
    values = [rng.normal(size=(6, 3)) for _ in range(4)]
    values[2][:3] = values[1][:3]
    for time in np.linspace(1.0, 2.0, 13):
        value = value_at(range(4), values, time)
        np.testing.assert_allclose(value[:3], values[1][:3], atol=1e-14)
    moved = value_at(range(4), values, 1.5)
    assert np.abs(moved[3:] - values[1][3:]).min() > 1e-4


def test_a_turned_scene_moves_in_the_same_way():
    rng = np.random.default_rng(4)
    values = [rng.normal(size=(20, 3)) for _ in range(5)]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    times = [0.0, 0.4, 1.0, 1.1, 3.0]
    for time in np.linspace(0, 3, 31):
        there = value_at(times, [value @ turn for value in values], time)
        np.testing.assert_allclose(there, value_at(times, values, time) @ turn, atol=1e-12)


def test_a_circle_is_gone_round_without_stopping():
    """Keys at every quarter: the ways at a right angle to one another do not hinder each other."""
    corners = [np.array([[np.cos(a), np.sin(a)]]) for a in np.pi / 2 * np.arange(5)]
    speed = [
        np.linalg.norm(value_at(range(5), corners, t + 1e-5) - value_at(range(5), corners, t - 1e-5)) / 2e-5
        for t in np.linspace(1, 3, 41)
    ]
    assert min(speed) > 0.9


@pytest.mark.parametrize("closed", [False, True])
def test_a_loop_goes_through_its_seam(closed):
    values = [np.array([value]) for value in (0.0, 1.0, 0.0, -1.0, 0.0)]
    end = (value_at(range(5), values, 4.0)[0] - value_at(range(5), values, 4.0 - 1e-6, closed=closed)[0]) / 1e-6
    begin = (value_at(range(5), values, 1e-6, closed=closed)[0] - 0.0) / 1e-6
    assert begin == pytest.approx(1.0 if closed else 0.0, abs=1e-4)
    assert end == pytest.approx(begin, abs=1e-4)


def test_velocities_worked_out_manually():
    def velocity(before, after):
        return limited_velocity(np.array([before]), np.array([after]), 1.0, 1.0)[0].tolist()

    assert velocity([1.0, 0.0], [1.0, 0.0]) == [1.0, 0.0]
    assert velocity([1.0, 0.0], [0.0, 0.0]) == [0.0, 0.0]  # a hold
    assert velocity([1.0, 0.0], [-0.5, 0.0]) == [0.0, 0.0]  # a turning point
    assert velocity([1.0, 0.0], [9.0, 0.0]) == pytest.approx([3.0, 0.0])  # three times the slower
    assert velocity([1.0, 0.0], [0.0, 1.0]) == [0.5, 0.5]
    assert limited_velocity(np.array([1.0, 1.0]), np.array([3.0, -3.0]), 1.0, 3.0).tolist() == [2.5, 0.0]


@pytest.mark.parametrize("easing", [*EASINGS, {"bezier": [0.3, 0.1, 0.2, 1.0]}], ids=str)
def test_values_are_read_only_and_keys_are_their_own(easing):
    values = [np.zeros((2, 3)), np.ones((2, 3))]
    for value in values:
        value.setflags(write=False)
    between = value_at([0.0, 1.0], values, 0.3, [easing] * 2)
    assert not between.flags.writeable
    assert value_at([0.0, 1.0], values, 1.0, [easing] * 2) is values[1]


def test_frames_of_lengths_that_floats_cannot_hold():
    assert len(frame_times(23 / 24, 24.0)) == 24
    assert len(frame_times(1001 / 30000 * 10, 30000 / 1001)) == 11
    refused(lambda: frame_times(1e9, 24.0), match="at most 1000000 frames")
