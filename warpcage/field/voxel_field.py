"""The voxel radiance field."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import as_given, as_host_points, as_points, empty_array, is_device_array, require_finite
from ..core.checks import (
    checked_bounds,
    checked_direction,
    checked_march,
    device_by_name,
    require_ordinary_side,
    require_type,
    warn_caller,
)
from ..core.devices import HeldOnDevice, launch, resolve_device
from ..core.reports import Progress, report_progress, reports_progress
from ..core.threads import device_turn, in_turn
from ..errors import InputError
from ..kernels.field.grid import VoxelGrid, sample_field
from ..package import WITHOUT_OLD_NAMES
from ..view.camera import Camera, camera_struct, rigid_motion
from ..view.camera_path import RefinedCameras
from ..view.frame import Frame, checked_supersampling, parse_background, view_background
from .io import load_field, save_field
from .io.field_file import BASIS_COUNT, FieldContents
from .render import FieldView, RenderKeywords, RenderOptions, RenderTarget, VoxelKeywords, render_options, takes_options
from .sparse import (
    checked_resolution,
    harmonics_on_device,
    harmonics_on_host,
    place_grid,
    store_harmonics,
    stored_harmonics,
    values_on_device,
    widen_harmonics,
)
from .surface import DensityField, color_vertices, extract_mesh
from .surroundings import LayeredBackground, OuterField
from .tables import MarchTables

if TYPE_CHECKING:
    import trimesh
    from typing_extensions import Unpack  # of the type checker


class VoxelField(HeldOnDevice):
    """A sparse voxel grid with trilinear density and spherical harmonics (Plenoxels, CVPR 2022).

    density(x) = max(0, trilinear sigma), colour(x, d) = max(0, trilinear SH . Y(d) + 0.5), d from the camera into the
    scene. Values lie at voxel centres. Harmonics are of degree 2 in red, green and blue (27 numbers, as in Plenoxels'
    files), or of degree 3 in luminance Y and degree 1 in two differences of colour, orange O and green G (24 numbers,
    what `fit` finds): red = Y + O - G / 2, green = Y + G, blue = Y - O - G / 2.

    References: Fridovich-Keil and Yu et al. 2022, section 3. Limitations: all voxels have the same degrees; lower ones
    are padded with zeros.

    Args:
        bounds: (2, 3) lower and upper corner, world units.
        links: (nx, ny, nz) int32, row of each voxel or -1. NumPy or a Warp array.
        density: (rows,) float32 per world unit, before the ReLU. NumPy or a Warp array.
        sh: (rows, 9, 3) float32, coefficients of each basis function in red, green and blue; or (rows, 24): 16 of
            luminance, 4 of orange, 4 of green; or the `grid.sh` of another field.
        background: Colour behind everything, a name or (3,) in [0, 1].
        background_model: What lies around the box instead of that colour. None is that colour.
        weights: (rows,) float32, the largest rendering weight that a training ray gave each voxel. None: not known.
        up: (3,) up direction of the world, of any length but zero.
        straightening: (4, 4) rigid, from the coordinates of the scene's files to those of the field, where the scene
            was straightened (`load_scene(orient="up")`). None is the same coordinates.
        supersampling: Rays along each side of a pixel in renders: 2 for fields that were fitted with four rays per
            pixel.
        device: Warp device. None is the device of `links` if that is a Warp array, else CUDA where there is one.

    Raises:
        ValueError: For shapes that do not fit together, values that are not finite, or bounds whose longest side is not
            1e-9 to 1e9 units.

    Attributes:
        device: Warp device of the arrays.
        bounds: (2, 3) float64, read-only, world units.
        background: (3,) float32 colour behind everything.
        background_model: LayeredBackground, OuterField or None.
        up: (3,) float64 unit vector.
        straightening: (4, 4) float64 from the coordinates of the scene's files, or None; its inverse leads back.
        supersampling: Rays along each side of a pixel in renders.
        resolution: (nx, ny, nz) number of voxels along each axis.
        voxel_size: (3,) float64, world units.
        weights: (rows,) float32 Warp array or None.
        refined_cameras: RefinedCameras of the fit's pictures, where it refined them; None otherwise. Files of fields
            hold them, but for those of svox2.
        stored: The VoxelGrid as frames read it: that of `grid`, where `links` and `skip` may be left out, and `sh` for
            `halves`.
        marching: Tables of it that ray marching reads.
    """

    _elsewhere = "save it, and load the file in each of them"

    def __init__(
        self,
        bounds: ArrayLike,
        links: np.ndarray | wp.array[Any, Any],
        density: np.ndarray | wp.array[Any, Any],
        sh: np.ndarray | wp.array[Any, Any],
        *,
        background: str | ArrayLike = "white",
        background_model: LayeredBackground | OuterField | None = None,
        weights: np.ndarray | wp.array[Any, Any] | None = None,
        up: ArrayLike = (0.0, 0.0, 1.0),
        straightening: ArrayLike | None = None,
        supersampling: int = 1,
        device: wp.DeviceLike = None,
    ):
        self.device = resolve_device(device if device is not None or not isinstance(links, wp.array) else links.device)
        self.bounds = checked_bounds(bounds)
        self._center, self._diagonal = self.bounds.mean(axis=0), math.dist(*self.bounds)
        require_ordinary_side(float((self.bounds[1] - self.bounds[0]).max()), "a field")
        self.background = parse_background(background)
        self.background_model = None if background_model is None else background_model.to(self.device)
        self.up = checked_direction(up, "up")
        self.straightening = None if straightening is None else rigid_motion(straightening, "straightening")
        self.supersampling = checked_supersampling(supersampling)
        self.refined_cameras: RefinedCameras | None = None
        self.resolution = checked_resolution(links)
        self.voxel_size = (self.bounds[1] - self.bounds[0]) / self.resolution

        with device_turn(self.device):
            self.stored = self._filled_grid(links, density, sh, weights)
            self.marching = MarchTables(self.stored)
            if self.device.is_cuda and not isinstance(links, wp.array):
                self.marching.drop_links()

    def _filled_grid(self, links: Any, density: Any, sh: Any, weights: Any) -> Any:
        """The VoxelGrid of the arrays that the constructor was given; their weights go to `weights`."""
        grid = VoxelGrid()
        grid.links = values_on_device(links, wp.int32, self.device)
        grid.density = values_on_device(density, wp.float32, self.device)
        harmonics = harmonics_on_device(sh, self.device)
        store_harmonics(grid, harmonics)
        if grid.density.ndim != 1 or harmonics.shape[0] != grid.density.shape[0]:
            raise InputError(
                f"density and sh must have one row per voxel, got {grid.density.shape} and {harmonics.shape[0]} rows"
            )
        self.weights = None if weights is None else values_on_device(weights, wp.float32, self.device)
        if self.weights is not None and self.weights.shape != grid.density.shape:
            raise InputError(f"weights must be one per row ({grid.density.shape[0]}), got {self.weights.shape}")

        place_grid(grid, self.bounds)
        return grid

    @property
    @in_turn
    def grid(self) -> Any:
        """The VoxelGrid that kernels take; positions in it are relative to `center`.

        Its arrays may be written to at any time, except the links. `skip` (nx-1, ny-1, nz-1) is the distance, in cells,
        of each cell from the nearest one whose nodes have rows: rays skip that many. On CUDA fields of files have
        neither until this is asked for, and harmonics as the file's half floats; from then on float32.
        """
        if self.stored.halves is not None:
            widen_harmonics(self.stored)
        return self.linked_grid()

    @in_turn
    def linked_grid(self) -> Any:
        """The VoxelGrid as frames read it, with its links and `skip`."""
        self.marching.restore_links()
        return self.stored

    @in_turn
    def host_links(self, step: int = 1) -> np.ndarray:
        """The row of each voxel, on the host.

        Args:
            step: How many voxels along each axis to take one of.

        Returns:
            (nx, ny, nz) int32 rows, -1 for voxels without one; fewer for a step of more than 1.
        """
        links: np.ndarray = self._links()[::step, ::step, ::step].numpy()
        return links

    def _links(self) -> wp.array:
        """(nx, ny, nz) int32 row of each voxel, or -1, on the device: a new array where frames do without."""
        links = self.stored.links
        return self.marching.columns.links() if links is None else links

    @classmethod
    def from_dense(
        cls,
        density: ArrayLike,
        sh: ArrayLike,
        bounds: ArrayLike,
        *,
        background: str | ArrayLike = "white",
        device: wp.DeviceLike = None,
    ) -> VoxelField:
        """A field from dense arrays.

        Voxels with density > 0 get rows, and so do their 26 neighbours, which the interpolation reaches.

        Args:
            density: (nx, ny, nz) float, per world unit.
            sh: (nx, ny, nz, 9, 3) float, coefficients of each basis function in red, green and blue.
            bounds: (2, 3) lower and upper corner, world units.
            background: Colour behind everything, a name or (3,) in [0, 1].
            device: Warp device. None is CUDA where there is one.

        Returns:
            The field.

        Raises:
            ValueError: For shapes that do not fit together, or values that are not finite.
        """
        sigma = np.asarray(density, np.float32)
        coefficients = np.asarray(sh, np.float32)
        if sigma.ndim != 3 or coefficients.shape != (*sigma.shape, BASIS_COUNT, 3):
            raise InputError(
                f"density must be (nx, ny, nz) and sh (nx, ny, nz, 9, 3), got {sigma.shape}, {coefficients.shape}"
            )
        if not (np.isfinite(sigma).all() and np.isfinite(coefficients).all()):
            raise InputError("density and sh must be finite")
        nx, ny, nz = sigma.shape
        padded = np.pad(sigma > 0, 1)
        mask = np.zeros(sigma.shape, dtype=bool)
        for i, j, k in np.ndindex(3, 3, 3):
            mask |= padded[i : i + nx, j : j + ny, k : k + nz]
        links = np.full(sigma.shape, -1, np.int32)
        links[mask] = np.arange(mask.sum(), dtype=np.int32)
        return cls(bounds, links, sigma[mask], coefficients[mask], background=background, device=device)

    @property
    def center(self) -> np.ndarray:
        """(3,) float64 middle of the bounds: the origin that kernels' positions are relative to."""
        return self._center.copy()

    @property
    def voxel_count(self) -> int:
        """Voxels that hold values."""
        return self.stored.density.shape[0]

    @functools.cached_property
    def step(self) -> float:
        """Default march step in world units: half the smallest side of a voxel."""
        return 0.5 * float(self.voxel_size.min())

    def __repr__(self) -> str:
        size = "x".join(str(n) for n in self.resolution)
        bounds = np.round(self.bounds, 4).tolist()
        return f"VoxelField({size}, {self.voxel_count} voxels, bounds {bounds}, {self.device})"

    @in_turn
    def sample(self, points: Any, directions: Any) -> tuple[Any, Any]:
        """Colour and density at points.

        Args:
            points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md). The density is zero outside
                the bounds.
            directions: (n, 3), from the camera into the scene, of any length but zero.

        Returns:
            Colours (n, 3) and densities (n,) per world unit, float32, as arrays of the points' kind on their device.

        Raises:
            ValueError: For shapes that differ or are not (n, 3), and for values that are not finite.
        """
        given, origin = points, self.center
        if not is_device_array(points):
            points = as_host_points(points) - origin
            origin = np.zeros(3)
        x = as_points(points, self.device)
        d = as_points(directions, self.device, name="directions")
        if x.shape != d.shape:
            raise InputError(f"there must be as many directions as points, got {d.shape[0]} for {x.shape[0]}")
        rgb = empty_array(x.shape[0], wp.vec3, self.device)
        density = empty_array(x.shape[0], wp.float32, self.device)
        inputs = [self.linked_grid(), wp.vec3(*origin), x, d]
        launch(sample_field, x.shape[0], inputs, [rgb, density], device=self.device)
        if is_device_array(points) or is_device_array(directions):
            require_finite(("points", x), ("directions", d))
        return as_given(rgb, given), as_given(density, given)

    @takes_options(VoxelKeywords)
    def render(self, camera: Camera, **options: Unpack[VoxelKeywords]) -> Frame:
        """The view of a camera.

        Args:
            camera: The camera.
            options: Options of the frame by keyword, see docs/python.md.

        Returns:
            The frame, its arrays on the field's device.

        Raises:
            ValueError: For a background that is not known, a step that is not positive and finite or is too short,
                a camera so far away that float32 has no steps there, or supersampling out of range.
        """
        return self._render(camera, render_options(options, VoxelKeywords))

    @in_turn
    def _render(self, camera: Camera, options: RenderOptions) -> Frame:
        """See `render`."""
        return self.marching.render(FieldView(self, camera, options))

    def march_step(self, step: float | None, camera: Camera) -> tuple[float, float]:
        """The step of a march from a camera.

        Args:
            step: The wanted step, world units. None is `.step`.
            camera: The camera.

        Returns:
            The step, world units, and how many of them there are along the diagonal of the box.

        Raises:
            ValueError: As `render`.
        """
        require_type(camera, Camera, "render needs")
        step = checked_march(step, self.step, self._diagonal, math.dist(camera.center, self._center))
        return step, self._diagonal / step

    @in_turn
    def render_by(
        self,
        begin: Callable[[], Callable[..., None]],
        camera: Camera,
        *,
        masks: tuple[str, ...] = (),
        into: dict[str, wp.array[Any, Any]] | None = None,
        **options: Unpack[RenderKeywords],
    ) -> Frame:
        """The view of a camera by another march through this field, before the field's own background; for one version.

        Args:
            begin: Called once the rest is checked. What it returns is called with the number of threads, the
                PinholeCamera, the colour behind the picture, and a function that makes the arrays to fill, by name.
            camera: The camera.
            masks: Names of the masks that the march fills beside colour, opacity and depth.
            into: Arrays (h * w,) to fill, by the names of the frame's parts and masks. None makes new ones.
            options: `background` and `supersampling`, as for `render`.

        Returns:
            The frame, its arrays on the field's device.

        Raises:
            ValueError: For a background that is not known, or supersampling out of range.
        """
        warn_caller(f"VoxelField.render_by goes with warpcage {WITHOUT_OLD_NAMES}: Deformer renders what is deformed")
        view = FieldView(self, camera, render_options(options, RenderKeywords), masks, RenderTarget(into))
        arrays: dict[str, wp.array] = {}

        def made_arrays() -> dict[str, wp.array]:
            arrays.update(view.new_arrays())
            return arrays

        color = wp.vec3(*map(float, view.color))
        begin()(view.threads, camera_struct(view.rays, self.center), color, made_arrays)
        return view.finished(arrays)

    def chosen_background(
        self, background: str | ArrayLike | None = None
    ) -> tuple[np.ndarray, LayeredBackground | OuterField | None]:
        """The background of a view.

        Args:
            background: Colour name or (3,). None is the field's own background.

        Returns:
            (3,) float32 colour to render on, and the background model to add to the view, or None.

        Raises:
            ValueError: For a background that is not known.
        """
        if background is not None:
            return view_background(background), None
        if self.background_model is None:
            return self.background, None
        return np.zeros(3, np.float32), self.background_model

    def extract_mesh(
        self,
        *,
        threshold: float | None = None,
        components: str = "largest",
        colors: bool = False,
        selection: DensityField | None = None,
    ) -> trimesh.Trimesh:
        """The surface where the density crosses a threshold, closed and looking outward.

        Args:
            threshold: Density, per world unit. None is `warpcage.field.surface.surface_density`.
            components: "largest" keeps the part of the largest volume, which drops floaters and cavities, "all" keeps
                everything.
            colors: Give its vertices the colours of the surface, as they are seen from straight ahead (sRGB).
            selection: A NodeSelection of this field, whose surface is taken. None is all of it.

        Returns:
            The mesh, world units.

        Raises:
            ValueError: For an empty field, a threshold that no density crosses, or another name of components.
        """
        mesh = extract_mesh(self if selection is None else selection, threshold=threshold, components=components)
        if colors:
            color_vertices(self, mesh)
        return mesh

    def node_densities(self) -> np.ndarray:
        """(nx, ny, nz) float32 density at the voxel centres, zero where there is none or it is negative."""
        return np.maximum(self._dense(self.stored.density), 0.0)

    def node_weights(self) -> np.ndarray | None:
        """(nx, ny, nz) float32, the largest rendering weight of each voxel, or None where none was recorded."""
        return None if self.weights is None else self._dense(self.weights)

    @in_turn
    def _dense(self, rows: wp.array) -> np.ndarray:
        """(nx, ny, nz) float32 values of the voxels, zero where there is no row."""
        links = self.host_links()
        if not rows.size:
            return np.zeros(links.shape, np.float32)
        return np.where(links >= 0, rows.numpy()[np.maximum(links, 0)], np.float32(0))

    def save(self, path: str | os.PathLike[str], *, format: str = "warpcage") -> None:
        """Write the field to a file, whole or not at all.

        Args:
            path: The file; it must end in .npz. As .nvdb (NanoVDB) and .vdb (OpenVDB, whose Python module is needed) it
                holds the grids "density" and "color" for other programs, without what depends on the direction.
            format: Of .npz: "warpcage"; "compact", quantised to a third of that; or "svox2", a Plenoxels checkpoint.
                Harmonics are half floats, in a compact file from -256 to 256: what is beyond is cut, with a warning.

        Raises:
            ValueError: For another format or ending.
        """
        save_field(self._contents(), path, format=format)

    @classmethod
    @reports_progress
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        scene_scale: float = 1.0,
        device: wp.DeviceLike = None,
        progress: bool | Progress = False,
    ) -> VoxelField:
        """Read our own .npz or a Plenoxels (svox2) checkpoint.

        Args:
            path: The file.
            scene_scale: Factor by which positions of the scene were multiplied before the fit, undone here: 2/3 for
                svox2's NeRF-synthetic scenes, so that they fit the cameras of `load_scene`.
            device: Warp device. None is CUDA where there is one.
            progress: True shows a bar on stderr. A function is called with (done, total, message) and cancels
                by returning False.

        Returns:
            The field.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: For a file of neither format, or whose parts do not fit.
            Cancelled: Where `progress` returned False.
        """
        report_progress(progress, 0, 2, "field: its file")
        held = load_field(path, scene_scale=scene_scale)
        report_progress(progress, 1, 2, "field: its tables")
        try:
            field = cls.from_contents(held, device=device)
        except ValueError as error:
            raise InputError(f"{path}: {error}") from error
        report_progress(progress, 2, 2, "field: its tables")
        return field

    @classmethod
    @device_by_name
    def from_contents(cls, contents: FieldContents, *, device: wp.DeviceLike = None) -> VoxelField:
        """A field of values as files have them.

        Args:
            contents: The values.
            device: Warp device. None is CUDA where there is one.

        Returns:
            The field.

        Raises:
            ValueError: For parts that do not fit.
        """
        model = None if contents.layers is None else LayeredBackground.from_contents(contents.layers, device)
        if contents.outer is not None:
            model = OuterField.from_contents(contents.outer, device)
        options = contents.options() | {"background_model": model, "device": device}
        field = cls(contents.bounds, contents.links, contents.density, contents.sh, **options)
        field.refined_cameras = contents.refined
        return field

    @in_turn
    def _contents(self) -> FieldContents:
        """The field's parts on the host, for a file."""
        model = self.background_model
        return FieldContents(
            bounds=self.bounds,
            links=self.host_links(),
            density=self.stored.density.numpy(),
            sh=harmonics_on_host(stored_harmonics(self.stored)),
            weights=None if self.weights is None else self.weights.numpy(),
            background=self.background,
            up=self.up,
            straightening=self.straightening,
            supersampling=self.supersampling,
            layers=model.contents() if isinstance(model, LayeredBackground) else None,
            outer=model.contents() if isinstance(model, OuterField) else None,
            refined=self.refined_cameras,
        )

    def to(self, device: wp.DeviceLike) -> VoxelField:
        """The same field on another device.

        Args:
            device: Warp device. None is CUDA where there is one.

        Returns:
            The field; this one if it is there already.
        """
        device = resolve_device(device)
        if device == self.device:
            return self
        grid, sh = self.stored, stored_harmonics(self.stored)
        moved = VoxelField(
            self.bounds, self._links(), grid.density, sh, weights=self.weights, device=device, **self.view_options()
        )
        moved.refined_cameras = self.refined_cameras
        return moved

    def view_options(self) -> dict[str, Any]:
        """The constructor's arguments that views depend on besides the voxels, for fields made from this one."""
        return {
            "background": self.background,
            "background_model": self.background_model,
            "up": self.up,
            "straightening": self.straightening,
            "supersampling": self.supersampling,
        }
