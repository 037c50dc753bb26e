"""How much memory a fit takes, before it takes it."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

import numpy as np
import warp as wp

from ..core.memory import free_bytes
from ..errors import InputError

#: Share of the free memory that a fit takes by default.
FREE_SHARE = 0.9

#: Steps between the factors by which a level may be refined; a smaller factor than the smallest is not worth its time.
FACTOR_STEP, SMALLEST_FACTOR = 1.0 / 16.0, 1.125

#: Voxels along the longest side below which a first level is of no use.
SMALLEST_LEVEL = 8

#: Where the factor is not a whole number, a voxel may become a few more than its cube, or fewer.
ROUNDING = 1.05

#: A first level that is too large is made coarser by this much more than the estimate says.
SHRINKAGE = 0.9

#: Images that do not fit should take this share of the memory after they are shrunk.
IMAGE_SHARE = 0.5

#: Items that a launch, and numbers that an array's axis may have: both are counted in 32 bits with a sign.
MAX_ITEMS = 2**31 - 1

#: Bytes per node of a mask, per row of a weight or a density, and of a place.
_MASK, _WEIGHT, _PLACE = 1, 4, 4

_Shape = TypeVar("_Shape")
_UNITS = {
    "": 1,
    "b": 1,
    **{
        f"{prefix}{ending}": base**power
        for ending, base in (("b", 1000), ("ib", 1024))
        for power, prefix in enumerate(("k", "m", "g", "t"), start=1)
    },
}


def memory_size(size: object) -> int:
    """A memory size in whole bytes, from a number or text such as "4GB" (10^9) or "512 MiB" (2^20)."""
    value = math.nan
    if isinstance(size, str):
        match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*([a-zA-Z]*)\s*", size)
        if match and match[2].lower() in _UNITS:
            value = float(match[1]) * _UNITS[match[2].lower()]
    elif isinstance(size, (int, float, np.integer, np.floating)) and not isinstance(size, bool):
        value = float(size)
    if not (value >= 1 and math.isfinite(value)):
        raise InputError(f"a memory size is a number of bytes or text such as '4GB' or '512MiB', got {size!r}")
    return int(value)


@dataclasses.dataclass(frozen=True)
class FitMemory:
    """Bytes that a fit takes on its device, by what they grow with, as the owners of the arrays state them."""

    fixed: int  # all that does not depend on the grid: pictures, batches, layers
    node: float  # for each node of the box
    row: int  # for each voxel that holds values
    field_row: int  # the field's part of it
    moment_row: int  # and the optimiser's second moments
    shards: int  # copies of the weights while a level is pruned
    tiles: int  # one number for each tile of the images
    row_numbers: int  # numbers of a voxel's gradient; a launch has an item for each

    def countable(self, rows: int, shape: tuple[int, ...]) -> bool:
        """Whether a level of (nx, ny, nz) with `rows` voxels has few enough for one launch, whatever the memory."""
        return rows * self.row_numbers <= MAX_ITEMS and math.prod(shape) <= MAX_ITEMS

    def without(self, size: int) -> FitMemory:
        """The same with `size` bytes less of what does not depend on the grid."""
        return dataclasses.replace(self, fixed=self.fixed - size)

    def first_shapes(self, shapes: Sequence[tuple[int, ...]], rows: int, limit: int) -> list[tuple[int, ...]] | None:
        """The resolutions of all levels, coarser than planned where the first one, of `rows` voxels, does not fit.
        None where too few voxels would be left."""
        needed = self.level_bytes(rows, shapes[0])
        if needed <= limit and self.countable(rows, shapes[0]):
            return list(shapes)
        spare = (limit - self.fixed) / (needed - self.fixed)
        most = MAX_ITEMS / max(rows * self.row_numbers, math.prod(shapes[0]))
        factor = SHRINKAGE * max(min(spare, most), 0.0) ** (1 / 3)
        coarser = [scaled_shape(shape, factor) for shape in shapes]
        return None if max(coarser[0]) < SMALLEST_LEVEL else coarser

    def refusal(self, rows: int, shape: tuple[int, ...], limit: int) -> ValueError:
        """The error for a first level of (nx, ny, nz) with `rows` voxels that does not fit into `limit` bytes."""
        return InputError(
            f"a fit within {memory_text(limit)} (max_memory) is not possible: the images take "
            f"{memory_text(self.fixed)}, the coarsest level {memory_text(self.level_bytes(rows, shape) - self.fixed)}"
        )

    def level_bytes(self, rows: int, shape: tuple[int, ...]) -> int:
        """Most that a level of (nx, ny, nz) with `rows` voxels takes, while its tiles are found and while it is
        optimised and pruned."""
        nodes = math.prod(shape)
        pruning = 2 * _MASK * nodes + _WEIGHT * self.shards * rows
        return math.ceil(self.fixed + self.node * nodes + self.row * rows + max(pruning, 2 * self.tiles))

    def change_bytes(self, rows: int, shape: tuple[int, ...], new_rows: int, new_shape: tuple[int, ...]) -> int:
        """Most that is held while a finer field replaces a level's: both fields, and the masks between them."""
        nodes, new_nodes = math.prod(shape), math.prod(new_shape)
        old = self.field_row * rows + (self.node + _MASK) * nodes
        new = self.field_row * new_rows + (self.node + 2 * _MASK) * new_nodes
        return math.ceil(self.fixed + old + new)

    def thinning_bytes(self, rows: int, new_rows: int, shape: tuple[int, ...]) -> int:
        """Most that is held while a level of (nx, ny, nz) goes from `rows` to `new_rows` and keeps its moments."""
        both = (self.field_row + self.moment_row) * (rows + new_rows)
        return math.ceil(self.fixed + both + (2 * self.node + 2 * _MASK) * math.prod(shape))

    def look_bytes(self, rows: int, shape: tuple[int, ...], children: int, new_shape: tuple[int, ...]) -> int:
        """Most that is held while a level's children are looked at: its field, their places, densities, weights, marks
        of pictures and counts."""
        old = self.field_row * rows + (self.node + _MASK) * math.prod(shape)
        new = (_PLACE + (1 + 2 * self.shards) * _WEIGHT + 1) * children + (self.node + 3 * _MASK) * math.prod(new_shape)
        return math.ceil(self.fixed + old + new)

    def refinement(
        self, rows: int, kept: int, shape: tuple[int, ...], new_shape: tuple[int, ...], limit: int
    ) -> tuple[int, ...] | None:
        """The resolution, at most `new_shape`, to which a level of `rows` voxels, `kept` with children, can be refined
        if all of these stay. None where the refinement would not be worth its time."""
        for finer in finer_shapes(shape, new_shape):
            grown = children_count(kept, shape, finer)
            needed = max(self.level_bytes(grown, finer), self.change_bytes(rows, shape, grown, finer))
            if needed <= limit and self.countable(grown, finer):
                return finer
        return None


def finer_shapes(shape: tuple[int, ...], planned: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """Resolutions to which (nx, ny, nz) can be refined, from the planned one down to what is worth its time."""
    whole = planned[0] / shape[0]
    for factor in np.arange(whole, SMALLEST_FACTOR - 1e-9, -FACTOR_STEP):
        yield tuple(planned) if factor == whole else scaled_shape(shape, factor)


def children_count(kept: int, shape: tuple[int, ...], finer: tuple[int, ...]) -> int:
    """Voxels of a finer grid within `kept` ones of (nx, ny, nz), at most."""
    return math.ceil(kept * math.prod(finer) / math.prod(shape) * ROUNDING)


def finest(memory: FitMemory, spare: int, choice: Callable[[FitMemory], _Shape | None]) -> tuple[_Shape | None, bool]:
    """The shapes of most voxels that the memory allows, and whether they need pictures of the lowest precision.
    spare: bytes that these would give back; choice: None where no shape fits."""
    shape, finer = (choice(memory.without(size)) for size in (0, spare))
    if finer is None or (shape is not None and _voxels(finer) <= _voxels(shape)):
        return shape, False
    return finer, True


def _voxels(shape) -> float:
    return float(np.prod(shape, dtype=float))


def scaled_shape(shape: tuple[int, ...], factor: float) -> tuple[int, ...]:
    """(nx, ny, nz) times a factor, at least 2 voxels along each axis."""
    return tuple(max(2, round(n * factor)) for n in shape)


def memory_limit(max_memory: int | str | None, device: wp.Device) -> int:
    """Bytes that a fit may take: `max_memory`, or most of what is free on the device where that is None."""
    return int(FREE_SHARE * free_bytes(device)) if max_memory is None else memory_size(max_memory)


def require_image_memory(size: int, limit: int) -> None:
    """Raise ValueError, with the factor by which to shrink the images, where their `size` bytes exceed `limit`."""
    if size > limit:
        factor = math.ceil(math.sqrt(size / (IMAGE_SHARE * limit)))
        raise InputError(
            f"the images take {memory_text(size)} of device memory and the fit may take {memory_text(limit)} "
            f"(max_memory): load them with downscale={factor}, or fewer of them"
        )


def memory_text(size: float) -> str:
    """A number of bytes as people read it."""
    return f"{size / 1e9:.2f} GB" if size >= 1e8 else f"{size / 1e6:.2f} MB"
