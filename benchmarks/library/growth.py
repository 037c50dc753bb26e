"""How time and memory grow: fits with pictures, pixels and splats; frames with pixels, splats and edits."""

from __future__ import annotations

import itertools
import json
import pathlib

import numpy as np
import warp as wp
from common import (
    DEVICE,
    JSON,
    QUICK,
    ball_field,
    command,
    median_seconds,
    option,
    quiet_device,
    seconds_of,
    turntable_view,
    write_results,
)

import warpcage

#: Values along each axis, and those of a quick run.
PICTURES, FEW_PICTURES = (25, 50, 100, 200, 400), (4, 8)
FIT_SIDES, FEW_FIT_SIDES = (100, 200, 400, 800), (16, 32)
SPLATS, FEW_SPLATS = (50_000, 200_000, 1_000_000, 4_000_000), (200, 800)
FRAME_SIDES, FEW_FRAME_SIDES = (200, 400, 800, 1600, 3200), (16, 32)
EDITS, FEW_EDITS = (1, 2, 4, 8), (1, 2)

#: Pictures and pixels along a side where another number grows, and those of a quick run.
USUAL, FEW = (100, 400), (6, 24)


@command(
    option("--field", help="field file, of which the pictures are rendered (default: a ball)"),
    DEVICE,
    option("--runs", type=int, default=20, help="frames that a median is of"),
    option("--only", nargs="+", help="names of what is measured (default: all)"),
    QUICK,
    JSON,
)
def measure(args) -> None:
    """Seconds and device memory against what is given.

        python benchmarks growth measure --field lego.npz --device cuda:0 --json docs/results/growth.json

    Scenes are rendered from the field, from all sides, so that there are as many pictures as are asked for. Fits have
    quality "fast" otherwise; memory is the most that Warp's arrays were seen to hold at a report of progress, without
    what was held before. Frames are medians with the pose ready, poses include their frame and are new each time.
    """
    device = quiet_device(args.device)
    field = warpcage.VoxelField.load(args.field, device=device) if args.field else ball_field(device)
    count, side = FEW if args.quick else USUAL
    pictures, fit_sides, splats, frame_sides, edits = (
        (FEW_PICTURES, FEW_FIT_SIDES, FEW_SPLATS, FEW_FRAME_SIDES, FEW_EDITS)
        if args.quick
        else (PICTURES, FIT_SIDES, SPLATS, FRAME_SIDES, EDITS)
    )
    lattice = {"resolution": 24} if args.quick else {}
    sweeps = {
        "voxel-fit-pictures": (pictures, lambda n: fit_cost(scene_of(field, n, side), device)),
        "voxel-fit-pixels-a-side": (fit_sides, lambda n: fit_cost(scene_of(field, count, n), device)),
        "splat-fit-pictures": (pictures, lambda n: fit_cost(scene_of(field, n, side), device, representation="splats")),
        "splat-fit-pixels-a-side": (
            fit_sides,
            lambda n: fit_cost(scene_of(field, count, n), device, representation="splats"),
        ),
        "splat-fit-splats": (splats, lambda n: splat_fit_cost(field, n, count, side)),
        "frame-pixels-a-side": (frame_sides, lambda n: frame_cost(field, n, args.runs)),
        "frame-of-splats-splats": (splats, lambda n: splat_frame_cost(field, n, side, args.runs)),
        "frame-edits": (edits, lambda n: edits_cost(field, n, 2 * side, args.runs, **lattice)),
    }
    rows = []
    for name, (values, cost) in sweeps.items():
        if args.only and name not in args.only:
            continue
        cost(values[0])  # compiles
        for value in values:
            rows.append({"what": name, "value": value, **cost(value)})
            print(rows[-1], flush=True)
        for figure, slope in slopes([row for row in rows if row["what"] == name]).items():
            print(f"{name}: {figure} grows by the power {slope:.2f}", flush=True)
        # after each, so that a run that is cut short keeps what it has
        write_results(args.json, device, voxels=field.voxel_count, pictures=count, pixels=side, rows=rows)


@command(
    option("json", type=pathlib.Path, nargs="+", help="what `growth measure` wrote, in one run or several"),
    option("figure", type=pathlib.Path, help="SVG file"),
)
def figure(args) -> None:
    """The plot of it: log-log, a line a figure, its slope in the legend.

    python benchmarks growth figure docs/results/growth*.json docs/pictures/growth.svg
    """
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "growth"  # the same file each time
    from matplotlib import pyplot, ticker

    rows = [row for path in args.json for row in json.loads(path.read_text(encoding="utf-8"))["rows"]]
    sweeps = {name: list(group) for name, group in itertools.groupby(rows, key=lambda row: row["what"])}
    columns = 4
    shape = -(-len(sweeps) // columns), columns
    made, axes = pyplot.subplots(*shape, figsize=(3.2 * columns, 2.8 * shape[0]), layout="constrained", squeeze=False)
    for axis in axes.flat[len(sweeps) :]:
        axis.set_axis_off()
    for (name, group), axis in zip(sweeps.items(), axes.flat, strict=False):
        for what, slope in slopes(group).items():
            points = [(row["value"], row[what]) for row in group if row.get(what)]
            axis.loglog(*zip(*points, strict=True), marker="o", markersize=3, label=f"{what}: {slope:.2f}")
        axis.set_title(name.replace("-", " "), fontsize=9)
        values = sorted({row["value"] for row in group})
        axis.set_xticks(values, [f"{value:,}" for value in values])
        axis.set_xticks([], minor=True)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter(ticker.LogFormatter(minor_thresholds=(1, 0.5)))
        axis.tick_params(labelsize=7, which="both")
        axis.legend(fontsize=7)
    args.figure.parent.mkdir(parents=True, exist_ok=True)
    made.savefig(args.figure, metadata={"Date": None})


def slopes(rows: list[dict]) -> dict[str, float]:
    """The power of the value by which each figure of rows grows: the slope of a line through its logarithms."""
    found = {}
    for name in rows[0]:
        points = [(row["value"], row[name]) for row in rows if name not in ("what", "value") and row.get(name)]
        if len(points) > 1:
            found[name] = float(np.polyfit(*np.log(points).T, 1)[0])
    return found


# Fits


def scene_of(field, count: int, side: int) -> warpcage.Scene:
    """A scene of pictures of a field from all sides, evenly (a golden spiral)."""
    view = turntable_view(field, side, side)
    radius = float(np.linalg.norm(view.camera_to_world[:3, 3] - field.center))
    heights = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turns = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    across = np.sqrt(1.0 - heights**2)
    directions = np.stack([across * np.cos(turns), across * np.sin(turns), heights], axis=1)
    cameras = [
        warpcage.Camera.look_at(
            field.center + radius * direction, field.center, fov_degrees=39.6, width=side, height=side
        )
        for direction in directions
    ]
    frames = [field.render(camera, background="white") for camera in cameras]
    images, alphas = (np.stack([getattr(frame, name) for frame in frames]) for name in ("rgb", "alpha"))
    return warpcage.Scene(images, alphas, cameras, bounds=field.bounds)


def fit_cost(scene, device, **options) -> dict:
    """Seconds and gigabytes of a fit, and millions of voxels or splats that came of it."""
    before = held(device)
    most = [before]
    made = []

    def watch(done, total, message) -> None:
        most.append(held(device))

    seconds = seconds_of(
        lambda: made.append(warpcage.fit(scene, quality="fast", device=device, progress=watch, **options)), device
    )
    return {"seconds": seconds, "gigabytes": (max(most) - before) / 1e9, "millions": field_length(made[0]) / 1e6}


def held(device) -> int:
    """Bytes that Warp's arrays hold on a GPU now; 0 on a CPU, which counts none."""
    return int(wp.get_mempool_used_mem_current(device)) if device.is_cuda else 0


def field_length(field) -> int:
    return field.voxel_count if isinstance(field, warpcage.VoxelField) else len(field)


def splat_fit_cost(field, most: int, count: int, side: int) -> dict:
    """Costs of a fit with so many splats at its end, whatever the pictures would allow."""
    return fit_cost(
        scene_of(field, count, side), field.device, representation="splats", most_splats=most, pixels_per_splat=0.1
    )


# Frames


def bent(field) -> tuple[warpcage.Cage, warpcage.Cage]:
    rest = warpcage.Cage.box(*field.bounds, segments=4)
    return rest, rest.bend(30.0, axis="y", towards="z")


def frame_cost(field, side: int, runs: int) -> dict:
    """Milliseconds of a canonical frame and of a bent one, each with its map ready."""
    camera = turntable_view(field, side, side)
    rest, posed = bent(field)
    deformer = warpcage.Deformer(field, rest, coordinates="mean_value").pose(posed)
    renders = {"canonical": field.render, "bent": deformer.render}
    return {name: milliseconds(lambda call=call: call(camera), field, runs) for name, call in renders.items()}


def milliseconds(action, field, runs: int) -> float:
    return 1e3 * median_seconds(action, field.device, runs=runs)


def splat_frame_cost(field, most: int, side: int, runs: int) -> dict:
    """Milliseconds of a frame of so many splats: those of the field, repeated beside each other where it has fewer."""
    splats = warpcage.to_splats(field, most=most)
    rows = np.resize(np.arange(len(splats)), most)
    scattered = np.random.default_rng(0).normal(size=(most, 3)) * splats.scales[rows]
    cloud = warpcage.SplatField.from_arrays(
        splats.centers[rows] + scattered,
        splats.scales[rows] * (len(splats) / most) ** (1 / 3),
        splats.rotations[rows],
        splats.opacities[rows],
        harmonics=splats.contents.harmonics[rows],
        device=field.device,
    )
    camera = turntable_view(field, 2 * side, 2 * side)
    return {"canonical": milliseconds(lambda: cloud.render(camera), field, runs)}


def edits_cost(field, count: int, side: int, runs: int, **lattice) -> dict:
    """Milliseconds of frames and of new poses with frames of boxes beside each other, each turned."""
    lower, upper = np.asarray(field.bounds, dtype=np.float64)
    edges = np.linspace(lower[0], upper[0], count + 1)
    gap = 0.02 * (upper[0] - lower[0]) / count
    boxes = [
        warpcage.Cage.box([low + gap, *lower[1:]], [high - gap, *upper[1:]], segments=2)
        for low, high in itertools.pairwise(edges)
    ]
    camera = turntable_view(field, side, side)
    deformer = warpcage.Deformer(field, boxes, coordinates="mean_value", **lattice)
    poses = itertools.cycle([[box.rotate(turn, axis="x") for box in boxes] for turn in (12.0, 10.0)])
    return {
        "pose and frame": milliseconds(lambda: deformer.pose(next(poses)).render(camera), field, runs),
        "bent": milliseconds(lambda: deformer.render(camera), field, runs),
    }
