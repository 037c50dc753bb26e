"""Where the driver of `warpcage run` ends: a million items over a thousand workers, simulated with measured times.

    python benchmarks/batch_scale.py --json docs/results/batch_scale.json --page docs/batch_scale.md

Measured here: what an item takes (frames of a ball by one worker), what a lot costs the driver (real Ray, items that
do nothing; processor time of the driver's process against lots and items), and what the driver does before and after (a
job file looked through, notes merged). With these the real dispatcher and its loop run under a virtual clock, with slow
workers, stalls, deaths and failing items. The exit status is 1 where an item was lost or made twice.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import json
import pathlib
import resource
import sys
import tempfile
import time

import numpy as np
from results import write_results

import warpcage
from warpcage.batch import scheduler
from warpcage.batch.job_file import JobFile, write_jobs
from warpcage.batch.loop import drive
from warpcage.batch.manifest import OutputFolder, merge_notes
from warpcage.batch.run import Options, _run, planned
from warpcage.batch.scheduler import AIM, LARGEST, Dispatcher, Lots

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / "tests"))
from batch_simulation import Conditions, SimulatedEngine  # noqa: E402

#: Mean seconds of an item: a small frame on an H200, a large one, a film's frame on a CPU.
MEANS = (0.02, 0.2, 2.0)

#: That of them for which lots of one item are simulated too, which takes long.
ONE_BY_ONE = 0.2

#: How lots are cut: the seconds that one aims at, and the most items that it has.
POLICIES = {"one item": (0.0, 1), "up to 16 items": (AIM, 16), f"{AIM:.0f} s, up to {LARGEST} items": (AIM, LARGEST)}

CAMERA = {"eye": [3, 2, 1.5], "target": [0, 0, 0], "width": 64, "height": 64}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--items", type=int, default=1_000_000)
    parser.add_argument("--workers", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=300, help="frames whose times are measured")
    parser.add_argument("--messages", type=int, default=20_000, help="items of the runs that measure Ray")
    parser.add_argument("--measured", help="take what was measured from an earlier JSON file of this machine")
    parser.add_argument("--json")
    parser.add_argument("--page")
    args = parser.parse_args()
    measured = json.loads(pathlib.Path(args.measured).read_text()) if args.measured else measure(args)
    seconds, costs = np.array(measured["frame_seconds"]), measured["costs"]
    shown = [(mean, policy) for mean in MEANS for policy in POLICIES if mean == ONE_BY_ONE or policy != "one item"]
    runs = [simulated(args.items, args.workers, mean, seconds, costs, policy) for mean, policy in shown]
    content = {name: measured[name] for name in ("frame_seconds", "costs", "driver")} | {"simulated": runs}
    if args.json:
        write_results(args.json, "cpu", **content)
    if args.page:
        pathlib.Path(args.page).write_text(page(args, content), encoding="utf-8")
    return 1 if any(run["lost"] or run["twice"] for run in runs) else 0


def measure(args) -> dict:
    """What is measured on this machine."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        seconds = frame_seconds(folder, args.frames)
        print(f"a frame takes {np.median(seconds):.4f} s in the median, {np.percentile(seconds, 95):.4f} s at 95 %")
        costs = message_costs(folder, args.messages)
        print(f"a lot costs the driver {1e3 * costs['lot']:.2f} ms and {1e3 * costs['item']:.3f} ms for each item")
        ends = driver_ends(folder, args.items)
        print(", ".join(f"{name}: {value:.4g}" for name, value in ends.items()))
    return {"frame_seconds": seconds.tolist(), "costs": costs, "driver": ends}


def frame_seconds(folder: pathlib.Path, count: int) -> np.ndarray:
    """What frames take, each with a pose of its own: (count - 1,) seconds, without the first, which loads."""
    n = 24
    nodes = np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij"), axis=-1)
    sh = np.zeros((n, n, n, 9, 3), np.float32)
    sh[..., 0, :] = nodes
    density = np.where(np.linalg.norm(nodes, axis=-1) < 0.8, 20.0, 0.0).astype(np.float32)
    warpcage.VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]], device="cpu").save(folder / "ball.npz")
    cage = warpcage.Cage.box((-1, -1, -1), (1, 1, 1), segments=2)
    cage.save(folder / "cage.obj")
    turns = 60.0 * np.sin(np.arange(count))
    np.save(folder / "poses.npy", np.stack([cage.twist(float(turn)).vertices for turn in turns]))
    items = [{"id": f"f{k:06d}", "posed": f"poses.npy#{k}"} for k in range(count)]
    defaults = {"field": "ball.npz", "cage": "cage.obj", "camera": CAMERA, "resolution": 32}
    write_jobs(folder / "frames.jsonl", items, defaults=defaults)
    warpcage.run_jobs(folder / "frames.jsonl", folder / "frames", device="cpu")
    with open(folder / "frames" / "manifest.jsonl", encoding="utf-8") as file:
        return np.array([json.loads(line)["seconds"] for line in file][1:])


class Nothing:
    """Makes nothing, at once."""

    def __init__(self, base, out, device):
        pass

    def submit(self, item, out=None):
        done = concurrent.futures.Future()
        done.set_result({path: 1000 for path in item.outputs.values()})
        return done

    def close(self):
        pass


def write_tiny(path: pathlib.Path, count: int) -> None:
    """A job file of frames with the words that a sweep writes."""
    camera = {"fx": 80.0, "fy": 80.0, "cx": 32.0, "cy": 32.0, "width": 64, "height": 64}
    camera["camera_to_world"] = np.eye(4).tolist()
    with open(path, "w", encoding="utf-8") as file:
        header = {"format": "warpcage jobs", "version": 1, "defaults": {"field": "ball.npz", "cage": "cage.obj"}}
        file.write(json.dumps(header) + "\n")
        for k in range(count):
            item = {"id": f"pose_{k // 8:06d}/camera_{k % 8:03d}", "posed": f"poses.npy#{k % 50}", "camera": camera}
            file.write(json.dumps(item) + "\n")


def message_costs(folder: pathlib.Path, count: int) -> dict[str, float]:
    """Processor seconds of the driver for a lot, and for each of its items, through Ray."""
    import ray

    ray.init(address="local", num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=10**8)
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    rows, largest = [], scheduler.LARGEST
    try:
        for size, share in ((1, 0.05), (16, 0.5), (256, 1.0)):
            used = max(40, int(share * count))
            write_tiny(folder / f"tiny{size}.jsonl", used)
            times = []
            with sized_lots(size):
                report = _run(
                    folder / f"tiny{size}.jsonl",
                    folder / f"tiny{size}",
                    Options(2, None, "cpu", 2),
                    lambda state, times=times: times.append((state.done, time.process_time())),
                    lambda line: None,
                    Nothing,
                )
            assert report.made == used
            made = [(done, when) for done, when in times if state_made(done, used)]
            begin, end = made[0], made[-1]
            rows.append((len(made) - 1, end[0] - begin[0], end[1] - begin[1]))
            print(f"lots of {size}: {rows[-1][0]} lots, {rows[-1][1]} items, {rows[-1][2]:.2f} s of the driver")
    finally:
        scheduler.LARGEST = largest
        ray.shutdown()
    table = np.array(rows)
    # least squares in relative error, as the runs differ in length
    weights = 1.0 / table[:, 2:]
    lot, item = np.linalg.lstsq(table[:, :2] * weights, np.ones(len(table)), rcond=None)[0]
    return {"lot": float(lot), "item": float(max(item, 0.0)), "runs": [list(map(float, row)) for row in rows]}


def state_made(done: int, count: int) -> bool:
    """Whether a report is one of the middle of a run: workers have started, and lots are not yet those of its end."""
    return 0.1 * count <= done <= 0.9 * count


class sized_lots:
    """Lots of one size for a while."""

    def __init__(self, size: int):
        self._size = size

    def __enter__(self):
        self._before = Lots._size
        size = self._size
        Lots._size = lambda self, group, workers, speed: min(size, max(1, self.left_in(group)))

    def __exit__(self, *_):
        Lots._size = self._before


def driver_ends(folder: pathlib.Path, count: int) -> dict[str, float]:
    """What the driver does before the first lot and after the last one, seconds and megabytes."""
    path = folder / "many.jsonl"
    write_tiny(path, count)
    out = OutputFolder(folder / "many")
    out.prepare()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    begin = time.process_time()
    with JobFile(path) as job:
        plan = planned(job, out)
    planning = time.process_time() - begin
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before
    assert len(plan.items) == count
    line = {"state": "done", "inputs": "0" * 32, "outputs": {"a.png": 123456}, "kind": "frame", "seconds": 0.1}
    line |= {"device": "NVIDIA H200", "worker": "0", "host": "node-0", "attempts": 1, "version": "0.1.0"}
    per_worker = max(1, count // 1000)
    for worker in range(min(1000, count)):
        with open(out.notes / f"{worker}.jsonl", "w", encoding="utf-8") as file:
            for k in range(worker * per_worker, (worker + 1) * per_worker):
                name = f"pose_{k // 8:06d}/camera_{k % 8:03d}"
                file.write(json.dumps({"id": name, "state": "started", "lot": k // 256}) + "\n")
                file.write(json.dumps({"id": name} | line) + "\n")
    begin, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    merge_notes(out.manifest, out.notes.glob("*.jsonl"))
    merging = time.process_time() - begin
    return {
        "items": count,
        "plan_seconds": planning,
        "plan_megabytes": grown,
        "merge_seconds": merging,
        "merge_megabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before,
        "manifest_megabytes": out.manifest.stat().st_size / 2**20,
    }


def simulated(count: int, workers: int, mean: float, sample: np.ndarray, costs: dict, policy: str) -> dict:
    """A run under the virtual clock."""
    random = np.random.default_rng(1)
    seconds = random.choice(sample, count) * (mean / sample.mean())
    groups = np.arange(count) * 40 // count  # 40 fields
    speeds = random.choice([1.0, 5.0], workers, p=[0.98, 0.02])
    bad = frozenset(random.choice(count, max(1, count // 10_000), replace=False).tolist())
    engine = SimulatedEngine(
        Conditions(
            seconds,
            groups,
            speeds,
            load_seconds=2.0,
            start_seconds=5.0,
            send_cost=(0.6 * costs["lot"], 0.6 * costs["item"]),
            receive_cost=(0.4 * costs["lot"], 0.4 * costs["item"]),
            deaths_per_hour=0.5,
            bad=bad,
            flaky=1e-4,
            stalls=(0.002, 10.0),
        )
    )
    aim, largest = POLICIES[policy]
    dispatcher = Dispatcher(Lots(np.arange(count), groups, aim=aim, largest=largest))
    for number in range(workers):
        dispatcher.add_worker(str(number))
    begin = time.perf_counter()
    drive(dispatcher, engine)
    good = np.ones(count, bool)
    good[list(dispatcher.failures)] = False
    ideal = seconds[good].sum() / (1.0 / speeds).sum()
    result = {
        "mean_seconds": mean,
        "policy": policy,
        "hours": engine.now() / 3600,
        "over_ideal": float(engine.now() / ideal),
        "driver_busy": engine.busy / engine.now(),
        "lots": engine.lots,
        "messages": engine.messages,
        "deaths": engine.deaths,
        "failed": dispatcher.failed,
        "lost": int(np.count_nonzero(engine.made[good] == 0)),
        "twice": int(np.count_nonzero(engine.made > 1)),
        "simulated_in_seconds": time.perf_counter() - begin,
    }
    print({name: round(value, 4) if isinstance(value, float) else value for name, value in result.items()}, flush=True)
    return result


def page(args, content: dict) -> str:
    """The page of the figures."""
    costs, ends = content["costs"], content["driver"]
    alone = 1.0 / (costs["lot"] + costs["item"])
    full = LARGEST / (costs["lot"] + LARGEST * costs["item"])
    rows = "\n".join(
        f"| {run['mean_seconds']:g} s | {run['policy']} | {run['hours']:.2f} h | {run['over_ideal']:.2f} | "
        f"{100 * run['driver_busy']:.0f} % | {run['lots']:,} | {run['deaths']} |"
        for run in content["simulated"]
    )
    return f"""\
# How far one driver goes

Written by `benchmarks/batch_scale.py`; figures and machine are in [results/batch_scale.json](results/batch_scale.json).

The driver of `warpcage run` hands out *lots*: items of one group, so many that a lot takes some {AIM:.0f} s, at most
{LARGEST}, and few towards the end. Of a lot it hears twice: when it sends it, and when it is done. What became of each
item is in the notes of its worker, which are merged at the end. Towards the end, workers that have nothing to do get
what others have not begun.

Measured here through Ray: a lot costs the driver {1e3 * costs["lot"]:.2f} ms of processor time, and
{1e3 * costs["item"]:.4f} ms more for each of its items, whose lines are sent as they stand. One by one, the driver's
limit is {alone:,.0f} items a second, in lots of {LARGEST} it is {full:,.0f}. A thousand workers are kept at work as
long as an item takes more than {1000 / full:.3f} s, one by one {1000 / alone:.2f} s.

Before the first lot the driver looks through the job file: {ends["plan_seconds"]:.0f} s and
{ends["plan_megabytes"]:.0f} MB for {ends["items"]:,} items. Afterwards it merges the notes:
{ends["merge_seconds"]:.0f} s and {ends["merge_megabytes"]:.0f} MB, for a manifest of
{ends["manifest_megabytes"]:.0f} MB.

## Simulated

{args.items:,} items of 40 fields over {args.workers:,} workers, by the dispatcher's own code under a virtual clock.
Items take what frames took here, scaled to the mean of the row. One worker in 50 is five times slower, one lot in 500
is made ten times slower, each worker dies every two hours on average, one item in 10,000 has bad input and as many
tries fail by chance. Every item that could be made was made once. *Over ideal*: how many times longer the run takes
than the work divided by all workers, with nothing else to do: no start of workers (5 s), no field to load (2 s).

| an item takes | lots | the run takes | over ideal | driver at work | lots in all | deaths |
| --- | --- | --- | --- | --- | --- | --- |
{rows}
"""


if __name__ == "__main__":
    sys.exit(main())
