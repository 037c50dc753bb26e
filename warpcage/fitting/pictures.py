"""A scene's pictures on a device, as a fit compares with them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from ..core.threads import run_parallel
from ..kernels.fitting.pictures import Pictures
from ..scene.scene import Scene
from ..view.pictures import to_uint8
from .memory import require_image_memory

#: Bits per channel that pictures may be kept at, the better first. Files have 8; opacity and averaging need more.
PRECISIONS = (16, 8)


def picture_bytes(scene: Scene, bits: int) -> int:
    """Device memory of a scene's pictures, and what masks split off them, at so many bits for each of four channels."""
    kinds = 1 if scene.surroundings is None else 2
    return kinds * scene.images.size // 3 * 4 * bits // 8


def chosen_bits(scene: Scene, held: int, limit: int) -> int:
    """The best of PRECISIONS for a scene's pictures that fits, beside `held` bytes, into `limit` bytes."""
    needed = {bits: held + picture_bytes(scene, bits) for bits in PRECISIONS}
    require_image_memory(needed[PRECISIONS[-1]], limit)
    return next(bits for bits in PRECISIONS if needed[bits] <= limit)


class TrainingPictures:
    """The pictures of a scene on a device, and what masks split off them; bits: per channel, one of PRECISIONS."""

    # At 8 bits numbers are rounded to the nearest of 0 to 1 in 255 steps.

    def __init__(self, scene: Scene, bits: int, device: wp.Device):
        self.scene, self.device, self.bits = scene, device, bits
        # premultiplied colours and opacity
        self.seen: Any = None
        # colours that masks split off times their share, and the share; None for a scene that is not split
        self.surroundings: Any = None
        self.keep(bits)

    def keep(self, bits: int) -> None:
        """Upload them at another precision, bits per channel."""
        # frees the arrays before first, where nothing else holds them
        self.seen = self.surroundings = None
        self.bits = bits
        scene = self.scene
        opacity = np.ones(scene.images.shape[:3], np.float32) if scene.alphas is None else scene.alphas
        self.seen = _uploaded(scene.images, opacity, -scene.background, bits, self.device)
        if scene.surroundings is not None:
            self.surroundings = _uploaded(scene.surroundings, 1.0 - opacity, np.zeros(3, np.float32), bits, self.device)

    @property
    def held_bytes(self) -> int:
        """Device memory of the pictures."""
        return picture_bytes(self.scene, self.bits)

    @property
    def spare_bytes(self) -> int:
        """Device memory that the lowest precision would give back."""
        return self.held_bytes - picture_bytes(self.scene, PRECISIONS[-1])


def _uploaded(images: np.ndarray, shares: np.ndarray, behind: np.ndarray, bits: int, device: wp.Device) -> Any:
    """Pictures of each pixel's colour + (1 - share) * behind, and of its share."""
    pixels = np.empty((*images.shape[:3], 4), np.float16 if bits == 16 else np.uint8)

    def pack(target: np.ndarray, image: np.ndarray, share: np.ndarray) -> None:
        values = np.concatenate([image + (1.0 - share[..., None]) * behind, share[..., None]], axis=-1)
        target[...] = values if bits == 16 else to_uint8(values)

    run_parallel([lambda view=view: pack(pixels[view], images[view], shares[view]) for view in range(len(pixels))])
    pictures: Any = Pictures()
    if bits == 16:
        pictures.halves = wp.array(pixels, dtype=wp.vec4h, device=device)
    else:
        pictures.bytes = wp.array(pixels, dtype=wp.vec4ub, device=device)
    return pictures
