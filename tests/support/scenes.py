"""Made scenes: a table with objects on it, the brick model in a painted room, a coloured box, a phone's walk."""

import dataclasses
import itertools
import json
import pathlib

import numpy as np
from ground_truth import TEXTURE, CarriedMesh, PhonePath, phone_cameras, table_scene
from scene_writers import Pictures, write_dtu, write_image

from warpcage import Camera, Scene, VoxelField, turntable
from warpcage.demo import brick_model, render_mesh_views

#: How tests/studio/captures/phone_video.mp4 was made: with a rolling shutter and every sixth frame blurred.
PHONE_VIDEO = {"frames": 36, "size": (256, 192), "strips": 8, "blurred": 6, "exposures": 1}

#: What a node belongs to.
EMPTY, FLOOR, TABLE, LAMP, BALL, FRAGMENT = range(6)

#: Height of the table's top, and of the floor, in the scene's own axes.
TABLE_TOP, FLOOR_TOP = -0.2, -0.8

#: Density of matter, per world unit, and the colours of what there is.
DENSITY = 60.0
COLORS = {FLOOR: (0.4, 0.4, 0.5), TABLE: (0.6, 0.4, 0.2), LAMP: (0.8, 0.1, 0.1), BALL: (0.1, 0.2, 0.8)}
COLORS[FRAGMENT] = 0, 0, 0


def tilt(degrees):
    """(3, 3) a turn about an axis between x and y; its columns are the scene's own axes."""
    axis = np.array([0.8, 0.6, 0.0])
    cross = np.cross(np.eye(3), axis)
    angle = np.radians(degrees)
    return np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


class TableScene:
    """The scene.

    Args:
        count: Nodes along each axis.
        degrees: How far everything is turned against +z, which is up for the field.
        floor, fragments: Whether there are any.
    """

    def __init__(self, count=64, degrees=0.0, floor=True, fragments=True, device="cpu"):
        self.turn = tilt(degrees)
        self.bounds = np.array([[-1.0] * 3, [1.0] * 3])
        cells = (np.indices((count,) * 3).reshape(3, -1).T + 0.5) * (2.0 / count) - 1.0
        self.own = cells @ self.turn  # in the scene's axes
        x, y, z = self.own.T
        label = np.zeros(len(cells), int)
        if floor:
            label[z < FLOOR_TOP] = FLOOR
        label[(np.abs(x) < 0.7) & (np.abs(y) < 0.6) & (z < TABLE_TOP) & (z > TABLE_TOP - 0.12)] = TABLE
        leg = (np.hypot(x, y) < 0.12) & (z <= TABLE_TOP - 0.12) & (z >= FLOOR_TOP)
        label[leg] = TABLE
        label[np.linalg.norm(self.own - [0.4, -0.3, TABLE_TOP + 0.15], axis=1) < 0.15] = BALL
        stem = (np.hypot(x + 0.15, y - 0.1) < 0.08) & (z >= TABLE_TOP) & (z < 0.35)
        foot = (np.hypot(x + 0.15, y - 0.1) < 0.2) & (z >= TABLE_TOP) & (z < TABLE_TOP + 0.14)
        shade = (np.abs(x + 0.05) < 0.3) & (np.abs(y - 0.1) < 0.12) & (np.abs(z - 0.4) < 0.1)
        label[stem | foot | shade] = LAMP
        if fragments:
            random = np.random.default_rng(1)
            free = np.flatnonzero((label == EMPTY) & (z > -0.1))
            label[random.choice(free, 30)] = FRAGMENT
        self.cells, self.labels, self.count = cells, label, count
        density = np.where(label > 0, DENSITY, 0.0).reshape((count,) * 3)
        sh = np.zeros((*density.shape, 9, 3), np.float32)
        for number, color in COLORS.items():
            sh[(label == number).reshape(density.shape), 0] = (np.array(color) - 0.5) / 0.28209479
        self.field = VoxelField.from_dense(density, sh, self.bounds, device=device)

    def world(self, point):
        """(3,) a point of the scene's own axes in the world."""
        return self.turn @ np.asarray(point, float)

    def heights(self):
        """(n,) of all nodes above the table."""
        return self.own[:, 2] - TABLE_TOP

    def camera(self, eye=(2.2, -2.4, 1.6), size=96):
        eye, middle, up = (self.world(place) for place in (eye, (0, 0, 0), (0, 0, 1)))
        return Camera.look_at(eye, middle, up=up, fov_degrees=40, width=size, height=size)

    def pixel_of(self, camera, label):
        """(2,) a pixel of a camera that shows what has a label, by the nearest node there."""
        places = self.cells[self.labels == label]
        pixels, depth = camera.project(self.cells[self.labels > 0])
        seen = {}
        owner = self.labels[self.labels > 0]
        for number, (place, far) in enumerate(zip(np.floor(pixels).astype(int), depth, strict=True)):
            if tuple(place) not in seen or far < depth[seen[tuple(place)]]:
                seen[tuple(place)] = number
        middle = camera.project(places)[0].mean(axis=0)
        own = [place for place, number in seen.items() if owner[number] == label]
        return min(own, key=lambda place: np.linalg.norm(np.add(place, 0.5) - middle))


#: Half the side of the room; cameras stand in it, around the model.
ROOM = 9.0


def room_color(origins, directions):
    """(..., 3) of the walls where rays from inside the room meet them: smooth paint, unlike on every side."""
    with np.errstate(divide="ignore"):
        distance = (np.where(directions > 0, ROOM, -ROOM) - origins) / directions
    place = (origins + distance.min(axis=-1)[..., None] * directions) / ROOM
    waves = np.array([[2.9, 1.3, -2.1], [-1.7, 2.6, 1.4], [1.1, -2.2, 3.1]])
    return 0.5 + 0.42 * np.sin(place @ waves.T + [0.3, 1.1, 2.5])


def room_cameras(count, size, turn=0.0):
    """Once around the model, up and down."""
    angles = turn + 2 * np.pi * np.arange(count) / count
    lifts = 0.35 + 0.3 * np.sin(3 * angles)
    eyes = 4.0 * np.stack([np.cos(angles) * np.cos(lifts), np.sin(angles) * np.cos(lifts), np.sin(lifts)], axis=1)
    return [Camera.look_at(eye, (0, 0, 0), fov_degrees=48, width=size, height=size) for eye in eyes]


def room_pictures(count, size, turn=0.0):
    """Pictures of the model in straight alpha, and (n, h, w, 3) uint8 of them before the walls."""
    cameras = room_cameras(count, size, turn)
    rgba = render_mesh_views(*brick_model(), cameras, samples=2)
    walls = np.stack([room_color(*camera.rays()) for camera in cameras])
    whole = rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]) * walls
    return Pictures(np.rint(255 * rgba).astype(np.uint8), cameras), np.rint(255 * whole).astype(np.uint8)


def room_scene(count, size, *, masks, turn=0.0):
    """Scene of whole pictures (masks=False), or of ones that are split at the model's outline ("split")."""
    pictures, whole = room_pictures(count, size, turn)
    whole = whole / 255.0
    if not masks:
        return Scene(whole, None, pictures.cameras)
    alphas = pictures.rgba[..., 3] / 255.0
    walls = np.stack([room_color(*camera.rays()) for camera in pictures.cameras])
    around = (1 - alphas[..., None]) * walls
    return Scene(whole - around + 1 - alphas[..., None], alphas, pictures.cameras, surroundings=around)


def write_room(folder, count, size):
    """The scene as a DTU folder: whole pictures, and masks beside them."""
    pictures, whole = room_pictures(count, size)
    write_dtu(folder, dataclasses.replace(pictures, rgba=np.concatenate([whole, pictures.rgba[..., 3:]], axis=-1)))
    for i, alpha in enumerate(pictures.rgba[..., 3]):
        write_image(folder / "mask" / f"{i:03d}.png", np.repeat(alpha[..., None], 3, axis=-1))
    return folder


OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def table_pictures(times, *, size=(200, 150), fov_degrees=62.0, route=None):
    """Pictures (n, h, w, 3) uint8 of the table scene at times of a walk, and their cameras."""
    route = PhonePath(shake=(0.0, 0.0)) if route is None else route
    cameras = phone_cameras(times, size, fov_degrees, route)
    return render_table(cameras), cameras


def render_table(cameras):
    """Pictures (n, h, w, 3) uint8 of the table scene."""
    rgba, _ = CarriedMesh(*table_scene(), texture=TEXTURE, device="cpu").render(cameras, samples=1)
    return np.round(rgba[..., :3] * 255).astype(np.uint8)


def save_pictures(folder, pictures, *, ending=".png", orientation=None, focal_35=None, first=0):
    """Write pictures, with EXIF where it is asked for: turned as a phone stores them."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    for index, picture in enumerate(pictures, first):
        exif = Image.Exif()
        if orientation is not None:
            exif[0x0112] = orientation
        if focal_35 is not None:
            exif.get_ifd(0x8769)[0xA405] = focal_35
        Image.fromarray(picture).save(folder / f"p{index:03d}{ending}", exif=exif, quality=97, subsampling=0)
    return folder


def found_poses(folder):
    """Names, poses (n, 4, 4) with OpenCV axes, and frames of a captured scene, by its transforms.json."""
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    names = [pathlib.Path(frame["file_path"]).stem for frame in frames]
    return names, np.array([frame["transform_matrix"] for frame in frames]) @ OPENCV, frames


def similarity(found, true):
    """Rotation, scale and shift that take found places (n, 3) nearest to true ones (Umeyama 1991)."""
    middle, goal = found.mean(axis=0), true.mean(axis=0)
    u, s, v = np.linalg.svd((true - goal).T @ (found - middle))
    signs = np.array([1.0, 1.0, np.linalg.det(u @ v)])
    rotation = u @ np.diag(signs) @ v
    scale = float((s * signs).sum() / ((found - middle) ** 2).sum())
    return rotation, scale, goal - scale * rotation @ middle


def camera_errors(found, true):
    """Degrees (n,) between rotations, and distances (n,) as shares of the cameras' mean distance from the origin, after
    the similarity that fits the places best."""
    true = np.array([camera.camera_to_world for camera in true])
    rotation, scale, shift = similarity(found[:, :3, 3], true[:, :3, 3])
    degrees = [angle(rotation @ a, b) for a, b in zip(found[:, :3, :3], true[:, :3, :3], strict=True)]
    off = np.linalg.norm(scale * found[:, :3, 3] @ rotation.T + shift - true[:, :3, 3], axis=1)
    return np.array(degrees), off / np.linalg.norm(true[:, :3, 3], axis=1).mean()


def relative_errors(found, true):
    """Degrees between the found and the true turn from each camera to each other one."""
    true = [camera.camera_to_world[:3, :3] for camera in true]
    pairs = itertools.combinations(range(len(true)), 2)
    return np.array([angle(found[a, :3, :3].T @ found[b, :3, :3], true[a].T @ true[b]) for a, b in pairs])


def angle(a, b):
    """Degrees between two rotations."""
    return float(np.degrees(2 * np.arcsin(min(1.0, np.linalg.norm(a - b) / np.sqrt(8)))))


def blob_scene(count=14, size=40, scale=1.0, offset=(0.0, 0.0, 0.0), with_alpha=True, device=None):
    """Views of a field with a coloured box in it, rendered by ourselves: the fit must find what was put in."""
    n = 24
    density, sh = np.zeros((n, n, n)), np.zeros((n, n, n, 9, 3))
    density[7:17, 8:16, 6:18] = 60.0 / scale
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij"), axis=-1)
    sh[..., 0, :] = grid / 0.2820948  # colour by position
    offset = np.asarray(offset)
    field = VoxelField.from_dense(density, sh, [offset - scale, offset + scale], device=device)
    lens = {"fov_degrees": 35, "width": size, "height": size}
    cameras = turntable(offset, 3.2 * scale, 30, count // 2, **lens)
    cameras += turntable(offset, 3.2 * scale, -25, count - count // 2, start_degrees=13, **lens)
    frames = [field.render(camera) for camera in cameras]
    alphas = np.stack([frame.alpha for frame in frames]) if with_alpha else None
    return Scene(np.stack([frame.rgb for frame in frames]), alphas, cameras)
