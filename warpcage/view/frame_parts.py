"""Pictures of the parts of a frame: colours, with opacity, depth, disparity, and masks in colour."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..mesh.mesh import ClosedMesh
from .camera import Camera
from .frame import Frame
from .overlay import draw_cage
from .pictures import color_disparity, disparity_range, with_opacity

#: Mask -> its colour in the picture, and what a warning says of the share that it marks.
MASKS = {
    "fold": ((0.9, 0.1, 0.1), "shows parts that are turned inside out, where a cage is bent or pushed too far (red)"),
    "reveal": ((0.1, 0.3, 0.9), "shows what a moved cage uncovered, which no camera may have seen (blue)"),
    "filled": ((0.6, 0.25, 0.85), "was uncovered and is filled by a smooth continuation, made up (violet)"),
    "outside": (
        (0.95, 0.75, 0.1),
        "may have holes, as parts of a posed cage have nothing to show: move it less there (yellow)",
    ),
}

#: A pixel counts as marked from this value on: opacity that folds or was uncovered, or number of samples lost.
MASK_LEVEL = {"fold": 0.1, "reveal": 0.1, "filled": 0.1, "outside": 1.0}


def picture(
    frame: Frame,
    kind: str,
    camera: Camera | None = None,
    cages: Sequence[ClosedMesh] = (),
    scale: tuple[float, float] | None = None,
) -> np.ndarray:
    """One part of a frame, "rgb", "alpha", "depth", "disparity" or "masks", as (h, w, 3) or (h, w) float in [0, 1].
    Edges of cages over it need the camera; `scale`: low and high disparity, None for the range of this frame."""
    if kind == "alpha":
        shown = frame.alpha
    elif kind == "disparity":
        shown = color_disparity(frame.disparity, alpha=frame.alpha, scale=scale)
    elif kind == "depth":
        low, high = disparity_range(frame.disparity) if scale is None else scale
        near, far = 1.0 / high, 1.0 / max(low, 0.05 * high)
        seen = np.where(np.isfinite(frame.depth), frame.depth, far)
        shown = frame.alpha * (1.0 - 0.85 * np.clip((seen - near) / max(far - near, 1e-12), 0.0, 1.0))
    else:
        shown = mask_picture(frame) if kind == "masks" else frame.rgb
    if not cages:
        return shown
    assert camera is not None
    if shown.ndim == 2:
        shown = np.repeat(shown[..., None], 3, axis=-1)
    shown = np.clip(shown, 0.0, 1.0).astype(np.float32)
    for cage in cages:
        shown = draw_cage(shown, camera, cage)
    return shown


def rgba_picture(frame: Frame, camera: Camera | None = None, cages: Sequence[ClosedMesh] = ()) -> np.ndarray:
    """Straight colours and opacity (h, w, 4) float32 in [0, 1] of a frame rendered on black; black for nothing seen.
    Edges of cages, drawn into it, need the camera."""
    colors = np.maximum(frame.rgb, 0.0)
    clear = np.repeat(1.0 - np.clip(frame.alpha, 0.0, 1.0)[..., None], 3, axis=-1)
    for cage in cages:
        assert camera is not None
        colors = draw_cage(colors, camera, cage)
        clear = draw_cage(clear, camera, cage, color=(0.0, 0.0, 0.0))  # what is behind, through the same lines
    alpha = 1.0 - clear[..., :1]
    return with_opacity(colors, alpha)


def mask_values(frame: Frame, name: str) -> np.ndarray | None:
    """(h, w) values of a mask; for "reveal" only where something may be missing."""
    return frame.missing if name == "reveal" else getattr(frame, name)


def mask_picture(frame: Frame) -> np.ndarray:
    """(h, w, 3) float32, the frame in grey with its masks in colour over it."""
    shown = np.repeat(0.35 + 0.65 * frame.rgb.mean(axis=-1, keepdims=True), 3, axis=-1)
    for name, (color, _) in MASKS.items():
        values = mask_values(frame, name)
        if values is not None:
            share = 0.8 * np.clip(values / (5.0 if name == "outside" else 1.0), 0.0, 1.0)[..., None]
            shown = (1.0 - share) * shown + share * np.array(color)
    return shown.astype(np.float32)


def mask_shares(frame: Frame) -> dict[str, float]:
    """Share of the pixels that each mask marks. The frame of a field that is not deformed has no masks."""
    return {
        name: float((values >= MASK_LEVEL[name]).mean())
        for name, values in ((name, mask_values(frame, name)) for name in MASKS)
        if values is not None
    }


def disparity_scale(frames: Sequence[Frame]) -> tuple[float, float]:
    """Low and high disparity for the frames of a film, such that a few outliers do not matter."""
    # faint pixels have a disparity too, which must not count
    return disparity_range(np.stack([np.where(frame.alpha > 0.5, frame.disparity, 0.0) for frame in frames]))
