"""Filling of background that no picture showed, by a smooth continuation of its surroundings."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from ..core.checks import require_type
from ..errors import InputError
from ..field.surroundings import LayeredBackground, OuterField
from ..field.voxel_field import VoxelField
from ..view.camera import Camera
from ..view.frame import Frame

#: A pixel is uncovered where it lost this much opacity, and shows background below this opacity.
UNCOVERED, CLEAR = 0.05, 0.5

#: Pixels between what the object hides and what counts as seen: edges are mixed.
RIM = 2

#: How far pictures are smoothed before they are continued, and the edge of the filled part, as shares of the width.
SMOOTHED, FEATHERED = 0.01, 0.005

#: Sweeps of relaxation at each size of the picture.
SWEEPS = 30


def fill_unseen(frame: Frame, field: VoxelField, camera: Camera) -> Frame:
    """A deformed frame in which the background that an edit uncovers goes on from what surrounds it.

    What was fitted behind an object is coloured fog where the object hid it from all cameras. There the picture takes
    the harmonic function (a membrane) that continues the background around it, so that ground, say, is even and no
    edge shows. `Frame.filled` marks it. Matter is left as it is, seen or not.

    Source: the membrane of Perez, Gangnet and Blake, "Poisson Image Editing" (SIGGRAPH 2003), without a source image,
    on a pyramid of pictures.

    Args:
        frame: A frame that a Deformer rendered before the field's own background.
        field: The field.
        camera: The camera of the frame.

    Returns:
        A frame with the mask `filled`, its colours NumPy. The mask is zero where nothing was uncovered, no background
        shows around, or the field has none but one colour.

    Raises:
        ValueError: For a frame without masks, or a camera of another size.
    """
    require_type(frame, Frame, "fill_unseen needs")
    if frame.reveal is None:
        raise InputError("fill_unseen needs a frame that a Deformer rendered: this one has no masks")
    if (camera.width, camera.height) != (frame.width, frame.height):
        raise InputError(f"the camera is {camera.width}x{camera.height}, the frame {frame.width}x{frame.height}")
    rgb, share = frame.rgb, np.zeros(frame.alpha.shape, np.float32)
    if frame.layered and field.background_model is not None:
        # of the background: where the object of the pictures is not any more. The reveal mask leaves out what an empty
        # part of a moved cage took the place of
        at_rest = field.render(camera).alpha
        uncovered = at_rest - frame.alpha > UNCOVERED
        known = ~grown(at_rest > UNCOVERED, RIM) & (frame.alpha < CLEAR)
        if uncovered.any() and known.any():
            behind = background_picture(field.background_model, camera)
            new = membrane(smoothed(behind, known, SMOOTHED * frame.width), known)
            share = feathered(grown(uncovered, RIM), FEATHERED * frame.width) * (1.0 - frame.alpha)
            rgb = rgb + share[..., None] * (new - behind)
    masks = {name: array for name, array in frame.arrays.items() if name not in ("rgb", "alpha", "depth", "filled")}
    arrays = frame.arrays
    filled = Frame(
        frame.width, frame.height, rgb.astype(np.float32), arrays["alpha"], arrays["depth"], filled=share, **masks
    )
    return filled.like(frame)


def background_picture(layers: LayeredBackground | OuterField, camera: Camera) -> np.ndarray:
    """(h, w, 3) float32, what a camera sees of the background alone."""
    count, device = camera.width * camera.height, layers.device
    rgb = wp.zeros(count, dtype=wp.vec3, device=device)
    nothing, nowhere = (wp.full(count, value, dtype=wp.float32, device=device) for value in (0.0, math.inf))
    layers.add_around(camera, rgb, nothing, nowhere)
    return rgb.numpy().reshape(camera.height, camera.width, 3)


def membrane(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The harmonic continuation (h, w, c) float64, coarse to fine, of values (h, w, c) from where they are known.
    known: (h, w), at least one. The border of the picture lets nothing through."""
    height, width = known.shape
    if known.all():
        return values.astype(np.float64)
    if max(height, width) == 1 or not known.any():
        return np.broadcast_to(values[known].mean(axis=0), values.shape).astype(np.float64)
    even = ((0, height % 2), (0, width % 2))
    weights = np.pad(known.astype(np.float64), even)
    sums = np.pad(np.where(known[..., None], values, 0.0), (*even, (0, 0)))
    quarters = [(slice(i, None, 2), slice(j, None, 2)) for i in (0, 1) for j in (0, 1)]
    count = np.sum([weights[part] for part in quarters], axis=0)
    mean = sum(sums[part] for part in quarters) / np.maximum(count, 1.0)[..., None]
    coarse = membrane(mean, count > 0.0)
    result = np.where(known[..., None], values, np.repeat(np.repeat(coarse, 2, 0), 2, 1)[:height, :width])
    for _ in range(SWEEPS):
        around = np.pad(result, ((1, 1), (1, 1), (0, 0)), mode="edge")
        mean = 0.25 * (around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:])
        result = np.where(known[..., None], values, mean)
    return result


def smoothed(values: np.ndarray, known: np.ndarray, radius: float) -> np.ndarray:
    """A picture (h, w, c) blurred within what is known, so that specks at the border of a hole grow no streaks."""
    from scipy.ndimage import gaussian_filter

    sigma = (radius, radius)
    weight = gaussian_filter(known.astype(np.float64), sigma)
    blurred = [gaussian_filter(np.where(known, channel, 0.0), sigma) for channel in np.moveaxis(values, -1, 0)]
    return np.stack(blurred, axis=-1) / np.maximum(weight, 1e-9)[..., None]


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    """A mask (h, w), wider by some pixels on all sides."""
    from scipy.ndimage import binary_dilation

    return binary_dilation(mask, iterations=pixels)


def feathered(mask: np.ndarray, radius: float) -> np.ndarray:
    """A mask (h, w) as float32 shares: 1 in it, falling to 0 over a radius in pixels outside."""
    from scipy.ndimage import distance_transform_edt

    t = np.clip(1.0 - np.asarray(distance_transform_edt(~mask)) / max(radius, 1.0), 0.0, 1.0)
    return (t * t * (3.0 - 2.0 * t)).astype(np.float32)
