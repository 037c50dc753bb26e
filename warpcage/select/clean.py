"""Fields without detached parts, and without what no view shows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..core.checks import checked_number, checked_positive, checked_whole
from ..core.devices import launch
from ..core.names import counted
from ..core.threads import device_turn
from ..errors import InputError
from ..field.render import STOP_TRANSMITTANCE
from ..field.sparse import harmonics_on_host, stored_harmonics
from ..field.voxel_field import VoxelField
from ..kernels.field.march import record_weights
from ..kernels.view.rays import PinholeCamera
from ..view.camera import Camera, camera_struct
from .selection import _parts, visible_mask

#: Connected parts with fewer nodes than this share of the largest are floaters, where they are farther than so many
#: nodes from what is kept: what is nearer may be a thin piece of it.
FLOATERS, GAP = 0.002, 3

#: Views that must show what is kept, and the rendering weight from which one does.
MIN_VIEWS, MIN_WEIGHT = 1, 0.01

#: Pixels along the longer side of the views that are asked what they show, at most.
VIEW_PIXELS = 800

#: Steps that a ray takes, for launches on the CPU.
RAY_WORK = 2000


@dataclasses.dataclass(frozen=True, eq=False)
class Cleaned:
    """What is left of a field."""

    field: Any  # what is left
    gone: np.ndarray  # bool, what was removed: (n,) of the splats, (nx, ny, nz) of the voxels
    notes: tuple[str, ...]  # a line for each kind of what was removed


@dataclasses.dataclass(frozen=True)
class CleanOptions:
    """What is removed from a field."""

    floaters: float = FLOATERS  # parts of fewer nodes than this share of the largest; 0 for none
    parts: int | None = None  # so many parts are kept, the largest; None for all
    cameras: Sequence[Camera] | None = None  # of the views that must show what is kept; None does not ask
    least_views: int = MIN_VIEWS  # so many of them must
    least_weight: float = MIN_WEIGHT  # rendering weight from which a view shows a splat (in pixels) or a voxel

    def __post_init__(self) -> None:
        if not 0.0 <= checked_number(self.floaters, "floaters") < 1.0:
            raise InputError(f"floaters must be a share of the largest part, 0 to below 1, got {self.floaters:g}")
        if self.parts is not None:
            checked_whole(self.parts, "parts", 1)
        checked_positive(self.least_weight, "least_weight")
        checked_whole(self.least_views, "least_views", 1)
        if self.cameras is not None and self.least_views > len(self.cameras):
            views = counted(len(self.cameras), "view")
            raise InputError(f"least_views must be at most the number of views, got {self.least_views} of {views}")


def clean_voxels(field: VoxelField, options: CleanOptions) -> Cleaned:
    """A field of voxels cleaned by the options; refused where no visible voxel would be left."""
    from scipy.ndimage import binary_dilation

    cube, links = np.ones((3, 3, 3), bool), field.host_links()
    seen, linked = visible_mask(field), links >= 0
    loose, count = detached_nodes(seen, options)
    # with what fades around them, but not what fades around what stays
    fringe = np.asarray(binary_dilation(loose, cube, 2), bool) & ~np.asarray(binary_dilation(seen & ~loose, cube), bool)
    gone = (loose | fringe) & linked
    notes = (
        [went(int(gone.sum()), int(linked.sum()), "voxel", f"in {counted(count, 'detached part')}")] if count else []
    )
    if options.cameras is not None:
        views = np.zeros(field.voxel_count, np.int64)
        for camera in small_cameras(options.cameras):
            views += voxel_weights(field, camera) >= options.least_weight
        shown = np.zeros_like(linked)
        shown[linked] = views[links[linked]] >= options.least_views
        hidden = linked & ~np.asarray(binary_dilation(shown, cube), bool) & ~gone  # samples lie between nodes
        if hidden.any():
            notes.append(went(int(hidden.sum()), int(linked.sum()), "voxel", unshown(options)))
        gone = gone | hidden
    require_left(seen & ~gone)
    return Cleaned(without_voxels(field, gone), gone, tuple(notes))


def require_left(left: np.ndarray) -> None:
    """Refuse to clean everything away; left: bool, what can be seen and stays."""
    if not left.any():
        raise InputError("nothing would be left: all that can be seen would go, ask for less")


def went(count: int, whole: int, node: str, where: str) -> str:
    """A line on what was removed; node: what one is called."""
    return f"removed {counted(count, node)} ({100 * count / max(whole, 1):.2g} %) {where}"


def unshown(options: CleanOptions) -> str:
    """A description of those that too few views show."""
    views = counted(len(options.cameras or ()), "view")
    return f"that {'none' if options.least_views == 1 else f'fewer than {options.least_views}'} of {views} show"


def detached_nodes(mask: np.ndarray, options: CleanOptions) -> tuple[np.ndarray, int]:
    """The nodes of small connected parts of a mask (nx, ny, nz) bool away from the others, and how many such parts."""
    from scipy.ndimage import binary_dilation

    labels, sizes, order = _parts(mask)
    if not len(order):
        return mask, 0
    large = order[sizes[order] >= options.floaters * sizes[order[0]]]
    near = np.isin(labels, large)
    if options.parts is None:  # what is near belongs to it
        cube = np.ones((3, 3, 3), bool)
        large = np.union1d(large, labels[np.asarray(binary_dilation(near, cube, GAP)) & mask])
    else:
        large = large[: options.parts]
    return mask & ~np.isin(labels, large), len(order) - len(large)


def small_cameras(cameras: Sequence[Camera]) -> list[Camera]:
    """Cameras of pictures of VIEW_PIXELS at most."""
    sizes = [(camera.width, camera.height) for camera in cameras]
    shares = [min(1.0, VIEW_PIXELS / max(size)) for size in sizes]
    return [
        camera.resized(*(max(1, round(share * side)) for side in size)) if share < 1.0 else camera
        for camera, size, share in zip(cameras, sizes, shares, strict=True)
    ]


def voxel_weights(field: VoxelField, camera: Camera) -> np.ndarray:
    """(rows,) float32, the largest rendering weight that a ray of a view gives to each voxel."""
    weights = wp.zeros(field.voxel_count, dtype=wp.float32, device=field.device)
    with device_turn(field.device):
        cameras = wp.array([camera_struct(camera, field.center)], dtype=PinholeCamera, device=field.device)
        inputs = [cameras, 1, None, field.linked_grid(), field.step, STOP_TRANSMITTANCE]
        count = camera.width * camera.height
        launch(record_weights, count, inputs, [weights, None], device=field.device, threads=1, work=RAY_WORK)
        return weights.numpy()


def without_voxels(field: VoxelField, gone: np.ndarray) -> VoxelField:
    """A field without the voxels of a mask (nx, ny, nz) bool, in the same box."""
    links = field.host_links()
    kept = (links >= 0) & ~gone
    rows, new = links[kept], np.full(links.shape, -1, np.int32)
    new[kept] = np.arange(len(rows), dtype=np.int32)
    weights = None if field.weights is None else field.weights.numpy()[rows]
    values = field.stored.density.numpy()[rows], harmonics_on_host(stored_harmonics(field.stored))[rows]
    return VoxelField(field.bounds, new, *values, weights=weights, device=field.device, **field.view_options())
