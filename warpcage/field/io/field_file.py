"""Field files of our own: plain and compact arrays, background layers and outer fields inside one archive."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import pathlib
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from ...core.checks import MAX_HALF, Cuts
from ...core.memory import free_host_bytes
from ...core.npz import require_numbers
from ...core.threads import run_parallel
from ...errors import InputError
from ...view.camera_path import RefinedCameras

#: Voxels that a grid may have, empty ones included: kernels count them in int32.
MAX_VOXELS = 2**31 - 1

#: The harmonic of degree 0: a colour is 0.5 and this times its coefficient.
Y0 = 0.28209479177387814

#: Harmonics of degree 0 to 2, which each channel of an RGB row has.
BASIS_COUNT = 9

#: Numbers of a row of either kind (kernels/field/harmonics): 3 x 9 of red, green and blue; or 16 of luminance and 4 of
#: each of two differences of colour.
RGB_NUMBERS, LUMINANCE_NUMBERS = 3 * BASIS_COUNT, 24

#: Places of the two colour differences in a row of luminance and differences.
_ORANGE, _GREEN = slice(16, 20), slice(20, 24)

#: What a field's colours are, in a message.
HARMONICS = "harmonics"

#: Numbers that a thread converts or looks through at once.
PART_NUMBERS = 1 << 22


@dataclasses.dataclass(frozen=True)
class LayerContents:
    """Background layers on the host."""

    center: np.ndarray  # (3,) float64 centre of all cubes, world units
    half: float  # half side of the innermost cube, world units
    side: int  # cells along an edge of a cube
    values: np.ndarray  # (layers, nodes, 4) float32 red, green, blue and optical depth
    unseen: np.ndarray | None  # (4,) float32 what nodes hold that no picture showed

    def shrunk(self, divisor: float) -> LayerContents:
        """The layers of a smaller world; divisor: old lengths over new ones."""
        return dataclasses.replace(self, center=self.center / divisor, half=self.half / divisor)


@dataclasses.dataclass(frozen=True)
class OuterContents:
    """An outer field on the host."""

    center: np.ndarray  # (3,) float64 middle and half sides of the box that it surrounds, world units
    half: np.ndarray
    links: np.ndarray  # (n, n, n) int32, row of each voxel of contracted space or -1
    values: np.ndarray  # (rows, 4) float32 red, green, blue and density per unit of contracted length
    sky: np.ndarray  # (nodes, 3) float32 colours of a cube at infinity

    def shrunk(self, divisor: float) -> OuterContents:
        """The outer field of a smaller world; divisor: old lengths over new ones."""
        return dataclasses.replace(self, center=self.center / divisor, half=self.half / divisor)


@dataclasses.dataclass(frozen=True)
class FieldContents:
    """A voxel field on the host, as field files read and write it; None is what the file does not say."""

    bounds: np.ndarray  # (2, 3) float64, world units
    links: np.ndarray  # (nx, ny, nz) int32, row of each voxel or -1
    density: np.ndarray  # (rows,) float32 per world unit
    sh: np.ndarray  # (rows, 9, 3) of red, green, blue or (rows, 24) of luminance, differences; float32 or float16
    weights: np.ndarray | None = None  # (rows,) float32 largest rendering weights
    background: np.ndarray | None = None  # (3,) colour and (3,) direction
    up: np.ndarray | None = None
    straightening: np.ndarray | None = None  # (4, 4) motion from the coordinates of the scene's files; None: the same
    supersampling: int | None = None  # rays along each side of a pixel
    layers: LayerContents | None = None
    outer: OuterContents | None = None
    refined: RefinedCameras | None = None  # of the pictures that it was fitted to

    def options(self) -> dict[str, Any]:
        """What is known beside the voxels and layers, by the names of VoxelField's arguments."""
        names = ("weights", "background", "up", "straightening", "supersampling")
        return {name: value for name in names if (value := getattr(self, name)) is not None}


def rgb_harmonics(sh: np.ndarray, count: int = BASIS_COUNT) -> np.ndarray:
    """Harmonics (rows, count, 3) of red, green and blue from (rows, 24) of luminance and colour differences,
    those above `count` (9 or 16) left out; (rows, 9, 3) as given."""
    if sh.ndim == 3:
        return sh
    orange, green = np.zeros((2, len(sh), count), np.float32)
    orange[:, :4], green[:, :4] = sh[:, _ORANGE], sh[:, _GREEN]
    luminance = sh[:, :count]
    grey = luminance - 0.5 * green
    return np.stack([grey + orange, luminance + green, grey - orange], axis=-1)


def surface_node_count(side: int) -> int:
    """Number of lattice points on the surface of a cube of `side` cells along an edge."""
    return 6 * int(side) ** 2 + 2


def voxel_side(bounds: np.ndarray, shape: tuple[int, ...]) -> float:
    """The smallest side of a voxel, world units, of (nx, ny, nz) voxels in bounds (2, 3)."""
    return float(((bounds[1] - bounds[0]) / shape).min())


def as_half(what: str, values: np.ndarray, cuts: Cuts) -> np.ndarray:
    """Numbers as float16, those beyond its range cut to the largest. what: they are, in a message."""
    return cuts.clip(what, values, -MAX_HALF, MAX_HALF, 0.0).astype(np.float16)


def _as_bytes(what: str, values: np.ndarray, cuts: Cuts) -> np.ndarray:
    """Numbers from 0 to 1 as bytes, others cut to that. what: they are, in a message."""
    return np.rint(255 * cuts.clip(what, values, 0.0, 1.0, 1.0 / 255.0)).astype(np.uint8)


def as_single(values: np.ndarray) -> np.ndarray:
    """A float32 copy of numbers in rows along the first axis, converted by all threads."""
    singles = np.empty(values.shape, np.float32)

    def convert(rows: slice) -> None:
        singles[rows] = values[rows]

    _by_rows(convert, values)
    return singles


def are_finite(values: np.ndarray) -> bool:
    """Whether all numbers of an array are finite, looked through by all threads."""
    return all(_by_rows(lambda rows: bool(np.isfinite(values[rows]).all()), values))


def numbered(occupied: np.ndarray) -> np.ndarray:
    """Number the set voxels of (nx, ny, nz) bool in memory order, by all threads; int32, -1 for others."""
    links = np.empty(occupied.shape, np.int32)
    begins = np.zeros(len(occupied) + 1, np.int64)

    def count(layers: slice) -> None:
        begins[layers.start + 1 : layers.stop + 1] = np.count_nonzero(occupied[layers], axis=(1, 2))

    def number(layers: slice) -> None:
        links[layers] = -1
        first, last = int(begins[layers.start]), int(begins[layers.stop])
        links[layers][occupied[layers]] = np.arange(first, last, dtype=np.int32)

    _by_rows(count, occupied)
    np.cumsum(begins, out=begins)
    _by_rows(number, occupied)
    return links


def _by_rows(task: Callable[[slice], Any], values: np.ndarray) -> list[Any]:
    """Run a task on the rows of an array in parts; returns what each gave."""
    size = max(1, PART_NUMBERS * len(values) // max(values.size, 1))
    parts = [slice(begin, min(begin + size, len(values))) for begin in range(0, len(values), size)]
    return run_parallel([functools.partial(task, part) for part in parts]) if parts else []


#: The arrays that a compact file has in place of those of a plain one.
COMPACT_NAMES = ("sh_step", "sh_low", "sh_high", "opacity", "weight_roots")

SH_STEP = 1 / 128  #: harmonics are multiples of this: trilinear weights and the samples of a ray average the error

#: Bits of mantissa of an opacity, and those of a float16.
DENSITY_BITS, HALF_BITS = 7, 10


def pack(contents: dict[str, Any], voxel_side: float, cuts: Cuts) -> dict[str, Any]:
    """The arrays of a compact file from those of the plain one, by name; voxel_side: the smallest, world units.
    cuts: counts what is cut."""
    packed = {name: value for name, value in contents.items() if name not in ("sh", "density", "weights")}
    sh = cuts.clip(
        HARMONICS, np.asarray(contents["sh"], np.float32), -(2**15) * SH_STEP, (2**15 - 1) * SH_STEP, SH_STEP
    )
    levels = np.rint(sh / SH_STEP).astype(np.int16).reshape(len(sh), -1).T
    packed["sh_step"] = np.array(SH_STEP)
    packed["sh_low"] = (levels & 255).astype(np.uint8)  # bytes of one kind together: deflate finds those alike
    packed["sh_high"] = (levels >> 8).astype(np.int8)
    opacity = as_half("densities of a voxel's side", contents["density"] * voxel_side, cuts).view(np.uint16)
    spare = HALF_BITS - DENSITY_BITS
    size = opacity & 0x7FFF  # ties go to the even one, and nothing to infinity
    nearest = np.minimum(size + (1 << spare - 1) - 1 + (size >> spare & 1), 0x7BFF) >> spare << spare
    packed["opacity"] = (nearest | (opacity & 0x8000)).view(np.float16)
    if "weights" in contents:
        packed["weight_roots"] = _as_bytes("roots of weights", np.sqrt(np.maximum(contents["weights"], 0)), cuts)
    return packed


def unpack(contents: dict[str, np.ndarray], rows: int, voxel_side: float, path: pathlib.Path) -> dict[str, np.ndarray]:
    """The arrays of the plain file again: harmonics (rows, 3, 9) or (rows, 24), densities, weights.
    voxel_side: the smallest, world units; path: for messages."""
    numbers = LUMINANCE_NUMBERS if contents["sh_low"].shape[:1] == (LUMINANCE_NUMBERS,) else RGB_NUMBERS
    planes: list[tuple[str, tuple[int, ...]]] = [
        ("sh_low", (numbers, rows)),
        ("sh_high", (numbers, rows)),
        ("sh_step", ()),
        ("opacity", (rows,)),
    ]
    if "weight_roots" in contents:
        planes.append(("weight_roots", (rows,)))
    for name, shape in planes:
        require_numbers(contents, name, shape, path)
    plain = {name: value for name, value in contents.items() if name not in ("sh_low", "sh_high", "sh_step", "opacity")}
    low, high = contents["sh_low"], contents["sh_high"]
    levels = (high.astype(np.int16) << 8) | low
    sh = levels.T * np.float32(contents["sh_step"])
    plain["sh"] = sh if numbers == LUMINANCE_NUMBERS else sh.reshape(rows, 3, BASIS_COUNT)
    plain["density"] = contents["opacity"].astype(np.float32) / np.float32(voxel_side)
    if "weight_roots" in contents:
        plain["weights"] = (contents["weight_roots"].astype(np.float32) / 255) ** 2
    return plain


def write(path: pathlib.Path, arrays: dict[str, Any]) -> None:
    """Write an .npz deflated at the quickest level: half the time of savez_compressed's, a tenth larger."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(
                    member, np.ascontiguousarray(array) if np.ndim(array) else np.asarray(array), allow_pickle=False
                )


def _read_bytes(contents: dict[str, np.ndarray], name: str, shape: tuple[int, ...], path: pathlib.Path) -> np.ndarray:
    """An array of bytes of a file; path: for messages."""
    array = require_numbers(contents, name, shape, path)
    if array.dtype != np.uint8:
        raise InputError(f"{path}: {name} must be uint8, got {array.dtype}")
    return array


#: Names in the archive begin with this.
LAYERS_PREFIX = "layers_"

#: The arrays of background layers.
LAYER_NAMES = tuple(LAYERS_PREFIX + name for name in ("center", "half", "side", "count", "seen", "rgba", "unseen"))

#: Most cells along an edge of a cube, and most cubes.
MAX_LAYER_SIDE, MAX_LAYERS = 8192, 1024

#: Values that differ from those of unseen nodes by more than this were seen.
SEEN_DIFFERENCE = 1e-6

#: Bytes that a node takes while it is read.
LAYER_NODE_BYTES = 40


def layer_arrays(layers: LayerContents, cuts: Cuts) -> dict[str, np.ndarray]:
    """The arrays of background layers, by name."""
    values, rest = layers.values, layers.unseen
    seen = np.ones(values.shape[:2], bool)
    if rest is not None:
        seen = (np.abs(values - rest) > SEEN_DIFFERENCE).any(axis=-1)
    rows = values[seen]
    rgba = np.empty(rows.shape, np.uint8)  # colours and, for optical depths, opacities below 1, to 1/255
    rgba[:, :3] = _as_bytes("colors of background layers", rows[:, :3], cuts)
    rgba[:, 3] = np.rint(255 * -np.expm1(-np.maximum(rows[:, 3], 0)))
    contents = {
        "center": layers.center,
        "half": np.array(layers.half),
        "side": np.array(layers.side),
        "count": np.array(len(values)),
        "seen": np.packbits(seen.ravel()),
        "rgba": rgba,
    }
    if rest is not None:
        contents["unseen"] = rest
    return {LAYERS_PREFIX + name: array for name, array in contents.items()}


def read_layers(contents: dict[str, np.ndarray], path: pathlib.Path) -> LayerContents | None:
    """The background layers of a file's arrays, or None where it has none; path: for messages."""
    if LAYERS_PREFIX + "side" not in contents:
        return None

    def read(name: str, shape: tuple[int, ...]) -> np.ndarray:
        return require_numbers(contents, LAYERS_PREFIX + name, shape, path)

    side, count = int(read("side", ())), int(read("count", ()))
    if not (2 <= side <= MAX_LAYER_SIDE and 2 <= count <= MAX_LAYERS):
        raise InputError(
            f"{path}: background layers must be 2 to {MAX_LAYERS} of 2 to {MAX_LAYER_SIDE} cells along an edge, "
            f"got {count} of {side}"
        )
    shape = (count, surface_node_count(side))
    size = shape[0] * shape[1]
    if LAYER_NODE_BYTES * size > free_host_bytes():
        raise InputError(f"{path}: {count} background layers of {side} cells need more memory than is free")
    packed = _read_bytes(contents, LAYERS_PREFIX + "seen", (-(-size // 8),), path)
    seen = np.unpackbits(packed, count=size).astype(bool).reshape(shape)
    rgba = _read_bytes(contents, LAYERS_PREFIX + "rgba", (int(seen.sum()), 4), path)
    unseen = read("unseen", (4,)).astype(np.float32) if LAYERS_PREFIX + "unseen" in contents else None
    if unseen is None and not seen.all():
        raise InputError(f"{path} lacks {LAYERS_PREFIX}unseen")
    values = np.empty((*shape, 4), np.float32)
    values[...] = 0.0 if unseen is None else unseen
    values[seen, :3] = rgba[:, :3] / np.float32(255)
    values[seen, 3] = -np.log1p(-np.minimum(rgba[:, 3], 254.5) / 255)
    return LayerContents(read("center", (3,)), float(read("half", ())), side, values, unseen)


#: Names in the archive begin with this.
OUTER_PREFIX = "outer_"

#: The arrays of an outer field.
OUTER_NAMES = tuple(OUTER_PREFIX + name for name in ("center", "half", "side", "occupancy", "rgba", "sky"))

#: Fewest and most voxels along a side of contracted space.
MIN_OUTER_SIDE, MAX_OUTER_SIDE = 4, 1290

#: Bytes that a node, and a voxel that holds values, take while they are read.
OUTER_NODE_BYTES, OUTER_ROW_BYTES = 10, 40

#: Opacity of a voxel, of 255, above which all are the same: 254.5 stands for all of it.
MAX_OPACITY = 254.5


def outer_arrays(outer: OuterContents, cuts: Cuts) -> dict[str, np.ndarray]:
    """The arrays of an outer field, by name."""
    occupied = outer.links >= 0
    values = outer.values[outer.links[occupied]]  # the file's rows are in memory order
    side = len(outer.links)
    rgba = np.empty(values.shape, np.uint8)  # colours and, for densities, opacities of a voxel below 1, to 1/255
    rgba[:, :3] = _as_bytes("colors of the outer field", values[:, :3], cuts)
    rgba[:, 3] = np.rint(255 * -np.expm1(-np.maximum(values[:, 3], 0) * (4.0 / side)))
    contents = {
        "center": outer.center,
        "half": outer.half,
        "side": np.array(side),
        "occupancy": np.packbits(occupied.ravel()),
        "rgba": rgba,
        "sky": _as_bytes("colors of the sky", outer.sky, cuts),
    }
    return {OUTER_PREFIX + name: array for name, array in contents.items()}


def read_outer(contents: dict[str, np.ndarray], path: pathlib.Path) -> OuterContents | None:
    """The outer field of a file's arrays, or None where it has none; path: for messages."""
    if OUTER_PREFIX + "side" not in contents:
        return None

    def read(name: str, shape: tuple[int, ...]) -> np.ndarray:
        return require_numbers(contents, OUTER_PREFIX + name, shape, path)

    side = int(read("side", ()))
    if not MIN_OUTER_SIDE <= side <= MAX_OUTER_SIDE:
        raise InputError(
            f"{path}: an outer field has {MIN_OUTER_SIDE} to {MAX_OUTER_SIDE} voxels along a side, got {side}"
        )
    count = side**3
    if OUTER_NODE_BYTES * count > free_host_bytes():
        raise InputError(f"{path}: an outer field of {side}^3 needs more memory than is free")
    packed = _read_bytes(contents, OUTER_PREFIX + "occupancy", (-(-count // 8),), path)
    occupied = np.unpackbits(packed, count=count).astype(bool).reshape(side, side, side)
    rows = int(occupied.sum())
    if OUTER_ROW_BYTES * rows > free_host_bytes():
        raise InputError(f"{path}: an outer field of {rows} voxels needs more memory than is free")
    rgba = _read_bytes(contents, OUTER_PREFIX + "rgba", (rows, 4), path)
    links = np.full(occupied.shape, -1, np.int32)
    links[occupied] = np.arange(rows, dtype=np.int32)
    sky = require_numbers(contents, OUTER_PREFIX + "sky", (None, 3), path).astype(np.float32) / 255
    values = np.empty((rows, 4), np.float32)
    values[:, :3] = rgba[:, :3] / np.float32(255)
    values[:, 3] = -np.log1p(-np.minimum(rgba[:, 3], MAX_OPACITY) / 255) * (side / 4.0)
    return OuterContents(read("center", (3,)), read("half", (3,)), links, values, sky)


#: Files with an outer field are of version 4, of luminous rows of version 3, others with background layers of version
#: 2; the rest stays readable by older releases.
FORMAT_VERSION, LUMINOUS_VERSION, LAYERS_VERSION = 4, 3, 2

#: The arrays of a plain file, without its layers.
OWN_NAMES = (
    *("format", "version", "bounds", "background", "up", "straightening", "supersampling"),
    *("resolution", "occupancy", "density", "sh", "weights", "refined_cameras"),
)


def own_arrays(field: FieldContents, cuts: Cuts) -> dict[str, Any]:
    """The arrays of a plain file, by name, of a field with background, up and supersampling.
    cuts: counts what is cut."""
    occupied = field.links >= 0
    order = field.links[occupied]  # the file's rows are in memory order
    sh = field.sh[order]
    contents = {
        "format": np.array("warpcage"),
        "version": np.array(_least_version(field)),
        "bounds": field.bounds,
        "background": field.background,
        "up": field.up,
        "supersampling": np.array(field.supersampling),
        "resolution": np.array(field.links.shape, np.int32),
        "occupancy": np.packbits(occupied.ravel()),
        "density": field.density[order],
        "sh": as_half(HARMONICS, sh if sh.ndim == 2 else sh.transpose(0, 2, 1), cuts),  # (rows, rgb, basis) or luminous
    }
    if field.straightening is not None:
        contents["straightening"] = field.straightening
    if field.weights is not None:
        contents["weights"] = as_half("weights", field.weights[order], cuts)
    if field.refined is not None:
        contents["refined_cameras"] = np.frombuffer(json.dumps(field.refined.entries()).encode(), np.uint8)
    if field.layers is not None:
        contents |= layer_arrays(field.layers, cuts)
    if field.outer is not None:
        contents |= outer_arrays(field.outer, cuts)
    return contents


def _least_version(field: FieldContents) -> int:
    """The oldest version of the format that can hold a field."""
    if field.outer is not None:
        return FORMAT_VERSION
    if field.sh.ndim == 2:
        return LUMINOUS_VERSION
    return 1 if field.layers is None else LAYERS_VERSION


def _read_harmonics(contents: dict[str, np.ndarray], rows: int, path: pathlib.Path) -> np.ndarray:
    """Harmonics of either kind; halves stay halves."""
    luminous = "sh" in contents and contents["sh"].ndim == 2
    shape = (rows, LUMINANCE_NUMBERS) if luminous else (rows, 3, BASIS_COUNT)
    sh = require_numbers(contents, "sh", shape, path)
    if sh.dtype != np.float16:
        sh = as_single(sh)
    return sh if luminous else sh.transpose(0, 2, 1)


def read_own(contents: dict[str, np.ndarray], path: pathlib.Path) -> FieldContents:
    """The field of a plain or compact file's arrays; path: for messages."""
    version = int(require_numbers(contents, "version", (), path))
    if version > FORMAT_VERSION:
        raise InputError(f"{path} has format version {version}, this warpcage reads up to {FORMAT_VERSION}: upgrade")
    shape = tuple(int(n) for n in require_numbers(contents, "resolution", (3,), path))
    count = math.prod(shape)
    if min(shape) < 2 or count > MAX_VOXELS or 6 * count > free_host_bytes():
        raise InputError(
            f"{path}: resolution must be at least 2 along each axis, and small enough that links fit into memory, "
            f"got {shape}"
        )
    packed = _read_bytes(contents, "occupancy", (-(-count // 8),), path)
    occupied = np.unpackbits(packed, count=count).view(bool).reshape(shape)
    rows = int(np.count_nonzero(occupied))
    bounds = require_numbers(contents, "bounds", (2, 3), path)
    if "sh_low" in contents:  # a compact file
        if not (bounds[1] > bounds[0]).all():
            raise InputError(f"{path}: bounds must be lower below upper, got {bounds.tolist()}")
        contents = unpack(contents, rows, voxel_side(bounds, shape), path)
    require_numbers(contents, "density", (rows,), path)
    links = numbered(occupied)
    background, up = (
        require_numbers(contents, name, (3,), path) if name in contents else None for name in ("background", "up")
    )
    straightening = supersampling = weights = None
    if "straightening" in contents:
        straightening = require_numbers(contents, "straightening", (4, 4), path)
    if "supersampling" in contents:
        supersampling = int(require_numbers(contents, "supersampling", (), path))
    if "weights" in contents:
        weights = as_single(require_numbers(contents, "weights", (rows,), path))
    return FieldContents(
        contents["bounds"],
        links,
        as_single(contents["density"]),
        _read_harmonics(contents, rows, path),
        weights=weights,
        background=background,
        up=up,
        straightening=straightening,
        supersampling=supersampling,
        layers=read_layers(contents, path),
        outer=read_outer(contents, path),
        refined=_read_refined(contents, path),
    )


def _read_refined(contents: dict[str, np.ndarray], path: pathlib.Path) -> RefinedCameras | None:
    """The refined cameras of a file, which it holds as the UTF-8 of a list in JSON."""
    if "refined_cameras" not in contents:
        return None
    text = require_numbers(contents, "refined_cameras", (None,), path)
    try:
        return RefinedCameras.from_entries(json.loads(text.tobytes()))
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: its refined cameras are damaged: {' '.join(str(error).split())}") from error
