"""A Deformer in a pose given as an array: canonical points and frames of it, and what they pass back."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import weakref
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..core.arrays import array_view, as_points, empty_array
from ..core.checks import checked_step
from ..core.devices import launch
from ..deform.deformer import Deformer
from ..errors import InputError
from ..fitting.batches import ShardedWork, launch_shards, shard_count, sum_shards
from ..gradients.frame import frame_gradient
from ..kernels.edits.canonical_adjoint import propagate_canonical_points
from ..render.scene import PosedScene
from ..splats.splat_field import SplatField
from ..view.camera import Camera
from ..view.frame import PART_NAMES, view_background

#: The last pose of each Deformer that was an array: to go back finds it in the buffers.
_last: weakref.WeakKeyDictionary[Deformer[Any], list[Cage | None]] = weakref.WeakKeyDictionary()


@dataclasses.dataclass(frozen=True, eq=False)
class CanonicalSlopes:
    """Slopes of a number, Warp arrays of vec3 on the Deformer's device, per world unit."""

    points: wp.array  # (n,)
    directions: wp.array  # (n,)
    vertices: wp.array | None = None  # (v,) of the posed cage


def posed_vertices(deformer: Deformer[Any]) -> np.ndarray:
    """The vertices (v, 3) float64 of a Deformer's last pose, which must be of one edit, of voxels on a lattice."""
    edits, is_exact = deformer.edits, deformer.resolution is None and not isinstance(deformer.field, SplatField)
    if len(edits) != 1 or edits[0].remove or edits[0].falloff or edits[0].fragments or is_exact:
        raise InputError(
            "gradients are of a Deformer with a resolution and one edit that moves or copies, without falloff and "
            "fragments"
        )
    cages = deformer.deformed
    return (edits[0].cage if cages is None or cages[0] is None else cages[0]).vertices


@contextlib.contextmanager
def posed_as(deformer: Deformer[Any], vertices: np.ndarray) -> Iterator[None]:
    """A Deformer of one edit in a pose (v, 3), locked; its own pose is there again behind."""
    posed_vertices(deformer)  # refuses others
    with deformer.lock:
        before = deformer.deformed
        held = (before, _last.get(deformer))
        cages = next((each for each in held if each is not None and _is_pose(each, vertices)), None)
        if cages is None:
            cages = _last[deformer] = deformer.posed(vertices).deformed
        deformer.deformed = cages
        try:
            yield
        finally:
            deformer.deformed = before


def _is_pose(cages: list[Cage | None], vertices: np.ndarray) -> bool:
    return cages[0] is not None and np.array_equal(cages[0].vertices, vertices)


def canonical_points_vjp(
    deformer: Deformer[Any],
    points: Any,
    directions: Any,
    region: wp.array[Any],
    slopes: tuple[Any, Any],
    step: float | None = None,
    *,
    by_vertices: bool = False,
) -> CanonicalSlopes:
    """Slopes of a number by what `Deformer.to_canonical` takes in the last pose, from those (n, 3) by the points and
    directions that it returns. region: (n,) int32, as it returned it."""
    # Arrays of any library; `posed_vertices` refuses other edits. What was not moved passes slopes on as they are.
    with deformer.lock:
        scene, device, field = deformer.posed_edits(), deformer.device, deformer.field
        assert isinstance(scene, PosedScene)
        position_map = scene.lattices.maps[0]
        assert position_map is not None
        x, d = as_points(points, device), as_points(directions, device, name="directions")
        given = [as_points(each, device, name="slopes") for each in slopes]
        found = [empty_array(len(x), wp.vec3, device) for _ in range(2)]
        inputs = [scene.array, wp.vec3(*field.center), x, d, checked_step(step, field.step), region, *given]
        if not by_vertices:
            outputs = [*found, wp.zeros((0, 0, 0), dtype=wp.vec3, device=device)]
            launch(propagate_canonical_points, len(x), inputs, outputs, device=device, work=4 * scene.sample_work)
            return CanonicalSlopes(*found)
        shape, shards = position_map.data.positions.shape, shard_count(device)
        sums = [wp.zeros(3 * math.prod(shape), dtype=wp.float32, device=device) for _ in range(shards)]
        shared = [[*found, array_view(each, wp.vec3, shape)] for each in sums]
        launch_shards([ShardedWork(propagate_canonical_points, len(x), inputs, shared)], shards, device)
        by_nodes = array_view(sum_shards(sums), wp.vec3, shape)
        return CanonicalSlopes(found[0], found[1], position_map.vertex_gradient(by_nodes)[0])


@dataclasses.dataclass(frozen=True, eq=False)
class FrameOptions:
    """What a frame is of, beside the pose."""

    camera: Camera
    change: np.ndarray | None  # (7,) of `turned_camera`
    background: tuple[float, float, float]
    step: float | None  # of the march, world units

    @property
    def view(self) -> Camera:
        """The camera as it is changed."""
        return self.camera if self.change is None else turned_camera(self.camera, self.change)


def frame_color(deformer: Deformer[Any], background: Sequence[float] | None) -> tuple[float, float, float]:
    """The colour behind a frame, the field's own where none is given."""
    if background is None and getattr(deformer.field, "background_model", None) is not None:
        raise InputError("gradients are of frames without surroundings: give the colour of a background")
    red, green, blue = deformer.field.background if background is None else view_background(background)
    return float(red), float(green), float(blue)


def posed_frame(deformer: Deformer[Any], vertices: np.ndarray, options: FrameOptions) -> list[wp.array[Any]]:
    """Colours, opacities and depths (h * w,) of a frame of a Deformer in a pose (v, 3)."""
    with posed_as(deformer, vertices):
        arrays = deformer.render(options.view, background=options.background, step=options.step).arrays
    return [arrays[name] for name in PART_NAMES]


def posed_frame_vjp(
    deformer: Deformer[Any], vertices: np.ndarray, slopes: Sequence[Any], options: FrameOptions
) -> tuple[wp.array[Any], np.ndarray | None]:
    """Slopes of a number by the posed vertices, (v,) vec3 on the Deformer's device, and by the camera's change (7,)
    where there is one, from those by what `posed_frame` returns, (h, w, 3) or (h, w) each."""
    with posed_as(deformer, vertices):
        found = frame_gradient(
            deformer,
            options.view,
            slopes[0],
            alpha_gradient=slopes[1],
            depth_gradient=slopes[2],
            by_vertices=True,
            by_camera=options.change is not None,
            background=options.background,
            step=options.step,
        )
    assert found.vertices is not None
    if options.change is None or found.camera is None:
        return found.vertices, None
    return found.vertices, camera_number_gradient(options.change, found.camera)


def require_camera_numbers(shape: Sequence[int]) -> None:
    """Refuse arrays of another shape than `turned_camera` takes."""
    if tuple(shape) != (7,):
        raise InputError(f"camera_change must be (7,), got {tuple(shape)}")


def turned_camera(camera: Camera, numbers: np.ndarray) -> Camera:
    """A camera changed by seven numbers: turns about its axes, radians; shifts along them; log of its focal length."""
    from scipy.spatial.transform import Rotation

    if not np.isfinite(numbers).all():
        raise InputError(f"camera_change must be finite, got {np.asarray(numbers).tolist()}")
    pose, factor = camera.camera_to_world.copy(), float(np.exp(numbers[6]))
    pose[:3, 3] += pose[:3, :3] @ numbers[3:6]
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(numbers[:3]).as_matrix()
    return dataclasses.replace(camera, camera_to_world=pose, fx=camera.fx * factor, fy=camera.fy * factor)


def camera_number_gradient(numbers: np.ndarray, by_turned: np.ndarray) -> np.ndarray:
    """The gradient (7,) by the numbers of `turned_camera`, from that by the numbers of the camera that it returns."""
    from scipy.spatial.transform import Rotation

    # R exp(n + dn) = R exp(n) exp(J dn) with the right Jacobian J of rotations (Sola et al. 2018, eq. 143)
    turn, rotation = numbers[:3], Rotation.from_rotvec(numbers[:3]).as_matrix()
    angle, cross = float(np.linalg.norm(turn)), np.cross(turn, np.eye(3)).T  # cross @ v = turn x v
    jacobian = np.eye(3) - 0.5 * cross
    if angle > 1e-4:
        first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
        jacobian = np.eye(3) - first * cross + second * cross @ cross
    return np.concatenate([jacobian.T @ by_turned[:3], rotation @ by_turned[3:6], by_turned[6:]])
