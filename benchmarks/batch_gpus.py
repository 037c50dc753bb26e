"""How much faster two workers of `warpcage run` are than one: frames, each of a pose of its own, and fits.

    python benchmarks/batch_gpus.py --field lego.npz --cage lego_42.obj --scene ../shared/data/lego_800 --json gpus.json

Frames are written as PNG, and once more as arrays of opacity, which nothing encodes: what encoding holds back is the
difference. Of the `seconds` of a run some go to the start of Ray and its workers: `rate`, items a second, counts from
when the first item was begun until the last one was made, with what loading takes, and `steady`, of many items, from
when a tenth was made until nine tenths were. `ratio` and `steady_ratio` compare them with those of the first number of
workers. `gpu_busy` is the share of the time of `rate` in which a GPU had something to do, as nvidia-smi sees it: the
rest is the host's.
"""

from __future__ import annotations

import argparse
import datetime
import json
import pathlib
import shutil
import subprocess
import tempfile
import threading
import time

import numpy as np
from results import write_results

import warpcage
from warpcage.batch.job_file import write_jobs

#: Seconds between two looks at the GPUs.
LOOK = 0.5

#: Of so many items a steady rate is told.
MANY = 100

#: What frames are written as.
OUTPUTS = {"png": {"rgb": "{id}.png"}, "arrays": {"alpha": "{id}.npy"}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", required=True)
    parser.add_argument("--cage", required=True)
    parser.add_argument("--scene", help="scene folder of the fits; without it there are none")
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--poses", type=pathlib.Path, help="poses drawn before, (n, vertices, 3) in a .npy file")
    parser.add_argument("--size", type=int, default=800, help="of the frames, pixels")
    parser.add_argument("--fits", type=int, default=12)
    parser.add_argument("--quality", default="fast")
    parser.add_argument("--downscale", type=int, default=1, help="of the pictures that are fitted")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--device", choices=["cpu", "cuda"], help="default: GPUs where there are any")
    parser.add_argument("--json", help="file for the results")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        jobs = {f"frames, {kind}": frame_job(folder, args, kind) for kind in OUTPUTS}
        if args.scene:
            jobs["fits"] = fit_job(folder, args)
        for what, path in jobs.items():
            first = None
            for workers in args.workers:
                row = {"what": what, "workers": workers} | timed(path, folder / "out", workers, args.device)
                first = first or row
                row["ratio"] = row["rate"] / first["rate"]
                if "steady" in row:
                    row["steady_ratio"] = row["steady"] / first["steady"]
                print(row, flush=True)
                rows.append(row)
    if args.json:
        write_results(args.json, args.device or "cuda:0", rows=rows)


def frame_job(folder: pathlib.Path, args: argparse.Namespace, kind: str) -> pathlib.Path:
    """Frames of random poses, each its own, from one camera."""
    rest = warpcage.Cage.load(args.cage)
    poses = folder / "poses.npy"
    if not poses.exists():
        np.save(poses, drawn_poses(rest, args.frames) if args.poses is None else np.load(args.poses)[: args.frames])
    centre, size = rest.bounds.mean(axis=0), float(np.ptp(rest.bounds, axis=0).max())
    eye = (centre + size * np.array([1.6, -1.2, 0.9])).tolist()
    camera = {"eye": eye, "target": centre.tolist(), "width": args.size, "height": args.size}
    usual = {"field": str(pathlib.Path(args.field).resolve()), "cage": str(pathlib.Path(args.cage).resolve())}
    items = ({"id": f"frame_{number:05d}", "posed": f"poses.npy#{number}"} for number in range(args.frames))
    defaults = usual | {"camera": camera, "background": "white", "outputs": OUTPUTS[kind]}
    write_jobs(folder / f"frames_{kind}.jsonl", items, defaults=defaults)
    return folder / f"frames_{kind}.jsonl"


def drawn_poses(rest: warpcage.Cage, count: int) -> np.ndarray:
    """(count, vertices, 3) random poses of a cage, some 40 ms each."""
    source = warpcage.RandomPoses(rest, seed=0)
    return np.stack([source.pose(number).vertices for number in range(count)])


def fit_job(folder: pathlib.Path, args: argparse.Namespace) -> pathlib.Path:
    """Fits of one scene by several seeds."""
    usual = {"kind": "fit", "scene": str(pathlib.Path(args.scene).resolve()), "downscale": args.downscale}
    items = ({"id": f"fit_{k:02d}", "options": {"quality": args.quality, "seed": k}} for k in range(args.fits))
    write_jobs(folder / "fits.jsonl", items, defaults=usual)
    return folder / "fits.jsonl"


def timed(path: pathlib.Path, out: pathlib.Path, workers: int, device: str | None) -> dict:
    """Run a job into a new folder; what it took."""
    shutil.rmtree(out, ignore_errors=True)
    with Busy() as busy:
        report = warpcage.run_jobs(path, out, workers=workers, device=device)
    assert report.complete, report
    with open(out / "manifest.jsonl", encoding="utf-8") as manifest:
        records = [json.loads(line) for line in manifest]
    ends = [datetime.datetime.fromisoformat(record["finished"]).timestamp() for record in records]
    begin = min(end - record["seconds"] for end, record in zip(ends, records, strict=True))
    ends.sort()
    low, high = len(ends) // 10, len(ends) - 1 - len(ends) // 10
    steady = {"steady": (high - low) / (ends[high] - ends[low])} if len(ends) >= MANY else {}
    return {
        "items": report.total,
        "seconds": report.seconds,
        "rate": report.total / (ends[-1] - begin),
        **steady,
        "gpu_busy": busy.share(begin, ends[-1]),
    }


class Busy:
    """Looks at how busy the GPUs are, while it is entered."""

    def __init__(self):
        self._looks: list[tuple[float, list[float]]] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> Busy:
        if shutil.which("nvidia-smi"):
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()

    def share(self, begin: float, end: float) -> list[float] | None:
        """Of each GPU, between two times (seconds since 1970); None where nobody looked."""
        looks = [shares for at, shares in self._looks if begin <= at <= end]
        return np.mean(looks, axis=0).round(3).tolist() if looks else None

    def _look(self) -> None:
        words = ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits"]
        while not self._end.wait(LOOK):
            seen = subprocess.run(words, capture_output=True, text=True)
            if seen.returncode == 0:
                self._looks.append((time.time(), [float(line) / 100 for line in seen.stdout.split()]))


if __name__ == "__main__":
    main()
