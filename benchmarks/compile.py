"""Seconds of a first start: import, first fit step, first pose, first frame, with kernels compiled anew or cached.

    python benchmarks/compile.py --device cpu --json docs/results/compile_cpu.json
    python benchmarks/compile.py --device cuda:0 --json compile_cuda.json

Wall-clock seconds are followed by the processor seconds of all threads, which alone are meaningful on a shared machine.
After the measured stages the process runs the rest (fit, frames of every kind) unmeasured, so that all modules are
seen. Each run is a process with its own kernel cache, empty for the cold run and filled by it for the warm ones
(median). Compiling costs the difference between cold and warm. It should stay below 25 s on a CPU and 10 s on CUDA, and
no module may be compiled twice in one process: Warp's report of each module is read, and counted by name.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time

LIMITS = {"cpu": 25.0, "cuda": 10.0}
UNITS = ("", "_work")  # wall-clock time, and processor time
STAGES = ("import", "first fit step", "first pose", "first frame")
MARK = "-- the rest of the way, not measured --"
REPORT = re.compile(r"Module (\S+) (\w+) load on device '[^']*' took ([\d.]+) ms\s+\((\w+)\)")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--warm-runs", type=int, default=3)
    parser.add_argument("--cache", help="folder for the kernel cache, which is kept; it must be empty at first")
    parser.add_argument("--json")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        return child(args.device)
    with tempfile.TemporaryDirectory() as temporary:
        cache = args.cache or temporary
        cold, modules = run(args.device, cache)
        warm = [run(args.device, cache) for _ in range(args.warm_runs)]
    compiled = collections.Counter(module["name"] for module in modules if module["how"] == "compiled")
    again = [module["name"] for _, loaded in warm for module in loaded if module["how"] == "compiled"]
    twice = sorted(name for name, count in compiled.items() if count > 1)
    rows = [
        {
            "stage": stage,
            **{"cold" + unit: cold[stage + unit] for unit in UNITS},
            **{"warm" + unit: statistics.median(seconds[stage + unit] for seconds, _ in warm) for unit in UNITS},
        }
        for stage in STAGES
    ]
    added, added_work = (sum(row["cold" + unit] - row["warm" + unit] for row in rows) for unit in UNITS)
    limit = LIMITS["cpu" if args.device == "cpu" else "cuda"]
    for row in rows:
        print("{stage:16} cold {cold:7.2f} s (work {cold_work:7.2f} s)   warm {warm:7.2f} s".format(**row))
    print(
        f"compiling adds {added:.2f} s (work {added_work:.2f} s), limit {limit:g} s; {len(compiled)} modules; "
        f"compiled twice: {twice or 'none'}; compiled again when cached: {sorted(set(again)) or 'none'}"
    )
    for module in sorted(modules, key=lambda module: (not module["measured"], -module["seconds"])):
        print(
            f"  {'   ' if module['measured'] else '(+)'} "
            f"  {module['seconds']:7.2f} s  {module['how']:9} {module['name']}"
        )
    if args.json:
        from common import write_results

        write_results(
            args.json,
            args.device,
            rows=rows,
            added=added,
            added_work=added_work,
            load_average=os.getloadavg()[0],
            limit=limit,
            compiled_twice=twice,
            compiled_when_cached=sorted(set(again)),
            modules=modules,
        )
    return 1 if twice or again else 0


def run(device: str, cache: str) -> tuple[dict, list[dict]]:
    """Seconds of the stages in a new process, and the modules that it loaded, in order."""
    environment = os.environ | {"WARP_CACHE_PATH": cache, "PYTHONUNBUFFERED": "1", "WARPCAGE_LOG": "debug"}
    command = [sys.executable, os.path.abspath(__file__), "--child", "--device", device]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the measured process failed:\n{done.stderr}")
    seconds = json.loads(done.stdout.splitlines()[-1])
    modules = [
        {"name": name, "hash": code, "seconds": float(milliseconds) / 1e3, "how": how, "measured": part == 0}
        for part, text in enumerate(done.stdout.split(MARK))
        for name, code, milliseconds, how in REPORT.findall(text)
    ]
    return seconds, modules


def child(device: str) -> int:
    """What a new user does first, on a scene small enough that only the start counts; prints seconds as JSON."""
    seconds, begin, work = {}, time.perf_counter(), time.process_time()

    def stage(name):
        nonlocal begin, work
        if name != "import":
            wp.synchronize_device(device)
        seconds[name], seconds[name + "_work"] = time.perf_counter() - begin, time.process_time() - work
        begin, work = time.perf_counter(), time.process_time()

    import warp as wp

    import warpcage

    wp.init()
    stage("import")
    scene = ball_scene()
    optimizer = warpcage.FieldOptimizer(scene, device=device, resolution=32)
    optimizer.step()
    stage("first fit step")
    rest = warpcage.Cage.icosphere((0, 0, 0), 1.2)
    deformer = warpcage.Deformer(optimizer.field, rest, resolution=32).pose(rest.twist(20))
    stage("first pose")
    deformer.render(scene.cameras[0]).rgb.sum()
    stage("first frame")
    print("\n" + MARK, flush=True)
    while optimizer.step_count < optimizer.total_steps:
        optimizer.step()
    field = optimizer.finish()
    field.render(scene.cameras[0])
    for coordinates in ("mean_value", "green"):
        for resolution in (32, None):
            deformer = warpcage.Deformer(field, rest, coordinates=coordinates, resolution=resolution)
            deformer.pose(rest.twist(20)).render(scene.cameras[0])
    two = [warpcage.CageEdit(rest, keep_source=True), rest]
    warpcage.Deformer(field, two, resolution=32).pose([rest.twist(20), rest]).render(scene.cameras[0])
    print("\n" + json.dumps(seconds))
    return 0


def ball_scene():
    """Pictures of a red ball of radius 0.8, made with NumPy."""
    import numpy as np

    import warpcage

    cameras = warpcage.turntable((0, 0, 0), 4.0, 20, 8, width=32, height=32)
    images, alphas = [], []
    for camera in cameras:
        origins, directions = camera.rays()
        nearest = np.linalg.norm(np.cross(origins, directions), axis=-1)
        alphas.append((nearest < 0.8).astype(np.float32))
        images.append(1 - alphas[-1][..., None] * np.array([0.2, 0.8, 0.8]))
    return warpcage.Scene(images=np.stack(images), alphas=np.stack(alphas), cameras=cameras)


if __name__ == "__main__":
    sys.exit(main())
