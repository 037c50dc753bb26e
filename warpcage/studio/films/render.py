"""How frames of a scene are rendered, one after another, which part of them pictures show, and what writes these."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ...cage.cage import Cage
from ...core.checks import Cuts
from ...core.files import PathLike, atomic_path
from ...deform.deformer import Deformer, PosedDeformer
from ...deform.objects import SceneObject, render_object, require_voxels
from ...deform.stage import Stage
from ...errors import InputError
from ...field.render import RenderOptions
from ...mesh.mesh import ClosedMesh
from ...mesh.validity import require_usable
from ...splats.splat_field import AnyField
from ...view import frame_parts
from ...view.camera import Camera
from ...view.exr import mean_picture, write_picture
from ...view.frame import Frame, depth_along_view
from ...view.frame_parts import rgba_picture
from ..spec.shot import ShotSpec
from .video import write_film_frame

#: What renders frames.
Scene: TypeAlias = SceneObject | PosedDeformer | Stage


@dataclasses.dataclass(frozen=True, eq=False)
class Look(RenderOptions):
    """How frames are rendered, and what their pictures show."""

    show: str = "rgb"  # what `frame_parts.picture` shows
    overlay: bool = False  # whether edges of cages are drawn

    @classmethod
    def of(cls, spec: ShotSpec, **changes: Any) -> Look:
        """The look of a spec's options of the same names; changes: others by name."""
        names = (field.name for field in dataclasses.fields(cls))
        return cls(**{name: getattr(spec, name) for name in names if hasattr(spec, name)} | changes)

    def render(self, scene: Scene, camera: Camera) -> Frame:
        """The view of a camera; stages are not filled."""
        return scene._render(camera, self) if isinstance(scene, Stage) else render_object(scene, camera, self)

    def picture(
        self, frame: Frame, camera: Camera, cages: Sequence[ClosedMesh] = (), scale: tuple[float, float] | None = None
    ) -> np.ndarray:
        """What is shown of a frame, (h, w, 3), (h, w) or, with straight opacity, (h, w, 4).
        cages: those of an overlay; scale: low and high disparity, None for those of the frame."""
        drawn = cages if self.overlay else ()
        if self.show == "rgb" and self.is_transparent:
            return rgba_picture(frame, camera, drawn)
        return frame_parts.picture(frame, self.show, camera, drawn, scale)


class Shot(NamedTuple):
    """A frame that was rendered, its camera, and the cages that an overlay draws."""

    frame: Frame
    camera: Camera
    cages: Sequence[ClosedMesh] = ()


def render_shot(look: Look, scene: Scene, camera: Camera, cages: Sequence[ClosedMesh] = ()) -> Shot:
    """The view of a camera of a scene in its pose."""
    return Shot(look.render(scene, camera), camera, cages)


def blurred_picture(
    look: Look, shots: Iterable[Shot], count: int, scale: tuple[float, float] | None = None
) -> tuple[np.ndarray, Shot]:
    """The mean of the pictures of `count` moments of a shutter, in linear light, and the shot in their middle."""
    pictures, middle = [], None
    for number, shot in enumerate(shots):
        pictures.append(look.picture(*shot, scale))
        middle = shot if number == count // 2 else middle
    assert middle is not None
    return mean_picture(pictures), middle


def pose_bytes(cages: Iterable[Cage | None]) -> tuple[bytes, ...]:
    """The vertices of posed cages, none of one that removes."""
    return tuple(b"" if cage is None else cage.vertices.tobytes() for cage in cages)


class HeldPose:
    """A Deformer that renders frame after frame: it is posed only where its cages move."""

    def __init__(self, deformer: Deformer):
        self.deformer = deformer
        self._held: tuple[bytes, ...] | None = None

    def pose(self, cages: Sequence[Cage | None], names: Sequence[str] = ()) -> bool:
        """Move the cages, one an edit, None for one that removes; returns whether that was to be done.
        names: how messages call cages that cannot be used."""
        pose = pose_bytes(cages)
        if pose == self._held:
            return False
        for name, cage in zip(names, cages, strict=False):
            if cage is not None:
                require_usable(cage, name)
        self._held = None  # should this fail, the next frame poses anew
        self.deformer.pose(cages)
        self._held = pose
        return True


def drawn_cages(deformer: Deformer, posed: Sequence[Cage | None] | None = None) -> list[Cage]:
    """The cages that an overlay shows: posed ones, with held walls at rest; at rest those whose content is removed.
    posed: those of a pose that is not its own."""
    posed = posed or deformer.deformed or [None] * len(deformer.edits)
    return [edit.cage if cage is None else cage for edit, cage in zip(deformer.edits, posed, strict=True)]


def require_fillable(field: AnyField, name: str) -> None:
    """Raises ValueError where there is nothing to fill; name: of the option, as the message begins."""
    if require_voxels(field, name).background_model is None:
        raise InputError(f"{name}: the background of this field is one colour, there is nothing to fill")


def picture_task(
    path: str | os.PathLike[str], image: np.ndarray, frame: Frame, camera: Camera, cuts: Cuts
) -> tuple[Callable[[], None], int]:
    """What writes a picture of a frame, .png, .npz, or .exr with its depth, in any thread, and the bytes it holds.
    cuts: counts what is cut of all pictures of a film."""
    # It needs neither the frame any more, nor what that has on a device.
    if os.fspath(path).lower().endswith(".npz"):
        return functools.partial(_write_film_frame, path, image, cuts), image.nbytes
    depth = depth_along_view(frame, camera) if os.fspath(path).lower().endswith(".exr") else None
    write = functools.partial(write_picture, path, image, depth, cuts=cuts)
    return write, image.nbytes + (0 if depth is None else depth.nbytes)


def _write_film_frame(path: PathLike, image: np.ndarray, cuts: Cuts) -> None:
    """The frame of a film with 16 bits, whole or not at all."""
    with atomic_path(path) as temporary:
        write_film_frame(temporary, image, cuts=cuts)
