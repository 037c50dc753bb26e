"""The full runs of `run_all.py`: what is measured on a machine with GPUs, and how runs are spread over them."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import threading
import time

HERE = pathlib.Path(__file__).resolve().parent


@dataclasses.dataclass(frozen=True)
class Run:
    """A process, whose output goes to a file of its name.

    Args:
        name: Of the run.
        command: Its words.
        seconds: After which it is ended. It is not begun where less time is left.
        gpus: How many it sees. Those that see several run alone.
    """

    name: str
    command: list[str]
    seconds: float = float("inf")
    gpus: int = 1


def full_runs(scenes: pathlib.Path, cage: pathlib.Path | None, out: pathlib.Path) -> list[Run]:
    """The full runs, the most important first.

    Args:
        scenes: Folder that holds lego_800, mic_800, dtu_scan24_half, fox and splats; runs of those that are not there
            are left out.
        cage: Cage around Lego. None leaves out what needs one.
        out: Folder of the results.
    """
    runs: list[Run] = []

    def add(
        name: str, script: str, seconds: float, *options: object, needs: tuple[pathlib.Path, ...] = (), gpus: int = 1
    ):
        if all(each.exists() for each in needs):
            runs.append(Run(name, [sys.executable, str(HERE / f"{script}.py"), *map(str, options)], seconds, gpus))

    def fits(name: str, seconds: float, *options: object, needs: tuple[pathlib.Path, ...] = ()):
        common = ("--device", "cuda:0", "--warm", "--json", out / f"fits_{name}.json", "--worst", out / f"worst_{name}")
        add(f"fits_{name}", "fit_scenes", seconds, *options, *common, needs=needs)

    lego, mic, dtu, fox = (scenes / name for name in ("lego_800", "mic_800", "dtu_scan24_half", "fox"))
    # what must be right before any time counts
    tests = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", "cuda", str(HERE.parent / "tests")]
    runs.append(Run("tests", tests, 420))
    sanitizer = ["compute-sanitizer", "--tool", "memcheck", "--error-exitcode", "9"]
    kernels = [sys.executable, str(HERE / "every_kernel.py"), "--device", "cuda:0", "--no-pool", "--eager"]
    runs.append(Run("memcheck", [*sanitizer, *kernels], 420))
    # fields
    every = ("standard", "fast", "high")  # peaks of memory only rise: that of standard alone is measured
    fits("lego", 160, "--kind", "--folder", lego, "--quality", *every, needs=(lego,))
    fits("mic", 120, "--kind", "--folder", mic, "--quality", *every, needs=(mic,))
    whole = ("--kind", "--room", "--size", 400, "--whole", "--folder", f"{fox}:2", dtu)
    fits("outer", 240, *whole, "--option", "background='outer'", needs=(fox, dtu))
    exact = ("--kind", "--folder", lego, mic, "--refine-cameras")
    fits("refined_exact", 90, *exact, needs=(lego, mic))
    fits("refined_noise", 60, "--kind", "--folder", lego, "--refine-cameras", "--pose-noise", 0.2, needs=(lego,))
    fits("refined_jpeg", 60, "--kind", "--folder", lego, "--refine-cameras", "--jpeg", 90, needs=(lego,))
    # splats
    files = ("--json", out / "splats_times_cuda.json")
    add("splats", "splats", 90, "--device", "cuda:0", *files)
    add("splat_poses", "splat_poses", 60, "--device", "cuda:0", "--json", out / "splat_poses_cuda.json")
    # frames: of a field that a fit of its own makes
    field = out / "lego.npz"
    if lego.exists() and cage is not None:
        words = ["-m", "warpcage", "fit", str(lego), "-o", str(field), "--device", "cuda:0", "--quiet"]
        made = " ".join([sys.executable, *words])
        frames = f"{sys.executable} {HERE / 'deformed_render.py'} --field {field} --cage {cage} --profile"
        wide = f"{frames} --size 1920 1080 --json {out / 'frames_1080p.json'}"
        runs.append(Run("frames", ["bash", "-c", f"{made} && {frames} --json {out / 'frames.json'} && {wide}"], 180))
    fits(
        "others", 120, "--kind", "specular", "bricks", "thin", "textured", "--size", 400, "--folder", dtu, needs=(dtu,)
    )
    fits("fox_high", 240, "--kind", "--folder", f"{fox}:1", "--quality", "high", needs=(fox,))
    for name, option in (("few10", ("--every", 9)), ("few22", ("--every", 4)), ("jpeg", ("--jpeg", 90))):
        fits(name, 40, "--kind", "--folder", lego, *option, needs=(lego,))
    edit = [sys.executable, str(HERE.parent / "examples" / "edit_fox.py"), "--data", str(fox), "--no-video"]
    if fox.exists():
        runs.append(Run("edit_fox", [*edit, "--out", str(out / "fox"), "--device", "cuda:0"], 180))
    # two GPUs
    if lego.exists() and cage is not None:  # of the field that "frames" made
        words = [str(HERE / "batch_gpus.py"), "--field", str(field), "--cage", str(cage), "--scene", str(lego)]
        runs.append(Run("batch_gpus", [sys.executable, *words, "--json", str(out / "batch_gpus.json")], 420, 2))
    add("fit_split", "fit_split", 120, "--data", lego, "--json", out / "fit_split.json", needs=(lego,), gpus=2)
    # the rest
    for name, seconds in (
        ("coordinates", 120),
        ("convergence", 120),
        ("compile", 200),
        ("ground_truth", 200),
        ("soak", 200),
    ):
        files = ("--json", out / f"{name}.json", *(("--figures", out) if name == "ground_truth" else ()))
        add(name, name, seconds, "--device", "cuda:0", *files)
    add("film_memory", "film_memory", 400, "--json", out / "film_memory.json")
    if cage is not None:
        figure = ("--figure", out / "table1.jpg")
        options = ("--data", lego, "--cage", cage, "--device", "cuda:0", "--json", out / "table1.json", *figure)
        add("table1", "table1", 120, *options, needs=(lego,))
    return runs


def run_over_gpus(runs: list[Run], gpus: list[str], seconds: float, out: pathlib.Path) -> int:
    """Run them, one a GPU at a time; those that need several GPUs after the others.

    Args:
        runs: In the order in which they are begun.
        gpus: Numbers of the GPUs, as CUDA_VISIBLE_DEVICES has them. None of them: one run at a time, as it is.
        seconds: When all must have ended.
        out: Folder for their output.

    Returns:
        0, or 1 where a run failed. Those that there was no time for did not fail.
    """
    begin, lock = time.monotonic(), threading.Lock()
    waiting = [run for run in runs if run.gpus <= 1]
    failed: list[str] = []

    def left() -> float:
        return seconds - (time.monotonic() - begin)

    def next_run() -> Run | None:
        with lock:
            chosen = next((run for run in waiting if run.seconds <= left() or left() == float("inf")), None)
            if chosen is not None:
                waiting.remove(chosen)
            return chosen

    def work(gpu: str | None) -> None:
        while (run := next_run()) is not None:
            if not _run(run, [] if gpu is None else [gpu], out):
                failed.append(run.name)

    threads = [threading.Thread(target=work, args=(gpu,)) for gpu in (gpus or [None])]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for run in runs:
        if 1 < run.gpus:
            if run.gpus > len(gpus) or run.seconds > left():
                waiting.append(run)
            elif not _run(run, gpus[: run.gpus], out):
                failed.append(run.name)
    for run in waiting:
        print(f"{run.name:16} left out: no time, or too few GPUs", flush=True)
    print(f"{len(failed)} failed, {time.monotonic() - begin:.1f} s in all")
    return 1 if failed else 0


def _run(run: Run, gpus: list[str], out: pathlib.Path) -> bool:
    """Run one; whether its exit status is 0. What it started ends with it."""
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": ",".join(gpus)} if gpus else None
    start, path = time.monotonic(), out / f"{run.name}.txt"
    if shutil.which(run.command[0]) is None:
        print(f"{run.name:16} FAILED (there is no {run.command[0]})", flush=True)
        return False
    with open(path, "w", encoding="utf-8") as log:
        process = subprocess.Popen(
            run.command, stdout=log, stderr=subprocess.STDOUT, env=environment, start_new_session=True
        )
        try:
            status = process.wait(None if run.seconds == float("inf") else run.seconds)
        except BaseException as error:  # an interrupt too: nothing runs on
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            status = f"ended after {run.seconds:.0f} s"
    word = "ok" if status == 0 else f"FAILED ({status})"
    print(f"{run.name:16} {word} {time.monotonic() - start:7.1f} s", flush=True)
    if status != 0:
        print(path.read_text(encoding="utf-8", errors="replace")[-3000:])
    return status == 0
