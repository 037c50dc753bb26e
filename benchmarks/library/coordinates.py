"""Coordinates: time and kernels of the map of a new pose, how harmonic ones converge, what a coarse lattice costs."""

from __future__ import annotations

import collections
import statistics
import time

import numpy as np
import warp as wp
from common import (
    CAGE,
    DEVICE,
    FIELD,
    JSON,
    KINDS,
    command,
    launch_times,
    median_seconds,
    option,
    quiet_device,
    write_results,
)

import warpcage
from warpcage.coordinates import harmonic_weights
from warpcage.core import cpu_threads, limit_threads
from warpcage.view import framing_orbit

#: Cages whose convergence is measured, and orders required over the resolutions that the reference still resolves.
CASES = {"icosphere": 1.7, "concave": 1.2}


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
    if args.json:
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


# Kernels


@command(
    option("--device", default="cuda:0"),
    option("--kinds", nargs="*", default=KINDS),
    option("--resolution", type=int, nargs="*", default=[64]),
    option("--vertices", type=int, default=42),
    option("--runs", type=int, default=10),
)
def profile(args) -> None:
    """Where the time for the position map of a new pose goes: by kernel on a GPU, by step on the host.

        python benchmarks coordinates profile --device cuda:0 --resolution 64

    Kernels are timed by events around each launch of a pose that runs outside its graph; the events themselves take a
    few microseconds. The graph of the whole pose and the host's steps before it follow.
    """
    device = quiet_device(args.device)
    rest = bumpy_cage(args.vertices)
    poses = two_poses(rest)
    for kind in args.kinds:
        for resolution in args.resolution:
            position_map = warpcage.PositionMap(rest, coordinates=kind, resolution=resolution, device=device)
            for turn in range(4):
                position_map.pose(poses[turn % 2])
            whole = median_seconds(lambda m=position_map: m.pose(poses[0]), device)
            graph = position_map._graph
            replay = median_seconds(lambda g=graph: (g.begin(), g.go_on(), g.finish()), device)
            print(
                f"{kind} {resolution}: pose {1e6 * whole:.0f} us, of which replay {1e6 * replay:.0f} us, "
                f"{position_map.cycles} cycles"
            )
            for name, step in (
                ("check", lambda rest=rest: rest.with_vertices(poses[0].vertices).require_usable()),
                ("lay", lambda m=position_map: m.lattice.lay(poses[0])),
                ("values", lambda m=position_map: m._write_values(m.lattice)),
                ("take map", lambda m=position_map: m._take_map(m.launches, False)),
            ):
                taken = []
                for _ in range(200):
                    begin = time.perf_counter()
                    step()
                    taken.append(time.perf_counter() - begin)
                print(f"    host {name}: {1e6 * sorted(taken)[100]:.0f} us")
            found = kernel_times(position_map, args.runs)
            for name, (launches, microseconds) in sorted(found.items(), key=lambda item: -item[1][1]):
                print(f"    {microseconds:8.1f} us {launches:6.1f} x  {name}")


def kernel_times(position_map, runs: int) -> dict:
    """{kernel: (launches per pose, microseconds per pose)} of the launches that the graph of a pose holds."""
    graph = position_map._graph
    graph.launch()
    total, launches = collections.Counter(), collections.Counter()
    for _ in range(runs):
        for label, milliseconds in launch_times(graph.launch):
            name = label.split(" ")[-1]
            total[name] += milliseconds
            launches[name] += 1
    return {name: (launches[name] / runs, 1e3 * total[name] / runs) for name in total}


# Convergence


@command(
    DEVICE,
    option("--resolution", type=int, nargs="*", default=[16, 24, 32, 48, 64, 96, 128]),
    option("--points", type=int, default=300),
    option("--cuts", type=int, nargs=2, default=[4, 6], help="levels of graded cuts of the two references"),
    JSON,
)
def convergence(args) -> None:
    """How fast harmonic coordinates on a lattice approach boundary elements as the lattice is refined.

        python benchmarks coordinates convergence --json convergence.json

    Harmonic weights of a convex cage (an icosphere with displaced vertices) and of a concave one (an L) at inside
    points clear of the cage by 0.1 of its size, against boundary elements in float64 on faces that are cut finer
    towards edges (the fluxes of weights are singular there). Printed are the RMS and the largest error per resolution,
    the order between one resolution and the next, and the difference between two cuts of the reference, below which
    errors mean nothing; then the largest error at points up to the cage.
    """
    import oracles

    rows = []
    for name, wanted in CASES.items():
        vertices, faces = oracles.cage(name)
        clear = clear_points(vertices, faces, args.points)
        points = np.concatenate([clear, points_up_to_the_cage(vertices, faces, args.points)])
        coarse, reference = (
            oracles.harmonic_oracle(vertices, faces, np.eye(len(vertices)), points, graded=cuts) for cuts in args.cuts
        )
        between = (coarse - reference)[: len(clear)]
        floor = np.sqrt((between**2).mean())
        print(
            f"{name}: {len(clear)} clear points, references differ by {floor:.1e} RMS, "
            f"{np.abs(between).max():.1e} at most; {len(points) - len(clear)} up to the cage, "
            f"{np.abs(coarse - reference).max():.1e} at most"
        )
        errors, last = [], None
        for resolution in args.resolution:
            weights = harmonic_weights(points, warpcage.Cage(vertices, faces), resolution, args.device, tolerance=2e-6)
            up_to_cage = float(np.abs(weights - reference).max())
            error = (weights - reference)[: len(clear)]
            errors.append(float(np.sqrt((error**2).mean())))
            order = np.log(errors[-2] / errors[-1]) / np.log(resolution / last) if len(errors) > 1 else None
            last = resolution
            row = {"cage": name, "resolution": resolution, "rms": errors[-1], "largest": float(np.abs(error).max()),
                   "up_to_cage": up_to_cage, "order": order, "reference_rms": float(floor)}  # fmt: skip
            rows.append(row)
            shown = "-" if order is None else f"{order:.2f}"
            print(
                f"  {resolution:4d}  rms {row['rms']:.2e}  largest {row['largest']:.2e}  to the cage {up_to_cage:.2e}"
                f"  order {shown}",
                flush=True,
            )
        seen = np.array(errors) > floor
        x, y = np.log(np.array(args.resolution)[seen]), np.log(np.array(errors)[seen])
        fitted = float(-np.polyfit(x, y, 1)[0])
        rows.append({"cage": name, "fitted_order": fitted, "wanted": wanted})
        print(f"  fitted order {fitted:.2f} over {seen.sum()} resolutions, wanted {wanted}")
    if args.json:
        write_results(args.json, args.device, rows=rows)


def clear_points(vertices, faces, count):
    """Random points inside that are clear of the cage."""
    import oracles
    import trimesh

    points = oracles.inside_points(vertices, faces, 12 * count)
    nearest = np.full(len(points), np.inf)
    for face in faces:
        corners = np.repeat(vertices[face][None], len(points), axis=0)
        foot = trimesh.triangles.closest_point(corners, points)
        nearest = np.minimum(nearest, np.linalg.norm(foot - points, axis=1))
    return points[nearest > 0.1 * np.ptp(vertices, axis=0).max()][:count]


def points_up_to_the_cage(vertices, faces, count):
    """Random points inside, and points inside within a hundredth of the size of random points on the faces."""
    import oracles

    random = np.random.default_rng(2)
    chosen = faces[random.integers(len(faces), size=count)]
    normal = np.cross(vertices[chosen[:, 1]] - vertices[chosen[:, 0]], vertices[chosen[:, 2]] - vertices[chosen[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    places = np.einsum("nk,nkc->nc", random.dirichlet([1, 1, 1], count), vertices[chosen])
    near = places - np.ptp(vertices, axis=0).max() * random.uniform(1e-4, 1e-2, (count, 1)) * normal
    near = near[oracles.winding_numbers(near, vertices, faces) > 0.5]
    return np.concatenate([oracles.inside_points(vertices, faces, count), near])


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
    if args.json:
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
