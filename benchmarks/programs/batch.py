"""`warpcage run`: how several workers pay, and what handing out items costs."""

from __future__ import annotations

import argparse
import concurrent.futures
import contextlib
import datetime
import functools
import json
import multiprocessing
import os
import pathlib
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time

import numpy as np
from common import BENCHMARKS, CAGE, FIELD, JSON, command, eye_beside, option, write_results

import warpcage
from warpcage.studio.jobs import write_jobs

#: Seconds between two looks at the GPUs.
LOOK = 0.5

#: From so many items on a steady rate is reported.
MANY = 100

#: What frames are written as, and all that is timed.
OUTPUTS = {"png": {"rgb": "{id}.png"}, "arrays": {"alpha": "{id}.npy"}, "records": {"record": "{id}.json"}}
WHAT = [*OUTPUTS, "fits"]

#: Poses that a process draws at once, and threads of a worker that write.
DRAWN_AT_ONCE, THREADS = 25, 16


# Workers


@command(
    FIELD,
    CAGE,
    option("--scene", help="scene folder of the fits; without it there are none"),
    option("--frames", type=int, default=2000),
    option("--poses", type=pathlib.Path, help="poses drawn before, (n, vertices, 3) in a .npy file"),
    option("--size", type=int, default=800, help="of the frames, pixels"),
    option("--fits", type=int, default=12),
    option("--quality", default="fast"),
    option("--downscale", type=int, default=1, help="of the pictures that are fitted"),
    option("--workers", type=int, nargs="+", default=[1, 2]),
    option("--device", choices=["cpu", "cuda"], help="default: GPUs where there are any"),
    JSON,
    option("--what", choices=WHAT, nargs="+", default=WHAT, help="what is timed"),
    option("--turns", type=int, default=1, help="how often all is timed, by turns"),
)
def gpus(args) -> None:
    """How much faster two workers of `warpcage run` are than one: frames, each of a pose of its own, and fits.

        python benchmarks batch gpus --field lego.npz --cage lego_42.obj --scene data/lego_800 --json gpus.json

    Frames are written as PNG; once more as arrays of opacity, which nothing encodes and which are eight times as large;
    and once more as records of a kilobyte, for which no picture leaves the GPU. What encoding and writing hold back are
    the differences. A few items are made first by each, so that no kernel is compiled in what is timed. Of each run:

    - `seconds`, all of the command, with the start of Python, the plan, the start of processes and their end;
    - `until_first`, of these until the first item was begun;
    - `rate`, items a second from then until the last one was made, with what loading takes;
    - `steady`, of many items, from when a tenth was made until nine tenths were;
    - `first_item`, seconds of the first item of each worker, with what it loads, and `item`, the median;
    - `begin_spread` and `end_spread`, seconds between the first items of the workers, and between the last;
    - `gpu_busy`, the share of the time of `rate` in which a GPU had something to do, as nvidia-smi sees it: the rest is
      the host's.

    `ratio`, `steady_ratio` and `seconds_ratio` compare `rate`, `steady` and `seconds` with those of the first number of
    workers in the same turn; `median` has them over all turns. `start` are the seconds of each step before the first
    frame, one after the other (`batch-start`).
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        for part in ("few", "all"):
            (folder / part).mkdir()
        few = argparse.Namespace(**vars(args) | {"frames": 2 * max(args.workers), "fits": 1})
        for path in made_jobs(folder / "few", few).values():
            print(path.stem, "beforehand", timed(path, folder / "out", 1, args.device)["seconds"], "s", flush=True)
        steps = None if args.what == ["fits"] else start_steps(args)
        print("start", steps, flush=True)
        jobs = made_jobs(folder / "all", args)
        rows = [row for turn in range(args.turns) for row in turn_rows(jobs, folder / "out", args, turn)]
    medians = median_rows(rows)
    for row in medians:
        print(row, flush=True)
    if args.json:
        write_results(args.json, args.device or "cuda:0", start=steps, median=medians, rows=rows)


def made_jobs(folder: pathlib.Path, args: argparse.Namespace) -> dict[str, pathlib.Path]:
    """The job files of what is timed, by what they make."""
    jobs = {f"frames, {kind}": frame_job(folder, args, kind) for kind in OUTPUTS if kind in args.what}
    return jobs | ({"fits": fit_job(folder, args)} if args.scene and "fits" in args.what else {})


def turn_rows(jobs: dict[str, pathlib.Path], out: pathlib.Path, args: argparse.Namespace, turn: int) -> list[dict]:
    """Time all jobs by each number of workers."""
    rows = []
    for what, path in jobs.items():
        first = None
        for workers in args.workers:
            row = {"what": what, "workers": workers, "turn": turn} | timed(path, out, workers, args.device)
            first = first or row
            row["ratio"], row["seconds_ratio"] = row["rate"] / first["rate"], first["seconds"] / row["seconds"]
            if "steady" in row:
                row["steady_ratio"] = row["steady"] / first["steady"]
            print(row, flush=True)
            rows.append(row)
    return rows


def median_rows(rows: list[dict], digits: int | None = 3) -> list[dict]:
    """The medians over all turns of what is one number."""
    found = []
    for what, workers in dict.fromkeys((row["what"], row["workers"]) for row in rows):
        same = [row for row in rows if (row["what"], row["workers"]) == (what, workers)]
        names = [name for name, value in same[0].items() if isinstance(value, float)]
        medians = {name: statistics.median(row[name] for row in same) for name in names}
        medians = medians if digits is None else {name: round(value, digits) for name, value in medians.items()}
        found.append({"what": what, "workers": workers, "turns": len(same)} | medians)
    return found


def start_steps(args: argparse.Namespace) -> dict[str, float]:
    """The seconds of each step before the first frame, in a process of their own."""
    arguments = [*BENCHMARKS, "batch-start", "--field", args.field, "--cage", args.cage, "--size", str(args.size)]
    arguments += ["--workers", str(max(args.workers)), *(["--device", args.device] if args.device else [])]
    done = subprocess.run(arguments, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def frame_job(folder: pathlib.Path, args: argparse.Namespace, kind: str) -> pathlib.Path:
    """Frames of random poses, each its own, from one camera."""
    poses = folder / "poses.npy"
    if not poses.exists():
        given = drawn_poses(args.cage, args.frames) if args.poses is None else np.load(args.poses)[: args.frames]
        np.save(poses, given)
    eye, center = (place.tolist() for place in eye_beside(warpcage.Cage.load(args.cage)))
    camera = {"eye": eye, "target": center, "width": args.size, "height": args.size}
    usual = {"field": str(pathlib.Path(args.field).resolve()), "cage": str(pathlib.Path(args.cage).resolve())}
    items = ({"id": f"frame_{number:05d}", "posed": f"poses.npy#{number}"} for number in range(args.frames))
    defaults = usual | {"camera": camera, "background": "white", "outputs": OUTPUTS[kind]}
    write_jobs(folder / f"frames_{kind}.jsonl", items, defaults=defaults)
    return folder / f"frames_{kind}.jsonl"


def drawn_poses(cage: str, count: int) -> np.ndarray:
    """(count, vertices, 3) random poses of a cage, some 40 ms each: by as many processes as there are cores."""
    parts = [(cage, begin, min(begin + DRAWN_AT_ONCE, count)) for begin in range(0, count, DRAWN_AT_ONCE)]
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(min(len(parts), os.cpu_count() or 1), mp_context=spawn) as pool:
        return np.concatenate(list(pool.map(_poses_of_part, parts)))


def _poses_of_part(part: tuple[str, int, int]) -> np.ndarray:
    cage, begin, end = part
    source = warpcage.RandomPoses(warpcage.Cage.load(cage), seed=0)
    return np.stack([source.pose(number).vertices for number in range(begin, end)])


def fit_job(folder: pathlib.Path, args: argparse.Namespace) -> pathlib.Path:
    """Fits of one scene by several seeds."""
    usual = {"kind": "fit", "scene": str(pathlib.Path(args.scene).resolve()), "downscale": args.downscale}
    items = ({"id": f"fit_{k:02d}", "options": {"quality": args.quality, "seed": k}} for k in range(args.fits))
    write_jobs(folder / "fits.jsonl", items, defaults=usual)
    return folder / "fits.jsonl"


def timed(path: pathlib.Path, out: pathlib.Path, workers: int, device: str | None) -> dict:
    """Run a job into a new folder, in a process of its own; what it took."""
    shutil.rmtree(out, ignore_errors=True)
    called = time.time()
    run = [sys.executable, "-m", "warpcage", "run", str(path), "-o", str(out), "--workers", str(workers), "--quiet"]
    with Busy() as busy:
        subprocess.run([*run, *(["--device", device] if device else [])], stdout=subprocess.DEVNULL, check=True)
    seconds = time.time() - called
    begin, course = course_of(out / "manifest.jsonl")
    end = begin + course["items"] / course["rate"]
    return {"seconds": seconds, "until_first": begin - called, **course, "gpu_busy": busy.share(begin, end)}


def course_of(path: pathlib.Path) -> tuple[float, dict]:
    """When the first item of a run was begun, seconds since 1970, and the figures from there on; path: its manifest."""
    with open(path, encoding="utf-8") as manifest:
        records = [json.loads(line) for line in manifest]
    of_workers: dict[str, list[tuple[float, float]]] = {}  # when each item was made, and how long it took
    for record in records:
        end = datetime.datetime.fromisoformat(record["finished"]).timestamp()
        of_workers.setdefault(record["worker"], []).append((end, record["seconds"]))
    # items that are settled together seem to take nothing: the first of them began first
    firsts = [min(made, key=lambda item: item[0] - item[1]) for made in of_workers.values()]
    lasts = [max(made) for made in of_workers.values()]
    ends = sorted(end for made in of_workers.values() for end, _ in made)
    begins = [end - taken for end, taken in firsts]
    begin = min(begins)
    low, high = len(ends) // 10, len(ends) - 1 - len(ends) // 10
    steady = {"steady": (high - low) / (ends[high] - ends[low])} if len(ends) >= MANY else {}
    return begin, {
        "items": len(records),
        "rate": len(records) / (ends[-1] - begin),
        **steady,
        "first_item": [round(taken, 3) for _, taken in firsts],
        "item": statistics.median(record["seconds"] for record in records),
        "items_of_workers": [len(made) for made in of_workers.values()],
        "begin_spread": max(begins) - begin,
        "end_spread": max(lasts)[0] - min(lasts)[0],
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
        """Of each GPU, between two times (seconds since 1970); None where none was sampled."""
        looks = [shares for at, shares in self._looks if begin <= at <= end]
        return np.mean(looks, axis=0).round(3).tolist() if looks else None

    def _look(self) -> None:
        arguments = ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits"]
        while not self._end.wait(LOOK):
            seen = subprocess.run(arguments, capture_output=True, text=True)
            if seen.returncode == 0:
                self._looks.append((time.time(), [float(line) / 100 for line in seen.stdout.split()]))


# Handing out


@command(
    option("--items", type=int, default=2000),
    option("--workers", type=int, nargs="+", default=[1, 2]),
    option("--turns", type=int, default=3, help="how often all is timed, by turns; medians are reported"),
    option("--load", type=float, default=0.45),
    option("--make", type=float, default=0.0066),
    option("--write", type=float, default=0.03),
    option("--megabytes", type=float, default=361.0, help="of the file that all items name"),
    JSON,
)
def handing_out(args) -> None:
    """What handing out items costs by itself: workers that wait instead of rendering, by one and by several of them.

        python benchmarks batch handing-out --json handing_out.json

    A worker loads for `--load` seconds, is then at each item for `--make` seconds, and files are there `--write`
    seconds later, from up to 16 threads. All items name one large file, which is hashed as a field is. So one worker
    and two differ by what `warpcage run` itself does: chunks and their ends, hashes, notes, messages. The defaults are
    what frames of Lego at 800x800 took on an H200. Figures as of `batch gpus`; `over_ideal` is what a run takes of what
    its items take, loading once included.
    """
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        path = waiting_job(pathlib.Path(temporary), args)
        for turn in range(args.turns):
            for workers in args.workers:
                row = {"what": "items", "workers": workers, "turn": turn} | handed_out(path, workers, args)
                print(row, flush=True)
                rows.append(row)
    medians = median_rows(rows, digits=None)
    for row in medians:
        row["ratio"], row["steady_ratio"] = (round(row[name] / medians[0][name], 3) for name in ("rate", "steady"))
        print(row, flush=True)
    if args.json:
        options = {name: value for name, value in vars(args).items() if name != "json"}
        write_results(args.json, "cpu", options=options, median=medians, rows=rows)


def waiting_job(folder: pathlib.Path, args: argparse.Namespace) -> pathlib.Path:
    """Items that name a large file. It holds nothing: only the hash reads it."""
    with open(folder / "field.npz", "wb") as file:
        file.truncate(int(args.megabytes * 2**20))
    (folder / "cage.obj").write_text("v 0 0 0\n")
    camera = {"eye": [2, 2, 2], "target": [0, 0, 0], "width": 800, "height": 800}
    (folder / "waits").write_text(f"{args.load} {args.make} {args.write}")
    usual = {"field": "field.npz", "cage": "cage.obj", "posed": "cage.obj", "camera": camera}
    items = ({"id": f"item_{number:05d}"} for number in range(args.items))
    write_jobs(folder / "jobs.jsonl", items, defaults=usual | {"outputs": {"rgb": "{id}.png"}})
    return folder / "jobs.jsonl"


def handed_out(path: pathlib.Path, workers: int, args: argparse.Namespace) -> dict:
    """Run a job into a new folder."""
    out = path.parent / "out"
    shutil.rmtree(out, ignore_errors=True)
    called = time.time()
    warpcage.run_jobs(path, out, workers=workers, device="cpu", warn=print, make=Waiting)
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


# Kills

#: Seconds that a run may take after a kill before it counts as one that hangs, and items that a worker may have under
#: way, which are made again.
HANGS, UNDER_WAY = 180.0, 4

#: What is said of a run that hangs.
HUNG = "hangs"

#: A run on a cluster, in a process of its own: a head that is killed may take its driver along.
DRIVER = """
import sys
sys.path.insert(0, sys.argv[1])
from common import pickle_by_value
from programs import batch
pickle_by_value(batch.__name__)
report = batch.counted_run(*sys.argv[2:4], cluster=sys.argv[4])
sys.exit(not report.complete)
"""


@command(
    option("--kills", type=int, default=20, help="of each"),
    option("--what", choices=["raylet", "head"], nargs="+", default=["raylet", "head"], help="what is killed"),
    option("--items", type=int, default=200, help="of each run"),
    option("--make", type=float, default=0.05, help="seconds of an item"),
    option("--seed", type=int, default=0),
    JSON,
)
def kills(args) -> int:
    """kill -9 of Ray's raylets and of its heads while a job runs on a cluster of three nodes on this machine.

        python benchmarks batch kills --json kills.json

    A run is two workers on two nodes beside the head. Of raylets, one of a worker's node is killed when a random number
    of items is begun, and a new node joins: the run has to end by itself with all items. Of heads, all processes of the
    head's node are killed: the run ends as it may, and processes of this machine make what is missing. Makers write
    down each item that they begin. `again` are those begun twice, at most UNDER_WAY for each worker that is lost;
    `seconds` pass from the kill to the end of the run, `status` and `said` are how that ended, `noted` the items done
    by then. The exit status is 1 where an item was lost, or one made again that was noted, or more than were under way.
    """
    rows, chance = [], random.Random(args.seed)
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "CUDA_VISIBLE_DEVICES": ""}
    with tempfile.TemporaryDirectory() as temporary:
        for victim in np.repeat(args.what, args.kills).tolist():
            folder = pathlib.Path(temporary, f"run_{len(rows)}")
            folder.mkdir()
            path = waiting_job(
                folder, argparse.Namespace(items=args.items, megabytes=1, load=0, make=args.make, write=0)
            )
            rows.append(one_kill(path, victim, chance.randrange(args.items * 9 // 10)))
            print(rows[-1], flush=True)
    wrong = [row for row in rows if row["wrong"]]
    print(f"{len(rows)} kills, {len(wrong)} of them wrong; {sum(row['again'] for row in rows)} items made again")
    if args.json:
        write_results(args.json, "cpu", rows=rows)
    return 1 if wrong else 0


def one_kill(path: pathlib.Path, victim: str, when: int) -> dict:
    """Run a job, kill a raylet or the head once so many items are begun, and see what came of it."""
    from ray.cluster_utils import Cluster

    out, log, here = path.parent / "out", path.with_name("made.txt"), pathlib.Path(__file__).parents[1]
    log.touch()
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
        arguments = [sys.executable, "-c", DRIVER, *map(str, (here, path, out, cluster.address))]
        driver = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        while len(log.read_text().splitlines()) < when and driver.poll() is None:
            time.sleep(0.002)
        killed = cluster.head_node if victim == "head" else nodes[when % 2]
        for name, processes in killed.all_processes.items():
            for each in processes if victim == "head" or name == "raylet" else ():
                each.process.kill()
                each.process.wait()  # a zombie counts as alive for those that it started
        begin, early = time.monotonic(), driver.poll() is not None
        if victim == "raylet":
            cluster.add_node(num_cpus=1)
        try:
            said = driver.communicate(timeout=HANGS)[1]
        except subprocess.TimeoutExpired:
            driver.kill()
            said = driver.communicate()[1] + HUNG
        seconds = time.monotonic() - begin
    finally:
        cluster.shutdown()
    noted, begun = done_items(out), log.read_text().splitlines()  # in this order, as a worker may still be ending
    report = counted_run(path, out)
    made = log.read_text().splitlines()
    again, lost_workers = len(made) - len(set(made)), 2 if victim == "head" else 1
    wrong = {
        "nothing was killed": early,
        HUNG: said.endswith(HUNG),
        "lost": not report.complete or len(done_items(out)) < report.total or len(set(made)) < report.total,
        "no file": not all((out / f"{each}.png").is_file() for each in made),
        "noted and not kept": report.kept < len(noted) or bool(noted & set(made[len(begun) :])),
        "made again": again > lost_workers * UNDER_WAY,
        "not ended by itself": victim == "raylet" and bool(driver.returncode or report.made),
    }
    row = {"victim": victim, "when": when, "seconds": round(seconds, 1), "status": driver.returncode, "again": again}
    row |= {"items": report.total, "noted": len(noted), "said": said.strip().splitlines()[-1:]}
    return row | {"wrong": [name for name, is_so in wrong.items() if is_so]}


def counted_run(path: pathlib.Path, out: pathlib.Path, **options):
    """A run whose makers write down each item that they make."""
    say = functools.partial(print, file=sys.stderr)
    return warpcage.run_jobs(path, out, workers=2, device="cpu", retries=40, make=Counting, warn=say, **options)


def done_items(out: pathlib.Path) -> set[str]:
    """Ids of the items that notes or the manifest of a folder have as done."""
    found = set()
    for path in [*out.glob(".warpcage/notes/*.jsonl"), out / "manifest.jsonl"]:
        with contextlib.suppress(FileNotFoundError), open(path, encoding="utf-8") as file:
            lines = [line for line in file if line.endswith("\n")]
            found |= {record["id"] for record in map(json.loads, lines) if record["state"] == "done"}
    return found


class Counting(Waiting):
    """Makes items by waiting, and writes down beside the job file which, before each."""

    def __init__(self, base: str, out: str, device: object):
        super().__init__(base, out, device)
        self._log = open(pathlib.Path(base, "made.txt"), "a", encoding="utf-8", buffering=1)

    def submit(self, item, out=None):
        """Write it down, and make it."""
        self._log.write(f"{item.id}\n")
        return super().submit(item, out)

    def close(self) -> None:
        """End the threads."""
        super().close()
        self._log.close()
