"""Smooth random ways away from rest: bends, twists, stretches, tapers, waves, bumps, to the bit the same everywhere."""
# A way is a path of poses x(t) from rest, t = 0, to its end, t = 1. Its modes are maps of space, so that a cage's
# vertices move as its inside should.
#
# Libraries differ in the last bits of sines, of sums and of products of matrices, from processor to processor. Here
# only sums, products, quotients and square roots of single numbers are taken, which IEEE 754 rounds alike everywhere,
# in a fixed order; sines are polynomials of them. Random numbers are the raw bits of PCG64.

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

#: The kinds of modes, in the order in which their numbers are drawn.
POSE_MODES = ("bend", "twist", "stretch", "taper", "wave", "bump")

#: The ends of ways: radians over the whole length; the ratio of the lengths of a stretch's ends, (1 + s) / (1 - s); the
#: change of width of a taper; shares of the size for the amplitude of waves and bumps.
_BEND, _TWIST, _STRETCH, _TAPER, _WAVE, _BUMP = 3.0, 3.4, 0.5, 0.8, 0.12, 0.45

#: Lengths of waves and radii of bumps, shares of the size.
_WAVE_NUMBERS, _BUMP_RADII = (0.25, 0.75), (0.35, 0.8)

#: Waves and bumps of a way.
_WAVES, _BUMPS = 2, 3

#: Coefficients of sin(p) / p and of (1 - cos(p)) / p^2 in powers of p^2: exact to a bit or two up to |p| = pi.
_SINE = [(-1) ** k / math.factorial(2 * k + 1) for k in range(15)]
_VERSED = [(-1) ** k / math.factorial(2 * k + 2) for k in range(15)]

#: A vector of columns: x, y and z of all vertices, or three numbers.
Columns = tuple


class RandomNumbers:
    """Numbers in [0, 1) from the raw bits of PCG64, whose stream NumPy never changes (NEP 19).
    The whole numbers of `key`, from 0 as `seed` is, make streams of their own."""

    def __init__(self, seed: int, key: Sequence[int]):
        self._bits = np.random.PCG64(np.random.SeedSequence(seed, spawn_key=tuple(key)))

    def number(self, low: float = 0.0, high: float = 1.0) -> float:
        """The next number, from `low` up to `high`."""
        return low + (high - low) * ((int(self._bits.random_raw()) >> 11) * 2.0**-53)

    def whole(self, count: int) -> int:
        """The next whole number, from 0 to count - 1."""
        return min(int(self.number() * count), count - 1)

    def direction(self) -> Columns:
        """The next unit vector, evenly over all directions."""
        while True:
            x, y, z = (self.number(-1.0, 1.0) for _ in range(3))
            square = x * x + y * y + z * z
            if 0.01 < square <= 1.0:
                length = math.sqrt(square)
                return x / length, y / length, z / length


class PoseWay:
    """A random way of a cage's vertices (v, 3), world units, away from rest; `modes` may act, of `POSE_MODES`."""

    def __init__(self, vertices: np.ndarray, random: RandomNumbers, modes: Sequence[str] = POSE_MODES):
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self._centre, self._size = 0.5 * (low + high), float((high - low).max())
        places = (vertices - self._centre) / self._size
        self._places: Columns = tuple(np.ascontiguousarray(places[:, k]) for k in range(3))
        # at least one mode acts, each with a probability of one half; amounts are drawn evenly between nothing and the
        # ends of their modes, in both senses
        acting = [random.number() < 0.5 for _ in POSE_MODES]
        chosen = random.whole(len(modes))
        kinds = {kind for kind, acts in zip(POSE_MODES, acting, strict=True) if acts and kind in modes}
        self.kinds = tuple(kind for kind in POSE_MODES if kind in (kinds or {modes[chosen]}))
        self._bend = (*_frame(random), random.number(-1.0, 1.0))
        self._twist = (random.direction(), random.number(-1.0, 1.0))
        self._stretch = (random.direction(), random.number(-1.0, 1.0))
        self._taper = (random.direction(), random.number(-1.0, 1.0))
        self._waves = [
            (
                _times(random.number(*_WAVE_NUMBERS), random.direction()),
                random.number(),
                random.direction(),
                random.number(),
            )
            for _ in range(_WAVES)
        ]
        self._bumps = [
            (random.whole(len(vertices)), random.number(*_BUMP_RADII), random.direction(), random.number())
            for _ in range(_BUMPS)
        ]
        self._bumps = self._bumps[: 1 + random.whole(_BUMPS)]
        # made larger together, so that one of the amounts gets to its end
        self._scale = 1.0 / max(abs(mode[-1]) for kind in self.kinds for mode in self._of(kind))

    def _of(self, kind: str) -> list[tuple]:
        """The modes of a kind: what each needs, and its amount last."""
        found = {"wave": self._waves, "bump": self._bumps}
        return found[kind] if kind in found else [getattr(self, f"_{kind}")]

    def at(self, t: float) -> np.ndarray:
        """The vertices (v, 3), world units, at a place of the way from 0, at rest, to 1; their mean stays."""
        x = rest = self._places
        # first bumps and waves, then what changes widths and lengths, then what turns
        for kind, act in (("bump", self._bumped), ("wave", self._waved), ("stretch", self._stretched),
                          ("taper", self._tapered), ("twist", self._twisted), ("bend", self._bent)):  # fmt: skip
            if kind in self.kinds:
                x = act(x, t * self._scale)
        # math.fsum rounds the exact sum: it has no order
        shifts = [math.fsum((new - old).tolist()) / len(old) for new, old in zip(x, rest, strict=True)]
        moved = np.stack([new - shift for new, shift in zip(x, shifts, strict=True)], axis=1)
        return self._centre + self._size * moved

    def _bumped(self, x: Columns, t: float) -> Columns:
        """Surroundings of a vertex move along: w(d / r) of an offset, w(s) = (1 - s)^2 (1 + 2 s)."""
        for vertex, radius, direction, amount in self._bumps:
            offset = [place - place[vertex] for place in self._places]
            s = np.minimum(np.sqrt(_dot(offset, offset)) / radius, 1.0)
            x = _moved(x, t * _BUMP * amount * ((1.0 - s) * (1.0 - s) * (1.0 + 2.0 * s)), direction)
        return x

    def _waved(self, x: Columns, t: float) -> Columns:
        """x + a sin(2 pi (k . x + phase)) e."""
        for wave, phase, direction, amount in self._waves:
            turns = _dot(self._places, wave) + phase
            x = _moved(x, t * _WAVE * amount * _sine_of_turns(turns), direction)
        return x

    def _stretched(self, x: Columns, t: float) -> Columns:
        """Longer along an axis and thinner across it, or shorter and thicker: volume stays."""
        axis, amount = self._stretch
        change = t * _STRETCH * amount
        factor = (1.0 + change) / (1.0 - change)
        across = 1.0 / math.sqrt(factor)
        return _moved(tuple(across * part for part in x), (factor - across) * _dot(x, axis), axis)

    def _tapered(self, x: Columns, t: float) -> Columns:
        """Wider and wider across an axis, along it."""
        axis, amount = self._taper
        along = _dot(x, axis)
        factor = 1.0 + t * _TAPER * amount * along / _reach(along)
        return _moved(tuple(factor * part for part in x), (1.0 - factor) * along, axis)

    def _twisted(self, x: Columns, t: float) -> Columns:
        """Turned about an axis through the middle, by an angle that grows along it (Rodrigues' formula)."""
        axis, amount = self._twist
        along = _dot(x, axis)
        angle = t * _TWIST * amount * 0.5 * along / _reach(along)
        sine, versed = _sine_and_versed(angle)
        turned = _cross(axis, x)
        across = tuple(part - along * e for part, e in zip(x, axis, strict=True))
        # the part across turns: cos = 1 - versed
        return tuple(part + sine * side - versed * flat for part, side, flat in zip(x, turned, across, strict=True))

    def _bent(self, x: Columns, t: float) -> Columns:
        """The line through the middle along an axis becomes a circular arc, as in `warpcage.cage.poses.bend`, whose
        middle stays."""
        axis, towards, amount = self._bend
        along, side = _dot(x, axis), _dot(x, towards)
        rate = t * _BEND * amount * 0.5 / _reach(along)
        angle = rate * along
        square = angle * angle
        sinc, arch = _polynomial(_SINE, square), _polynomial(_VERSED, square)
        new_along = along * sinc - side * (angle * sinc)
        new_side = along * (angle * arch) + side * (1.0 - square * arch)
        return _moved(_moved(x, new_along - along, axis), new_side - side, towards)


def _frame(random: RandomNumbers) -> tuple[Columns, Columns]:
    """Two unit vectors at right angles."""
    axis = random.direction()
    while True:
        other = random.direction()
        along = _dot(axis, other)
        across = tuple(part - along * e for part, e in zip(other, axis, strict=True))
        square = _dot(across, across)
        if square > 0.1:
            length = math.sqrt(square)
            return axis, tuple(part / length for part in across)


def _reach(along: np.ndarray) -> float:
    """How far places reach along an axis from the middle."""
    return max(float(np.abs(along).max()), 1e-12)


def _moved(x: Columns, amount: np.ndarray, direction: Columns) -> Columns:
    return tuple(part + amount * e for part, e in zip(x, direction, strict=True))


def _times(factor: float, vector: Columns) -> Columns:
    return tuple(factor * part for part in vector)


def _dot(a: Sequence, b: Sequence):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Sequence, b: Sequence) -> Columns:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _polynomial(coefficients: Sequence[float], x: np.ndarray) -> np.ndarray:
    """By Horner's rule."""
    value = np.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


def _sine_and_versed(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """sin(p) and 1 - cos(p) for |p| up to pi."""
    square = angle * angle
    return angle * _polynomial(_SINE, square), square * _polynomial(_VERSED, square)


def _sine_of_turns(turns: np.ndarray) -> np.ndarray:
    """sin(2 pi turns)."""
    part = turns - np.rint(turns)
    return _sine_and_versed(2.0 * math.pi * part)[0]
