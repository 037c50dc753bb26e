"""Cages through Blender and back: exported, posed by a modifier, imported, matched.

    pip install bpy                                                   # Blender as a module; about 400 MB
    python benchmarks/blender_round_trip.py
    python benchmarks/blender_round_trip.py --fixtures tests/fixtures/blender

Each row is one way through: a cage written by warpcage, read by Blender, bent by a Simple Deform modifier, written by
Blender in one of its dialects, loaded and matched. The error is the largest distance between a matched vertex and
where Blender has it, as a share of the cage's size; text files keep six decimals, PLY and glTF float32.
"""

from __future__ import annotations

import argparse
import pathlib
import random
import sys
import tempfile

import numpy as np

import warpcage

#: name: (format, up, what is done to the mesh in Blender, options of the exporter). "through" reads the cage in the
#: same format and with Blender's own axes for it, as a user does who changes no setting; the others read OBJ, z up.
WAYS = {
    "obj_plain": ("obj", "z", "", {"export_normals": False, "export_uv": False, "export_materials": False}),
    "obj_default": ("obj", "y", "materials", {}),
    "obj_groups": ("obj", "y", "materials groups", {"export_object_groups": True, "export_material_groups": True,
                                                    "export_vertex_groups": True, "export_smooth_groups": True}),
    "obj_quads": ("obj", "z", "quads", {}),
    "obj_ngons": ("obj", "z", "ngons", {}),
    "obj_quads_triangulated": ("obj", "z", "quads", {"export_triangulated_mesh": True}),
    "obj_shuffled": ("obj", "z", "shuffled", {}),
    "obj_through": ("obj", None, "through", {}),
    "ply_through": ("ply", None, "through", {}),
    "glb_through": ("glb", None, "through", {}),
    "ply": ("ply", "z", "", {"export_normals": True}),
    "ply_ascii_y_up": ("ply", "y", "quads", {"ascii_format": True}),
    "ply_shuffled": ("ply", "z", "shuffled", {}),
    "glb": ("glb", None, "materials", {}),
    "glb_bare": ("glb", None, "", {"export_normals": False, "export_materials": "NONE"}),
    "gltf_shuffled": ("glb", None, "shuffled smooth", {}),
}  # fmt: skip


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fixtures", help="folder to keep the rest cage and Blender's files of the cylinder in")
    args = parser.parse_args(argv)
    try:
        import bpy
    except ImportError:
        print("bpy is not installed: pip install bpy (Python of the version it is built for)", file=sys.stderr)
        return 2
    worst, rows = (
        0.0,
        [f"Blender {bpy.app.version_string}", f"{'cage':10} {'way':24} {'vertices in file':>16} {'error':>9}"],
    )
    for name, cage in cages().items():
        with tempfile.TemporaryDirectory() as temporary:
            keep = args.fixtures if name == "cylinder" else None
            folder = pathlib.Path(keep or temporary)
            folder.mkdir(parents=True, exist_ok=True)
            cage.save(folder / "rest.obj")
            for way in WAYS:
                count, error, vertices = through(cage, folder, way)
                worst = max(worst, error)
                rows.append(f"{name:10} {way:24} {count:16d} {error:9.1e}")
            if keep:
                for file in folder.glob("*.mtl"):
                    file.unlink()
                np.savetxt(folder / "bent.txt", vertices, fmt="%.9g")
    print("\n".join(rows))  # at the end: Blender's own lines come in between
    print(f"worst error {worst:.1e} of the size")
    return 0 if worst < 2e-6 else 1


def cages() -> dict[str, warpcage.Cage]:
    """A box, a ring and two separate balls, all away from their axes of symmetry."""
    box = warpcage.Cage.box([-0.4, -0.3, -1.0], [0.5, 0.3, 1.0], segments=(2, 1, 4))
    ring = warpcage.Cage.cylinder([0, 0, 0], 0.5, 2.0, sides=7, rings=4)
    ball = warpcage.Cage.icosphere([0.2, 0, -0.7], 0.5)
    two = np.concatenate([ball.vertices, ball.vertices * [1.0, 0.8, 0.7] + [0.1, 0.0, 1.5]])
    return {
        "box": box,
        "cylinder": ring,
        "two balls": warpcage.Cage(two, np.concatenate([ball.faces, ball.faces + len(ball.vertices)])),
    }


def through(cage, folder, way: str) -> tuple[int, float, np.ndarray]:
    """Vertices in Blender's posed file, error of the matched pose, and Blender's own vertices in the cage's order."""
    import bpy

    ending, up, changes, options = WAYS[way]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bring_in(cage, folder, ending, changes)
    thing = bpy.context.selected_objects[0]
    bpy.context.view_layer.objects.active = thing
    prepare(thing, changes)
    number = [value.value for value in thing.data.attributes["cage_vertex"].data]
    thing.data.attributes.remove(thing.data.attributes["cage_vertex"])
    rest_file = folder / f"{way}_rest.{ending}"
    if any(word in changes for word in ("quads", "ngons")):
        export(rest_file, ending, up, options)  # other faces than the cage had: a cage of its own

    modifier = thing.modifiers.new("bend", "SIMPLE_DEFORM")
    modifier.deform_method, modifier.deform_axis, modifier.angle = "BEND", "X", 0.7
    bpy.ops.object.modifier_apply(modifier=modifier.name)
    expected = np.empty((len(cage.vertices), 3))
    expected[number] = [vertex.co[:] for vertex in thing.data.vertices]

    posed_file = folder / f"{way}.{ending}"
    if "through" in changes:  # the vertices are those of the file turned to Blender's axes and back
        place = np.array(thing.matrix_world)
        expected = expected @ place[:3, :3].T + place[:3, 3]
        if ending == "obj":
            expected = expected[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    export(posed_file, ending, "own" if "through" in changes else up, options)
    rest = warpcage.Cage.load(rest_file, up=up) if rest_file.exists() else cage
    posed = warpcage.Cage.load(posed_file, up=up)
    matched = rest.match(posed).vertices
    want = expected[number] if rest_file.exists() else expected
    return len(posed.vertices), float(np.abs(matched - want).max() / cage.size), expected


def bring_in(cage, folder: pathlib.Path, ending: str, changes: str) -> None:
    import bpy

    if "through" not in changes:
        bpy.ops.wm.obj_import(filepath=str(folder / "rest.obj"), forward_axis="Y", up_axis="Z")
        return
    file = folder / f"through.{ending}"
    cage.save(file)
    read = {"obj": bpy.ops.wm.obj_import, "ply": bpy.ops.wm.ply_import, "glb": bpy.ops.import_scene.gltf}[ending]
    read(filepath=str(file))
    file.unlink()


def prepare(thing, changes: str) -> None:
    """Give the mesh what the way asks for; the attribute cage_vertex keeps each vertex's number in the cage."""
    import bpy

    mesh = thing.data
    numbers = mesh.attributes.new("cage_vertex", "INT", "POINT")
    numbers.data.foreach_set("value", np.arange(len(mesh.vertices), dtype=np.int32))
    mesh.shade_flat()
    if "smooth" in changes:
        mesh.shade_smooth()
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    if "quads" in changes:
        bpy.ops.mesh.tris_convert_to_quads()
    if "ngons" in changes:
        bpy.ops.mesh.dissolve_limited(angle_limit=0.02)
        bpy.ops.mesh.select_all(action="SELECT")
    if "shuffled" in changes:
        random.seed(3)
        bpy.ops.mesh.sort_elements(type="RANDOMIZE", elements={"VERT", "FACE"}, seed=3)
    bpy.ops.object.mode_set(mode="OBJECT")
    if "materials" in changes:
        for name in ("red", "blue"):
            mesh.materials.append(bpy.data.materials.new(name))
        for polygon in mesh.polygons:
            polygon.material_index = polygon.index % 2
    if "groups" in changes:
        group = thing.vertex_groups.new(name="top")
        group.add([vertex.index for vertex in mesh.vertices if vertex.co.z > 0], 1.0, "REPLACE")


def export(path: pathlib.Path, ending: str, up: str | None, options: dict) -> None:
    import bpy

    axes = {"forward_axis": "NEGATIVE_Z", "up_axis": "Y"} if up == "y" else {"forward_axis": "Y", "up_axis": "Z"}
    axes = {} if up == "own" else axes
    if ending == "obj":
        bpy.ops.wm.obj_export(filepath=str(path), **axes, **options)
    elif ending == "ply":
        bpy.ops.wm.ply_export(filepath=str(path), **axes, **options)
    else:
        bpy.ops.export_scene.gltf(filepath=str(path), **options)


if __name__ == "__main__":
    sys.exit(main())
