"""Quads and Blender: its Mesh Deform on cages of quads beside ours, and cages through its files and back.

`python -m venv blender && blender/bin/pip install bpy` makes the Python that --blender names; it imports NumPy alone.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import sys
import tempfile

import numpy as np
from common import JSON, command, option, write_results

BLENDER = option("--blender", default=sys.executable, help="Python that has bpy (default: this one)")

#: How far vertices are moved at random, in mean sides: of the cages at rest, and of their poses beside the bend.
WARPED, POSED = 0.05, 0.15

# Cages as artists make them


def extruded(cells, smooth: int) -> tuple[np.ndarray, list[list[int]]]:
    """Vertices and quads of the surface of cells (i, j, k) of a grid, as extruded from each other, then smoothed."""
    cells, numbers, quads = set(map(tuple, cells)), {}, []
    for cell in sorted(cells):
        for axis in range(3):
            for side in (0, 1):
                beside = list(cell)
                beside[axis] += 2 * side - 1
                if tuple(beside) in cells:
                    continue
                quad = []
                for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)):
                    corner = list(cell)
                    corner[axis] += side
                    corner[(axis + 1) % 3] += a
                    corner[(axis + 2) % 3] += b
                    quad.append(numbers.setdefault(tuple(corner), len(numbers)))
                quads.append(quad if side else quad[::-1])
    vertices = np.array(list(numbers), np.float64)
    pairs = np.array([(quad[k], quad[(k + 1) % 4]) for quad in quads for k in range(4)])
    for _ in range(smooth):
        total, count = np.zeros_like(vertices), np.zeros((len(vertices), 1))
        np.add.at(total, pairs[:, 0], vertices[pairs[:, 1]])
        np.add.at(count, pairs[:, 0], 1.0)
        vertices = 0.5 * (vertices + total / count)
    return vertices, quads


def block(*sides: range) -> list[tuple[int, ...]]:
    return [(i, j, k) for i in sides[0] for j in sides[1] for k in sides[2]]


def ball() -> tuple[np.ndarray, list[list[int]]]:
    """A ball of 54 quads."""
    vertices, quads = extruded(block(range(3), range(3), range(3)), 0)
    vertices -= 1.5
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), quads


def figure() -> tuple[np.ndarray, list[list[int]]]:
    """A trunk with a head, two arms held away from it, and two legs."""
    trunk = block(range(-1, 2), range(1), range(5))
    legs = [(x, 0, z) for x in (-1, 1) for z in (-1, -2, -3, -4)]
    arms = [(x, 0, 4) for x in (-5, -4, -3, -2, 2, 3, 4, 5)]
    vertices, quads = extruded([*trunk, *legs, *arms, (0, 0, 5), (0, 0, 6)], 1)
    return vertices * [1.0, 1.2, 1.2], quads


def head() -> tuple[np.ndarray, list[list[int]]]:
    """A skull with a nose, two ears and a neck."""
    skull = block(range(4), range(4), range(4))
    neck, nose = block(range(1, 3), range(1, 3), (-1, -2)), [(4, 1, 1), (4, 2, 1)]
    ears = [(2, y, z) for y in (-1, 4) for z in (1, 2)]
    vertices, quads = extruded([*skull, *neck, *nose, *ears], 3)
    return vertices * [1.0, 0.9, 1.15], quads


def animal() -> tuple[np.ndarray, list[list[int]]]:
    """A trunk on four legs, with a neck, a head that looks ahead, and a tail."""
    trunk = block(range(6), range(-1, 2), range(2))
    legs = [(x, y, z) for x in (0, 5) for y in (-1, 1) for z in (-1, -2, -3)]
    neck, tail = [(5, 0, 2), (5, 0, 3), (5, 0, 4), (6, 0, 4), (7, 0, 4)], [(-1, 0, 1), (-2, 0, 1), (-3, 0, 1)]
    return extruded([*trunk, *legs, *neck, *tail], 1)


CAGES = {"figure": figure, "animal": animal, "head": head, "ball": ball}


def warped_cages(name: str):
    """A cage of CAGES about the origin, and its pose: bent by 40 degrees; vertices of both moved at random."""
    import warpcage

    vertices, quads = CAGES[name]()
    rest = warpcage.Cage(vertices - vertices.mean(axis=0), quads)
    side = np.linalg.norm(rest.vertices[rest.edges[:, 0]] - rest.vertices[rest.edges[:, 1]], axis=1).mean()
    moved = np.random.default_rng(0).uniform(-1.0, 1.0, (2, *rest.vertices.shape)) * side
    rest = rest.with_vertices(rest.vertices + WARPED * moved[0])
    bent = rest.bend(40, axis="z", towards="x")
    return rest, bent.with_vertices(bent.vertices + POSED * moved[1])


def field_inside(cage, resolution: int = 80):
    """A field of what lies two voxels and more inside a cage."""
    from scipy.ndimage import distance_transform_edt

    import warpcage

    middle, half = cage.bounds.mean(axis=0), 0.5 * cage.size + 0.02 * cage.size
    axis = half * ((np.arange(resolution) + 0.5) * 2.0 / resolution - 1.0)
    nodes = middle + np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    inside = cage.contains(nodes.reshape(-1, 3)).reshape(nodes.shape[:3])
    density = 60.0 * np.clip(distance_transform_edt(inside) - 1.5, 0.0, 1.0)
    sh = np.zeros((*density.shape, 9, 3), np.float32)
    return warpcage.VoxelField.from_dense(density.astype(np.float32), sh, [middle - half, middle + half])


# Mesh Deform


@command(
    BLENDER,
    option("--cages", nargs="+", choices=list(CAGES), default=list(CAGES)),
    option("--out", required=True, metavar="DIR", help="folder for cages, pictures and errors.png"),
    JSON,
)
def deform(args) -> None:
    """Blender's Mesh Deform on cages of quads, warped and posed, beside ours of the same quads, and of them cut.

        python benchmarks blender-quads deform --blender blender/bin/python --out out --json blender_quads.json

    Cages hold a field; the vertices of its mesh are moved by Blender's modifier, bound at rest (minutes for the ball
    and the head, which fill much of their boxes), and by harmonic coordinates of the cage at rest. Shares of the cage's
    size, at Blender's highest precision: median, 95th percentile, most. "Cut" is ours of the same quads as triangles,
    cut along a diagonal. errors.png has, row by row, the mesh at rest in its cage, posed by ours, and posed by Blender
    with how far the two are apart in color: dark 0, yellow 0.2 % of the size.
    """
    from programs.blender import PRECISIONS, shares

    import warpcage
    from warpcage import deform_points
    from warpcage.demo import render_mesh_views
    from warpcage.view import contact_sheet, draw_cage, framing_orbit, write_png

    out = pathlib.Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    rows, panels = [], []
    print(f"{'cage':8}{'quads':>6}{'off plane':>10}{'points':>8}  {'quads: median, 95 %, most':28}cut")
    for name in args.cages:
        rest, posed = warped_cages(name)
        field = field_inside(rest)
        mesh = field.extract_mesh(components="all")
        points, found = moved_by_blender(args.blender, mesh, rest, posed)
        cut = warpcage.Cage(
            rest.vertices, [tuple(face[k] for k in (0, i, i + 1)) for face in rest.polygons for i in (1, 2)]
        )
        ours = deform_points(points, rest, posed, coordinates="harmonic")
        held = cut.contains(points)  # a diagonal may leave a point out
        ours_cut = deform_points(points[held], cut, cut.with_vertices(posed.vertices), coordinates="harmonic")
        moved = found[f"moved_{PRECISIONS[-1]}"]
        row = {
            "cage": name, "vertices": len(rest.vertices), "quads": rest.face_count, "points": len(points),
            "planarity": rest.check(pose=posed).planarity, "planarity_posed": posed.check().planarity,
            "quads_apart": shares(moved - ours, rest.size), "cut_apart": shares(moved[held] - ours_cut, rest.size),
        }  # fmt: skip
        rows.append(row)
        quads, as_cut = (" ".join(f"{value:8.1e}" for value in row[key]) for key in ("quads_apart", "cut_apart"))
        print(
            f"{name:8}{row['quads']:6d}{row['planarity_posed']:10.3f}{row['points']:8d}  {quads:28}{as_cut}", flush=True
        )
        rest.save(out / f"{name}.obj")
        posed.save(out / f"{name}_posed.obj")
        errors = np.linalg.norm(moved - ours, axis=1) / rest.size
        for cage, places, shade in ((rest, points, None), (posed, ours, None), (posed, moved, errors)):
            camera = framing_orbit(
                cage.vertices, 1, elevation_degrees=20.0, start_degrees=-50.0, width=420, height=420
            )[0]
            colors = np.full(mesh.faces.shape, 0.7) if shade is None else heat(shade[mesh.faces].mean(axis=1) / 0.002)
            rgba = render_mesh_views(places, mesh.faces, colors, [camera], samples=3)[0]
            panels.append(draw_cage(rgba[..., :3] * rgba[..., 3:] + 1.0 - rgba[..., 3:], camera, cage))
    write_png(out / "errors.png", contact_sheet(panels, columns=3))
    write_results(args.json, "cpu", blender=str(found["version"]), precision=PRECISIONS[-1], rows=rows)


def heat(values: np.ndarray) -> np.ndarray:
    """Colors (n, 3), dark at 0, yellow at 1 and more."""
    share = np.clip(values, 0.0, 1.0)[:, None]
    return (1.0 - share) * [0.15, 0.05, 0.35] + share * [1.0, 0.9, 0.1]


def moved_by_blender(blender: str, mesh, rest, posed) -> tuple[np.ndarray, dict]:
    """The vertices (n, 3) of a mesh and what `blender preview` makes of them in Blender."""
    from programs.blender import PRECISIONS, run_in_blender

    from warpcage.mesh import write_glb

    points = np.asarray(mesh.vertices)
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        upright = points[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
        (folder / "mesh.glb").write_bytes(write_glb(upright, np.asarray(mesh.faces, np.int32), name="mesh"))
        rest.save(folder / "cage.obj")
        np.savez(folder / "pose.npz", posed=posed.vertices, precisions=PRECISIONS[-1:])
        run_in_blender(blender, "blender preview", folder, "moved.npz")
        return points, dict(np.load(folder / "moved.npz"))


# Files

#: Name: (ending of both files, changes in Blender, options of the exporter beside its defaults).
WAYS = {
    "OBJ, defaults": ("obj", "", {}),
    "OBJ, texture coordinates, smooth, materials": ("obj", "seams smooth materials", {}),
    "OBJ, Triangulated Mesh": ("obj", "", {"export_triangulated_mesh": True}),
    "PLY, defaults": ("ply", "", {}),
    "PLY, texture coordinates": ("ply", "seams", {}),
    "PLY, texture coordinates, normals, ASCII": ("ply", "seams", {"export_normals": True, "ascii_format": True}),
    "PLY, Triangulated Mesh": ("ply", "", {"export_triangulated_mesh": True}),
    "USD, defaults": ("usdc", "", {}),
    "USD, texture coordinates, materials, text": ("usda", "seams materials", {}),
    "USD, Triangulate Meshes": ("usdc", "", {"triangulate_meshes": True}),
    "USD, subdivision modifier": ("usdc", "subdivision", {}),
    "OBJ, subdivision modifier": ("obj", "subdivision", {}),
    "OBJ, subdivision modifier, without Apply Modifiers": ("obj", "subdivision", {"apply_modifiers": False}),
    "glTF, defaults": ("glb", "", {}),
    "glTF, texture coordinates, flat": ("glb", "seams", {}),
}  # fmt: skip


@command(BLENDER, JSON, option("--blender-part", help=argparse.SUPPRESS))
def round_trip(args) -> int | None:
    """A cage of quads through Blender's files and back: are quads kept, and the order of vertices?

        python benchmarks blender-quads round-trip --blender blender/bin/python --json blender_files.json

    For each format: warpcage writes the figure at rest, Blender imports it by its defaults, its vertices are moved to
    the pose, Blender exports it, warpcage loads it. Quads and order are compared with those that warpcage wrote; a pose
    fits where `Cage.match` takes it, and lies where Blender had it.
    """
    if args.blender_part:
        through_blender(pathlib.Path(args.blender_part))
        return None
    from programs.blender import run_in_blender

    rest, posed = warped_cages("figure")
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        np.save(folder / "pose.npy", posed.vertices)
        (folder / "ways.json").write_text(json.dumps([*WAYS.values()]))
        for ending in {way[0] for way in WAYS.values()}:
            rest.save(folder / f"rest.{ending}")
        run_in_blender(args.blender, "blender-quads round-trip", folder, "done.json")
        version = json.loads((folder / "done.json").read_text())
        for number, (name, (ending, _, _)) in enumerate(WAYS.items()):
            rows.append({"way": name, **came_back(folder / f"back_{number}.{ending}", rest, posed)})
    print(f"Blender {version}")
    print(f"{'':52}{'vertices':>9} {'faces':>6}  quads  order  fits")
    for row in rows:
        kept = "  ".join(f"{'yes' if row[key] else 'NO':5}" for key in ("quads", "order", "fits"))
        print(f"{row['way']:52}{row['vertices']:9d} {row['faces']:6d}  {kept}  {row['said']}")
    write_results(args.json, "cpu", blender=version, vertices=len(rest.vertices), faces=rest.face_count, rows=rows)
    return 0


def came_back(path: pathlib.Path, rest, posed) -> dict:
    """What of a cage is as it was in a file that Blender wrote."""
    import warpcage

    near, said = 2e-6 * rest.size, ""
    loaded = warpcage.Cage.load(path, reference=rest)
    same = len(loaded.vertices) == len(rest.vertices)
    order = same and bool(np.abs(loaded.vertices - posed.vertices).max() < near)
    quads = sum(len(face) == 4 for face in loaded.polygons)
    try:
        fits = bool(np.abs(rest.match(loaded).vertices - posed.vertices).max() < near)
    except ValueError as error:
        fits, said = False, str(error)
    found = {"vertices": len(loaded.vertices), "faces": loaded.face_count, "quads": quads == rest.face_count}
    return {**found, "order": order, "fits": fits, "said": said.replace(str(path.parent), "")}


def through_blender(folder: pathlib.Path) -> None:
    """Import, pose, export, once for each way. Needs bpy and NumPy alone."""
    import bpy

    pose = np.load(folder / "pose.npy")
    for number, (ending, changes, options) in enumerate(json.loads((folder / "ways.json").read_text())):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        file, back = str(folder / f"rest.{ending}"), str(folder / f"back_{number}.{ending}")
        if ending == "obj":
            bpy.ops.wm.obj_import(filepath=file)
        elif ending == "ply":
            bpy.ops.wm.ply_import(filepath=file)
        elif ending == "glb":
            bpy.ops.import_scene.gltf(filepath=file)
        else:
            bpy.ops.wm.usd_import(filepath=file)
        cage = next(each for each in bpy.context.scene.objects if each.type == "MESH")
        place_vertices(cage, pose, ending)
        bpy.context.view_layer.objects.active = cage
        change(cage, changes)
        if ending == "obj":
            bpy.ops.wm.obj_export(filepath=back, **options)
        elif ending == "ply":
            bpy.ops.wm.ply_export(filepath=back, **options)
        elif ending == "glb":
            bpy.ops.export_scene.gltf(filepath=back, **options)
        else:
            bpy.ops.wm.usd_export(filepath=back, **options)
    (folder / "done.json").write_text(json.dumps(bpy.app.version_string))


def place_vertices(cage, pose: np.ndarray, ending: str) -> None:
    """Vertices of a Blender object to a pose in the world that warpcage has; OBJ is taken for one with y up."""
    world = pose[:, [0, 2, 1]] * [1.0, -1.0, 1.0] if ending == "obj" else pose
    into = np.linalg.inv(np.array(cage.matrix_world))
    cage.data.vertices.foreach_set("co", (world @ into[:3, :3].T + into[:3, 3]).reshape(-1))
    cage.data.update()


def change(cage, changes: str) -> None:
    """What else artists do to a mesh."""
    import bpy

    cage.data.shade_flat()
    if "smooth" in changes:
        cage.data.shade_smooth()
    if "materials" in changes:
        for name in ("red", "blue"):
            cage.data.materials.append(bpy.data.materials.new(name))
        for polygon in cage.data.polygons:
            polygon.material_index = polygon.index % 2
    if "seams" in changes:
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.select_all(action="SELECT")
        bpy.ops.uv.smart_project()
        bpy.ops.object.mode_set(mode="OBJECT")
    if "subdivision" in changes:
        cage.modifiers.new("smooth", "SUBSURF").levels = 1
