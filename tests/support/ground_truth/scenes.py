"""Small scenes of several kinds, and a room with an object on a table, known to the last voxel."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp

from warpcage.demo.bricks import Model, merged
from warpcage.demo.raycast import render_mesh_views
from warpcage.demo.viewpoints import orbit_eyes, reference_cameras, require_counts, spread_eyes
from warpcage.errors import InputError
from warpcage.scene.scene import Scene
from warpcage.view.camera import Camera

from .models import MODELS

Vector = tuple[float, float, float]

#: Model -> options of render_mesh_views.
LIGHTS = {"specular": {"highlight": 1.2, "shininess": 60.0}}


@dataclasses.dataclass(frozen=True)
class SceneKind:
    """A model and how it is seen."""

    model: str  # one of `MODELS`
    view_count: int | None = None  # training views; None is what the caller asks for
    scale: float = 1.0  # of the model and of the distances of the cameras
    shift: Vector = (0, 0, 0)  # moves the object and the cameras together, in units of the model
    aside: Vector = (0, 0, 0)  # moves the object away from what the cameras look at, in units of the model


#: Kinds of scenes by name.
KINDS = {
    "bricks": SceneKind("bricks"),
    "thin": SceneKind("thin"),
    "specular": SceneKind("specular"),
    "textured": SceneKind("textured"),
    "off-centre": SceneKind("bricks", shift=(70, -50, 30)),
    "aside": SceneKind("bricks", aside=(0.25, -0.2, 0.15)),
    "ten times larger": SceneKind("bricks", scale=10.0),
    "20 views": SceneKind("bricks", view_count=20),
    "20 views, thin": SceneKind("thin", view_count=20),
    "20 views, specular": SceneKind("specular", view_count=20),
    "20 views, textured": SceneKind("textured", view_count=20),
}


def synthetic_scene(
    kind: str = "bricks",
    *,
    train_views: int = 60,  # for kinds that do not fix it
    test_views: int = 8,
    size: int = 100,  # pixels along each side of a picture
    seed: int = 0,  # places the training cameras
    samples: int = 3,  # rays along each side of a pixel
    alpha: bool = True,  # whether the scenes have alphas
    device: wp.DeviceLike = None,
) -> tuple[Scene, Scene]:
    """Views of one of `KINDS` on white, training and test, from the upper hemisphere, 4 units of the model away."""
    if kind not in KINDS:
        raise InputError(f"scene kind {kind!r} is not known: {', '.join(KINDS)}")
    require_counts(train_views, test_views, size)
    chosen = KINDS[kind]
    vertices, faces, colors = MODELS[chosen.model]()
    vertices = chosen.scale * (vertices + chosen.shift + chosen.aside)
    target = chosen.scale * np.asarray(chosen.shift, np.float64)
    light = LIGHTS.get(chosen.model, {})

    def scene(eyes: np.ndarray) -> Scene:
        cameras = reference_cameras(target + chosen.scale * eyes, target, size)
        rgba = render_mesh_views(vertices, faces, colors, cameras, samples=samples, device=device, **light)
        alphas = rgba[..., 3]
        images = rgba[..., :3] * alphas[..., None] + (1.0 - alphas[..., None])
        return Scene(images, alphas if alpha else None, cameras)

    return scene(spread_eyes(chosen.view_count or train_views, seed)), scene(orbit_eyes(test_views))


#: The room: half its sides in x and y, the height of floor and of walls. The object is about the origin.
ROOM_HALF, FLOOR, TOP = (5.0, 4.0), -2.6, 4.0

#: Side of a painted tile.
TILE = 0.09

#: The box that holds the object and the table's top: what a fit calls the object.
OBJECT_BOX = np.array([[-1.7, -1.7, -1.35], [1.7, 1.7, 1.35]])

#: The top of the table: half its side, where it begins and ends in z.
TABLE_HALF, TABLE_BOTTOM, TABLE_TOP = 1.5, -1.15, -1.0

#: The object's size over that of its model.
OBJECT_SCALE = 0.95

#: Cameras: distance from the origin, how high they stand, and the field of view.
DISTANCE, HEIGHTS, FOV_DEGREES = 3.3, (0.1, 1.9), 62.0


@dataclasses.dataclass(frozen=True)
class RoomViews:
    """Views of the room."""

    whole: Scene  # whole pictures: no opacity, the object's box as bounds
    object: Scene  # what is in that box alone, on white, with opacity: as if all that is around it were known
    around: np.ndarray  # (n, h, w, 3) the views of all the rest, without it

    @property
    def split(self) -> Scene:
        """The object, with what is around it split off: to compare whole pictures, and the object in them."""
        alphas = self.object.alphas
        assert alphas is not None
        return dataclasses.replace(self.object, surroundings=(1.0 - alphas[..., None]) * self.around)


def room_views(
    train_views: int = 60,
    test_views: int = 8,
    size: int = 100,  # pixels along each side of a picture
    *,
    samples: int = 3,  # rays along each side of a pixel
    seed: int = 0,  # places the training cameras
    device: wp.DeviceLike = None,
) -> tuple[RoomViews, RoomViews]:
    """Training and test views of the room; what is in the object's box and around it is lit apart: the two make all."""
    require_counts(train_views, test_views, size)
    inside, outside = object_model(), room_model()

    def views(cameras: list[Camera]) -> RoomViews:
        rgba = render_mesh_views(*inside, cameras, samples=samples, device=device)
        room = render_mesh_views(*outside, cameras, samples=samples, device=device)
        around = room[..., :3] * room[..., 3:] + 1.0 - room[..., 3:]  # white light comes in from above
        alphas = rgba[..., 3]
        share = alphas[..., None]
        whole = Scene(rgba[..., :3] * share + (1.0 - share) * around, None, cameras, bounds=OBJECT_BOX)
        alone = Scene(rgba[..., :3] * share + (1.0 - share), alphas, cameras, bounds=OBJECT_BOX)
        return RoomViews(whole, alone, around)

    return views(room_cameras(train_views, size, seed)), views(room_cameras(test_views, size, seed + 1))


def room_cameras(count: int, size: int, seed: int) -> list[Camera]:
    """Cameras that walk around the table, up and down, and look about where it is."""
    random = np.random.default_rng(seed)
    turn = 2 * np.pi * (np.arange(count) + random.uniform(0.2, 0.8, count)) / count
    height = random.uniform(*HEIGHTS, count)
    flat = DISTANCE * random.uniform(0.9, 1.05, count)
    eyes = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    targets = random.normal(scale=0.2, size=(count, 3))
    return [
        Camera.look_at(eye, target, fov_degrees=FOV_DEGREES, width=size, height=size)
        for eye, target in zip(eyes, targets, strict=True)
    ]


def object_model() -> Model:
    """Bricks on the top of a table: vertices, faces and a colour for each face."""
    vertices, faces, colors = MODELS["bricks"]()
    vertices = OBJECT_SCALE * (vertices - [0.0, 0.0, vertices[:, 2].min()]) + [0.0, 0.0, TABLE_TOP]
    low, high = [-TABLE_HALF] * 2 + [TABLE_BOTTOM], [TABLE_HALF] * 2 + [TABLE_TOP]
    return merged([(vertices, faces, colors), painted_box(low, high, wood)])


def room_model() -> Model:
    """Floor, walls and the legs of the table, painted by small squares."""
    x, y = ROOM_HALF
    parts = [
        painted_plane([-x, -y, FLOOR], [2 * x, 0, 0], [0, 2 * y, 0], planks),
        painted_plane([-x, -y, FLOOR], [2 * x, 0, 0], [0, 0, TOP - FLOOR], _paper),
        painted_plane([-x, y, FLOOR], [2 * x, 0, 0], [0, 0, TOP - FLOOR], _paper),
        painted_plane([-x, -y, FLOOR], [0, 2 * y, 0], [0, 0, TOP - FLOOR], _bricks),
        painted_plane([x, -y, FLOOR], [0, 2 * y, 0], [0, 0, TOP - FLOOR], _bricks),
    ]
    leg = TABLE_HALF - 0.2
    for sign in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        middle = leg * np.array([*sign, 0.0])
        low, high = middle + [-0.1, -0.1, FLOOR], middle + [0.1, 0.1, OBJECT_BOX[0, 2] - 0.02]
        parts.append(painted_box(low, high, wood))
    return merged(parts)


def painted_plane(corner, along, up, paint, tile: float = TILE) -> Model:
    """A rectangle in squares of about `tile`, each of the colour that `paint` gives its middle (n, 3)."""
    corner, along, up = (np.asarray(each, np.float64) for each in (corner, along, up))
    columns, rows = (max(1, round(float(np.linalg.norm(each)) / tile)) for each in (along, up))
    i, j = np.meshgrid(np.arange(columns + 1), np.arange(rows + 1), indexing="ij")
    vertices = corner + (i / columns)[..., None] * along + (j / rows)[..., None] * up
    first = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    faces = np.stack([first, first + rows + 1, first + rows + 2, first, first + rows + 2, first + 1], axis=1)
    middles = vertices.reshape(-1, 3)[first] + 0.5 * along / columns + 0.5 * up / rows
    return vertices.reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32), np.repeat(paint(middles), 2, axis=0)


def painted_box(low, high, paint) -> Model:
    """The six sides of a box."""
    low, size = np.asarray(low, np.float64), np.asarray(high, np.float64) - low
    sides = []
    for axis in range(3):
        along, up = (size * (np.arange(3) == (axis + turn) % 3) for turn in (1, 2))
        sides += [painted_plane(low + offset * size * (np.arange(3) == axis), along, up, paint) for offset in (0, 1)]
    return merged(sides)


def smooth_noise(places: np.ndarray, waves: int, seed: int) -> np.ndarray:
    """(n,) smooth unrest in about [-1, 1]."""
    random = np.random.default_rng(seed)
    across = random.normal(size=(waves, 3)) * random.uniform(0.5, 4.0, (waves, 1))
    return np.sin(places @ across.T + random.uniform(0, 2 * np.pi, waves)).sum(axis=1) / np.sqrt(waves)


def mixed_colors(share: np.ndarray, one, other) -> np.ndarray:
    share = np.clip(share, 0.0, 1.0)[:, None]
    return (1.0 - share) * np.asarray(one) + share * np.asarray(other)


def wood(places: np.ndarray) -> np.ndarray:
    return mixed_colors(
        0.5 + 0.4 * np.sin(9 * places[:, 0] + 2 * smooth_noise(places, 6, 0)), (0.45, 0.28, 0.15), (0.62, 0.42, 0.25)
    )


def planks(places: np.ndarray) -> np.ndarray:
    plank = np.floor(places[:, 1] / 0.45)
    shade = 0.5 + 0.35 * np.sin(12.9 * plank) + 0.2 * smooth_noise(places * [0.6, 3.0, 1.0], 8, 1)
    return mixed_colors(shade, (0.32, 0.24, 0.18), (0.66, 0.52, 0.38))


def _paper(places: np.ndarray) -> np.ndarray:
    """Wallpaper with flowers, and a picture with a frame."""
    u, v = places[:, 0], places[:, 2]
    flower = np.hypot((u % 1.1) - 0.55, (v % 0.9) - 0.45)
    color = mixed_colors(0.5 + 0.3 * smooth_noise(places, 5, 2), (0.75, 0.78, 0.66), (0.85, 0.84, 0.76))
    color = np.where((flower < 0.24)[:, None], mixed_colors(flower / 0.24, (0.75, 0.2, 0.25), (0.9, 0.6, 0.55)), color)
    frame = np.maximum(np.abs(u - 1.2) / 1.5, np.abs(v - 1.0) / 1.0)
    painting = mixed_colors(0.5 + 0.5 * smooth_noise(2 * places, 8, 3), (0.1, 0.3, 0.5), (0.9, 0.8, 0.4))
    color = np.where((frame < 1)[:, None], (0.2, 0.14, 0.1), color)
    return np.where((frame < 0.88)[:, None], painting, color)


def _bricks(places: np.ndarray) -> np.ndarray:
    """A wall of bricks with a door."""
    u, v = places[:, 1], places[:, 2]
    course = np.floor(v / 0.36)
    joint = (np.abs(v / 0.36 - course - 0.5) > 0.4) | (np.abs((u / 0.8 + 0.5 * (course % 2)) % 1 - 0.5) > 0.44)
    shade = 0.5 + 0.4 * np.sin(7.3 * np.floor(u / 0.8 + 0.5 * (course % 2)) + 3.1 * course)
    color = np.where(joint[:, None], (0.72, 0.7, 0.66), mixed_colors(shade, (0.5, 0.22, 0.16), (0.7, 0.38, 0.28)))
    door = (np.abs(u + 1.5) < 0.9) & (v < 1.4)
    return np.where(
        door[:, None], mixed_colors(0.5 + 0.4 * smooth_noise(places, 5, 4), (0.15, 0.25, 0.3), (0.3, 0.45, 0.5)), color
    )
