"""Deformer: a voxel field and cages, rendered as the posed cages deform it."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..core.arrays import as_host_points, as_points, is_device_array
from ..core.checks import require_type
from ..core.devices import launch, resolve_device
from ..core.names import DENSITIES
from ..field.voxel_field import STOP_TRANSMITTANCE, VoxelField
from ..kernels.deform.march import MarchOptions
from ..kernels.deform.render import Picture
from ..mesh.match import require_same_faces
from ..mesh.usable import require_usable
from ..view.camera import Camera
from ..view.frame import Frame, average_frame, camera_struct, checked_supersampling, finer_camera, tile_threads
from .edits import ClosedFormEdits, LatticeEdits, checked_edits

COORDINATES = ("harmonic", "mean_value", "green")
STORES = ("map", "weights")


class Deformer:
    """A radiance field as cages deform it.

    field: VoxelField. rest: a Cage around what is to be deformed, as it is in the field, or a list of Cage / CageEdit
    that are resolved in order (each acts on the scene that the ones before it left).
    coordinates: "harmonic", "mean_value" or "green". resolution: cells of the map's lattice along the longest side of a
    cage; None evaluates mean value or Green coordinates at every sample (slow: the paper's "precise").
    density: "opacity" takes optical depth in canonical arc length, sigma |phi(x + dt d) - phi(x)|, so that a part keeps
    its opacity when it is scaled; "paper" keeps sigma as Eq. 5 has it.
    device: Warp device; None is the field's. store: "map" keeps the positions that the weights lead to on the lattice;
    "weights" keeps the weights themselves, as the paper does, at many times the memory, for the same picture.

    Before the first `pose` the cages are at rest: the deformed scene is the field itself.

    Raises ValueError for names that do not exist, harmonic coordinates without a lattice, or a cage that is not usable.

    References: Xu and Harada, "Deforming Radiance Fields with Cages" (ECCV 2022), Eq. 3-5, section 4.1.
    Limitations: what a map sends out of its rest cage is left empty (`Frame.outside` counts it), and what a moved cage
    uncovers was never seen by a camera (`Frame.reveal`).

    Example::

        cage = Cage.from_field(field)
        frame = Deformer(field, cage).pose(cage.twist(60)).render(camera)
    """

    def __init__(
        self,
        field: VoxelField,
        rest,
        *,
        coordinates: str = "harmonic",
        resolution: int | None = 128,
        density: str = "opacity",
        device=None,
        store: str = "map",
    ):
        require_type(field, VoxelField, "a Deformer needs")
        if coordinates not in COORDINATES:
            raise ValueError(f"coordinates {coordinates!r} are not known: {', '.join(COORDINATES)}")
        if density not in DENSITIES:
            raise ValueError(f"density {density!r} is not known: {', '.join(DENSITIES)}")
        if resolution is None and coordinates == "harmonic":
            raise ValueError("harmonic coordinates have no closed form: give a resolution, or mean_value or green")
        if store not in STORES:
            raise ValueError(f"store {store!r} is not known: {', '.join(STORES)}")
        if resolution is None and store != "map":
            raise ValueError('store="weights" keeps weights on a lattice: give a resolution')
        self.edits = checked_edits(rest)
        self.device = field.device if device is None else resolve_device(device)
        self.field = field.to(self.device)
        self.coordinates, self.resolution, self.density, self.store = coordinates, resolution, density, store
        self.deformed: list[Cage | None] | None = None  #: one cage an edit, None for an edit that removes
        if resolution is None:
            self._edits = ClosedFormEdits(self.edits, coordinates, self.field.center, self.device)
        else:
            self._edits = LatticeEdits(self.edits, coordinates, resolution, self.field.center, self.device, store)

    def pose(self, deformed) -> Deformer:
        """Move the cages: one Cage, or one an edit in their order (None for an edit that removes). Returns self.

        Raises ValueError for another count, cages whose faces differ from the rest cage's, or a cage that cannot be
        used (inverted, open, without volume); the pose before stays then. Also for too little memory, or a cage so far
        from the field that float32 cannot tell the cells of its lattice apart; the cages are at rest then.
        """
        cages = list(deformed) if isinstance(deformed, list | tuple) else [deformed]
        if len(cages) != len(self.edits):
            raise ValueError(f"a pose needs one cage an edit, {len(self.edits)}, got {len(cages)}")
        for index, (edit, cage) in enumerate(zip(self.edits, cages, strict=True)):
            if edit.remove:
                cages[index] = None
                continue
            require_type(cage, Cage, f"the pose of edit {index} must be")
            require_same_faces(edit.cage, cage)
            require_usable(cage, "the deformed cage")
        self.deformed = None  # should this fail half-way, the next use starts from rest
        self._edits.pose(cages)
        self.deformed = cages
        return self

    def __reduce__(self):
        raise TypeError("a Deformer is held on a device and not copied between processes: make one in each of them")

    def _require_pose(self) -> None:
        if self.deformed is None:
            self.pose([None if edit.remove else edit.cage for edit in self.edits])

    def to_canonical(self, points, directions, *, step: float | None = None, return_outside: bool = False):
        """Where points of the deformed scene are in the canonical one, and how they are seen there (Eq. 4 and 5).

        points: (n, 3) world units. directions: (n, 3) from the camera into the scene, any length but zero. step: the dt
        of the finite difference, world units; None takes the field's march step.

        Returns points (n, 3), directions (n, 3) and region (n,) int32: 0 unchanged (as given), 1 cleared (nothing is
        there; as given), 2 mapped (unit directions). Points whose map leaves the rest cage are empty, and so cleared;
        return_outside=True returns a fourth array (n,) uint8 that marks them. NumPy in, NumPy out, float64 where the
        points are; Warp or DLPack arrays in, Warp arrays on their device out, float32.
        Raises ValueError for shapes that differ or are not (n, 3), or a step that is not positive.
        """
        self._require_pose()
        origin = np.zeros(3)
        dtype = np.float64 if getattr(points, "dtype", None) == np.float64 else np.float32
        if is_device_array(points):
            x, keep = as_points(points, self.device)
            kernel_origin = self.field.center
        else:
            origin = self.field.center
            x, keep = as_points(as_host_points(points) - origin, self.device)
            kernel_origin = np.zeros(3)
        d, _ = as_points(directions, self.device, name="directions")
        if x.shape != d.shape:
            raise ValueError(f"points and directions must be as many, got {x.shape[0]} and {d.shape[0]}")
        count = x.shape[0]
        outputs = [
            wp.empty(count, dtype=wp.vec3, device=self.device),
            wp.empty(count, dtype=wp.vec3, device=self.device),
            wp.empty(count, dtype=wp.int32, device=self.device),
            wp.empty(count, dtype=wp.uint8, device=self.device),
        ]
        inputs = [self._edits.array, wp.vec3(*kernel_origin), x, d, self._checked_step(step)]
        launch(self._edits.map_kernel, count, inputs, outputs, device=self.device)
        if not keep:
            outputs = [array.numpy() for array in outputs]
            outputs[0] = (outputs[0].astype(np.float64) + origin).astype(dtype)
            # what did not move keeps its last bit
            still = outputs[2] != 2
            outputs[0][still] = np.asarray(points, dtype).reshape(-1, 3)[still]
        return tuple(outputs) if return_outside else tuple(outputs[:3])

    def render(self, camera, *, background=None, step: float | None = None, supersampling: int | None = None) -> Frame:
        """The view of a camera of the deformed scene, with the masks reveal, fold and outside.

        background: colour name or (3,); None takes the field's own, whose background model stays where it is however
        the cages move, and shows where they clear. step: march step in world units; None takes the field's.
        supersampling: rays a side of a pixel; None takes the field's. Raises ValueError for a background that is not
        known, a step that is not positive, or supersampling out of range.
        """
        require_type(camera, Camera, "render needs")
        self._require_pose()
        side = checked_supersampling(self.field.supersampling if supersampling is None else supersampling)
        if side > 1:
            parts = self.render(finer_camera(camera, side), background=background, step=step, supersampling=1)
            return average_frame(parts, side)
        colour, model = self.field.chosen_background(background)
        options = MarchOptions()
        options.step = self._checked_step(step)
        options.stop = STOP_TRANSMITTANCE
        options.arc_opacity = int(self.density == "opacity")
        self._edits.prepare(self.field.grid, options.step)
        count = camera.width * camera.height
        picture = Picture()
        picture.rgb = wp.empty(count, dtype=wp.vec3, device=self.device)
        names = ("alpha", "depth", "reveal", "fold", "outside")
        for name in names:
            setattr(picture, name, wp.empty(count, dtype=wp.float32, device=self.device))
        camera_data = camera_struct(camera, self.field.center)
        inputs = [self.field.grid, self._edits.scene, camera_data, wp.vec3(*map(float, colour)), options, picture]
        launch(self._edits.render_kernel, tile_threads(camera), inputs, device=self.device)
        if model is not None:
            model.add_behind(camera, picture.rgb, picture.alpha)
        return Frame(camera.width, camera.height, picture.rgb, **{name: getattr(picture, name) for name in names})

    def _checked_step(self, step: float | None) -> float:
        step = self.field.step if step is None else float(step)
        if not (step > 0 and np.isfinite(step)):
            raise ValueError(f"the step must be positive and finite, got {step}")
        return step
