"""Where the time of a new pose's position map goes: kernel by kernel on a GPU, step by step on the host.

    python benchmarks/coordinates_profile.py --device cuda:0 --resolution 64

Kernels are timed by events around each launch of a pose that runs outside its graph (a few microseconds of each are the
events' own); below stand the graph of the whole pose, and the host's steps before it.
"""

import argparse
import collections
import time

import warp as wp
from coordinates import KINDS, test_cage
from timing import median_seconds

import warpcage


def kernel_times(position_map, runs: int) -> dict:
    """{kernel: (launches a pose, microseconds a pose)} of the launches that the graph of a pose holds."""
    graph = position_map._graph
    graph._launch()
    total, launches = collections.Counter(), collections.Counter()
    for _ in range(runs):
        wp.timing_begin(cuda_filter=wp.TIMING_ALL)
        graph._launch()
        for result in wp.timing_end():
            name = result.name.split(" ")[-1]
            total[name] += result.elapsed
            launches[name] += 1
    return {name: (launches[name] / runs, 1e3 * total[name] / runs) for name in total}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--kinds", nargs="*", default=KINDS)
    parser.add_argument("--resolution", type=int, nargs="*", default=[64])
    parser.add_argument("--vertices", type=int, default=42)
    parser.add_argument("--runs", type=int, default=10)
    args = parser.parse_args()
    wp.config.quiet = True
    device = warpcage.core.devices.resolve_device(args.device)
    rest = test_cage(args.vertices)
    poses = [rest.twist(25).bend(20), rest.twist(-20)]
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
                ("values", lambda m=position_map: m._write_values()),
                ("take map", lambda m=position_map: m._take_map(False)),
            ):
                times = []
                for _ in range(200):
                    begin = time.perf_counter()
                    step()
                    times.append(time.perf_counter() - begin)
                print(f"    host {name}: {1e6 * sorted(times)[100]:.0f} us")
            times = kernel_times(position_map, args.runs)
            for name, (launches, microseconds) in sorted(times.items(), key=lambda item: -item[1][1]):
                print(f"    {microseconds:8.1f} us {launches:6.1f} x  {name}")


if __name__ == "__main__":
    main()
