"""Videos and folders of pictures for tests of captures, and how found cameras compare with true ones."""

import itertools
import json
import pathlib

import numpy as np

from warpcage import Camera
from warpcage.reference import TEXTURE, CarriedMesh, PhonePath, table_scene

OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def table_pictures(times, *, size=(200, 150), fov_degrees=62.0, route=None):
    """Pictures (n, h, w, 3) uint8 of the table scene at times of a walk, and their cameras."""
    route = PhonePath(shake=(0.0, 0.0)) if route is None else route
    width, height = size
    focal = 0.5 * width / np.tan(np.radians(fov_degrees) / 2)
    cameras = [Camera(focal, focal, width / 2, height / 2, width, height, route.pose(time)) for time in times]
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
