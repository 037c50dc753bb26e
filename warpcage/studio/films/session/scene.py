"""The scene of a document, posed and ready to be rendered."""

from __future__ import annotations

import dataclasses
import math
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ....cage.cage import Cage
from ....cage.walls import cut_faces
from ....core.arrays import box_corners
from ....core.memory import LRUCache
from ....deform.deformer import Deformer
from ....deform.stage import Stage
from ....edits.edits import CageEdit
from ....edits.place import Place, seen_from
from ....errors import InputError
from ....field.voxel_field import VoxelField
from ....mesh.validity import require_usable
from ....render.surface_mesh import AnyObject, load_object
from ....splats.splat_field import AnyField
from ....view.camera import Camera
from ....view.frame import Frame
from ...spec.settings import Settings
from ..document import MAIN, Document, Edit, SceneObject, View, same
from ..render import HeldPose, Look

#: Deformers that are kept for one set of edits, one per resolution: a drag and a picture at rest may have two.
KEPT_DEFORMERS = 2

#: Rows of the picture that a click is taken in: finer than any page's.
CLICK_ROWS = 4096

#: Pixels of less opacity hide nothing.
HIDING_ALPHA = 0.5

#: A pixel of a picture, and the camera of the picture.
Pixel = tuple[tuple[int, int], Camera]

#: Pictures as the scene has them.
PLAIN = Look()


def view_camera(view: View, width: int, height: int) -> Camera:
    """The camera of a view, with square pixels, for a picture of so many pixels."""
    focal = 0.5 * height / math.tan(math.radians(view.fov) / 2)
    looking = Camera.look_at(view.eye, view.target, up=view.up, width=width, height=height)
    return dataclasses.replace(looking, fx=focal, fy=focal)


def clicked_pixel(view: View, across: float, down: float, aspect: float) -> Pixel:
    """The pixel of a click, and the camera that it is of; across, down: shares of a page's picture of this aspect."""
    width, height = round(CLICK_ROWS * aspect), CLICK_ROWS
    pixel = min(int(across * width), width - 1), min(int(down * height), height - 1)
    return pixel, view_camera(view, width, height)


def is_filled(document: Document, field: AnyField) -> bool:
    """Whether background that an edit uncovers is filled in pictures at rest; field: the session's own."""
    settings, around = document.settings, field.background_model
    return settings.fill and settings.background is None and around is not None and not document.is_staged


class Fields:
    """The fields and meshes of a session's objects: its own, and others by their files' names, which copies share."""

    def __init__(self, main: AnyField):
        self.main = main
        self.files: dict[str, AnyObject] = {}  # seen from the session's folder

    @classmethod
    def of(cls, fields: AnyField | Fields) -> Fields:
        """Fields as they are, or of a session with one object."""
        return fields if isinstance(fields, Fields) else cls(fields)

    def field(self, scene_object: SceneObject) -> AnyObject:
        """The field of an object. Raises ValueError where it was not read."""
        if scene_object.file is None:
            return self.main
        if scene_object.file not in self.files:
            raise InputError(
                f"the file of {scene_object.name!r}, {scene_object.file}, was not read: it was added elsewhere"
            )
        return self.files[scene_object.file]

    def bounds(self, document: Document) -> np.ndarray:
        """(2, 3) box of all objects where they stand, world units; of hidden ones too."""
        boxes = [one.place.moved(box_corners(self.field(one).bounds)) for one in document.objects]
        return np.stack([np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))])


def read_fields(document: Document, main: AnyField, folder: pathlib.Path) -> Fields:
    """The fields of a document's objects; folder: of the session, which the names of files are seen from."""
    fields = Fields(main)
    for scene_object in document.objects:
        if scene_object.file is not None and scene_object.file not in fields.files:
            fields.files[scene_object.file] = load_object(folder / scene_object.file, device=main.device)
    return fields


class PosedScene:
    """The scene of a document, posed and ready to be rendered. One thread at a time may use it."""

    def __init__(self, fields: AnyField | Fields):
        self.fields = Fields.of(fields)
        self._posed: dict[int, PosedObject] = {}  # by the number of the object
        self.stage: Stage | None = None  # of the last `prepare`; None for the session's own field in its own place
        self.held: tuple[Document, int | None] | None = None  # what is posed, and with how many cells

    def posed(self, number: int) -> AnyObject | Deformer:
        """An object of the last `prepare` in which it was seen: a Deformer, or its field where that is as it is."""
        posed = self._posed[number]
        return posed.deformer or posed.field

    def prepare(self, document: Document, resolution: int | None = None) -> None:
        """Make the scene of a document's objects, edits and settings; where that fails, the scene before stays.
        `resolution`: cells of the lattices along the longest side of a cage, None is that of the settings."""
        objects, self.held = [one for one in document.objects if one.visible], None
        for scene_object in objects:
            field, posed = self.fields.field(scene_object), self._posed.get(scene_object.id)
            if posed is None:
                posed = self._posed[scene_object.id] = PosedObject(field)
            posed.prepare(document.edits_of(scene_object.id), document.settings, resolution)
        for gone in set(self._posed) - {scene_object.id for scene_object in document.objects} - {MAIN}:
            del self._posed[gone]
        stage = None
        if objects != [document.objects[0]] or document.is_staged:
            stage = Stage(device=self.fields.main.device)
            for scene_object in objects:
                stage.add(str(scene_object.id), self.posed(scene_object.id), place=scene_object.place)
        self.stage, self.held = stage, (document, resolution)

    def render(self, camera: Camera, look: Look = PLAIN) -> Frame:
        """The view of a camera of the scene that was prepared last; a field without a Deformer has no masks."""
        return self._posed[MAIN].render(camera, look) if self.stage is None else look.render(self.stage, camera)

    def object_at(self, view: View, across: float, down: float, aspect: float) -> int | None:
        """The object that a click meets first, or None; across, down: shares of a picture of this aspect."""
        if self.stage is None:
            return MAIN
        pixel, met = clicked_pixel(view, across, down, aspect), []
        for name, item in self.stage.items.items():
            place = item.places.at(0.0)
            depth = _depth_at(item.scene_object, place, pixel)
            if depth is not None:
                met.append((depth * place.scale, int(name)))
        return min(met)[1] if met else None

    def surface_at(self, number: int, place: Place, pixel: Pixel) -> np.ndarray | None:
        """(3,) where an object that is posed shows matter at a pixel, in its own coordinates; None: it does not."""
        depth = _depth_at(self.posed(number), place, pixel)
        if depth is None:
            return None
        one = seen_from(place, _one_pixel(pixel))
        ray = one.rotation @ [(0.5 - one.cx) / one.fx, (0.5 - one.cy) / one.fy, 1.0]
        return one.center + depth * ray / np.linalg.norm(ray)


def _one_pixel(pixel: Pixel) -> Camera:
    """The camera of a pixel alone."""
    (x, y), looking = pixel
    return dataclasses.replace(looking, cx=looking.cx - x, cy=looking.cy - y, width=1, height=1)


def _depth_at(scene_object: AnyObject | Deformer, place: Place, pixel: Pixel) -> float | None:
    """How far an object's matter is along the ray of a pixel, in its own units; None where it shows none."""
    seen = seen_from(place, _one_pixel(pixel))
    frame = scene_object.render(seen, background="transparent", supersampling=1)
    return float(frame.depth.mean()) if float(frame.alpha.mean()) >= HIDING_ALPHA else None


class PosedObject:
    """A field or mesh and its edits, posed and ready to be rendered. One thread at a time may use it.
    A Deformer is made only when what it is made of changes; a changed pose is posed, an unchanged one left as it is."""

    def __init__(self, field: AnyObject):
        self.field = field
        self.deformer: Deformer | None = None  # of the last `prepare`; None where the field is shown as it is
        self._made_of: tuple[Any, ...] = ()  # options without the resolution and edits of the kept Deformers
        self._rest: list[Cage] = []
        self._kept: LRUCache[HeldPose] = LRUCache(KEPT_DEFORMERS)  # by resolution

    def prepare(self, edits: Sequence[Edit], settings: Settings, resolution: int | None = None) -> None:
        """Pose the field by edits; where that fails, the pose before stays; see `PosedScene.prepare`."""
        edits = tuple(edit for edit in edits if edit.visible)
        if not edits or settings.mode == "rest":
            self.deformer = None
            return
        cells = settings.resolution if resolution is None else resolution
        options = dataclasses.replace(settings, resolution=cells).deformer_options(cells)
        made_of, rest, kept = (options | {"resolution": None}, *map(_made_of, edits)), self._rest, self._kept
        if not same(made_of, self._made_of):
            rest, kept = [Cage(edit.rest, edit.faces) for edit in edits], LRUCache(KEPT_DEFORMERS)
        pairs = zip(edits, rest, strict=True)
        posed = [None if edit.kind == "remove" else cage.with_vertices(edit.posed) for edit, cage in pairs]
        held = kept.get(cells, lambda: HeldPose(Deformer(self.field, self._cage_edits(edits, rest), **options)))
        held.pose(posed, [f"the posed cage of {edit.name!r}" for edit in edits])
        self._made_of, self._rest, self._kept, self.deformer = made_of, rest, kept, held.deformer

    def render(self, camera: Camera, look: Look) -> Frame:
        """The view of a camera of what was posed last, or of the field itself."""
        frame = look.render(self.deformer or self.field, camera)
        if "filled" in frame.arrays:
            device = frame.arrays["alpha"].device
            frame.arrays["rgb"] = wp.array(frame.rgb.reshape(-1, 3), dtype=wp.vec3, device=device)  # as the others
        return frame

    def _cage_edits(self, edits: Sequence[Edit], rest: Sequence[Cage]) -> list[CageEdit]:
        """The edits as a Deformer takes them."""
        for edit, cage in zip(edits, rest, strict=True):
            require_usable(cage, f"the rest cage of {edit.name!r}")
        made = [edit.edit_of(cage) for edit, cage in zip(edits, rest, strict=True)]
        if not isinstance(self.field, VoxelField):
            return made
        for edit, one in zip(edits, made, strict=True):
            if one.falloff > 0.0 and one.held == "cut" and not len(cut_faces(one.cage, self.field)):
                raise InputError(
                    f"{edit.name!r} has a fade, but no side of its cage cuts through the object: nothing tears there. "
                    "Set the fade to 0, or let it fade at the sides that are not moved"
                )
        return made


def _made_of(edit: Edit) -> tuple[Any, ...]:
    """What a Deformer is made of."""
    return edit.kind, edit.falloff, edit.held, edit.fragments, edit.faces, edit.rest


def same_pose(one: Document, two: Document) -> bool:
    """Whether two documents pose the scene alike."""

    def pose(document: Document) -> tuple[Any, ...]:
        shown = tuple((one.id, one.file, one.visible) for one in document.objects)
        edits = tuple((edit.object_id, edit.visible, edit.posed, *_made_of(edit)) for edit in document.edits)
        return document.settings.mode, document.settings.deformer_options(0), shown, edits

    return same(pose(one), pose(two))
