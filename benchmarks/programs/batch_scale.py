"""How far the driver of `warpcage run` goes, with measured times."""

from __future__ import annotations

import concurrent.futures
import contextlib
import json
import pathlib
import resource
import tempfile
import time

import numpy as np
from common import JSON, ball_field, command, option, pickle_by_value, write_results, write_twists

import warpcage
from warpcage.studio.jobs import (
    AIM,
    LARGEST,
    ChunkQueue,
    Dispatcher,
    Driver,
    JobFile,
    OutputFolder,
    make_plan,
    merge_notes,
    scheduler,
    write_jobs,
)

#: Mean seconds of an item: a small frame on an H200, a large one, a film's frame on a CPU.
MEANS = (0.02, 0.2, 2.0)

#: That of them for which chunks of one item are simulated too, which takes long.
ONE_BY_ONE = 0.2

#: How chunks are cut: the seconds that one aims at, and the most items that it has.
POLICIES = {"one item": (0.0, 1), "up to 16 items": (AIM, 16), f"{AIM:.0f} s, up to {LARGEST} items": (AIM, LARGEST)}

CAMERA = {"eye": [3, 2, 1.5], "target": [0, 0, 0], "width": 64, "height": 64}


@command(
    option("--items", type=int, default=1_000_000),
    option("--workers", type=int, default=1000),
    option("--frames", type=int, default=300, help="frames whose times are measured"),
    option("--messages", type=int, default=20_000, help="items of the runs that measure Ray"),
    option("--measured", help="take what was measured from an earlier JSON file of this machine"),
    JSON,
)
def main(args) -> int:
    """How far the driver of `warpcage run` goes: a million items over a thousand workers, simulated.

        python benchmarks batch-scale --json docs/results/batch_scale.json

    Measured here: what an item takes (frames of a ball by one worker), what a chunk costs the driver (real Ray, items
    that do nothing; processor time of the driver's process against chunks and items), and what the driver does before
    and after (a job file looked through, notes merged). With these the real dispatcher and its loop run under a virtual
    clock, with slow workers, stalls, deaths and failing items. The exit status is 1 where an item was lost or made
    twice.
    """
    measured = json.loads(pathlib.Path(args.measured).read_text()) if args.measured else measure(args)
    seconds, costs = np.array(measured["frame_seconds"]), measured["costs"]
    shown = [(mean, policy) for mean in MEANS for policy in POLICIES if mean == ONE_BY_ONE or policy != "one item"]
    runs = [simulated(args.items, args.workers, mean, seconds, costs, policy) for mean, policy in shown]
    content = {name: measured[name] for name in ("frame_seconds", "costs", "driver")} | {"simulated": runs}
    write_results(args.json, "cpu", **content)
    return 1 if any(run["lost"] or run["twice"] for run in runs) else 0


def measure(args) -> dict:
    """What is measured on this machine."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        seconds = frame_seconds(folder, args.frames)
        print(f"a frame takes {np.median(seconds):.4f} s in the median, {np.percentile(seconds, 95):.4f} s at 95 %")
        costs = message_costs(folder, args.messages)
        print(f"a chunk costs the driver {1e3 * costs['lot']:.2f} ms and {1e3 * costs['item']:.3f} ms for each item")
        ends = driver_ends(folder, args.items)
        print(", ".join(f"{name}: {value:.4g}" for name, value in ends.items()))
    return {"frame_seconds": seconds.tolist(), "costs": costs, "driver": ends}


def frame_seconds(folder: pathlib.Path, count: int) -> np.ndarray:
    """What frames take, each with a pose of its own: (count - 1,) seconds, without the first, which loads."""
    ball_field("cpu").save(folder / "ball.npz")
    write_twists(folder, "cage", warpcage.Cage.box((-1, -1, -1), (1, 1, 1), segments=2), count)
    items = [{"id": f"f{k:06d}", "posed": f"cage.npy#{k}"} for k in range(count)]
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
        done.set_result(dict.fromkeys(item.outputs.values(), 1000))
        return done

    def close(self):
        pass


def write_tiny(path: pathlib.Path, count: int) -> None:
    """A job file of frames with the keys that a sweep writes."""
    camera = {"fx": 80.0, "fy": 80.0, "cx": 32.0, "cy": 32.0, "width": 64, "height": 64}
    camera["camera_to_world"] = np.eye(4).tolist()
    with open(path, "w", encoding="utf-8") as file:
        header = {"format": "warpcage jobs", "version": 1, "defaults": {"field": "ball.npz", "cage": "cage.obj"}}
        file.write(json.dumps(header) + "\n")
        for k in range(count):
            item = {"id": f"pose_{k // 8:06d}/camera_{k % 8:03d}", "posed": f"poses.npy#{k % 50}", "camera": camera}
            file.write(json.dumps(item) + "\n")


def message_costs(folder: pathlib.Path, count: int) -> dict[str, float]:
    """Processor seconds of the driver for a chunk, and for each of its items, through Ray."""
    import ray

    ray.init(address="local", num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=10**8)
    pickle_by_value(__name__)
    rows, largest = [], scheduler.LARGEST
    try:
        for size, share in ((1, 0.05), (16, 0.5), (256, 1.0)):
            used = max(40, int(share * count))
            write_tiny(folder / f"tiny{size}.jsonl", used)
            times = []
            with SizedChunks(size):
                report = warpcage.run_jobs(
                    folder / f"tiny{size}.jsonl",
                    folder / f"tiny{size}",
                    workers=2,
                    cluster=ray.get_runtime_context().gcs_address,
                    device="cpu",
                    progress=lambda state, times=times: times.append((state.done, time.process_time())),
                    make=Nothing,
                )
            assert report.made == used
            made = [(done, when) for done, when in times if state_made(done, used)]
            begin, end = made[0], made[-1]
            rows.append((len(made) - 1, end[0] - begin[0], end[1] - begin[1]))
            print(f"chunks of {size}: {rows[-1][0]} chunks, {rows[-1][1]} items, {rows[-1][2]:.2f} s of the driver")
    finally:
        scheduler.LARGEST = largest
        ray.shutdown()
    table = np.array(rows)
    # least squares in relative error, as the runs differ in length
    weights = 1.0 / table[:, 2:]
    chunk, item = np.linalg.lstsq(table[:, :2] * weights, np.ones(len(table)), rcond=None)[0]
    return {"lot": float(chunk), "item": float(max(item, 0.0)), "runs": [list(map(float, row)) for row in rows]}


def state_made(done: int, count: int) -> bool:
    """Whether a report is one of the middle of a run: workers have started, and chunks are not yet those of its end."""
    return 0.1 * count <= done <= 0.9 * count


class SizedChunks:
    """Chunks of one size for a while."""

    def __init__(self, size: int):
        self._size = size

    def __enter__(self):
        self._before = ChunkQueue._size
        size = self._size
        ChunkQueue._size = lambda self, group, workers: min(size, max(1, self.left_in(group)))

    def __exit__(self, *_):
        ChunkQueue._size = self._before


def driver_ends(folder: pathlib.Path, count: int) -> dict[str, float]:
    """What the driver does before the first chunk and after the last one, seconds and megabytes."""
    path = folder / "many.jsonl"
    write_tiny(path, count)
    out = OutputFolder(folder / "many")
    out.prepare()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    begin = time.process_time()
    with JobFile(path) as job, contextlib.closing(out.read_manifest()) as manifest:
        plan = make_plan(job, out, manifest)
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
    from batch_simulation import Conditions, SimulatedEngine

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
    dispatcher = Dispatcher(ChunkQueue(np.arange(count), groups, aim=aim, largest=largest))
    for number in range(workers):
        dispatcher.add_worker(str(number))
    begin = time.perf_counter()
    Driver(dispatcher, engine, engine).run()
    good = np.ones(count, bool)
    good[list(dispatcher.failures)] = False
    ideal = seconds[good].sum() / (1.0 / speeds).sum()
    result = {
        "mean_seconds": mean,
        "policy": policy,
        "hours": engine.now() / 3600,
        "over_ideal": float(engine.now() / ideal),
        "driver_busy": engine.busy / engine.now(),
        "lots": engine.chunks,
        "messages": engine.messages,
        "deaths": engine.deaths,
        "failed": len(dispatcher.failures),
        "lost": int(np.count_nonzero(engine.made[good] == 0)),
        "twice": int(np.count_nonzero(engine.made > 1)),
        "simulated_in_seconds": time.perf_counter() - begin,
    }
    print({name: round(value, 4) if isinstance(value, float) else value for name, value in result.items()}, flush=True)
    return result
