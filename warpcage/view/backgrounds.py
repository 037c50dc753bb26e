"""The colour behind a picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..core.checks import real_array, shown
from ..core.names import BACKGROUNDS


def parse_background(background: str | ArrayLike) -> np.ndarray:
    """The colour (3,) float32 in [0, 1] of a background: the name of one (see BACKGROUNDS), or three numbers."""
    if isinstance(background, str):
        if background == "random":
            raise ValueError(
                "random backgrounds are drawn anew for every ray of a fit, where pictures have opacity: "
                "load with a colour and fit with background='random'"
            )
        if background not in BACKGROUNDS:
            raise ValueError(
                f"background {shown(background)} is not known: {', '.join(BACKGROUNDS)} or 3 numbers in [0, 1]"
            )
        background = BACKGROUNDS[background]
    colour = real_array(background, "a background that is no colour name", np.float32)
    if colour.shape != (3,) or not np.isfinite(colour).all() or colour.min() < 0 or colour.max() > 1:
        raise ValueError(f"background must be a colour name or three numbers in [0, 1], got {shown(background)}")
    return colour
