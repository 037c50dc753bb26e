"""`warpcage run` on Ray: what is lost where its processes are killed."""

from __future__ import annotations

import concurrent.futures
import contextlib
import functools
import json
import os
import pathlib
import random
import subprocess
import sys
import tempfile
import time

import numpy as np
from common import JSON, command, option, write_results

import warpcage
from warpcage.studio.jobs import write_jobs

#: Seconds that a run may take after a kill before it counts as one that hangs, and items that a worker may have under
#: way, which are made again.
HANGS, UNDER_WAY = 180.0, 4

#: How a run that hangs is reported.
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
            path = waiting_job(folder, args.items, args.make)
            rows.append(one_kill(path, victim, chance.randrange(args.items * 9 // 10)))
            print(rows[-1], flush=True)
    wrong = [row for row in rows if row["wrong"]]
    print(f"{len(rows)} kills, {len(wrong)} of them wrong; {sum(row['again'] for row in rows)} items made again")
    write_results(args.json, "cpu", rows=rows)
    return 1 if wrong else 0


def waiting_job(folder: pathlib.Path, count: int, seconds: float) -> pathlib.Path:
    """Items that each take so many seconds, of files that only hashes read."""
    folder.mkdir()
    (folder / "field.npz").write_bytes(b"")
    (folder / "cage.obj").write_text("v 0 0 0\n")
    (folder / "seconds").write_text(str(seconds))
    camera = {"eye": [2, 2, 2], "target": [0, 0, 0], "width": 800, "height": 800}
    defaults = {"field": "field.npz", "cage": "cage.obj", "posed": "cage.obj", "camera": camera}
    items = ({"id": f"item_{number:05d}"} for number in range(count))
    write_jobs(folder / "jobs.jsonl", items, defaults=defaults | {"outputs": {"rgb": "{id}.png"}})
    return folder / "jobs.jsonl"


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


class Counting:
    """Makes items by waiting, and writes down beside the job file which, before each."""

    def __init__(self, base: str, out: str, device: object):
        self._out, self._seconds = pathlib.Path(out), float(pathlib.Path(base, "seconds").read_text())
        self._log = open(pathlib.Path(base, "made.txt"), "a", encoding="utf-8", buffering=1)
        self._pool = concurrent.futures.ThreadPoolExecutor()

    def submit(self, item, out=None):
        """Write it down, wait, and let a thread write its files."""
        self._log.write(f"{item.id}\n")
        time.sleep(self._seconds)
        return self._pool.submit(self._write, item)

    def _write(self, item) -> dict[str, int]:
        return {path: (self._out / path).write_text(item.id) for path in item.outputs.values()}

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()
        self._log.close()
