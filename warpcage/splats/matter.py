"""The matter of splats: densities on a grid, splats in its nodes, and where a ray meets them."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import empty_array
from ..core.checks import checked_bounds, checked_whole
from ..core.devices import launch
from ..core.memory import require_memory
from ..errors import InputError
from ..view.camera import Camera
from ..view.frame import Frame
from .io.contents import MIN_OPACITY

if TYPE_CHECKING:
    from .splat_field import SplatField

#: Standard deviations from its centre, along its axes, at which a splat is looked at beside its centre.
PROBE = 1.0

#: Share of those places that must be in chosen nodes, where the centre itself is not.
MAX_OF_IT = 0.5

#: Standard deviations to which a ray meets a splat, and to which it is taken to reach.
REACH = 3.0

#: The share of the light at which a ray's end is, and the opacity at which a splat counts as whole.
HALF, OPAQUE = 0.5, 0.999

#: Sides of nodes below this share of the median size of splats show their gaps.
FINEST_SHARE = 0.5


def in_nodes(centers: np.ndarray, factors: np.ndarray, mask: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Which splats have their centre, or most of what lies around it, in nodes of a mask (nx, ny, nz) bool; (n,) bool.
    centers (n, 3); factors (n, 3, 3): axes times standard deviations, a column each; bounds (2, 3) of the mask."""
    size = (bounds[1] - bounds[0]) / mask.shape
    middle = centers.astype(np.float64) - bounds[0]

    def inside(places: np.ndarray) -> np.ndarray:
        cells = np.floor(places / size)
        within = ((cells >= 0) & (cells < mask.shape)).all(axis=1)
        found = np.zeros(len(places), bool)
        found[within] = mask[tuple(cells[within].astype(np.int64).T)]
        return found

    centre = inside(middle)
    hits = centre.astype(np.int64)
    for axis in range(3):
        step = PROBE * factors[:, :, axis]
        hits += inside(middle + step).astype(np.int64) + inside(middle - step)
    return centre | (hits > 7 * MAX_OF_IT)


def half_light(
    centers: np.ndarray,
    covariances: np.ndarray,
    opacities: np.ndarray,
    origin: np.ndarray,
    direction: np.ndarray,
    spread: float,
    near: float,
) -> float:
    """Distance along a ray, unit direction (3,), at which half of its light is gone; infinite where it is not.
    spread: width of its pixel at distance 1; near: splats less than this ahead are not drawn."""
    from .render import IMAGE_BLUR  # here, as its kernels are loaded where splats are drawn

    offset = centers.astype(np.float64) - origin
    ahead = offset @ direction
    beside = np.linalg.norm(offset - ahead[:, None] * direction, axis=1)
    reach = REACH * (np.sqrt(np.einsum("nii->n", covariances)) + spread * np.abs(ahead))
    rows = np.flatnonzero((opacities >= MIN_OPACITY) & (ahead > near) & (beside <= reach))
    blur = IMAGE_BLUR * (spread * ahead[rows]) ** 2
    least = 1e-12 * np.einsum("nii->n", covariances[rows])  # a flat splat has an inverse too
    wide = covariances[rows] + (blur + least)[:, None, None] * np.eye(3)
    turned = np.linalg.solve(wide, np.broadcast_to(direction[:, None], (len(rows), 3, 1)))[..., 0]
    across = turned @ direction
    distance = np.einsum("ni,ni->n", turned, offset[rows]) / across
    rest = offset[rows] - distance[:, None] * direction
    far = np.einsum("ni,ni->n", rest, np.linalg.solve(wide, rest[..., None])[..., 0])
    alpha = np.minimum(OPAQUE, opacities[rows] * np.exp(-0.5 * far))
    drawn = np.flatnonzero((alpha >= MIN_OPACITY) & (distance > 0.0))
    order = drawn[np.argsort(distance[drawn], kind="stable")]
    gone = np.flatnonzero(np.cumprod(1.0 - alpha[order]) <= HALF)
    return float(distance[order[gone[0]]]) if len(gone) else np.inf


def finest_side(log_scales: np.ndarray) -> float:
    """The smallest side of a node at which splats, log_scales (n, 3), hang together, world units; 0 without splats."""
    if not len(log_scales):
        return 0.0
    return FINEST_SHARE * float(np.exp(np.median(log_scales.astype(np.float64).max(axis=1))))


def whole_voxels(box: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """A box (2, 3) made larger about its middle to whole cubes, two or more along each axis, and (3,) the side of a
    cube. resolution: cubes along the longest side of the box."""
    side = float((box[1] - box[0]).max()) / resolution
    shape = np.maximum(np.ceil((box[1] - box[0]) / side - 1e-6), 2.0)
    middle = box.mean(axis=0)
    return np.stack([middle - 0.5 * side * shape, middle + 0.5 * side * shape]), np.full(3, side)


#: Nodes along the longest side of a grid by default, and at most.
RESOLUTION, MAX_RESOLUTION = 128, 1024

#: What messages call a node of a grid of splats.
SPLAT_NODE = "cell"


class SplatDensity:
    """Densities of splats at the nodes of a grid: what `Cage.from_field`, `select_nodes` and `extract_mesh` read.
    resolution: nodes along the longest side, 2 to 1024; bounds: (2, 3) box, world units, None is that of all splats."""

    # Node (i, j, k): bounds[0] + (i + 0.5) * voxel_size. Covariance and opacity count (kernels/splats/fit.py).

    node_name = SPLAT_NODE

    def __init__(self, field: SplatField, resolution: int = RESOLUTION, bounds: ArrayLike | None = None):
        from ..kernels.splats.fit import deposit_splats

        self.field, self.straightening = field, None  # the coordinates are those of the file
        box = field.bounds if bounds is None else checked_bounds(bounds)
        # (2, 3) and (3,) float64, world units; the box is a whole number of voxels
        self.bounds, self.voxel_size = whole_voxels(box, checked_whole(resolution, "resolution", 2, MAX_RESOLUTION))
        side = float(self.voxel_size[0])
        shape = np.round((self.bounds[1] - self.bounds[0]) / side).astype(int)
        nodes = int(np.prod(shape, dtype=np.int64))
        require_memory(8 * nodes, field.device, f"{' x '.join(map(str, shape))} nodes need {{size}}: take fewer")
        density = empty_array(tuple(int(n) for n in shape), wp.float32, field.device)
        density.zero_()
        lower = wp.vec3(*(self.bounds[0] + 0.5 * side - field.center))
        inputs = [field.splats, lower, side, MIN_OPACITY]
        launch(deposit_splats, field.splat_count, inputs, [density], device=field.device, threads=1, work=1000)
        self._density = density.numpy()

    @property
    def up(self) -> np.ndarray:
        """(3,) what is up in the world."""
        return self.field.up

    def node_densities(self) -> np.ndarray:
        """(nx, ny, nz) float32 densities, per world unit."""
        return self._density

    def sample(self, points: ArrayLike, directions: ArrayLike | None = None) -> tuple[None, np.ndarray]:
        """None for colours, and densities (n,) float64, per world unit, at points (n, 3), between the nodes."""
        from scipy.ndimage import map_coordinates

        places = (np.asarray(points, np.float64) - self.bounds[0]) / self.voxel_size - 0.5
        return None, map_coordinates(self._density, places.T, order=1, mode="nearest", output=np.float64)

    @property
    def device(self) -> wp.Device:
        """Where the splats are."""
        return self.field.device

    def render(self, camera: Camera, **options: Any) -> Frame:
        """The view of the splats, as `SplatField.render`."""
        return self.field.render(camera, **options)

    def splats_in(self, mask: np.ndarray) -> np.ndarray:
        """Which splats have their centre, or most of their matter, in nodes of a mask (nx, ny, nz) bool, (n,) bool.
        Those that cannot be seen are left out."""
        whole = self.field
        inside = in_nodes(whole.contents.centers, whole.rotations * whole.scales[:, None, :], mask, self.bounds)
        return inside & (whole.opacities >= MIN_OPACITY)

    def cut_out(self, mask: np.ndarray) -> SplatField:
        """A field of the splats of a mask of nodes alone."""
        rows = self.splats_in(mask)
        if not rows.any():
            raise InputError("nothing is chosen that could be cut out: no splat lies in the chosen cells")
        return self.field.chosen(rows)

    def painted(self, mask: np.ndarray) -> SplatField:
        """The same splats, white in a mask of nodes and black elsewhere."""
        return self.field.painted(self.splats_in(mask))

    @property
    def digest(self) -> str:
        """32 hexadecimal digits that identify the splats, on any device."""
        held = self.field.contents
        parts = [np.ascontiguousarray(each, np.float32).tobytes() for each in (held.centers, held.logits)]
        return hashlib.blake2b(b"".join(parts), digest_size=16).hexdigest()
