"""Frames of two checkouts by turns, on the CPU: CPU time of each, their ratio, and how alike the pictures are.

    python benchmarks/frames_by_turns.py --other ../older --field bricks.npz --cage bricks_cage.obj

Each checkout renders in a process of its own, which waits while the other one works, so that both meet the same noise.
The ratio is that of the medians; its spread is that of the ratios of successive frames.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import time

import numpy as np

HERE = pathlib.Path(__file__).resolve().parents[1]


def main() -> None:
    args = parse_arguments()
    if args.worker:
        work(args)
        return
    workers = {"this": started(HERE, args), "other": started(pathlib.Path(args.other).resolve(), args)}
    for what in ask(workers["this"], "list"):
        pictures = {name: ask(worker, f"show {what}") for name, worker in workers.items()}
        seconds = {name: [] for name in workers}
        for _ in range(args.runs):
            for name, worker in workers.items():
                seconds[name].append(ask(worker, f"time {what}"))
        ratios = np.array(seconds["other"]) / np.array(seconds["this"])
        error = np.mean((np.load(pictures["this"]) - np.load(pictures["other"])) ** 2)
        row = {
            "what": what,
            **{f"{name}_ms": round(1e3 * float(np.median(times)), 2) for name, times in seconds.items()},
            "ratio": round(float(np.median(seconds["other"]) / np.median(seconds["this"])), 2),
            "ratios": [round(float(np.percentile(ratios, share)), 2) for share in (25, 75)],
            "psnr": round(float(-10 * np.log10(max(error, 1e-14))), 1),
        }
        print(json.dumps(row), flush=True)
    for worker in workers.values():
        worker.stdin.close()
        worker.wait()


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--other", help="another checkout")
    parser.add_argument("--field", required=True)
    parser.add_argument("--cage", required=True)
    parser.add_argument("--size", type=int, default=200, help="pixels along each side")
    parser.add_argument("--resolution", type=int, default=64, help="cells of the lattice")
    parser.add_argument("--runs", type=int, default=15)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def started(checkout: pathlib.Path, args):
    """A process that renders with a checkout."""
    options = ["--field", args.field, "--cage", args.cage, "--size", str(args.size)]
    command = [sys.executable, __file__, "--worker", *options, "--resolution", str(args.resolution)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(checkout), os.environ.get("PYTHONPATH", "")])}
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)


def ask(worker, question: str):
    """Ask a process and wait for its answer."""
    worker.stdin.write(question + "\n")
    worker.stdin.flush()
    while not (line := worker.stdout.readline()).startswith("answer "):
        if not line:
            raise RuntimeError("a process has ended early")
    return json.loads(line.removeprefix("answer "))


def work(args) -> None:
    """Answer questions until there are no more."""
    import tempfile

    import warp as wp

    import warpcage

    wp.config.quiet = True
    field = warpcage.VoxelField.load(args.field, device="cpu")
    rest = warpcage.Cage.load(args.cage)
    camera = warpcage.turntable(
        field.center, 4.03, 30, 1, fov_degrees=39.6, width=args.size, height=args.size, start_degrees=30
    )[0]
    bend, slabs = rest.bend(45, axis="y", towards="z"), three_slabs(rest)
    turned = [slab.rotate(12, axis="x") for slab in slabs]

    def deformed(rests, poses, kind):
        deformer = warpcage.Deformer(field, rests, coordinates=kind, resolution=args.resolution).pose(poses)
        return lambda: deformer.render(camera)

    frames = {
        "canonical": lambda: field.render(camera),
        **{kind: deformed(rest, bend, kind) for kind in ("harmonic", "mean_value", "green")},
        "one-slab": deformed(slabs[1], turned[1], "mean_value"),
        "three-slabs": deformed(slabs, turned, "mean_value"),
    }
    with tempfile.TemporaryDirectory() as folder:
        for line in sys.stdin:
            question, _, what = line.strip().partition(" ")
            if question == "list":
                answer = list(frames)
            elif question == "show":
                answer = os.path.join(folder, f"{what}.npy")
                np.save(answer, frames[what]().rgb.astype(np.float64))
            else:
                begin = time.process_time()
                frames[what]()
                answer = time.process_time() - begin
            print("answer " + json.dumps(answer), flush=True)


def three_slabs(rest):
    """Boxes beside each other around what a cage holds."""
    import warpcage

    lower, upper = np.asarray(rest.bounds) + [[-0.05], [0.05]]
    width = (upper[0] - lower[0]) / 3
    boxes = []
    for i in range(3):
        low, high = lower.copy(), upper.copy()
        low[0], high[0] = lower[0] + i * width + 0.01, lower[0] + (i + 1) * width - 0.01
        boxes.append(warpcage.Cage.box(low, high, segments=2))
    return boxes


if __name__ == "__main__":
    main()
