"""Frames and new poses of two checkouts by turns: what got slower from one to the other.

Beyond warpcage's public names everything is imported where it is used, so that older checkouts run too.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np
from common import BENCHMARKS, CAGE, FIELD, HERE, JSON, command, option, turntable_view, write_results
from library.frames import Cycle, three_slabs

import warpcage


@command(
    option("--other", help="another checkout"),
    FIELD,
    CAGE,
    option("--size", type=int, default=200, help="pixels along each side"),
    option("--resolution", type=int, default=64, help="cells of the lattice"),
    option("--runs", type=int, default=15),
    option("--most", type=float, default=1.15, help="how many times as long as the other one it may take"),
    JSON,
    option("--worker", action="store_true", help=argparse.SUPPRESS),
)
def main(args) -> int:
    """Frames and poses of two checkouts by turns, on the CPU: CPU time, their ratio, and how alike the pictures are.

        python benchmarks by-turns --other ../older --field bricks.npz --cage bricks_cage.obj
        python benchmarks by-turns --other ../last_release --field bricks.npz --cage bricks_cage.obj \\
            --json docs/results/trend_2026-11-27.json

    Each checkout renders in a process of its own, which waits while the other one works, so that both meet the same
    noise. The ratio is that of the medians; its spread is that of the ratios of successive frames. The exit status is 1
    where this checkout takes more than --most times as long. `pages trends` makes a page of
    several --json.
    """
    if args.worker:
        work(args)
        return 0
    options = ["--field", args.field, "--cage", args.cage, "--size", args.size, "--resolution", args.resolution]
    trees = {"this": HERE.parent, "other": pathlib.Path(args.other)}
    rows, workers = [], {name: started(tree, "by-turns", "--worker", *options) for name, tree in trees.items()}
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
            **{f"{name}_ms": round(1e3 * float(np.median(taken)), 2) for name, taken in seconds.items()},
            "ratio": round(float(np.median(seconds["other"]) / np.median(seconds["this"])), 2),
            "ratios": [round(float(np.percentile(ratios, share)), 2) for share in (25, 75)],
            "psnr": round(float(-10 * np.log10(max(error, 1e-14))), 1),
        }
        rows.append(row)
        print(json.dumps(row), flush=True)
    for worker in workers.values():
        worker.stdin.close()
        worker.wait()
    if args.json:
        names = {"this": revision_of(HERE.parent), "other": revision_of(pathlib.Path(args.other))}
        write_results(args.json, "cpu", date=str(datetime.date.today()), **names, size=args.size, rows=rows)
    slower = [row["what"] for row in rows if row["ratio"] * args.most < 1]
    if slower:
        print(f"takes more than {args.most:g} times as long: {', '.join(slower)}", file=sys.stderr)
    return 1 if slower else 0


def revision_of(checkout: pathlib.Path) -> str:
    """The tag of a checkout, or its commit; its folder's name where it is none of git."""
    arguments = ["git", "-C", str(checkout), "describe", "--tags", "--always"]
    return subprocess.run(arguments, capture_output=True, text=True).stdout.strip() or checkout.resolve().name


def started(checkout: pathlib.Path, *arguments) -> subprocess.Popen:
    """A command that answers questions, in a process of its own with the library of a checkout."""
    paths = [str(checkout.resolve()), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    command = [*BENCHMARKS, *map(str, arguments)]
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
    field = warpcage.VoxelField.load(args.field, device="cpu")
    rest = warpcage.Cage.load(args.cage)
    camera = turntable_view(field, args.size, args.size)
    bend, slabs = rest.bend(45, axis="y", towards="z"), three_slabs(rest)
    turned = [slab.rotate(12, axis="x") for slab in slabs]

    def deformed(rests, poses, kind):
        deformer = warpcage.Deformer(field, rests, coordinates=kind, resolution=args.resolution).pose(poses)
        return lambda: deformer.render(camera)

    def posed(kind):
        deformer = warpcage.Deformer(field, rest, coordinates=kind, resolution=args.resolution).pose(bend)
        cycle = Cycle(deformer, [rest.bend(40, axis="y", towards="z"), bend])
        return lambda: cycle.pose().render(camera)

    frames = {
        "canonical": lambda: field.render(camera),
        **{kind: deformed(rest, bend, kind) for kind in ("harmonic", "mean_value", "green")},
        **{f"{kind},-new-pose": posed(kind) for kind in ("harmonic", "mean_value", "green")},
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
