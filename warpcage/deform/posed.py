"""Poses of callers that share a Deformer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..view.camera import Camera
from ..view.frame import Frame

if TYPE_CHECKING:
    from .deformer import Deformer


class PosedDeformer:
    """One pose of a Deformer that several callers share; see `Deformer.posed`."""

    def __init__(self, deformer: Deformer, cages: list[Cage | None]):
        self.deformer, self.deformed = deformer, cages  # posed cages, one per edit, None for one that removes

    def to_canonical(
        self, points: Any, directions: Any, *, step: float | None = None, return_outside: bool = False
    ) -> tuple[Any, ...]:
        """Where points (n, 3) of the deformed scene, world units, are in the canonical one; see
        `Deformer.to_canonical`."""
        shared = self.deformer
        with shared.lock:
            return shared._to_canonical(shared._hold(self.deformed), points, directions, step, return_outside)

    def render(
        self,
        camera: Camera,
        *,
        background: str | ArrayLike | None = None,
        step: float | None = None,
        supersampling: int | None = None,
        antialias: bool | None = None,
    ) -> Frame:
        """The view of a camera of the scene in this pose; see `Deformer.render`."""
        shared, options = self.deformer, (background, step, supersampling, antialias)
        with shared.lock:
            return shared._render(lambda: shared._hold(self.deformed), camera, *options)
