"""Median of warm, synchronised runs."""

import statistics
import time

import warp as wp


def median_seconds(action, device, *, runs: int = 20, warm: int = 2) -> float:
    """Median wall-clock seconds of action(), the device idle before and after each."""
    for _ in range(warm):
        action()
    times = []
    for _ in range(runs):
        wp.synchronize_device(device)
        begin = time.perf_counter()
        action()
        wp.synchronize_device(device)
        times.append(time.perf_counter() - begin)
    return statistics.median(times)
