"""Random poses drawn by several processes: in threads they wait for each other."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from ..cage.random_poses import RandomPoses

#: Poses that a process gets at once, and that each gets before the next ones are handed out.
AT_ONCE, AHEAD = 4, 256

#: What this process draws.
_drawn: list[RandomPoses] = []


def rows_by_processes(poses: RandomPoses, count: int, processes: int) -> Iterator[np.ndarray]:
    """The vertices (v, 3) float64, world units, of the first poses in their order: those of this process, to the bit.
    Processes are started anew, not copied: a program needs `if __name__ == "__main__":` around what it does."""
    poses.probe  # noqa: B018  (made once, and sent with the poses)
    fresh = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, fresh, initializer=_begin, initargs=(poses,)) as pool:
        step = AHEAD * processes
        for first in range(0, count, step):
            yield from pool.map(_draw, range(first, min(first + step, count)), chunksize=AT_ONCE)


def _begin(poses: RandomPoses) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever started this ends it
    _drawn.append(poses)


def _draw(number: int) -> np.ndarray:
    return _drawn[0].vertices(number)
