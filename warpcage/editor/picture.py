"""What is sent of a frame: a JPEG, and a few depths that tell which parts of the cage are hidden."""

from __future__ import annotations

import dataclasses
import json
import struct
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import empty_array
from ..core.devices import launch
from ..core.locks import device_turn
from ..kernels.view import preview
from ..view.camera import Camera
from ..view.frame import Frame
from ..view.frame_parts import picture

#: The first number of a frame's message; see `packed_frame`.
FRAME = 10

#: Depths along the longest side of a picture, while the hand moves and when it rests.
DEPTHS_MOVING, DEPTHS_SHARP = 64, 128

#: Pixels of less opacity hide nothing.
HIDING_ALPHA = 0.5


@dataclasses.dataclass(frozen=True)
class Pixels:
    """A frame on the host, as it is sent."""

    colours: np.ndarray  # (h, w, 3) uint8
    depths: np.ndarray  # (rows, columns) uint16, see kernels/view/preview.py
    near: float  # distances that the depths 1 and 65535 stand for, world units
    far: float


def depth_size(width: int, height: int, depths: int) -> tuple[int, int]:
    """Columns and rows of depths for a picture, of which the longest side has at most `depths`."""
    share = min(1.0, depths / max(width, height))
    return max(1, round(width * share)), max(1, round(height * share))


def frame_pixels(frame: Frame, show: str, near: float, far: float, columns: int, rows: int) -> Pixels:
    """What is sent of a frame, whose arrays are on a device: `show` is one of SHOWN.
    `near` and `far`: distances that the depths 1 and 65535 stand for, world units."""
    rgb = frame.arrays["rgb"]
    width, height = frame.width, frame.height
    with device_turn(rgb.device):
        sampled = empty_array(rows * columns, wp.uint16, rgb.device)
        inputs = [width, height, columns, rows, HIDING_ALPHA, near, far, frame.arrays["alpha"], frame.arrays["depth"]]
        launch(preview.sample_depths, rows * columns, inputs, [sampled], device=rgb.device)
        if show == "rgb":
            packed = empty_array((width * height, 3), wp.uint8, rgb.device)
            launch(preview.pack_colours, width * height, [rgb], [packed], device=rgb.device)
            colours = packed.numpy().reshape(height, width, 3)
        else:
            shown = picture(frame, "rgb" if show == "masks" and frame.reveal is None else show)
            shown = np.repeat(shown[..., None], 3, axis=-1) if shown.ndim == 2 else shown
            colours = (np.clip(shown, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
        return Pixels(np.ascontiguousarray(colours), sampled.numpy().reshape(rows, columns), near, far)


def joined_pixels(bands: list[Pixels]) -> Pixels:
    """Bands of one picture, from the top, as one."""
    colours, depths = (np.concatenate([getattr(band, name) for band in bands]) for name in ("colours", "depths"))
    return Pixels(colours, depths, bands[0].near, bands[0].far)


def band_camera(camera: Camera, first: int, last: int) -> Camera:
    """The camera of some rows of a picture, of which `last` is the first that is left out."""
    return dataclasses.replace(camera, cy=camera.cy - first, height=last - first)


def packed_frame(header: dict[str, Any], pixels: Pixels | None, quality: int) -> bytes:
    """A frame's message: four little-endian uint32 (FRAME, bytes of the header, of the JPEG, of the depths), then those
    three. Each but the last is padded to a multiple of 8. pixels None: there is only something to say."""
    import simplejpeg

    jpeg, depths = b"", b""
    if pixels is not None:
        sampling = "444" if quality >= 90 else "420"  # from 90 on colours keep their full resolution
        jpeg = simplejpeg.encode_jpeg(pixels.colours, quality=quality, colorspace="RGB", colorsubsampling=sampling)
        depths = pixels.depths.astype("<u2").tobytes()
    words = json.dumps(header, allow_nan=False).encode()
    parts = [struct.pack("<4I", FRAME, len(words), len(jpeg), len(depths))]
    parts += [words, b" " * (-len(words) % 8), jpeg, b"\0" * (-len(jpeg) % 8), depths]
    return b"".join(parts)
