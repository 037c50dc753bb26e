"""Models of thin rods: a chair, and a wire globe on a lattice mast."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .solids import Model, Part, box, centred, cylinder, joined


def chair_model() -> Model:
    """A chair of rods: legs of 0.05 units, a back of spindles half as thick, a slatted seat; 2 units high, z up.
    Every part is a closed surface, counterclockwise seen from outside; parts overlap."""
    vertices, faces, colours = joined(_chair_parts())
    return centred(vertices), faces, colours


def _chair_parts() -> Iterator[Part]:
    red, blue, green, white, dark = (
        (0.78, 0.16, 0.12),
        (0.12, 0.34, 0.72),
        (0.16, 0.52, 0.28),
        (0.90, 0.88, 0.82),
        (0.20, 0.20, 0.22),
    )
    for x in (-0.42, 0.42):
        for y in (-0.42, 0.42):
            yield cylinder((1.12 * x, 1.12 * y, 0.0), (x, y, 0.95), 0.045, red, segments=16)
            yield cylinder((1.13 * x, 1.13 * y, -0.02), (1.13 * x, 1.13 * y, 0.04), 0.06, dark, segments=16)
    for z, shrink in ((0.35, 1.08), (0.55, 1.05)):  # rungs
        reach = 0.42 * shrink
        for side in (-reach, reach):
            yield cylinder((-reach, side, z), (reach, side, z), 0.022, blue, segments=12)
            yield cylinder((side, -reach, z + 0.08), (side, reach, z + 0.08), 0.022, blue, segments=12)
    for y in np.linspace(-0.44, 0.44, 9):  # slats of the seat
        yield box((-0.5, y - 0.038, 0.93), (0.5, y + 0.038, 0.98), white)
    for x in (-0.4, 0.4):
        yield box((x - 0.05, -0.47, 0.89), (x + 0.05, 0.47, 0.93), white)
    for y in (-0.44, 0.44):  # the back, leaning
        yield cylinder((-0.42, y, 0.93), (-0.62, y, 2.0), 0.042, red, segments=16)
    for y in np.linspace(-0.33, 0.33, 7):
        yield cylinder((-0.43, y, 0.96), (-0.6, y, 1.9), 0.02, green, segments=12)
    for z, x in ((1.45, -0.517), (1.88, -0.598)):
        yield cylinder((x, -0.46, z), (x, 0.46, z), 0.03, blue, segments=14)


def globe_model() -> Model:
    """A wire globe on a lattice mast, its rods a fiftieth of the model thick. Returns what `chair_model` does."""
    parts, rod = [], 0.02
    turn = 2 * np.pi * np.arange(28) / 28

    def ring(points, colour):
        for start, end in zip(points, np.roll(points, -1, axis=0), strict=True):
            parts.append(cylinder(start, end, rod, colour, segments=8))

    globe = np.array([0.0, 0.0, 0.35])
    for tilt, colour in ((0, (0.8, 0.15, 0.1)), (60, (0.1, 0.3, 0.75)), (120, (0.15, 0.55, 0.25))):
        c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
        ring(globe + 0.62 * np.stack([c * np.cos(turn), s * np.cos(turn), np.sin(turn)], axis=1), colour)
    ring(globe + 0.62 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1), (0.9, 0.7, 0.1))
    feet = np.array([[0.3, 0.3], [-0.3, 0.3], [-0.3, -0.3], [0.3, -0.3]])
    levels = ((-0.95, 1.0), (-0.6, 0.7), (-0.27, 0.3))
    for (low, wide), (high, narrow) in zip(levels, levels[1:], strict=False):
        for i in range(4):
            foot, head = np.append(wide * feet[i], low), np.append(narrow * feet[i], high)
            across = np.append(narrow * feet[(i + 1) % 4], high)
            for end in (head, across):
                parts.append(cylinder(foot, end, rod, (0.25, 0.25, 0.28), segments=8))
            parts.append(cylinder(head, across, rod, (0.25, 0.25, 0.28), segments=8))
    parts.append(box((-0.4, -0.4, -1.0), (0.4, 0.4, -0.95), (0.5, 0.48, 0.45)))
    return joined(parts)
