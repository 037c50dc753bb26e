"""Deformer: a radiance field as posed cages deform it, of voxels or of Gaussian splats."""

from __future__ import annotations

import inspect
import os
import pathlib
import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, cast, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..core.arrays import PointsLike
from ..core.checks import checked_path, checked_whole, require_type
from ..core.devices import HeldOnDevice, resolve_device
from ..core.locks import owner_lock
from ..core.names import FIELD_COORDINATES, Coordinates, Density, SplatMap, Store
from ..core.reports import Progress, reports_progress
from ..edits.edits import checked_edits
from ..errors import InputError
from ..field.voxel_field import VoxelField
from ..mesh.validity import is_usable
from ..render.sampled import SampledField
from ..render.surface_mesh import SurfaceMesh
from ..render.view import PosedEdits
from ..splats.io.formats import format_to_write
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.frame import Frame, Frames
from .backends import Backend, MapOptions, MeshBackend, SampledBackend, SplatBackend, VoxelBackend
from .posed import PosedDeformer
from .poses import DeformerOptions, PoseLike, RestLike, inverse_error
from .splat_baking import baked_field, numbered_files, warn_of_others
from .views import ViewOptions, render_pose, render_poses

if TYPE_CHECKING:
    from typing_extensions import Self, Unpack  # of the type checker


#: What a Deformer poses.
Deformable: TypeAlias = VoxelField | SplatField | SampledField | SurfaceMesh


class Deformer(HeldOnDevice):
    """A radiance field as cages deform it: voxels, or splats (see `SplatDeformer`, which this makes of a SplatField).

    Before the first `pose` the cages are at rest: the deformed scene is the field itself. Any thread may use it;
    threads that share one and each want a pose of their own take `posed` (docs/threads.md).

    References: Xu and Harada, "Deforming Radiance Fields with Cages" (ECCV 2022), Eq. 3-5, section 4.1.
    Limitations: what a map sends out of its rest cage is left empty (`Frame.outside` counts it), and what a moved cage
    uncovers was never seen by a camera (`Frame.reveal`).

    Example::

        cage = Cage.from_field(field)
        frame = Deformer(field, cage).pose(cage.twist(60)).render(camera)

    Args:
        field: The radiance field: a VoxelField, a SplatField, or a SampledField of any other representation; or a
            SurfaceMesh, whose vertices go with the cages that they are in, as `deform_points` moves them.
        rest: A Cage around what is to be deformed, as it is in the field; or a list of Cage or CageEdit, each of which
            acts on the scene that the ones before it left.
        coordinates: "harmonic", "mean_value" or "green". The default is harmonic, as in the paper; `deform_points` has
            mean value, and moves points otherwise than this: name one kind in both.
        resolution: Cells of the map's lattice along the longest side of a cage. None evaluates mean value or Green
            coordinates at every sample, which is slow: the paper's "precise".
        density: "opacity" takes optical depth in canonical arc length, sigma |phi(x + dt d) - phi(x)|, so that a part
            keeps its opacity when it is scaled. "paper" keeps sigma as Eq. 5 has it.
        device: Warp device. None is the field's.
        store: "map" keeps the positions that the weights lead to on the lattice. "weights" keeps the weights
            themselves, as the paper does: many times the memory for the same picture.
        map: Splats only: "forward" moves them by the coordinates of the cage at rest, "backward" puts them where the
            voxels' map finds them. None is the field's own way: voxels are always looked up backward.
        progress: True shows bars on stderr. A function is told (done, total, words) while splats are bound or kernels
            compiled, and ends that by returning False or by raising.

    Raises:
        ValueError: For names that do not exist, harmonic coordinates without a lattice, or a cage that cannot be used.
        Cancelled: Where `progress` returned False.

    Attributes:
        field: The field, on the device.
        edits: The CageEdits in their order.
        device: Warp device.
        coordinates: Kind of coordinates.
        resolution: Cells of the lattices, or None.
        density: "opacity" or "paper".
        store: "map" or "weights".
        map: "forward", "backward", or None for the field's own way.
        deformed: The posed cages, one per edit, None for an edit that removes; None before the first pose.
        lock: Held while buffers are in use. Hold it around several calls that must see the same pose, and around what
            reads `posed_edits()`.
    """

    if TYPE_CHECKING:

        @overload
        def __new__(cls, field: SplatField, rest: RestLike, **options: Unpack[DeformerOptions]) -> SplatDeformer: ...
        @overload
        def __new__(
            cls, field: VoxelField | SampledField | SurfaceMesh, rest: RestLike, **options: Unpack[DeformerOptions]
        ) -> Self: ...
        @overload
        def __new__(cls, field: Deformable, rest: RestLike, **options: Unpack[DeformerOptions]) -> Deformer: ...

    field: VoxelField
    _backends: ClassVar[tuple[type[Backend], ...]] = (VoxelBackend, SplatBackend, SampledBackend, MeshBackend)
    _kinds: ClassVar[dict[type, type]] = {}  # of Deformers that have more to say of a kind of field

    def __init_subclass__(cls, of: type[Backend] | None = None, **options: Any):
        super().__init_subclass__(**options)
        if of is not None:
            cls._backends = (of,)
            Deformer._kinds[of.kind] = cls

    def __new__(cls, field: Any, *args: Any, **options: Any) -> Any:
        known = Deformer._kinds.items() if cls is Deformer else ()
        return object.__new__(next((kind for of, kind in known if isinstance(field, of)), cls))

    @reports_progress
    def __init__(
        self,
        field: Deformable,
        rest: RestLike,
        *,
        coordinates: Coordinates = FIELD_COORDINATES,
        resolution: int | None = 128,
        density: Density = "opacity",
        device: wp.DeviceLike = None,
        store: Store = "map",
        map: SplatMap | None = None,
        progress: bool | Progress = False,
    ):
        backend = next((each for each in self._backends if isinstance(field, each.kind)), self._backends[0])
        require_type(field, backend.kind, f"a {type(self).__name__} needs")
        asked = MapOptions(coordinates, resolution, density, store, map)
        backend.check(asked)
        self.edits = checked_edits(rest)
        self.device = field.device if device is None else resolve_device(device)
        self.field = cast(Any, field).to(self.device)
        self.coordinates: Coordinates = coordinates
        self.density: Density = density
        self.store: Store = store
        self.map: SplatMap | None = map
        self.resolution = resolution
        self.deformed: list[Cage | None] | None = None
        self.lock = owner_lock(self.device)
        with self.lock:
            self._backend = backend(self.field, self.edits, asked)

    @property
    def reached_bounds(self) -> np.ndarray:
        """(2, 3) box of all that the field and the posed cages reach, fragments that go with them too; world units."""
        with self.lock:
            return self._backend.reached(self._posed_cages())

    def pose(self, deformed: PoseLike | Sequence[PoseLike | None]) -> Deformer:
        """Move the cages.

        Args:
            deformed: One pose: a Cage, its vertices (v, 3) in world units as an array of any library, or a file of one
                pose that `PoseFile.load` reads; or a list of one per edit in their order, None for one that removes.

        Returns:
            This Deformer.

        Raises:
            ValueError: For another count, cages whose faces differ from the rest cage's, or a cage that cannot be used
                (inverted, open, without volume); the pose before stays then. Also for too little memory, or a cage so
                far from the field that float32 cannot tell the cells of its lattice apart; the cages are at rest then.
        """
        cages = self._backend.checked(deformed)
        with self.lock:
            before, self.deformed = self.deformed, None  # should this fail half-way, the next use starts from rest
            try:
                self._backend.hold(cages)
            except ValueError:
                if not all(cage is None or is_usable(cage) for cage in cages):
                    self.deformed = before
                raise
            self.deformed = cages
        return self

    def posed(self, deformed: PoseLike | Sequence[PoseLike | None]) -> PosedDeformer:
        """A pose of its own, for callers that share this Deformer; this Deformer's own pose stays what it is.

        All poses share the buffers. Where another pose came between, the next use computes this one again: threads that
        take turns at every frame are quicker with a Deformer each.

        Args:
            deformed: As for `pose`.

        Returns:
            The pose: it renders as this Deformer does, and always its own cages.

        Raises:
            ValueError: As `pose`.
        """
        cages = self._backend.checked(deformed)
        with self.lock:
            self._backend.hold(cages)
        return PosedDeformer(self, cages)

    def posed_edits(self) -> PosedEdits:
        """What kernels take of the last pose; the cages are posed at rest where there was none.

        Hold `lock` over this and what reads it, where several threads use this Deformer.
        """
        with self.lock:
            return self._backend.hold(self._posed_cages())

    def _posed_cages(self) -> list[Cage | None]:
        """The cages of the last pose, at rest where there was none."""
        if self.deformed is None:
            self.pose([None if edit.remove else edit.cage for edit in self.edits])
        assert self.deformed is not None
        return self.deformed

    def inverse_error(self, points: Any = None, *, edit: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """How far apart the two maps of the last pose draw the same matter: 0 where each is the inverse of the other.

        Voxels are looked up backward, by coordinates of the posed cage; splats and `deform_points` go forward, by those
        of the cage at rest. A point of the picture takes the one to rest and the other back, and misses itself by this.

        Args:
            points: (n, 3), world units, in the posed cage. None is a grid of 24 cells along its longest side.
            edit: Number of the edit whose cages are meant, without falloff and fragments.

        Returns:
            The points (n, 3) float64, and their errors (n,) float64, world units; NaN outside of the posed cage, and
            where the map leads out of the one at rest. At a distance z from a camera they are `error * fx / z` pixels.

        Raises:
            ValueError: For an edit that does not exist or removes, and for points of another shape or not finite.
        """
        checked_whole(edit, "edit", 0, len(self.edits) - 1)
        posed = self.edits[edit].cage if self.deformed is None else self.deformed[edit]
        if posed is None or self.edits[edit].remove:
            raise InputError(f"edit {edit} removes what is in its cage: it has no map")
        return inverse_error(self.edits[edit].cage, posed, self.coordinates, points, self.device)

    def to_canonical(
        self, points: Any, directions: Any, *, step: float | None = None, return_outside: bool = False
    ) -> tuple[Any, ...]:
        """Where points of the deformed scene are in the canonical one, and how they are seen there (Eq. 4 and 5).

        Args:
            points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md).
            directions: (n, 3), from the camera into the scene, of any length but zero.
            step: The dt of the finite difference, world units. None is the field's march step.
            return_outside: Return a fourth array, which marks the points whose map leaves the rest cage.

        Returns:
            Points (n, 3), directions (n, 3) and region (n,) int32: 0 unchanged (as given), 1 cleared (nothing is there;
            as given), 2 mapped (unit directions). Points whose map leaves the rest cage are empty, and so cleared; the
            fourth array (n,) uint8 marks them. Arrays of the points' kind on their device: float32, but float64 for
            float64 NumPy.

        Raises:
            ValueError: For shapes that differ or are not (n, 3), values that are not finite, or a step that is not
                positive and finite.
        """
        with self.lock:
            return self._backend.to_canonical(self._posed_cages(), points, directions, step, return_outside)

    def sample(self, points: Any, directions: Any, *, step: float | None = None) -> tuple[Any, Any]:
        """Colour and density of the deformed scene at points, for renderers of fields: `to_canonical`, then the field.

        Args:
            points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md). They are taken in float32.
            directions: (n, 3), from the camera into the scene, of any length but zero.
            step: The dt of the finite differences, world units. None is the field's march step.

        Returns:
            Colours (n, 3) and densities (n,) per world unit, float32, as arrays of the points' kind on their device.
            Densities are 0 where the pose clears, and of `density="opacity"` times the stretch of the map along the
            direction, so that a sample of length dt has the optical depth sigma dt either way.

        Raises:
            ValueError: As `to_canonical`, for splats, and for a field whose densities are negative or not finite.
        """
        with self.lock:
            return self._backend.sample(self._posed_cages(), points, directions, step)

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
        """The view of a camera of the deformed scene, with the masks reveal, fold and outside; or those of several.

        Args:
            camera: The camera; or cameras of one size, whose views follow each other without a word to the host.
            background: Colour behind the scene, a name or (3,) in [0, 1]. None is the field's own; its background model
                stays where it is however the cages move, and shows where they clear.
            step: March step, world units, at least 1e-5 of the field's diagonal. None is the field's.
            supersampling: Rays along each side of a pixel. None is the field's.
            antialias: Of splats only: weaken those that the blur of the picture makes larger; see `SplatField.render`.
                None is the field's own.
            outputs: Of voxels: what is wanted beside colour, opacity, depth and masks, by names of Frame's properties:
                "canonical", "flow", "instance".
            flow_pose: Pose to which "flow" goes, as `pose` takes them. None is the pose of the view.
            flow_camera: Camera to which "flow" goes, one for all views or one each. None is the camera of the view.

        Returns:
            The frame, its arrays on the device; the Frames of several cameras, in one allocation there.

        Raises:
            ValueError: For a background that is not known, a step that is not positive and finite or is too short,
                a camera so far away that float32 cannot tell steps there, a posed cage so large that a march through it
                would not end, supersampling out of range, or antialias with voxels. For cameras of several sizes or
                none, outputs that are not known, and flow without its aim.
        """
        with self.lock:
            how = background, step, supersampling, antialias
            return render_pose(self._backend, self._posed_cages(), camera, how, outputs, flow_pose, flow_camera)

    def render_poses(
        self,
        poses: Sequence[PoseLike | Sequence[PoseLike | None]] | PointsLike,
        camera: Camera | Sequence[Camera],
        *,
        background: str | ArrayLike | None = None,
        step: float | None = None,
        supersampling: int | None = None,
        antialias: bool | None = None,
        outputs: str | Sequence[str] = (),
        flow_poses: Sequence[PoseLike | Sequence[PoseLike | None]] | PointsLike | None = None,
        flow_camera: Camera | Sequence[Camera] | None = None,
    ) -> Frames:
        """The view of a camera of each of several poses; this Deformer's own pose stays what it is.

        Args:
            poses: What `pose` takes for each view; for one edit also vertices (n, v, 3), world units, as an array of
                any library.
            camera: The camera, or one for each pose, of one size.
            background: As for `render`.
            step: As for `render`.
            supersampling: As for `render`.
            antialias: As for `render`.
            outputs: As for `render`.
            flow_poses: As many poses, to which "flow" goes. None is each view's own.
            flow_camera: As for `render`.

        Returns:
            The Frames, in one allocation on the device.

        Raises:
            ValueError: As `pose` and `render`, and for other numbers of poses and cameras.
        """
        with self.lock:
            how = background, step, supersampling, antialias
            return render_poses(self._backend, poses, camera, how, outputs, flow_poses, flow_camera)


class SplatDeformer(Deformer, of=SplatBackend):
    """Gaussian splats as cages deform them. `Deformer(splat_field, cage)` makes one.

    Splats are matter, so that they move forward: each is bound to the cage at rest once, and a pose is one weighted sum
    a splat. Covariances follow by the map's Jacobian, J S J^T; harmonics turn by the rotation nearest to J; a splat
    that the pose bends is drawn in pieces; one at the wall of a cage goes and stays by its shares (docs/splats.md).

    References: Xu and Harada, "Deforming Radiance Fields with Cages" (ECCV 2022), Eq. 5, with the map of Joshi et al.
    2007, Ju et al. 2005 or Lipman et al. 2008 from the cage at rest to the posed one.
    Limitations: what an edit moves is carried through later edits as its centre goes, on a lattice; fragments of edits
    are for voxels.

    Example::

        field = SplatField.load("scene.ply")
        cage = Cage.from_field(field)
        Deformer(field, cage).pose(cage.bend(40)).baked().save("bent.ply")

    Args:
        field: The splats.
        rest: A Cage around what is to be deformed, or a list of Cage or CageEdit, as for `Deformer`.
        coordinates: "harmonic", "mean_value" or "green"; the default is as for `Deformer`.
        resolution: Cells along the longest side of a cage of lattices, on which harmonic coordinates are solved. None
            is 128. Mean value and Green coordinates need no lattice for one edit.
        density: "opacity" keeps how opaque the splat is to a ray that goes along, so that a part keeps its look when
            it is stretched. "paper" keeps matter per length: optical depth grows with the stretch (the root mean
            square over directions).
        device: Warp device. None is the field's.
        store: "map": splats keep the weights that they need in any case.
        map: "forward" or None; "backward" puts splats where voxels under the same cages would be (Newton's method on
            the lattices of `resolution` of the posed cages).
        progress: As for `Deformer`.

    Raises:
        ValueError: For names that do not exist, or a cage that cannot be used.
        Cancelled: Where `progress` returned False.

    Attributes:
        field: The SplatField, on the device.
        edits: The CageEdits in their order.
        deformed: The posed cages, one per edit, None for an edit that removes; None before the first pose.
    """

    field: SplatField  # pyright: ignore[reportIncompatibleVariableOverride]

    def pose(self, deformed: PoseLike | Sequence[PoseLike | None]) -> SplatDeformer:
        """Move the cages; see `Deformer.pose`.

        Args:
            deformed: As for `Deformer.pose`.

        Returns:
            This SplatDeformer.

        Raises:
            ValueError: As `Deformer.pose`.
        """
        super().pose(deformed)
        return self

    def posed_splats(self) -> Any:
        """The Splats of the last pose, for kernels (kernels/splats/splats.py), relative to `field.center`.

        The field's own at rest. The next pose overwrites them: hold `lock` over this and what reads it, where several
        threads use this Deformer. Splats that are not drawn have opacity 0.
        """
        return self.posed_edits().posed  # pyright: ignore[reportAttributeAccessIssue]

    def baked(self) -> SplatField:
        """The posed splats as a field of their own: with turned harmonics, for files that any viewer opens.

        Splats that did not move keep every bit, and all of them what their file says that nobody here knows. Those that
        are cleared, split or hidden are left out.

        Returns:
            The field, on the same device.
        """
        with self.lock:
            posed, edits = self.posed_splats(), self._backend.posed
            if posed is self.field.splats:
                return self.field
            return baked_field(self.field, posed, edits)

    def save_sequence(
        self,
        path: str | os.PathLike[str],
        poses: Iterable[PoseLike | Sequence[PoseLike | None]],
        *,
        first: int = 1,
        overwrite: bool = False,
    ) -> list[pathlib.Path]:
        """Write a file for each of several poses, for viewers and programs that play such sequences.

        Each file is written whole or not at all; those before a failure stay. Files of the same name with other
        numbers, as a longer sequence before has left them, stay too, with a warning that names them, unless they are to
        be replaced.

        Args:
            path: The files, with a run of # where the number goes (`walk_####.ply`), in any format that is saved.
            poses: As `pose` takes them.
            first: Number of the first file, from 0.
            overwrite: Whether all files of such a name are removed, whatever their numbers, as soon as the first one of
                this sequence is made.

        Returns:
            The files.

        Raises:
            ValueError: For a path without a run of #, a first number that is none, or as `pose`.
        """
        pattern = checked_path(path, "the name of a sequence")
        marks = re.findall("#+", pattern.name)
        if len(marks) != 1:
            raise InputError(f"a sequence needs one run of # in its name, such as walk_####.ply, got {pattern.name!r}")
        format_to_write(pattern)
        checked_whole(first, "first", 0)
        written: list[pathlib.Path] = []
        for number, cages in enumerate(poses, first):
            with self.lock:
                baked = self.pose(cages).baked()
            for other in [] if written or not overwrite else numbered_files(pattern, marks[0]):
                other.unlink()
            written.append(pattern.with_name(pattern.name.replace(marks[0], str(number).zfill(len(marks[0])))))
            baked.save(written[-1])
        warn_of_others(pattern, marks[0], written)
        return written


# `__new__`, which chooses the class, would hide it
for _class in (Deformer, SplatDeformer):
    _of_self = inspect.signature(_class.__init__)
    _given = list(_of_self.parameters.values())[1:]
    _class.__signature__ = _of_self.replace(parameters=_given)  # pyright: ignore[reportAttributeAccessIssue]
