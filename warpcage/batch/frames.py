"""Frames of items: fields and deformers that stay loaded, and the pictures of what they render."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from ..cage.cage import Cage
from ..core.arrays import array_bytes
from ..core.memory import LRUCache, free_bytes
from ..core.names import TRANSPARENT
from ..deform.deformer import Deformer
from ..deform.fill import fill_unseen
from ..edits.edits import CageEdit, picture_cells
from ..field.voxel_field import VoxelField
from ..render.modules import load_usual_modules
from ..splats.io import is_splat_file
from ..splats.splat_field import AnyField
from ..view.camera import Camera
from ..view.exr import write_picture
from ..view.film import write_film_frame
from ..view.frame import RGB_BYTES, Frame, depth_along_view
from ..view.frame_parts import picture
from ..view.opacity import rgba_picture
from .items import FrameItem, canonical
from .manifest import MadeItem, Writer, array_data, write_array
from .records import frame_record, pose_array
from .references import MEMORY_SHARE, LoadedFields, References, RestCage

#: Most deformers that stay bound to a field.
MOST_DEFORMERS = 4

#: Parts of a frame that no picture is needed for.
OF_RECORDS = ("pose", "record")

#: Endings of pictures with 8 bits a channel.
BYTE_ENDINGS = (".png", ".jpg", ".jpeg")

#: Arrays of a frame that a part is made of. Others are made of all.
ARRAYS_OF_PARTS = {
    "rgb": ("rgb",),
    "film": ("rgb",),
    "alpha": ("alpha",),
    "depth": ("alpha", "depth"),
    "disparity": ("alpha", "depth"),
    "reveal": ("reveal",),
    "fold": ("fold",),
    "outside": ("outside",),
}


@dataclasses.dataclass
class Counts:
    """How often something was made, by which reuse is seen."""

    deformers: int = 0  # cages at rest that were bound to a field, maps of poses, pictures rendered
    poses: int = 0
    frames: int = 0


@dataclasses.dataclass
class Bound:
    """A Deformer and the pose that it holds."""

    deformer: Deformer
    rests: list[RestCage]
    pose: Hashable = None


class FrameMaker:
    """Renders frames, and keeps what the next ones need: fields, deformers, and the map of the last pose.
    memory: bytes of deformers beside their fields, one stays whatever it takes; None is a quarter of what is free."""

    def __init__(self, references: References, fields: LoadedFields, memory: int | None = None):
        self.references, self.fields, self.counts = references, fields, Counts()
        limit = int(MEMORY_SHARE * free_bytes(fields.device)) // 2 if memory is None else memory
        self._kernels: dict[str, Future[None] | None] = {}  # by coordinates; None once they were waited for
        self.kept: LRUCache[Bound] = LRUCache(MOST_DEFORMERS, limit, _bound_bytes)
        fields.dropped = self._drop_bound_to

    @property
    def held_bytes(self) -> int:
        """Bytes that deformers take, beside their fields."""
        return self.kept.held_bytes

    def forget(self) -> None:
        """Let go of all that is bound to fields."""
        self.kept.clear()

    def _drop_bound_to(self, field: AnyField) -> None:
        """Let go of what is bound to a field, which would keep it loaded."""
        for key, bound in self.kept.items():
            if bound.deformer.field is field:
                self.kept.drop(key)

    def make(self, item: FrameItem) -> MadeItem:
        """Render a frame; what is made writes its outputs."""
        self.begin_kernels(item)
        field_key, field = self.fields.get(item.field, item.scene_scale)
        camera = self.references.camera(item, field)
        posed: list[Cage | None] = []
        if item.edits:
            bound_key, bound = self._deformer(item, field_key, field, camera)
            posed = self._pose(bound, item)
            renderer, drawn = bound.deformer, _drawn(bound) if item.overlay else []
        else:
            bound_key, renderer, drawn = None, field, []
        if item.antialias is not None and isinstance(field, VoxelField):
            raise ValueError("'antialias' is for files of splats, this field is one of voxels (.npz)")
        frame = renderer.render(camera, **_render_options(item))
        if item.fill:
            frame = _filled(frame, field, camera)
        self.counts.frames += 1
        writers = frame_writers(item, frame, camera, drawn) | _record_writers(item, camera, posed)
        self.fields.settle(field_key)
        self.kept.settle(bound_key)
        return MadeItem(writers, sum(_host_bytes(frame, name) for name in needed_arrays(item, frame)))

    def begin_kernels(self, item: FrameItem) -> None:
        """Let a thread load the kernels that a frame needs, once for each kind of coordinates."""
        looked_up = item.edits and item.resolution != "precise" and not is_splat_file(item.field)
        if looked_up and item.coordinates not in self._kernels:
            thread = ThreadPoolExecutor(1, "warpcage-kernels")
            self._kernels[item.coordinates] = thread.submit(load_usual_modules, item.coordinates, self.fields.device)
            thread.shutdown(wait=False)  # it ends with its task

    def _require_kernels(self, coordinates: str) -> None:
        """Wait for kernels that are being loaded. Raises what went wrong."""
        loading = self._kernels.get(coordinates)
        if loading is not None:
            self._kernels[coordinates] = None
            loading.result()

    def _deformer(
        self, item: FrameItem, field_key: Hashable, field: AnyField, camera: Camera
    ) -> tuple[Hashable, Bound]:
        cells = picture_cells(camera) if item.resolution is None else item.resolution
        files = [self.references.stamped(edit.cage, "cage file") for edit in item.edits if isinstance(edit.cage, str)]
        rest = canonical([edit.rest for edit in item.edits])
        key = field_key, rest, tuple(files), item.coordinates, cells, item.density, item.map

        def bind() -> Bound:
            rests = [self.references.rest_cage(edit, field) for edit in item.edits]
            edits = [
                CageEdit(cage.cage, edit.keep, edit.remove, edit.falloff, edit.held, edit.fragments)
                for cage, edit in zip(rests, item.edits, strict=True)
            ]
            self._require_kernels(item.coordinates)
            self.counts.deformers += 1
            resolution = None if cells == "precise" else int(cells)
            options: dict[str, Any] = {"coordinates": item.coordinates, "density": item.density, "map": item.map}
            return Bound(Deformer(field, edits, resolution=resolution, **options), rests)

        return key, self.kept.get(key, bind)

    def _pose(self, bound: Bound, item: FrameItem) -> list[Cage | None]:
        """Move the cages of a Deformer, if they are not there; returns them."""
        field, edits = bound.deformer.field, zip(item.edits, bound.rests, strict=True)
        cages = [self.references.posed_cage(edit, rest, field) for edit, rest in edits]
        pose = tuple(None if cage is None else cage.vertices.tobytes() for cage in cages)
        if pose == bound.pose:
            return cages
        bound.pose = None  # should this fail, the next frame poses anew
        bound.deformer.pose(cages)
        bound.pose = pose
        self.counts.poses += 1
        return cages


def _bound_bytes(bound: Bound) -> int:
    return array_bytes(bound.deformer, leave=(bound.deformer.field,))


def _drawn(bound: Bound) -> list[Cage]:
    """The cages that an overlay shows: posed ones, and at rest those whose content is removed."""
    posed = bound.deformer.deformed or []
    return [rest.cage if cage is None else cage for rest, cage in zip(bound.rests, posed, strict=True)]


def _render_options(item: FrameItem) -> dict[str, Any]:
    options: dict[str, Any] = {} if item.supersampling is None else {"supersampling": item.supersampling}
    if item.antialias is not None:
        options["antialias"] = item.antialias
    if item.background is None:
        return options
    return options | {"background": item.background}


def _filled(frame: Frame, field: AnyField, camera: Camera) -> Frame:
    if not isinstance(field, VoxelField):
        raise ValueError("'fill' is for fields of voxels (.npz), this one is of splats")
    if field.background_model is None:
        raise ValueError("'fill': behind this field there is one colour, so that nothing is missing where it shows")
    return fill_unseen(frame, field, camera)


def frame_writers(item: FrameItem, frame: Frame, camera: Camera, drawn: list[Cage]) -> dict[str, Writer]:
    """What writes the outputs of a frame, by their paths; drawn: cages whose edges are drawn into the picture.
    The arrays that they need are on their way to the host when this returns."""
    frame.begin_copies(*needed_arrays(item, frame))
    pictures = {part: path for part, path in item.outputs.items() if part not in OF_RECORDS}
    return {path: _writer(part, path, item, frame, camera, drawn) for part, path in pictures.items()}


def needed_arrays(item: FrameItem, frame: Frame) -> list[str]:
    """Names of the arrays of a frame that its outputs are made of: to copy all takes longer than a frame on a GPU."""
    needed = {"alpha"} if item.background == TRANSPARENT else set()
    for part, path in item.outputs.items():
        if part not in OF_RECORDS:
            needed.update([RGB_BYTES] if is_bytes(item, part, path) else ARRAYS_OF_PARTS.get(part, frame.arrays))
    return [name for name in (*frame.arrays, RGB_BYTES) if name in needed]


def is_bytes(item: FrameItem, part: str, path: str) -> bool:
    """Whether an output is made of the colours of a frame as bytes, with nothing done to them."""
    plain = part == "rgb" and item.background != TRANSPARENT and not item.overlay
    return plain and pathlib.PurePosixPath(path).suffix.lower() in BYTE_ENDINGS


def _host_bytes(frame: Frame, name: str) -> int:
    """Bytes of an array on the host."""
    values = 3 if name in ("rgb", RGB_BYTES) else 1
    return frame.width * frame.height * values * (1 if name == RGB_BYTES else 4)


def _record_writers(item: FrameItem, camera: Camera, posed: list[Cage | None]) -> dict[str, Writer]:
    """What writes the parts of a record that are no pictures."""
    contents: dict[str, Callable[[], bytes | memoryview]] = {
        "pose": lambda: array_data(pose_array(posed)),
        "record": lambda: (json.dumps(frame_record(item, camera, posed), ensure_ascii=False) + "\n").encode(),
    }

    def writer(part: str) -> Writer:
        return lambda temporary: temporary.write_bytes(contents[part]())

    return {item.outputs[part]: writer(part) for part in OF_RECORDS if part in item.outputs}


def _writer(part: str, path: str, item: FrameItem, frame: Frame, camera: Camera, drawn: list[Cage]) -> Writer:
    ending = pathlib.PurePosixPath(path).suffix.lower()
    if part in ("reveal", "fold", "outside", "masks") and "reveal" not in frame.arrays:
        raise ValueError(f"{part!r} is for fields of voxels (.npz), this one is of splats")
    if ending == ".npy":
        return lambda temporary: write_array(temporary, getattr(frame, part))

    def image() -> np.ndarray:
        if is_bytes(item, part, path):
            return frame.rgb_bytes
        if part in ("rgb", "film"):
            clear = item.background == TRANSPARENT
            return rgba_picture(frame, camera, drawn) if clear else picture(frame, "rgb", camera, drawn)
        if part in ("reveal", "fold"):
            return np.clip(getattr(frame, part), 0.0, 1.0)
        return picture(frame, part, scale=item.disparity_scale)

    if ending == ".exr":
        shown = (lambda: np.repeat(frame.alpha[..., None], 3, axis=-1)) if part == "depth" else image
        return lambda temporary: write_picture(temporary, shown(), depth_along_view(frame, camera))
    write = write_film_frame if part == "film" else write_picture
    return lambda temporary: write(temporary, image())
