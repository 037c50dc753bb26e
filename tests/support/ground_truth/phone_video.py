"""A phone's video of an object on a patterned table, whose true cameras are known."""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import warp as wp

from warpcage.demo.bricks import Model, Part, ball, box, brick_model, joined, merged
from warpcage.errors import InputError
from warpcage.studio.films.video import write_video
from warpcage.view.camera import Camera

from .carried_mesh import CarriedMesh

#: Half side of the table, height of its top, and half side of the room around it, world units.
TABLE, TOP, ROOM = 3.0, -1.0, 7.0

#: A blurred frame is exposed so many times as long as the others, and is the mean of at least so many moments.
LONG, LONG_EXPOSURES = 12, 6

#: Amplitude of the noise over all colours, and its frequency per world unit.
TEXTURE = (0.55, 5.0)


@dataclasses.dataclass(frozen=True)
class PhonePath:
    """How a hand carries a phone around the origin, +z up."""

    degrees: float = 250.0  # how far around it walks
    distance: float = 4.2  # from the origin, world units
    rise: tuple[float, float] = (18.0, 42.0)  # lowest and highest elevation, degrees
    shake: tuple[float, float] = (0.02, 0.006)  # trembling of the hand, world units, and of the view, radians
    seed: int = 0  # of the trembling
    start: float = -90.0  # where it begins, degrees from +x to +y
    waves: float = 1.5  # how often it goes up and down
    nearer: float = 0.0  # share of the distance by which it comes nearer as it goes up
    target: tuple[float, float, float] = (0.0, 0.0, -0.2)  # what it looks at

    def pose(self, time: float) -> np.ndarray:
        """Where the phone is at a time from 0 at the beginning to 1 at the end: (4, 4) camera to world, OpenCV axes."""
        turn = np.radians(self.degrees * time + self.start)
        low, high = self.rise
        wave = 0.5 - 0.5 * np.cos(2 * self.waves * np.pi * time)
        rise = np.radians(low + (high - low) * wave)
        away = self.distance * (1.0 - self.nearer * wave)
        eye = away * np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
        rng = np.random.default_rng(self.seed)
        rates, phases = rng.uniform(4.0, 11.0, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3))
        tremble = np.sin(2 * np.pi * rates * time + phases).mean(axis=1)
        eye = eye + self.shake[0] * tremble[:3]
        view = Camera.look_at(eye, self.target).camera_to_world
        x, y, z = self.shake[1] * tremble[3:]
        small = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        q, r = np.linalg.qr(np.eye(3) + small)  # a small turn about the camera's own axes
        pose = view.copy()
        pose[:3, :3] = view[:3, :3] @ (q * np.sign(np.diag(r)))
        return pose


def take_picture(
    render: Callable[[list[Camera]], np.ndarray],  # pictures (n, h, w, 3) of cameras of one size
    route: PhonePath,
    time: float,  # of the middle of the picture, 0 to 1
    camera: Camera,  # its size and intrinsics
    *,
    exposure: float = 0.0,  # time that a row is exposed
    readout: float = 0.0,  # time from the first row to the last one
    strips: int = 1,  # parts of the picture whose rows are taken at one time
    moments: int = 1,  # moments of which an exposure is the mean
) -> tuple[np.ndarray, np.ndarray]:
    """A picture (h, w, 3) of a phone that moves on while its rows are taken one after another, and the poses
    (strips * moments, 4, 4) of which it is made."""
    edges = np.linspace(0, camera.height, strips + 1).round().astype(int)
    rows, poses = [], []
    for strip, (first, last) in enumerate(itertools.pairwise(edges)):
        late = readout * ((strip + 0.5) / strips - 0.5)
        times = time + late + exposure * ((np.arange(moments) + 0.5) / moments - 0.5)
        of_strip = [route.pose(moment) for moment in times]
        shape = {"height": int(last - first), "cy": camera.cy - first}
        cameras = [dataclasses.replace(camera, camera_to_world=pose, **shape) for pose in of_strip]
        rows.append(render(cameras).mean(axis=0))
        poses += of_strip
    return np.concatenate(rows), np.array(poses)


def phone_cameras(
    times: Sequence[float], size: tuple[int, int], fov_degrees: float = 62.0, route: PhonePath | None = None
) -> list[Camera]:
    """The phone at times of a walk, from 0 to 1; see `write_phone_video`."""
    (width, height), route = size, PhonePath() if route is None else route
    focal = 0.5 * width / np.tan(np.radians(fov_degrees) / 2)
    return [Camera(focal, focal, width / 2, height / 2, width, height, route.pose(time)) for time in times]


def write_phone_video(
    path: str | os.PathLike[str],
    *,
    frames: int = 40,
    size: tuple[int, int] = (256, 192),  # width and height, even, pixels
    fov_degrees: float = 62.0,  # horizontal
    route: PhonePath | None = None,
    exposure: float = 0.04,  # time that a row is exposed, in times from one frame to the next
    readout: float = 0.04,  # time from the first row to the last one, in the same unit
    blurred: int = 6,  # every so many-th frame is exposed LONG times as long; 0 for none
    strips: int = 8,  # parts of a frame whose rows are taken at one time; they divide its height
    exposures: int = 2,  # moments of which an exposure is the mean
    samples: int = 1,  # rays along each side of a pixel
    rate: float = 30.0,  # frames per second of the file
    device: wp.DeviceLike = None,
) -> list[Camera]:
    """Ray cast a walk around the table scene, as a phone records it.
    Returns the true cameras: where the phone was in the middle of each frame."""
    # Rows are taken one after another (rolling shutter), blurred by the motion in their exposure; H.264 of 8 bits.
    width, height = size
    if height % strips or width % 2 or height % 2:
        raise InputError(f"a video of {width}x{height} pixels is not cut into {strips} strips of whole, even sizes")
    route = PhonePath() if route is None else route
    mesh = CarriedMesh(*table_scene(), texture=TEXTURE, device=device)
    step = 1.0 / max(frames - 1, 1)
    true = phone_cameras([k * step for k in range(frames)], size, fov_degrees, route)

    def render(cameras: list[Camera]) -> np.ndarray:
        return mesh.render(cameras, samples=samples)[0][..., :3]

    def pictures() -> Iterator[np.ndarray]:
        for frame, camera in enumerate(true):
            long = blurred and frame % blurred == blurred - 1
            yield take_picture(
                render,
                route,
                frame * step,
                camera,
                exposure=(LONG if long else 1) * exposure * step,
                readout=readout * step,
                strips=strips,
                moments=max(exposures, LONG_EXPOSURES) if long else exposures,
            )[0]

    write_video(path, pictures(), rate)
    return true


def table_scene(model: Model | None = None) -> Model:
    """A model, or else the excavator of bricks, on a table with a patchwork cloth and objects around it, in a room of
    coloured panels. +z is up, the model around the origin; its vertices and faces come first."""
    rng = np.random.default_rng(5)
    vertices, faces, colors = brick_model() if model is None else model
    vertices = vertices + [0.0, 0.0, TOP - vertices[:, 2].min()]
    parts: list[Model] = [(vertices, faces, colors)]
    parts.append(_patchwork([-TABLE, -TABLE, TOP], [2 * TABLE, 0, 0], [0, 2 * TABLE, 0], 30, rng))
    for k in range(4):  # walls, seen from inside
        turn = 0.5 * np.pi * k
        out, along = np.array([np.cos(turn), np.sin(turn), 0]), np.array([-np.sin(turn), np.cos(turn), 0])
        parts.append(_patchwork(ROOM * (out - along) + [0, 0, -3.5], 2 * ROOM * along, [0, 0, 8.0], 14, rng))
    parts.append(_patchwork([-ROOM, -ROOM, -3.5], [2 * ROOM, 0, 0], [0, 2 * ROOM, 0], 14, rng))
    parts.append(_patchwork([-ROOM, -ROOM, 4.5], [2 * ROOM, 0, 0], [0, 2 * ROOM, 0], 10, rng))
    parts.append(joined(_objects(rng)))
    return merged(parts)


def _patchwork(corner, side, other, count: int, rng: np.random.Generator) -> Model:
    """A parallelogram of count x count patches of random colours."""
    steps = np.linspace(0.0, 1.0, count + 1)
    across, up = np.meshgrid(steps, steps)
    vertices = np.asarray(corner, np.float64) + across.reshape(-1, 1) * side + up.reshape(-1, 1) * other
    place = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = (place[:-1, :-1], place[:-1, 1:], place[1:, 1:], place[1:, :-1])
    faces = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2).reshape(-1, 3)
    colors = np.repeat(rng.uniform(0.15, 0.95, (count * count, 3)), 2, axis=0)
    return vertices, faces.astype(np.int32), colors.astype(np.float32)


def _objects(rng: np.random.Generator) -> Iterator[Part]:
    """Boxes and balls around the table's edge."""
    for turn in np.radians(np.arange(15, 375, 40)):
        x, y = 2.2 * np.cos(turn), 2.2 * np.sin(turn)
        size = rng.uniform(0.12, 0.35, 3)
        red, green, blue = rng.uniform(0.1, 0.95, 3)
        if rng.random() < 0.6:
            yield box(
                [x - size[0], y - size[1], TOP], [x + size[0], y + size[1], TOP + 2 * size[2]], (red, green, blue)
            )
        else:
            yield ball([x, y, TOP + size[2]], float(size[2]), (red, green, blue), subdivisions=3)
