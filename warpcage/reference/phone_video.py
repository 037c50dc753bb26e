"""A phone's video of an object on a patterned table, whose true cameras are known."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator

import numpy as np
import warp as wp

from ..errors import InputError
from ..view.camera import Camera
from ..view.film import write_video
from .bricks import brick_model
from .raycast import CarriedMesh
from .solids import Model, Part, ball, box, joined

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

    def pose(self, time: float) -> np.ndarray:
        """Where the phone is at a time from 0 at the beginning to 1 at the end: (4, 4) camera to world, OpenCV axes."""
        turn = np.radians(self.degrees * time - 90.0)
        low, high = self.rise
        rise = np.radians(low + (high - low) * (0.5 - 0.5 * np.cos(3 * np.pi * time)))
        eye = self.distance * np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
        rng = np.random.default_rng(self.seed)
        rates, phases = rng.uniform(4.0, 11.0, (6, 3)), rng.uniform(0, 2 * np.pi, (6, 3))
        tremble = np.sin(2 * np.pi * rates * time + phases).mean(axis=1)
        eye = eye + self.shake[0] * tremble[:3]
        view = Camera.look_at(eye, [0.0, 0.0, -0.2]).camera_to_world
        x, y, z = self.shake[1] * tremble[3:]
        small = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        q, r = np.linalg.qr(np.eye(3) + small)  # a small turn about the camera's own axes
        pose = view.copy()
        pose[:3, :3] = view[:3, :3] @ (q * np.sign(np.diag(r)))
        return pose


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
    focal = 0.5 * width / np.tan(np.radians(fov_degrees) / 2)
    mesh = CarriedMesh(*table_scene(), texture=TEXTURE, device=device)
    step, rows = 1.0 / max(frames - 1, 1), height // strips

    def pictures() -> Iterator[np.ndarray]:
        for frame in range(frames):
            long = LONG if blurred and frame % blurred == blurred - 1 else 1
            moments = exposures if long == 1 else max(exposures, LONG_EXPOSURES)
            cameras = []
            for strip in range(strips):
                late = readout * ((strip + 0.5) / strips - 0.5)
                for part in range(moments):
                    moment = long * exposure * ((part + 0.5) / moments - 0.5)
                    pose = route.pose((frame + late + moment) * step)
                    cameras.append(Camera(focal, focal, width / 2, height / 2 - strip * rows, width, rows, pose))
            rgba, _ = mesh.render(cameras, samples=samples)
            shown = rgba[..., :3].reshape(strips, moments, rows, width, 3).mean(axis=1)
            yield shown.reshape(height, width, 3)

    write_video(path, pictures(), rate)
    return [Camera(focal, focal, width / 2, height / 2, width, height, route.pose(k * step)) for k in range(frames)]


def table_scene() -> Model:
    """The excavator of bricks on a table with a patchwork cloth and things around it, in a room of coloured panels.
    +z is up, the excavator around the origin."""
    rng = np.random.default_rng(5)
    vertices, faces, colors = brick_model()
    vertices = vertices * np.array([1.0, 1.0, 1.0]) + [0.0, 0.0, TOP - vertices[:, 2].min()]
    parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = [(vertices, faces, colors)]
    parts.append(_patchwork([-TABLE, -TABLE, TOP], [2 * TABLE, 0, 0], [0, 2 * TABLE, 0], 30, rng))
    for k in range(4):  # walls, seen from inside
        turn = 0.5 * np.pi * k
        out, along = np.array([np.cos(turn), np.sin(turn), 0]), np.array([-np.sin(turn), np.cos(turn), 0])
        parts.append(_patchwork(ROOM * (out - along) + [0, 0, -3.5], 2 * ROOM * along, [0, 0, 8.0], 14, rng))
    parts.append(_patchwork([-ROOM, -ROOM, -3.5], [2 * ROOM, 0, 0], [0, 2 * ROOM, 0], 14, rng))
    parts.append(_patchwork([-ROOM, -ROOM, 4.5], [2 * ROOM, 0, 0], [0, 2 * ROOM, 0], 10, rng))
    parts.append(joined(_things(rng)))
    first = np.cumsum([0] + [len(each[0]) for each in parts])
    return (
        np.concatenate([each[0] for each in parts]),
        np.concatenate([each[1] + start for each, start in zip(parts, first[:-1], strict=True)]).astype(np.int32),
        np.concatenate([each[2] for each in parts]).astype(np.float32),
    )


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


def _things(rng: np.random.Generator) -> Iterator[Part]:
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
