"""Points and cages as the coordinate functions take them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from ..core.arrays import PointsLike, as_host_points, as_points, empty_array, is_device_array
from ..core.devices import launch, resolve_device
from ..core.memory import require_memory
from ..core.names import agreed
from ..kernels.coordinates import local_points
from ..mesh.mesh import ClosedMesh
from ..mesh.queries import SURFACE_TOLERANCE, inside_mesh


@dataclass
class _Local:
    """Points in a local frame: a cage's has the middle of its bounding box at the origin and a longest side of one."""

    given: PointsLike  # as given by the caller, but host points are (n, 3) float64
    points: wp.array  # (n,) vec3 on device
    on_device: bool  # whether they were given as an array of a device
    single: bool  # whether they were given as float32
    bad: wp.array  # (1,) int, above 0 where a point is not finite, or FARTHEST away or more

    @property
    def device(self) -> wp.Device:
        return self.points.device  # pyright: ignore[reportReturnType]

    @property
    def count(self) -> int:
        return len(self.points)

    def given_back(self, array: wp.array) -> np.ndarray | wp.array:
        """A result in the form the points came in."""
        return array if self.on_device else array.numpy()

    def world(self, rows) -> np.ndarray:
        """World positions of some rows, for messages and checks on the host."""
        host = np.asarray(self.given.numpy() if isinstance(self.given, wp.array) else self.given, dtype=np.float64)
        return host.reshape(-1, 3)[rows]

    def place(self, row: int) -> str:
        """World position of a point, for messages."""
        return ", ".join(f"{value:.6g}" for value in self.world(row))


def _localise(
    points: PointsLike, centre: np.ndarray, size: float, device: wp.DeviceLike, *, check: bool = True
) -> _Local:
    """Points relative to a cage. check: refuse points of a device that are not finite at once, which waits for it."""
    if not is_device_array(points):
        host = as_host_points(points)
        single = isinstance(points, np.ndarray) and points.dtype == np.float32
        local = (host - centre) / size
        bad = not (np.abs(local) < local_points.FARTHEST).all()
        with np.errstate(over="ignore"):
            local = wp.array(local.astype(np.float32), dtype=wp.vec3, device=resolve_device(device))
        return _Local(host, local, False, single, wp.full(1, int(bad), dtype=int, device=local.device))

    world, _ = as_points(points, device)
    local = empty_array(len(world), wp.vec3, world.device)
    bad = wp.zeros(1, dtype=int, device=world.device)
    launch(
        local_points.localise_points,
        len(world),
        [world, wp.vec3d(*centre), wp.float64(size)],
        [local, bad],
        device=world.device,
    )
    result = _Local(world, local, True, True, bad)
    if check and int(bad.numpy()[0]):
        _require_finite(result)
    return result


def _require_finite(local: _Local) -> None:
    as_host_points(local.given)


def _require_near(local: _Local, cage: ClosedMesh) -> None:
    """Refuse points so far from the cage that their mean value weights have no digits."""
    if int(local.bad.numpy()[0]):
        away = np.abs(local.world(slice(None)) - cage.bounds.mean(axis=0)).max(axis=1) / cage.size
        lost = np.flatnonzero(away >= local_points.FARTHEST)
        raise ValueError(
            f"{len(lost)} of {local.count} points {agreed(len(lost), 'is', 'are')} "
            f"{local_points.FARTHEST:.0f} times the cage's size "
            f"away or more, the first is point {lost[0]} at ({local.place(lost[0])}): leave them out"
        )


def _restore(moved: wp.array, local: _Local, centre: np.ndarray, size: float):
    """Local results in world units, in the form the points came in."""
    if local.on_device:
        world = wp.empty_like(moved)
        launch(
            local_points.restore_points,
            local.count,
            [moved, wp.vec3d(*centre), wp.float64(size)],
            [world],
            device=local.device,
        )
        return world
    world = moved.numpy().astype(np.float64).reshape(-1, 3) * size + centre
    return world.astype(np.float32) if local.single else world


def _cage_arrays(cage: ClosedMesh, local: _Local) -> tuple[wp.array, wp.array]:
    vertices = ((cage.vertices - cage.bounds.mean(axis=0)) / cage.size).astype(np.float32)
    return (
        wp.array(vertices, dtype=wp.vec3, device=local.device),
        wp.array(cage.faces, dtype=wp.vec3i, device=local.device),
    )


def _outside_points(local: _Local, cage: ClosedMesh) -> np.ndarray:
    """Rows of the points farther outside than 1e-5 of the size."""
    if not local.count:
        return np.zeros(0, dtype=np.int64)
    inside = inside_mesh(local.given, cage, device=local.device)
    return np.flatnonzero(~(inside.numpy() if isinstance(inside, wp.array) else np.asarray(inside)).astype(bool))


def _require_room(local: _Local, columns: int) -> None:
    """Refuse weights that the device has not the memory for; NumPy results are held on the host as well."""
    size = 4 * local.count * columns
    message = f"weights of {local.count} points, {columns} each, need {{size}}: take fewer points at a time"
    require_memory(size, local.device, message + ", or deform_points, which keeps none")
    if not local.on_device and not local.device.is_cpu:
        require_memory(size, wp.get_device("cpu"), message)


def _require_inside(local: _Local, cage: ClosedMesh, kind: str) -> None:
    lost = _outside_points(local, cage)
    if len(lost):
        raise ValueError(_outside_message(local, lost, kind))


def _outside_message(local: _Local, lost: np.ndarray, kind: str) -> str:
    return (
        f"{len(lost)} of {local.count} points {agreed(len(lost), 'is', 'are')} outside the cage by more "
        f"than {SURFACE_TOLERANCE:g} of its size, "
        f"the first is point {lost[0]} at ({local.place(lost[0])}): {kind} coordinates are for points inside, "
        "mean_value for any"
    )


def _as_given(array, local: _Local):
    """`array` as Warp or NumPy, whichever the points were."""
    if local.on_device:
        return array if isinstance(array, wp.array) else wp.array(array, dtype=wp.float32, device=local.device)
    return array.numpy() if isinstance(array, wp.array) else array
