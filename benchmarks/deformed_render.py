"""Time of a canonical frame, a deformed frame with its lattice ready, a new pose with its frame, and posing in a loop.

    python benchmarks/deformed_render.py --field field.npz --cage cage.obj --device cuda:0 --json render.json
    python benchmarks/deformed_render.py --field room.npz --cage cage.obj --scene DIR --device cuda:0

A field with layers behind it is rendered with them, and the rows of frames say what they add (layers_milliseconds:
against the same frame on black, by turns). --scene takes a held-out view of a scene, whose surroundings such a field
shows.

The kernels behind a frame and a pose are listed with --profile (CUDA only); NOTES-render.md holds what was found.
"""

import argparse
import json
import time

import warp as wp
from timing import median_seconds, median_seconds_by_turns

import warpcage


def main() -> None:
    args = parse_arguments()
    wp.config.quiet = True
    device = warpcage.core.devices.resolve_device(args.device)
    field = warpcage.VoxelField.load(args.field, device=device)
    rest = warpcage.Cage.load(args.cage)
    camera = chosen_camera(field, args)
    rows = []

    def report(what, seconds, **more):
        rows.append({"what": what, "milliseconds": round(1e3 * seconds, 3), **more})
        print(rows[-1], flush=True)

    def report_frame(what, render, **more):
        views = [lambda: render(camera), lambda: render(camera, background="black")]
        seconds, *plain = median_seconds_by_turns(
            views if field.background_model else views[:1], device, runs=args.runs
        )
        if plain:
            more["layers_milliseconds"] = round(1e3 * (seconds - plain[0]), 3)
        report(what, seconds, **more)

    report_frame("canonical frame", field.render)
    poses = [rest.bend(share * args.bend, axis="y", towards="z") for share in (1.0, 0.8)]
    for kind in args.kinds:
        deformer = warpcage.Deformer(field, rest, coordinates=kind, resolution=args.resolution).pose(poses[0])
        report_frame("frame, lattice ready", deformer.render, kind=kind)
        cycle = Cycle(deformer, poses)
        report("pose", median_seconds(cycle.pose, device, runs=args.runs), kind=kind)
        report(
            "pose and frame", median_seconds(lambda c=cycle: c.pose().render(camera), device, runs=args.runs), kind=kind
        )
        if device.is_cuda:
            seconds = posing_loop(deformer, rest, camera, args)
            report("posing in a loop", seconds, kind=kind, frames_a_second=round(1 / seconds, 1))
        if args.profile and device.is_cuda:
            profile(lambda c=cycle: c.pose().render(camera))
        if args.bake:
            report("bake", median_seconds(lambda d=deformer: warpcage.bake(d), device, runs=1), kind=kind)
            baked = warpcage.bake(deformer)
            live = deformer.render(camera).rgb
            print({"bake": repr(baked), "psnr": round(float(warpcage.psnr(baked.render(camera).rgb, live)), 2)})
            report_frame("frame of the baked field", baked.render, kind=kind)
    peak = wp.get_mempool_used_mem_high(device) if device.is_cuda else None
    print({"peak_device_bytes": peak})
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump(
                {
                    "device": device.name,
                    "warp": wp.__version__,
                    "voxels": field.voxel_count,
                    "size": [camera.width, camera.height],
                    "resolution": args.resolution,
                    "layers": field.background_model.layer_count if field.background_model else 0,
                    "peak_device_bytes": peak,
                    "rows": rows,
                },
                file,
                indent=1,
            )


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", required=True)
    parser.add_argument("--cage", required=True)
    parser.add_argument("--device", default=None)
    parser.add_argument("--size", type=int, default=800, help="pixels a side, without --scene")
    parser.add_argument("--scene", help="scene folder: its first held-out view instead of one from a turntable")
    parser.add_argument("--downscale", type=int, default=1, help="of the scene's pictures")
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--bend", type=float, default=45.0)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--kinds", nargs="+", default=["harmonic", "mean_value", "green"])
    parser.add_argument("--profile", action="store_true", help="list the kernels of a pose and its frame")
    parser.add_argument("--bake", action="store_true", help="bake the pose too, and compare with the live frame")
    parser.add_argument("--json")
    return parser.parse_args()


def chosen_camera(field, args):
    if args.scene:
        return warpcage.load_scene(args.scene, split="test", downscale=args.downscale).cameras[0]
    return warpcage.turntable(
        field.center, 4.03, 30, 1, fov_degrees=39.6, width=args.size, height=args.size, start_degrees=30
    )[0]


class Cycle:
    """Poses by turns, so that each is a new one."""

    def __init__(self, deformer, poses):
        self.deformer, self.poses, self.turn = deformer, poses, 0

    def pose(self):
        self.turn += 1
        return self.deformer.pose(self.poses[self.turn % len(self.poses)])


def posing_loop(deformer, rest, camera, args, count: int = 60) -> float:
    """Seconds a frame of a bend that swings, each frame a new pose, cages made beforehand. The device may run behind
    the host within the loop, as it would in a viewer; the solver's cycles replay CUDA graphs."""
    cages = [rest.bend(args.bend * (0.5 + 0.5 * k / count), axis="y", towards="z") for k in range(count)]
    for cage in cages[:3]:
        deformer.pose(cage).render(camera)
    wp.synchronize_device(deformer.device)
    begin = time.perf_counter()
    for cage in cages:
        deformer.pose(cage).render(camera)
    wp.synchronize_device(deformer.device)
    return (time.perf_counter() - begin) / count


def profile(action) -> None:
    """Print the device time of each kernel of action()."""
    action()
    with wp.ScopedTimer(
        "kernels", cuda_filter=wp.TIMING_KERNEL | wp.TIMING_MEMCPY | wp.TIMING_MEMSET | wp.TIMING_GRAPH, print=False
    ) as timer:
        action()
    totals: dict[str, list] = {}
    for result in timer.timing_results:
        entry = totals.setdefault(result.name, [0, 0.0])
        entry[0] += 1
        entry[1] += result.elapsed
    for name, (number, milliseconds) in sorted(totals.items(), key=lambda item: -item[1][1]):
        print(f"  {milliseconds:8.3f} ms {number:4d} {name}")


if __name__ == "__main__":
    main()
