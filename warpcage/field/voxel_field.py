"""The voxel radiance field."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.arrays import as_host_points, as_points, is_device_array
from ..core.checks import checked_bounds, require_type
from ..core.devices import launch, resolve_device
from ..kernels.field.grid import VoxelGrid, sample_field
from ..kernels.field.harmonics import vec9
from ..kernels.field.render import render_image
from ..view.camera import Camera
from ..view.frame import (
    Frame,
    average_frame,
    camera_struct,
    checked_supersampling,
    finer_camera,
    parse_background,
    tile_threads,
)
from .background import LayeredBackground
from .files.contents import FieldContents
from .files.files import load_field, save_field
from .sparse import BASIS_COUNT, link_mask, measure_skip
from .surface import extract_mesh

#: A march ends where less than this share of the light is left.
STOP_TRANSMITTANCE = 1e-3


class VoxelField:
    """A sparse voxel grid with trilinear density and degree-2 spherical harmonics (Plenoxels, CVPR 2022).

    density(x) = max(0, trilinear sigma), colour(x, d) = max(0, trilinear SH . Y(d) + 0.5), d from the camera into the
    scene. Values lie at voxel centres.

    bounds: (2, 3) lower and upper corner in world units.
    links: (nx, ny, nz) int32, row of each voxel or -1.
    density: (rows,) float32 per world unit, before the ReLU.
    sh: (rows, 9, 3) float32, coefficients of each basis function in rgb (or a Warp array (rows, 3) of vec9).
    background: colour behind everything, a name or (3,).
    background_model: LayeredBackground or None, what lies around the box instead of that colour.
    weights: (rows,) float32 or None, the largest rendering weight that a training ray gave each voxel.
    up: (3,) what is up in the world, for views of it; of any length but zero.
    supersampling: rays a side of a pixel in renders: 2 for fields that were fitted with four rays a pixel.
    device: Warp device; None is CUDA where there is one.

    Raises ValueError for shapes that do not fit together or values that are not finite.

    References: Fridovich-Keil and Yu et al. 2022, section 3. Limitations: one SH degree (lower ones are padded with
    zeros).
    """

    def __init__(
        self,
        bounds,
        links,
        density,
        sh,
        *,
        background="white",
        background_model=None,
        weights=None,
        up=(0.0, 0.0, 1.0),
        supersampling=1,
        device=None,
    ):
        self.device = resolve_device(device if device is not None or not isinstance(links, wp.array) else links.device)
        self.bounds = checked_bounds(bounds)
        self.background = parse_background(background)
        self.background_model = None if background_model is None else background_model.to(self.device)
        self.up = _checked_up(up)
        self.supersampling = checked_supersampling(supersampling)
        if len(links.shape) != 3 or min(links.shape) < 2:
            raise ValueError(f"links must be (nx, ny, nz) of at least 2 voxels a side, got {tuple(links.shape)}")
        self.resolution = tuple(int(n) for n in links.shape)
        self.voxel_size = (self.bounds[1] - self.bounds[0]) / self.resolution

        links = _on_device(links, wp.int32, self.device)
        density = _on_device(density, wp.float32, self.device)
        sh = _sh_on_device(sh, self.device)
        if density.ndim != 1 or sh.shape[0] != density.shape[0]:
            raise ValueError(f"density and sh must have one row a voxel, got {density.shape} and {sh.shape[0]} rows")
        self.weights = None if weights is None else _on_device(weights, wp.float32, self.device)
        if self.weights is not None and self.weights.shape != density.shape:
            raise ValueError(f"weights must be one a row ({density.shape[0]}), got {self.weights.shape}")

        half = 0.5 * (self.bounds[1] - self.bounds[0])
        grid = VoxelGrid()
        grid.lower = wp.vec3(*(0.5 * self.voxel_size - half))
        grid.voxel_size = wp.vec3(*self.voxel_size)
        grid.inverse_voxel_size = wp.vec3(*(1.0 / self.voxel_size))
        grid.links, grid.density, grid.sh = links, density, sh
        grid.skip = measure_skip(links)
        self.grid = grid  #: what kernels take; positions in it are relative to `center`

    @classmethod
    def from_dense(cls, density, sh, bounds, *, background="white", device=None) -> VoxelField:
        """A field from dense arrays: density (nx, ny, nz), sh (nx, ny, nz, 9, 3). Voxels with density > 0 get rows,
        and so do their 26 neighbours, which the interpolation reaches."""
        density = np.asarray(density, np.float32)
        sh = np.asarray(sh, np.float32)
        if density.ndim != 3 or sh.shape != (*density.shape, BASIS_COUNT, 3):
            raise ValueError(f"density must be (nx, ny, nz) and sh (nx, ny, nz, 9, 3), got {density.shape}, {sh.shape}")
        if not (np.isfinite(density).all() and np.isfinite(sh).all()):
            raise ValueError("density and sh must be finite")
        padded = np.pad(density > 0, 1)
        mask = np.zeros(density.shape, dtype=bool)
        for i, j, k in np.ndindex(3, 3, 3):
            mask |= padded[i : i + mask.shape[0], j : j + mask.shape[1], k : k + mask.shape[2]]
        links = np.full(density.shape, -1, np.int32)
        links[mask] = np.arange(mask.sum(), dtype=np.int32)
        return cls(bounds, links, density[mask], sh[mask], background=background, device=device)

    @property
    def center(self) -> np.ndarray:
        """(3,) float64 middle of the bounds: the origin that kernels' positions are relative to."""
        return self.bounds.mean(axis=0)

    @property
    def voxel_count(self) -> int:
        """Voxels that hold values."""
        return self.grid.density.shape[0]

    @property
    def step(self) -> float:
        """Default march step in world units: half the smallest side of a voxel."""
        return 0.5 * float(self.voxel_size.min())

    def __repr__(self) -> str:
        size = "x".join(str(n) for n in self.resolution)
        bounds = np.round(self.bounds, 4).tolist()
        return f"VoxelField({size}, {self.voxel_count} voxels, bounds {bounds}, {self.device})"

    def __reduce__(self):
        raise TypeError(
            "a VoxelField is held on a device and not copied between processes: save it, and load the file "
            "in each of them"
        )

    def sample(self, points, directions):
        """Colour (n, 3) and density (n,) at world points (n, 3) seen along directions (n, 3) of any length but zero.

        NumPy in, NumPy out (float32); Warp or DLPack arrays in, Warp arrays on their device out. Zero density outside
        the bounds. Raises ValueError for shapes that differ or are not (n, 3).
        """
        origin = self.center
        if not is_device_array(points):
            points = as_host_points(points) - origin
            origin = np.zeros(3)
        x, keep = as_points(points, self.device)
        d, _ = as_points(directions, self.device, name="directions")
        if x.shape != d.shape:
            raise ValueError(f"points and directions must be as many, got {x.shape[0]} and {d.shape[0]}")
        rgb = wp.empty(x.shape[0], dtype=wp.vec3, device=self.device)
        density = wp.empty(x.shape[0], dtype=wp.float32, device=self.device)
        launch(sample_field, x.shape[0], [self.grid, wp.vec3(*origin), x, d], [rgb, density], device=self.device)
        return (rgb, density) if keep else (rgb.numpy(), density.numpy())

    def render(self, camera, *, background=None, step: float | None = None, supersampling: int | None = None):
        """The view of a camera as a Frame.

        background: colour name or (3,) to put behind the field; None takes the field's own, its background model where
        it has one. step: march step in world units; None takes `.step`. supersampling: rays a side of a pixel; None
        takes the field's. Opacity, depth and disparity are those of the field itself, whatever is behind it.
        Raises ValueError for a step that is not positive, or supersampling out of range.
        """
        require_type(camera, Camera, "render needs")
        colour, model = self.chosen_background(background)
        step = self.step if step is None else float(step)
        if not step > 0:
            raise ValueError(f"the march step must be positive, got {step}")
        side = checked_supersampling(self.supersampling if supersampling is None else supersampling)
        if side > 1:
            parts = self.render(finer_camera(camera, side), background=background, step=step, supersampling=1)
            return average_frame(parts, side)
        count = camera.width * camera.height
        rgb = wp.empty(count, dtype=wp.vec3, device=self.device)
        alpha = wp.empty(count, dtype=wp.float32, device=self.device)
        depth = wp.empty(count, dtype=wp.float32, device=self.device)
        inputs = [self.grid, camera_struct(camera, self.center), wp.vec3(*map(float, colour)), step, STOP_TRANSMITTANCE]
        launch(render_image, tile_threads(camera), inputs, [rgb, alpha, depth], device=self.device)
        if model is not None:
            model.add_behind(camera, rgb, alpha)
        return Frame(camera.width, camera.height, rgb, alpha, depth)

    def chosen_background(self, background=None):
        """What goes behind a view: (3,) the colour to render it on, and the LayeredBackground that is then added, or
        None. background: colour name or (3,), or None for the field's own."""
        if background is not None:
            return parse_background(background), None
        if self.background_model is None:
            return self.background, None
        return np.zeros(3, np.float32), self.background_model

    def extract_mesh(self, *, threshold: float | None = None, components: str = "largest"):
        """The surface as a trimesh.Trimesh in world units; see `warpcage.field.voxel_field.surface.extract_mesh`."""
        return extract_mesh(self, threshold=threshold, components=components)

    def node_densities(self) -> np.ndarray:
        """(nx, ny, nz) float32 density at the voxel centres, zero where there is none or it is negative."""
        return np.maximum(self._dense(self.grid.density), 0.0)

    def node_weights(self) -> np.ndarray | None:
        """(nx, ny, nz) float32, the largest rendering weight of each voxel, or None where none was recorded."""
        return None if self.weights is None else self._dense(self.weights)

    def _dense(self, rows: wp.array) -> np.ndarray:
        links = self.grid.links.numpy()
        return (
            np.where(links >= 0, rows.numpy()[np.maximum(links, 0)], np.float32(0))
            if rows.size
            else np.zeros(links.shape, np.float32)
        )

    def save(self, path, *, format: str = "warpcage") -> None:
        """Write the field, whole or not at all. format: "warpcage" (.npz), "compact" (quantised to a third of
        that) or "svox2" (a Plenoxels checkpoint, .npz)."""
        save_field(self._contents(), path, format=format)

    @classmethod
    def load(cls, path, *, scene_scale: float = 1.0, device=None) -> VoxelField:
        """Read our own .npz or a Plenoxels (svox2) checkpoint. scene_scale: the factor that its scene's positions were
        multiplied by, which bounds are divided by: 2/3 for svox2's NeRF-synthetic scenes, so that they fit the cameras
        of `load_scene`. See `warpcage.field.voxel_field.files.files.load_field`."""
        held = load_field(path, scene_scale=scene_scale)
        try:
            layers = None if held.layers is None else LayeredBackground(**held.layers, device=device)
            return cls(
                held.bounds, held.links, held.density, held.sh, background_model=layers, device=device, **held.options()
            )
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def _contents(self) -> FieldContents:
        """The field's parts on the host, for a file."""
        return FieldContents(
            bounds=self.bounds,
            links=self.grid.links.numpy(),
            density=self.grid.density.numpy(),
            sh=self.grid.sh.numpy().transpose(0, 2, 1),
            weights=None if self.weights is None else self.weights.numpy(),
            background=self.background,
            up=self.up,
            supersampling=self.supersampling,
            layers=None if self.background_model is None else self.background_model.arguments(),
        )

    def to(self, device) -> VoxelField:
        """The same field on another device."""
        device = resolve_device(device)
        if device == self.device:
            return self
        grid = self.grid
        return VoxelField(
            self.bounds, grid.links, grid.density, grid.sh, weights=self.weights, device=device, **self.view_options()
        )

    def view_options(self) -> dict:
        """What views of the field depend on besides its voxels, by the constructor's names: a field that is made from
        this one takes it over."""
        return {
            "background": self.background,
            "background_model": self.background_model,
            "up": self.up,
            "supersampling": self.supersampling,
        }


def field_from_mask(bounds, mask: wp.array, density: float, *, background, device) -> tuple[VoxelField, wp.array]:
    """A grey field of one density at the set nodes of a mask (nx, ny, nz) uint8, and its nodes (rows,) vec3i."""
    links, nodes = link_mask(mask)
    rows = nodes.shape[0]
    field = VoxelField(
        bounds,
        links,
        wp.full(rows, density, dtype=wp.float32, device=device),
        wp.zeros((rows, 3), dtype=vec9, device=device),
        background=background,
        device=device,
    )
    return field, nodes


def _checked_up(up) -> np.ndarray:
    up = np.array(up, dtype=np.float64)
    if up.shape != (3,) or not np.isfinite(up).all() or not np.linalg.norm(up) > 0:
        raise ValueError(f"up must be a finite direction (3,), got {up.tolist()}")
    up /= np.linalg.norm(up)
    return up


def _on_device(array, dtype, device) -> wp.array:
    if isinstance(array, wp.array):
        return array if array.device == device else array.to(device)
    host = np.ascontiguousarray(array, dtype=np.int32 if dtype == wp.int32 else np.float32)
    return wp.array(host, dtype=dtype, device=device)


def _sh_on_device(sh, device) -> wp.array:
    """(rows, 3) of vec9 from that on a device, or from NumPy (rows, 9, 3)."""
    if isinstance(sh, wp.array):
        return sh if sh.device == device else sh.to(device)
    host = np.asarray(sh, np.float32)
    if host.ndim != 3 or host.shape[1:] != (BASIS_COUNT, 3):
        raise ValueError(f"sh must be (rows, 9, 3), got {host.shape}")
    return wp.array(np.ascontiguousarray(host.transpose(0, 2, 1)), dtype=vec9, device=device)
