"""The lattice that suits a picture, where nobody asks for a number of cells."""

from __future__ import annotations

import math

from ..view.camera import Camera

#: Fewest and most cells along the longest side of a cage where nobody asks for a number of them, and pixels for each:
#: a lattice of 64 cells is 72 dB from a fine one in pictures of any size (docs/measurements.md).
FEWEST_CELLS, MOST_CELLS, PIXELS_PER_CELL = 64, 128, 5


def picture_cells(camera: Camera) -> int:
    """Cells along the longest side of a cage that suit a camera's picture, a multiple of 16."""
    cells = 16 * math.ceil(max(camera.width, camera.height) / (16 * PIXELS_PER_CELL))
    return min(max(cells, FEWEST_CELLS), MOST_CELLS)
