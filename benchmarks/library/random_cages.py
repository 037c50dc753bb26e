"""Cages around random shapes: how many fail, do not enclose, fold or cut themselves."""

from __future__ import annotations

import collections
import itertools
import time
import warnings

import numpy as np
from common import JSON, UsageError, command, option, write_results
from shapes import cones, marched, slabs

import warpcage

KINDS = ("boxes", "balls", "blobs", "sticks", "torus", "limbs")


def random_shape(rng: np.random.Generator):
    """The kind of a closed mesh within a cube about the origin, and the mesh."""
    import trimesh

    def made(vertices, faces):
        return kind, trimesh.Trimesh(vertices, faces, process=False)

    kind = str(rng.choice(KINDS))
    if kind == "boxes":
        lows = rng.uniform(-1.0, 0.5, (rng.integers(1, 5), 3))
        return made(*marched(slabs(*zip(lows, lows + rng.uniform(0.1, 0.7, lows.shape), strict=True))))
    if kind == "balls":
        mesh = trimesh.creation.icosphere(3)
        return made(mesh.vertices * rng.uniform(0.1, 1.0, 3), mesh.faces)
    if kind == "torus":
        mesh = trimesh.creation.torus(rng.uniform(0.4, 0.9), rng.uniform(0.03, 0.35))
        return made(mesh.vertices * rng.uniform(0.5, 1.2, 3), mesh.faces)
    count = int(rng.integers(2, 9))
    starts = rng.uniform(-0.8, 0.8, (count, 3))
    if kind == "blobs":
        rows, blend = np.column_stack([starts, starts, rng.uniform(0.1, 0.35, (count, 1)).repeat(2, axis=1)]), 0.08
    else:  # limbs start where others end
        ends = rng.uniform(-0.8, 0.8, (count, 3))
        if kind == "limbs":
            starts = np.concatenate([np.zeros((1, 3)), [ends[rng.integers(k)] for k in range(1, count)]])
        rows, blend = np.column_stack([starts, ends, rng.uniform(0.05, 0.2, (count, 2))]), 0.02
    return made(*marched(cones(rows, blend)))


def verdict(cage: warpcage.Cage, points: np.ndarray) -> str:
    """What is wrong with a cage of these points, or "holds"."""
    report = cage.check()
    if len(report.intersecting_faces):
        return "cuts itself"
    if report.volume <= 0.0 or not report.usable:
        return "cannot be used"
    a, b, c = np.swapaxes(cage.surface.vertices[cage.surface.faces], 0, 1)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    pairs = collections.defaultdict(list)
    for face, corners in enumerate(cage.surface.faces):
        for edge in zip(corners, np.roll(corners, -1), strict=True):
            pairs[tuple(sorted(map(int, edge)))].append(face)
    folds = [normals[one] @ normals[other] for one, other in pairs.values()]
    if min(folds) < -0.999:
        return "folded"
    return "holds" if cage.contains(points, device="cpu").all() else "does not enclose"


@command(
    option("--count", type=int, default=100, help="shapes (default: 100)"),
    option("--first", type=int, default=0, metavar="SEED", help="seed of the first, one more each (default: 0)"),
    option("--detail", nargs="+", default=["even"], metavar="DETAIL", help="values of `detail` (default: even)"),
    option("--faces", nargs="+", default=["triangles"], metavar="FACES", help="values of `faces` (default: triangles)"),
    option("--vertices", nargs=2, type=int, default=[12, 150], metavar=("MIN", "MAX"), help="(default: 12 150)"),
    JSON,
)
def main(args) -> int:
    """Cages around random shapes: how many fail, do not enclose, fold or cut themselves.

        python benchmarks random-cages --count 1000 --detail even parts --faces triangles quads

    Boxes, balls, blobs, sticks, tori and limbs, each with a random number of vertices, in every combination of the
    options. Folded: two faces across an edge lie on each other. The exit status is 1 where a cage does not hold.
    """
    if args.count < 1 or args.vertices[0] > args.vertices[1]:
        raise UsageError("--count must be at least 1, and --vertices MIN at most MAX")
    rows = []
    for seed in range(args.first, args.first + args.count):
        rng = np.random.default_rng(seed)
        kind, mesh = random_shape(rng)
        count = int(rng.integers(args.vertices[0], args.vertices[1] + 1))
        for detail, shape in itertools.product(args.detail, args.faces):
            start = time.process_time()
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of what had to be closed
                    cage = warpcage.Cage.from_mesh(mesh, count, detail=detail, faces=shape)
                found = verdict(cage, mesh.vertices)
            except ValueError as error:
                found = str(error)
            seconds = time.process_time() - start
            rows.append({"seed": seed, "kind": kind, "count": count, "detail": detail, "faces": shape,
                         "found": found, "cpu_seconds": seconds})  # fmt: skip
            if found != "holds":
                print(f"{seed} {kind} {count} {detail} {shape}: {found}", flush=True)
    for (detail, shape), same in itertools.groupby(
        sorted(rows, key=lambda row: (row["detail"], row["faces"])), key=lambda row: (row["detail"], row["faces"])
    ):
        same = list(same)
        times = [row["cpu_seconds"] for row in same]
        held = sum(row["found"] == "holds" for row in same)
        print(f"{detail:8}{shape:10}{held} of {len(same)} hold; CPU seconds: median {np.median(times):.2f}, "
              f"95 % {np.percentile(times, 95):.2f}, most {max(times):.2f}")  # fmt: skip
    if args.json:
        write_results(args.json, "cpu", rows=rows)
    return int(any(row["found"] != "holds" for row in rows))
