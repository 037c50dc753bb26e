"""Three-dimensional textures on CUDA devices that kernels write and read (kernels/core/texels)."""

from __future__ import annotations

from typing import Any

import warp as wp

#: Channels of a texel.
CHANNELS = 4

#: Most texels that CUDA takes along an axis.
MOST_TEXELS = 16384


def make_texture(shape: tuple[int, int, int], dtype: Any, device: wp.DeviceLike) -> wp.Texture3D:
    """A texture of four numbers a texel, whose values are not set yet.

    It is asked by unnormalised coordinates, texel (i, j, k) of its axes from the last one on being at the middle
    (i + 0.5, j + 0.5, k + 0.5), and blends texels.

    Args:
        shape: (depth, height, width), texels along each axis, the slowest first.
        dtype: wp.float16 or wp.float32.
        device: CUDA device.

    Returns:
        The texture.
    """
    depth, height, width = shape
    return wp.Texture3D(
        width=width,
        height=height,
        depth=depth,
        num_channels=CHANNELS,
        dtype=dtype,
        filter_mode=wp.TextureFilterMode.LINEAR,
        normalized_coords=False,
        surface_access=True,
        device=device,
    )
