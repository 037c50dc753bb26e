"""A captured scene of the project's own: the brick model in a room whose walls are painted, seen whole."""

import dataclasses

import numpy as np
from scene_writers import Pictures, write_dtu, write_image

from warpcage import Camera, Scene
from warpcage.reference import brick_model, render_mesh_views

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
