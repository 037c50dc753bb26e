"""`warpcage run` by several workers, processes of this machine and Ray: whatever is killed when, every output is whole,
each item once in the manifest, and the pictures are those of a run without faults, to the bit."""

import contextlib
import os
import pathlib
import random
import signal
import subprocess
import sys
import threading
import time
import types

import pytest
from makers import Deadly, Deaf, Endless, Full, Hostless, Late, Making, Moody, Unwritten, Waiting
from messages import MESSAGES
from refusals import refused
from runs import SUPPORT, command, left_over, pictures, records, run_with, write_frames

import warpcage
from warpcage.core import cpu_threads
from warpcage.studio.jobs import LocalHost, ProcessEngine, RayHost, early_processes, scheduler

FRAMES = 40

#: Kills of workers and of the driver, by day and at night.
KILLS, KILLS_OF_DRIVERS = (2, 20), (1, 5)

#: Ray's workers have a niceness of 15: beside other tests they would wait for minutes.
OF_RAY = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_worker_niceness": "0"}
OF_RAY["RAY_prestart_worker_first_driver"] = "0"  # workers are started as they are asked for


#: Tests of what is the same code for both; each of Ray's workers takes seconds to start.
RAY_AT_NIGHT = pytest.mark.parametrize(
    "address", ["processes", pytest.param("ray", marks=pytest.mark.nightly)], indirect=True
)


@pytest.fixture(scope="module", params=["processes", "ray"])
def address(request):
    """Where workers live: None is this machine, else the address of Ray, started once for all tests of this file."""
    if request.param == "processes":
        yield None
        return
    ray = pytest.importorskip("ray", reason="clusters need Ray")
    os.environ |= OF_RAY
    ray.init(address="local", num_cpus=4, include_dashboard=False, log_to_driver=False, object_store_memory=100 * 2**20)
    import makers

    ray.cloudpickle.register_pickle_by_value(makers)
    yield ray.get_runtime_context().gcs_address
    ray.shutdown()


def run_by(address, *given, **options):
    return run_with(*given, cluster=address, **options)


def command_of(address, job, out):
    argv = ["run", job, "-o", out, "--device", "cpu", "--quiet", "--workers", 2]
    return command(*argv, *(["--cluster", address] if address else []))


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

    class Seen(ProcessEngine):
        def __init__(self, *given):
            super().__init__(*given)
            made.append(self)

    monkeypatch.setattr("warpcage.studio.jobs.run.ProcessEngine", Seen)
    return made


def assert_whole(out, whole):
    assert pictures(out) == whole and left_over(out) == []
    found = records(out)
    assert len(found) == len(whole) and {record["state"] for record in found.values()} == {"done"}
    for record in found.values():
        assert all((out / name).stat().st_size == size for name, size in record["outputs"].items())


def about_workers(lines):
    """What a run said but that fewer workers are quicker, which depends on the machine."""
    return [line for line in lines if "fewer workers are quicker" not in line]


@pytest.mark.nightly
@RAY_AT_NIGHT
def test_a_worker_killed_between_two_chunks_loses_nothing(address, job, whole, tmp_path):
    """While it makes items of a chunk and writes files of the one before."""
    out, lines = tmp_path / "out", []
    assert run_by(address, job, out, Late, workers=2, warn=lines.append).complete
    reports = about_workers(lines)
    assert len(reports) == 1 and "its worker died" in reports[0] and left_over(out) == ["died"]
    assert [name for name, each in records(out).items() if each["attempts"] > 1] == ["shot/f0023"]
    assert len(records(out)) == len(whole) == len(list((out / "shot").iterdir()))


@pytest.mark.nightly
@RAY_AT_NIGHT
def test_two_workers_make_what_one_does(address, job, whole, tmp_path):
    out = tmp_path / "out"
    report = run_by(address, job, out, workers=2)
    assert report.complete and report.made == FRAMES
    assert_whole(out, whole)
    assert {record["worker"] for record in records(out).values()} <= {"0", "1"}  # both: see the straggler
    assert run_with(job, out).kept == FRAMES


def children():
    """Processes that this one has started and that are there."""
    fields = []
    for path in pathlib.Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            fields.append((int(path.parent.name), path.read_text().rpartition(")")[2].split()))
    return {pid for pid, (state, parent, *_) in fields if int(parent) == os.getpid() and state != "Z"}


@pytest.mark.skipif(not pathlib.Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
@pytest.mark.parametrize("maker", [None, Making])
@pytest.mark.nightly
def test_workers_start_beside_the_plan_and_are_those_that_work(job, whole, tmp_path, engines, maker):
    before, planned = children(), set()

    def progress(state):
        (planned if state.stage == "check" else made).update(children() - before)

    made = set()
    assert run_with(job, tmp_path / "out", maker, workers=2, progress=progress).complete
    # none is started twice, and none beyond the threads that are allowed starts beforehand
    assert len(planned) == min(2, cpu_threads()) and planned <= made and len(made) == 2
    assert children() <= before
    if maker is None:
        assert_whole(tmp_path / "out", whole)


@pytest.mark.skipif(not pathlib.Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
@pytest.mark.nightly
def test_a_process_that_a_program_starts_works_in_its_run(job, whole, tmp_path, engines):
    before, out = children(), tmp_path / "out"
    with early_processes(2, 1, "cpu"):
        (early,) = children() - before
        assert run_with(job, out, workers=2).complete
        assert early in {place["pid"] for place in engines[0].places.values()}
        assert children() <= before
    assert_whole(out, whole)
    with early_processes(2, 2, "cpu"):  # no run takes them
        assert len(children() - before) == 2
    assert children() <= before


@pytest.mark.skipif(not pathlib.Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
@pytest.mark.parametrize("end", ["same names", "interrupt", "killed", "nothing to make"])
def test_no_worker_stays_of_a_plan_that_ends(tmp_path, end):
    changes = {1: {"id": "shot/f0000"}} if end == "same names" else {}
    path, before, seen = write_frames(tmp_path / "job", 3, changes=changes), children(), set()

    def progress(state):
        seen.update(children() - before)
        if end == "interrupt" and state.stage == "check":
            raise KeyboardInterrupt
        if end == "killed" and state.stage == "check":
            for pid in children() - before:
                os.kill(pid, signal.SIGKILL)

    if end == "nothing to make":
        run_with(path, tmp_path / "out", Making)
    ended = {"same names": pytest.raises(ValueError), "interrupt": pytest.raises(KeyboardInterrupt)}
    with ended.get(end, contextlib.nullcontext()):
        assert run_with(path, tmp_path / "out", Making, workers=2, progress=progress).complete
    assert len(seen) >= min(2, cpu_threads()) or end == "same names"
    assert children() <= before


@pytest.mark.scaled
def test_kills_of_workers_cost_nothing(address, job, whole, tmp_path, engines, monkeypatch, at_night):
    """kill -9 of one of two workers, in the middle of an item or before its first, at random moments."""
    monkeypatch.setattr(
        scheduler, "MAX_EARLY_DEATHS", 25
    )  # workers that die by themselves before any item are given up
    out, chance, kills, done = tmp_path / "out", random.Random(), [], threading.Event()
    count = KILLS[at_night]

    def kill():
        while len(kills) < count and not done.is_set():
            time.sleep(chance.uniform(0.0, 0.15))
            places = list(engines[0].places.values()) if engines else []
            pids = [place["pid"] for place in places if place["pid"] not in kills]  # each process once
            if pids:
                kills.append(chance.choice(pids))
                os.kill(kills[-1], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    states = []
    try:
        while len(kills) < count:
            report = run_by(address, job, out, workers=2, retries=20, progress=states.append)
            assert report.complete
            if len(kills) < count:  # there was not enough to do for all: once more from the beginning
                assert_whole(out, whole)
                for path in [*out.rglob("*.png"), out / "manifest.jsonl"]:
                    path.unlink()
                engines.clear()
    finally:
        done.set()
        killer.join()
    assert_whole(out, whole)
    assert len(set(kills)) == count


@pytest.mark.scaled
@RAY_AT_NIGHT
def test_kills_of_the_driver_cost_nothing(address, job, whole, tmp_path, at_night):
    out, chance = tmp_path / "out", random.Random()
    notes, made, kills = out / ".warpcage" / "notes", 0, 0
    while kills < KILLS_OF_DRIVERS[at_night]:
        driver = subprocess.Popen(command_of(address, job, out), stderr=subprocess.PIPE)
        here = made + chance.randint(1, FRAMES // 6)  # so that there is something left for all
        while driver.poll() is None and here > (made := count_of(notes, out)):
            time.sleep(0.003)
        time.sleep(chance.uniform(0.0, 0.03))
        assert driver.poll() is None, driver.stderr.read().decode()
        driver.kill()
        driver.communicate()
        kills += 1
        made = min(count_of(notes, out), FRAMES - 1)
    before = {path: path.stat().st_mtime_ns for path in (out / "shot").glob("*.png")}
    assert run_with(job, out, retries=20).complete
    assert_whole(out, whole)
    again = [path for path, when in before.items() if path.stat().st_mtime_ns != when]
    assert len(again) <= 20  # those that were being written


def count_of(notes, out):
    """Items that are noted as done."""
    files = [*notes.glob("*.jsonl"), out / "manifest.jsonl"] if notes.exists() else []
    found = set()
    for path in files:
        with contextlib.suppress(FileNotFoundError):
            found |= {line.split(b'"')[3] for line in path.read_bytes().splitlines() if b'"done"' in line}
    return len(found)


@RAY_AT_NIGHT
def test_an_item_that_kills_its_worker_is_failed_and_the_rest_is_made(address, job, tmp_path):
    path, out = write_frames(tmp_path / "job", 20), tmp_path / "out"
    lines = []
    report = run_by(address, path, out, Deadly, workers=2, warn=lines.append)
    assert report.made == 19 and list(report.failed) == ["shot/f0005"]
    assert report.failed["shot/f0005"].endswith("killed, or a crash of the process, 3 times while it was made")
    record = records(out)["shot/f0005"]
    reports = about_workers(lines)
    assert record["state"] == "failed" and record["attempts"] == 3 == len(reports) == sum("died" in x for x in reports)


@RAY_AT_NIGHT
def test_errors_are_tried_again_elsewhere(address, tmp_path):
    path, out = write_frames(tmp_path / "job", 20), tmp_path / "out"
    report = run_by(address, path, out, Moody, workers=2, retries=6)
    found = records(out)
    assert sorted(report.failed) == [f"shot/f00{tens}{ones}" for tens in range(2) for ones in (5, 7)]
    assert [found[f"shot/f000{number}"]["attempts"] for number in (2, 7, 5)] == [1, 1, 7]
    assert 3 <= found["shot/f0003"]["attempts"] <= 6  # it fails twice in each process


@RAY_AT_NIGHT
def test_a_straggler_gives_its_rest_to_the_other(address, tmp_path):
    """The first item takes as long as all others."""
    path, out = write_frames(tmp_path / "job", 60), tmp_path / "out"
    assert run_by(address, path, out, Waiting, workers=2).complete
    found = records(out)
    first = found["shot/f0000"]["worker"]
    others = [record["worker"] != first for name, record in found.items() if name != "shot/f0000"]
    assert len(others) == 59 and all(others)


@RAY_AT_NIGHT
@pytest.mark.parametrize("workers, maker", [(None, Endless), pytest.param(2, Unwritten, marks=pytest.mark.nightly)])
def test_an_endless_item_is_failed_and_the_rest_is_made(address, tmp_path, workers, maker):
    """An item that takes long once, by chance, is tried again: more warnings may come, no other failures."""
    path, out, lines = write_frames(tmp_path / "job", 30), tmp_path / "out", []
    report = run_by(address, path, out, maker, workers=workers, retries=1, item_timeout=2, warn=lines.append)
    line = "its worker was ended: the item took longer than 2 s, 2 times while it was made"
    assert report.failed == {"shot/f0005": line} and report.made == 29 and not report.left
    found = records(out)
    assert len(found) == 30 and (found["shot/f0005"]["state"], found["shot/f0005"]["attempts"]) == ("failed", 2)
    reports = about_workers(lines)
    assert len(reports) >= 2 and all("the item took longer than 2 s: it is started again" in each for each in reports)
    assert run_with(path, out, Making).kept == 29
    assert {record["state"] for record in records(out).values()} == {"done"} and left_over(out) == []


@RAY_AT_NIGHT
def test_a_worker_that_answers_no_more_is_ended(address, tmp_path, monkeypatch):
    monkeypatch.setattr("warpcage.studio.jobs.run.ANSWER", 3.0)
    path, out = write_frames(tmp_path / "job", 12), tmp_path / "out"
    report = run_by(address, path, out, Deaf, workers=2, retries=0, item_timeout=2)
    line = "its worker was ended: it did not answer for 3 s, 1 time while it was made"
    assert report.failed == {"shot/f0003": line} and report.made == 11
    assert records(out)["shot/f0003"]["state"] == "failed"


@RAY_AT_NIGHT
@pytest.mark.skipif(not pathlib.Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_ends_the_run(address, tmp_path):
    path, out = write_frames(tmp_path / "job", 60), tmp_path / "out"
    report = run_by(address, path, out, Full, workers=2)
    assert "no space left on device" in report.halt and not report.failed
    # the other worker may have begun with later items, and met the end of the disk before the tenth was made
    assert report.made <= 10 and report.left == 60 - report.made
    assert run_with(path, out, Making).complete and left_over(out) == []


@pytest.mark.nightly
@RAY_AT_NIGHT
def test_workers_that_cannot_start_end_the_run_in_one_line(address, tmp_path):
    path = write_frames(tmp_path / "job", 4)
    with pytest.raises(RuntimeError, match=MESSAGES["batch.no_worker_left"]):
        run_by(address, path, tmp_path / "out", Hostless, workers=2)
    assert run_with(path, tmp_path / "out", Making).complete


@RAY_AT_NIGHT
def test_an_interrupt_keeps_what_is_made(address, job, whole, tmp_path):
    out = tmp_path / "out"
    driver = subprocess.Popen(command_of(address, job, out), stderr=subprocess.PIPE, text=True)
    while driver.poll() is None and count_of(out / ".warpcage" / "notes", out) < 5:
        time.sleep(0.02)
    driver.send_signal(signal.SIGINT)
    said = driver.communicate()[1]
    # A warning that few items need fewer workers may come first, where a start is slow.
    last = said.splitlines()[-1:]
    assert driver.returncode == 130 and last == ["warpcage: interrupted"] and "Traceback" not in said, said
    found = records(out)
    assert 5 <= len(found) == len(pictures(out)) < FRAMES and left_over(out) == []
    assert run_with(job, out).kept == len(found)
    assert_whole(out, whole)


def test_clusters_that_do_not_answer_are_refused(job, tmp_path, capsys):
    """In a process of its own: this one is connected already."""
    pytest.importorskip("ray", reason="clusters need Ray")
    argv = command("run", job, "-o", tmp_path / "out", "--cluster", "127.0.0.1:1", "--quiet")
    done = subprocess.run(argv, capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("warpcage: error: no Ray cluster answers at '127.0.0.1:1'"), done.stderr


@RAY_AT_NIGHT
@pytest.mark.parametrize("device", ["cuda:1", "gpu"])
def test_devices_that_several_workers_cannot_share_are_refused(address, job, tmp_path, device):
    with pytest.raises(ValueError, match=MESSAGES["batch.devices_of_workers"]):
        warpcage.run_jobs(job, tmp_path / "out", workers=2, device=device, cluster=address)


class Nodes:
    """What Ray says about machines."""

    def __init__(self, *resources):
        self.resources = resources

    def nodes(self):
        return [{"Alive": True, "Resources": each} for each in self.resources]

    def remote(self, actor):
        return types.SimpleNamespace(options=lambda **settings: None)


def test_workers_share_the_cores_of_a_cluster():
    two = Nodes({"CPU": 8.0}, {"CPU": 6.0})
    found = [RayHost(two, count, None).share for count in (2, 3, 14, None)]
    assert [(each.cpus, each.workers) for each in found] == [(6, 2), (4, 3), (1, 14), (6, 2)]
    gpus = Nodes({"CPU": 32.0, "GPU": 2.0})
    share = RayHost(gpus, None, None).share
    assert (share.workers, share.gpus, share.threads, share.device) == (2, 1, 16, "cuda:0")
    assert RayHost(gpus, 4, "cpu").share.gpus == 0 and RayHost(gpus, 4, None).share.workers == 4  # more may come


def test_workers_share_this_machine():
    here = LocalHost(2, None, gpus=lambda: 0).share
    assert (here.workers, here.gpus, here.device) == (2, 0, "cpu") and here.threads == max(1, cpu_threads() // 2)
    share = LocalHost(2, None, gpus=lambda: 2).share
    assert (share.workers, share.gpus, share.device) == (2, 1, "cuda:0")
    assert LocalHost(4, "cpu", gpus=lambda: 2).share.gpus == 0
    refused(lambda: LocalHost(4, None, gpus=lambda: 2), match=MESSAGES["batch.as_many_gpus"])
    refused(lambda: LocalHost(2, "cuda", gpus=lambda: 0), match="no GPU that Warp sees")
    alone = LocalHost(1, "cuda:1").share  # the device itself, with all cores
    assert (alone.device, alone.threads) == ("cuda:1", 0)


LOST_NODE = """\
import pathlib, sys, threading, time
sys.path.insert(0, sys.argv[3])
import makers
import ray
import runs
from ray.cluster_utils import Cluster

ray.cloudpickle.register_pickle_by_value(makers)


class Slow(makers.Making):
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
reports = [line for line in lines if "fewer workers are quicker" not in line]
assert len(reports) == 1 and "its worker died" in reports[0], lines
cluster.shutdown()
"""


@pytest.mark.nightly
def test_a_lost_machine_costs_an_item_a_try(tmp_path):
    """Two nodes of a cluster on one machine, one of which is killed with all that runs on it."""
    pytest.importorskip("ray", reason="clusters need Ray")
    path, out = write_frames(tmp_path / "job", 60), tmp_path / "out"
    line = [sys.executable, "-c", LOST_NODE, str(path), str(out), SUPPORT]
    done = subprocess.run(line, capture_output=True, text=True, env=os.environ | OF_RAY)
    assert done.returncode == 0, done.stderr[-3000:]
    found = records(out)
    assert len(found) == 60 and left_over(out) == [] and {each["state"] for each in found.values()} == {"done"}
    assert sum(each["attempts"] > 1 for each in found.values()) <= 1
