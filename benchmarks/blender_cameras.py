"""Cameras of Blender, as glTF, and where Blender has points in their pictures: files for the tests.

    pip install bpy                                                     # Blender as a module; about 400 MB
    python benchmarks/blender_cameras.py tests/fixtures/blender_cameras

A camera that stands still, and one that is animated and hangs on an object that turns. Each .glb is written with
Blender's defaults but for the cameras; beside it NAME.npz holds `points` (n, 3) in world units, `pixels` (frames, n, 2)
of them, the first pixel's centre at (0.5, 0.5), and `size`, width and height.
"""

from __future__ import annotations

import pathlib
import sys

import bpy
import numpy as np
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector

WIDTH, HEIGHT = 320, 200

POINTS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-0.5, 0.8)])


def write_all(folder: pathlib.Path) -> None:
    """Write both files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, animate in (("still", False), ("moving", True)):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
        camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
        camera.data.lens = 40.0
        camera.location, camera.rotation_euler = (6.0, -5.0, 3.0), (1.15, 0.05, 0.85)
        scene.collection.objects.link(camera)
        scene.camera = camera
        scene.frame_end = 1
        if animate:
            move(scene, camera)
        pixels = [pixels_at(scene, camera, frame) for frame in range(1, scene.frame_end + 1)]
        np.savez_compressed(folder / f"{name}.npz", points=POINTS, pixels=np.array(pixels), size=[WIDTH, HEIGHT])
        path = str(folder / f"{name}.glb")
        bpy.ops.export_scene.gltf(filepath=path, export_format="GLB", export_cameras=True)


def move(scene, camera) -> None:
    """The camera goes forth, and what it hangs on turns."""
    scene.frame_end = 9
    pivot = bpy.data.objects.new("Pivot", None)
    scene.collection.objects.link(pivot)
    camera.parent = pivot
    for frame, place, turn in ((1, (6.0, -5.0, 3.0), 0.0), (9, (5.0, -4.0, 3.5), 0.7)):
        camera.location, pivot.rotation_euler = place, (0.0, 0.1 * turn, turn)
        camera.keyframe_insert("location", frame=frame)
        pivot.keyframe_insert("rotation_euler", frame=frame)


def pixels_at(scene, camera, frame: int) -> np.ndarray:
    """(n, 2) where Blender has the points."""
    scene.frame_set(frame)
    bpy.context.view_layer.update()
    seen = np.array([world_to_camera_view(scene, camera, Vector(point)) for point in POINTS])
    return np.stack([seen[:, 0] * WIDTH, (1.0 - seen[:, 1]) * HEIGHT], axis=1)


if __name__ == "__main__":
    write_all(pathlib.Path(sys.argv[1]))
