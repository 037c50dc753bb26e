"""Deformer: a field or mesh as posed cages deform it, and its poses, which render."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Generic, cast, overload

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..core.arrays import PointsLike
from ..core.checks import checked_whole, require_type, warn_renamed
from ..core.devices import HeldOnDevice, resolve_device
from ..core.names import FIELD_COORDINATES, Coordinates, Density, SplatMap, Store
from ..core.reports import Progress, reports_progress
from ..core.threads import owner_lock
from ..edits.edits import checked_edits
from ..errors import InputError
from ..field.render import PoseKeywords, RenderOptions, render_options, takes_options
from ..mesh.validity import is_usable
from ..render.view import PosedEdits
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.frame import Frame, Frames
from .backends import AnyBackend, FieldT, MapOptions, backend_of
from .poses import PoseLike, RestLike, inverse_error
from .views import ViewKeywords, render_pose, render_poses

if TYPE_CHECKING:
    from typing_extensions import Self, Unpack  # of the type checker


class PosedDeformer(Generic[FieldT]):
    """One pose of a Deformer, which renders; see `Deformer.posed`."""

    def __init__(self, deformer: Deformer[FieldT], cages: list[Cage | None]):
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
    def render(self, camera: Camera, **options: Unpack[ViewKeywords]) -> Frame: ...
    @overload
    def render(self, camera: Sequence[Camera], **options: Unpack[ViewKeywords]) -> Frames: ...
    def render(
        self,
        camera: Camera | Sequence[Camera],
        *,
        outputs: str | Sequence[str] = (),
        flow_pose: PoseLike | Sequence[PoseLike | None] | None = None,
        flow_camera: Camera | Sequence[Camera] | None = None,
        **options: Any,
    ) -> Frame | Frames:
        """The view of a camera, or those of several, of the scene in this pose; see `Deformer.render`."""
        shared, chosen = self.deformer, render_options(options, ViewKeywords)
        shared._backend.check_view(chosen)
        with shared.lock:
            return render_pose(shared._backend, self.deformed, camera, chosen, outputs, flow_pose, flow_camera)

    def _render(self, camera: Camera, options: RenderOptions) -> Frame:
        """The view of a camera; options of other kinds of fields do nothing."""
        shared = self.deformer
        with shared.lock:
            return shared._backend.render(self.deformed, camera, options)


class Deformer(HeldOnDevice, Generic[FieldT]):
    """A radiance field or a mesh, deformed by cages.

    Before the first `pose` the cages are at rest: the deformed scene is the field itself. Any thread may use it;
    threads that share one take a pose each by `posed` (docs/threads.md).

    Voxels are looked up backward, from the posed scene to the one at rest. Splats move forward: each is bound to the
    cage at rest once, and a pose is one weighted sum a splat. Covariances follow by the map's Jacobian, J S J^T;
    harmonics turn by the rotation nearest to J; a splat that the pose bends is drawn in pieces; one at the wall of a
    cage moves and stays by its shares (docs/splats.md).

    References: Xu and Harada, "Deforming Radiance Fields with Cages" (ECCV 2022), Eq. 3-5, section 4.1; coordinates of
    Joshi et al. 2007, Ju et al. 2005 and Lipman et al. 2008.
    Limitations: what a map sends out of its rest cage is left empty (`Frame.outside` counts it), and what a moved cage
    uncovers was never seen by a camera (`Frame.reveal`). A splat that an edit moves is carried through later edits as
    its centre goes, on a lattice; fragments of edits are for voxels.

    Example::

        cage = Cage.from_field(field)
        frame = Deformer(field, cage).pose(cage.twist(60)).render(camera)
        Deformer(SplatField.load("scene.ply"), cage).pose(cage.bend(40)).baked().save("bent.ply")

    Args:
        field: A VoxelField, a SplatField, or a SampledField of any other representation; or a SurfaceMesh, whose
            vertices go with the cages that they are in, as `deform_points` moves them.
        rest: A Cage around what is to be deformed, as it is in the field; or a list of Cage or CageEdit, each of which
            acts on the scene that the ones before it left.
        coordinates: "harmonic", "mean_value", "green", "maximum_likelihood" or "biharmonic". The default is harmonic,
            as in the paper; `deform_points` has mean value: name one kind in both for the same map.
        resolution: Cells of the map's lattice along the longest side of a cage. None evaluates mean value or Green
            coordinates at every sample, which is slow: the paper's "precise". For splats None is 128; they need no
            lattice for one edit with mean value or Green coordinates.
        density: "opacity" takes optical depth in canonical arc length, sigma |phi(x + dt d) - phi(x)|, so that a part
            keeps its opacity when it is scaled; a splat stays as opaque to a ray that goes along. "paper" keeps sigma
            as Eq. 5 has it; the optical depth of a splat grows with its stretch (root mean square over directions).
        device: Warp device. None is the field's.
        store: "map" keeps the positions that the weights lead to on the lattice. "weights" keeps the weights
            themselves, as the paper does: many times the memory for the same picture. Voxels only.
        map: Splats only: "forward" moves them by the coordinates of the cage at rest, "backward" puts them where voxels
            under the same cages would be (Newton's method on lattices of the posed cages). None is forward for splats
            and meshes, backward for the rest.
        progress: True shows bars on stderr. A function is called with (done, total, message) while splats are
            bound or kernels compiled, and cancels that by returning False or by raising.

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

    @reports_progress
    def __init__(
        self,
        field: FieldT,
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
        kind = backend_of(field)
        options = MapOptions(coordinates, resolution, density, store, map)
        kind.check(options)
        self.edits = checked_edits(rest)
        self.device = field.device if device is None else resolve_device(device)
        self.field: FieldT = cast(Any, field).to(self.device)
        self.coordinates: Coordinates = coordinates
        self.density: Density = density
        self.store: Store = store
        self.map: SplatMap | None = map
        self.resolution = resolution
        self.deformed: list[Cage | None] | None = None
        self.lock = owner_lock(self.device)
        with self.lock:
            self._backend: AnyBackend = kind(self.field, self.edits, options, progress)

    @property
    def reached_bounds(self) -> np.ndarray:
        """(2, 3) box of all that the field and the posed cages reach, fragments that go with them too; world units."""
        with self.lock:
            return self._backend.reached(self._posed_cages())

    def pose(self, deformed: PoseLike | Sequence[PoseLike | None]) -> Self:
        """Move the cages.

        Args:
            deformed: One pose: a Cage, its vertices (v, 3) in world units as an array of any library, or a file of one
                pose that `PoseFile.load` reads; or a list of one per edit in their order, None for one that removes.

        Returns:
            This Deformer.

        Raises:
            ValueError: For another count, cages whose faces differ from the rest cage's, or a cage that cannot be used
                (inverted, open, without volume); the pose before stays then. Also for too little memory, or a cage too
                far from the field for the cells of its lattice in float32; the cages are at rest then.
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

    def posed(self, deformed: PoseLike | Sequence[PoseLike | None]) -> PosedDeformer[FieldT]:
        """A separate pose, for callers that share this Deformer, whose current pose stays.

        All poses share the buffers: a pose is computed again where another one was used in between. Threads that take
        turns at every frame are faster with a Deformer each.

        Args:
            deformed: As for `pose`.

        Returns:
            The pose, with the methods `render`, `sample` and `to_canonical`.

        Raises:
            ValueError: As `pose`.
        """
        cages = self._backend.checked(deformed)
        with self.lock:
            self._backend.hold(cages)
        return PosedDeformer(self, cages)

    def posed_edits(self) -> PosedEdits:
        """The edits of the last pose for kernels, at rest before the first one.

        Where several threads use this Deformer, hold `lock` over this and what reads it.
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
        """The distance between the two maps of the last pose: 0 where each is the inverse of the other.

        Voxels are looked up backward, by coordinates of the posed cage; splats and `deform_points` move forward, by
        those of the cage at rest. The error of a point is its distance to itself after the one map and then the other.

        Args:
            points: (n, 3), world units, in the posed cage. None is a grid of 24 cells along its longest side.
            edit: Number of the edit; its falloff and fragments are left out.

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
            posed = PosedDeformer(self, self._posed_cages())
            return posed.to_canonical(points, directions, step=step, return_outside=return_outside)

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
            return PosedDeformer(self, self._posed_cages()).sample(points, directions, step=step)

    @overload
    def render(self, camera: Camera, **options: Unpack[ViewKeywords]) -> Frame: ...
    @overload
    def render(self, camera: Sequence[Camera], **options: Unpack[ViewKeywords]) -> Frames: ...
    @takes_options(PoseKeywords)
    def render(
        self,
        camera: Camera | Sequence[Camera],
        *,
        outputs: str | Sequence[str] = (),
        flow_pose: PoseLike | Sequence[PoseLike | None] | None = None,
        flow_camera: Camera | Sequence[Camera] | None = None,
        **options: Unpack[PoseKeywords],
    ) -> Frame | Frames:
        """The view of a camera of the deformed scene, with the masks reveal, fold and outside; or those of several.

        A background model stays where it is however the cages move, and shows where they clear.

        Args:
            camera: The camera; or cameras of one size, whose views are launched without waiting for the host.
            outputs: Voxels only: outputs beside colour, opacity, depth and masks, by names of Frame's properties:
                "canonical", "flow", "instance".
            flow_pose: Pose to which "flow" goes, as `pose` takes them. None is the pose of the view.
            flow_camera: Camera to which "flow" goes, one for all views or one each. None is the camera of the view.
            options: Options of the frame by keyword, see docs/python.md.

        Returns:
            The frame, its arrays on the device; the Frames of several cameras, in one allocation there.

        Raises:
            ValueError: For a background that is not known, a step that is not positive and finite or is too short,
                a camera too far away for its steps in float32, a posed cage that takes too many steps, supersampling
                out of range, or antialias with voxels. For cameras of several sizes or none, outputs that are not
                known, and flow without `flow_pose` or `flow_camera`.
        """
        with self.lock:
            posed = PosedDeformer(self, self._posed_cages())
            return posed.render(camera, outputs=outputs, flow_pose=flow_pose, flow_camera=flow_camera, **options)

    def _render(self, camera: Camera, options: RenderOptions) -> Frame:
        """As that of a PosedDeformer."""
        with self.lock:
            return PosedDeformer(self, self._posed_cages())._render(camera, options)

    @takes_options(PoseKeywords)
    def render_poses(
        self,
        poses: Sequence[PoseLike | Sequence[PoseLike | None]] | PointsLike,
        camera: Camera | Sequence[Camera],
        *,
        outputs: str | Sequence[str] = (),
        flow_poses: Sequence[PoseLike | Sequence[PoseLike | None]] | PointsLike | None = None,
        flow_camera: Camera | Sequence[Camera] | None = None,
        **options: Unpack[PoseKeywords],
    ) -> Frames:
        """The view of a camera of each of several poses; the current pose stays.

        Args:
            poses: What `pose` takes for each view; for one edit also vertices (n, v, 3), world units, as an array of
                any library.
            camera: The camera, or one for each pose, of one size.
            outputs: As for `render`.
            flow_poses: As many poses, to which "flow" goes. None is each view's own.
            flow_camera: As for `render`.
            options: Options of the frames by keyword, see docs/python.md.

        Returns:
            The Frames, in one allocation on the device.

        Raises:
            ValueError: As `pose` and `render`, and for other numbers of poses and cameras.
        """
        chosen = render_options(options, PoseKeywords)
        self._backend.check_view(chosen)
        with self.lock:
            return render_poses(self._backend, poses, camera, chosen, outputs, flow_poses, flow_camera)

    def posed_splats(self) -> Any:
        """Splats only: those of the last pose, for kernels (kernels/splats/splats.py), relative to `field.center`.

        The field's own at rest. The next pose overwrites them: hold `lock` over this and what reads it, where several
        threads use this Deformer. Splats that are not drawn have opacity 0.

        Raises:
            ValueError: For a field that is not one of splats.
        """
        self._splat_field("posed_splats")
        return cast(Any, self.posed_edits()).posed

    def baked(self) -> SplatField:
        """Splats only: the posed ones as a field of their own, with turned harmonics, for files that any viewer opens.

        Splats that did not move keep every bit, and all of them the properties of their file that warpcage does not
        know. Those that are cleared, split or hidden are left out.

        Returns:
            The field, on the same device.

        Raises:
            ValueError: For a field that is not one of splats: `bake` takes voxels too.
        """
        from .splat_baking import baked_field  # with kernels that voxels do not need

        field = self._splat_field("baked")
        with self.lock:
            posed, edits = self.posed_splats(), self._backend.posed
            return field if posed is field.splats else baked_field(field, posed, edits)

    def save_sequence(
        self,
        path: str | os.PathLike[str],
        poses: Iterable[PoseLike | Sequence[PoseLike | None]],
        *,
        first: int = 1,
        overwrite: bool = False,
    ) -> list[pathlib.Path]:
        """Splats only: write a file for each of several poses, for viewers and programs that play such sequences.

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
            ValueError: For a field that is not one of splats, a path without a run of #, a first number that is none,
                or as `pose`.
        """
        from .splat_baking import write_sequence

        self._splat_field("save_sequence")
        return write_sequence(path, (self._baked_pose(pose) for pose in poses), first, overwrite)

    def _baked_pose(self, pose: Any) -> SplatField:
        with self.lock:
            return self.pose(pose).baked()

    def _splat_field(self, name: str) -> SplatField:
        """The field, for a method that only splats have."""
        if not isinstance(self.field, SplatField):
            raise InputError(f"{name} is for splats, this Deformer has a {type(self.field).__name__}")
        return self.field


class _DeformersOfSplats(type):
    """Lets `isinstance` find a Deformer of splats by the old name."""

    def __instancecheck__(cls, instance: Any) -> bool:
        if cls is not SplatDeformer:
            return super().__instancecheck__(instance)
        warn_renamed("SplatDeformer", "Deformer")
        return isinstance(instance, Deformer) and isinstance(instance.field, SplatField)


class SplatDeformer(Deformer[SplatField], metaclass=_DeformersOfSplats):
    """The old name of `Deformer(splat_field, rest)`, for one version.

    Args:
        field: The splats.
        rest: As for `Deformer`.
        options: As for `Deformer`.

    Raises:
        ValueError: As `Deformer`, and for another kind of field.
        Cancelled: Where `progress` returned False.

    Attributes:
        field: The SplatField, on the device.
        edits: The CageEdits in their order.
        deformed: The posed cages, one per edit, None for an edit that removes; None before the first pose.
    """

    def __init__(self, field: SplatField, rest: RestLike, **options: Any):
        warn_renamed("SplatDeformer", "Deformer")
        require_type(field, SplatField, "a SplatDeformer needs")
        super().__init__(field, rest, **options)
