"""The lock of captures of CUDA graphs, and garbage collections of other threads."""

import gc
import threading

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
