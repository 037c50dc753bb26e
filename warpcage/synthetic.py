"""A scene that the project makes itself: a brick-built excavator, ray cast to a NeRF-synthetic folder."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import shutil
import tempfile

import numpy as np
import warp as wp

from .camera import Camera
from .devices import launch, resolve_device
from .images import to_uint8, write_png
from .kernels.mesh_raycast import MeshLighting, cast_mesh_rays
from .render import camera_struct

#: Horizontal field of view (radians) and camera distance of the NeRF-synthetic scenes.
CAMERA_ANGLE_X = 0.6911112070083618
CAMERA_RADIUS = 4.0

STUD = 0.17  # world units from one stud to the next
STUD_RADIUS, STUD_HEIGHT = 0.3, 0.2  # of that pitch, as on the real toy
SEAM = 0.015  # half the gap between two bricks, of that pitch

YELLOW, RED, BLUE, WHITE = (0.98, 0.74, 0.06), (0.82, 0.10, 0.08), (0.10, 0.30, 0.78), (0.93, 0.93, 0.90)
DARK, GREY, SILVER = (0.16, 0.17, 0.19), (0.42, 0.44, 0.46), (0.72, 0.74, 0.76)
GREEN, GLASS, ORANGE = (0.12, 0.55, 0.25), (0.50, 0.76, 0.90), (0.98, 0.48, 0.06)


def brick_model() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An excavator built of bricks, about 2 units long, centred at the origin, z up, its arm towards +x.

    Returns vertices (v, 3) float64, faces (f, 3) int32, counter-clockwise seen from outside, and colours (f, 3)
    float32 in [0, 1]. Every part is a closed surface; parts touch and overlap.
    """
    parts = [*_tracks(), *_house(), *_cabin(), *_arm()]
    counts = np.cumsum([0] + [len(vertices) for vertices, _, _ in parts])
    vertices = np.concatenate([vertices for vertices, _, _ in parts])
    faces = np.concatenate([faces + first for (_, faces, _), first in zip(parts, counts[:-1], strict=True)])
    colours = np.concatenate([np.broadcast_to(colour, faces.shape) for _, faces, colour in parts])
    vertices = (vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2) * STUD
    return vertices, faces.astype(np.int32), colours.astype(np.float32)


# The model, in studs: +x ahead, +y to the left, z = 0 on the ground. A part is (vertices, faces, colour).


def _tracks():
    for side in (-1, 1):
        inner, outer = 1.7 * side, 3.2 * side
        for x in (-3.0, 3.0):
            yield _cylinder((x, inner, 1.1), (x, outer, 1.1), 1.1, DARK, segments=24)
        for x in (-3.0, -1.0, 1.0, 3.0):
            radius = 0.75 if abs(x) == 3.0 else 0.6
            yield _cylinder((x, outer, 1.1), (x, outer + 0.14 * side, 1.1), radius, SILVER, segments=20)
            yield _cylinder((x, outer + 0.14 * side, 1.1), (x, outer + 0.26 * side, 1.1), 0.25, RED, segments=12)
        low, high = min(inner, outer), max(inner, outer)
        yield _box((-3.0, low, 0.0), (3.0, high, 2.2), DARK)
        # a mudguard ties track and house together where cameras see it, so that the fitted surface is one piece too
        yield _box((-2.4, low, 2.1), (2.4, high, 2.7), GREY)
        for x in np.arange(-2.75, 3.0, 0.785):
            yield _box((x - 0.16, low - 0.06, 2.2), (x + 0.16, high + 0.06, 2.36), GREY)
            yield _box((x - 0.16, low - 0.06, -0.16), (x + 0.16, high + 0.06, 0.0), GREY)
        for x, turns in ((3.0, (-60, -20, 20, 60)), (-3.0, (120, 160, 200, 240))):
            for turn in turns:
                cleat = _box((1.1, low - 0.06, -0.16), (1.26, high + 0.06, 0.16), GREY)
                yield _placed(cleat, turn, (x, 0.0, 1.1))
    yield _box((-2.6, -1.7, 0.7), (2.6, 1.7, 2.0), GREY)
    yield _cylinder((0.0, 0.0, 2.0), (0.0, 0.0, 2.6), 1.9, DARK, segments=28)


def _house():
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
        yield _box((-4.1, y, z + 0.2), (-4.0, y + 0.4, z + 0.9), DARK)
    yield _cylinder((-1.5, -2.5, z + 0.9), (-1.5, -2.5, z + 2.6), 0.28, SILVER, segments=14)
    yield _cylinder((-1.5, -2.5, z + 2.6), (-1.5, -2.5, z + 2.75), 0.36, DARK, segments=14)
    for y in (-2.4, 2.4):  # lamps
        yield _cylinder((4.0, y, 3.1), (4.15, y, 3.1), 0.32, WHITE, segments=14)


def _cabin():
    z = 4.1
    yield from _brick((-1, 0, z), (4, 3, 0.9), YELLOW, studs=False)
    low, high = (-0.85, 0.15, z + 0.9), (2.85, 2.85, z + 3.0)
    yield _box(low, high, GLASS)
    for x in (-1.0, 0.8, 2.6):
        for y in (0.0, 2.6):
            yield _box((x, y, z + 0.9), (x + 0.4, y + 0.4, z + 3.0), YELLOW)
    yield from _brick((-1, 0, z + 3.0), (4, 3, 0.45), BLUE)
    yield _cylinder((-0.5, 0.5, z + 3.45), (-0.5, 0.5, z + 4.1), 0.3, ORANGE, segments=14)


def _arm():
    boom_foot, elbow, wrist = np.array([2.0, -1.5, 4.4]), np.array([5.0, -1.5, 8.9]), np.array([7.4, -1.5, 4.6])
    # bracket between the house and the boom
    for y in (-2.6, -0.75):
        yield _box((1.0, y, 4.1), (3.0, y + 0.35, 5.2), GREY)
    yield _cylinder(boom_foot + (0, -1.2, 0), boom_foot + (0, 1.2, 0), 0.4, SILVER, segments=16)

    yield from _limb(boom_foot, elbow, 0.62, YELLOW)
    yield _cylinder(elbow + (0, -1.05, 0), elbow + (0, 1.05, 0), 0.78, RED, segments=20)
    yield _cylinder(elbow + (0, -1.2, 0), elbow + (0, 1.2, 0), 0.3, SILVER, segments=14)
    yield from _limb(elbow, wrist, 0.5, YELLOW)
    yield _cylinder(wrist + (0, -1.0, 0), wrist + (0, 1.0, 0), 0.5, RED, segments=18)

    # pistons: house to boom, boom to stick
    for start, middle, end in (((3.6, -1.5, 4.3), (3.95, -1.5, 5.3), (4.3, -1.5, 6.3)),
                               ((3.2, -1.5, 7.7), (4.2, -1.5, 9.2), (5.0, -1.5, 10.0))):
        yield _cylinder(start, middle, 0.34, DARK, segments=14)
        yield _cylinder(middle, end, 0.2, SILVER, segments=12)
    yield _cylinder((5.0, -1.5, 10.0), elbow, 0.25, GREY, segments=12)
    yield from _bucket(wrist)


def _limb(start, end, half, colour):
    """A beam of bricks from start to end with studs along its upper side."""
    along = end - start
    length, angle = float(np.linalg.norm(along)), float(np.degrees(np.arctan2(along[2], along[0])))
    flip = -1.0 if angle < -90 or angle > 90 else 1.0
    whole = int(length)
    edge = (length - whole) / 2
    yield _placed(_box((0, -0.8, -half), (length, 0.8, half), colour), angle, start)
    for i in range(whole):
        foot = (edge + i + 0.5, 0.0, half * flip)
        stud = _cylinder(foot, (foot[0], 0.0, foot[2] + flip * 1.2 * STUD_HEIGHT), STUD_RADIUS, colour, segments=12)
        yield _placed(stud, angle, start)
    for y in (-0.86, 0.8):  # a dark stripe on either side
        yield _placed(_box((0.9, y, -0.22), (length - 0.9, y + 0.06, 0.22), DARK), angle, start)


def _bucket(wrist):
    turn = -155.0
    plates = [((0.0, -1.7, -0.9), (0.3, 1.7, 0.9)), ((0.0, -1.7, -0.9), (1.9, 1.7, -0.6)),
              ((0.0, -1.7, -0.9), (1.7, -1.4, 0.9)), ((0.0, 1.4, -0.9), (1.7, 1.7, 0.9))]
    foot = wrist + (-0.25, 0.0, -0.35)
    for low, high in plates:
        yield _placed(_box(low, high, GREY), turn, foot)
    for y in (-1.6, -0.75, 0.15, 1.0):
        yield _placed(_box((1.9, y, -0.85), (2.4, y + 0.5, -0.65), SILVER), turn, foot)


def _brick(corner, size, colour, studs=True):
    """A brick of size (studs, studs, height) with its studs."""
    corner, size = np.asarray(corner, np.float64), np.asarray(size, np.float64)
    gap = np.array([SEAM, SEAM, 0.0])
    yield _box(corner + gap, corner + size - gap, colour)
    if studs:
        top = corner[2] + size[2]
        for x in corner[0] + 0.5 + np.arange(int(size[0])):
            for y in corner[1] + 0.5 + np.arange(int(size[1])):
                yield _cylinder((x, y, top), (x, y, top + STUD_HEIGHT), STUD_RADIUS, colour, segments=12)


def _box(low, high, colour):
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    vertices = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * (high - low) + low
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]), colour


def _cylinder(start, end, radius, colour, *, segments):
    """A closed prism over a regular polygon, its axis from start to end."""
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
    return vertices, np.concatenate([np.stack(column, axis=1) for column in columns]), colour


def _placed(part, degrees, offset):
    """A part turned about y (x towards z) and moved."""
    vertices, faces, colour = part
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return vertices @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) + offset, faces, colour


# Pictures

#: Strength and exponent of the specular term.
HIGHLIGHT, SHININESS = 0.22, 18.0


def render_mesh_views(vertices, faces, colours, cameras, *, samples: int = 3, highlight: float = HIGHLIGHT,
                      shininess: float = SHININESS, device=None) -> np.ndarray:
    """Ray cast a mesh from each camera.

    vertices (v, 3) world units; faces (f, 3); colours (f, 3) in [0, 1]; cameras of one image size; samples x samples
    rays a pixel; highlight, shininess: strength and exponent of the specular term.
    Returns (n, h, w, 4) float32, straight alpha (colour 0 where alpha is 0).
    Lit from above (+z). Raises ValueError for shapes that do not fit, no camera, or cameras of several sizes.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    colours = np.asarray(colours, np.float32)
    cameras = list(cameras)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
        raise ValueError(f"vertices must be finite (v, 3), got shape {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0 or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"faces must be (f, 3) indices below {len(vertices)}, got shape {faces.shape}")
    if colours.shape != faces.shape:
        raise ValueError(f"colours must hold one colour a face, {faces.shape}, got {colours.shape}")
    if not cameras or len({(camera.width, camera.height) for camera in cameras}) > 1:
        raise ValueError("render_mesh_views needs one camera or more, all of one image size")
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")

    device = resolve_device(device)
    origin = vertices.mean(axis=0)  # taken off in float64: far scenes survive float32
    size = float(np.ptp(vertices, axis=0).max())
    mesh = wp.Mesh(
        points=wp.array((vertices - origin).astype(np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(faces.ravel(), dtype=wp.int32, device=device),
    )
    face_colours = wp.array(colours, dtype=wp.vec3, device=device)
    lighting = mesh_lighting(size, highlight, shininess)
    width, height = cameras[0].width, cameras[0].height
    rgba = wp.zeros(width * height, dtype=wp.vec4, device=device)
    views = np.empty((len(cameras), height, width, 4), np.float32)
    for view, camera in zip(views, cameras, strict=True):
        inputs = [mesh.id, face_colours, lighting, camera_struct(camera, origin), samples]
        launch(cast_mesh_rays, width * height, inputs, [rgba], device=device)
        view[...] = rgba.numpy().reshape(height, width, 4)
    return views


def mesh_lighting(size: float, highlight: float = HIGHLIGHT, shininess: float = SHININESS) -> MeshLighting:
    """The light of all scenes here, for a mesh of this size (world units)."""
    lighting = MeshLighting()
    lighting.highlight, lighting.shininess = highlight, shininess
    lighting.key_direction = wp.normalize(wp.vec3(0.45, -0.6, 0.9))
    lighting.key_colour = wp.vec3(0.66, 0.64, 0.59)
    lighting.fill_direction = wp.normalize(wp.vec3(-0.6, 0.7, 0.25))
    lighting.fill_colour = wp.vec3(0.24, 0.26, 0.29)
    lighting.sky_colour = wp.vec3(0.60, 0.62, 0.66)
    lighting.ground_colour = wp.vec3(0.46, 0.43, 0.40)
    lighting.reach, lighting.offset = 0.15 * size, 1e-4 * size
    return lighting


def write_brick_scene(path, *, train_views: int = 60, test_views: int = 8, size: int = 100, seed: int = 0,
                      samples: int = 3, device=None) -> pathlib.Path:
    """Render the brick model to a NeRF-synthetic folder and return its path.

    train_views, test_views: pictures of each split; size: pixels a side; samples x samples rays a pixel; seed: places
    the training cameras. Writes transforms_<split>.json (camera_angle_x, Blender camera axes: +y up, -z forward) and
    <split>/r_<i>.png (RGBA, straight alpha); cameras lie on the upper hemisphere, 4 units from the origin.
    The folder appears complete or not at all; an earlier brick scene there is replaced.
    Raises ValueError for counts below one, or where `path` holds anything else.
    """
    path = pathlib.Path(path)
    if min(train_views, test_views, size) < 1:
        raise ValueError(f"a scene needs views and pixels, got {train_views} + {test_views} views of {size} pixels")
    if path.exists() and not _is_replaceable(path):
        raise ValueError(f"{str(path)!r} is there and is no brick scene: give a new or an empty folder")
    eyes = {"train": _spread_eyes(train_views, seed), "test": _orbit_eyes(test_views)}
    model = brick_model()
    with _atomic_folder(path) as folder:
        for split, places in eyes.items():
            cameras = [Camera.look_at(eye, (0.0, 0.0, 0.0), fov_degrees=np.degrees(CAMERA_ANGLE_X), width=size,
                                      height=size) for eye in places]
            views = render_mesh_views(*model, cameras, samples=samples, device=device)
            _write_split(folder, split, views, cameras)
    return path


def _spread_eyes(count: int, seed: int) -> np.ndarray:
    """Even over the upper hemisphere (a Fibonacci spiral with a turn and small jitter from the seed), (count, 3)."""
    rng = np.random.default_rng(seed)
    height = 0.03 + 0.94 * (np.arange(count) + rng.random(count)) / count
    turn = 2 * np.pi * (rng.random() + np.arange(count) * (np.sqrt(5) - 1) / 2)
    flat = np.sqrt(1 - height**2)
    return CAMERA_RADIUS * np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


def _orbit_eyes(count: int) -> np.ndarray:
    """Once around, between 15 and 50 degrees up, (count, 3)."""
    turn = 2 * np.pi * (np.arange(count) + 0.5) / count
    rise = np.radians(32.5 + 17.5 * np.sin(2 * turn + 0.5))
    return CAMERA_RADIUS * np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], axis=1)


def _write_split(folder: pathlib.Path, split: str, views: np.ndarray, cameras: list[Camera]) -> None:
    frames = []
    for index, (view, camera) in enumerate(zip(views, cameras, strict=True)):
        write_png(folder / split / f"r_{index}.png", to_uint8(view))
        pose = camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV to Blender axes
        frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose.tolist()})
    content = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")


def _is_replaceable(path: pathlib.Path) -> bool:
    ours = {"train", "test", "transforms_train.json", "transforms_test.json"}
    return path.is_dir() and {entry.name for entry in path.iterdir()} in (set(), ours)


@contextlib.contextmanager
def _atomic_folder(path: pathlib.Path):
    """A temporary folder beside `path` that takes its place when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    work = pathlib.Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    try:
        new = work / "new"
        new.mkdir()
        yield new
        if path.exists():
            os.replace(path, work / "old")
        os.replace(new, path)
    finally:
        shutil.rmtree(work, ignore_errors=True)
