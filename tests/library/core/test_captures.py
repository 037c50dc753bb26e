"""Captures of CUDA graphs beside garbage collections of other threads."""

import gc
import threading

import numpy as np
import pytest
import warp as wp

from warpcage.core.devices import captured
from warpcage.core.threads import collector_lock


def test_collections_of_other_threads_wait_until_the_lock_is_free():
    collected = threading.Event()
    other = threading.Thread(target=lambda: (gc.collect(), collected.set()))
    with collector_lock():
        gc.collect()  # this thread's own does not wait
        other.start()
        assert not collected.wait(0.2)
    assert collected.wait(10)
    other.join()


def test_a_collection_that_waits_too_long_goes_on(monkeypatch):
    monkeypatch.setattr("warpcage.core.threads.MAX_COLLECTION_WAIT", 0.05)
    collected = threading.Event()
    with collector_lock():
        threading.Thread(target=lambda: (gc.collect(), collected.set())).start()
        assert collected.wait(10)


def test_arrays_that_another_thread_collects_break_no_capture(device):
    """Without the lock some of these captures fail: Warp frees arrays on the stream that must not wait then."""
    if device == "cpu":
        pytest.skip("CUDA alone has a stream that must not wait")
    ended, values = threading.Event(), wp.zeros(1000, dtype=float, device=device)

    def collect():
        while not ended.is_set():
            for _ in range(50):
                ring = [wp.empty(1000, dtype=float, device=device)]
                ring.append(ring)
            del ring
            gc.collect()

    other = threading.Thread(target=collect)
    other.start()
    try:
        for _ in range(500):
            with captured(values.device) as capture:
                values.fill_(2.0)
            wp.capture_launch(capture.graph)
    finally:
        ended.set()
        other.join()
    assert np.all(values.numpy() == 2.0)
