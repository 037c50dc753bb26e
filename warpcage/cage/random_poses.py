"""Smooth random paths from rest (bends, twists, tapers, waves, bumps), to the bit the same everywhere."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from ..coordinates.reference_mvc import mean_value_gradients
from ..core.checks import checked_whole, shown
from ..core.names import checked_choice
from ..errors import InputError
from ..mesh.faces import column_dot, face_edges
from ..mesh.mesh import ClosedMesh
from ..mesh.queries import crossing_faces
from ..mesh.validity import first_problem, require_usable, winding_numbers

#: The kinds of modes, in the order in which their numbers are drawn.
POSE_MODES = ("bend", "twist", "stretch", "taper", "wave", "bump")

#: Cells along each edge of a face of more than three corners, of the surface that is probed.
CELLS = 1

#: The ends of paths: radians over the whole length; the ratio of the lengths of a stretch's ends, (1 + s) / (1 - s);
#: the change of width of a taper; shares of the size for the amplitude of waves and bumps.
MAX_BEND, MAX_TWIST, MAX_STRETCH, MAX_TAPER, MAX_WAVE, MAX_BUMP = 3.0, 3.4, 0.5, 0.8, 0.12, 0.45

#: Lengths of waves and radii of bumps, shares of the size.
_WAVE_NUMBERS, _BUMP_RADII = (0.25, 0.75), (0.35, 0.8)

#: Waves and bumps of a path.
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


class PosePath:
    """A random path of a cage's vertices (v, 3), world units, away from rest; `modes` may act, of `POSE_MODES`."""

    def __init__(self, vertices: np.ndarray, random: RandomNumbers, modes: Sequence[str] = POSE_MODES):
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self._center, self._size = 0.5 * (low + high), float((high - low).max())
        places = (vertices - self._center) / self._size
        self._places: Columns = tuple(np.ascontiguousarray(places[:, k]) for k in range(3))
        # one mode or more, each with a probability of 1/2; amounts even up to the ends of their modes, both ways
        acting = [random.number() < 0.5 for _ in POSE_MODES]
        chosen = random.whole(len(modes))
        kinds = {kind for kind, acts in zip(POSE_MODES, acting, strict=True) if acts and kind in modes}
        self.kinds = tuple(kind for kind in POSE_MODES if kind in (kinds or {modes[chosen]}))
        self.bend = (*_frame(random), random.number(-1.0, 1.0))  # axes, and amounts last
        self.twist = (random.direction(), random.number(-1.0, 1.0))
        self.stretch = (random.direction(), random.number(-1.0, 1.0))
        self.taper = (random.direction(), random.number(-1.0, 1.0))
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
        self._scale = 1.0 / max(abs(mode[-1]) for kind in self.kinds for mode in self._of(kind))  # one gets to its end

    def _of(self, kind: str) -> list[tuple]:
        """The modes of a kind: what each needs, and its amount last."""
        found = {"wave": self._waves, "bump": self._bumps}
        return found[kind] if kind in found else [getattr(self, kind)]

    def at(self, t: float) -> np.ndarray:
        """The vertices (v, 3), world units, at a place of the path from 0, at rest, to 1; their mean stays."""
        x = rest = self._places
        # first bumps and waves, then what changes widths and lengths, then what turns
        for kind, act in (("bump", self._bumped), ("wave", self._waved), ("stretch", self._stretched),
                          ("taper", self._tapered), ("twist", self._twisted), ("bend", self._bent)):  # fmt: skip
            if kind in self.kinds:
                x = act(x, t * self._scale)
        # math.fsum rounds the exact sum: it has no order
        shifts = [math.fsum((new - old).tolist()) / len(old) for new, old in zip(x, rest, strict=True)]
        moved = np.stack([new - shift for new, shift in zip(x, shifts, strict=True)], axis=1)
        return self._center + self._size * moved

    def _bumped(self, x: Columns, t: float) -> Columns:
        """Surroundings of a vertex move along: w(d / r) of an offset, w(s) = (1 - s)^2 (1 + 2 s)."""
        for vertex, radius, direction, amount in self._bumps:
            offset = [place - place[vertex] for place in self._places]
            s = np.minimum(np.sqrt(_dot(offset, offset)) / radius, 1.0)
            x = _moved(x, t * MAX_BUMP * amount * ((1.0 - s) * (1.0 - s) * (1.0 + 2.0 * s)), direction)
        return x

    def _waved(self, x: Columns, t: float) -> Columns:
        """x + a sin(2 pi (k . x + phase)) e."""
        for wave, phase, direction, amount in self._waves:
            turns = _dot(self._places, wave) + phase
            x = _moved(x, t * MAX_WAVE * amount * _sine_of_turns(turns), direction)
        return x

    def _stretched(self, x: Columns, t: float) -> Columns:
        """Longer along an axis and thinner across it, or shorter and thicker: volume stays."""
        axis, amount = self.stretch
        change = t * MAX_STRETCH * amount
        factor = (1.0 + change) / (1.0 - change)
        across = 1.0 / math.sqrt(factor)
        return _moved(tuple(across * part for part in x), (factor - across) * _dot(x, axis), axis)

    def _tapered(self, x: Columns, t: float) -> Columns:
        """Wider and wider across an axis, along it."""
        axis, amount = self.taper
        along = _dot(x, axis)
        factor = 1.0 + t * MAX_TAPER * amount * along / _reach(along)
        return _moved(tuple(factor * part for part in x), (1.0 - factor) * along, axis)

    def _twisted(self, x: Columns, t: float) -> Columns:
        """Turned about an axis through the middle, by an angle that grows along it (Rodrigues' formula)."""
        axis, amount = self.twist
        along = _dot(x, axis)
        angle = t * MAX_TWIST * amount * 0.5 * along / _reach(along)
        sine, versed = _sine_and_versed(angle)
        turned = _cross(axis, x)
        across = tuple(part - along * e for part, e in zip(x, axis, strict=True))
        # the part across turns: cos = 1 - versed
        return tuple(part + sine * side - versed * flat for part, side, flat in zip(x, turned, across, strict=True))

    def _bent(self, x: Columns, t: float) -> Columns:
        """The line through the middle along an axis becomes a circular arc, as in `warpcage.cage.poses.bend`, whose
        middle stays."""
        axis, towards, amount = self.bend
        along, side = _dot(x, axis), _dot(x, towards)
        rate = t * MAX_BEND * amount * 0.5 / _reach(along)
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


#: Least and largest stretch of random poses.
DEFAULT_STRETCH = (0.5, 2.0)

#: How far a pose goes, as shares of the farthest that the bounds allow.
DEFAULT_REACH = (0.3, 1.0)


@dataclasses.dataclass(frozen=True)
class RandomPoseOptions:
    """What `RandomPoses` takes besides the cage."""

    seed: int = 0
    stretch: Sequence[float] = DEFAULT_STRETCH  # least and largest length over that at rest, all places and directions
    reach: Sequence[float] = DEFAULT_REACH  # shares of its farthest amplitude that a pose's lies between, evenly
    modes: Sequence[str] = POSE_MODES

    def __post_init__(self) -> None:
        if isinstance(self.modes, str) or not isinstance(self.modes, Sequence):
            raise InputError(f"modes of random poses must be a list of {', '.join(POSE_MODES)}, got {self.modes!r}")
        found = {
            "seed": checked_whole(self.seed, "the seed of random poses", 0),
            "stretch": _pair(self.stretch, "stretch"),
            "reach": _pair(self.reach, "reach"),
            "modes": tuple(checked_choice(mode, "a mode of random poses", POSE_MODES) for mode in self.modes),
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)
        if not 0.0 < self.stretch[0] < 1.0 < self.stretch[1]:
            raise InputError(
                f"stretch must hold 1 between two positive bounds, such as 0.5 and 2, got {shown(self.stretch)}"
            )
        if not 0.0 < self.reach[0] <= self.reach[1] <= 1.0:
            raise InputError(f"reach must be two shares above 0 and up to 1, the lower first, got {shown(self.reach)}")
        if not self.modes:
            raise InputError(f"random poses need at least one mode of {', '.join(POSE_MODES)}")


def _pair(values: Sequence[float], name: str) -> tuple[float, float]:
    """Two finite numbers."""
    try:
        pair = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        pair = np.empty(0)
    if pair.shape != (2,) or not np.isfinite(pair).all():
        raise InputError(f"{name} must be two finite numbers, got {shown(values)}")
    return float(pair[0]), float(pair[1])


#: Samples inside a cage, about.
SAMPLES = 300

#: Length of finite differences, as a share of the size. In float64 they are right to six digits.
DIFFERENCE = 1e-6

#: Samples are this far from the surface, as a share of their distance from each other; nearer where a cage is so thin
#: that few are left.
CLEARANCES = (0.15, 0.01, 0.001)

#: Share of the requested samples that is enough.
ENOUGH = 0.3


@dataclass(frozen=True)
class Stretch:
    """Least and largest length after a pose over the length before, over all directions."""

    least: float  # 0 or less where space is turned inside out, or where matter is sent out of the posed cage
    largest: float

    def within(self, least: float, largest: float) -> bool:
        """Whether both lie between two bounds."""
        return self.least >= least and self.largest <= largest

    def __or__(self, other: Stretch) -> Stretch:
        return Stretch(min(self.least, other.least), max(self.largest, other.largest))


class PoseProbe:
    """Measures poses of one usable cage, at about `samples` places inside."""

    # Inside, matter moves by mean value coordinates: those of the cage at rest carry points along ("forward", as meshes
    # and splats go), those of the posed cage say where a place has its matter from ("backward", as fields; paper,
    # section 3). `forward` is linear, so quick: gradients are worked out once. `backward` takes hundredths of a second.

    def __init__(self, rest: ClosedMesh, samples: int = SAMPLES):
        self.rest, self._surface = rest, rest.refined(CELLS)
        rest = self._surface
        self._step = DIFFERENCE * rest.size
        self.places = _places(rest, samples)
        self._weights, gradients = mean_value_gradients(self.places, rest, self._step)
        self._gradients = gradients.reshape(-1, len(rest.vertices))
        self._crossing = {tuple(pair) for pair in crossing_faces(rest).tolist()}

    def faces(self, posed: ClosedMesh) -> Stretch:
        """How much faces stretch: the singular values of the maps of their planes."""
        # in the frame of a face at rest, u along its first edge, the map takes [u, v] = [[a, b], [0, c]] to [s, t]
        u, v = face_edges(self._surface)
        s, t = face_edges(posed.refined(CELLS))
        a = np.sqrt(column_dot(u, u))
        b = column_dot(u, v) / a
        c = np.sqrt(column_dot(v - u * (b / a), v - u * (b / a)))
        first, second = s / a, (t - s * (b / a)) / c
        p, q, r = column_dot(first, first), column_dot(first, second), column_dot(second, second)
        mean, half = 0.5 * (p + r), np.sqrt(0.25 * (p - r) ** 2 + q * q)
        return Stretch(float(np.sqrt(np.maximum(mean - half, 0.0)).min()), float(np.sqrt(mean + half).max()))

    def forward(self, posed: ClosedMesh) -> Stretch:
        """How much the inside stretches as points are carried along; the least is 0 or less where det J <= 0."""
        jacobian = (self._gradients @ posed.refined(CELLS).vertices).reshape(-1, 3, 3)
        least, largest = _singular_values(jacobian)
        return Stretch(least, largest)

    def backward(self, posed: ClosedMesh) -> Stretch:
        """How much the inside stretches in pictures of the pose.
        The least is 0 where det J <= 0, and where a sample is carried out of the posed cage."""
        if not len(self.places):
            return Stretch(1.0, 1.0)
        posed = posed.refined(CELLS)
        places = self._weights @ (posed.vertices - posed.vertices[0]) + posed.vertices[0]
        if not _inside(places, posed).all():
            return Stretch(0.0, 1.0)
        _, gradients = mean_value_gradients(places, posed, self._step)
        least, largest = _singular_values(np.matmul(gradients, self._surface.vertices))
        # 1 over the singular values of the map posed -> rest, at the places where the samples are carried to
        return Stretch(1.0 / largest, 1.0 / least) if least > 0.0 else Stretch(0.0, 1.0)

    def crosses(self, posed: ClosedMesh) -> bool:
        """Whether faces cross that do not at rest, or the pose cannot be used."""
        if first_problem(posed):
            return True
        found = crossing_faces(posed.refined(CELLS)).tolist()
        return any(tuple(pair) not in self._crossing for pair in found)


def _places(rest: ClosedMesh, samples: int) -> np.ndarray:
    """About so many places (n, 3) inside a cage, clear of its surface; none where it is too thin for any."""
    from .check import grid_points

    points, spacing = grid_points(rest, samples)
    places = points[:0]
    for clearance in CLEARANCES:
        around = clearance * spacing * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        inside = _inside((points[:, None] + around).reshape(-1, 3), rest).reshape(-1, 7).all(axis=1)
        places = points[inside]
        if len(places) >= ENOUGH * samples:
            break
    return places


def _inside(points: np.ndarray, mesh: ClosedMesh) -> np.ndarray:
    """Whether points (n, 3) are inside a mesh, by winding numbers in float64."""
    return winding_numbers(points, mesh.vertices, mesh.faces) > 0.5


def _singular_values(jacobian: np.ndarray) -> tuple[float, float]:
    """Least and largest singular value of matrices (n, 3, 3), the least negated where one turns inside out."""
    if not len(jacobian):
        return 1.0, 1.0
    values = np.linalg.svd(jacobian, compute_uv=False)
    folded = np.linalg.det(jacobian) <= 0.0
    return (-1.0 if folded.any() else 1.0) * float(values[:, 2].min()), float(values[:, 0].max())


Posed = TypeVar("Posed", bound=ClosedMesh)

#: Steps of a path from rest, and how often the last one is halved: the farthest pose is known to 1 / 256 of the way.
STEPS, HALVINGS = 8, 5

#: A pose that is out of bounds after all goes back to this share of its path, so often at most.
BACK, MAX_BACK = 0.75, 8

#: Paths that are tried before a cage is refused.
MAX_WAYS = 64


class RandomPoses(Generic[Posed]):
    """Random plausible poses of a cage, numbered from 0. A number always has the same pose, whatever others are made.

    A pose goes some way along a random smooth path from rest: bends, twists, stretches, tapers, waves and bumps of
    space (`warpcage.cage.random_poses`), one or several of them. Its amplitude is a random share of the largest that is
    allowed: on the whole way to it the faces, and the inside by mean value coordinates, stretch within the bounds and
    turn nowhere inside out. So poses of all strengths up to the bounds come out, and none lies at them by force. The
    pose itself is measured as pictures show it (posed -> rest) too, and its faces must not cross; where that fails it
    goes back along its way. All is measured on all faces and at about 300 places inside: between them it may stretch
    more, near edges above all. Other coordinates stretch otherwise; docs/sweeps.md has measured figures.

    Vertices are the same to the bit on all processors, but where a measured stretch is within some 1e-12 of a bound.

    Args:
        rest: The cage; usable.
        seed: Another one gives other poses; a whole number from 0.
        stretch: Least and largest length in a pose over the length at rest, over all places and directions.
        reach: (2,) shares between which a pose's share of its farthest amplitude lies, evenly.
        modes: Which modes may act, of "bend", "twist", "stretch", "taper", "wave" and "bump".
        probe: What measures the poses, where others of the same cage have made it. None makes one when it is needed.

    Raises:
        ValueError: For a cage that is not usable, bounds that do not hold 1 between them, or other options that cannot
            be.

    Example:
        `deformer.pose(RandomPoses(cage, seed=7).pose(12)).render(camera)`
    """

    def __init__(
        self,
        rest: Posed,
        *,
        seed: int = 0,
        stretch: Sequence[float] = DEFAULT_STRETCH,
        reach: Sequence[float] = DEFAULT_REACH,
        modes: Sequence[str] = POSE_MODES,
        probe: PoseProbe | None = None,
    ):
        require_usable(rest, "rest cage")
        self.rest = rest
        self.chance = chance = RandomPoseOptions(seed, stretch, reach, modes)
        self.seed, self.stretch, self.reach, self.modes = chance.seed, chance.stretch, chance.reach, chance.modes
        if probe is not None and probe.rest is not rest:
            raise InputError("the probe of random poses must be one of the very cage that they are poses of")
        self._probe = probe

    def pose(self, number: int) -> Posed:
        """A pose.

        Args:
            number: Which, a whole number from 0.

        Returns:
            The pose.

        Raises:
            ValueError: For another number, or where no way from rest stays within the bounds.
        """
        return self.rest.with_vertices(self.vertices(number))

    def vertices(self, number: int) -> np.ndarray:
        """The vertices of a pose.

        Args:
            number: Which, a whole number from 0.

        Returns:
            (v, 3) float64, world units.

        Raises:
            ValueError: For another number, or where no way from rest stays within the bounds.
        """
        number = checked_whole(number, "the number of a random pose", 0)
        for attempt in range(MAX_WAYS):
            random = RandomNumbers(self.seed, (number, attempt))
            share = random.number(*self.reach)
            path = PosePath(self.rest.vertices, random, self.modes)
            t = self._farthest(path) * share
            for _ in range(MAX_BACK if t > 0.0 else 0):
                posed = self.rest.with_vertices(path.at(t))
                if self._allowed(posed):
                    return posed.vertices
                t *= BACK
        raise InputError(
            f"no random pose of this cage stretches by {self.stretch[0]:g} to {self.stretch[1]:g} without folds: allow "
            "more stretch, or look for crossing faces and slivers (Cage.check)"
        )

    def _farthest(self, path: PosePath) -> float:
        """The end of the allowed part of a path; 0 where it ends within the first 256th."""
        good, step = 0.0, 1.0 / STEPS
        while good < 1.0 and self._smooth(self.rest.with_vertices(path.at(good + step))):
            good += step
        for _ in range(HALVINGS if good < 1.0 else 0):
            step *= 0.5
            if self._smooth(self.rest.with_vertices(path.at(good + step))):
                good += step
        return good

    def _smooth(self, posed: Posed) -> bool:
        """Whether a pose passes the quick tests."""
        probe = self.probe
        return probe.faces(posed).within(*self.stretch) and probe.forward(posed).within(*self.stretch)

    def _allowed(self, posed: Posed) -> bool:
        """Whether a pose passes all tests."""
        probe = self.probe
        return self._smooth(posed) and not probe.crosses(posed) and probe.backward(posed).within(*self.stretch)

    @property
    def probe(self) -> PoseProbe:
        """What measures the poses; made when it is first needed."""
        if self._probe is None:
            self._probe = PoseProbe(self.rest)
        return self._probe
