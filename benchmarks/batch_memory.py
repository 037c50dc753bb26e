"""Memory of the driver and of two workers of `warpcage run` over a run of many frames, each with a pose of its own.

    python benchmarks/batch_memory.py --json docs/results/batch_memory.json

The exit status is 1 where one of them holds GROWTH megabytes more at the end than when a fifth of the items was made:
until then caches and pools fill.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import sys
import tempfile

import numpy as np
from results import write_results
from soak import GROWTH, ball_field

import warpcage
from warpcage.batch import ray_engine
from warpcage.batch.job_file import write_jobs
from warpcage.batch.ray_engine import RayEngine

#: Times that memory is looked at, and the share of the items that is made before it counts.
SAMPLES, WARM = 60, 0.2

PAGE = os.sysconf("SC_PAGE_SIZE") / 2**20

CAMERA = {"eye": [3, 2, 1.5], "target": [0, 0, 0], "width": 32, "height": 32}


class Seen(RayEngine):
    """The engine, which tells the processes of its workers."""

    newest: Seen

    def __init__(self, *given):
        super().__init__(*given)
        Seen.newest = self


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--items", type=int, default=5000)
    parser.add_argument("--json")
    args = parser.parse_args()
    curves: dict[str, list] = {"items": [], "driver": [], "worker 0": [], "worker 1": []}
    marks = {int(mark) for mark in np.linspace(0, args.items, SAMPLES + 1)[1:]}

    def look(state: warpcage.batch.RunProgress) -> None:
        passed = {mark for mark in marks if mark <= state.done}
        if state.stage == "make" and passed and len(Seen.newest.places) == 2:
            marks.difference_update(passed)
            curves["items"].append(state.done)
            curves["driver"].append(resident(os.getpid()))
            for name in ("0", "1"):
                curves[f"worker {name}"].append(resident(Seen.newest.places[name]["pid"]))

    ray_engine.RayEngine = Seen
    with tempfile.TemporaryDirectory() as temporary:
        path = write_job(pathlib.Path(temporary), args.items)
        report = warpcage.run_jobs(path, pathlib.Path(temporary, "out"), workers=2, device="cpu", progress=look)
    assert report.complete, report
    warm = next(k for k, done in enumerate(curves["items"]) if done >= WARM * args.items)
    grown = {name: values[-1] - values[warm] for name, values in curves.items() if name != "items"}
    for name, growth in grown.items():
        print(f"{name}: {curves[name][warm]:.0f} to {curves[name][-1]:.0f} MB, {growth:+.1f}")
    if args.json:
        write_results(args.json, "cpu", seconds=report.seconds, megabytes=curves, grown=grown, limit_megabytes=GROWTH)
    return 1 if max(grown.values()) > GROWTH else 0


def write_job(folder: pathlib.Path, count: int) -> pathlib.Path:
    """Frames of a field under two cages, by harmonic and by mean value coordinates, a pose each."""
    ball_field("cpu").save(folder / "ball.npz")
    for name, segments in (("coarse", 1), ("fine", 2)):
        cage = warpcage.Cage.box((-1, -1, -1), (1, 1, 1), segments=segments)
        cage.save(folder / f"{name}.obj")
        turns = 60.0 * np.sin(np.arange(count // 2 + 1))
        np.save(folder / f"{name}.npy", np.stack([cage.twist(float(turn)).vertices for turn in turns]))
    words = [{"cage": "coarse.obj", "coordinates": "harmonic"}, {"cage": "fine.obj", "coordinates": "mean_value"}]
    items = [
        {"id": f"f{k:06d}", "posed": f"{words[k % 2]['cage'][:-4]}.npy#{k // 2}"} | words[k % 2] for k in range(count)
    ]
    write_jobs(folder / "jobs.jsonl", items, defaults={"field": "ball.npz", "camera": CAMERA, "resolution": 12})
    return folder / "jobs.jsonl"


def resident(pid: int) -> float:
    """Megabytes that a process holds in memory; not a number where it is gone."""
    try:
        with open(f"/proc/{pid}/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * PAGE
    except FileNotFoundError:
        return float("nan")


if __name__ == "__main__":
    sys.exit(main())
