"""By what random poses are drawn, checked before any cage is there."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..core.checks import checked_whole, shown
from ..core.names import require_name
from .pose_modes import POSE_MODES

#: Least and largest stretch of random poses.
USUAL_STRETCH = (0.5, 2.0)

#: How far a pose goes, as shares of the farthest that the bounds allow.
USUAL_REACH = (0.3, 1.0)


@dataclasses.dataclass(frozen=True)
class PoseChance:
    """What `RandomPoses` takes besides the cage."""

    seed: int = 0
    # least and largest length in a pose over the length at rest, over all places and directions
    stretch: Sequence[float] = USUAL_STRETCH
    # (2,) shares between which a pose's share of its farthest amplitude lies, evenly
    reach: Sequence[float] = USUAL_REACH
    modes: Sequence[str] = POSE_MODES

    def __post_init__(self) -> None:
        if isinstance(self.modes, str) or not isinstance(self.modes, Sequence):
            raise ValueError(f"modes of random poses must be a list of {', '.join(POSE_MODES)}, got {self.modes!r}")
        found = {
            "seed": checked_whole(self.seed, "the seed of random poses", 0),
            "stretch": _pair(self.stretch, "stretch"),
            "reach": _pair(self.reach, "reach"),
            "modes": tuple(require_name(mode, POSE_MODES, "a mode of random poses") for mode in self.modes),
        }
        for name, value in found.items():
            object.__setattr__(self, name, value)
        if not 0.0 < self.stretch[0] < 1.0 < self.stretch[1]:
            raise ValueError(
                f"stretch must hold 1 between two positive bounds, such as 0.5 and 2, got {shown(self.stretch)}"
            )
        if not 0.0 < self.reach[0] <= self.reach[1] <= 1.0:
            raise ValueError(f"reach must be two shares above 0 and up to 1, the lower first, got {shown(self.reach)}")
        if not self.modes:
            raise ValueError(f"random poses need at least one mode of {', '.join(POSE_MODES)}")


def _pair(values: Sequence[float], name: str) -> tuple[float, float]:
    """Two finite numbers."""
    try:
        pair = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        pair = np.empty(0)
    if pair.shape != (2,) or not np.isfinite(pair).all():
        raise ValueError(f"{name} must be two finite numbers, got {shown(values)}")
    return float(pair[0]), float(pair[1])
