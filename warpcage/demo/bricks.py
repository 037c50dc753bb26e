"""Closed solids of one colour, and of them the brick model: an excavator, for scenes that the project makes itself."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

Color = tuple[float, float, float]

#: vertices (v, 3) float64, faces (f, 3) int, counterclockwise seen from outside, and a colour in [0, 1]
Part = tuple[np.ndarray, np.ndarray, Color]

#: vertices (v, 3) float64, faces (f, 3) int32, colours (f, 3) float32
Model = tuple[np.ndarray, np.ndarray, np.ndarray]


def box(low: ArrayLike, high: ArrayLike, color: Color) -> Part:
    """A box along the axes between two opposite corners (3,)."""
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    vertices = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * (high - low) + low
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]), color


def cylinder(start: ArrayLike, end: ArrayLike, radius: float, color: Color, *, segments: int) -> Part:
    """A closed prism over a regular polygon, its axis from start (3,) to end (3,)."""
    start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    turn = 2 * np.pi * np.arange(segments) / segments
    ring = radius * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side))
    vertices = np.concatenate([start + ring, end + ring, [start], [end]])
    i = np.arange(segments)
    j = (i + 1) % segments
    n, low, high = segments, np.full(segments, 2 * segments), np.full(segments, 2 * segments + 1)
    columns = ((i, j, j + n), (i, j + n, i + n), (low, j, i), (high, i + n, j + n))
    return vertices, np.concatenate([np.stack(column, axis=1) for column in columns]), color


def ball(center: ArrayLike, radius: float, color: Color, *, subdivisions: int = 4) -> Part:
    """A subdivided icosahedron."""
    import trimesh

    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.asarray(sphere.vertices) + center, np.asarray(sphere.faces), color


def turned(part: Part, degrees: float, offset: ArrayLike) -> Part:
    """A part turned about y (x towards z) and then moved by offset (3,)."""
    vertices, faces, color = part
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return vertices @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) + offset, faces, color


def joined(parts: Iterable[Part]) -> Model:
    """One model of all parts, which stay separate surfaces."""
    return merged([(points, faces, np.broadcast_to(color, faces.shape)) for points, faces, color in parts])


def merged(models: Sequence[Model]) -> Model:
    """One model of several, which stay separate surfaces."""
    first = np.cumsum([0] + [len(vertices) for vertices, _, _ in models])
    faces = [model[1] + begin for model, begin in zip(models, first, strict=False)]
    vertices, colors = (np.concatenate([model[n] for model in models]) for n in (0, 2))
    return vertices, np.concatenate(faces).astype(np.int32), colors.astype(np.float32)


def centered(vertices: np.ndarray) -> np.ndarray:
    """Vertices (v, 3) moved so that the middle of their bounding box is the origin."""
    return vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2


STUD = 0.17  # world units from one stud to the next
STUD_RADIUS, STUD_HEIGHT = 0.3, 0.2  # of that pitch, as on the real toy
SEAM = 0.015  # half the gap between two bricks, of that pitch
YELLOW, RED, BLUE, WHITE = (0.98, 0.74, 0.06), (0.82, 0.10, 0.08), (0.10, 0.30, 0.78), (0.93, 0.93, 0.90)
DARK, GREY, SILVER = (0.16, 0.17, 0.19), (0.42, 0.44, 0.46), (0.72, 0.74, 0.76)
GREEN, GLASS, ORANGE = (0.12, 0.55, 0.25), (0.50, 0.76, 0.90), (0.98, 0.48, 0.06)


def brick_model() -> Model:
    """An excavator built of bricks, about 2 units long, centred at the origin, z up, its arm towards +x.
    Every part is a closed surface, counterclockwise seen from outside; parts touch and overlap."""
    vertices, faces, colors = joined([*_tracks(), *_house(), *_cabin(), *_arm()])
    return centered(vertices) * STUD, faces, colors


# The model in studs: +x ahead, +y to the left, z = 0 on the ground.


def _tracks() -> Iterator[Part]:
    for side in (-1, 1):
        inner, outer = 1.7 * side, 3.2 * side
        for x in (-3.0, 3.0):
            yield cylinder((x, inner, 1.1), (x, outer, 1.1), 1.1, DARK, segments=24)
        for x in (-3.0, -1.0, 1.0, 3.0):
            radius = 0.75 if abs(x) == 3.0 else 0.6
            yield cylinder((x, outer, 1.1), (x, outer + 0.14 * side, 1.1), radius, SILVER, segments=20)
            yield cylinder((x, outer + 0.14 * side, 1.1), (x, outer + 0.26 * side, 1.1), 0.25, RED, segments=12)
        low, high = min(inner, outer), max(inner, outer)
        yield box((-3.0, low, 0.0), (3.0, high, 2.2), DARK)
        # a mudguard ties track and house together where cameras see it, so that the fitted surface is one piece too
        yield box((-2.4, low, 2.1), (2.4, high, 2.7), GREY)
        for x in np.arange(-2.75, 3.0, 0.785):
            yield box((x - 0.16, low - 0.06, 2.2), (x + 0.16, high + 0.06, 2.36), GREY)
            yield box((x - 0.16, low - 0.06, -0.16), (x + 0.16, high + 0.06, 0.0), GREY)
        for x, turns in ((3.0, (-60, -20, 20, 60)), (-3.0, (120, 160, 200, 240))):
            for turn in turns:
                cleat = box((1.1, low - 0.06, -0.16), (1.26, high + 0.06, 0.16), GREY)
                yield turned(cleat, turn, (x, 0.0, 1.1))
    yield box((-2.6, -1.7, 0.7), (2.6, 1.7, 2.0), GREY)
    yield cylinder((0.0, 0.0, 2.0), (0.0, 0.0, 2.6), 1.9, DARK, segments=28)


def _house() -> Iterator[Part]:
    z = 2.6
    # two courses of bricks with staggered seams
    for x, length in ((-4, 3), (-1, 4), (3, 1)):
        for y in (-3, -1, 1):
            yield from _brick((x, y, z), (length, 2, 1.0), YELLOW, studs=False)
    z += 1.0
    for x, length in ((-4, 2), (-2, 3), (1, 3)):
        for y in (-3, 0):
            yield from _brick((x, y, z), (length, 3, 0.5), DARK if x < 0 else YELLOW)
    z += 0.5
    # engine cover and counterweight
    yield from _brick((-4, -3, z), (2, 2, 1.1), RED, studs=False)
    yield from _brick((-4, -1, z), (2, 2, 1.1), RED, studs=False)
    yield from _brick((-4, 1, z), (2, 2, 1.1), RED, studs=False)
    yield from _brick((-4, -3, z + 1.1), (2, 3, 0.5), RED)
    yield from _brick((-4, 0, z + 1.1), (2, 3, 0.5), WHITE)
    yield from _brick((-2, -3, z), (2, 3, 0.9), GREEN)
    for y in (-2.5, -1.75, -1.0, -0.25, 0.5, 1.25, 2.0):  # louvres at the back
        yield box((-4.1, y, z + 0.2), (-4.0, y + 0.4, z + 0.9), DARK)
    yield cylinder((-1.5, -2.5, z + 0.9), (-1.5, -2.5, z + 2.6), 0.28, SILVER, segments=14)
    yield cylinder((-1.5, -2.5, z + 2.6), (-1.5, -2.5, z + 2.75), 0.36, DARK, segments=14)
    for y in (-2.4, 2.4):  # lamps
        yield cylinder((4.0, y, 3.1), (4.15, y, 3.1), 0.32, WHITE, segments=14)


def _cabin() -> Iterator[Part]:
    z = 4.1
    yield from _brick((-1, 0, z), (4, 3, 0.9), YELLOW, studs=False)
    low, high = (-0.85, 0.15, z + 0.9), (2.85, 2.85, z + 3.0)
    yield box(low, high, GLASS)
    for x in (-1.0, 0.8, 2.6):
        for y in (0.0, 2.6):
            yield box((x, y, z + 0.9), (x + 0.4, y + 0.4, z + 3.0), YELLOW)
    yield from _brick((-1, 0, z + 3.0), (4, 3, 0.45), BLUE)
    yield cylinder((-0.5, 0.5, z + 3.45), (-0.5, 0.5, z + 4.1), 0.3, ORANGE, segments=14)


def _arm() -> Iterator[Part]:
    boom_foot, elbow, wrist = np.array([2.0, -1.5, 4.4]), np.array([5.0, -1.5, 8.9]), np.array([7.4, -1.5, 4.6])
    # bracket between the house and the boom
    for y in (-2.6, -0.75):
        yield box((1.0, y, 4.1), (3.0, y + 0.35, 5.2), GREY)
    yield cylinder(boom_foot + (0, -1.2, 0), boom_foot + (0, 1.2, 0), 0.4, SILVER, segments=16)

    yield from _limb(boom_foot, elbow, 0.62, YELLOW)
    yield cylinder(elbow + (0, -1.05, 0), elbow + (0, 1.05, 0), 0.78, RED, segments=20)
    yield cylinder(elbow + (0, -1.2, 0), elbow + (0, 1.2, 0), 0.3, SILVER, segments=14)
    yield from _limb(elbow, wrist, 0.5, YELLOW)
    yield cylinder(wrist + (0, -1.0, 0), wrist + (0, 1.0, 0), 0.5, RED, segments=18)

    # pistons: house to boom, boom to stick
    for start, middle, end in (
        ((3.6, -1.5, 4.3), (3.95, -1.5, 5.3), (4.3, -1.5, 6.3)),
        ((3.2, -1.5, 7.7), (4.2, -1.5, 9.2), (5.0, -1.5, 10.0)),
    ):
        yield cylinder(start, middle, 0.34, DARK, segments=14)
        yield cylinder(middle, end, 0.2, SILVER, segments=12)
    yield cylinder((5.0, -1.5, 10.0), elbow, 0.25, GREY, segments=12)
    yield from _bucket(wrist)


def _limb(start: np.ndarray, end: np.ndarray, half: float, color: Color) -> Iterator[Part]:
    """A beam of bricks from start to end with studs along its upper side."""
    along = end - start
    length, angle = float(np.linalg.norm(along)), float(np.degrees(np.arctan2(along[2], along[0])))
    flip = -1.0 if angle < -90 or angle > 90 else 1.0
    whole = int(length)
    edge = (length - whole) / 2
    yield turned(box((0, -0.8, -half), (length, 0.8, half), color), angle, start)
    for i in range(whole):
        foot = (edge + i + 0.5, 0.0, half * flip)
        stud = cylinder(foot, (foot[0], 0.0, foot[2] + flip * 1.2 * STUD_HEIGHT), STUD_RADIUS, color, segments=12)
        yield turned(stud, angle, start)
    for y in (-0.86, 0.8):  # a dark stripe on either side
        yield turned(box((0.9, y, -0.22), (length - 0.9, y + 0.06, 0.22), DARK), angle, start)


def _bucket(wrist: np.ndarray) -> Iterator[Part]:
    turn = -155.0
    plates = [
        ((0.0, -1.7, -0.9), (0.3, 1.7, 0.9)),
        ((0.0, -1.7, -0.9), (1.9, 1.7, -0.6)),
        ((0.0, -1.7, -0.9), (1.7, -1.4, 0.9)),
        ((0.0, 1.4, -0.9), (1.7, 1.7, 0.9)),
    ]
    foot = wrist + (-0.25, 0.0, -0.35)
    for low, high in plates:
        yield turned(box(low, high, GREY), turn, foot)
    for y in (-1.6, -0.75, 0.15, 1.0):
        yield turned(box((1.9, y, -0.85), (2.4, y + 0.5, -0.65), SILVER), turn, foot)


def _brick(corner: ArrayLike, size: ArrayLike, color: Color, studs: bool = True) -> Iterator[Part]:
    """A brick of size (studs, studs, height), with studs on top unless it is to be smooth."""
    corner, size = np.asarray(corner, np.float64), np.asarray(size, np.float64)
    gap = np.array([SEAM, SEAM, 0.0])
    yield box(corner + gap, corner + size - gap, color)
    if studs:
        top = corner[2] + size[2]
        for x in corner[0] + 0.5 + np.arange(int(size[0])):
            for y in corner[1] + 0.5 + np.arange(int(size[1])):
                yield cylinder((x, y, top), (x, y, top + STUD_HEIGHT), STUD_RADIUS, color, segments=12)
