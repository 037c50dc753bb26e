"""`warpcage run` by several workers: whatever is killed when, every output is whole, each item once in the manifest,
and the pictures are those of a run without faults, to the bit."""

import concurrent.futures
import os
import pathlib
import random
import re
import signal
import subprocess
import sys
import threading
import time
import types

import numpy as np
import pytest
from messages import MESSAGES
from runs import SUPPORT, Deadly, Making, Moody, left_over, number_of, pictures, records, run_with, write_frames

import warpcage
from warpcage.batch import RayEngine, RunnerSettings, Share
from warpcage.cli import main

ray = pytest.importorskip("ray", reason="several workers need Ray")

FRAMES = 60


@pytest.fixture(scope="module")
def address():
    """Ray, started once for all tests of this file: its address. Makers of tests are sent by their source."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    ray.init(address="local", num_cpus=4, include_dashboard=False, log_to_driver=False, object_store_memory=100 * 2**20)
    import runs

    ray.cloudpickle.register_pickle_by_value(runs)
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    yield ray.get_runtime_context().gcs_address
    ray.shutdown()


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("jobs") / "job", FRAMES)


@pytest.fixture(scope="module")
def whole(job, tmp_path_factory):
    """The pictures of a run without faults, by one worker."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert run_with(job, out).complete
    return pictures(out)


@pytest.fixture
def engines(monkeypatch):
    """The engines of the runs of a test."""
    made = []

    class Seen(RayEngine):
        def __init__(self, *given):
            super().__init__(*given)
            made.append(self)

    monkeypatch.setattr("warpcage.batch.run.RayEngine", Seen)
    return made


def assert_whole(out, whole):
    assert pictures(out) == whole and left_over(out) == []
    found = records(out)
    assert len(found) == len(whole) and {record["state"] for record in found.values()} == {"done"}
    for record in found.values():
        assert all((out / name).stat().st_size == size for name, size in record["outputs"].items())


class Late(Making):
    """Files are there a while after the next items were begun. Item 23 kills its worker in the midst of that."""

    def __init__(self, base, out, device):
        super().__init__(base, out, device)
        self.pool = concurrent.futures.ThreadPoolExecutor(40)

    def submit(self, item, out=None):
        if number_of(item) == 23 and not (self.out / ".warpcage" / "died").exists():
            (self.out / ".warpcage" / "died").write_text("")
            os.kill(os.getpid(), signal.SIGKILL)

        def write():
            time.sleep(0.3)
            return Making.submit(self, item, out).result()

        time.sleep(0.01)
        return self.pool.submit(write)


def test_a_worker_killed_between_two_chunks_loses_nothing(address, job, whole, tmp_path):
    """While it makes items of a chunk and writes files of the one before."""
    out, lines = tmp_path / "out", []
    assert run_with(job, out, Late, workers=2, cluster=address, warn=lines.append).complete
    assert len(lines) == 1 and "its worker died" in lines[0] and left_over(out) == ["died"]
    assert [name for name, each in records(out).items() if each["attempts"] > 1] == ["shot/f0023"]
    assert len(records(out)) == len(whole) == len(list((out / "shot").iterdir()))


def test_two_workers_make_what_one_does(address, job, whole, tmp_path):
    out = tmp_path / "out"
    report = run_with(job, out, workers=2)
    assert report.complete and report.made == FRAMES
    assert_whole(out, whole)
    assert {record["worker"] for record in records(out).values()} <= {"0", "1"}  # both: see the straggler
    assert run_with(job, out, workers=2).kept == FRAMES


def test_twenty_kills_of_workers_cost_nothing(address, job, whole, tmp_path, engines):
    """kill -9 of one of two workers, in the middle of an item, at random moments."""
    out, chance, kills, done = tmp_path / "out", random.Random(5), [], threading.Event()

    def kill():
        while len(kills) < 20 and not done.is_set():
            time.sleep(chance.uniform(0.0, 0.15))
            places = list(engines[0].places.items()) if engines else []
            if places:
                name, place = chance.choice(places)
                if engines[0].places.pop(name, None):  # each process once
                    os.kill(place["pid"], signal.SIGKILL)
                    kills.append(place["pid"])

    killer = threading.Thread(target=kill)
    killer.start()
    states = []
    try:
        while len(kills) < 20:
            report = warpcage.run_jobs(job, out, workers=2, device="cpu", retries=20, progress=states.append)
            assert report.complete
            if len(kills) < 20:  # there was not enough to do for twenty: once more from the beginning
                assert_whole(out, whole)
                for path in [*out.rglob("*.png"), out / "manifest.jsonl"]:
                    path.unlink()
                engines.clear()
    finally:
        done.set()
        killer.join()
    assert_whole(out, whole)
    assert len(set(kills)) == 20


def test_five_kills_of_the_driver_cost_nothing(address, job, whole, tmp_path):
    out, chance = tmp_path / "out", random.Random(3)
    words = ["run", job, "-o", out, "--device", "cpu", "--quiet", "--workers", 2, "--cluster", address]
    notes, made, kills = out / ".warpcage" / "notes", 0, 0
    while kills < 5:
        driver = subprocess.Popen([sys.executable, "-m", "warpcage", *map(str, words)], stderr=subprocess.PIPE)
        here = made + chance.randint(1, 8)  # of 60: so that there is something left for all five
        while driver.poll() is None and here > (made := count_of(notes, out)):
            time.sleep(0.003)
        time.sleep(chance.uniform(0.0, 0.03))
        assert driver.poll() is None, driver.stderr.read().decode()
        driver.kill()
        driver.communicate()
        kills += 1
        made = min(count_of(notes, out), FRAMES - 1)
    before = {path: path.stat().st_mtime_ns for path in (out / "shot").glob("*.png")}
    assert main([*map(str, words[:-4]), "--retries", "20"]) == 0
    assert_whole(out, whole)
    again = [path for path, when in before.items() if path.stat().st_mtime_ns != when]
    assert len(again) <= 20  # those that were being written


def count_of(notes, out):
    """Items that are noted as done."""
    files = [*notes.glob("*.jsonl"), out / "manifest.jsonl"] if notes.exists() else []
    found = set()
    for path in files:
        try:
            found |= {line.split(b'"')[3] for line in path.read_bytes().splitlines() if b'"done"' in line}
        except FileNotFoundError:
            pass
    return len(found)


def test_an_item_that_kills_its_worker_is_failed_and_the_rest_is_made(address, job, tmp_path):
    path, out = write_frames(tmp_path / "job", 40), tmp_path / "out"
    lines = []
    report = run_with(path, out, Deadly, workers=2, warn=lines.append)
    assert report.made == 39 and list(report.failed) == ["shot/f0005"]
    assert report.failed["shot/f0005"].endswith("killed, or a crash of the process, 3 times while it was made")
    record = records(out)["shot/f0005"]
    assert (
        record["state"] == "failed" and record["attempts"] == 3 and len(lines) == 3 == sum("died" in x for x in lines)
    )


def test_errors_are_tried_again_elsewhere(address, tmp_path):
    path, out = write_frames(tmp_path / "job", 40), tmp_path / "out"
    report = run_with(path, out, Moody, workers=2, retries=6)
    found = records(out)
    assert sorted(report.failed) == [f"shot/f00{tens}{ones}" for tens in range(4) for ones in (5, 7)]
    assert [found[f"shot/f000{number}"]["attempts"] for number in (2, 7, 5)] == [1, 1, 7]
    assert 3 <= found["shot/f0003"]["attempts"] <= 6  # it fails twice in each process


class Waiting(Making):
    def before(self, item):
        end = time.monotonic() + 60
        while number_of(item) == 0 and count_made(self.out) < 59 and time.monotonic() < end:
            time.sleep(0.05)


def count_made(out):
    return sum(path.is_file() and ".warpcage" not in path.parts for path in out.rglob("*.png"))


def test_a_straggler_gives_its_rest_to_the_other(address, tmp_path):
    """The first item takes as long as all others."""
    path, out = write_frames(tmp_path / "job", 60), tmp_path / "out"
    assert run_with(path, out, Waiting, workers=2).complete
    found = records(out)
    first = found["shot/f0000"]["worker"]
    others = [record["worker"] != first for name, record in found.items() if name != "shot/f0000"]
    assert len(others) == 59 and all(others)


class Endless(Making):
    """Item 5 is never made."""

    def before(self, item):
        if number_of(item) == 5:
            threading.Event().wait()


class Unwritten(Making):
    """The files of item 5 are never written, while others are made."""

    def submit(self, item, out=None):
        done = super().submit(item, out)
        return concurrent.futures.Future() if number_of(item) == 5 else done


@pytest.mark.parametrize("workers, maker", [(None, Endless), (2, Unwritten)])
def test_an_endless_item_is_failed_and_the_rest_is_made(address, tmp_path, workers, maker):
    """An item that takes long once, by chance, is tried again: more warnings may come, no other failures."""
    path, out, lines = write_frames(tmp_path / "job", 30), tmp_path / "out", []
    report = run_with(path, out, maker, workers=workers, retries=1, item_timeout=2, warn=lines.append)
    line = "its worker was ended: the item took longer than 2 s, 2 times while it was made"
    assert report.failed == {"shot/f0005": line} and report.made == 29 and not report.left
    found = records(out)
    assert len(found) == 30 and (found["shot/f0005"]["state"], found["shot/f0005"]["attempts"]) == ("failed", 2)
    assert len(lines) >= 2 and all("the item took longer than 2 s: it is started again" in each for each in lines)
    assert run_with(path, out, Making, workers=2).kept == 29
    assert {record["state"] for record in records(out).values()} == {"done"} and left_over(out) == []


class Deaf(Making):
    """Item 3 keeps the interpreter to itself: no other thread of its process runs, nor answers."""

    def before(self, item):
        if number_of(item) == 3:
            re.match("(a+)+$", "a" * 60 + "b")


def test_a_worker_that_answers_no_more_is_ended(address, tmp_path, monkeypatch):
    monkeypatch.setattr("warpcage.batch.ray_engine.ANSWER", 3.0)
    path, out = write_frames(tmp_path / "job", 12), tmp_path / "out"
    report = run_with(path, out, Deaf, workers=2, retries=0, item_timeout=2)
    line = "its worker was ended: it did not answer for 3 s, 1 time while it was made"
    assert report.failed == {"shot/f0003": line} and report.made == 11
    assert records(out)["shot/f0003"]["state"] == "failed"


class Full(Making):
    """A disk that is full from the tenth item on."""

    def before(self, item):
        if number_of(item) >= 10:
            os.write(os.open("/dev/full", os.O_WRONLY), b"x")


@pytest.mark.skipif(not pathlib.Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_ends_the_run(address, tmp_path):
    path, out = write_frames(tmp_path / "job", 60), tmp_path / "out"
    report = run_with(path, out, Full, workers=2)
    assert "no space left on device" in report.halt and not report.failed
    # the other worker may have begun with later items, and met the end of the disk before the tenth was made
    assert report.made <= 10 and report.left == 60 - report.made
    assert run_with(path, out, Making, workers=2).complete and left_over(out) == []


class Hostless(Making):
    def __init__(self, base, out, device):
        raise RuntimeError("no driver of the GPU")


def test_workers_that_cannot_start_end_the_run_in_one_line(address, tmp_path):
    path = write_frames(tmp_path / "job", 4)
    with pytest.raises(RuntimeError, match=MESSAGES["batch.no_worker_left"]):
        run_with(path, tmp_path / "out", Hostless, workers=2)
    assert run_with(path, tmp_path / "out", Making, workers=2).complete


def test_an_interrupt_keeps_what_is_made(address, job, whole, tmp_path):
    out = tmp_path / "out"
    program = (
        "import signal, sys\nfrom warpcage.cli import main\nsignal.signal(signal.SIGINT, signal.default_int_handler)"
    )
    words = ["run", job, "-o", out, "--device", "cpu", "--quiet", "--workers", 2, "--cluster", address]
    line = [sys.executable, "-c", f"{program}\nsys.exit(main(sys.argv[1:]))", *map(str, words)]
    driver = subprocess.Popen(line, stderr=subprocess.PIPE, text=True)
    while driver.poll() is None and count_of(out / ".warpcage" / "notes", out) < 5:
        time.sleep(0.02)
    driver.send_signal(signal.SIGINT)
    said = driver.communicate()[1]
    assert driver.returncode == 130 and said == "warpcage: interrupted\n"
    found = records(out)
    assert 5 <= len(found) == len(pictures(out)) < FRAMES and left_over(out) == []
    assert run_with(job, out, workers=2).kept == len(found)
    assert_whole(out, whole)


def test_clusters_that_do_not_answer_are_refused(job, tmp_path, capsys):
    """In a process of its own: this one is connected already."""
    words = ["run", job, "-o", tmp_path / "out", "--cluster", "127.0.0.1:1", "--quiet"]
    done = subprocess.run([sys.executable, "-m", "warpcage", *map(str, words)], capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("warpcage: error: no Ray cluster answers at '127.0.0.1:1'"), done.stderr


@pytest.mark.parametrize("device", ["cuda:1", "gpu"])
def test_devices_that_several_workers_cannot_share_are_refused(address, job, tmp_path, device):
    with pytest.raises(ValueError, match=MESSAGES["batch.devices_of_workers"]):
        warpcage.run_jobs(job, tmp_path / "out", workers=2, device=device)


def test_workers_share_the_cores():
    from warpcage.batch import shares
    from warpcage.core import cpu_threads

    class Nodes:
        def __init__(self, *resources):
            self.resources = resources

        def nodes(self):
            return [{"Alive": True, "Resources": each} for each in self.resources]

    here = shares(Nodes({"CPU": 2.0}), 2, False, None)
    assert (here.workers, here.gpus, here.cpus, here.device) == (2, 0, 0, "cpu")
    assert here.threads == max(1, cpu_threads() // 2)
    two = Nodes({"CPU": 8.0}, {"CPU": 6.0})
    assert [(shares(two, n, True, None).cpus, shares(two, n, True, None).workers) for n in (2, 3, 14, None)] == [
        (6, 2),
        (4, 3),
        (1, 14),
        (6, 2),
    ]
    gpus = Nodes({"CPU": 32.0, "GPU": 2.0})
    found = shares(gpus, None, False, None)
    assert (found.workers, found.gpus, found.threads, found.device) == (2, 1, 16, "cuda:0")
    assert shares(gpus, 4, False, "cpu").gpus == 0
    with pytest.raises(ValueError, match=MESSAGES["batch.as_many_gpus"]):
        shares(gpus, 4, False, None)
    with pytest.raises(ValueError, match="Ray sees no GPU"):
        shares(two, 2, False, "cuda")
    assert np.isfinite(found.cpus)


def test_a_run_ends_in_one_line_when_ray_itself_has_ended_here(monkeypatch):
    """Ray would let it wait for two minutes, and then end the process without a word."""
    alive = {"here": True, "asked": 0}

    def nodes():
        alive["asked"] += 1
        return [{"Alive": alive["here"], "Resources": {}}]

    never = types.SimpleNamespace(remote=lambda *_: types.SimpleNamespace(future=concurrent.futures.Future))
    made = types.SimpleNamespace(remote=lambda settings: types.SimpleNamespace(facts=never))
    fake = types.SimpleNamespace(
        remote=lambda actor: types.SimpleNamespace(options=lambda **words: made), nodes=nodes, kill=lambda actor: None
    )
    settings = RunnerSettings("job", None, "out", "run")
    for cluster in (False, True):
        engine = RayEngine(fake, settings, Share(1, 0, 0, 1, "cpu"), None, None, cluster)
        now = [100.0]
        monkeypatch.setattr(engine, "now", lambda now=now: now[0])
        alive |= {"here": True, "asked": 0}
        engine.launch("0")
        for _ in range(3):
            assert engine.wait(0.0) == []  # it may still start
        assert alive["asked"] == (0 if cluster else 1)  # not at each turn
        alive["here"], now[0] = False, 110.0
        if cluster:  # whose machines may come back
            assert engine.wait(0.0) == []
        else:
            with pytest.raises(RuntimeError, match=MESSAGES["batch.ray_ended"]):
                engine.wait(0.0)


LOST_NODE = """\
import pathlib, sys, threading, time
sys.path.insert(0, sys.argv[3])
import runs
import ray
from ray.cluster_utils import Cluster

ray.cloudpickle.register_pickle_by_value(runs)


class Slow(runs.Making):
    def before(self, item):
        time.sleep(0.1)


cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
nodes = [cluster.add_node(num_cpus=1) for _ in range(2)]
out = pathlib.Path(sys.argv[2])


def lose():
    while not all(list(out.glob(f".warpcage/notes/*-{worker}-1.jsonl")) for worker in "01"):
        time.sleep(0.05)
    time.sleep(0.5)
    cluster.remove_node(nodes[0], allow_graceful=False)


losing = threading.Thread(target=lose)
losing.start()
lines = []
report = runs.run_with(pathlib.Path(sys.argv[1]), out, Slow, workers=2, cluster=cluster.address, warn=lines.append)
losing.join()
assert report.complete and report.made == 60, report
assert len(lines) == 1 and "its worker died" in lines[0], lines
cluster.shutdown()
"""


def test_a_lost_machine_costs_an_item_a_try(tmp_path):
    """Two nodes of a cluster on one machine, one of which is killed with all that runs on it."""
    path, out = write_frames(tmp_path / "job", 60), tmp_path / "out"
    line = [sys.executable, "-c", LOST_NODE, str(path), str(out), SUPPORT]
    done = subprocess.run(line, capture_output=True, text=True, env=os.environ | {"RAY_USAGE_STATS_ENABLED": "0"})
    assert done.returncode == 0, done.stderr[-3000:]
    found = records(out)
    assert len(found) == 60 and left_over(out) == [] and {each["state"] for each in found.values()} == {"done"}
    assert sum(each["attempts"] > 1 for each in found.values()) <= 1
