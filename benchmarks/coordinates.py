"""Time of one new pose's position map, and of the closed forms a point.

    python benchmarks/coordinates.py --device cuda:0 --json coordinates.json
    python benchmarks/coordinates.py --device cpu --resolution 64 128 --runs 3

A map is what `PositionMap.pose` does, host and device: lattice, distances, coordinates on the deformed cage, and the
extension beyond it; on CUDA one graph. Median of warm runs, alternating between two poses, each a new Cage so that its
checks are paid for as well. Memory is what the map's buffers hold. On a CPU the ratio to one thread is printed, from
poses that take turns with such on one thread. Several vertex counts show how the cost grows.
"""

import argparse
import json
import statistics
import time

import numpy as np
import warp as wp
from timing import median_seconds

import warpcage
from warpcage.core import devices

KINDS = ("mean_value", "harmonic", "green")


def test_cage(vertex_count: int) -> warpcage.Cage:
    """The icosphere of 42 vertices, or a bumpy sphere whose mesh is decimated to about a count."""
    if vertex_count == 42:
        return warpcage.Cage.icosphere((0, 0, 0), 1.0, subdivisions=1)
    mesh = warpcage.Cage.icosphere((0, 0, 0), 1.0, subdivisions=3)
    bumps = 1 + 0.25 * np.sin(3 * mesh.vertices[:, :1]) * np.cos(2 * mesh.vertices[:, 1:2])
    import trimesh

    return warpcage.Cage.from_mesh(
        trimesh.Trimesh(mesh.vertices * bumps, mesh.faces, process=False), vertex_count=vertex_count
    )


def interleaved_seconds(action, runs: int) -> tuple[float, float]:
    """Median seconds of action() on all threads and on one, in turns, so that other work on the machine meets both."""
    threads = devices.CPU_THREADS
    times = {threads: [], 1: []}
    action()
    for _ in range(runs):
        for count in times:
            devices.CPU_THREADS = count
            begin = time.perf_counter()
            action()
            times[count].append(time.perf_counter() - begin)
    devices.CPU_THREADS = threads
    return statistics.median(times[threads]), statistics.median(times[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--resolution", type=int, nargs="*", default=[64, 128, 256])
    parser.add_argument("--vertices", type=int, nargs="*", default=[42])
    parser.add_argument("--cage", nargs="*", default=[], help="cage files instead (where pymeshlab is missing)")
    parser.add_argument("--kinds", nargs="*", default=KINDS)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--points", type=int, help="for the closed forms: 16 million, or 400,000 on a CPU")
    parser.add_argument("--json")
    args = parser.parse_args()
    wp.config.quiet = True
    device = warpcage.core.devices.resolve_device(args.device)
    args.points = args.points or (400_000 if device.is_cpu else 16_000_000)
    cages = [warpcage.Cage.load(file) for file in args.cage] or [test_cage(count) for count in args.vertices]
    rows = []
    for rest in cages:
        poses = [rest.twist(25).bend(20), rest.twist(-20)]
        for kind in args.kinds:
            for resolution in args.resolution:
                position_map = warpcage.PositionMap(rest, coordinates=kind, resolution=resolution, device=device)
                turn = [0]

                def pose(position_map=position_map, poses=poses, turn=turn):
                    turn[0] += 1
                    deformed = poses[turn[0] % 2]
                    position_map.pose(deformed.with_vertices(deformed.vertices))

                for _ in range(2 if device.is_cpu else 100):  # an idle GPU's clock takes a while to rise
                    pose()
                ratio = {}
                if device.is_cpu:
                    seconds, alone = interleaved_seconds(pose, max(3, args.runs))
                    ratio = {"times_one_thread": round(alone / seconds, 2)}
                else:
                    seconds = median_seconds(pose, device, runs=args.runs)
                rows.append(
                    {
                        "kind": kind,
                        "resolution": resolution,
                        "vertices": len(rest.vertices),
                        "faces": len(rest.faces),
                        "milliseconds": round(1e3 * seconds, 3),
                        "cycles": position_map.cycles,
                        "nodes": position_map.lattice.node_count,
                        "megabytes": round(position_map.lattice.buffers.bytes / 1e6, 1),
                        **ratio,
                    }
                )
                print(rows[-1], flush=True)
        random = np.random.default_rng(0)
        points = wp.array(random.uniform(-0.3, 0.3, (args.points, 3)), dtype=wp.vec3, device=device)
        for kind in [kind for kind in args.kinds if kind != "harmonic"]:
            seconds = median_seconds(
                lambda kind=kind, points=points, rest=rest, poses=poses: warpcage.deform_points(
                    points, rest, poses[0], coordinates=kind, device=device
                ),
                device,
                runs=max(3, args.runs // 4),
            )
            rows.append(
                {
                    "kind": kind,
                    "points": args.points,
                    "vertices": len(rest.vertices),
                    "million_points_a_second": round(args.points / seconds / 1e6, 2),
                }
            )
            print(rows[-1], flush=True)
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump(
                {"device": device.name, "cpu_threads": devices.CPU_THREADS, "warp": wp.__version__, "rows": rows},
                file,
                indent=1,
            )


if __name__ == "__main__":
    main()
