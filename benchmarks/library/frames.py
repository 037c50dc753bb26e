"""Frames: a new pose and its picture, many views, and the paper's Table 1."""

from __future__ import annotations

import tempfile

import numpy as np
import warp as wp
from common import (
    CAGE,
    DEVICE,
    FIELD,
    JSON,
    KINDS,
    QUICK,
    ball_field,
    command,
    median_seconds,
    option,
    quiet_device,
    seconds_by_turns,
    seconds_of,
    turntable_view,
    write_jpeg,
    write_results,
)

import warpcage

#: Frames before those whose time counts.
WARM_FRAMES = 10


# Times of frames and poses


@command(
    FIELD,
    CAGE,
    DEVICE,
    option("--size", type=int, nargs="+", default=[800], help="pixels a side, or width and height; without --scene"),
    option("--scene", help="scene folder: its first held-out view instead of one from a turntable"),
    option("--downscale", type=int, default=1, help="factor on the scene's pictures"),
    option("--resolution", type=int, default=128, help="cells of the lattice"),
    option("--bend", type=float, default=45.0),
    option("--runs", type=int, default=40),
    option("--kinds", nargs="+", default=["harmonic", "mean_value", "green"]),
    option("--poses", type=int, default=40, help="random poses"),
    option("--seed", type=int, default=0, help="of the random poses"),
    JSON,
)
def times(args) -> None:
    """Time of a canonical frame, a deformed one with its lattice ready, a new pose with its frame, and poses in a loop.

        python benchmarks frames times --field field.npz --cage cage.obj --device cuda:0 --json render.json
        python benchmarks frames times --field field.npz --cage cage.obj --size 1920 1080
        python benchmarks frames times --field room.npz --cage cage.obj --scene DIR --device cuda:0

    New poses are random and smooth, each another one: their median, 95th percentile and longest, and the first ten of a
    new Deformer, which meets buffers that are too small. Slabs are boxes beside each other around what the cage holds,
    each turned: one edit, and three. Deformed frames go by turns with canonical ones, and three slabs with one, as the
    host is now and then slower for a while: times_canonical and times_one are of medians of the same seconds.

    A field with an outer field or background layers is rendered with them, and the rows of frames say what they add
    (around_milliseconds, compared with the same frame on black, by turns). --scene takes a held-out view of a scene,
    since such a field shows its surroundings.
    """
    device = quiet_device(args.device)
    field = warpcage.VoxelField.load(args.field, device=device)
    rest = warpcage.Cage.load(args.cage)
    if args.scene:
        camera = warpcage.load_scene(args.scene, split="test", downscale=args.downscale).cameras[0]
    else:
        camera = turntable_view(field, args.size[0], args.size[-1])
    rows = []

    def report(what, seconds, spread=(), **more):
        more |= {name: round(1e3 * value, 3) for name, value in spread}
        rows.append({"what": what, "milliseconds": round(1e3 * seconds, 3), **more})
        print(rows[-1], flush=True)

    def frame_seconds(*renders):
        views = [lambda render=render: render(camera) for render in renders]
        return [float(np.median(taken)) for taken in seconds_by_turns(views, device, runs=args.runs, warm=WARM_FRAMES)]

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
        report("pose and frame, as sweeps draw them", *random_times(deformer, wild, camera), kind=kind)
        randoms = random_poses(rest, args.poses, args.seed)
        report("pose and frame, random", *random_times(deformer, randoms, camera), kind=kind)
        firsts = warpcage.Deformer(field, rest, coordinates=kind, resolution=args.resolution)
        taken = [pose_and_frame(firsts, cage, camera) for cage in randoms[:10]]
        report("the first ten, the longest", max(taken), kind=kind, each=[round(1e3 * t, 2) for t in taken])
        cycle = Cycle(deformer, poses)
        report("pose", median_seconds(cycle.pose, device, runs=args.runs), kind=kind)
        seconds = median_seconds(lambda c=cycle: c.pose().render(camera), device, runs=args.runs)
        report("pose and frame", seconds, kind=kind)
        if device.is_cuda:
            seconds = posing_loop(deformer, rest, camera, args)
            report("posing in a loop", seconds, kind=kind, frames_a_second=round(1 / seconds, 1))
    slabs = three_slabs(rest)
    turned = [slab.rotate(12, axis="x") for slab in slabs]
    options = {"coordinates": "mean_value", "resolution": args.resolution}
    one = warpcage.Deformer(field, slabs[1], **options).pose(turned[1])
    three = warpcage.Deformer(field, slabs, **options).pose(turned)
    alone, together = frame_seconds(one.render, three.render)
    report("frame, one slab, lattices ready", alone, kind="mean_value")
    report("frame, three slabs, lattices ready", together, kind="mean_value", times_one=round(together / alone, 3))
    peak = wp.get_mempool_used_mem_high(device) if device.is_cuda else None
    print({"peak_device_bytes": peak})
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


def random_poses(rest, count: int, seed: int) -> list:
    """Cages moved by three waves each, of random directions, lengths above 1.4 times their size, and phases: those that
    times have been taken with from the start, milder than `RandomPoses`."""
    random = np.random.default_rng(seed)
    center, size = rest.vertices.mean(axis=0), float(np.ptp(rest.bounds, axis=0).max())
    places = (rest.vertices - center) / size
    poses = []
    for _ in range(count):
        moved = places.copy()
        for _ in range(3):
            wave = random.normal(size=3)
            wave *= random.uniform(0.2, 0.7) / np.linalg.norm(wave)
            phase = random.uniform(0, 2 * np.pi)
            moved += 0.05 * random.normal(size=3) * np.sin(2 * np.pi * places @ wave + phase)[:, None]
        poses.append(rest.with_vertices(center + size * moved))
    return poses


def pose_and_frame(deformer, cage, camera) -> float:
    """Seconds of a new pose and its frame, with the device idle before and after."""
    return seconds_of(lambda: deformer.pose(cage).render(camera), deformer.device)


def random_times(deformer, cages, camera):
    """Median seconds of random poses and their frames, and their other statistics."""
    for cage in cages[:3]:
        deformer.pose(cage).render(camera)
    taken = [pose_and_frame(deformer, cage, camera) for cage in cages]
    return float(np.median(taken)), [("percentile_95", float(np.percentile(taken, 95))), ("longest", max(taken))]


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
    return seconds_of(lambda: [deformer.pose(cage).render(camera) for cage in cages], deformer.device) / count


# Many views by one call


@command(
    option("--field", help="field file (default: a ball)"),
    option("--cage", help="cage file, at rest (default: a box around the ball)"),
    DEVICE,
    option("--cameras", type=int, default=64),
    option("--poses", type=int, default=16),
    option("--size", type=int, default=256, help="pixels along each side"),
    option("--kind", choices=KINDS, default="mean_value"),
    option("--resolution", type=int, default=128, help="cells of the lattice"),
    option("--runs", type=int, default=10),
    JSON,
)
def many(args) -> None:
    """Views of many cameras and of many poses by one call, beside a loop of single ones, by turns; and what canonical
    positions, instances and flow add.

        python benchmarks frames many --field lego.npz --cage cage.obj --device cuda:0 --json many.json
        python benchmarks frames many --device cpu --cameras 8 --poses 2 --size 64 --resolution 32 --runs 3

    Loops end where the device is done with the last view, as calls do; those "to the host" copy colours, the loop
    after each view. Arrays of both are compared: `equal` says whether all are the same to the bit.
    """
    device = quiet_device(args.device)
    field = warpcage.VoxelField.load(args.field, device=device) if args.field else ball_field(device)
    rest = warpcage.Cage.load(args.cage) if args.cage else warpcage.Cage.box([-0.9] * 3, [0.9] * 3, segments=2)
    deformer = warpcage.Deformer(field, rest, coordinates=args.kind, resolution=args.resolution)
    deformer.pose(rest.bend(45, axis="y", towards="z"))
    target, radius = field.center, 1.4 * float(np.linalg.norm(np.ptp(field.bounds, axis=0)))
    cameras = warpcage.turntable(target, radius, 25, args.cameras, width=args.size, height=args.size)
    poses, other = random_poses(rest, args.poses, seed=0), rest.twist(30)
    rows = []

    def compare(what, views, loop, call):
        seconds = [np.median(taken) for taken in seconds_by_turns([loop, call], device, runs=args.runs)]
        equal = all(
            np.array_equal(getattr(one, name), getattr(each, name))
            for one, each in zip(call(), loop(), strict=True)
            for name in each.arrays
        )
        report(what, views, seconds[1], loop=seconds[0], times=float(seconds[0] / seconds[1]), equal=equal)

    def report(what, views, seconds, loop=None, **more):
        times = {"milliseconds": seconds, "milliseconds_a_view": seconds / views}
        times |= {} if loop is None else {"loop_milliseconds": loop, "loop_milliseconds_a_view": loop / views}
        rows.append({"what": what, "views": views, **{key: 1e3 * float(each) for key, each in times.items()}, **more})
        print({key: round(each, 4) if isinstance(each, float) else each for key, each in rows[-1].items()}, flush=True)

    def copied(frames):
        for frame in frames:
            assert frame.rgb is not None  # which waits for the view
        return frames

    def all_copied(frames):
        assert frames.rgb is not None
        return frames

    one_by_one = lambda: [deformer.render(camera) for camera in cameras]  # noqa: E731
    compare("cameras", len(cameras), one_by_one, lambda: deformer.render(cameras))
    to_host = lambda: [copied([deformer.render(camera)])[0] for camera in cameras]  # noqa: E731
    compare("cameras, to the host", len(cameras), to_host, lambda: all_copied(deformer.render(cameras)))
    held = lambda: [deformer.posed(pose).render(cameras[0]) for pose in poses]  # noqa: E731
    compare("poses", len(poses), held, lambda: deformer.render_poses(poses, cameras[0]))
    for outputs, aim in (
        (["canonical", "instance"], {}),
        (["flow"], {"flow_camera": cameras[1:] + cameras[:1]}),
        (["canonical", "instance", "flow"], {"flow_pose": other}),
    ):
        call = lambda wanted=outputs, aim=aim: deformer.render(cameras, outputs=wanted, **aim)  # noqa: E731
        label = f"cameras, with {', '.join(outputs)}{' to another pose' if 'flow_pose' in aim else ''}"
        report(label, len(cameras), np.median(seconds_by_turns([call], device, runs=args.runs)[0]))
        if "flow_pose" in aim:
            frames = call()
            seen = np.isfinite(frames.depth)
            rows[-1]["share_with_flow"] = float(np.isfinite(frames.flow[seen]).all(axis=-1).mean())
            print({"share_with_flow": round(rows[-1]["share_with_flow"], 4)})
    write_results(args.json, device, voxels=field.voxel_count, size=args.size, kind=args.kind, rows=rows)


# Slabs


def three_slabs(rest):
    """Boxes beside each other around what a cage holds."""
    lower, upper = np.asarray(rest.bounds) + [[-0.05], [0.05]]
    width = (upper[0] - lower[0]) / 3
    boxes = []
    for i in range(3):
        low, high = lower.copy(), upper.copy()
        low[0], high[0] = lower[0] + i * width + 0.01, lower[0] + (i + 1) * width - 0.01
        boxes.append(warpcage.Cage.box(low, high, segments=2))
    return boxes


# The paper's table


FINEST = 512

#: Samples a ray, and of a quick run; degrees of the bend; distance of the camera, in longest sides of the field.
SAMPLES, FEW_SAMPLES, SWING_BEND, DISTANCE = 512, 128, 40.0, 1.75

#: Part of the picture that the figure shows: left, top, right, bottom, 0 to 1.
CROP = (0.34, 0.32, 0.66, 0.64)

#: Poses of a swing. A GPU runs through all of them before the clock starts, so that graphs have room for each.
SWING = 9

#: Seconds per frame in the paper's Table 1 (one A100).
PAPER = {
    "mean_value": {64: 0.31, 128: 0.98, 256: 5.71, None: 102.0},
    "harmonic": {64: 0.23, 128: 0.90, 256: 6.32},
    "green": {64: 0.35, 128: 2.49, 256: 19.69, None: 243.0},
}

#: The authors' code on an H200 (DESIGN, section 5): seconds of a lattice with a 42-vertex cage, and of a render at
#: 800x800 with 512 samples once the lattice is ready, whose middle of 0.550 to 0.576 is added.
AUTHORS_LATTICE = {
    "mean_value": {64: 0.020, 128: 0.170, 256: 1.390},
    "harmonic": {64: 0.490, 128: 1.240, 256: 1.650},
    "green": {64: 0.100, 128: 0.770, 256: 6.140},
}

AUTHORS_RENDER = 0.563


@command(
    option("--data", help="scene folder to fit; default: the brick model"),
    option("--field", help="a fitted field instead"),
    option("--scene", help="name of the scene that this field shows"),
    option("--cage", help="cage file of 42 vertices; default: one is made around the field"),
    option("--quality", default="fast", help="quality of the fit"),
    DEVICE,
    option("--size", type=int, default=800),
    option("--resolution", type=int, nargs="*", default=[64, 128, 256]),
    option("--runs", type=int, default=2 * SWING),
    JSON,
    option("--figure", help="JPEG file: rows are kinds, columns resolutions and the reference"),
    QUICK,
)
def table1(args) -> None:
    """The paper's Table 1 and Fig. 8: seconds per frame for each kind of coordinates and resolution, and pictures.

        python benchmarks frames table1 --data ../shared/data/lego_800 --cage lego_42.obj --device cuda:0 \\
            --json docs/results/table1.json --figure docs/pictures/table1.jpg
        python benchmarks frames table1 --quick

    A frame is a new pose, never seen before (checks, coordinates, map, marks), and its picture at 800x800 with 512
    samples per ray, as the paper counts it: samples are 1/512 of the longest way through the deformed scene's box
    apart. Times are medians over frames of a swinging bend, on a GPU after one whole swing, with the device idle before
    and after each. "precise" evaluates the closed forms at every sample. PSNR is that of one pose's picture against
    precise; harmonic coordinates have no closed form and are compared with the finest lattice (512 cells). Without
    --data the scene is the brick model; so it is with --quick, which is small and runs on the CPU.
    """
    if args.quick:
        args.device, args.size, args.runs, args.resolution = "cpu", 60, 1, [16, 32]
    device = quiet_device(args.device)
    if args.field:
        field, test_psnr, scene = warpcage.VoxelField.load(args.field, device=device), None, args.scene
    else:
        field, test_psnr, scene = prepared_field(args, device)
    rest = warpcage.Cage.load(args.cage) if args.cage else warpcage.Cage.from_field(field, vertex_count=42)
    distance = DISTANCE * np.ptp(field.bounds, axis=0).max()
    camera = turntable_view(field, args.size, args.size, distance=distance)
    shown = rest.bend(SWING_BEND, axis="y", towards="z").twist(15)
    samples = FEW_SAMPLES if args.quick else SAMPLES
    step = longest_way(field, rest, shown) / samples
    finest = FINEST if not args.quick else 2 * max(args.resolution)
    rows, pictures = [], {}
    for kind in KINDS:
        for resolution in [*args.resolution, finest if kind == "harmonic" else None]:
            deformer = warpcage.Deformer(field, rest, coordinates=kind, resolution=resolution)
            swing = NewPoses(deformer, rest, camera, step)
            seconds = median_seconds(swing, device, runs=args.runs, warm=SWING if device.is_cuda else 2)
            frame = deformer.pose(shown).render(camera, step=step)
            pictures[kind, resolution] = np.clip(frame.rgb, 0, 1)
            rows.append(
                {
                    "kind": kind,
                    "resolution": resolution,
                    "seconds": seconds,
                    "paper_a100": PAPER[kind].get(resolution),
                    "authors_h200": authors_seconds(kind, resolution),
                    "outside_pixels": int((frame.outside > 0).sum()),
                }
            )
            print(rows[-1], flush=True)
    for row in rows:
        reference = pictures[row["kind"], finest if row["kind"] == "harmonic" else None]
        psnr = float(warpcage.psnr(pictures[row["kind"], row["resolution"]], reference))
        row["psnr_to_reference"] = psnr if np.isfinite(psnr) else None
        print(row)
    write_results(
        args.json,
        device,
        scene=scene,
        size=args.size,
        samples=samples,
        step=step,
        cage_vertices=len(rest.vertices),
        cage_faces=len(rest.faces),
        voxels=field.voxel_count,
        field_resolution=list(field.resolution),
        field_psnr=test_psnr,
        harmonic_reference=finest,
        rows=rows,
    )
    if args.figure:
        write_jpeg(args.figure, figure(pictures, args.resolution))


def prepared_field(args, device):
    """The fitted field, its PSNR on test views, and the scene's name."""
    from warpcage.demo import write_brick_scene

    with tempfile.TemporaryDirectory() as folder:
        size = 48 if args.quick else 400
        data = args.data or write_brick_scene(
            folder + "/bricks", train_views=30 if args.quick else 80, size=size, device=device
        )
        field = warpcage.fit(warpcage.load_scene(data), device=device, quality=args.quality, progress=False)
        test = warpcage.load_scene(data, split="test")
        psnr = warpcage.mean_psnr(warpcage.evaluate(field, test))
        return field, psnr, "Lego, 800x800" if args.data else f"bricks, {size}x{size}"


def longest_way(field, rest, deformed) -> float:
    """Diagonal of the box around the field and both cages, world units."""
    corners = np.concatenate([field.bounds, rest.bounds, deformed.bounds])
    return float(np.linalg.norm(np.ptp(corners, axis=0)))


def authors_seconds(kind, resolution):
    lattice = AUTHORS_LATTICE[kind].get(resolution)
    return None if lattice is None else lattice + AUTHORS_RENDER


class NewPoses:
    """Frames of a swinging bend. Each call poses a cage that was not posed before."""

    def __init__(self, deformer, rest, camera, step):
        self.deformer, self.rest, self.camera, self.step, self.turn = deformer, rest, camera, step, 0

    def __call__(self):
        self.turn += 1
        share = 0.6 + 0.4 * np.cos(0.7 * self.turn)
        posed = self.rest.bend(share * SWING_BEND, axis="y", towards="z").twist(15)
        self.deformer.pose(posed).render(self.camera, step=self.step)


def figure(pictures, resolutions) -> np.ndarray:
    """A crop of each picture; the last column is precise, or for harmonic coordinates the finest lattice."""
    from warpcage.view import contact_sheet

    cells = []
    for kind in KINDS:
        last = max((r for k, r in pictures if k == kind and r is not None)) if kind == "harmonic" else None
        for resolution in [*resolutions, last]:
            picture = pictures[kind, resolution]
            h, w = picture.shape[:2]
            left, top, right, bottom = np.multiply(CROP, (w, h, w, h)).astype(int)
            cells.append(picture[top:bottom, left:right])
    return contact_sheet(cells, columns=len(resolutions) + 1)
