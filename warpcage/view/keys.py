"""Keys on an axis of time: values between them, films that loop, and the times of frames."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from fractions import Fraction
from typing import TypeVar

import numpy as np

from .film import MAX_DENOMINATOR

#: Most frames that a film may have.
MAX_FRAMES = 1_000_000

Time = TypeVar("Time", float, Fraction)


def value_at(
    times: Sequence[float],
    values: Sequence[np.ndarray],
    time: float,
    easings: Sequence[str] | None = None,
    *,
    still_ends: bool = True,
    closed: bool = False,
) -> np.ndarray:
    """What keys, ascending in time, come to at a time. Before the first and after the last one all is still.
    `values`: (d,) d numbers of their own or (..., d) vectors. Do not write what comes back: it may be a key's own."""
    # "smooth" is a cubic whose velocity does not jump at keys. Nothing swings beyond its keys, and what two keys have
    # in common stays still between them: velocities are limited (`limited_velocity`) along vectors, so that a turned
    # scene moves in the same way. "hold" stays at its key until the next; "ease-in" sets out gently, "ease-out" arrives
    # so. `still_ends`: smooth ways set out from the first key and arrive at the last one at rest. `closed`: the last
    # key is the first one again, a loop, which goes through it without stopping.
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
        eased = {"linear": share, "ease-in": share * share, "ease-out": share * (2.0 - share)}[easing]
        value = begin + eased * (end - begin)
    value.setflags(write=False)
    return value


class _Velocities:
    """What smooth ways have at keys; see `value_at`."""

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

    def _easing(self, index: int) -> str:
        return "smooth" if self.easings is None else self.easings[index]

    def _length(self, index: int) -> float:
        return self.times[index + 1] - self.times[index]

    def _slope(self, index: int) -> np.ndarray:
        length = self._length(index)
        change = self.values[index + 1] - self.values[index]
        return np.zeros_like(change) if length == 0.0 else change / length


def limited_velocity(before: np.ndarray, after: np.ndarray, length_before: float, length_after: float) -> np.ndarray:
    """The velocity at a key between two ways: that from the key before to the key after, as far as nothing overshoots.
    `before`, `after`: velocities of the straight ways, (d,) numbers of their own or (..., d) vectors."""
    # What would turn against either way is taken out of it, and it is at most three times the slower of both (Fritsch
    # and Carlson 1980). Along one line that keeps what rises rising and makes turning points flat.
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


def frame_times(length: float, fps: float | Fraction, loop: str = "once") -> list[float]:
    """The times of a film's frames, seconds from its start, at least one."""
    # A film that is played once ends with the frame at its length, where a frame falls on it. A film that loops or goes
    # back and forth has every moment of its round once: the frame after its last one is the first.
    rate = frame_rate(fps)
    exact_length = whole_frames(length, rate)
    period = 2 * exact_length if loop == "ping-pong" else exact_length
    exact = period * rate
    count = exact.__floor__() + 1 if loop == "once" else max(1, exact.__ceil__())
    if count > MAX_FRAMES:
        raise ValueError(f"a film has at most {MAX_FRAMES} frames, {length:g} s at {float(rate):g} would have {count}")
    return [float(looped_time(loop, exact_length, index / rate)) for index in range(count)]


def frame_rate(fps: float | Fraction) -> Fraction:
    """Frames per second as the nearest fraction whose denominator is at most 1001, such as 30000/1001 for 29.97003."""
    exact = fps if isinstance(fps, Fraction) else Fraction(repr(float(fps)))
    return exact.limit_denominator(MAX_DENOMINATOR)


def whole_frames(length: float, rate: Fraction) -> Fraction:
    """A length as a fraction: a whole number of frames where it is one but for the last digits of a float."""
    exact = Fraction(repr(float(length)))
    frames = round(exact * rate)
    return frames / rate if abs(exact * rate - frames) < Fraction(1, 10**6) else exact
