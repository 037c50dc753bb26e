"""Casual captures that the project makes itself, with true cameras: places, and how a phone is carried past them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp

from warpcage.demo.bricks import Color, Model, Part, ball, box, cylinder, joined, merged
from warpcage.demo.viewpoints import require_counts
from warpcage.errors import InputError
from warpcage.scene.parsing import HOLD_OUT
from warpcage.scene.scene import Scene
from warpcage.view.camera import Camera

from .carried_mesh import CarriedMesh
from .models import MODELS
from .phone_video import LONG_EXPOSURES, TEXTURE, PhonePath, table_scene, take_picture
from .scenes import LIGHTS, mixed_colors, painted_box, painted_plane, planks, smooth_noise, wood

#: Heights of what objects stand on, and of ceilings.
GROUND, TABLE_TOP, CEILING = -1.0, -0.85, 3.0

#: The light's way through the hole in a ceiling: its middle, and half its sides.
HOLE, HOLE_HALF = (2.0, -2.67), 1.4

#: How far the outdoors reach, and where hills begin.
FAR, HILLS = 120.0, 22.0

#: Points of a reconstruction that a picture adds to the scene.
POINTS = 40

#: Pixels along the longer side of the smallest pictures.
SMALLEST = 16

#: A view off the path, by turns: share of the path's distance, and how many degrees higher it stands.
ASIDE = ((0.8, 12.0), (1.1, -8.0))


@dataclasses.dataclass(frozen=True)
class CasualCapture:
    """A place, and how a phone is carried past it."""

    place: Callable[[], Model]
    route: PhonePath
    shape: tuple[int, int] = (4, 3)  # width to height
    fov_degrees: float = 62.0  # along the longer side
    rolls: float = 0.0  # exposures differ by factors of up to exp(this), smoothly from one picture to the next
    blurred: int = 0  # every so many-th picture is blurred; 0 for none
    exposure: float = 0.0  # time that a blurred picture is exposed, in times from one to the next
    readout: float = 0.0  # time from the first row of a picture to the last one, in the same unit
    look: dict[str, Any] = dataclasses.field(default_factory=dict)  # options of CarriedMesh, plain unless they say so


def casual_scene(
    name: str,  # one of `CASUAL`
    *,
    views: int = 64,  # along the path
    aside: int = 6,  # off it
    size: int = 160,  # pixels along the longer side
    samples: int = 2,  # rays along each side of a pixel
    seed: int = 0,  # of the hand's trembling and of exposures
    device: wp.DeviceLike = None,
) -> tuple[Scene, Scene]:
    """Whole pictures of a walk past a place, and held-out ones: every eighth of the walk ("path_0000"), and others from
    where nobody was, sharp and of an exposure of 1 ("aside_00"). Cameras are true, points on surfaces."""
    capture = _known(name)
    require_counts(views, aside, size)
    if views < 2 or size < SMALLEST:
        raise InputError(f"a walk needs 2 views of {SMALLEST} pixels or more, got {views} of {size}")
    route = dataclasses.replace(capture.route, seed=seed)
    width, height = (max(1, round(size * side / max(capture.shape))) for side in capture.shape)
    focal = 0.5 * max(width, height) / np.tan(np.radians(capture.fov_degrees) / 2)
    lens = Camera(focal, focal, width / 2, height / 2, width, height, np.eye(4))
    mesh = _mesh(capture, device)
    step, train = 1.0 / (views - 1), [k for k in range(views) if k % HOLD_OUT]
    images, cameras = [], []
    for frame, gain in enumerate(_exposures(views, capture.rolls, seed, train)):
        long = bool(capture.blurred) and frame % capture.blurred == capture.blurred - 1
        picture, poses = take_picture(
            lambda moments: _pictures(mesh, moments, samples),
            route,
            frame * step,
            lens,
            exposure=long * capture.exposure * step,
            readout=capture.readout * step,
            strips=8 if capture.readout else 1,
            moments=2 * LONG_EXPOSURES if long else 1,
        )
        images.append(_in_8_bits(gain * picture))
        # of a blurred picture: the mean of its poses
        cameras.append(dataclasses.replace(lens, camera_to_world=_mean_pose(poses)))
    off = [dataclasses.replace(lens, camera_to_world=_aside_pose(route, k, aside)) for k in range(aside)]
    points, colors = _points(mesh, [cameras[k] for k in train], seed)
    images += list(_in_8_bits(_pictures(mesh, off, samples)))
    cameras += off
    names = [f"path_{k:04d}" for k in range(views)] + [f"aside_{k:02d}" for k in range(aside)]

    def part(chosen: list[int]) -> Scene:
        own, called = [cameras[k] for k in chosen], [names[k] for k in chosen]
        pictures = np.stack([images[k] for k in chosen])
        return Scene(pictures, None, own, names=called, points=points, point_colors=colors)

    return part(train), part([*range(0, views, HOLD_OUT), *range(views, views + aside)])


def casual_views(name: str, cameras: Sequence[Camera], *, samples: int = 2, device: wp.DeviceLike = None) -> np.ndarray:
    """Sharp pictures (n, h, w, 3) float32 in [0, 1] of a place of `CASUAL`, at an exposure of 1, from cameras of one
    size. samples: rays along each side of a pixel."""
    return _pictures(_mesh(_known(name), device), list(cameras), samples)


def _known(name: str) -> CasualCapture:
    if name not in CASUAL:
        raise InputError(f"casual capture {name!r} is not known: {', '.join(CASUAL)}")
    return CASUAL[name]


def _mesh(capture: CasualCapture, device: wp.DeviceLike) -> CarriedMesh:
    return CarriedMesh(*capture.place(), **{"texture": (0.0, 1.0), "device": device, **capture.look})


def _pictures(mesh: CarriedMesh, cameras: list[Camera], samples: int) -> np.ndarray:
    """Pictures (n, h, w, 3) before the sky."""
    rgba, _ = mesh.render(cameras, samples=samples)
    if (rgba[..., 3] < 1.0).any():
        sky = np.stack([_sky(camera.rays()[1]) for camera in cameras])
        return rgba[..., :3] * rgba[..., 3:] + (1.0 - rgba[..., 3:]) * sky
    return rgba[..., :3]


def _sky(directions: np.ndarray) -> np.ndarray:
    """(..., 3) blue that fades to the horizon, and clouds, of unit directions (..., 3)."""
    flat = directions.reshape(-1, 3)
    clear = mixed_colors(1.6 * flat[:, 2] + 0.1, (0.80, 0.86, 0.92), (0.30, 0.52, 0.86))
    cloud = np.clip(0.9 * smooth_noise(3.0 * flat * [1.0, 1.0, 2.5], 12, 5) - 0.1, 0.0, 0.9)[:, None]
    return ((1.0 - cloud) * clear + cloud * 0.97).reshape(directions.shape).astype(np.float32)


def _mean_pose(poses: np.ndarray) -> np.ndarray:
    """The mean place, and the rotation nearest to the mean of those of poses (n, 4, 4)."""
    mean = poses.mean(axis=0)
    u, _, v = np.linalg.svd(mean[:3, :3])
    mean[:3, :3] = u @ v
    return mean


def _exposures(views: int, rolls: float, seed: int, train: list[int]) -> np.ndarray:
    """Factors (n,) whose geometric mean over the training views is 1."""
    random, time = np.random.default_rng(seed + 1), np.linspace(0.0, 1.0, views)
    waves = random.uniform(0.7, 2.0, 2)[:, None] * time + random.uniform(0.0, 1.0, (2, 1))
    log = np.sin(2 * np.pi * waves).mean(axis=0)
    return np.exp(rolls * (log - log[train].mean()) / max(1.0, float(np.abs(log - log[train].mean()).max())))


def _aside_pose(route: PhonePath, k: int, count: int) -> np.ndarray:
    """A steady pose higher and nearer, or lower and farther than the path, that looks beside its target."""
    share, higher = ASIDE[k % len(ASIDE)]
    shift = 0.3 * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.3])
    low, high = route.rise
    other = {"distance": share * route.distance, "rise": (low + higher, high + higher), "shake": (0.0, 0.0)}
    x, y, z = np.add(route.target, shift)
    return dataclasses.replace(route, target=(x, y, z), **other).pose((k + 0.5) / count)


def _points(mesh: CarriedMesh, cameras: list[Camera], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (m, 3) on surfaces and their colours, in pixels of much contrast among some of each picture."""
    random = np.random.default_rng(seed)
    points, colors = [], []
    for camera in cameras:
        (picture,), (distance,) = mesh.render([camera], samples=1)
        contrast = np.hypot(*np.gradient(picture[..., :3].mean(axis=-1))) * np.isfinite(distance)
        drawn = random.permutation(contrast.size)[: 4 * POINTS]
        best = drawn[np.argsort(-contrast.ravel()[drawn], kind="stable")[:POINTS]]
        best = best[contrast.ravel()[best] > 0.0]
        origins, directions = (each.reshape(-1, 3)[best] for each in camera.rays())
        points.append(origins + distance.ravel()[best, None] * directions)
        colors.append(picture.reshape(-1, 4)[best, :3])
    return np.concatenate(points), np.concatenate(colors)


def _in_8_bits(images: np.ndarray) -> np.ndarray:
    return (np.rint(255.0 * np.clip(images, 0.0, 1.0)) / 255.0).astype(np.float32)


# Places


def _plain(color: Color) -> Callable[[np.ndarray], np.ndarray]:
    return lambda places: np.tile(color, (len(places), 1))


def _room(low: Sequence[float], high: Sequence[float], wall: Color) -> Model:
    """A room of plain walls between corners (x, y), a floor of planks at GROUND, and a hole for the light above."""
    (x, y), (right, back), tall = low, high, CEILING - GROUND
    across, along, paint = [right - x, 0, 0], [0, back - y, 0], _plain(wall)
    left, front = HOLE[0] - HOLE_HALF, HOLE[1] - HOLE_HALF
    ceiling = [  # around the hole
        (x, y, left - x, back - y),
        (left + 2 * HOLE_HALF, y, right - left - 2 * HOLE_HALF, back - y),
        (left, y, 2 * HOLE_HALF, front - y),
        (left, front + 2 * HOLE_HALF, 2 * HOLE_HALF, back - front - 2 * HOLE_HALF),
    ]
    sides = [([x, y], across), ([x, back], across), ([x, y], along), ([right, y], along)]
    return merged(
        [
            painted_plane([x, y, GROUND], across, along, planks),
            *(painted_plane([*corner, GROUND], way, [0, 0, tall], paint, tall) for corner, way in sides),
            *(painted_plane([a, b, CEILING], [w, 0, 0], [0, d, 0], paint, tall) for a, b, w, d in ceiling),
        ]
    )


def _standing(name: str, scale: float, height: float) -> Model:
    """A model of MODELS whose lowest point is at a height."""
    vertices, faces, colors = MODELS[name]()
    return scale * (vertices - [0.0, 0.0, vertices[:, 2].min()]) + [0.0, 0.0, height], faces, colors


def _speckled(parts: Sequence[Part], random: np.random.Generator) -> Model:
    """Parts whose faces differ in brightness, as leaves and stones do."""
    vertices, faces, colors = joined(parts)
    return vertices, faces, (colors * random.uniform(0.6, 1.3, (len(faces), 1))).astype(np.float32)


def _table() -> Model:
    objects = [
        cylinder((0.9, -0.8, TABLE_TOP), (0.9, -0.8, -0.45), 0.2, (0.15, 0.35, 0.7), segments=24),
        box((-1.2, 0.5, TABLE_TOP), (-0.7, 1.2, -0.73), (0.7, 0.15, 0.2)),
    ]
    room = _room((-4.6, -4.4), (4.6, 4.4), (0.86, 0.85, 0.82))
    return merged([room, _table_top(), _standing("animal", 0.8, TABLE_TOP), joined(objects)])


def _table_top() -> Model:
    return painted_box([-1.5, -1.5, GROUND], [1.5, 1.5, TABLE_TOP], wood)


def _corner() -> Model:
    objects = [
        box((-2.6, 1.1, GROUND), (-1.5, 2.2, -0.2), (0.62, 0.44, 0.22)),
        ball((-2.0, -0.6, -0.65), 0.35, (0.85, 0.4, 0.1)),
        cylinder((1.2, 2.2, GROUND), (1.2, 2.2, 1.2), 0.09, (0.2, 0.2, 0.22), segments=16),
        ball((1.2, 2.2, 1.35), 0.35, (0.95, 0.9, 0.7)),
    ]
    return merged(
        [_room((-3.1, -7.0), (7.0, 3.1), (0.84, 0.86, 0.85)), _standing("chair", 1.0, GROUND), joined(objects)]
    )


def _outdoors() -> Model:
    random = np.random.default_rng(3)
    stems, crowns = [], []
    for turn in np.radians(np.arange(12) * 30 + random.uniform(-9, 9, 12)):
        x, y = random.uniform(6.5, 18.0) * np.array([np.cos(turn), np.sin(turn)])
        tall = random.uniform(1.8, 3.2)
        stems.append(cylinder((x, y, GROUND - 0.3), (x, y, GROUND + tall), 0.16, (0.33, 0.24, 0.16), segments=10))
        for lift in (0.0, 0.8):
            green = (random.uniform(0.12, 0.3), random.uniform(0.32, 0.5), random.uniform(0.1, 0.2))
            crowns.append(ball((x, y, GROUND + tall + lift), 1.1 - 0.4 * lift, green, subdivisions=3))
    for turn in np.radians(np.arange(10) * 36 + random.uniform(-12, 12, 10)):
        x, y = random.uniform(1.7, 3.0) * np.array([np.cos(turn), np.sin(turn)])
        crowns.append(ball((x, y, GROUND), random.uniform(0.08, 0.22), (0.5, 0.49, 0.46), subdivisions=2))
    return merged([_terrain(), _standing("bricks", 1.0, GROUND), joined(stems), _speckled(crowns, random)])


def _terrain() -> Model:
    """Grass around the origin, and hills that grow bluer with their distance; cells grow with it too."""
    turns, rings = np.arange(241) * 2 * np.pi / 240, np.geomspace(0.05, FAR, 150)
    r, turn = np.meshgrid(rings, turns, indexing="ij")
    flat = np.stack([r * np.cos(turn), r * np.sin(turn), 0 * r], axis=-1).reshape(-1, 3)
    far = np.clip((r.ravel() - HILLS) / (FAR - HILLS), 0.0, 1.0)
    unit = np.stack([np.cos(turn), np.sin(turn), 0 * r], axis=-1).reshape(-1, 3)
    height = GROUND + far * (14.0 + 8.0 * smooth_noise(2.0 * unit, 9, 6)) + 0.02 * smooth_noise(flat, 8, 7)
    first = (np.arange(149)[:, None] * 241 + np.arange(240)).ravel()
    faces = np.stack([first, first + 241, first + 242, first, first + 242, first + 1], axis=1).reshape(-1, 3)
    middles = flat[faces].mean(axis=1)
    grass = mixed_colors(0.5 + 0.35 * smooth_noise(2.5 * middles, 14, 8), (0.20, 0.30, 0.10), (0.46, 0.52, 0.22))
    earth = mixed_colors(2.0 * smooth_noise(0.8 * middles, 10, 9) - 0.6, (0, 0, 0), (1, 1, 1))
    color = (1.0 - earth) * grass + earth * (0.50, 0.42, 0.30)
    color *= np.random.default_rng(10).uniform(0.75, 1.2, (len(faces), 1))
    haze = far[faces].mean(axis=1)[:, None] ** 0.7
    color = (1.0 - 0.75 * haze) * color + 0.75 * haze * (0.52, 0.62, 0.74)
    return np.column_stack([flat[:, :2], height]), faces.astype(np.int32), color.astype(np.float32)


def _shelf() -> Model:
    """Boards with books in front of a wall, and leaves on stems before them."""
    random = np.random.default_rng(4)
    boards = [painted_box([-2.0, 0.3, z - 0.06], [2.0, 1.1, z], wood) for z in (GROUND + 0.1, 0.1, 1.1, 2.1)]
    boards += [painted_box([x - 0.06, 0.3, GROUND], [x + 0.06, 1.1, 2.1], wood) for x in (-2.0, 2.0)]
    books, leaves = [], []
    for level in (GROUND + 0.1, 0.1, 1.1):
        x = -1.9
        while x < 1.6:
            wide, tall, deep = random.uniform(0.06, 0.2), random.uniform(0.5, 0.85), random.uniform(0.3, 0.55)
            red, green, blue = random.uniform(0.08, 0.9, 3)
            books.append(box((x, 1.0 - deep, level), (x + wide, 1.0, level + tall), (red, green, blue)))
            x += wide + (0.5 if random.random() < 0.12 else 0.01)
    for _ in range(9):
        x, y, tall = random.uniform(-1.3, 1.3), random.uniform(-0.9, -0.3), random.uniform(0.6, 1.9)
        leaves.append(cylinder((0.3 * x, -0.6, GROUND), (x, y, GROUND + tall), 0.03, (0.2, 0.4, 0.15), segments=8))
        leaves.append(ball((x, y, GROUND + tall), random.uniform(0.08, 0.17), (0.25, 0.55, 0.2), subdivisions=2))
    room = _room((-6.0, -7.0), (6.0, 1.2), (0.80, 0.78, 0.74))
    return merged([room, *boards, joined(books), _speckled(leaves, random)])


def _lamp() -> Model:
    room = _room((-4.6, -4.4), (4.6, 4.4), (0.45, 0.44, 0.46))
    return merged([room, _table_top(), _standing("specular", 1.0, TABLE_TOP)])


def _narrow() -> Model:
    """A corridor: a globe nearby, pillars and doors as far as its end."""
    random, parts = np.random.default_rng(6), []
    for x in range(3, 17, 3):
        for side in (-1, 1):
            red, green, blue = random.uniform(0.1, 0.85, 3)
            parts.append(box((x, 3.1 * side, GROUND), (x + 1.2, 3.3 * side, 1.3), (red, green, blue)))
            parts.append(
                cylinder((x - 0.8, 2.6 * side, GROUND), (x - 0.8, 2.6 * side, 2.9), 0.2, (0.7, 0.68, 0.6), segments=20)
            )
    parts.append(box((17.7, -1.2, GROUND), (17.9, 1.2, 1.6), (0.55, 0.2, 0.15)))
    room = _room((-5.5, -4.2), (18.0, 4.2), (0.83, 0.82, 0.76))
    return merged([room, _standing("thin", 1.0, GROUND), joined(parts)])


#: Casual captures by name; each is hard in a way of its own.
CASUAL = {
    "table": CasualCapture(_table, PhonePath(degrees=340.0, distance=3.6, rise=(12.0, 45.0))),
    "corner": CasualCapture(_corner, PhonePath(degrees=180.0, start=-135.0, distance=3.6, rise=(8.0, 35.0))),
    "outdoors": CasualCapture(_outdoors, PhonePath(degrees=320.0, distance=4.0, rise=(6.0, 32.0), target=(0, 0, -0.1))),
    "shelf": CasualCapture(
        _shelf, PhonePath(degrees=70.0, start=-125.0, distance=4.0, rise=(-6.0, 24.0), waves=2.5, target=(0, 0, 0.4))
    ),
    "handheld": CasualCapture(
        table_scene,
        PhonePath(degrees=280.0, rise=(12.0, 42.0), shake=(0.25, 0.05), waves=3.5),
        rolls=0.2,
        blurred=6,
        exposure=0.25,
        readout=0.03,
        look={"texture": TEXTURE},
    ),
    "lamp": CasualCapture(_lamp, PhonePath(degrees=300.0, distance=3.5, rise=(12.0, 50.0)), look=LIGHTS["specular"]),
    "narrow": CasualCapture(
        _narrow,
        PhonePath(degrees=110.0, start=125.0, distance=4.4, nearer=0.5, rise=(4.0, 24.0), waves=2.5),
        shape=(3, 4),
        rolls=0.1,
    ),
}
