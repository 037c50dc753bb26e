"""Backends of a Deformer, one for each kind of field: they hold one pose in their buffers, and render it."""

from __future__ import annotations

import abc
import dataclasses
import functools
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeAlias, TypeVar

import numpy as np

from ..cage.cage import Cage
from ..coordinate_kinds import names_where
from ..coordinates.coordinates import deform_points
from ..core.names import (
    DENSITIES,
    SPLAT_MAPS,
    Coordinates,
    Density,
    SplatMap,
    Store,
    checked_choice,
    chosen,
    coordinate_kind,
    require_store,
)
from ..core.reports import Progress
from ..edits.edits import CageEdit, refined_edit
from ..edits.falloff import FalloffBand
from ..edits.fragments import found_fragments
from ..edits.maps import EditLattices
from ..errors import InputError
from ..field.render import NEW_TARGET, FieldView, RenderOptions, RenderTarget
from ..field.voxel_field import VoxelField
from ..kernels.render import samples
from ..lattice.buffers import StreamOrder
from ..mesh.queries import inside_mesh
from ..mesh.validity import require_usable
from ..render.launch import load_pose_modules, render_modules
from ..render.sampled import SampledField, render_samples
from ..render.scene import PosedScene
from ..render.surface_mesh import SurfaceMesh
from ..render.view import PosedEdits, cage_span, require_short_march
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.frame import MASK_NAMES, Frame
from .exact import ExactEdits
from .poses import canonical_points, checked_poses, posed_samples

#: The posed cages, one per edit, None for one that removes.
Cages: TypeAlias = list[Cage | None]

#: What a Deformer poses.
Deformable: TypeAlias = VoxelField | SplatField | SampledField | SurfaceMesh

if TYPE_CHECKING:
    import typing_extensions  # of the type checker

    from .splat_edits import SplatEdits

    # the default lets annotations of callers be plain `Deformer`
    FieldT = typing_extensions.TypeVar("FieldT", bound=Deformable, default=Any)
    EditsT = typing_extensions.TypeVar("EditsT", bound="PosedEdits | SplatEdits | MeshEdits", default=Any)
else:
    FieldT, EditsT = TypeVar("FieldT"), TypeVar("EditsT")


@dataclasses.dataclass(frozen=True)
class MapOptions:
    """How cages act on a field; see `Deformer`."""

    coordinates: Coordinates
    resolution: int | None
    density: Density
    store: Store
    map: SplatMap | None


class Backend(abc.ABC, Generic[FieldT, EditsT]):
    """A field that cages deform; its buffers hold one pose at a time, for callers that take turns."""

    kind: ClassVar[type]  # of the field
    masks: ClassVar[tuple[str, ...]] = ()  # of its frames
    bands: list[FalloffBand | None]  # of each edit
    posed: EditsT  # on the device, with a pose in their buffers

    def __init__(self, field: FieldT, edits: list[CageEdit], options: MapOptions, progress: bool | Progress = False):
        self.field, self.edits, self.device, self.options = field, edits, field.device, options
        self._cells = coordinate_kind(options.coordinates).face_cells
        self.surfaces = [refined_edit(edit, self._cells) for edit in edits]  # which are computed on
        self._held: Cages | None = None  # the pose that is in the buffers
        self._spans: list[float] = []  # of its cages
        self._order = StreamOrder(self.device)
        self._order.follow()
        self.bands = [None] * len(edits)
        self.posed = self._make_edits(progress)

    @abc.abstractmethod
    def _make_edits(self, progress: bool | Progress) -> EditsT:
        """The edits on the device; sets `bands` too. Raises ValueError for edits that such fields do not have."""

    @classmethod
    @abc.abstractmethod
    def check(cls, options: MapOptions) -> None:
        """Refuse options that this kind of field does not have."""

    def checked(self, deformed: Any) -> Cages:
        """The cages of a pose as callers give it, one per edit."""
        return checked_poses(self.edits, self.bands, deformed)

    def hold(self, cages: Cages) -> EditsT:
        """The edits with this pose in their buffers, computed where another one is there."""
        self._order.follow()  # poses and frames of other streams share the buffers
        if self._held is not cages:
            self._held = None
            try:
                self.posed.pose([self.surface(cage) for cage in cages])
            except ValueError:
                for cage in cages:  # an error names the cage's own faces where it is at fault
                    if cage is not None and cage.polygon_faces is not None:
                        require_usable(cage, "the deformed cage")
                raise
            self._held, self._spans = cages, [cage_span(cage) for cage in cages]
        return self.posed

    def surface(self, cage: Cage | None) -> Cage | None:
        """The triangles of a posed cage that are computed on."""
        return None if cage is None else cage.refined(self._cells)

    @classmethod
    def check_view(cls, options: RenderOptions) -> None:
        """Refuse options of a frame that this kind of field does not have."""

    @abc.abstractmethod
    def render(self, cages: Cages, camera: Camera, options: RenderOptions, target: RenderTarget = NEW_TARGET) -> Frame:
        """The view of a camera in a pose."""

    def to_canonical(
        self, cages: Cages, points: Any, directions: Any, step: float | None, return_outside: bool
    ) -> tuple[Any, ...]:
        """Where points of a pose are at rest, see `Deformer.to_canonical`."""
        raise InputError(
            "to_canonical looks points up backward, as only voxels do: splats move forward, as meshes do; use "
            "deform_points for points, or posed_splats for the splats themselves"
        )

    def sample(self, cages: Cages, points: Any, directions: Any, step: float | None) -> tuple[Any, Any]:
        """Colour and density of the posed scene, see `Deformer.sample`."""
        raise InputError(
            "splats and meshes have no density at points: render them, or use posed_splats for the splats themselves"
        )

    def reached(self, cages: Cages) -> np.ndarray:
        """(2, 3) box of all that the field and its posed cages reach, world units."""
        boxes = [self.field.bounds, *(cage.bounds for cage in cages if cage is not None)]
        reached = np.stack([*boxes, *self._carried_boxes()])
        return np.stack([reached[:, 0].min(axis=0), reached[:, 1].max(axis=0)])

    def _carried_boxes(self) -> list[np.ndarray]:
        """Boxes (2, 3), world units, of what goes with cages beside what is in them."""
        return []


LookupT = TypeVar("LookupT", VoxelField, SampledField)


class LookupBackend(Backend[LookupT, PosedEdits]):
    """A field that is looked up backward: where each place of the deformed scene comes from."""

    @property
    def arc_opacity(self) -> int:
        """1 where optical depth is in canonical arc length."""
        return chosen(self.options.density, "density", opacity=1, paper=0)

    @classmethod
    def check(cls, options: MapOptions) -> None:
        if options.map not in (None, "backward"):
            raise InputError(f'map={options.map!r} is for splats: voxels are looked up backward, "backward" or None')
        kind = coordinate_kind(options.coordinates)
        checked_choice(options.density, "density", DENSITIES)
        if options.resolution is None:
            kind.require_precise(f"give a resolution, or {' or '.join(names_where('is_precise'))}")
        require_store(options.store)
        if options.resolution is None and options.store != "map":
            raise InputError('store="weights" keeps weights on a lattice: give a resolution')

    @classmethod
    def check_view(cls, options: RenderOptions) -> None:
        if options.antialias:
            raise InputError("antialias is for splats: voxels take more rays a pixel (supersampling)")

    def to_canonical(
        self, cages: Cages, points: Any, directions: Any, step: float | None, return_outside: bool
    ) -> tuple[Any, ...]:
        return canonical_points(self.field, self.hold(cages), points, directions, step, return_outside)

    def sample(self, cages: Cages, points: Any, directions: Any, step: float | None) -> tuple[Any, Any]:
        return posed_samples(self.field, self.hold(cages), points, directions, step, is_arc=self.arc_opacity == 1)


class VoxelBackend(LookupBackend[VoxelField]):
    """Voxels."""

    kind, masks = VoxelField, MASK_NAMES

    def _make_edits(self, progress: bool | Progress) -> PosedEdits:
        field, edits, options = self.field, self.surfaces, self.options
        origin, device, coordinates = field.center, field.device, options.coordinates
        self.bands = [FalloffBand(edit, field) if edit.falloff > 0.0 else None for edit in self.edits]
        self._carried = [found_fragments(edit, field, index) for index, edit in enumerate(edits)]
        if options.resolution is None:
            return ExactEdits(edits, coordinates, origin, device, self.bands, self._carried)
        load_pose_modules(coordinates, render_modules(device, len(edits), any(self._carried)), device, progress)
        kept = options.store, self.bands, self._carried
        scene = PosedScene(EditLattices(edits, coordinates, options.resolution, origin, device, *kept))
        scene.warm(field)
        return scene

    def render(self, cages: Cages, camera: Camera, options: RenderOptions, target: RenderTarget = NEW_TARGET) -> Frame:
        view = FieldView(self.field, camera, options, MASK_NAMES, target)
        posed = self.hold(cages)
        require_short_march(self._spans, view.step)
        return posed.render(view, self.arc_opacity)

    def _carried_boxes(self) -> list[np.ndarray]:
        return [each.bounds for each in self._carried if each is not None and each.bounds is not None]


class SampledBackend(LookupBackend[SampledField]):
    """A field of another representation, whose samples its function returns."""

    kind = SampledField

    def _make_edits(self, progress: bool | Progress) -> PosedEdits:
        edits, options, origin, device = self.surfaces, self.options, self.field.center, self.device
        if any(edit.falloff > 0.0 or edit.fragments > 0.0 for edit in edits):
            raise InputError("falloff and fragments of an edit are for voxels, not for a SampledField")
        if options.resolution is None:
            return ExactEdits(edits, options.coordinates, origin, device)
        load_pose_modules(options.coordinates, [samples], device, progress)
        return PosedScene(EditLattices(edits, options.coordinates, options.resolution, origin, device, options.store))

    def render(self, cages: Cages, camera: Camera, options: RenderOptions, target: RenderTarget = NEW_TARGET) -> Frame:
        self.hold(cages)
        require_short_march(self._spans, self.field.step if options.step is None else options.step)
        sample = functools.partial(self.sample, cages)
        return render_samples(sample, self.field, self.reached(cages), camera, options, target)


class SplatBackend(Backend[SplatField, "SplatEdits"]):
    """Splats, which are matter and move forward."""

    kind = SplatField

    def _make_edits(self, progress: bool | Progress) -> SplatEdits:
        from ..kernels.splats.pose import LAW_DENSITY, LAW_RAYS
        from .splat_edits import SplatEdits  # here, as fields of voxels need none of its kernels

        field, edits, options = self.field, self.surfaces, self.options
        if any(edit.fragments > 0.0 for edit in edits):
            raise InputError("fragments are for voxels: splats of a part that hang over its wall go by their shares")
        self.bands = [splat_band(field, edit) if edit.falloff > 0.0 else None for edit in self.edits]
        law = chosen(options.density, "density", opacity=LAW_RAYS, paper=LAW_DENSITY)
        lattices = options.coordinates, options.resolution
        return SplatEdits(field, edits, *lattices, law, options.map == "backward", self.bands, progress)

    @classmethod
    def check(cls, options: MapOptions) -> None:
        _check_forward(options)
        if options.map is not None:
            checked_choice(options.map, "map", SPLAT_MAPS)

    @classmethod
    def check_view(cls, options: RenderOptions) -> None:
        if options.step is not None:
            raise InputError("splats are not marched through: leave step out")

    def render(self, cages: Cages, camera: Camera, options: RenderOptions, target: RenderTarget = NEW_TARGET) -> Frame:
        return self.field._render(camera, options, target, self.hold(cages).posed)


def splat_band(field: SplatField, edit: CageEdit) -> FalloffBand:
    """The band of an edit, whose cut walls are found among the splats near its cage."""
    from ..splats.matter import SplatDensity

    low, high = edit.cage.bounds
    reach = 0.1 * edit.cage.size
    matter: Any = SplatDensity(field, bounds=np.array([low - reach, high + reach]))
    return FalloffBand(edit, matter)


def _check_forward(options: MapOptions) -> None:
    """Refuse options that only fields which are looked up have."""
    coordinate_kind(options.coordinates)
    checked_choice(options.density, "density", DENSITIES)
    if options.store != "map":
        raise InputError(f'splats and meshes keep no lattice: store must be "map", got {options.store!r}')


class MeshEdits:
    """Edits of a mesh: its vertices go with the cages that they are in, one edit after the other."""

    def __init__(self, mesh: SurfaceMesh, edits: list[CageEdit], coordinates: Coordinates):
        self.rest, self.mesh, self._edits, self._coordinates = mesh, mesh, edits, coordinates
        self._inside: np.ndarray | None = None  # (v,) bool, of the first cage, which finds the mesh at rest

    def pose(self, cages: Cages) -> None:
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


class MeshBackend(Backend[SurfaceMesh, MeshEdits]):
    """Triangles, whose vertices move forward."""

    kind = SurfaceMesh

    def _make_edits(self, progress: bool | Progress) -> MeshEdits:
        if any(edit.falloff > 0.0 or edit.fragments > 0.0 for edit in self.edits):
            raise InputError("falloff and fragments of an edit are for fields: a vertex of a mesh goes with its cage")
        return MeshEdits(self.field, self.surfaces, self.options.coordinates)

    @classmethod
    def check(cls, options: MapOptions) -> None:
        _check_forward(options)
        if options.map not in (None, "forward"):
            raise InputError(f'vertices of a mesh move forward: map must be "forward" or None, got {options.map!r}')

    @classmethod
    def check_view(cls, options: RenderOptions) -> None:
        if options.step is not None or options.antialias is not None:
            raise InputError("step is for voxels and antialias for splats: meshes take more rays (supersampling)")

    def render(self, cages: Cages, camera: Camera, options: RenderOptions, target: RenderTarget = NEW_TARGET) -> Frame:
        return self.hold(cages).mesh._render(camera, options, target)

    def _carried_boxes(self) -> list[np.ndarray]:
        return [self.posed.mesh.bounds]


AnyBackend: TypeAlias = Backend[Any, Any]

#: One for each kind of field.
BACKENDS: tuple[type[AnyBackend], ...] = (VoxelBackend, SplatBackend, SampledBackend, MeshBackend)


def backend_of(field: Deformable) -> type[AnyBackend]:
    """The backend of a field."""
    found = next((backend for backend in BACKENDS if isinstance(field, backend.kind)), None)
    if found is None:
        kinds = ", ".join(backend.kind.__name__ for backend in BACKENDS[:-1])
        raise InputError(f"a Deformer needs a {kinds} or {BACKENDS[-1].kind.__name__}, got {type(field).__name__}")
    return found
