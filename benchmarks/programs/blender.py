"""Blender: its Mesh Deform as a preview, cages through it and back, and files of it for the tests.

What runs in Blender's own Python imports NumPy alone beside it:

    python -m venv blender && blender/bin/pip install bpy          # Blender as a module, about 400 MB; its own Python
"""

from __future__ import annotations

import argparse
import json
import math
import pathlib
import random
import subprocess
import sys
import tempfile

import numpy as np
from common import HERE, command, option

#: Precisions of Blender's modifier: its grid has 2^precision cells a side, and a few more.
PRECISIONS = (4, 5, 6)

#: Name: (format, up, changes of the mesh in Blender, options of the exporter). "through" reads the cage in the same
#: format with Blender's default axes, as for a user who changes no setting; the others read OBJ, z up.
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

#: Of pictures of cameras, and points in them.
WIDTH, HEIGHT = 320, 200

POINTS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-0.5, 0.8)])


# Mesh Deform as a preview


@command(
    option("--blender", default=sys.executable, help="Python that has bpy (default: this one)"),
    option("--field", help="field file (default: the editor's demo)"),
    option("--cage", help="cage at rest of that field"),
    option("--posed", default="bend:40:z:x", help="posed cage, or a preset (default: %(default)s)"),
    option("--resolution", type=int, default=128, help="cells of the map's lattice (default: %(default)s)"),
    option("--inverted", type=int, default=400, help="vertices that are inverted (default: %(default)s)"),
    option("--size", type=int, default=300, help="pixels a side of pictures (default: %(default)s)"),
    option("--out", metavar="DIR", help="where preview.png and figures.json go"),
    option("--device", help='"cpu" or "cuda:0" (default: CUDA where there is one)'),
    option("--blender-part", help=argparse.SUPPRESS),
)
def preview(args) -> None:
    """Blender's Mesh Deform as a live preview: how far what it shows is from what warpcage renders.

        python benchmarks blender preview --blender blender/bin/python --out out            (the editor's demo)
        python benchmarks blender preview --blender blender/bin/python --field lego.npz --cage cage.obj --posed bend:40

    Blender and warpcage take the same harmonic coordinates (Joshi et al. 2007), bound the other way round: Blender
    binds the mesh to the cage at rest and moves it with the cage; warpcage binds space to the posed cage and looks up
    where it was at rest. Both meet on the cage and differ within it. The mesh goes to Blender with colors, as GLB;
    Blender binds it and poses the cage. Printed, as shares of the cage's size, over the vertices of the mesh:

        forward   Blender's vertices beside warpcage's own harmonic coordinates of the cage at rest: how alike both are
        preview   how far the matter that warpcage shows at Blender's vertex lies from that vertex, at rest
        posed     how far warpcage shows a vertex from where Blender does (the inverse of the map, at --inverted of
                  them)

    Each for several precisions of Blender's modifier. --out gets preview.png: rest, Blender's picture, warpcage's, and
    their difference about gray, 2.5 times; figures.json.
    """
    if args.blender_part:
        blender_part(pathlib.Path(args.blender_part))
        return
    from ground_truth import InverseMap

    import warpcage
    from warpcage import deform_points, psnr
    from warpcage.core import resolve_device
    from warpcage.mesh import write_glb
    from warpcage.studio.editor import demo_files
    from warpcage.studio.films import AssetResolver, RestCage
    from warpcage.view import contact_sheet, read_image, write_png

    device = resolve_device(args.device)
    field_path, cage_path = (args.field, args.cage) if args.field else demo_files(device)
    field = warpcage.VoxelField.load(field_path, device=device)
    cage = warpcage.Cage.load(cage_path)
    posed = AssetResolver().pose(RestCage(cage), args.posed)
    mesh = field.extract_mesh(colors=True)
    vertices = np.asarray(mesh.vertices)
    middle = (cage.bounds[0] + cage.bounds[1]) / 2
    eye = middle + cage.size * np.array([1.1, -1.5, 0.8])
    camera = warpcage.Camera.look_at(eye, middle, width=args.size, height=args.size, fov_degrees=38)
    deformer = warpcage.Deformer(field, cage, resolution=args.resolution).pose(posed)

    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255.0
        upright = vertices[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
        (folder / "mesh.glb").write_bytes(write_glb(upright, np.asarray(mesh.faces, np.int32), colors, name="mesh"))
        cage.save(folder / "cage.obj")  # which keeps polygons, and the order of vertices
        view = {"view": camera.camera_to_world, "fov": 38.0, "size": args.size}
        np.savez(folder / "pose.npz", posed=posed.vertices, precisions=PRECISIONS, **view)
        run_in_blender(args.blender, "blender preview", folder, "moved.npz")
        found = dict(np.load(folder / "moved.npz"))
        picture = read_image(folder / "blender.png")
    picture = picture[..., :3] * picture[..., 3:] + 1.0 - picture[..., 3:]  # on white

    forward = deform_points(vertices, cage, posed, coordinates="harmonic", device=device)
    chosen = np.random.default_rng(0).choice(len(vertices), min(args.inverted, len(vertices)), replace=False)
    seen = InverseMap(cage, posed, "harmonic", device=device).invert(vertices[chosen])
    reached = seen.residuals < 1e-6 * cage.size
    figures = {
        "blender": str(found["version"]),
        "vertices": len(vertices),
        "reached": float(reached.mean()),
        "rows": [],
    }
    print(f"Blender {figures['blender']}, {len(vertices)} vertices, a cage of {len(cage.vertices)}, posed {args.posed}")
    print(f"{'precision':>9}  " + "  ".join(f"{name:>24}" for name in ("forward", "preview", "posed")))
    print(f"{'':9}  " + "  ".join(f"{'median':>7} {'95 %':>7} {'most':>8}" for _ in range(3)))
    for precision in PRECISIONS:
        moved = found[f"moved_{precision}"]
        canonical, _, region = deformer.to_canonical(moved, np.broadcast_to([0.0, 0.0, 1.0], moved.shape))
        errors = {
            "forward": moved - forward,
            "preview": (canonical - vertices)[region == 2],
            "posed": (moved[chosen] - seen.points)[reached],
        }
        row = {name: shares(error, cage.size) for name, error in errors.items()}
        figures["rows"].append({"precision": precision, **row})
        text = "  ".join(f"{median:7.1e} {most:7.1e} {worst:8.1e}" for median, most, worst in row.values())
        print(f"{precision:9d}  {text}")
    rendered = np.clip(deformer.render(camera, background="white").rgb, 0, 1)
    figures["psnr"] = psnr(picture, rendered)
    print(f"Blender's picture of the colored mesh beside the rendered field: {figures['psnr']:.1f} dB")
    if args.out:
        out = pathlib.Path(args.out)
        rest = np.clip(field.render(camera, background="white").rgb, 0, 1)
        difference = np.clip(0.5 + 2.5 * (picture - rendered), 0, 1)
        write_png(out / "preview.png", contact_sheet([rest, picture, rendered, difference], columns=4))
        (out / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")


def run_in_blender(blender: str, command: str, folder: pathlib.Path, result: str) -> None:
    """The part of a command that needs bpy, by Blender's Python; it writes the file `result`."""
    asked = [blender, str(HERE), *command.split(), "--blender-part", str(folder)]
    done = subprocess.run(asked, capture_output=True, text=True)
    if not (folder / result).exists():
        raise SystemExit(f"Blender failed:\n{(done.stdout + done.stderr)[-2000:]}")


def shares(errors: np.ndarray, size: float) -> tuple[float, float, float]:
    """Median, 95th percentile and largest length of errors (n, 3), as shares of a size."""
    lengths = np.linalg.norm(errors, axis=1) / size
    return float(np.median(lengths)), float(np.percentile(lengths, 95)), float(lengths.max())


def blender_part(folder: pathlib.Path) -> None:
    """What an artist does in Blender, by script: import, bind, pose; and a picture where there is a view of it.
    Needs bpy and NumPy alone."""
    import bpy

    given = np.load(folder / "pose.npz")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(folder / "mesh.glb"))
    mesh = bpy.context.selected_objects[0]
    bpy.ops.wm.obj_import(filepath=str(folder / "cage.obj"), forward_axis="Y", up_axis="Z")
    cage = bpy.context.selected_objects[0]
    place = np.linalg.inv(np.array(cage.matrix_world))
    rest = np.array([vertex.co[:] for vertex in cage.data.vertices])
    posed = given["posed"] @ place[:3, :3].T + place[:3, 3]
    moved = {}
    modifier = mesh.modifiers.new("preview", "MESH_DEFORM")
    modifier.object = cage
    bpy.context.view_layer.objects.active = mesh
    for precision in given["precisions"].tolist():
        if modifier.is_bound:
            bpy.ops.object.meshdeform_bind(modifier=modifier.name)  # unbinds
        cage.data.vertices.foreach_set("co", rest.reshape(-1))
        cage.data.update()
        bpy.context.view_layer.update()
        modifier.precision = precision
        bpy.ops.object.meshdeform_bind(modifier=modifier.name)
        if not modifier.is_bound:
            raise SystemExit("Blender could not bind the mesh to the cage")
        cage.data.vertices.foreach_set("co", posed.reshape(-1))
        cage.data.update()
        bpy.context.view_layer.update()
        shown = mesh.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        places = np.empty(3 * len(shown.vertices))
        shown.vertices.foreach_get("co", places)
        world = np.array(mesh.matrix_world)
        moved[f"moved_{precision}"] = places.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3]

    if "view" in given:
        write_picture(bpy.context.scene, cage, given, folder / "blender.png")
    np.savez(folder / "moved.npz", version=bpy.app.version_string, **moved)


def write_picture(scene, cage, given, path: pathlib.Path) -> None:
    """Blender's picture of all but the cage, from the view of pose.npz."""
    import bpy
    from mathutils import Matrix

    bpy.ops.preferences.addon_enable(module="cycles")
    size = int(given["size"])
    eye = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(eye)
    eye.matrix_world = Matrix((given["view"] @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist())  # Blender looks along -z
    eye.data.angle = float(np.radians(given["fov"]))
    scene.camera = eye
    cage.hide_render = True
    scene.world = bpy.data.worlds.new("white")
    scene.world.color = (1.0, 1.0, 1.0)
    scene.render.engine, scene.cycles.samples = "CYCLES", 16
    scene.render.resolution_x = scene.render.resolution_y = size
    scene.render.film_transparent = True
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"
    scene.view_settings.view_transform = "Standard"  # colors as they were captured
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


# Cages there and back


@command(option("--fixtures", help="folder for the rest cage and Blender's files of the cylinder"))
def round_trip(args) -> int:
    """Cages through Blender and back: exported, posed by a modifier, imported, matched.

        python benchmarks blender round-trip
        python benchmarks blender round-trip --fixtures tests/data/blender

    Each row is one route: warpcage writes a cage, Blender reads it, bends it by a Simple Deform modifier and writes it
    in one of its dialects, and warpcage loads and matches it. The error is the largest distance between a matched
    vertex and its place in Blender, as a share of the cage's size. Text files keep six decimals, PLY and glTF float32.
    """
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
    print("\n".join(rows))  # at the end, since Blender prints lines of its own in between
    print(f"worst error {worst:.1e} of the size")
    return 0 if worst < 2e-6 else 1


def cages() -> dict:
    """A box, a ring and two separate balls, all away from their axes of symmetry."""
    import warpcage

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

    import warpcage

    ending, up, changes, options = WAYS[way]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bring_in(cage, folder, ending, changes)
    blender_object = bpy.context.selected_objects[0]
    bpy.context.view_layer.objects.active = blender_object
    prepare(blender_object, changes)
    number = [value.value for value in blender_object.data.attributes["cage_vertex"].data]
    blender_object.data.attributes.remove(blender_object.data.attributes["cage_vertex"])
    rest_file = folder / f"{way}_rest.{ending}"
    if any(word in changes for word in ("quads", "ngons")):
        export(rest_file, ending, up, options)  # other faces than the cage has: another cage

    modifier = blender_object.modifiers.new("bend", "SIMPLE_DEFORM")
    modifier.deform_method, modifier.deform_axis, modifier.angle = "BEND", "X", 0.7
    bpy.ops.object.modifier_apply(modifier=modifier.name)
    expected = np.empty((len(cage.vertices), 3))
    expected[number] = [vertex.co[:] for vertex in blender_object.data.vertices]

    posed_file = folder / f"{way}.{ending}"
    if "through" in changes:  # the vertices are those of the file turned to Blender's axes and back
        place = np.array(blender_object.matrix_world)
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


def prepare(blender_object, changes: str) -> None:
    """Change the mesh as a route asks for. The attribute cage_vertex keeps the index of each vertex in the cage."""
    import bpy

    mesh = blender_object.data
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
        group = blender_object.vertex_groups.new(name="top")
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


# Files for the tests


@command(option("folder", type=pathlib.Path, help="where the files go"))
def cameras(args) -> None:
    """Cameras of Blender, as glTF, and where Blender has points in their pictures: files for the tests.

        python benchmarks blender cameras tests/data/blender_cameras

    A camera that stands still, and one that is animated and hangs on an object that turns. Each .glb is written with
    Blender's defaults but for the cameras; beside it NAME.npz holds `points` (n, 3) in world units, `pixels` (frames,
    n, 2) of them, the first pixel's center at (0.5, 0.5), and `size`, width and height.
    """
    import bpy

    folder = args.folder
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
    import bpy

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
    import bpy
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    scene.frame_set(frame)
    bpy.context.view_layer.update()
    seen = np.array([world_to_camera_view(scene, camera, Vector(point)) for point in POINTS])
    return np.stack([seen[:, 0] * WIDTH, (1.0 - seen[:, 1]) * HEIGHT], axis=1)


@command(option("folder", type=pathlib.Path, help="where the files go"))
def motion(args) -> None:
    """A cage that moves in Blender, as glTF and USD, and its vertices at each frame: files for the tests.

        python benchmarks blender motion tests/data/blender_motion

    Shape keys, those at 30 frames a second, an animated object, and an armature with weights between two bones. Each
    .glb and .usdc is written with Blender's defaults; beside it NAME.npz holds `vertices` (frames, v, 3) in world
    units, float32.
    """
    import bpy

    folder = args.folder
    for build in (shape_keys, shape_keys_at_30, moved_object, armature):
        name = build.__name__
        bpy.ops.wm.read_factory_settings(use_empty=True)
        cube = subdivided_cube()
        build(cube)
        np.savez_compressed(folder / f"{name}.npz", vertices=vertices_by_frame(cube))
        bpy.ops.export_scene.gltf(filepath=str(folder / f"{name}.glb"), export_format="GLB")
        bpy.ops.wm.usd_export(filepath=str(folder / f"{name}.usdc"), export_animation=True)


def subdivided_cube():
    """A cube of 56 vertices."""
    import bpy

    bpy.ops.mesh.primitive_cube_add(size=2)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.subdivide(number_cuts=2)
    bpy.ops.object.mode_set(mode="OBJECT")
    return bpy.context.object


def vertices_by_frame(cube) -> np.ndarray:
    """(frames, v, 3) float32 where Blender has the vertices."""
    import bpy

    scene, frames = bpy.context.scene, []
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        posed = cube.evaluated_get(bpy.context.evaluated_depsgraph_get())
        frames.append([posed.matrix_world @ vertex.co for vertex in posed.data.vertices])
    return np.array(frames, np.float32)


def shape_keys(cube, first: int = 1) -> None:
    """A bend that comes, and a height that comes and goes."""
    import bpy

    bpy.context.scene.frame_start, bpy.context.scene.frame_end = first, first + 11
    cube.shape_key_add(name="Basis")
    bend, tall = (cube.shape_key_add(name=name) for name in ("Bend", "Tall"))
    for vertex in bend.data:
        vertex.co.x += 0.4 * vertex.co.z**2
    for vertex in tall.data:
        vertex.co.z *= 1.5
    for key, values in ((bend, {0: 0.0, 11: 1.0}), (tall, {0: 0.0, 5: 0.5, 11: 0.0})):
        for frame, value in values.items():
            key.value = value
            key.keyframe_insert("value", frame=first + frame)


def shape_keys_at_30(cube) -> None:
    """The same at 30 frames a second from frame 10 on, below an object that is turned."""
    import bpy

    bpy.context.scene.render.fps = 30
    shape_keys(cube, first=10)
    cube.parent = bpy.data.objects.new("above", None)
    bpy.context.collection.objects.link(cube.parent)
    cube.parent.rotation_euler, cube.parent.location, cube.scale = (0.2, 0.0, 0.5), (3.0, 1.0, 0.0), (1.2, 1.0, 0.8)


def moved_object(cube) -> None:
    """A turn and a way."""
    import bpy

    bpy.context.scene.frame_end = 10
    for frame, place, turn in ((1, (0, 0, 0), (0, 0, 0)), (10, (1, 0, 0.5), (0.3, 0, math.pi / 2))):
        cube.location, cube.rotation_euler = place, turn
        cube.keyframe_insert("location", frame=frame)
        cube.keyframe_insert("rotation_euler", frame=frame)


def armature(cube) -> None:
    """Two bones, of which the upper one turns."""
    import bpy

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
