"""How a pose goes from rest to its end and back over the frames of a film."""

from __future__ import annotations

import numpy as np

MOTIONS = ("swing", "once", "hold")


def pose_weights(count: int, motion: str = "swing") -> np.ndarray:
    """(count,) weights of a pose in [0, 1], gentle at both ends.

    motion: "swing" from rest to the pose and back, so that the film loops without a repeated frame; "once" from rest to
    the pose; "hold" the pose throughout. Raises ValueError for no frames or another motion.
    """
    if count < 1:
        raise ValueError(f"a film needs at least one frame, got {count}")
    if motion == "swing":
        return 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(count) / count)
    if motion == "once":
        return 0.5 - 0.5 * np.cos(np.pi * np.arange(count) / max(1, count - 1))
    if motion == "hold":
        return np.ones(count)
    raise ValueError(f"motion {motion!r} is not known: {', '.join(MOTIONS)}")


def pose_between(rest, posed, weight: float):
    """The cage whose vertices lie on the straight way from `rest` (weight 0) to `posed` (weight 1), world units."""
    return rest.with_vertices((1.0 - weight) * rest.vertices + weight * posed.vertices)
