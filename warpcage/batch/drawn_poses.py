"""Random poses of items, drawn by whoever makes them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..cage.cage import Cage
from ..cage.random_poses import PoseProbe, RandomPoses
from ..core.memory import Recent
from .item import canonical
from .pose_words import RANDOM

#: Cages whose poses can be measured at once, and poses, that are kept: items of one pose follow each other.
MOST_PROBES, MOST_POSES = 8, 16


class DrawnPoses:
    """Draws poses, and keeps the last ones: several cameras show each."""

    def __init__(self) -> None:
        self._probes: Recent[PoseProbe] = Recent(MOST_PROBES)
        self._poses: Recent[np.ndarray] = Recent(MOST_POSES)

    def vertices(self, posed: dict[str, Any], rest: Cage, rest_hash: str) -> np.ndarray:
        """The vertices (v, 3) float64, world units, of a pose: those of `RandomPoses`, to the bit.
        posed: its words, as `pose_words.drawn_pose` returns them; rest_hash: the `cage_hash` of `rest`."""
        probe = self._probes.get(rest_hash, lambda: PoseProbe(rest))
        words = dict(posed[RANDOM])
        number = words.pop("number")

        def draw() -> np.ndarray:
            return RandomPoses(probe.rest, **words, probe=probe).vertices(number)

        return self._poses.get((rest_hash, canonical(posed)), draw)
