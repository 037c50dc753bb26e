"""Bricks of nodes of a grid whose colours are in a texture, so that what holds nothing takes no memory."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from ..core.arrays import empty_array
from ..core.devices import HALF_TEXEL_BYTES, MAX_TEXELS, half_texture, launch
from ..core.threads import owner_lock
from ..kernels.core.texels import clear_half_texels
from ..kernels.field.outer_bricks import ACROSS_BITS, BRICK_CELLS, BRICK_NODES, mark_row_bricks
from ..kernels.render.volume import COLOR_LAYERS

LAYERS = int(COLOR_LAYERS)  #: of a posed frame's colours

#: Texels of a brick, and bricks along a side of a slab of a texture, which is one brick deep.
BRICK_TEXELS = int(BRICK_NODES) ** 3
ACROSS = 1 << int(ACROSS_BITS)


def brick_counts(node_counts: Sequence[int]) -> tuple[int, ...]:
    """Bricks along each axis of a grid."""
    return tuple(max(1, -(-(n - 1) // int(BRICK_CELLS))) for n in node_counts)


def texture_shape(count: int) -> tuple[int, int, int]:
    """Texels (depth, height, width) of a texture of bricks."""
    slabs, rows, width = -(-count // ACROSS**2), min(-(-count // ACROSS), ACROSS), min(count, ACROSS)
    return int(BRICK_NODES) * slabs, int(BRICK_NODES) * rows, int(BRICK_NODES) * width


def texture_bytes(count: int) -> float:
    """Bytes of a texture of bricks; infinite where CUDA has none so large."""
    shape = texture_shape(count)
    return HALF_TEXEL_BYTES * math.prod(shape) if max(shape) <= MAX_TEXELS else math.inf


class ColorBricks:
    """The bricks of a field's grid in which frames keep colours, by layer: those that any frame asked for."""

    def __init__(self, node_counts: Sequence[int], nodes: wp.array):
        self.device, self.count = wp.get_device(nodes.device), 0
        self._lock = owner_lock(self.device)  # threads may share a field
        self._node_counts, self._nodes = node_counts, nodes  # of the grid; (rows,) int32 flat index of each row's node
        # (layers, bricks along each axis) int32 number of each brick, -1 for those without
        self.numbers = wp.full((LAYERS, *brick_counts(node_counts)), -1, dtype=wp.int32, device=self.device)

    @functools.cached_property
    def most_bytes(self) -> float:
        """Bytes of a texture of all that holds anything in all layers; infinite where CUDA has none so large."""
        marks, (_, ny, nz) = self.new_marks(), self._node_counts
        launch(mark_row_bricks, self._nodes.size, [self._nodes, ny, nz], [marks], device=self.device)
        return texture_bytes(LAYERS * int(marks.numpy().sum()))

    def new_marks(self) -> wp.array:
        """(layers, bricks along each axis) int32 zeros, for `add`."""
        return wp.zeros(self.numbers.shape, dtype=wp.int32, device=self.device)

    def add(self, marks: wp.array) -> None:
        """Let the marked bricks have numbers: those that have one keep theirs."""
        with self._lock:
            numbers = self.numbers.numpy().copy()
            new = (marks.numpy() != 0) & (numbers < 0)
            if not new.any():
                return
            first, self.count = self.count, self.count + int(new.sum())
            numbers[new] = np.arange(first, self.count)
            self.numbers = wp.array(numbers, dtype=wp.int32, device=self.device)
            if self.device.is_cuda:  # frames of other streams may be the next to read them
                wp.synchronize_stream(self.device.stream)

    def new_texture(self) -> wp.Texture3D:
        """A texture of all numbered bricks, on CUDA, of 0."""
        depth, height, width = shape = texture_shape(max(self.count, 1))
        texture = half_texture(shape, self.device)
        slab = int(BRICK_NODES)
        for begin in range(0, depth, slab):  # one by one, as all together may be more than an index counts
            inputs = [wp.uint64(texture.cuda_surface), width, height, begin]
            launch(clear_half_texels, slab * height * width, inputs, device=self.device)
        return texture

    def new_colors(self) -> wp.array:
        """(numbered bricks * their nodes,) vec4 zeros, on a CPU."""
        colors = empty_array(self.count * BRICK_TEXELS, wp.vec4, self.device)
        colors.zero_()
        return colors
