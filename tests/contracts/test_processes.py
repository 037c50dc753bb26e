"""Threads and processes: pools of processes around warpcage, and its own threads when it is interrupted."""

import _thread
import gc
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused

from warpcage import Cage, PositionMap, deform_points
from warpcage.core import THREADS_VARIABLE, cpu_threads, limit_threads, run_parallel

PROGRAM = """\
import multiprocessing

import numpy as np

from warpcage import Cage, deform_points
from warpcage.core.threads import run_parallel

CAGE = Cage.box((-1, -1, -1), (1, 1, 1), segments=2)
POINTS = np.random.default_rng(0).uniform(-0.9, 0.9, (5000, 3))
TURNS = [10, 20]


def moved(degrees):
    run_parallel([lambda: None] * 4)
    return deform_points(POINTS, CAGE, CAGE.twist(degrees), "mean_value", device="cpu")


def moved_elsewhere(method):
    if method not in multiprocessing.get_all_start_methods():
        return expected
    with multiprocessing.get_context(method).Pool(2 if method == "fork" else 1) as pool:
        return pool.map_async(moved, TURNS).get(timeout=60)


if __name__ == "__main__":
    expected = None
    before = moved_elsewhere("fork")  # this process has loaded no kernel yet
    expected = [moved(degrees) for degrees in TURNS]
    for found in (before or expected, moved_elsewhere("fork"), moved_elsewhere("spawn")):
        assert all(np.array_equal(one, two) for one, two in zip(found, expected, strict=True))
"""


def test_processes_on_a_cpu_compute_what_their_parent_does(tmp_path):
    """By fork, before and after the parent has used kernels, and by spawn."""
    (tmp_path / "program.py").write_text(PROGRAM)
    environment = os.environ | {THREADS_VARIABLE: "2"}
    command = [sys.executable, "program.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True, timeout=240)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def heeds_interrupts():
    """Background jobs of a shell ignore them. Python drops one that comes while it frees garbage of earlier tests."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.collect()
    gc.disable()
    yield
    gc.enable()
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_no_task_goes_on_after_an_interrupt_or_an_error(error, two_threads, heeds_interrupts):
    begun, ended, count = [], [], 4 * cpu_threads()

    def stop():
        if error is KeyboardInterrupt:
            _thread.interrupt_main()
        else:
            raise error

    def work(k):
        begun.append(k)
        time.sleep(0.2)
        ended.append(k)

    with pytest.raises(error):
        run_parallel([stop, *(lambda k=k: work(k) for k in range(count))], threads=2)
        time.sleep(5)  # an interrupt may come late
    assert sorted(begun) == sorted(ended) and len(begun) < count
    assert run_parallel([lambda k=k: k * k for k in range(5)], threads=2) == [0, 1, 4, 9, 16]


@pytest.mark.parametrize("kind", ["harmonic", "mean_value", "green", "maximum_likelihood", "biharmonic"])
def test_launches_over_several_threads_give_the_same_to_the_bit(kind):
    rest = Cage.box((-1, -1, -1), (1, 1, 1), segments=2)
    points = np.random.default_rng(3).uniform(-0.9, 0.9, (500, 3))
    found = []
    for count in (1, 2, 5):
        with limit_threads(count):
            assert cpu_threads() == count
            position_map = PositionMap(rest, coordinates=kind, resolution=16, device="cpu").pose(rest.twist(40))
            found.append(
                [
                    position_map.data.positions.numpy(),
                    position_map.data.distance.numpy(),
                    deform_points(points, rest, rest.bend(30), kind, device="cpu"),
                ]
            )
    for arrays in found[1:]:
        assert all(np.array_equal(one, two) for one, two in zip(arrays, found[0], strict=True))


def test_the_environment_limits_threads(monkeypatch):
    monkeypatch.setenv(THREADS_VARIABLE, "3")
    assert cpu_threads() == 3
    with limit_threads(1):
        assert cpu_threads() == 1
    monkeypatch.setenv(THREADS_VARIABLE, "")
    assert cpu_threads() == os.cpu_count()
    for wrong in ("0", "-1", "many", "1.5"):
        monkeypatch.setenv(THREADS_VARIABLE, wrong)
        refused(cpu_threads, match=MESSAGES["core.threads_variable"].format(wrong=wrong))
