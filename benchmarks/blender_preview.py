"""Blender's Mesh Deform as a live preview: how far what it shows is from what warpcage renders.

    python -m venv blender && blender/bin/pip install bpy          # Blender as a module, about 400 MB; its own Python
    python benchmarks/blender_preview.py --blender blender/bin/python --out out            (the editor's demo)
    python benchmarks/blender_preview.py --blender blender/bin/python --field lego.npz --cage cage.obj --posed bend:40

Blender and warpcage take the same harmonic coordinates (Joshi et al. 2007), bound the other way round: Blender binds
the mesh to the cage at rest and moves it with the cage; warpcage binds space to the posed cage and looks up where it
was at rest. Both meet on the cage and differ within it. The mesh goes to Blender with colours, as GLB; Blender binds it
and poses the cage. Printed, as shares of the cage's size, over the vertices of the mesh:

    forward   Blender's vertices beside warpcage's own harmonic coordinates of the cage at rest: how alike both are
    preview   how far the matter that warpcage shows at Blender's vertex lies from that vertex, at rest
    posed     how far warpcage shows a vertex from where Blender does (the inverse of the map, at --inverted of them)

Each for several precisions of Blender's modifier. --out gets preview.png: rest, Blender's picture, warpcage's, and
their difference about grey, 2.5 times; figures.json.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np

#: Precisions of Blender's modifier: its grid has 2^precision cells a side, and a few more.
PRECISIONS = (4, 5, 6)


def main(argv=None) -> dict:
    args = parse_arguments(argv)
    if args.blender_part:
        blender_part(pathlib.Path(args.blender_part))
        return {}
    import warpcage
    from warpcage.cli.pose_words import read_pose
    from warpcage.coordinates.coordinates import deform_points
    from warpcage.core.devices import resolve_device
    from warpcage.editor.demo import demo_files
    from warpcage.fitting.evaluation import psnr
    from warpcage.mesh.io.gltf import write_glb
    from warpcage.reference.inverse_map import InverseMap
    from warpcage.view.pictures import contact_sheet, read_image, write_png

    device = resolve_device(args.device)
    field_path, cage_path = (args.field, args.cage) if args.field else demo_files(device)
    field = warpcage.VoxelField.load(field_path, device=device)
    cage = warpcage.Cage.load(cage_path)
    posed = read_pose(cage, args.posed)
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
        cage.save(folder / "cage.glb")
        np.savez(folder / "pose.npz", posed=posed.vertices, view=camera.camera_to_world, fov=38.0, size=args.size)
        done = subprocess.run([args.blender, __file__, "--blender-part", temporary], capture_output=True, text=True)
        if not (folder / "moved.npz").exists():
            raise SystemExit(f"Blender failed:\n{(done.stdout + done.stderr)[-2000:]}")
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
    print(f"Blender's picture of the coloured mesh beside the rendered field: {figures['psnr']:.1f} dB")
    if args.out:
        out = pathlib.Path(args.out)
        rest = np.clip(field.render(camera, background="white").rgb, 0, 1)
        difference = np.clip(0.5 + 2.5 * (picture - rendered), 0, 1)
        write_png(out / "preview.png", contact_sheet([rest, picture, rendered, difference], columns=4))
        (out / "figures.json").write_text(json.dumps(figures, indent=1) + "\n")
    return figures


def shares(errors: np.ndarray, size: float) -> tuple[float, float, float]:
    """Median, 95th percentile and largest length of errors (n, 3), as shares of a size."""
    lengths = np.linalg.norm(errors, axis=1) / size
    return float(np.median(lengths)), float(np.percentile(lengths, 95)), float(lengths.max())


def blender_part(folder: pathlib.Path) -> None:
    """What an artist does in Blender, by script: import, bind, pose; and a picture. Needs bpy and NumPy alone."""
    import bpy
    from mathutils import Matrix

    given = np.load(folder / "pose.npz")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    things = []
    for name in ("mesh", "cage"):
        bpy.ops.import_scene.gltf(filepath=str(folder / f"{name}.glb"))
        things.append(bpy.context.selected_objects[0])
    mesh, cage = things
    place = np.linalg.inv(np.array(cage.matrix_world))
    rest = np.array([vertex.co[:] for vertex in cage.data.vertices])
    posed = given["posed"] @ place[:3, :3].T + place[:3, 3]
    moved = {}
    modifier = mesh.modifiers.new("preview", "MESH_DEFORM")
    modifier.object = cage
    bpy.context.view_layer.objects.active = mesh
    for precision in PRECISIONS:
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

    bpy.ops.preferences.addon_enable(module="cycles")
    scene, size = bpy.context.scene, int(given["size"])
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
    scene.view_settings.view_transform = "Standard"  # colours as they were captured
    scene.render.filepath = str(folder / "blender.png")
    bpy.ops.render.render(write_still=True)
    np.savez(folder / "moved.npz", version=bpy.app.version_string, **moved)


def parse_arguments(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blender", default=sys.executable, help="Python that has bpy (default: this one)")
    parser.add_argument("--field", help="field file (default: the editor's demo)")
    parser.add_argument("--cage", help="cage at rest of that field")
    parser.add_argument("--posed", default="bend:40:z:x", help="posed cage, or a preset (default: %(default)s)")
    parser.add_argument("--resolution", type=int, default=128, help="cells of the map's lattice (default: %(default)s)")
    parser.add_argument("--inverted", type=int, default=400, help="vertices that are inverted (default: %(default)s)")
    parser.add_argument("--size", type=int, default=300, help="pixels a side of pictures (default: %(default)s)")
    parser.add_argument("--out", metavar="DIR", help="where preview.png and figures.json go")
    parser.add_argument("--device", help='"cpu" or "cuda:0" (default: CUDA where there is one)')
    parser.add_argument("--blender-part", help=argparse.SUPPRESS)
    return parser.parse_args(argv)


if __name__ == "__main__":
    main()
