"""Random plausible poses of a cage, for data augmentation: smooth, without folds, and within bounds of stretch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np

from ..core.checks import checked_whole
from ..mesh.mesh import ClosedMesh
from ..mesh.validity import require_usable
from .pose_chance import USUAL_REACH, USUAL_STRETCH, PoseChance
from .pose_limits import PoseProbe
from .pose_modes import POSE_MODES, PoseWay, RandomNumbers

Posed = TypeVar("Posed", bound=ClosedMesh)

#: Steps of a way from rest, and how often the last one is halved: the farthest pose is known to 1 / 256 of the way.
STEPS, HALVINGS = 8, 5

#: A pose that is out of bounds after all goes back to this share of its way, so often at most.
BACK, MOST_BACK = 0.75, 8

#: Ways that are tried before a cage is given up.
MOST_WAYS = 64


class RandomPoses(Generic[Posed]):
    """Random plausible poses of a cage, numbered from 0. A number always has the same pose, whatever others are made.

    A pose goes some way along a random smooth path from rest: bends, twists, stretches, tapers, waves and bumps of
    space (`warpcage.cage.pose_modes`), one or several of them. How far is a random share of the farthest that is
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
        stretch: Sequence[float] = USUAL_STRETCH,
        reach: Sequence[float] = USUAL_REACH,
        modes: Sequence[str] = POSE_MODES,
        probe: PoseProbe | None = None,
    ):
        require_usable(rest, "rest cage")
        self.rest = rest
        self.chance = chance = PoseChance(seed, stretch, reach, modes)
        self.seed, self.stretch, self.reach, self.modes = chance.seed, chance.stretch, chance.reach, chance.modes
        if probe is not None and probe.rest is not rest:
            raise ValueError("the probe of random poses must be one of the very cage that they are poses of")
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
        for attempt in range(MOST_WAYS):
            random = RandomNumbers(self.seed, (number, attempt))
            share = random.number(*self.reach)
            way = PoseWay(self.rest.vertices, random, self.modes)
            t = self._farthest(way) * share
            for _ in range(MOST_BACK if t > 0.0 else 0):
                posed = self.rest.with_vertices(way.at(t))
                if self._allowed(posed):
                    return posed.vertices
                t *= BACK
        raise ValueError(
            f"no random pose of this cage stretches by {self.stretch[0]:g} to {self.stretch[1]:g} without folds: allow "
            "more stretch, or look for crossing faces and slivers (Cage.check)"
        )

    def _farthest(self, way: PoseWay) -> float:
        """The end of the allowed part of a way; 0 where it ends within the first 256th."""
        good, step = 0.0, 1.0 / STEPS
        while good < 1.0 and self._smooth(self.rest.with_vertices(way.at(good + step))):
            good += step
        for _ in range(HALVINGS if good < 1.0 else 0):
            step *= 0.5
            if self._smooth(self.rest.with_vertices(way.at(good + step))):
                good += step
        return good

    def _smooth(self, posed: Posed) -> bool:
        """Whether a pose is allowed by what is quick to find."""
        probe = self.probe
        return probe.faces(posed).within(*self.stretch) and probe.forward(posed).within(*self.stretch)

    def _allowed(self, posed: Posed) -> bool:
        """Whether a pose is allowed by all that is looked at."""
        probe = self.probe
        return self._smooth(posed) and not probe.crosses(posed) and probe.backward(posed).within(*self.stretch)

    @property
    def probe(self) -> PoseProbe:
        """What measures the poses; made when it is first needed."""
        if self._probe is None:
            self._probe = PoseProbe(self.rest)
        return self._probe
