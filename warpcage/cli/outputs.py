"""Pictures of the parts of a frame, and warnings about what its masks mark."""

from __future__ import annotations

import sys

from ..view.frame_parts import MASKS
from ..view.frame_parts import disparity_scale as disparity_scale
from ..view.frame_parts import mask_shares as mask_shares
from ..view.frame_parts import picture as picture


def warn_of_masks(shares: dict[str, float], where: str = "the picture") -> None:
    """Print a line on stderr for each mask that marks anything; where: how the line calls the picture."""
    for name, share in shares.items():
        if share > 0:
            print(f"warpcage: warning: {100 * share:.2f} % of {where} {MASKS[name][1]}", file=sys.stderr)
