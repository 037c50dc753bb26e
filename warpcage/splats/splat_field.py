"""SplatField: Gaussian splats; fields of either kind from their files."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import as_host_array, empty_array
from ..core.checks import checked_bounds, checked_direction, checked_flag, checked_vector, real_array, renamed
from ..core.devices import HeldOnDevice, resolve_device
from ..core.files import PathLike, begins_as_archive, kind_seen, require_file
from ..core.names import counted
from ..core.reports import Progress, report_progress, reports_progress
from ..core.threads import in_turn
from ..errors import InputError
from ..field.io import load_field as load_voxels
from ..field.io.field_file import Y0, FieldContents
from ..field.render import NEW_TARGET, RenderOptions, RenderTarget, SplatKeywords, render_options, takes_options
from ..field.voxel_field import VoxelField
from ..kernels.splats.splats import Splats
from ..view.camera import Camera
from ..view.frame import Frame, parse_background
from .io import is_splat_file, own_background, read_splats, write_splats
from .io.contents import (
    MIN_OPACITY,
    PlyLayout,
    SplatContents,
    checked_contents,
    chosen_contents,
    contents_of_arrays,
    opacities_of,
    rotation_matrices,
)
from .io.formats import endings_read
from .matter import REACH, RESOLUTION, SPLAT_NODE, SplatDensity, finest_side, half_light, whole_voxels

if TYPE_CHECKING:
    from typing_extensions import Unpack  # of the type checker

    from .render import SplatRenderer


class SplatField(HeldOnDevice):
    """3D Gaussian splats: matter around centres, with spherical harmonics of degree 0 to 3.

    Opacity o exp(-1/2 (x - c)^T S^-1 (x - c)), S = R diag(s^2) R^T, colour max(0, 0.5 + SH . Y(d)), d from the camera
    into the scene. Values are held as files have them (logarithms of scales, logits of opacities, quaternions of any
    length), so that loading and saving a .ply keeps every bit, and properties that warpcage does not know.

    References: Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (SIGGRAPH 2023).

    Args:
        centers: (n, 3) float32 or float64, world units.
        log_scales: (n, 3) natural logarithms of the standard deviations along each splat's own axes, world units.
        quaternions: (n, 4) w x y z, rotations of those axes, of any length. One of length zero turns nothing.
        logits: (n,) or (n, 1) logarithms of opacity / (1 - opacity).
        harmonics: (n, b, 3) coefficients in red, green and blue; b = 1, 4, 9 or 16.
        layout: Layout of the PLY file that the splats come from, with its other properties. None is that of 3DGS.
        background: Colour behind the splats, a name or (3,) in [0, 1].
        up: (3,) up direction of the world, of any length but zero.
        antialias: Whether the splats were fitted with antialiasing: the default of `render`.
        device: Warp device. None is CUDA where there is one.

    Raises:
        ValueError: For shapes that do not fit together, or values that are not finite.

    Attributes:
        straightening: None, as for a VoxelField whose coordinates are those of its files.
        background_model: None: there is one colour behind splats.
        contents: The values as files have them. They are not to be written to.
        background: (3,) float32 colour behind the splats.
        up: (3,) float64 unit vector.
        antialias: Whether views are antialiased by default. Files of .spz and .sog say so.
        device: Warp device.
    """

    _elsewhere = "save it, and load the file in each of them"

    straightening = background_model = None

    #: What messages call a node of `node_densities`.
    node_name = SPLAT_NODE

    @renamed(centers="centres")
    def __init__(
        self,
        centers: ArrayLike,
        log_scales: ArrayLike,
        quaternions: ArrayLike,
        logits: ArrayLike,
        harmonics: ArrayLike,
        *,
        layout: PlyLayout | None = None,
        background: str | ArrayLike = "black",
        up: ArrayLike = (0.0, -1.0, 0.0),
        antialias: bool = False,
        device: wp.DeviceLike = None,
    ):
        held = np.asarray(as_host_array(centers, "centers"))
        places = held if held.dtype in (np.float32, np.float64) else real_array(held, "centers", np.float32)
        others = {"log_scales": log_scales, "quaternions": quaternions, "logits": logits, "harmonics": harmonics}
        scales, turns, opacities, colors = (
            real_array(as_host_array(each, name), name, np.float32) for name, each in others.items()
        )
        if places.ndim != 2 or colors.ndim != 3:
            raise InputError(f"centres must be (n, 3) and harmonics (n, b, 3), got {places.shape}, {colors.shape}")
        if opacities.shape == (len(places), 1):  # as the optimiser of 3DGS holds them
            opacities = opacities[:, 0]
        self.contents = checked_contents(SplatContents(places, scales, turns, opacities, colors, layout))
        self.antialias = checked_flag(antialias, "antialias")
        self.device = resolve_device(device)
        self.background = parse_background(background)
        self.up = checked_direction(up, "up")
        self._splats: Any = None
        self._density: SplatDensity | None = None

    @classmethod
    @reports_progress
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        activated: bool | None = None,
        device: wp.DeviceLike = None,
        progress: bool | Progress = False,
    ) -> SplatField:
        """Read splats from a file.

        Splats with values that are not finite or scales of zero are left out where they are few (10, or 1 % of a large
        file), with a warning that counts them. The 3D filter of Mip-Splatting is applied.

        Args:
            path: A file such as .ply or .spz (`warpcage info` lists all formats), or a folder of SOG, which has a
                meta.json. Or an output folder of 3D Gaussian Splatting: its newest iteration is read, with the
                background of its fit.
            activated: For .ply files: whether they have opacities and scales instead of logits and logarithms. None
                decides by their ranges, and warns where they have.
            device: Warp device. None is CUDA where there is one.
            progress: True shows a bar on stderr. A function is called with (done, total, message) and cancels
                by returning False.

        Returns:
            The field.

        Raises:
            FileNotFoundError: If there is no such file.
            Cancelled: Where `progress` returned False.
            ValueError: For a file of another layout, one with more splats whose values are not finite, or one that
                was never filled: with zeros alone, without scales, or without rotations.
        """
        if activated is not None:
            checked_flag(activated, "activated")
        report_progress(progress, 0, 2, "splats: their file")
        contents = read_splats(path, activated=activated)
        report_progress(progress, 1, 2, "splats: their tables")
        field = cls.from_contents(contents, device=device, **own_background(path))
        report_progress(progress, 2, 2, "splats: their tables")
        return field

    @classmethod
    def from_arrays(
        cls,
        centers: Any,
        scales: Any,
        rotations: Any,
        opacities: Any,
        colors: Any = None,
        *,
        harmonics: Any = None,
        **options: Any,
    ) -> SplatField:
        """A field of values as renderers have them, as arrays of any library (NumPy, Warp, torch, CuPy, JAX).

        Args:
            centers: (n, 3) world units.
            scales: (n, 3) standard deviations along each splat's own axes, above 0, world units.
            rotations: (n, 4) quaternions w x y z of any length, or (n, 3, 3) with those axes as columns. None turns
                nothing.
            opacities: (n,) or (n, 1), 0 to 1.
            colors: (n, 3) in [0, 1], the same from all sides. None where there are harmonics.
            harmonics: (n, b, 3) coefficients in red, green and blue; b = 1, 4, 9 or 16.
            options: `background`, `up`, `antialias` and `device`, as for the constructor.

        Returns:
            The field.

        Raises:
            ValueError: As the constructor; for logarithms or logits; and for neither or both of colours and harmonics.
        """
        return cls.from_contents(
            contents_of_arrays(centers, scales, rotations, opacities, colors, harmonics), **options
        )

    @classmethod
    def from_contents(cls, contents: SplatContents, **options: Any) -> SplatField:
        """A field of values as files have them.

        Args:
            contents: The values.
            options: `background`, `up`, `antialias` and `device`, as for the constructor. Where antialias is not given
                it is that of the values.

        Returns:
            The field.

        Raises:
            ValueError: As the constructor.
        """
        values = (contents.log_scales, contents.quaternions, contents.logits, contents.harmonics)
        options = {"antialias": contents.antialias} | options
        return cls(contents.centers, *values, layout=contents.layout, **options)

    def save(self, path: str | os.PathLike[str], *, version: int | None = None) -> None:
        """Write the splats to a file, whole or not at all.

        What was loaded from a .ply and is saved as one is the same file, bit for bit. The other formats quantise:
        .compressed.ply positions and scales to 11 bits of a chunk's range, for which fine splats may be put in another
        order, .spz positions to 1 / 4096 of a unit or finer, .splat has no harmonics but the first, .sog positions to
        16 bits of the logarithm of their range. A .glb has float32 numbers. Numbers beyond the range of a format are
        cut; a warning counts them.

        Args:
            path: The file, whose ending says the format, such as .ply or .spz (`warpcage info` lists all).
            version: Of .spz files: 3 (gzip, which all programs read) or 4 (zstd). None is 3.

        Raises:
            ValueError: For another ending, splats that the format cannot hold, or a version that is not written.
        """
        write_splats(dataclasses.replace(self.contents, antialias=self.antialias), path, version=version)

    @property
    def splat_count(self) -> int:
        """Number of splats."""
        return self.contents.count

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return self.contents.degree

    @property
    def centers(self) -> np.ndarray:
        """(n, 3) float32 or float64 centres, world units, as files have them. They are not to be written to."""
        return self.contents.centers

    @functools.cached_property
    def scales(self) -> np.ndarray:
        """(n, 3) float64 standard deviations along each splat's own axes, world units."""
        return np.exp(self.contents.log_scales.astype(np.float64))

    @functools.cached_property
    def rotations(self) -> np.ndarray:
        """(n, 3, 3) float64 each splat's own axes, one per column."""
        return rotation_matrices(self.contents.quaternions)

    @functools.cached_property
    def opacities(self) -> np.ndarray:
        """(n,) float64 opacity at each centre, 0 to 1."""
        return opacities_of(self.contents.logits)

    @functools.cached_property
    def covariances(self) -> np.ndarray:
        """(n, 3, 3) float64, world units squared."""
        factors = self.rotations * self.scales[:, None, :]
        return factors @ factors.transpose(0, 2, 1)

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) float64 box of all splats that can be seen, to three standard deviations; world units.

        It is a whole number of voxels of `voxel_size` along each axis."""
        return self._bounds

    @functools.cached_property
    def _bounds(self) -> np.ndarray:
        seen = self.opacities >= MIN_OPACITY
        if not seen.any():
            seen[:] = True
        if not len(seen):
            return whole_voxels(np.array([np.full(3, -0.5), np.full(3, 0.5)]), RESOLUTION)[0]
        reach = REACH * np.sqrt(np.einsum("nii->ni", self.covariances)[seen])
        centers = self.contents.centers[seen].astype(np.float64)
        low, high = (centers - reach).min(axis=0), (centers + reach).max(axis=0)
        size = max(float((high - low).max()), 1e-9 * float(np.abs(centers).max()), 1e-9)
        box = np.array([np.minimum(low, high - 1e-6 * size), np.maximum(high, low + 1e-6 * size)])
        return whole_voxels(box, RESOLUTION)[0]

    @functools.cached_property
    def shown_bounds(self) -> np.ndarray:
        """(2, 3) float64 box of most of what can be seen, for cameras to look at; world units.

        It leaves out the outermost hundredth of the centres on each side."""
        seen = self.opacities >= MIN_OPACITY
        if not seen.any():
            return self.bounds
        low, high = np.quantile(self.contents.centers[seen].astype(np.float64), [0.01, 0.99], axis=0)
        reach = 2.0 * float(np.median(self.scales[seen].max(axis=1)))
        return np.array([np.maximum(low - reach, self.bounds[0]), np.minimum(high + reach, self.bounds[1])])

    @property
    def shown_points(self) -> np.ndarray:
        """(n, 3) float64 centres of the splats that can be seen, within `shown_bounds`; world units."""
        centers = self.contents.centers[self.opacities >= MIN_OPACITY].astype(np.float64)
        low, high = self.shown_bounds
        return centers[((centers >= low) & (centers <= high)).all(axis=1)]

    @property
    def center(self) -> np.ndarray:
        """(3,) float64 middle of the bounds: the origin that kernels' positions are relative to."""
        return self.bounds.mean(axis=0)

    @property
    def voxel_size(self) -> np.ndarray:
        """(3,) world units: of the grid that `node_densities` looks at the splats on, 128 along the longest side."""
        return np.full(3, float((self.bounds[1] - self.bounds[0]).max()) / RESOLUTION)

    def node_densities(self) -> np.ndarray:
        """(nx, ny, nz) float32 densities of the splats' matter in the middle of each voxel, per world unit.

        Cages, selections and surfaces are made of them (kernels/splats/fit.py)."""
        return self.matter().node_densities()

    def matter(self, bounds: ArrayLike | None = None, resolution: int = RESOLUTION) -> SplatDensity:
        """The densities of the splats on a grid, finer where a box is smaller than the field.

        `Cage.from_field`, `select_nodes` and `select_object` take it in place of the field.

        Args:
            bounds: (2, 3) box of the grid, world units, made larger to whole cells. None is that of all splats.
            resolution: Cells along its longest side, 2 to 1024.

        Returns:
            The densities, with `bounds`, `voxel_size` and `node_densities` as of a field.

        Raises:
            ValueError: For a box or a resolution out of range.
        """
        if bounds is not None or resolution != RESOLUTION:
            return SplatDensity(self, resolution, bounds)
        if self._density is None:
            self._density = SplatDensity(self)
        return self._density

    def finest_cell(self, bounds: ArrayLike) -> float:
        """The smallest cell size at which the splats in a box still form connected matter.

        Args:
            bounds: (2, 3) the box, world units.

        Returns:
            The side, world units; 0 for a box without splats that can be seen.

        Raises:
            ValueError: For a box whose corners are not ordered and finite.
        """
        (low, high), places = checked_bounds(bounds), self.contents.centers
        inside = ((places >= low) & (places <= high)).all(axis=1)
        return finest_side(self.contents.log_scales[inside & (self.opacities >= MIN_OPACITY)])

    def distance_seen(self, origin: ArrayLike, direction: ArrayLike, spread: float = 0.0) -> float:
        """The distance along a ray at which half of its light is absorbed.

        Args:
            origin: (3,) where the ray begins, world units.
            direction: (3,) where it goes, of any length but zero.
            spread: Width of the pixel that the ray goes through at distance 1, by which views blur splats.

        Returns:
            The distance, world units; infinite where more than half of the light passes.

        Raises:
            ValueError: For a direction of length zero.
        """
        start, along = checked_vector(origin, "origin"), checked_direction(direction, "direction")
        places = self.contents.centers
        return half_light(places, self.covariances, self.opacities, start, along, spread, self.near)

    def painted(self, rows: np.ndarray) -> SplatField:
        """The same matter, chosen splats white and others black: views show the chosen share of the light.

        Args:
            rows: (n,) bool, the chosen splats.

        Returns:
            The field, before black.
        """
        held = self.contents
        paint = np.where(rows, 0.5, -0.5).astype(np.float32)[:, None, None] / np.float32(Y0)
        values = (held.centers, held.log_scales, held.quaternions, held.logits)
        return SplatField(
            *values, np.repeat(paint, 3, axis=2), up=self.up, antialias=self.antialias, device=self.device
        )

    @property
    def splats(self) -> Any:
        """The Splats of kernels/splats/splats.py on the device, relative to `center`. They are not to be written to."""
        if self._splats is None:
            self._splats = self._on_device()
        return self._splats

    @in_turn
    def _on_device(self) -> Any:
        splats = Splats()
        device = self.device
        centers = (self.contents.centers.astype(np.float64) - self.center).astype(np.float32)
        covariances = self.covariances[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)
        harmonics = np.ascontiguousarray(self.contents.harmonics.reshape(self.splat_count, -1))
        splats.centers = wp.array(centers, dtype=wp.vec3, device=device)
        splats.covariances = wp.array(covariances, dtype=wp.float32, device=device)
        splats.opacities = wp.array(self.opacities.astype(np.float32), dtype=wp.float32, device=device)
        splats.harmonics = wp.array(harmonics, dtype=wp.float32, device=device)
        splats.degree = self.degree
        splats.turns = empty_array(0, wp.quat, device)
        splats.rows = empty_array(0, wp.int32, device)
        return splats

    def to(self, device: wp.DeviceLike) -> SplatField:
        """The same field on another device.

        Args:
            device: Warp device. None is CUDA where there is one.

        Returns:
            The field; this one if it is there already.
        """
        device = resolve_device(device)
        return (
            self if device == self.device else self.from_contents(self.contents, **self.view_options(), device=device)
        )

    def chosen(self, rows: ArrayLike) -> SplatField:
        """Some of the splats, with what else their file says of each.

        Args:
            rows: (n,) bool, or the numbers of the splats in any order.

        Returns:
            The field of those.

        Raises:
            ValueError: For rows that are not there.
        """
        rows = np.asarray(rows)
        if rows.dtype == bool:
            if rows.shape != (self.splat_count,):
                raise InputError(f"a mask of {self.splat_count} splats must be ({self.splat_count},), got {rows.shape}")
            rows = np.flatnonzero(rows)
        if rows.ndim != 1 or (
            len(rows) and not (rows.dtype.kind in "iu" and 0 <= rows.min() <= rows.max() < len(self))
        ):
            raise InputError(f"rows must be whole numbers from 0 to {self.splat_count - 1}, got {rows!r:.60}")
        rows = rows.astype(np.int64)
        return self.from_contents(chosen_contents(self.contents, rows), device=self.device, **self.view_options())

    @takes_options(SplatKeywords)
    def render(self, camera: Camera, **options: Unpack[SplatKeywords]) -> Frame:
        """The view of a camera.

        The depth of a splat is that of the matter that a pixel sees, so that large slanted splats have slanted depths.

        Args:
            camera: The camera.
            options: Options of the frame by keyword, see docs/python.md.

        Returns:
            The frame, its arrays on the field's device.

        Raises:
            ValueError: For a background that is not known, or supersampling out of range.
        """
        return self._render(camera, render_options(options, SplatKeywords))

    def _render(
        self, camera: Camera, options: RenderOptions, target: RenderTarget = NEW_TARGET, posed: Any = None
    ) -> Frame:
        """See `render`; posed: Splats that are drawn in place of the field's own."""
        return self.renderer.render(
            self.splats if posed is None else posed,
            camera,
            color=self.background,
            origin=self.center,
            near=self.near,
            antialias=self.antialias,
            options=options,
            target=target,
        )

    @functools.cached_property
    def renderer(self) -> SplatRenderer:
        """What draws the field, with buffers that its views share."""
        from .render import SplatRenderer

        return SplatRenderer(self.device)

    @functools.cached_property
    def near(self) -> float:
        """How far before a camera a splat's centre must be to be drawn, world units."""
        from .render import near_distance

        return near_distance(self.contents.centers)

    def view_options(self) -> dict[str, Any]:
        """The constructor's arguments that views depend on besides the splats."""
        return {"background": self.background, "up": self.up, "antialias": self.antialias}

    def __len__(self) -> int:
        return self.splat_count

    def __repr__(self) -> str:
        bounds = np.round(self.bounds, 4).tolist()
        return f"SplatField({self.splat_count} splats of degree {self.degree}, bounds {bounds}, {self.device})"


#: What a Deformer poses.
AnyField: TypeAlias = VoxelField | SplatField


def load_field(path: PathLike, *, scene_scale: float = 1.0, device: wp.DeviceLike = None) -> AnyField:
    """Read a field of voxels or of splats, by the ending; scene_scale as for `VoxelField.load`."""
    return read_field(path, scene_scale=scene_scale)(device)


def read_field(path: PathLike, *, scene_scale: float = 1.0) -> Callable[[wp.DeviceLike], AnyField]:
    """Read a field into the host's memory, for which no device is needed; returns what makes the field on a device.
    That may raise a ValueError of parts that do not fit."""
    if not is_splat_file(path):
        _require_field_file(path)
        return functools.partial(_voxels_of, load_voxels(path, scene_scale=scene_scale), path)
    if scene_scale != 1.0:
        raise InputError(f"{path} holds splats, which keep their scale: leave the scene scale out")
    splats, background = read_splats(path), own_background(path)
    return lambda device: SplatField.from_contents(splats, device=device, **background)


def _require_field_file(path: PathLike) -> None:
    """Refuse a file that is of another kind, with what fields are."""
    file = require_file(path, "field file")
    if file.suffix.lower() not in (".npz", "") and not begins_as_archive(file):
        endings = " ".join(endings_read())
        raise InputError(
            f"{path} is not a field: fields are .npz (voxels) or {endings} (splats), this looks like {kind_seen(file)}"
        )


def _voxels_of(contents: FieldContents, path: PathLike, device: wp.DeviceLike) -> VoxelField:
    """The field of what was read of a file, which a ValueError names."""
    try:
        return VoxelField.from_contents(contents, device=device)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error


def field_size(field: AnyField) -> str:
    """How large a field is, such as "12000 voxels"."""
    return counted(len(field), "splat") if isinstance(field, SplatField) else counted(field.voxel_count, "voxel")
