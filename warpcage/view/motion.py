"""Keys on an axis of time: values and cages between them, films that loop, and the times of frames."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from fractions import Fraction
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..core.names import MAX_FRAMES, checked_choice
from ..easings import Easing, eased_share
from ..errors import InputError
from ..package import lazy_exports

#: Largest denominator of a rate, that of the television rates such as 30000/1001.
MAX_DENOMINATOR = 1001

#: Rates of television are these by 1001/1000; decimals so near to one stand for it, as 23.976 and 23.98 for 24000/1001.
TELEVISION, ROUNDED = (15, 24, 30, 48, 60, 120, 240), Fraction(1, 200)


Time = TypeVar("Time", float, Fraction)


def value_at(
    times: Sequence[float],
    values: Sequence[np.ndarray],
    time: float,
    easings: Sequence[Easing] | None = None,
    *,
    still_ends: bool = True,
    closed: bool = False,
) -> np.ndarray:
    """The interpolated value of keys, ascending in time; constant before the first and after the last one.
    `values`: (d,) d separate numbers, or (..., d) vectors. The result may be a key's array: do not write to it."""
    # "smooth" is a cubic with continuous velocity that never overshoots its keys: velocities are limited
    # (`limited_velocity`) along vectors, so that a rotated scene moves alike. "hold" stays until the next key.
    # Others are functions of the share of the time. `still_ends`: smooth segments begin and end at rest.
    # `closed`: the last key is the first again, passed without stopping.
    index = bisect.bisect_right(times, time) - 1
    if index < 0 or index == len(times) - 1:
        return values[max(index, 0)]
    easing = "smooth" if easings is None else easings[index]
    begin, end = values[index], values[index + 1]
    length = times[index + 1] - times[index]
    share = (time - times[index]) / length
    if share == 0.0 or easing == "hold" or np.array_equal(begin, end):
        return begin
    if easing == "smooth":
        velocities = _Velocities(times, values, easings, still_ends, closed)
        eased = share * share * (3.0 - 2.0 * share)
        value = begin + eased * (end - begin)
        value += length * share * (1.0 - share) ** 2 * velocities.at(index)
        value -= length * share * share * (1.0 - share) * velocities.at(index + 1)
    else:
        value = begin + eased_share(easing, share) * (end - begin)
    value.setflags(write=False)
    return value


class _Velocities:
    """Velocities at keys of smooth segments; see `value_at`."""

    def __init__(self, times, values, easings, still_ends: bool, closed: bool):
        self.times, self.values, self.easings = times, values, easings
        self.still_ends, self.closed = still_ends, closed and len(times) > 2

    def at(self, index: int) -> np.ndarray | float:
        last = len(self.times) - 1
        if index in (0, last) and not self.closed:
            return 0.0 if self.still_ends else self._slope(0 if index == 0 else last - 1)
        before, after = (index - 1, index) if 0 < index < last else (last - 1, 0)
        if "hold" in (self._easing(before), self._easing(after)):
            return 0.0
        return limited_velocity(self._slope(before), self._slope(after), self._length(before), self._length(after))

    def _easing(self, index: int) -> Easing:
        return "smooth" if self.easings is None else self.easings[index]

    def _length(self, index: int) -> float:
        return self.times[index + 1] - self.times[index]

    def _slope(self, index: int) -> np.ndarray:
        length = self._length(index)
        change = self.values[index + 1] - self.values[index]
        return np.zeros_like(change) if length == 0.0 else change / length


def limited_velocity(before: np.ndarray, after: np.ndarray, length_before: float, length_after: float) -> np.ndarray:
    """The velocity at a key: that from the key before to the key after, limited so that nothing overshoots.
    `before`, `after`: mean velocities of the two segments, (d,) separate numbers or (..., d) vectors."""
    # Components against either segment are removed, and it is at most three times the slower of both (Fritsch and
    # Carlson 1980). In one dimension this keeps monotone keys monotone and makes extrema flat.
    one, two = (value[..., None] if value.ndim == 1 else value for value in (before, after))
    velocity = (length_before * one + length_after * two) / max(length_before + length_after, 1e-300)
    slower = np.sqrt(np.minimum(_dot(one, one), _dot(two, two)))
    for way in (one, two):
        against = np.minimum(_dot(velocity, way), 0.0)
        velocity = velocity - against / np.maximum(_dot(way, way), 1e-300) * way
    speed = np.sqrt(_dot(velocity, velocity))
    velocity = velocity * np.minimum(1.0, 3.0 * slower / np.maximum(speed, 1e-300))
    return velocity.reshape(before.shape)


def _dot(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    return (one * two).sum(axis=-1, keepdims=True)


def looped_time(loop: str, length: Time, elapsed: Time) -> Time:
    """Where a film is that has been played for `elapsed`: seconds, floats or fractions, 0 to its `length`."""
    zero = length - length
    if length <= 0:
        return zero
    if loop == "once":
        return min(max(elapsed, zero), length)
    if loop == "loop":
        return elapsed % length
    place = elapsed % (length + length)
    return place if place <= length else length + length - place


def frame_count(length: float, fps: float | Fraction, loop: str = "once") -> int:
    """The number of a film's frames, at least one."""
    # Played once, it ends with the frame at its length, if any; in a loop the frame after the last is the first.
    rate = frame_rate(fps)
    exact_length = whole_frames(length, rate)
    exact = (2 * exact_length if loop == "ping-pong" else exact_length) * rate
    return exact.__floor__() + 1 if loop == "once" else max(1, exact.__ceil__())


def frame_times(length: float, fps: float | Fraction, loop: str = "once") -> list[float]:
    """The times of a film's frames, seconds from its start, at least one."""
    rate, count = frame_rate(fps), frame_count(length, fps, loop)
    if count > MAX_FRAMES:
        raise InputError(f"a film has at most {MAX_FRAMES} frames, {length:g} s at {float(rate):g} would have {count}")
    return [time_at(index, length, rate, loop) for index in range(count)]


def time_at(frame: float, length: float, rate: Fraction, loop: str) -> float:
    """The time of a film's frame, or between two of them, seconds from its start."""
    return float(looped_time(loop, whole_frames(length, rate), Fraction(frame) / rate))


def frame_rate(fps: float | Fraction) -> Fraction:
    """Frames per second as a fraction whose denominator is at most 1001: the nearest, or the television rate that
    decimals such as 23.976, 29.97 and 59.94 stand for, 30000/1001."""
    exact = fps if isinstance(fps, Fraction) else Fraction(repr(float(fps)))
    television = [Fraction(1000 * whole, MAX_DENOMINATOR) for whole in TELEVISION]
    meant = [rate for rate in television if abs(exact - rate) < ROUNDED]
    rate = meant[0] if meant else exact.limit_denominator(MAX_DENOMINATOR)
    if rate <= 0:
        raise InputError(f"fps must be at least 1/{MAX_DENOMINATOR}, got {float(fps):g}")
    return rate


def whole_frames(length: float, rate: Fraction) -> Fraction:
    """A length as a fraction: a whole number of frames where it is one but for the last digits of a float."""
    exact = Fraction(repr(float(length)))
    frames = round(exact * rate)
    return frames / rate if abs(exact * rate - frames) < Fraction(1, 10**6) else exact


#: How it goes from one keyframe to the next.
INTERPOLATIONS = ("smooth", "linear")


def value_along(values: Sequence[np.ndarray], place: float, interpolation: str = "smooth") -> np.ndarray:
    """The value at a place among keyframes, from 0 for the first to len(values) - 1 for the last.
    `values` are arrays of one shape: (d,) d separate numbers, or (..., d) vectors."""
    # "linear" joins keyframes by straight lines, "smooth" is that of `value_at`, straight at both ends.
    checked_choice(interpolation, "interpolation", INTERPOLATIONS)
    if not 0 <= place <= len(values) - 1:
        raise InputError(f"a place among {len(values)} keyframes must be 0 to {len(values) - 1}, got {place}")
    return value_at(range(len(values)), values, place, [interpolation] * len(values), still_ends=False)


def evenly(begin: float, end: float, count: int, frames: ArrayLike | None = None) -> np.ndarray:
    """Evenly spaced numbers from `begin` to `end`; frames: (n,) of `count`, whole or between, or None for all."""
    numbers = np.linspace(begin, end, count)
    return numbers if frames is None else np.interp(np.asarray(frames, np.float64), np.arange(count), numbers)


def axis_rotation(axis: ArrayLike, angle: float) -> np.ndarray:
    """The rotation (3, 3) about a unit vector (3,) by an angle, radians, counterclockwise seen from its tip."""
    x, y, z = np.asarray(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross  # Rodrigues' formula


#: Of `warpcage.studio.films.motion`, which were here up to version 0.2.
__getattr__ = lazy_exports(str(__package__), {"film_motion": "cameras_along frame_places pose_along pose_weights"})[0]
