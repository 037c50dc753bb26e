"""What a Deformer deforms: a field of voxels or of splats on its device, with the pose that is in its buffers."""

from __future__ import annotations

import abc
import dataclasses
import functools
from typing import Any, ClassVar

import numpy as np

from ..cage.cage import Cage
from ..coordinates.coordinates import deform_points
from ..core.checks import checked_flag
from ..core.names import (
    DENSITIES,
    SPLAT_MAPS,
    Coordinates,
    Density,
    SplatMap,
    Store,
    chosen,
    require_coordinates,
    require_name,
    require_store,
)
from ..edits.edits import CageEdit
from ..edits.falloff import FalloffBand
from ..edits.fragments import found_fragments
from ..edits.maps import EditLattices
from ..errors import InputError
from ..field.render import asked_view
from ..field.voxel_field import VoxelField
from ..kernels.render import samples
from ..kernels.splats.pose import LAW_DENSITY, LAW_RAYS
from ..lattice.buffers import StreamOrder
from ..mesh.queries import inside_mesh
from ..render.launch import load_pose_modules, render_modules
from ..render.sampled import SampledField, render_samples
from ..render.scene import PosedScene
from ..render.surface_mesh import SurfaceMesh
from ..render.view import PosedEdits, cage_span, require_short_march
from ..splats.matter import SplatDensity
from ..splats.render import render_field
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.frame import MASK_NAMES, Frame
from .exact import ExactEdits
from .poses import canonical_points, checked_poses, posed_samples
from .splat_edits import SplatEdits


@dataclasses.dataclass(frozen=True)
class MapOptions:
    """How cages act on a field; see `Deformer`."""

    coordinates: Coordinates
    resolution: int | None
    density: Density
    store: Store
    map: SplatMap | None


class Backend(abc.ABC):
    """A field that cages deform; its buffers hold one pose at a time, for callers that take turns."""

    kind: ClassVar[type]  # of the field
    masks: ClassVar[tuple[str, ...]] = ()  # of its frames
    bands: list[FalloffBand | None]  # of each edit
    posed: Any  # the edits on the device, with a pose in their buffers

    def __init__(self, field: Any, edits: list[CageEdit], options: MapOptions):
        self.field, self.edits, self.device, self.options = field, edits, field.device, options
        self._held: list[Cage | None] | None = None  # the pose that is in the buffers
        self._spans: list[float] = []  # of its cages
        self._order = StreamOrder(self.device)
        self._order.follow()

    @classmethod
    @abc.abstractmethod
    def check(cls, options: MapOptions) -> None:
        """Refuse options that this kind of field does not have."""

    def checked(self, deformed: Any) -> list[Cage | None]:
        """The cages of a pose as callers give it, one per edit."""
        return checked_poses(self.edits, self.bands, deformed)

    def hold(self, cages: list[Cage | None]) -> Any:
        """The edits with this pose in their buffers, computed where another one is there."""
        self._order.follow()  # poses and frames of other streams share the buffers
        if self._held is not cages:
            self._held = None
            self.posed.pose(cages)
            self._held, self._spans = cages, [cage_span(cage) for cage in cages]
        return self.posed

    @abc.abstractmethod
    def render(self, cages: list[Cage | None], camera: Camera, how: tuple[Any, ...], **target: Any) -> Frame:
        """The view of a camera in a pose; how: background, step, supersampling and antialias as `Deformer.render` has
        them, target: `into` and `is_again` as a FieldView has them."""

    def to_canonical(self, cages: list[Cage | None], *asked: Any) -> tuple[Any, ...]:
        """Where points of a pose are at rest; asked: points, directions, step, return_outside."""
        raise InputError(
            "to_canonical looks points up backward, as voxels are: splats move forward, and meshes do; take "
            "deform_points for points, or posed_splats for the splats themselves"
        )

    def sample(self, cages: list[Cage | None], *asked: Any) -> tuple[Any, Any]:
        """Colour and density of the posed scene; asked: points, directions, step."""
        raise InputError(
            "splats and meshes have no density at points: render them, or take posed_splats for the splats themselves"
        )

    def reached(self, cages: list[Cage | None]) -> np.ndarray:
        """(2, 3) box of all that the field and its posed cages reach, world units."""
        boxes = [self.field.bounds, *(cage.bounds for cage in cages if cage is not None)]
        reached = np.stack([*boxes, *self._carried_boxes()])
        return np.stack([reached[:, 0].min(axis=0), reached[:, 1].max(axis=0)])

    def _carried_boxes(self) -> list[np.ndarray]:
        """Boxes (2, 3), world units, of what goes with cages beside what is in them."""
        return []


class VoxelBackend(Backend):
    """Voxels, which are looked up backward: where each place of the deformed scene comes from."""

    kind, masks = VoxelField, MASK_NAMES
    posed: PosedEdits

    def __init__(self, field: VoxelField, edits: list[CageEdit], options: MapOptions):
        super().__init__(field, edits, options)
        origin, device, coordinates = field.center, field.device, options.coordinates
        self.bands = [FalloffBand(edit, field) if edit.falloff > 0.0 else None for edit in edits]
        self._carried = [found_fragments(edit, field, index) for index, edit in enumerate(edits)]
        if options.resolution is None:
            self.posed = ExactEdits(edits, coordinates, origin, device, self.bands, self._carried)
        else:
            load_pose_modules(coordinates, render_modules(device, len(edits), any(self._carried)), device)
            kept = options.store, self.bands, self._carried
            scene = PosedScene(EditLattices(edits, coordinates, options.resolution, origin, device, *kept))
            scene.warm(field)
            self.posed = scene

    @classmethod
    def check(cls, options: MapOptions) -> None:
        if options.map not in (None, "backward"):
            raise InputError(f'map={options.map!r} is for splats: voxels are looked up backward, "backward" or None')
        require_coordinates(options.coordinates)
        require_name(options.density, DENSITIES, "density")
        if options.resolution is None and options.coordinates == "harmonic":
            raise InputError("harmonic coordinates have no closed form: give a resolution, or mean_value or green")
        require_store(options.store)
        if options.resolution is None and options.store != "map":
            raise InputError('store="weights" keeps weights on a lattice: give a resolution')

    def render(self, cages: list[Cage | None], camera: Camera, how: tuple[Any, ...], **target: Any) -> Frame:
        background, step, supersampling = _marched(how)
        view = asked_view(self.field, camera, background, step, supersampling, masks=MASK_NAMES, **target)
        posed = self.hold(cages)
        require_short_march(self._spans, view.step)
        return posed.render(view, self.arc_opacity)

    @property
    def arc_opacity(self) -> int:
        """1 where optical depth is in canonical arc length."""
        return chosen(self.options.density, "density", opacity=1, paper=0)

    def to_canonical(self, cages: list[Cage | None], *asked: Any) -> tuple[Any, ...]:
        return canonical_points(self.field, self.hold(cages), *asked)

    def sample(self, cages: list[Cage | None], *asked: Any) -> tuple[Any, Any]:
        return posed_samples(self.field, self.hold(cages), *asked, is_arc=self.arc_opacity == 1)

    def _carried_boxes(self) -> list[np.ndarray]:
        return [each.bounds for each in self._carried if each is not None and each.bounds is not None]


def _marched(how: tuple[Any, ...]) -> tuple[Any, Any, Any]:
    """Background, step and supersampling of a view that is marched; how: as `Backend.render` has it."""
    background, step, supersampling, antialias = how
    if antialias is not None and checked_flag(antialias, "antialias"):
        raise InputError("antialias is for splats: voxels take more rays a pixel (supersampling)")
    return background, step, supersampling


class SampledBackend(VoxelBackend):
    """A field of another representation, which is looked up as voxels are and asked for its samples."""

    kind, masks = SampledField, ()

    def __init__(self, field: SampledField, edits: list[CageEdit], options: MapOptions):
        if any(edit.falloff > 0.0 or edit.fragments > 0.0 for edit in edits):
            raise InputError("falloff and fragments of an edit are for voxels, not for a SampledField")
        Backend.__init__(self, field, edits, options)
        self.bands = list[FalloffBand | None]([None] * len(edits))
        self._carried = []
        origin, device = field.center, field.device
        if options.resolution is None:
            self.posed = ExactEdits(edits, options.coordinates, origin, device)
        else:
            load_pose_modules(options.coordinates, [samples], device)
            lattices = EditLattices(edits, options.coordinates, options.resolution, origin, device, options.store)
            self.posed = PosedScene(lattices)

    def render(self, cages: list[Cage | None], camera: Camera, how: tuple[Any, ...], **target: Any) -> Frame:
        asked = _marched(how)
        self.hold(cages)
        require_short_march(self._spans, self.field.step if asked[1] is None else asked[1])
        ask = functools.partial(self.sample, cages)
        return render_samples(ask, self.field, self.reached(cages), camera, asked, target.get("into"))


class SplatBackend(Backend):
    """Splats, which are matter and move forward."""

    kind = SplatField
    posed: SplatEdits

    def __init__(self, field: SplatField, edits: list[CageEdit], options: MapOptions):
        if any(edit.fragments > 0.0 for edit in edits):
            raise InputError("fragments are for voxels: splats of a part that hang over its wall go by their shares")
        super().__init__(field, edits, options)
        self.bands = [splat_band(field, edit) if edit.falloff > 0.0 else None for edit in edits]
        law = chosen(options.density, "density", opacity=LAW_RAYS, paper=LAW_DENSITY)
        how = options.coordinates, options.resolution, law, options.map == "backward"
        self.posed = SplatEdits(field, edits, *how, self.bands)

    @classmethod
    def check(cls, options: MapOptions) -> None:
        _check_forward(options)
        if options.map is not None:
            require_name(options.map, SPLAT_MAPS, "map")

    def render(self, cages: list[Cage | None], camera: Camera, how: tuple[Any, ...], **target: Any) -> Frame:
        background, step, supersampling, antialias = how
        if step is not None:
            raise InputError("splats are not marched through: leave step out")
        splats = self.hold(cages).posed
        return render_field(self.field, splats, camera, background, supersampling, antialias, target.get("into"))


def splat_band(field: SplatField, edit: CageEdit) -> FalloffBand:
    """The band of an edit, whose cut walls are found among the splats near its cage."""
    low, high = edit.cage.bounds
    reach = 0.1 * edit.cage.size
    matter: Any = SplatDensity(field, bounds=np.array([low - reach, high + reach]))
    return FalloffBand(edit, matter)


def _check_forward(options: MapOptions) -> None:
    """Refuse options that nothing has which moves forward."""
    require_coordinates(options.coordinates)
    require_name(options.density, DENSITIES, "density")
    if options.store != "map":
        raise InputError(f'splats and meshes keep no lattice: store must be "map", got {options.store!r}')


class MeshEdits:
    """Edits of a mesh: its vertices go with the cages that they are in, one edit after the other."""

    def __init__(self, mesh: SurfaceMesh, edits: list[CageEdit], coordinates: Coordinates):
        self.rest, self.mesh, self._edits, self._coordinates = mesh, mesh, edits, coordinates
        self._inside: np.ndarray | None = None  # (v,) bool, of the first cage, which finds the mesh at rest

    def pose(self, cages: list[Cage | None]) -> None:
        """Move the vertices. A face is copied or removed where all of its corners are in the cage."""
        surface, device = self.rest.surface, self.rest.device
        faces, rows = np.arange(len(surface.faces)), np.arange(len(surface.vertices))  # what is left of them at rest
        corners, places = surface.faces, surface.vertices
        for number, (edit, cage) in enumerate(zip(self._edits, cages, strict=True)):
            found = None if number else self._inside
            inside = inside_mesh(places, edit.cage, device=device) if found is None else found
            if not number:
                self._inside = inside
            held = inside[corners].all(axis=1)
            if cage is None:
                faces, corners = faces[~held], corners[~held]
                continue
            if edit.keep_source:  # what goes is a copy, and all else stays
                used, renamed = np.unique(corners[held], return_inverse=True)
                corners = np.concatenate([corners, renamed.reshape(-1, 3) + len(places)]).astype(np.int32)
                faces, rows = np.concatenate([faces, faces[held]]), np.concatenate([rows, rows[used]])
                inside = np.arange(len(places) + len(used)) >= len(places)
                places = np.concatenate([places, places[used]])
            moving = np.flatnonzero(inside)
            if len(moving):
                places = places.copy()
                places[moving] = deform_points(places[moving], edit.cage, cage, self._coordinates, device=device)
        if np.array_equal(corners, self.mesh.faces) and len(places) == len(self.mesh.vertices):
            self.mesh = self.mesh.with_vertices(places, refit=self.mesh is not self.rest)
            return
        if not len(faces):
            raise InputError("the edits remove all of the mesh: leave it out instead")
        self.mesh = self.rest._chosen(places, corners, rows, faces)


class MeshBackend(Backend):
    """Triangles, whose vertices move forward."""

    kind = SurfaceMesh
    posed: MeshEdits

    def __init__(self, field: SurfaceMesh, edits: list[CageEdit], options: MapOptions):
        if any(edit.falloff > 0.0 or edit.fragments > 0.0 for edit in edits):
            raise InputError("falloff and fragments of an edit are for fields: a vertex of a mesh goes with its cage")
        super().__init__(field, edits, options)
        self.bands = [None] * len(edits)
        self.posed = MeshEdits(field, edits, options.coordinates)

    @classmethod
    def check(cls, options: MapOptions) -> None:
        _check_forward(options)
        if options.map not in (None, "forward"):
            raise InputError(f'vertices of a mesh move forward: map must be "forward" or None, got {options.map!r}')

    def render(self, cages: list[Cage | None], camera: Camera, how: tuple[Any, ...], **target: Any) -> Frame:
        background, step, supersampling, antialias = how
        if step is not None or antialias is not None:
            raise InputError("step is for voxels and antialias for splats: meshes take more rays (supersampling)")
        return self.hold(cages).mesh._render(camera, background, supersampling, target.get("into"))

    def _carried_boxes(self) -> list[np.ndarray]:
        return [self.posed.mesh.bounds]
