"""Coordinates: time of the map of a new pose, and what a coarse lattice costs in a picture."""

from __future__ import annotations

import statistics
import time

import numpy as np
import warp as wp
from common import CAGE, DEVICE, FIELD, JSON, KINDS, command, median_seconds, option, quiet_device, write_results

import warpcage
from warpcage.core import cpu_threads, limit_threads
from warpcage.view import framing_orbit

# Times


@command(
    DEVICE,
    option("--resolution", type=int, nargs="*", default=[64, 128, 256]),
    option("--vertices", type=int, nargs="*", default=[42]),
    option("--cage", nargs="*", default=[], help="cage files instead (where pymeshlab is missing)"),
    option("--kinds", nargs="*", default=KINDS),
    option("--runs", type=int, default=20),
    option("--points", type=int, help="points of the closed forms (default: 16 million, CPU 400,000)"),
    JSON,
)
def times(args) -> None:
    """Time of the position map of a new pose, and of the closed forms per point.

        python benchmarks coordinates times --device cuda:0 --json coordinates.json
        python benchmarks coordinates times --device cpu --resolution 64 128 --runs 3

    A map is what `PositionMap.pose` does, host and device: lattice, distances, coordinates on the deformed cage, and
    the extension beyond it; on CUDA one graph. Times are medians of warm runs that alternate between two poses, each a
    new Cage, so that its checks are included. Memory is what the map's buffers hold. On a CPU the ratio to one thread
    is printed too, from runs that alternate with runs on one thread. Several vertex counts show how the cost grows.
    """
    device = quiet_device(args.device)
    points = args.points or (400_000 if device.is_cpu else 16_000_000)
    cages = [warpcage.Cage.load(file) for file in args.cage] or [bumpy_cage(count) for count in args.vertices]
    rows = []

    def report(row: dict, rest) -> None:
        rows.append(row | {"vertices": len(rest.vertices), "faces": len(rest.faces)})
        print(rows[-1], flush=True)

    for rest in cages:
        for kind in args.kinds:
            for resolution in args.resolution:
                report(map_row(rest, kind, resolution, device, args.runs), rest)
        for kind in args.kinds:
            if kind != "harmonic":
                report(closed_form_row(rest, kind, points, device, args.runs), rest)
    write_results(args.json, device, cpu_threads=cpu_threads(), rows=rows)


def bumpy_cage(vertex_count: int) -> warpcage.Cage:
    """The icosphere of 42 vertices, or a bumpy sphere decimated to about vertex_count vertices."""
    if vertex_count == 42:
        return warpcage.Cage.icosphere((0, 0, 0), 1.0, subdivisions=1)
    mesh = warpcage.Cage.icosphere((0, 0, 0), 1.0, subdivisions=3)
    bumps = 1 + 0.25 * np.sin(3 * mesh.vertices[:, :1]) * np.cos(2 * mesh.vertices[:, 1:2])
    import trimesh

    return warpcage.Cage.from_mesh(
        trimesh.Trimesh(mesh.vertices * bumps, mesh.faces, process=False), vertex_count=vertex_count
    )


def two_poses(rest) -> list:
    """Poses that are taken by turns."""
    return [rest.twist(25).bend(20), rest.twist(-20)]


def map_row(rest, kind: str, resolution: int, device, runs: int) -> dict:
    """Time of the map of new poses."""
    position_map = warpcage.PositionMap(rest, coordinates=kind, resolution=resolution, device=device)
    poses, turn = two_poses(rest), [0]

    def pose():
        turn[0] += 1
        deformed = poses[turn[0] % 2]
        position_map.pose(deformed.with_vertices(deformed.vertices))

    for _ in range(2 if device.is_cpu else 100):  # an idle GPU's clock takes a while to rise
        pose()
    ratio = {}
    if device.is_cpu:
        seconds, alone = interleaved_seconds(pose, max(3, runs))
        ratio = {"times_one_thread": round(alone / seconds, 2)}
    else:
        seconds = median_seconds(pose, device, runs=runs)
    return {
        "kind": kind,
        "resolution": resolution,
        "milliseconds": round(1e3 * seconds, 3),
        "cycles": position_map.cycles,
        "nodes": position_map.lattice.node_count,
        "megabytes": round(position_map.lattice.buffers.bytes / 1e6, 1),
        **ratio,
    }


def closed_form_row(rest, kind: str, count: int, device, runs: int) -> dict:
    """Points that a closed form deforms in a second."""
    random = np.random.default_rng(0)
    points = wp.array(random.uniform(-0.3, 0.3, (count, 3)), dtype=wp.vec3, device=device)
    posed = two_poses(rest)[0]

    def deform():
        warpcage.deform_points(points, rest, posed, coordinates=kind, device=device)

    seconds = median_seconds(deform, device, runs=max(3, runs // 4))
    return {"kind": kind, "points": count, "million_points_a_second": round(count / seconds / 1e6, 2)}


def interleaved_seconds(action, runs: int) -> tuple[float, float]:
    """Median seconds of action() on all threads and on one, by turns, so that other work affects both."""
    threads = cpu_threads()
    taken = {threads: [], 1: []}
    action()
    for _ in range(runs):
        for count in taken:
            with limit_threads(count):
                begin = time.perf_counter()
                action()
                taken[count].append(time.perf_counter() - begin)
    return statistics.median(taken[threads]), statistics.median(taken[1])


# Lattices


@command(
    FIELD,
    CAGE,
    option("--sizes", type=int, nargs="+", default=[80, 160, 320, 640]),
    option("--cells", type=int, nargs="+", default=[24, 32, 48, 64, 96, 128]),
    option("--fine", type=int, default=192),
    option("--coordinates", nargs="+", default=["harmonic", "mean_value"]),
    JSON,
)
def lattice_by_size(args) -> None:
    """What a coarser lattice costs in a picture, by the picture's size: the rule of the command line's --resolution.

        python benchmarks coordinates lattice-by-size --field bricks.npz --cage bricks_cage.obj --json lattice.json

    The demo (`warpcage edit --demo` makes both files), bent and twisted, is rendered at several sizes over lattices of
    several numbers of cells along the longest side of the cage, and compared with one of --fine cells: PSNR over the
    object's pixels, and the share of them that differ by more than 8 of 255. Times are CPU times of the pose and of the
    frame, after a first one, and mean something beside one another alone.
    """
    field, rest = warpcage.VoxelField.load(args.field), warpcage.Cage.load(args.cage)
    posed = rest.bend(40, axis="x", towards="z").twist(20, axis="z")
    rows = [row for kind in args.coordinates for row in compared(field, rest, posed, kind, args)]
    write_results(args.json, field.device, fine=args.fine, rows=rows)


def compared(field, rest, posed, kind: str, args) -> list[dict]:
    """One row for each number of cells and each size."""
    points = np.concatenate([rest.vertices, posed.vertices])
    cameras = {
        size: framing_orbit(points, 1, elevation_degrees=25, start_degrees=-60, up=field.up, width=size, height=size)[0]
        for size in args.sizes
    }
    truth = {}
    rows = []
    for cells in [args.fine, *args.cells]:
        deformer = warpcage.Deformer(field, rest, coordinates=kind, resolution=cells).pose(posed)
        start = time.process_time()
        deformer.pose(posed.translate([1e-3, 0, 0]))
        pose_seconds = time.process_time() - start
        deformer.pose(posed)
        for size, camera in cameras.items():
            deformer.render(camera)
            start = time.process_time()
            frame = deformer.render(camera)
            frame_seconds = time.process_time() - start
            if cells == args.fine:
                truth[size] = frame
                continue
            seen = np.maximum(frame.alpha, truth[size].alpha) > 0.01
            difference = np.abs(frame.rgb - truth[size].rgb)[seen]
            row = {"coordinates": kind, "cells": cells, "size": size, "cells_per_pixel": cells / size,
                   "psnr": float(-10 * np.log10(np.mean(difference**2))),
                   "differ": float((difference.max(axis=-1) > 8 / 255).mean()),
                   "pose_seconds": pose_seconds, "frame_seconds": frame_seconds}  # fmt: skip
            rows.append(row)
            print(
                f"{kind:10s} {cells:4d} cells {size:4d} pixels: {row['psnr']:5.1f} dB, {100 * row['differ']:5.2f} % "
                f"differ, pose {pose_seconds:6.3f} s, frame {frame_seconds:6.3f} s",
                flush=True,
            )
    return rows
