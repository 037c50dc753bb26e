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
from ..kernels.render.volume import COLOR_LAYERS, PAGE_BEGIN

#: Bits of the float 2^23.
FLOAT_BITS = 0x4B000000

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
        self.device, self.count = wp.get_device(nodes.device), 1  # the first one is empty
        self._lock = owner_lock(self.device)  # threads may share a field
        self._node_counts, self._nodes = node_counts, nodes  # of the grid; (rows,) int32 flat index of each row's node
        # (layers, bricks along each axis) int32 number of each brick; and vec2i, see ShadedVolume
        numbers = np.zeros((LAYERS, *brick_counts(node_counts)), np.int32)
        self.numbers, self.pages = self._on_device(numbers)
        # a GPU adds bits of 2^23 + x instead of x
        self.first_page = FLOAT_BITS * (1 + numbers.shape[3] * (1 + numbers.shape[2])) & 0xFFFFFFFF

    @functools.cached_property
    def most_bytes(self) -> float:
        """Bytes of a texture of all that holds anything in all layers; infinite where CUDA has none so large."""
        marks, (_, ny, nz) = self.new_marks(), self._node_counts
        launch(mark_row_bricks, self._nodes.size, [self._nodes, ny, nz], [marks], device=self.device)
        fits = max(self._node_counts) <= PAGE_BEGIN
        return texture_bytes(1 + LAYERS * int(marks.numpy().sum())) if fits else math.inf

    def new_marks(self) -> wp.array:
        """(layers, bricks along each axis) int32 zeros, for `add`."""
        return wp.zeros(self.numbers.shape, dtype=wp.int32, device=self.device)

    def add(self, marks: wp.array) -> None:
        """Let the marked bricks have numbers: those that have one keep theirs."""
        with self._lock:
            numbers = self.numbers.numpy().copy()
            new = (marks.numpy() != 0) & (numbers == 0)
            if not new.any():
                return
            first, self.count = self.count, self.count + int(new.sum())
            numbers[new] = np.arange(first, self.count)
            self.numbers, self.pages = self._on_device(numbers)
            if self.device.is_cuda:  # frames of other streams may be the next to read them
                wp.synchronize_stream(self.device.stream)

    def _on_device(self, numbers: np.ndarray) -> tuple[wp.array, wp.array]:
        """Numbers of bricks, and their pages: texels of each less the nodes before it, as ShadedVolume has them."""
        last, bits = ACROSS - 1, int(ACROSS_BITS)
        texels = int(BRICK_NODES) * np.stack([numbers & last, numbers >> bits & last, numbers >> 2 * bits])
        nodes = int(BRICK_CELLS) * np.indices(numbers.shape)[:0:-1]
        x, y, z = (2 * (texels - nodes + PAGE_BEGIN) + 1).astype(np.uint32)  # half texels, to the middle of a texel
        pages = np.stack([x | y << 16, z], axis=-1).view(np.int32)
        device = self.device
        return wp.array(numbers, dtype=wp.int32, device=device), wp.array(pages, dtype=wp.vec2i, device=device)

    def new_texture(self) -> wp.Texture3D:
        """A texture of all numbered bricks, on CUDA, of 0."""
        depth, height, width = shape = texture_shape(self.count)
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
