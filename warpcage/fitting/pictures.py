"""A scene's pictures on a device, as a fit compares with them."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..core.threads import run_parallel
from ..kernels.fitting.pictures import Pictures
from ..view.pictures import to_uint8

#: Bits a channel that pictures may be kept at, the better first. Files have 8; opacity and averaging make more of them.
PRECISIONS = (16, 8)


def picture_bytes(scene, bits: int) -> int:
    """Device memory that a scene's pictures take, with what masks split off them."""
    kinds = 1 if scene.surroundings is None else 2
    return kinds * scene.images.size // 3 * 4 * bits // 8


class TrainingPictures:
    """The pictures of a scene at `bits` a channel, and what masks split off them.

    seen: Pictures, premultiplied colours and opacity. surroundings: Pictures, colours times their share, and the share;
    None for a scene that is not split. At 8 bits numbers are rounded to the nearest of 0 to 1 in 255 steps.
    """

    def __init__(self, scene, bits: int, device):
        self.scene, self.device = scene, device
        self.keep(bits)

    def keep(self, bits: int) -> None:
        """Upload them at another precision; the arrays before are let go first, where nothing else holds them."""
        self.seen = self.surroundings = None
        self.bits = bits
        scene = self.scene
        alphas = np.ones(scene.images.shape[:3], np.float32) if scene.alphas is None else scene.alphas
        self.seen = self._uploaded(scene.images, alphas, -scene.background)
        if scene.surroundings is not None:
            self.surroundings = self._uploaded(scene.surroundings, 1.0 - scene.alphas, np.zeros(3, np.float32))

    def _uploaded(self, images, shares, behind) -> Pictures:
        """colours + (1 - share) * behind, and share, of each pixel."""
        pixels = np.empty((*images.shape[:3], 4), np.float16 if self.bits == 16 else np.uint8)

        def pack(target, image, share) -> None:
            values = np.concatenate([image + (1.0 - share[..., None]) * behind, share[..., None]], axis=-1)
            target[...] = values if self.bits == 16 else to_uint8(values)

        run_parallel([lambda parts=parts: pack(*parts) for parts in zip(pixels, images, shares, strict=True)])
        pictures = Pictures()
        if self.bits == 16:
            pictures.halves = wp.array(pixels, dtype=wp.vec4h, device=self.device)
        else:
            pictures.bytes = wp.array(pixels, dtype=wp.vec4ub, device=self.device)
        return pictures

    @property
    def spare_bytes(self) -> int:
        """Device memory that the lowest precision would give back."""
        return picture_bytes(self.scene, self.bits) - picture_bytes(self.scene, PRECISIONS[-1])
