"""Median time of warm, synchronised runs."""

import statistics
import time

import warp as wp


def median_seconds(action, device, *, runs: int = 20, warm: int = 2) -> float:
    """Median wall-clock seconds of action(), with the device idle before and after each run."""
    return median_seconds_by_turns([action], device, runs=runs, warm=warm)[0]


def median_seconds_by_turns(actions, device, *, runs: int = 20, warm: int = 2) -> list[float]:
    """The same for several actions by turns, so that other work on the machine affects all of them."""
    times = [[] for _ in actions]
    for run in range(warm + runs):
        for action, taken in zip(actions, times, strict=True):
            wp.synchronize_device(device)
            begin = time.perf_counter()
            action()
            wp.synchronize_device(device)
            if run >= warm:
                taken.append(time.perf_counter() - begin)
    return [statistics.median(taken) for taken in times]
