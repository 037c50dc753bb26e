"""What handing out items costs by itself: workers that wait instead of rendering, by one and by several of them.

    python benchmarks/batch_handing_out.py --json handing_out.json

A worker loads for `--load` seconds, is then at each item for `--make` seconds, and files are there `--write` seconds
later, from up to 16 threads. All items name one large file, which is hashed as a field is. So one worker and two differ
by what `warpcage run` itself does: lots and their ends, hashes, notes, messages. The defaults are what frames of Lego
at 800x800 took on an H200. Figures as in `batch_gpus.py`; `over_ideal` is what a run takes of what its items take,
loading once included.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import pathlib
import shutil
import statistics
import tempfile
import time

from batch_gpus import course_of
from results import write_results

from warpcage.batch.job_file import write_jobs
from warpcage.batch.run import Options, _run

#: Threads of a worker that write.
THREADS = 16


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--items", type=int, default=2000)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--turns", type=int, default=3, help="how often all is timed, by turns; medians are told")
    parser.add_argument("--load", type=float, default=0.45)
    parser.add_argument("--make", type=float, default=0.0066)
    parser.add_argument("--write", type=float, default=0.03)
    parser.add_argument("--megabytes", type=float, default=361.0, help="of the file that all items name")
    parser.add_argument("--json", help="file for the results")
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        path = waiting_job(pathlib.Path(temporary), args)
        for turn in range(args.turns):
            for workers in args.workers:
                row = {"workers": workers, "turn": turn} | timed(path, workers, args)
                print(row, flush=True)
                rows.append(row)
    medians = [median_row([row for row in rows if row["workers"] == workers]) for workers in args.workers]
    for row in medians:
        row["ratio"], row["steady_ratio"] = (round(row[name] / medians[0][name], 3) for name in ("rate", "steady"))
        print(row, flush=True)
    if args.json:
        write_results(
            args.json,
            "cpu",
            options={name: value for name, value in vars(args).items() if name != "json"},
            median=medians,
            rows=rows,
        )


def median_row(rows: list[dict]) -> dict:
    """The medians of what is one number."""
    names = [name for name, value in rows[0].items() if isinstance(value, float)]
    return {"workers": rows[0]["workers"]} | {name: statistics.median(row[name] for row in rows) for name in names}


def waiting_job(folder: pathlib.Path, args: argparse.Namespace) -> pathlib.Path:
    """Items that name a large file. It holds nothing: nobody but the hash reads it."""
    with open(folder / "field.npz", "wb") as file:
        file.truncate(int(args.megabytes * 2**20))
    (folder / "cage.obj").write_text("v 0 0 0\n")
    camera = {"eye": [2, 2, 2], "target": [0, 0, 0], "width": 800, "height": 800}
    waits = {"load": args.load, "make": args.make, "write": args.write}
    (folder / "waits").write_text(" ".join(map(str, waits.values())))
    usual = {"field": "field.npz", "cage": "cage.obj", "posed": "cage.obj", "camera": camera}
    items = ({"id": f"item_{number:05d}"} for number in range(args.items))
    write_jobs(folder / "jobs.jsonl", items, defaults=usual | {"outputs": {"rgb": "{id}.png"}})
    return folder / "jobs.jsonl"


def timed(path: pathlib.Path, workers: int, args: argparse.Namespace) -> dict:
    """Run a job into a new folder."""
    out = path.parent / "out"
    shutil.rmtree(out, ignore_errors=True)
    called = time.time()
    _run(path, out, Options(workers, device="cpu"), lambda state: None, print, Waiting)
    begin, course = course_of(out / "manifest.jsonl")
    ideal = args.load + args.items * args.make / workers + args.write
    return {"until_first": begin - called, **course, "over_ideal": course["items"] / course["rate"] / ideal}


class Waiting:
    """Makes items by waiting, as `batch.worker.Worker` would make frames."""

    def __init__(self, base: str, out: str, device: object):
        self._out = pathlib.Path(out)
        self._load, self._make, self._write_seconds = map(float, pathlib.Path(base, "waits").read_text().split())
        self._pool = concurrent.futures.ThreadPoolExecutor(THREADS)

    def submit(self, item, out=None):
        """Wait, and let a thread write."""
        time.sleep(self._load + self._make)
        self._load = 0.0
        return self._pool.submit(self._write, item)

    def _write(self, item) -> dict[str, int]:
        time.sleep(self._write_seconds)
        for path in item.outputs.values():
            (self._out / path).write_text(item.id)
        return {path: len(item.id) for path in item.outputs.values()}

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()


if __name__ == "__main__":
    main()
