"""Time of a canonical frame, a deformed frame with its lattice ready, and a new pose with its frame.

    python benchmarks/deformed_render.py --field field.npz --cage cage.obj --device cuda:0 --json render.json
"""

import argparse
import json

import warp as wp
from timing import median_seconds

import warpcage


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", required=True)
    parser.add_argument("--cage", required=True)
    parser.add_argument("--device", default=None)
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--bend", type=float, default=45.0)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--json")
    args = parser.parse_args()
    wp.config.quiet = True
    device = warpcage.devices.resolve_device(args.device)
    field = warpcage.VoxelField.load(args.field, device=device)
    rest = warpcage.Cage.load(args.cage)
    poses = [rest.bend(args.bend, axis="y", towards="z"), rest.bend(0.8 * args.bend, axis="y", towards="z")]
    camera = warpcage.turntable(field.center, 4.03, 30, 1, fov_degrees=39.6, width=args.size, height=args.size,
                                start_degrees=30)[0]
    rows = [{"what": "canonical frame",
             "milliseconds": 1e3 * median_seconds(lambda: field.render(camera), device, runs=args.runs)}]
    print(rows[-1], flush=True)
    for kind in ("harmonic", "mean_value", "green"):
        deformer = warpcage.Deformer(field, rest, coordinates=kind, resolution=args.resolution).pose(poses[0])
        frame = median_seconds(lambda deformer=deformer: deformer.render(camera), device, runs=args.runs)
        turn = [0]

        def pose(deformer=deformer, turn=turn):
            turn[0] += 1
            deformer.pose(poses[turn[0] % 2])

        posing = median_seconds(pose, device, runs=args.runs)
        both = median_seconds(lambda pose=pose, deformer=deformer: (pose(), deformer.render(camera)), device,
                              runs=args.runs)
        for what, seconds in (("frame, lattice ready", frame), ("pose", posing), ("pose and frame", both)):
            rows.append({"what": what, "kind": kind, "milliseconds": round(1e3 * seconds, 3)})
            print(rows[-1], flush=True)
    if device.is_cuda:
        print({"peak_device_bytes": wp.get_mempool_used_mem_high(device)})
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump({"device": device.name, "warp": wp.__version__, "voxels": field.voxel_count, "size": args.size,
                       "resolution": args.resolution, "rows": rows}, file, indent=1)


if __name__ == "__main__":
    main()
