"""Pictures of a frame other than its colours, and what its masks warn of."""

from __future__ import annotations

import sys

from ..view.overlay import draw_cage
from ..view.pictures import colour_disparity, disparity_range

KINDS = ("rgb", "alpha", "depth", "disparity", "masks")

#: Mask -> its colour in the picture, and what it says of a share of the picture.
MASKS = {
    "fold": ((0.9, 0.1, 0.1), "folds over (the map turns inside out; red)"),
    "reveal": ((0.1, 0.3, 0.9), "shows what a moved cage uncovered, which no camera may have seen (blue)"),
    "outside": ((0.95, 0.75, 0.1), "lost samples that the map sends out of the rest cage (yellow)"),
}

#: A pixel counts from here on: opacity that folds or was uncovered, or samples lost.
MASK_LEVEL = {"fold": 0.1, "reveal": 0.1, "outside": 1.0}


def picture(frame, kind: str, camera=None, cage=None, scale=None):
    """(h, w, 3) or (h, w) of one kind; with the edges of a cage over it where one is given.

    scale: (low, high) disparities of depth and disparity pictures; None takes this frame's.
    """
    import numpy as np

    if kind == "alpha":
        shown = frame.alpha
    elif kind == "disparity":
        shown = colour_disparity(frame.disparity, alpha=frame.alpha, scale=scale)
    elif kind == "depth":
        low, high = disparity_range(frame.disparity) if scale is None else scale
        near, far = 1.0 / high, 1.0 / max(low, 0.05 * high)
        seen = np.where(np.isfinite(frame.depth), frame.depth, far)
        shown = frame.alpha * (1.0 - 0.85 * np.clip((seen - near) / max(far - near, 1e-12), 0.0, 1.0))
    else:
        shown = mask_picture(frame) if kind == "masks" else frame.rgb
    if cage is None:
        return shown
    if shown.ndim == 2:
        shown = np.repeat(shown[..., None], 3, axis=-1)
    return draw_cage(np.clip(shown, 0.0, 1.0).astype(np.float32), camera, cage)


def mask_picture(frame):
    """(h, w, 3) the frame in grey, with its masks in colour over it."""
    import numpy as np

    shown = np.repeat(0.35 + 0.65 * frame.rgb.mean(axis=-1, keepdims=True), 3, axis=-1)
    for name, (colour, _) in MASKS.items():
        values = getattr(frame, name)
        if values is not None:
            share = 0.8 * np.clip(values / (5.0 if name == "outside" else 1.0), 0.0, 1.0)[..., None]
            shown = (1.0 - share) * shown + share * np.array(colour)
    return shown.astype(np.float32)


def mask_shares(frame) -> dict[str, float]:
    """Share of the picture's pixels that each mask marks; a plain field's frame has none."""
    return {
        name: float((values >= MASK_LEVEL[name]).mean())
        for name, values in ((name, getattr(frame, name)) for name in MASKS)
        if values is not None
    }


def warn_of_masks(shares: dict[str, float], where: str = "the picture") -> None:
    """A line on stderr for each mask that marks anything."""
    for name, share in shares.items():
        if share > 0:
            print(f"warpcage: warning: {100 * share:.2f} % of {where} {MASKS[name][1]}", file=sys.stderr)


def disparity_scale(frames) -> tuple[float, float]:
    """One scale for several frames of a film that a few wild pixels do not spoil."""
    import numpy as np

    # what is hardly there has a depth too, and no say
    return disparity_range(np.stack([np.where(frame.alpha > 0.5, frame.disparity, 0.0) for frame in frames]))
