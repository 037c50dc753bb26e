"""Deformer: a radiance field as posed cages deform it, of voxels or of Gaussian splats."""

from __future__ import annotations

import inspect
import os
import pathlib
import re
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..core.arrays import PointsLike
from ..core.checks import checked_flag, checked_path, checked_whole, require_type
from ..core.devices import resolve_device
from ..core.locks import owner_lock
from ..core.names import (
    DENSITIES,
    FIELD_COORDINATES,
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
from ..core.reports import Progress, hears
from ..edits.edits import CageEdit, checked_edits
from ..edits.falloff import FalloffBand
from ..edits.fragments import found_fragments
from ..errors import InputError, UseError
from ..field.render import asked_view
from ..field.voxel_field import VoxelField
from ..kernels.splats.pose import LAW_DENSITY, LAW_RAYS
from ..lattice.buffers import StreamOrder
from ..mesh.validity import is_usable
from ..render.scene import PosedScene
from ..render.view import PosedEdits, cage_span, require_short_march
from ..splats.io.formats import format_to_write
from ..splats.matter import SplatDensity
from ..splats.render import render_field
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.frame import MASK_NAMES, Frame, Frames
from .exact import ExactEdits
from .posed import DeformerOptions, PosedDeformer, PoseLike, RestLike
from .poses import canonical_points, checked_pose, inverse_error
from .splat_baking import baked_field, numbered_files, warn_of_others
from .splat_edits import SplatEdits
from .views import ViewOptions, render_pose, render_poses

if TYPE_CHECKING:
    from typing_extensions import Self, Unpack  # of the type checker


class Deformer:
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
        field: The radiance field, a VoxelField or a SplatField.
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
        field: The VoxelField, on the device.
        edits: The CageEdits in their order.
        device: Warp device.
        coordinates: Kind of coordinates.
        resolution: Cells of the lattices, or None.
        density: "opacity" or "paper".
        store: "map" or "weights".
        deformed: The posed cages, one per edit, None for an edit that removes; None before the first pose.
        lock: Held while buffers are in use. Hold it around several calls that must see the same pose, and around what
            reads `posed_edits()`.
    """

    if TYPE_CHECKING:

        @overload
        def __new__(cls, field: SplatField, rest: RestLike, **options: Unpack[DeformerOptions]) -> SplatDeformer: ...
        @overload
        def __new__(cls, field: VoxelField, rest: RestLike, **options: Unpack[DeformerOptions]) -> Self: ...
        @overload
        def __new__(
            cls, field: VoxelField | SplatField, rest: RestLike, **options: Unpack[DeformerOptions]
        ) -> Deformer: ...

    def __new__(cls, field: Any, *args: Any, **options: Any) -> Any:
        if cls is Deformer and isinstance(field, SplatField):
            return object.__new__(SplatDeformer)
        return super().__new__(cls)

    @hears
    def __init__(
        self,
        field: VoxelField | SplatField,
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
        require_type(field, VoxelField, "a Deformer needs")
        assert isinstance(field, VoxelField)
        if map not in (None, "backward"):
            raise InputError(f'map={map!r} is for splats: voxels are looked up backward, "backward" or None')
        require_coordinates(coordinates)
        require_name(density, DENSITIES, "density")
        if resolution is None and coordinates == "harmonic":
            raise InputError("harmonic coordinates have no closed form: give a resolution, or mean_value or green")
        require_store(store)
        if resolution is None and store != "map":
            raise InputError('store="weights" keeps weights on a lattice: give a resolution')
        self.edits = checked_edits(rest)
        self.device = field.device if device is None else resolve_device(device)
        self.field = field.to(self.device)
        self.coordinates: Coordinates = coordinates
        self.density: Density = density
        self.store: Store = store
        self.resolution = resolution
        self.deformed: list[Cage | None] | None = None
        self.lock, self._order = owner_lock(self.device), StreamOrder(self.device)
        self._held: list[Cage | None] | None = None  # the pose that is in the buffers
        self._spans: list[float] = []  # of its cages
        self._edits: PosedEdits
        with self.lock:
            self._order.follow()
            self._bands = [FalloffBand(edit, self.field) if edit.falloff > 0.0 else None for edit in self.edits]
            self._carried = [found_fragments(edit, self.field, index) for index, edit in enumerate(self.edits)]
            origin, device = self.field.center, self.device
            if resolution is None:
                self._edits = ExactEdits(self.edits, coordinates, origin, device, self._bands, self._carried)
            else:
                kept = store, self._bands, self._carried
                edits = self._edits = PosedScene(self.edits, coordinates, resolution, origin, device, *kept)
                edits.warm(self.field)

    @property
    def reached_bounds(self) -> np.ndarray:
        """(2, 3) box of all that the field and the posed cages reach, fragments that go with them too; world units."""
        with self.lock:
            self.posed_edits()
            boxes = [cage.bounds for cage in self.deformed or [] if cage is not None]
            boxes += [each.bounds for each in self._carried if each is not None and each.bounds is not None]
            reached = np.stack([self.field.bounds, *boxes])
        return np.stack([reached[:, 0].min(axis=0), reached[:, 1].max(axis=0)])

    def __reduce__(self):
        raise UseError("a Deformer is held on a device and not copied between processes: make one in each of them")

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
        cages = self._checked(deformed)
        with self.lock:
            before, self.deformed = self.deformed, None  # should this fail half-way, the next use starts from rest
            try:
                self._hold(cages)
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
        cages = self._checked(deformed)
        with self.lock:
            self._hold(cages)
        return PosedDeformer(self, cages)

    def posed_edits(self) -> PosedEdits:
        """What kernels take of the last pose; the cages are posed at rest where there was none.

        Hold `lock` over this and what reads it, where several threads use this Deformer.
        """
        with self.lock:
            if self.deformed is None:
                self.pose([None if edit.remove else edit.cage for edit in self.edits])
            assert self.deformed is not None
            return self._hold(self.deformed)

    def _checked(self, deformed: PoseLike | Sequence[PoseLike | None]) -> list[Cage | None]:
        """The cages of a pose, one per edit. Whether they can be used is for the edits to find, which have the device
        at work meanwhile."""
        cages = list(deformed) if isinstance(deformed, list | tuple) else [deformed]
        if len(cages) != len(self.edits):
            raise InputError(f"a pose needs one cage per edit, {len(self.edits)}, got {len(cages)}")
        numbered = enumerate(zip(self.edits, cages, self._bands, strict=True))
        return [checked_pose(edit, cage, index, band) for index, (edit, cage, band) in numbered]

    def _hold(self, cages: list[Cage | None]) -> PosedEdits:
        """The edits with this pose in their buffers, computed where another one is there. Needs the lock."""
        self._order.follow()  # poses and frames of other streams share the buffers
        if self._held is not cages:
            self._held = None
            self._edits.pose(cages)
            self._held, self._spans = cages, [cage_span(cage) for cage in cages]
        return self._edits

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
            return self._to_canonical(self.posed_edits(), points, directions, step, return_outside)

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
            return render_pose(self, self.posed_edits, camera, how, outputs, flow_pose, flow_camera)

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
            return render_poses(self, poses, camera, how, outputs, flow_poses, flow_camera)

    def _to_canonical(
        self, edits: PosedEdits, points: Any, directions: Any, step: float | None, return_outside: bool
    ) -> tuple[Any, ...]:
        """`to_canonical` of the pose that the buffers hold."""
        return canonical_points(self.field, edits, points, directions, step, return_outside)

    def _render(
        self,
        posed_edits: Callable[[], PosedEdits],
        camera: Camera,
        background: str | ArrayLike | None,
        step: float | None,
        supersampling: int | None,
        antialias: bool | None,
        into: dict[str, wp.array] | None = None,
        again: bool = False,
    ) -> Frame:
        """`render` of a pose, which is worked out once the rest is checked. into: arrays (h * w,) to fill, None makes
        new ones; again: a view of the same call came before, and densities are as it found them."""
        if antialias is not None and checked_flag(antialias, "antialias"):
            raise InputError("antialias is for splats: voxels take more rays a pixel (supersampling)")
        masks = {"masks": MASK_NAMES, "into": into, "is_again": again}
        view = asked_view(self.field, camera, background, step, supersampling, **masks)
        edits = posed_edits()
        require_short_march(self._spans, view.step)
        return edits.render(view, chosen(self.density, "density", opacity=1, paper=0))


class SplatDeformer(Deformer):
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

    @hears
    def __init__(
        self,
        field: SplatField,
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
        require_type(field, SplatField, "a SplatDeformer needs")
        require_coordinates(coordinates)
        require_name(density, DENSITIES, "density")
        self.coordinates, self.density = coordinates, density
        self.map = "forward" if map is None else require_name(map, SPLAT_MAPS, "map")
        if store != "map":
            raise InputError(f'splats keep their weights: store must be "map", got {store!r}')
        self.store, self.resolution = store, resolution
        self.edits = checked_edits(rest)
        if any(edit.fragments > 0.0 for edit in self.edits):
            raise InputError("fragments are for voxels: splats of a part that hang over its wall go by their shares")
        self.device = field.device if device is None else resolve_device(device)
        self.field = field.to(self.device)
        self.deformed = None
        self.lock, self._order = owner_lock(self.device), StreamOrder(self.device)
        self._held = None
        with self.lock:
            self._bands = [self._band(edit) if edit.falloff > 0.0 else None for edit in self.edits]
            law = chosen(density, "density", opacity=LAW_RAYS, paper=LAW_DENSITY)
            backward = self.map == "backward"
            self._edits: Any = SplatEdits(self.field, self.edits, coordinates, resolution, law, backward, self._bands)

    def _band(self, edit: CageEdit) -> FalloffBand:
        """The band of an edit; what walls cut is found among the splats near its cage."""
        low, high = edit.cage.bounds
        reach = 0.1 * edit.cage.size
        matter: Any = SplatDensity(self.field, bounds=np.array([low - reach, high + reach]))
        return FalloffBand(edit, matter)

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
            posed, edits = self.posed_splats(), self._edits
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

    def _to_canonical(self, edits: Any, points: Any, directions: Any, step: float | None, return_outside: bool) -> Any:
        raise InputError(
            "to_canonical looks points up backward, as voxels are: splats move forward; take deform_points for points, "
            "or posed_splats for the splats themselves"
        )

    def _render(
        self,
        posed_edits: Any,
        camera: Camera,
        background: str | ArrayLike | None,
        step: float | None,
        supersampling: int | None,
        antialias: bool | None,
        into: dict[str, wp.array] | None = None,
        again: bool = False,
    ) -> Frame:
        """`render` of a pose."""
        if step is not None:
            raise InputError("splats are not marched through: leave step out")
        return render_field(self.field, posed_edits().posed, camera, background, supersampling, antialias, into)


# `__new__`, which chooses the class, would hide it
for _class in (Deformer, SplatDeformer):
    _of_self = inspect.signature(_class.__init__)
    _class.__signature__ = _of_self.replace(parameters=list(_of_self.parameters.values())[1:])  # pyright: ignore
