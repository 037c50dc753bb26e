"""Three-dimensional textures on CUDA devices that kernels write and read (kernels/core/texels)."""

from __future__ import annotations

import warp as wp

#: Numbers of a texel, and its bytes.
CHANNELS = 4
HALF_TEXEL_BYTES = 2 * CHANNELS

#: Most texels that CUDA takes along an axis.
MOST_TEXELS = 16384


def half_texture(shape: tuple[int, int, int], device: wp.DeviceLike) -> wp.Texture3D:
    """A texture of four halves a texel, (depth, height, width) texels, on a CUDA device; its values are not set yet.
    It is asked by unnormalised coordinates, and blends texels."""
    depth, height, width = shape
    return wp.Texture3D(
        width=width,
        height=height,
        depth=depth,
        num_channels=CHANNELS,
        dtype=wp.float16,
        filter_mode=wp.TextureFilterMode.LINEAR,
        normalized_coords=False,
        surface_access=True,
        device=device,
    )
