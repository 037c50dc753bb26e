"""Generated cages measured: what they enclose, how tight and how even they are, and what they cost.

    python benchmarks/cages.py --out out
    python benchmarks/cages.py --field lego.npz --counts 42 100 200 --methods auto shell voxel

One row per scene, method and count. Enclosed: share of the visible voxels that are inside; gap: smallest distance
between the faces and the visible voxels (boxes around their nodes), in voxels; hull: volume of the cage over that of
the object's convex hull; even: mean over the faces of 4 sqrt(3) area / sum of squared sides (1 for equilateral), and
that of the worst face; sides: 95th over 5th percentile of the lengths of the edges; sharp: the largest share of its
full angle that a vertex lacks (0 flat, 1/4 the corner of a box, near 1 a spike). Written with --out: cages.json and the
cages.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import pathlib
import platform
import sys
import time

import numpy as np

import warpcage
from warpcage.cage.generate.fit import face_samples
from warpcage.core.files import atomic_path
from warpcage.field.selection import visible_nodes
from warpcage.reference.cage_scenes import CAGE_SCENES, scene_field


def main(argv=None) -> int:
    args = parse_arguments(argv)
    rows = []
    print(
        f"{'scene':12}{'method':8}{'asked':>6}{'got':>5}{'genus':>6}{'parts':>6}{'enclosed':>10}{'gap':>6}{'hull':>7}"
        f"{'even':>12}{'sides':>7}{'sharp':>7}{'crossings':>10}{'same':>6}{'s':>7}{'cpu s':>7}"
    )
    for name, field in fields(args).items():
        for method in args.methods:
            for count in args.counts:
                row, cage = measured(name, field, method, count, args)
                rows.append(row)
                print(line(row), flush=True)
                if args.out:
                    cage.save(pathlib.Path(args.out) / f"{row['scene'].replace(' ', '_')}_{method}_{count}.obj")
    if args.out:
        document = {"machine": machine(), "rows": rows}
        with atomic_path(pathlib.Path(args.out) / "cages.json") as temporary:
            temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    bad = [f"{row['scene']} {row['method']} {row['asked']}" for row in rows if not holds(row, args.margin)]
    print(f"{len(rows) - len(bad)} of {len(rows)} hold" + (f"; not: {', '.join(bad)}" if bad else ""))
    return 1 if bad else 0


def fields(args) -> dict:
    found = {pathlib.Path(path).stem: warpcage.VoxelField.load(path) for path in args.field or ()}
    return found | {name: scene_field(name, args.resolution) for name in args.scenes}


def measured(name: str, field, method: str, count: int, args) -> tuple[dict, warpcage.Cage]:
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


def machine() -> dict:
    packages = {name: importlib.metadata.version(name) for name in ("numpy", "pymeshlab", "scikit-image", "trimesh")}
    return {"python": platform.python_version(), "cores": os.cpu_count(), "processor": platform.machine(), **packages}


def parse_arguments(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    every = list(CAGE_SCENES)
    parser.add_argument("--out", help="folder for cages.json and the cages")
    parser.add_argument("--field", nargs="+", metavar="FIELD", help="field files (.npz) before the scenes")
    parser.add_argument("--scenes", nargs="*", choices=every, default=every, metavar="SCENE", help="(default: all)")
    parser.add_argument("--counts", nargs="+", type=int, default=[42, 100, 200], help="(default: 42 100 200)")
    parser.add_argument("--methods", nargs="+", choices=("auto", "shell", "voxel"), default=["auto"])
    parser.add_argument("--margin", type=float, help="voxels (default: the generator's own, 1)")
    parser.add_argument("--resolution", type=int, default=64, help="voxels along each side of the scenes (default: 64)")
    parser.add_argument("--again", action="store_true", help="make each cage twice and compare the two bit by bit")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
