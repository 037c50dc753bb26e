"""Cages: generated ones, how tight and even they are, and their times; random poses, how far they stretch."""

from __future__ import annotations

import argparse
import itertools
import json
import pathlib
import statistics
import sys
import tempfile
import time

import numpy as np
from common import HERE, JSON, KINDS, command, option, write_results
from library.by_turns import ask, revision_of, started
from shapes import LIMBS, SHAPES, Shape, bent, cones, gap_points, grown, marched, shape_of, topology

import warpcage
from warpcage.cage import check_pose, face_samples, grid_points
from warpcage.demo import CAGE_SCENES, scene_field
from warpcage.select import visible_nodes
from warpcage.view import contact_sheet, draw_cage, framing_orbit, write_jpeg

# Generated cages


@command(
    option("--out", help="folder for cages.json and the cages"),
    option("--field", nargs="+", metavar="FIELD", help="field files (.npz) before the scenes"),
    option("--scenes", nargs="*", choices=list(CAGE_SCENES), default=list(CAGE_SCENES), metavar="SCENE"),
    option("--counts", nargs="+", type=int, default=[42, 100, 200], help="(default: 42 100 200)"),
    option("--methods", nargs="+", choices=("auto", "shell", "voxel"), default=["auto"]),
    option("--margin", type=float, help="voxels (default: the generator's own, 1)"),
    option("--resolution", type=int, default=64, help="voxels along each side of the scenes (default: 64)"),
    option("--again", action="store_true", help="make each cage twice and compare the two bit by bit"),
)
def generated(args) -> int:
    """Generated cages measured: what they enclose, how tight and how even they are, and what they cost.

        python benchmarks cages generated --out out
        python benchmarks cages generated --field lego.npz --counts 42 100 200 --methods auto shell voxel

    One row per scene, method and count. Enclosed: share of the visible voxels that are inside; gap: smallest distance
    between the faces and the visible voxels (boxes around their nodes), in voxels; hull: volume of the cage over that
    of the object's convex hull; even: mean over the faces of 4 sqrt(3) area / sum of squared sides (1 for equilateral),
    and that of the worst face; sides: 95th over 5th percentile of the lengths of the edges; sharp: the largest share of
    its full angle that a vertex lacks (0 flat, 1/4 the corner of a box, near 1 a spike). Written with --out: cages.json
    and the cages. The exit status is 1 where a cage does not hold what it promises.
    """
    rows = []
    print(
        f"{'scene':12}{'method':8}{'asked':>6}{'got':>5}{'genus':>6}{'parts':>6}{'enclosed':>10}{'gap':>6}{'hull':>7}"
        f"{'even':>12}{'sides':>7}{'sharp':>7}{'crossings':>10}{'same':>6}{'s':>7}{'cpu s':>7}"
    )
    fields = {pathlib.Path(path).stem: warpcage.VoxelField.load(path) for path in args.field or ()}
    fields |= {name: scene_field(name, args.resolution) for name in args.scenes}
    for name, field in fields.items():
        for method in args.methods:
            for count in args.counts:
                row, cage = generated_row(name, field, method, count, args)
                rows.append(row)
                print(line(row), flush=True)
                if args.out:
                    cage.save(pathlib.Path(args.out) / f"{row['scene'].replace(' ', '_')}_{method}_{count}.obj")
    if args.out:
        write_results(pathlib.Path(args.out) / "cages.json", None, rows=rows)
    bad = [f"{row['scene']} {row['method']} {row['asked']}" for row in rows if not holds(row, args.margin)]
    print(f"{len(rows) - len(bad)} of {len(rows)} hold" + (f"; not: {', '.join(bad)}" if bad else ""))
    return 1 if bad else 0


def generated_row(name: str, field, method: str, count: int, args) -> tuple[dict, warpcage.Cage]:
    """One row of figures, and the cage."""
    wall, cpu = time.perf_counter(), time.process_time()
    cage = warpcage.Cage.from_field(field, count, method=method, margin=args.margin)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    same = None
    if args.again:
        again = warpcage.Cage.from_field(field, count, method=method, margin=args.margin)
        same = bool(np.array_equal(again.vertices, cage.vertices) and np.array_equal(again.faces, cage.faces))
    report = cage.check(field=field)
    return {
        "scene": name, "method": method, "asked": count, "vertices": report.vertex_count, "genus": report.genus,
        "parts": report.part_count, "usable": report.usable, "enclosed": report.field_enclosed,
        "gap_voxels": gap(cage, field), "hull_ratio": report.hull_ratio, **shape(cage),
        "crossings": len(report.intersecting_faces), "same_again": same, "seconds": wall, "cpu_seconds": cpu,
    }, cage  # fmt: skip


def holds(row: dict, margin: float | None) -> bool:
    return (
        row["usable"]
        and row["enclosed"] == 1.0
        and row["crossings"] == 0
        and row["same_again"] is not False
        and abs(row["vertices"] - row["asked"]) <= 0.1 * row["asked"]
        and row["gap_voxels"] > (1.0 if margin is None else margin)
    )


def gap(cage, field) -> float:
    """Smallest distance, in voxels, from points on the faces, half a voxel apart, to the boxes of visible voxels."""
    from scipy.spatial import KDTree

    voxel = np.broadcast_to(field.voxel_size, 3)
    longest = np.linalg.norm(cage.vertices[cage.edges[:, 0]] - cage.vertices[cage.edges[:, 1]], axis=1).max()
    samples, _ = face_samples(cage.vertices, cage.faces, int(np.ceil(2.0 * longest / voxel.max())))
    samples, nodes = samples.reshape(-1, 3), visible_nodes(field)
    # the nearest box is among the nearest nodes; those are few where the faces are near
    nearest = KDTree(nodes).query(samples, 8)[1]
    beyond = np.maximum(np.abs(samples[:, None] - nodes[nearest]) - 0.5 * voxel, 0.0)
    return float(np.linalg.norm(beyond, axis=2).min() / voxel.max())


def shape(cage) -> dict:
    """How even the faces, the edges and the vertices are."""
    corners = cage.vertices[cage.faces]
    sides = corners - np.roll(corners, 1, axis=1)
    double_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    even = 2.0 * np.sqrt(3.0) * double_area / (sides**2).sum(axis=(1, 2))
    lengths = np.linalg.norm(cage.vertices[cage.edges[:, 0]] - cage.vertices[cage.edges[:, 1]], axis=1)
    angle = np.zeros(len(cage.vertices))
    for k in range(3):
        one, two = (corners[:, (k + step) % 3] - corners[:, k] for step in (1, 2))
        turn = np.arctan2(np.linalg.norm(np.cross(one, two), axis=1), (one * two).sum(axis=1))
        np.add.at(angle, cage.faces[:, k], turn)
    low, high = np.percentile(lengths, [5, 95])
    return {
        "even": float(even.mean()),
        "least_even": float(even.min()),
        "sides": float(high / low),
        "sharp": float(1.0 - angle.min() / (2.0 * np.pi)),
    }


def line(row: dict) -> str:
    even = f"{row['even']:.2f} {row['least_even']:.2f}"
    same = "-" if row["same_again"] is None else "yes" if row["same_again"] else "NO"
    return (
        f"{row['scene']:12}{row['method']:8}{row['asked']:6d}{row['vertices']:5d}{row['genus']:6d}"
        f"{row['parts']:6d}{100 * row['enclosed']:9.3f}%{row['gap_voxels']:6.2f}{row['hull_ratio']:7.2f}"
        f"{even:>12}{row['sides']:7.1f}{row['sharp']:7.2f}{row['crossings']:10d}{same:>6}{row['seconds']:7.1f}{row['cpu_seconds']:7.1f}"
    )


# Shapes of many kinds


@command(
    option("--shapes", nargs="*", choices=list(SHAPES), default=list(SHAPES), metavar="SHAPE", help="(default: all)"),
    option("--field", nargs="+", metavar="FIELD", default=[], help="field files, voxels or splats, behind the shapes"),
    option("--counts", nargs="+", type=int, default=[100], help="vertices (default: 100)"),
    option("--detail", nargs="+", metavar="DETAIL", help="values of `detail`, a cage each"),
    option("--faces", nargs="+", metavar="FACES", help="values of `faces`, a cage each"),
    option("--method", help="shell, voxel or auto"),
    option("--symmetry", help="x, y or z"),
    option(
        "--tree", type=pathlib.Path, help="another checkout, which makes cages by turns with this one, by its defaults"
    ),
    option("--runs", type=int, default=3, help="times each cage is made (default: 3)"),
    option("--out", metavar="DIR", help="folder for shapes.json, the cages, and shapes.png, to be looked at"),
    option("--worker", action="store_true", help=argparse.SUPPRESS),
)
def shapes(args) -> int:
    """Cages around shapes of many kinds: time, enclosure, tightness, holes, parts, gaps, the farthest vertex.

        python benchmarks cages shapes --out out --field lego.npz house.npz tumbler.ply
        python benchmarks cages shapes --out out --tree ../before --detail even parts --counts 42 100 200

    Options that are given go to `Cage.from_mesh` and `Cage.from_field`, each combination in a row of its own. Enclosed:
    share of the object's points (vertices, and 200,000 on faces; visible voxels) that are inside; hull, object: volume
    of the cage over that of the object's convex hull, and of the object; parts, holes: of the cage, and of all within
    the margin of the object, which is what any cage could keep; gaps: share of the space between parts of the object
    nearer than a fifth of the size which the cage leaves out; far: largest distance of a vertex from the object, in
    sides, sqrt(area / count), and over 1.75 margin + 1.5 sides. Seconds are medians of wall time, and of the
    process's own. The exit status is 1 where a cage cannot be used, does not enclose, or crosses itself.
    """
    if args.worker:
        make_cages()
        return 0
    given = {name: [value] for name in ("method", "symmetry") if (value := getattr(args, name)) is not None}
    given |= {name: values for name in ("detail", "faces") if (values := getattr(args, name)) is not None}
    ways = {"this": [dict(zip(given, chosen, strict=True)) for chosen in itertools.product(*given.values())]}
    trees = {"this": HERE.parent} | ({"other": args.tree} if args.tree else {})
    ways |= {"other": [{}]} if args.tree else {}
    workers = {name: started(tree, "cages", "shapes", "--worker") for name, tree in trees.items()}
    rows, panels = [], []
    print(f"{'shape':10}{'tree':6}{'options':22}{'asked':>6}{'got':>5}{'s':>7}{'cpu s':>7}{'enclosed':>10}{'hull':>7}"
          f"{'object':>8}{'parts':>7}{'holes':>7}{'gaps':>7}{'far':>12}")  # fmt: skip
    with tempfile.TemporaryDirectory() as temporary:
        objects = {name: (SHAPES[name], None) for name in args.shapes}
        objects |= {pathlib.Path(path).stem: (None, pathlib.Path(path).resolve()) for path in args.field}
        for name, (make, path) in objects.items():
            shape = shape_of(name, make() if path is None else load_object(path))
            path = path or save_object(shape, pathlib.Path(temporary))
            kept = (topology(grown(shape, shape.need)), gap_points(shape, 0.2 * shape.size))
            for count in args.counts:
                made = cages_by_turns(workers, ways, path, count, args.runs)
                for (tree, chosen), answers in made.items():
                    rows.append(shape_row(shape, kept, tree, chosen, count, answers))
                    print(shape_line(rows[-1]), flush=True)
                    panels.append((shape, rows[-1], answers[-1]))
                    if args.out and (cage := cage_of(answers[-1])) is not None:
                        file = "_".join([name, str(count), tree, *chosen.replace("=", "_").split()])
                        cage.save(pathlib.Path(args.out) / f"{file.replace(' ', '_')}.obj")
    for worker in workers.values():
        worker.stdin.close()
        worker.wait()
    if args.out:
        write_results(
            pathlib.Path(args.out) / "shapes.json",
            "cpu",
            **{name: revision_of(tree) for name, tree in trees.items()},
            rows=rows,
        )
        draw_shapes(pathlib.Path(args.out) / "shapes.png", panels, len(args.counts) * sum(map(len, ways.values())))
    bad = [f"{row['shape']} {row['tree']} {row['options']} {row['asked']}" for row in rows if not row["holds"]]
    print(f"{len(rows) - len(bad)} of {len(rows)} hold" + (f"; not: {', '.join(bad)}" if bad else ""))
    return 1 if bad else 0


def load_object(path: pathlib.Path):
    """A mesh of `save_object`, or a field of any kind."""
    if path.suffix != ".npz":
        return warpcage.SplatField.load(path, device="cpu")
    with np.load(path) as held:
        if "faces" not in held:
            return warpcage.VoxelField.load(path, device="cpu")
        import trimesh

        return trimesh.Trimesh(held["vertices"], held["faces"], process=False)


def save_object(shape: Shape, folder: pathlib.Path) -> pathlib.Path:
    path = folder / f"{shape.name.replace(' ', '_')}.npz"
    if isinstance(shape.object, warpcage.VoxelField):
        shape.object.save(path)
    else:
        np.savez(path, vertices=shape.object.vertices, faces=shape.object.faces)
    return path


def cages_by_turns(workers: dict, ways: dict, path: pathlib.Path, count: int, runs: int) -> dict:
    """Answers of each tree and its options, one a run, as `make_cages` gives them."""
    made = {}
    for _ in range(runs):
        for tree, choices in ways.items():
            for chosen in choices:
                question = json.dumps({"path": str(path), "count": count, "options": chosen})
                key = (tree, " ".join(f"{name}={value}" for name, value in chosen.items()))
                made.setdefault(key, []).append(ask(workers[tree], question))
    return made


def make_cages() -> None:
    """Answer questions for a cage with its vertices, faces and seconds, or why there is none."""
    import warnings

    warnings.simplefilter("ignore")
    path, scene_object = None, None
    for question in map(json.loads, sys.stdin):
        if question["path"] != path:
            path = question["path"]
            scene_object = load_object(pathlib.Path(path))
        make = warpcage.Cage.from_mesh if hasattr(scene_object, "faces") else warpcage.Cage.from_field
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            cage = make(scene_object, question["count"], **question["options"])
        except (ValueError, TypeError) as error:
            answer = {"error": str(error)}
        else:
            seconds = {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}
            faces = cage.polygons if hasattr(cage, "polygons") else cage.faces.tolist()
            answer = {"vertices": cage.vertices.tolist(), "faces": faces, **seconds}
        print("answer " + json.dumps(answer), flush=True)


def cage_of(answer: dict) -> warpcage.Cage | None:
    return None if "error" in answer else warpcage.Cage(np.array(answer["vertices"]), answer["faces"])


def shape_row(shape: Shape, kept, tree: str, chosen: str, count: int, answers: list[dict]) -> dict:
    """The figures of a cage that was made a few times."""
    from scipy.spatial import ConvexHull, KDTree

    (parts, holes), gaps = kept
    row = {"shape": shape.name, "tree": tree, "options": chosen, "asked": count, "object_parts": parts,
           "object_holes": holes, "holds": False}  # fmt: skip
    cage = cage_of(answers[-1])
    if cage is None:
        return row | {"error": answers[-1]["error"]}
    report = cage.check()
    corners = cage.surface.vertices[cage.surface.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    side = float(np.sqrt(area / len(cage.vertices)))
    far = float(KDTree(shape.points).query(cage.vertices)[0].max())
    enclosed = float(cage.contains(shape.points, device="cpu").mean())
    crossings = len(report.intersecting_faces)
    return row | {
        "vertices": len(cage.vertices), "faces": cage.face_count,
        **{key: statistics.median(answer[key] for answer in answers) for key in ("seconds", "cpu_seconds")},
        "enclosed": enclosed, "hull_ratio": report.volume / ConvexHull(shape.points).volume,
        "object_ratio": report.volume / shape.volume, "parts": report.part_count, "holes": report.genus,
        "gaps_open": float(1.0 - cage.contains(gaps, device="cpu").mean()) if len(gaps) else None,
        "far_sides": far / side, "far_bound": far / (1.75 * shape.need + 1.5 * side), "crossings": crossings,
        "holds": report.usable and enclosed == 1.0 and not crossings,
    }  # fmt: skip


def shape_line(row: dict) -> str:
    head = f"{row['shape']:10}{row['tree']:6}{row['options']:22}{row['asked']:6d}"
    if "error" in row:
        return f"{head}  {row['error'][:90]}"
    gaps = "-" if row["gaps_open"] is None else f"{100 * row['gaps_open']:.0f}%"
    parts, holes = (f"{row[key]}/{row['object_' + key]}" for key in ("parts", "holes"))
    far = f"{row['far_sides']:.2f} {row['far_bound']:.2f}"
    return (
        f"{head}{row['vertices']:5d}{row['seconds']:7.2f}{row['cpu_seconds']:7.2f}{100 * row['enclosed']:9.3f}%"
        f"{row['hull_ratio']:7.2f}{row['object_ratio']:8.2f}{parts:>7}{holes:>7}{gaps:>7}{far:>12}"
        + ("" if row["holds"] else "  DOES NOT HOLD")
    )


def draw_shapes(path: pathlib.Path, panels: list, columns: int, size: int = 300) -> None:
    """A sheet of the objects in their cages, a row for each shape."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = columns if columns > 1 else 4
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.0 * columns, 3.3 * rows), squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for axis, (shape, row, answer) in zip(axes.flat, panels, strict=False):
        title = f"{row['shape']} {row['tree']} {row['options']} {row['asked']}"
        cage = cage_of(answer)
        if cage is None:
            axis.set_title(f"{title}\n{row['error'][:40]}", fontsize=7)
            continue
        axis.imshow(picture_of(shape, cage, size))
        holes = f"{row['parts']}/{row['object_parts']} parts, {row['holes']}/{row['object_holes']} holes"
        axis.set_title(f"{title}\nhull {row['hull_ratio']:.2f}, {holes}, {row['seconds']:.1f} s", fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    print(f"wrote {path}")


def picture_of(shape: Shape, cage, size: int) -> np.ndarray:
    """The object with the cage drawn over it."""
    from warpcage.demo import render_mesh_views

    turns = {"start_degrees": -55.0, "elevation_degrees": 25.0}
    camera = framing_orbit(cage.vertices, 1, width=size, height=size, **turns)[0]
    if hasattr(shape.object, "faces"):
        colors = np.broadcast_to([0.62, 0.66, 0.70], np.shape(shape.object.faces))
        rgba = render_mesh_views(shape.object.vertices, shape.object.faces, colors, [camera], samples=2)[0]
        picture = rgba[..., :3] * rgba[..., 3:] + 1.0 - rgba[..., 3:]
    else:
        picture = np.clip(shape.object.render(camera, background="white").rgb, 0.0, 1.0)
    return np.clip(draw_cage(picture, camera, cage), 0.0, 1.0)


# Local poses


@command(
    option("--shapes", nargs="*", choices=list(LIMBS), default=list(LIMBS), metavar="SHAPE", help="(default: all)"),
    option("--count", type=int, default=100, help="vertices (default: 100)"),
    option("--degrees", type=float, default=40.0, help="how far a limb bends (default: 40)"),
    option("--samples", type=int, default=1500, help="points on the surface (default: 1500)"),
    JSON,
)
def limbs(args) -> None:
    """How near cages by parts and even ones can follow a bend of one limb, whose true places are known.

        python benchmarks cages limbs --json limbs.json

    Points on the surface and where the bend takes them; the cage's vertices are fitted to these by least squares over
    the points' harmonic coordinates, those that hardly count being held. Even, parts: RMS of what is left, in percent
    of the RMS of the moves of points that move; dB: 20 log10 of the ratio of the two, positive where parts are nearer.
    """
    import trimesh

    rows = []
    print(f"{'shape':10}{'points':>8}{'even':>9}{'parts':>9}{'dB':>7}")
    for name in args.shapes:
        solid, number = LIMBS[name]
        mesh = trimesh.Trimesh(*marched(cones(solid)), process=False)
        points = np.asarray(trimesh.sample.sample_surface(mesh, args.samples, seed=0)[0])
        moves = bent(solid, number, points, args.degrees) - points
        moving = np.linalg.norm(moves, axis=1) > 1e-9
        unit = np.sqrt((moves[moving] ** 2).sum(axis=1).mean())
        cages = {detail: warpcage.Cage.from_mesh(mesh, args.count, detail=detail) for detail in ("even", "parts")}
        left = {detail: left_of(cage, points, moves) / unit for detail, cage in cages.items()}
        rows.append(
            {"shape": name, "moving": int(moving.sum()), **left, "db": 20 * np.log10(left["even"] / left["parts"])}
        )
        print(
            f"{name:10}{moving.sum():8d}{100 * left['even']:8.2f}%{100 * left['parts']:8.2f}%{rows[-1]['db']:7.1f}",
            flush=True,
        )
    median = statistics.median(row["db"] for row in rows)
    print(f"median of {len(rows)}: {median:.1f} dB")
    write_results(args.json, None, rows=rows, median_db=median)


def left_of(cage, points: np.ndarray, moves: np.ndarray) -> float:
    """RMS of what moves (n, 3) of points (n, 3) the vertices of a cage leave, by least squares."""
    weights = np.asarray(warpcage.harmonic_coordinates(points, cage, 64), np.float64)
    held = np.concatenate([weights, 0.01 * np.eye(len(cage.vertices))])
    found = np.linalg.lstsq(held, np.concatenate([moves, 0.0 * cage.vertices]), rcond=None)[0]
    return float(np.sqrt(((weights @ found - moves) ** 2).sum(axis=1).mean()))


# Random poses


@command(
    option("--count", type=int, default=100, help="poses of each cage (default: 100)"),
    option("--carried", type=int, default=5, help="poses that points are carried by (default: 5)"),
    option("--kinds", nargs="*", default=list(KINDS)),
    option("--seed", type=int, default=0),
    option("--stretch", type=float, nargs=2, default=(0.5, 2.0)),
    option("--cage", help="a cage file instead of the usual cages"),
    option("--field", help="field that --sheet draws"),
    option("--sheet", help="contact sheet to write (.jpg)"),
    option("--columns", type=int, default=4),
    option("--size", type=int, default=220, help="pixels along each side of a picture"),
    option("--overlay", action="store_true", help="draw the cages too"),
    JSON,
)
def random_poses(args) -> None:
    """Random poses of several cages: their stretch by each kind of coordinates, their strength, and their time.

        python benchmarks cages random-poses --json random_poses.json
        python benchmarks cages random-poses --count 15 --field bricks.npz --cage cage.obj --sheet random_poses.jpg

    Stretch inside is measured between pairs of points on a grid of about 3,000 places in the cage at rest: how far
    apart they are after the pose over how far apart they were, in three directions, by `deform_points` (forward), and
    by `Cage.check` (posed -> rest). --field draws the poses: rest first, then one picture a pose, from one camera that
    sees all of them whole.
    """
    rows = []
    cages = {args.cage: warpcage.Cage.load(args.cage)} if args.cage else usual_cages()
    for name, rest in cages.items():
        rows.append({"cage": name, "vertices": len(rest.vertices), **poses_row(rest, args)})
        print(rows[-1], flush=True)
    if args.sheet:
        draw(args, next(iter(cages.values())))
    write_results(args.json, None, count=args.count, seed=args.seed, stretch=args.stretch, rows=rows)


def usual_cages() -> dict:
    """Shapes, and cages that were generated around fields that are hard for them."""
    cages = {
        "box, 8": warpcage.Cage.box([-1, -1, -1], [1, 1, 1]),
        "box, 56": warpcage.Cage.box([-1, -1, -1], [1, 1, 1], segments=3),
        "icosphere, 162": warpcage.Cage.icosphere([0, 0, 0], 1, 2),
    }
    for scene in ("concave", "ring", "two parts", "tall", "thin"):
        cages[f"{scene}, generated"] = warpcage.Cage.from_field(scene_field(scene, 48), 60)
    return cages


def poses_row(rest, args) -> dict:
    """The statistics of the poses of one cage."""
    source = warpcage.RandomPoses(rest, seed=args.seed, stretch=args.stretch)
    begin = time.perf_counter()
    poses = [source.pose(number) for number in range(args.count)]
    seconds = (time.perf_counter() - begin) / args.count
    strength = [np.linalg.norm(pose.vertices - rest.vertices, axis=1).max() / rest.size for pose in poses]
    reports = [check_pose(rest, pose) for pose in poses]
    found = {
        "milliseconds": round(1e3 * seconds, 1),
        "farthest vertex": quartiles(strength),
        "largest stretch": quartiles([report.largest_stretch for report in reports]),
        "least stretch": quartiles([report.least_stretch for report in reports]),
        "crossing": sum(bool(report.intersecting_faces) for report in reports),
        "inverted": max(report.inverted_share for report in reports),
    }
    for kind in args.kinds:
        found[f"{kind}: beyond the bounds"] = beyond(rest, poses[: args.carried], kind, args.stretch)
    return found


def quartiles(values) -> list[float]:
    """Least, quartiles and largest."""
    return [round(float(value), 3) for value in np.percentile(values, [0, 25, 50, 75, 100])]


def beyond(rest, poses, kind: str, stretch) -> dict:
    """Shares of pairs of near places inside that a kind of coordinates brings nearer or farther than the bounds, with
    5 % of room, and the least and largest ratio."""
    points, spacing = grid_points(rest, 3000)
    step = 0.1 * spacing
    stencil = points[:, None] + step * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    stencil = stencil[rest.contains(stencil.reshape(-1, 3)).reshape(-1, 4).all(axis=1)]
    ratios = []
    for pose in poses:
        moved = warpcage.deform_points(stencil.reshape(-1, 3), rest, pose, kind).reshape(-1, 4, 3)
        ratios.append(np.linalg.norm(moved[:, 1:] - moved[:, :1], axis=2).reshape(-1) / step)
    ratio = np.concatenate(ratios)
    return {
        "shorter": round(float(np.mean(ratio < stretch[0] / 1.05)), 6),
        "longer": round(float(np.mean(ratio > stretch[1] * 1.05)), 6),
        "least": round(float(ratio.min()), 3),
        "largest": round(float(ratio.max()), 3),
    }


def draw(args, rest) -> None:
    """A sheet of a field at rest and its poses."""
    field = warpcage.VoxelField.load(args.field)
    source = warpcage.RandomPoses(rest, seed=args.seed, stretch=args.stretch)
    poses = [source.pose(number) for number in range(args.count)]
    size = {"width": args.size, "height": round(0.8 * args.size)}
    places = np.concatenate([cage.vertices for cage in (rest, *poses)])  # matter is inside: none is cut off
    camera = framing_orbit(places, 1, elevation_degrees=25.0, start_degrees=-60.0, fill=1.0, **size)[0]
    deformer = warpcage.Deformer(field, rest, resolution=64)
    panels = []
    for cage in (rest, *poses):
        frame = deformer.pose(cage).render(camera, supersampling=2, background="white")
        panels.append(draw_cage(frame.rgb, camera, cage) if args.overlay else frame.rgb)
    write_jpeg(args.sheet, contact_sheet(panels, columns=args.columns))
    print(f"wrote {args.sheet}: {pathlib.Path(args.sheet).stat().st_size} bytes")
