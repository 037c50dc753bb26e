"""A cage that moves in Blender, as glTF, and where Blender has its vertices at each frame: files for the tests.

    pip install bpy                                                   # Blender as a module; about 400 MB
    python benchmarks/blender_motion.py tests/fixtures/blender_motion

Shape keys, an animated object, and an armature with weights between two bones. Each .glb is written with Blender's
defaults; beside it NAME.npz holds `vertices` (frames, v, 3) in world units, float32.
"""

from __future__ import annotations

import math
import pathlib
import sys

import numpy as np


def write_all(folder: pathlib.Path) -> None:
    """Write the three motions."""
    for name, build in (("shape_keys", shape_keys), ("moved_object", moved_object), ("armature", armature)):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        cube = subdivided_cube()
        build(cube)
        np.savez_compressed(folder / f"{name}.npz", vertices=vertices_by_frame(cube))
        bpy.ops.export_scene.gltf(filepath=str(folder / f"{name}.glb"), export_format="GLB")


def subdivided_cube():
    """A cube of 56 vertices."""
    bpy.ops.mesh.primitive_cube_add(size=2)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.subdivide(number_cuts=2)
    bpy.ops.object.mode_set(mode="OBJECT")
    return bpy.context.object


def vertices_by_frame(cube) -> np.ndarray:
    """(frames, v, 3) float32 where Blender has the vertices."""
    scene, frames = bpy.context.scene, []
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        posed = cube.evaluated_get(bpy.context.evaluated_depsgraph_get())
        frames.append([posed.matrix_world @ vertex.co for vertex in posed.data.vertices])
    return np.array(frames, np.float32)


def shape_keys(cube) -> None:
    """A bend that comes, and a height that comes and goes."""
    bpy.context.scene.frame_end = 12
    cube.shape_key_add(name="Basis")
    bend, tall = (cube.shape_key_add(name=name) for name in ("Bend", "Tall"))
    for vertex in bend.data:
        vertex.co.x += 0.4 * vertex.co.z**2
    for vertex in tall.data:
        vertex.co.z *= 1.5
    for key, values in ((bend, {1: 0.0, 12: 1.0}), (tall, {1: 0.0, 6: 0.5, 12: 0.0})):
        for frame, value in values.items():
            key.value = value
            key.keyframe_insert("value", frame=frame)


def moved_object(cube) -> None:
    """A turn and a way."""
    bpy.context.scene.frame_end = 10
    for frame, place, turn in ((1, (0, 0, 0), (0, 0, 0)), (10, (1, 0, 0.5), (0.3, 0, math.pi / 2))):
        cube.location, cube.rotation_euler = place, turn
        cube.keyframe_insert("location", frame=frame)
        cube.keyframe_insert("rotation_euler", frame=frame)


def armature(cube) -> None:
    """Two bones, of which the upper one turns."""
    bpy.context.scene.frame_end = 8
    bpy.ops.object.armature_add(location=(0, 0, -1))
    rig = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    bones = rig.data.edit_bones
    bones[0].head, bones[0].tail = (0, 0, 0), (0, 0, 1)
    top = bones.new("top")
    top.head, top.tail, top.parent = (0, 0, 1), (0, 0, 2), bones[0]
    bpy.ops.object.mode_set(mode="OBJECT")
    cube.parent, cube.matrix_parent_inverse = rig, rig.matrix_world.inverted()
    cube.modifiers.new("rig", "ARMATURE").object = rig
    lower, upper = (cube.vertex_groups.new(name=bone.name) for bone in rig.data.bones)
    for vertex in cube.data.vertices:
        share = min(1.0, max(0.0, (vertex.co.z + 1.0) / 2.0))
        lower.add([vertex.index], 1.0 - share, "REPLACE")
        upper.add([vertex.index], share, "REPLACE")
    bone = rig.pose.bones["top"]
    bone.rotation_mode = "XYZ"
    for frame, turn in ((1, (0, 0, 0)), (8, (0.8, 0, 0.2))):
        bone.rotation_euler = turn
        bone.keyframe_insert("rotation_euler", frame=frame)


if __name__ == "__main__":
    import bpy

    write_all(pathlib.Path(sys.argv[1]))
