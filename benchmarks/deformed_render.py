"""Time of a canonical frame, a deformed frame with its lattice ready, a new pose with its frame, and poses in a loop.

New poses are random and smooth, each another one: their median, 95th percentile and longest, and the first ten of a new
Deformer, which meets buffers that are too small. Slabs are boxes beside each other around what the cage holds, each
turned: one edit, and three. Deformed frames go by turns with canonical ones, and three slabs with one, as the host is
now and then slower for a while: times_canonical and times_one are of medians of the same seconds.

    python benchmarks/deformed_render.py --field field.npz --cage cage.obj --device cuda:0 --json render.json
    python benchmarks/deformed_render.py --field field.npz --cage cage.obj --size 1920 1080
    python benchmarks/deformed_render.py --field room.npz --cage cage.obj --scene DIR --device cuda:0

A field with an outer field or background layers is rendered with them, and the rows of frames say what they add
(around_milliseconds, compared with the same frame on black, by turns). --scene takes a held-out view of a scene, since
such a field shows its surroundings.

--profile lists the kernels of a frame and of a pose (CUDA only); see NOTES-render.md for findings.
"""

import argparse
import dataclasses
import time

import numpy as np
import warp as wp
from frames_by_turns import three_slabs
from results import write_results
from timing import median_seconds, median_seconds_by_turns

import warpcage
from warpcage.core.devices import resolve_device

#: Frames before those whose time counts.
WARM_FRAMES = 10


def main() -> None:
    args = parse_arguments()
    wp.config.quiet = True
    device = resolve_device(args.device)
    field = warpcage.VoxelField.load(args.field, device=device)
    rest = warpcage.Cage.load(args.cage)
    camera = chosen_camera(field, args)
    rows = []

    def report(what, seconds, spread=(), **more):
        more |= {name: round(1e3 * value, 3) for name, value in spread}
        rows.append({"what": what, "milliseconds": round(1e3 * seconds, 3), **more})
        print(rows[-1], flush=True)

    def frame_seconds(*renders):
        views = [lambda render=render: render(camera) for render in renders]
        return median_seconds_by_turns(views, device, runs=args.runs, warm=WARM_FRAMES)

    def report_frame(what, render, **more):
        seconds, canonical = frame_seconds(render, field.render)
        more["times_canonical"] = round(seconds / canonical, 3)
        if field.background_model:
            plain = frame_seconds(lambda view: render(view, background="black"), render)
            more["around_milliseconds"] = round(1e3 * (plain[1] - plain[0]), 3)
        report(what, seconds, **more)

    report_frame("canonical frame", field.render)
    poses = [rest.bend(share * args.bend, axis="y", towards="z") for share in (1.0, 0.8)]
    source = warpcage.RandomPoses(rest, seed=args.seed)
    for kind in args.kinds:
        deformer = warpcage.Deformer(field, rest, coordinates=kind, resolution=args.resolution).pose(poses[0])
        report_frame("frame, lattice ready", deformer.render, kind=kind)
        wild = [source.pose(number) for number in range(args.poses)]
        report("pose and frame, as sweeps draw them", *random_times(deformer, wild, camera, device), kind=kind)
        randoms = random_poses(rest, args.poses, args.seed)
        report("pose and frame, random", *random_times(deformer, randoms, camera, device), kind=kind)
        firsts = warpcage.Deformer(field, rest, coordinates=kind, resolution=args.resolution)
        times = [pose_and_frame(firsts, cage, camera, device) for cage in randoms[:10]]
        report("the first ten, the longest", max(times), kind=kind, each=[round(1e3 * t, 2) for t in times])
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
    slabs = three_slabs(rest)
    turned = [slab.rotate(12, axis="x") for slab in slabs]
    options = {"coordinates": "mean_value", "resolution": args.resolution}
    one = warpcage.Deformer(field, slabs[1], **options).pose(turned[1])
    three = warpcage.Deformer(field, slabs, **options).pose(turned)
    alone, together = frame_seconds(one.render, three.render)
    report("frame, one slab, lattices ready", alone, kind="mean_value")
    report("frame, three slabs, lattices ready", together, kind="mean_value", times_one=round(together / alone, 3))
    if args.profile and device.is_cuda:
        for several in (one, three):
            profile(lambda several=several: several.render(camera))
    peak = wp.get_mempool_used_mem_high(device) if device.is_cuda else None
    print({"peak_device_bytes": peak})
    if args.json:
        write_results(
            args.json,
            device,
            voxels=field.voxel_count,
            cage_vertices=len(rest.vertices),
            size=[camera.width, camera.height],
            resolution=args.resolution,
            around=field.background_model.summary if field.background_model else None,
            peak_device_bytes=peak,
            rows=rows,
        )


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", required=True)
    parser.add_argument("--cage", required=True)
    parser.add_argument("--device", default=None)
    parser.add_argument(
        "--size", type=int, nargs="+", default=[800], help="pixels a side, or width and height; without --scene"
    )
    parser.add_argument("--scene", help="scene folder: its first held-out view instead of one from a turntable")
    parser.add_argument("--downscale", type=int, default=1, help="factor on the scene's pictures")
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--bend", type=float, default=45.0)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--kinds", nargs="+", default=["harmonic", "mean_value", "green"])
    parser.add_argument("--poses", type=int, default=40, help="random poses")
    parser.add_argument("--seed", type=int, default=0, help="of the random poses")
    parser.add_argument("--profile", action="store_true", help="list the kernels of a pose and its frame")
    parser.add_argument("--bake", action="store_true", help="bake the pose too, and compare with the live frame")
    parser.add_argument("--json")
    return parser.parse_args()


def chosen_camera(field, args):
    if args.scene:
        return warpcage.load_scene(args.scene, split="test", downscale=args.downscale).cameras[0]
    width, height = args.size[0], args.size[-1]
    camera = warpcage.turntable(
        field.center, 4.03, 30, 1, fov_degrees=39.6, width=height, height=height, start_degrees=30
    )[0]
    # a wider picture shows more beside the scene, which stays as high in it
    return dataclasses.replace(camera, width=width, cx=camera.cx + 0.5 * (width - height))


def random_poses(rest, count: int, seed: int) -> list:
    """Cages moved by three waves each, of random directions, lengths above 1.4 times their size, and phases: those that
    times have been taken with from the start, milder than `RandomPoses`."""
    random = np.random.default_rng(seed)
    centre, size = rest.vertices.mean(axis=0), float(np.ptp(rest.bounds, axis=0).max())
    places = (rest.vertices - centre) / size
    poses = []
    for _ in range(count):
        moved = places.copy()
        for _ in range(3):
            wave = random.normal(size=3)
            wave *= random.uniform(0.2, 0.7) / np.linalg.norm(wave)
            phase = random.uniform(0, 2 * np.pi)
            moved += 0.05 * random.normal(size=3) * np.sin(2 * np.pi * places @ wave + phase)[:, None]
        poses.append(rest.with_vertices(centre + size * moved))
    return poses


def pose_and_frame(deformer, cage, camera, device) -> float:
    """Seconds of a new pose and its frame, with the device idle before and after."""
    wp.synchronize_device(device)
    begin = time.perf_counter()
    deformer.pose(cage).render(camera)
    wp.synchronize_device(device)
    return time.perf_counter() - begin


def random_times(deformer, cages, camera, device):
    """Median seconds of random poses and their frames, and what else is told of them."""
    for cage in cages[:3]:
        deformer.pose(cage).render(camera)
    times = [pose_and_frame(deformer, cage, camera, device) for cage in cages]
    return float(np.median(times)), [("percentile_95", float(np.percentile(times, 95))), ("longest", max(times))]


class Cycle:
    """Poses by turns, so that each one is new."""

    def __init__(self, deformer, poses):
        self.deformer, self.poses, self.turn = deformer, poses, 0

    def pose(self):
        self.turn += 1
        return self.deformer.pose(self.poses[self.turn % len(self.poses)])


def posing_loop(deformer, rest, camera, args, count: int = 60) -> float:
    """Seconds per frame of a swinging bend: each frame is a new pose, its cage made beforehand. The device may lag
    behind the host within the loop, as in a viewer; the solver's cycles replay CUDA graphs."""
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
