"""Memory of a long film, and what it costs that its pictures are encoded: beside rendering, and after each frame.

    python benchmarks/film_memory.py --json docs/results/film_memory_cpu.json

*Memory*: films of --frames pictures of 1920x1080 that cost nothing to make, so that the encoder is what all waits for;
resident memory of the process is sampled SAMPLES times from frame WARM on, when the encoder looks as far ahead as it
does. The exit status is 1 where the last samples lie more than GROWTH above the first.

*Time*: --timed pictures, each "rendered" by a wait of as long as its encoding takes alone: a device that works while
the host has nothing to do. Encoded after each frame, a film takes twice as long as its rendering. Figures are ratios
to that rendering alone.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import os
import pathlib
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from results import write_results

import warpcage.view.film as film
from warpcage.core import overlap
from warpcage.core.overlap import Beside, stream
from warpcage.view.pictures import write_png

#: Times that memory is sampled, and frames before the first.
SAMPLES, WARM = 40, 120

#: Samples at both ends that are compared by their means, and megabytes that they may differ by.
ENDS, GROWTH = 5, 48.0

#: Megabytes of a page.
PAGE = os.sysconf("SC_PAGE_SIZE") / 2**20

#: Pictures that are made beforehand, and shown in turn.
PICTURES = 6

KINDS = ("mp4", "png", "mov", "webm")

Write = Callable[[pathlib.Path, Iterable[np.ndarray]], None]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=2000, help="of a film whose memory is watched")
    parser.add_argument("--timed", type=int, default=40, help="frames of a film that is timed")
    parser.add_argument("--size", type=int, nargs=2, default=(1920, 1080), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=["mp4", "png"], help="of films that are watched")
    parser.add_argument("--json")
    args = parser.parse_args()
    pictures = shown_pictures(*args.size)
    memory, times = {}, {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in args.kinds:
            memory[kind] = watched(kind, pictures, args.frames, pathlib.Path(folder))
            first, last = ends(memory[kind]["megabytes"])
            print(f"{kind:5} {args.frames} frames: {first:.0f} to {last:.0f} MB", flush=True)
        for kind in KINDS:
            times[kind] = timed(kind, pictures, args.timed, pathlib.Path(folder))
            after, beside = times[kind]["after_each_frame"], times[kind]["beside"]
            print(f"{kind:5} time of rendering: {after:.2f} encoded after each frame, {beside:.2f} beside", flush=True)
    grown = {kind: ends(found["megabytes"])[1] - ends(found["megabytes"])[0] for kind, found in memory.items()}
    if args.json:
        size = {"width": args.size[0], "height": args.size[1]}
        write_results(args.json, "cpu", size=size, memory=memory, grown_megabytes=grown, limit=GROWTH, times=times)
    return 1 if max(grown.values()) > GROWTH else 0


def shown_pictures(width: int, height: int) -> list[np.ndarray]:
    """(height, width, 3) float32: a shaded ball that moves over a plain ground, with some grain on it."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    grain = np.random.default_rng(0).normal(0.0, 0.02, (height, width, 1)).astype(np.float32)
    made = []
    for index in range(PICTURES):
        u, v = (x - width * (0.4 + 0.03 * index)) / (0.4 * height), (y - height / 2) / (0.4 * height)
        inside = u * u + v * v < 1.0
        shade = np.where(inside, np.sqrt(np.maximum(1.0 - u * u - v * v, 0.0)), 0.0)[..., None]
        picture = np.where(inside[..., None], shade * [1.0, 0.7, 0.4] + grain, 0.93).astype(np.float32)
        picture.flags.writeable = False
        made.append(picture)
    return made


def watched(kind: str, pictures: list[np.ndarray], count: int, folder: pathlib.Path) -> dict:
    """The curve of the process's memory over a film."""
    marks = {int(mark) for mark in np.linspace(min(WARM, count // 2), count - 1, SAMPLES)}
    curve: dict[str, list] = {"frames": [], "megabytes": []}

    def frames() -> Iterator[np.ndarray]:
        for index in range(count):
            if index in marks:
                curve["frames"].append(index)
                curve["megabytes"].append(resident())
            yield pictures[index % PICTURES] + np.float32(0.0)  # an array of its own, as a frame is

    begin = time.perf_counter()
    if kind == "png":
        with Beside() as beside:
            for index, picture in enumerate(frames()):
                # the same few names again and again: what counts is memory, not the disk
                path = folder / f"frame_{index % 64}.png"
                beside.run(functools.partial(write_png, path, picture), picture.nbytes)
    else:
        film.write_film(folder / f"film.{kind}", frames())
    return curve | {"seconds": time.perf_counter() - begin, "threads": threading.active_count()}


def timed(kind: str, pictures: list[np.ndarray], count: int, folder: pathlib.Path) -> dict:
    """How long a film takes, by the time that its rendering takes alone."""
    alone = seconds(kind, rendered(pictures, count, 0.0), folder, in_turn=True) / count
    begin = time.perf_counter()
    for _ in rendered(pictures, count, alone):
        pass
    rendering = time.perf_counter() - begin
    after = seconds(kind, rendered(pictures, count, alone), folder, in_turn=True)
    beside = seconds(kind, rendered(pictures, count, alone), folder, in_turn=False)
    return {
        "encoding_of_a_frame_seconds": alone,
        "after_each_frame": after / rendering,
        "beside": beside / rendering,
        "share_of_encoding_after": 1.0 - rendering / after,
        "share_of_encoding_beside": max(0.0, 1.0 - rendering / beside),
    }


def rendered(pictures: list[np.ndarray], count: int, wait: float) -> Iterator[np.ndarray]:
    for index in range(count):
        time.sleep(wait)
        yield pictures[index % PICTURES]


def seconds(kind: str, frames: Iterable[np.ndarray], folder: pathlib.Path, in_turn: bool) -> float:
    """Time of a film, in one thread or with those of the encoder."""
    begin = time.perf_counter()
    if kind == "png":
        with contextlib.nullcontext() if in_turn else Beside() as beside:
            for index, picture in enumerate(frames):
                task = functools.partial(write_png, folder / f"frame_{index % 64}.png", picture)
                task() if beside is None else beside.run(task, picture.nbytes)
    else:
        overlap.stream = one_after_the_other if in_turn else stream
        try:
            film.write_film(folder / f"film.{kind}", frames)
        finally:
            overlap.stream = stream
    return time.perf_counter() - begin


def one_after_the_other(items, prepare, consume) -> None:
    """What `stream` does, in one thread."""
    consume(map(prepare, items))


def resident() -> float:
    """Megabytes of memory that the process holds."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * PAGE


def ends(values: list[float]) -> tuple[float, float]:
    """Means of the first and of the last values."""
    return float(np.mean(values[:ENDS])), float(np.mean(values[-ENDS:]))


if __name__ == "__main__":
    sys.exit(main())
