"""Random poses of several cages: their stretch by each kind of coordinates, their strength, and their time.

    python benchmarks/random_poses.py --json random_poses.json
    python benchmarks/random_poses.py --count 15 --field bricks.npz --cage cage.obj --sheet random_poses.jpg

Stretch inside is measured between pairs of points on a grid of about 3,000 places in the cage at rest: how far apart
they are after the pose over how far apart they were, in three directions, by `deform_points` (forward), and by
`Cage.check` (posed -> rest). --field draws the poses: rest first, then one picture a pose, from one camera that sees
all of them whole.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import time

import numpy as np
import warp as wp

import warpcage
from warpcage.cage.check import check_pose, grid_points
from warpcage.core.files import atomic_path
from warpcage.reference.cage_scenes import scene_field
from warpcage.view.camera import framing_orbit
from warpcage.view.overlay import draw_cage
from warpcage.view.pictures import contact_sheet, write_jpeg


def main() -> None:
    args = parse_arguments()
    wp.config.quiet = True
    rows = []
    cages = {args.cage: warpcage.Cage.load(args.cage)} if args.cage else usual_cages()
    for name, rest in cages.items():
        rows.append({"cage": name, "vertices": len(rest.vertices), **measured(rest, args)})
        print(rows[-1], flush=True)
    if args.sheet:
        draw(args, next(iter(cages.values())))
    if args.json:
        content = {"count": args.count, "seed": args.seed, "stretch": args.stretch, "rows": rows}
        with atomic_path(args.json) as temporary:
            temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


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


def measured(rest, args) -> dict:
    """What is told of the poses of one cage."""
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


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100, help="poses of each cage (default: 100)")
    parser.add_argument("--carried", type=int, default=5, help="poses that points are carried by (default: 5)")
    parser.add_argument("--kinds", nargs="*", default=["mean_value", "harmonic", "green"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stretch", type=float, nargs=2, default=(0.5, 2.0))
    parser.add_argument("--cage", help="a cage file instead of the usual cages")
    parser.add_argument("--field", help="field that --sheet draws")
    parser.add_argument("--sheet", help="contact sheet to write (.jpg)")
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--size", type=int, default=220, help="pixels along each side of a picture")
    parser.add_argument("--overlay", action="store_true", help="draw the cages too")
    parser.add_argument("--json")
    return parser.parse_args()


if __name__ == "__main__":
    main()
