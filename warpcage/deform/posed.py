"""What a Deformer takes, and poses of callers that share one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, TypedDict, overload

import warp as wp
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..core.arrays import PointsLike
from ..core.names import Coordinates, Density, SplatMap, Store
from ..core.reports import Progress
from ..edits.edits import CageEdit
from ..view.camera import Camera
from ..view.frame import Frame, Frames
from .views import ViewOptions, render_pose

if TYPE_CHECKING:
    from typing_extensions import Unpack  # of the type checker

    from .deformer import Deformer


#: A pose of one cage: the Cage, its vertices (v, 3), or a file.
PoseLike: TypeAlias = "Cage | PointsLike | str | os.PathLike[str]"

#: What is posed: a cage, an edit, or several in their order.
RestLike: TypeAlias = Cage | CageEdit | Sequence[Cage | CageEdit]


class DeformerOptions(TypedDict, total=False):
    """Options of a Deformer by their names, for type checkers: `Deformer.__new__` has no more to say of them."""

    coordinates: Coordinates
    resolution: int | None
    density: Density
    device: wp.DeviceLike
    store: Store
    map: SplatMap | None
    progress: bool | Progress


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
