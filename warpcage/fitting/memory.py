"""How much memory a fit takes, before it takes it."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np
import warp as wp

from ..core.memory import free_bytes

#: Share of what is free that a fit takes where nothing is said.
FREE_SHARE = 0.9

#: A level is refined in steps of this factor of its resolution; below the smallest it is not worth its time.
FACTOR_STEP, SMALLEST_FACTOR = 1.0 / 16.0, 1.125

#: Voxels along the longest side under which a first level says nothing.
SMALLEST_LEVEL = 8

#: Where the factor is no whole number, a voxel may become a few more than its cube, or less.
ROUNDING = 1.05

#: Bytes of a node in a mask, and of a row's weight while a level is pruned.
_MASK, _WEIGHT = 1, 4
_UNITS = {
    "": 1,
    "b": 1,
    **{
        f"{prefix}{ending}": base**power
        for ending, base in (("b", 1000), ("ib", 1024))
        for power, prefix in enumerate(("k", "m", "g", "t"), start=1)
    },
}


def memory_size(size) -> int:
    """Bytes of a number of bytes, or of text such as "4GB" (10^9) or "512 MiB" (2^20).

    Raises ValueError for anything else, and for sizes that are not positive.
    """
    value = math.nan
    if isinstance(size, str):
        match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*([a-zA-Z]*)\s*", size)
        if match and match[2].lower() in _UNITS:
            value = float(match[1]) * _UNITS[match[2].lower()]
    elif isinstance(size, (int, float, np.integer, np.floating)) and not isinstance(size, bool):
        value = float(size)
    if not (value >= 1 and math.isfinite(value)):
        raise ValueError(f"a memory size is a number of bytes or text such as '4GB' or '512MiB', got {size!r}")
    return int(value)


def device_arrays(*things) -> list[wp.array]:
    """Each Warp array once that objects hold: in their attributes, lists, dictionaries and Warp structs."""
    found, visited, waiting = {}, set(), list(things)
    while waiting:
        thing = waiting.pop()
        if id(thing) in visited:
            continue
        visited.add(id(thing))
        if isinstance(thing, wp.array):
            if thing.ptr:
                found[thing.ptr] = thing
        elif isinstance(thing, dict):
            waiting += thing.values()
        elif isinstance(thing, (list, tuple)):
            waiting += thing
        elif hasattr(thing, "_cls") and hasattr(thing._cls, "vars"):  # a Warp struct
            waiting += [getattr(thing, name) for name in thing._cls.vars]
        elif type(thing).__module__.startswith("warpcage"):
            waiting += [value for name, value in vars(thing).items() if name != "scene"]
    return list(found.values())


def array_bytes(arrays) -> int:
    return sum(array.capacity for array in arrays)


@dataclasses.dataclass(frozen=True)
class FitMemory:
    """Bytes that a FieldOptimizer's arrays take, by what they grow with; read off the arrays that it holds.

    fixed: images and whatever else does not depend on the grid. node: for each node of the box. field_node: the part of
    it that is the field's. row, field_row: for each voxel that holds values. shards: copies of the weights while it
    prunes. tiles: one number for each tile of the images.
    """

    fixed: int
    node: float
    field_node: float
    row: float
    field_row: float
    shards: int
    tiles: int

    @classmethod
    def of(cls, optimizer) -> FitMemory:
        """Measured on an optimiser that holds a level."""
        rows, shape = optimizer.field.voxel_count, optimizer.field.resolution
        nodes = math.prod(shape)
        totals = {"fixed": 0, "node": 0, "row": 0}
        field_totals = dict(totals)
        field_pointers = {array.ptr for array in device_arrays(optimizer.field, optimizer.nodes)}
        for array in device_arrays(optimizer):
            kind = _growth(array, rows, shape)
            totals[kind] += array.capacity
            if array.ptr in field_pointers:
                field_totals[kind] += array.capacity
        tiles = 4 * optimizer.tile_total
        fixed = totals["fixed"] + (tiles if optimizer.rays.tiles is None else 0)  # there will be
        return cls(
            fixed,
            totals["node"] / nodes,
            field_totals["node"] / nodes,
            totals["row"] / rows,
            field_totals["row"] / rows,
            optimizer.shards,
            tiles,
        )

    def without(self, size: int) -> FitMemory:
        """As it were with so many bytes less of what does not depend on the grid."""
        return dataclasses.replace(self, fixed=self.fixed - size)

    def first_shapes(self, shapes, rows: int, limit: int) -> list | None:
        """The levels' shapes, made coarser where the first, of `rows`, would not fit into `limit` bytes; None where
        nothing worth the name would."""
        needed = self.level_bytes(rows, shapes[0])
        if needed <= limit:
            return list(shapes)
        factor = 0.9 * max((limit - self.fixed) / (needed - self.fixed), 0.0) ** (1 / 3)
        coarser = [scaled_shape(shape, factor) for shape in shapes]
        return None if max(coarser[0]) < SMALLEST_LEVEL else coarser

    def refuse(self, rows: int, shape, limit: int) -> None:
        """Raise the ValueError of a first level that does not fit."""
        raise ValueError(
            f"a fit within {_text(limit)} (max_memory) is not possible: the images take "
            f"{_text(self.fixed)}, the coarsest level {_text(self.level_bytes(rows, shape) - self.fixed)}"
        )

    def level_bytes(self, rows: int, shape) -> int:
        """At most what a level takes while its tiles are found, and while it is optimised and pruned."""
        nodes = math.prod(shape)
        pruning = 2 * _MASK * nodes + _WEIGHT * self.shards * rows
        return math.ceil(self.fixed + self.node * nodes + self.row * rows + max(pruning, 2 * self.tiles))

    def change_bytes(self, rows: int, shape, new_rows: int, new_shape) -> int:
        """At most what is held while a finer field takes another's place: both, and the masks between them."""
        nodes, new_nodes = math.prod(shape), math.prod(new_shape)
        old = self.field_row * rows + (self.field_node + _MASK) * nodes
        new = self.field_row * new_rows + (self.field_node + 2 * _MASK) * new_nodes
        return math.ceil(self.fixed + old + new)

    def thinning_bytes(self, rows: int, new_rows: int, shape, moment_row: float) -> int:
        """At most what is held while rows go and the optimiser's moments, of `moment_row` bytes each, stay."""
        both = (self.field_row + moment_row) * (rows + new_rows)
        return math.ceil(self.fixed + both + (2 * self.node + 2 * _MASK) * math.prod(shape))

    def refinement(self, rows: int, pruned: int, shape, new_shape, limit: int):
        """(nx, ny, nz), at most `new_shape`, to which a level of `rows` at `shape`, of which `pruned` stay, can be
        refined within `limit` bytes; None where that is not worth its time."""
        whole = new_shape[0] / shape[0]
        for factor in np.arange(whole, SMALLEST_FACTOR - 1e-9, -FACTOR_STEP):
            finer = new_shape if factor == whole else scaled_shape(shape, factor)
            grown = math.ceil(pruned * math.prod(finer) / math.prod(shape) * ROUNDING)
            needed = max(self.level_bytes(grown, finer), self.change_bytes(rows, shape, grown, finer))
            if needed <= limit:
                return tuple(finer)
        return None


def scaled_shape(shape, factor: float) -> tuple[int, ...]:
    return tuple(max(2, round(n * factor)) for n in shape)


def memory_limit(max_memory: int | None, device) -> int:
    """Bytes that a fit may take: as asked, else most of what is free."""
    return int(FREE_SHARE * free_bytes(device)) if max_memory is None else max_memory


def require_image_memory(size: int, limit: int) -> None:
    """Raise ValueError where the images alone do not fit, with the factor by which to shrink them."""
    if size > limit:
        factor = math.ceil(math.sqrt(size / (0.5 * limit)))
        raise ValueError(
            f"the images take {_text(size)} of device memory and the fit may take {_text(limit)} "
            f"(max_memory): load them with downscale={factor}, or fewer of them"
        )


def _text(size: float) -> str:
    return f"{size / 1e9:.2f} GB" if size >= 1e8 else f"{size / 1e6:.2f} MB"


def _growth(array: wp.array, rows: int, shape) -> str:
    """Whether an array grows with the nodes of the box, the rows of the field, or with neither."""
    if array.ndim == 3 and all(0 <= n - m <= 1 for n, m in zip(shape, array.shape, strict=True)):
        return "node"
    return "row" if array.ndim and array.shape[0] == rows else "fixed"
