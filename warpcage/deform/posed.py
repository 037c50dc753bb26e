"""Poses of callers that share one Deformer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, overload

from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..view.camera import Camera
from ..view.frame import Frame, Frames
from .poses import PoseLike
from .views import ViewOptions, render_pose

if TYPE_CHECKING:
    from typing_extensions import Unpack  # of the type checker

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
            return shared._backend.to_canonical(self.deformed, points, directions, step, return_outside)

    def sample(self, points: Any, directions: Any, *, step: float | None = None) -> tuple[Any, Any]:
        """Colour and density of the scene in this pose at points (n, 3), world units; see `Deformer.sample`."""
        shared = self.deformer
        with shared.lock:
            return shared._backend.sample(self.deformed, points, directions, step)

    @overload
    def render(self, camera: Camera, **options: Unpack[ViewOptions]) -> Frame: ...
    @overload
    def render(self, camera: Sequence[Camera], **options: Unpack[ViewOptions]) -> Frames: ...
    def render(
        self,
        camera: Camera | Sequence[Camera],
        *,
        background: str | ArrayLike | None = None,
        step: float | None = None,
        supersampling: int | None = None,
        antialias: bool | None = None,
        outputs: str | Sequence[str] = (),
        flow_pose: PoseLike | Sequence[PoseLike | None] | None = None,
        flow_camera: Camera | Sequence[Camera] | None = None,
    ) -> Frame | Frames:
        """The view of a camera, or those of several, of the scene in this pose; see `Deformer.render`."""
        shared, how = self.deformer, (background, step, supersampling, antialias)
        with shared.lock:
            return render_pose(shared._backend, self.deformed, camera, how, outputs, flow_pose, flow_camera)
