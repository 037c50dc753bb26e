"""Run every benchmark; with --quick, small versions of some on the CPU, to see within a minute that they still run.

    python benchmarks/run_all.py --quick
    python benchmarks/run_all.py --quick --all
    python benchmarks/run_all.py --scenes ../shared/data --cage lego_42.obj --gpus 0 1 --seconds 1500 --out results

Each benchmark is a separate process. Its JSON file and its output go to --out (default: a temporary folder). The exit
status is 1 if one of them fails. Quick ones go over the cores of a machine: first what makes the scene, then all
others, then pages of their results; --all adds those that take longer, as they run at night. The full ones go over the
GPUs of a machine, one process a GPU at a time, the most important first; what would not end within --seconds is left
out and named. Left out of --quick are `blender`, which needs Blender, `editor pictures`, which makes pictures of docs,
and `select`, which needs the fox's pictures.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import os
import pathlib
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence

from common import BENCHMARKS, HERE

#: Name of a quick run -> its arguments, at a size for a CPU; "prepare" makes the scene that some of them need. Those
#: that take longest come first, so that none of them is left alone at the end.
QUICK = {
    "prepare": "truth prepare {out}",
    "compile": "compile.py --device cpu --warm-runs 1 --json {out}/compile.json",
    "batch_kills": "batch kills --kills 1 --items 40 --json {out}/kills.json",
    "truth": "truth fields --quick --poses bend --json {out}/ground_truth.json --figures {out}",
    "batch_scale": "batch-scale --items 5_000 --workers 50 --frames 20 --messages 2000 --json {out}/batch_scale.json",
    "table1": "frames table1 --quick --json {out}/table1.json --figure {out}/table1.jpg",
    "splats_truth": "splats-truth --quick --json {out}/splats_truth.json --figures {out}",
    "frames": "frames times {of} --device cpu --size 48 --resolution 24 --runs 1 --poses 3 --json {out}/frames.json",
    "every_kernel": "every_kernel.py --device cpu",
    "growth": "growth measure --quick --device cpu --runs 1 --only frame-edits --json {out}/growth.json",
    "same_bits": "same-bits {tree} --only pose mesh",
    "poses_known": "poses known --quick --json {out}/poses_known.json --figure {out}/poses.jpg",
    "poses_captured": "poses captured --quick --json {out}/poses_captured.json --figure {out}/captured.jpg",
    "coverage": "truth coverage --device cpu --size 40 --test-views 1 --edge 0.4 --json {out}/coverage.json",
    "captures": "captures --video --device cpu --width 192 --degrees 100 --video-frames 16 --frames 10"
    " --json {out}/captures.json",
    "coordinates": "coordinates times --device cpu --resolution 16 24 --runs 1 --points 20000"
    " --json {out}/coordinates.json",
    "cages_generated": "cages generated --scenes thin --counts 42 --resolution 24",
    "cages_shapes": "cages shapes --shapes box --counts 42 --runs 1 --out {out}/shapes",
    "random_cages": "random-cages --count 1 --vertices 12 20 --json {out}/random_cages.json",
    "cages_limbs": "cages limbs --shapes ear --count 42 --samples 200 --json {out}/limbs.json",
    "cages_random_poses": "cages random-poses {of} --count 2 --carried 1 --size 60 --sheet {out}/random.jpg"
    " --json {out}/random_poses.json",
    "lattice_by_size": "coordinates lattice-by-size {of} --sizes 40 --cells 12 --fine 24 --coordinates mean_value"
    " --json {out}/lattice.json",
    "frames_many": "frames many --device cpu --cameras 4 --poses 2 --size 24 --resolution 16 --runs 1"
    " --json {out}/many.json",
    "editor": "editor drags {of} --device cpu --size 200 150 --seconds 2 --json {out}/editor.json",
    "fits_scenes": "fits scenes --kind thin --views 8 --size 24 --option least_steps=9 --worst {out}/worst"
    " --json {out}/fits.json",
    "fits_made": "fits scenes --kind --made corner --views 7 --size 24 --option least_steps=9 --sheet {out}/made.jpg"
    " --json {out}/scenes.json",
    "splat_fits": "splat-fits {scene} --device cpu --quality fast --option steps=30 most_splats=400 --out {out}/s",
    "splats": "splats views --device cpu --count 3000 --sizes 80 --json {out}/splats_times.json",
    "splats_poses": "splats poses --device cpu --kinds mean_value --count 2000 --rounds 2"
    " --json {out}/splat_poses.json",
    "by_turns": "by-turns --other {tree} {of} --size 40 --resolution 16 --runs 2 --most 9 --json {out}/trend.json",
    "soak": "memory soak --poses 20 --fits 4 --refused 200 --json {out}/soak.json",
    "films": "memory films --frames 200 --size 320 180 --json {out}/film_memory.json",
    "batch_memory": "memory batch --items 400 --json {out}/batch_memory.json",
    "page_splats_views": "pages splats-views --results {out} --page {out}/splats_views.md",
    "page_fits": "pages fits --results {out} --page {out}/fits.md",
    "page_fits_of_captures": "pages fits-of-captures --results {out} --page {out}/fits_of_captures.md",
    "page_frames": "pages frames --results {out} --page {out}/frames.md",
    "page_captures": "pages captures --results {out} --page {out}/captures.md",
    "page_batch_scale": "pages batch-scale --results {out} --page {out}/batch_scale.md",
    "page_trends": "pages trends --results {out} --page {out}/trends.md",
    "page_files": "files {out} --device cpu --side 80 --out {out}/files.png",
    "page_results": "pages results --results {out} --page {out}/results.md",
}

#: Of these, those that --quick leaves to --all: what breaks them breaks a test or one of the others too.
LONG = (
    "compile batch_kills truth batch_scale table1 splats_truth every_kernel same_bits coverage captures"
    " cages_generated cages_shapes cages_limbs random_cages cages_random_poses lattice_by_size editor by_turns"
    " poses_known poses_captured batch_memory page_batch_scale page_captures page_trends page_results"
).split()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small, on the CPU: those that take some seconds")
    parser.add_argument("--all", action="store_true", help="with --quick: all of them")
    parser.add_argument("--scenes", type=pathlib.Path, help="folder of lego_800, mic_800, dtu_scan24_half, fox, splats")
    parser.add_argument("--cage", help="cage around Lego, of 42 vertices or so")
    parser.add_argument("--gpus", nargs="+", default=["0"], help="numbers of the GPUs that runs are given to")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="when all must have ended")
    parser.add_argument("--out", help="folder for results")
    parser.add_argument("--only", nargs="*", help="names of runs, as --list says them")
    parser.add_argument("--list", action="store_true", help="say what would be run, and how long it may take")
    args = parser.parse_args()
    if not args.quick and args.scenes is None:
        parser.error("give --quick, or --scenes with the scenes of the full runs")
    with tempfile.TemporaryDirectory() as temporary:
        out = pathlib.Path(args.out or temporary).resolve()
        out.mkdir(parents=True, exist_ok=True)
        if args.quick:
            runs = [Run(name, arguments_of(line, out)) for name, line in QUICK.items() if args.all or name not in LONG]
        else:
            runs = full_runs(args.scenes.resolve(), args.cage and pathlib.Path(args.cage).resolve(), out)
        runs = [run for run in runs if not args.only or run.name in args.only]
        if args.list:
            for run in runs:
                print(f"{run.name:24} {run.seconds:6.0f} s: {' '.join(run.command[1:])}")
            return 0
        if not args.quick:
            return run_over_gpus(runs, args.gpus, args.seconds, out)
        os.environ.setdefault("RAY_worker_niceness", "0")  # Ray's workers would give way to the run on the other core
        cores = [None] * (os.cpu_count() or 1)
        return max(run_over_gpus(list(part), cores, args.seconds, out) for _, part in itertools.groupby(runs, stage))


def stage(run: Run) -> int:
    """Which of the quick runs come first: the one that makes the scene, those that measure, those that write pages."""
    return 0 if run.name == "prepare" else 2 if run.name.startswith("page_") else 1


def arguments_of(line: str, out: pathlib.Path) -> list[str]:
    """The arguments of a quick run, with its folders."""
    of = f"--field {out}/field.npz --cage {out}/cage.obj"
    given = shlex.split(line.format(out=out, scene=out / "scene", of=of, tree=HERE.parent))
    if given[0].endswith(".py"):
        return [sys.executable, str(HERE / given[0]), *given[1:]]
    return [*BENCHMARKS, *given]


@dataclasses.dataclass(frozen=True)
class Run:
    """A process, whose output goes to a file of its name.

    Args:
        name: Of the run.
        command: Its arguments.
        seconds: After which it is ended. It is not begun where less time is left.
    """

    name: str
    command: list[str]
    seconds: float = float("inf")


def full_runs(scenes: pathlib.Path, cage: pathlib.Path | None, out: pathlib.Path) -> list[Run]:
    """The full runs, the most important first.

    Args:
        scenes: Folder that holds lego_800, mic_800, dtu_scan24_half, fox and splats; runs of those that are not there
            are left out.
        cage: Cage around Lego. None leaves out what needs one.
        out: Folder of the results.
    """
    runs: list[Run] = []

    def add(name: str, command: str, seconds: float, *options, needs: tuple[pathlib.Path, ...] = ()):
        if all(each.exists() for each in needs):
            runs.append(Run(name, [*BENCHMARKS, *command.split(), *map(str, options)], seconds))

    def fits(name: str, seconds: float, *options: object, needs: tuple[pathlib.Path, ...] = ()):
        common = ("--device", "cuda:0", "--warm", "--json", out / f"fits_{name}.json", "--worst", out / f"worst_{name}")
        add(f"fits_{name}", "fits scenes", seconds, *options, *common, needs=needs)

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
    add("splats", "splats views", 90, "--device", "cuda:0", *files)
    add("splats_poses", "splats poses", 60, "--device", "cuda:0", "--json", out / "splat_poses_cuda.json")
    # frames: of a field that a fit of its own makes
    field = out / "lego.npz"
    if lego.exists() and cage is not None:
        arguments = ["-m", "warpcage", "fit", str(lego), "-o", str(field), "--device", "cuda:0", "--quiet"]
        made = " ".join([sys.executable, *arguments])
        frames = f"{' '.join(BENCHMARKS)} frames times --field {field} --cage {cage}"
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
    for name, command, seconds in (
        ("coordinates", "coordinates times", 120),
        ("ground_truth", "truth fields", 200),
        ("soak", "memory soak", 200),
    ):
        files = ("--json", out / f"{name}.json", *(("--figures", out) if name == "ground_truth" else ()))
        add(name, command, seconds, "--device", "cuda:0", *files)
    arguments = [str(HERE / "compile.py"), "--device", "cuda:0", "--json", str(out / "compile.json")]
    runs.append(Run("compile", [sys.executable, *arguments], 200))
    add("films", "memory films", 400, "--json", out / "film_memory.json")
    if cage is not None:
        figure = ("--figure", out / "table1.jpg")
        options = ("--data", lego, "--cage", cage, "--device", "cuda:0", "--json", out / "table1.json", *figure)
        add("table1", "frames table1", 120, *options, needs=(lego,))
    return runs


def run_over_gpus(runs: list[Run], gpus: Sequence[str | None], seconds: float, out: pathlib.Path) -> int:
    """Run them, one a GPU at a time.

    Args:
        runs: In the order in which they are begun.
        gpus: Numbers of the GPUs, as CUDA_VISIBLE_DEVICES has them; None is no GPU but a run on the CPU at a time.
        seconds: When all must have ended.
        out: Folder for their output.

    Returns:
        0, or 1 where a run failed. Those that there was no time for did not fail.
    """
    begin, lock = time.monotonic(), threading.Lock()
    waiting = list(runs)
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
            if not _run(run, gpu, out):
                failed.append(run.name)

    threads = [threading.Thread(target=work, args=(gpu,)) for gpu in gpus]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for run in waiting:
        print(f"{run.name:16} left out: no time", flush=True)
    print(f"{len(failed)} failed, {time.monotonic() - begin:.1f} s in all")
    return 1 if failed else 0


def _run(run: Run, gpu: str | None, out: pathlib.Path) -> bool:
    """Run one; whether its exit status is 0. What it started ends with it."""
    environment = None if gpu is None else {**os.environ, "CUDA_VISIBLE_DEVICES": gpu}
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


if __name__ == "__main__":
    sys.exit(main())
