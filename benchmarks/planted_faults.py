"""How many faults the tests catch: each is planted in a copy of a checkout, and the tests that should notice it run.

    python benchmarks/planted_faults.py --json faults.json
    python benchmarks/planted_faults.py --tree ../older --only green-sign spz-shift

A fault replaces one piece of text, which must be there once; a tree whose text has changed since names it and ends with
1. A fault is caught where a test fails. Tests are those of the folders named with the fault, stopped at the first
failure, without those that run at night. The exit status is 1 where a fault was not caught.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

ROOT = pathlib.Path(__file__).resolve().parents[1]


class Fault(NamedTuple):
    name: str
    path: str  # of the file
    right: str  # what stands there, once
    wrong: str  # what is planted instead
    tests: str  # folders and files, below tests/


FAULTS = [
    # kernels
    Fault("mean-value-sign", "kernels/coordinates/mean_value.py",
          "cross_q = wp.cross(r, p - r)", "cross_q = wp.cross(p - r, r)", "coordinates"),
    Fault("green-sign", "kernels/coordinates/green.py",
          "area_r * k_r - height * solid_angle))", "area_r * k_r + height * solid_angle))", "coordinates"),
    Fault("mean-value-gradient", "kernels/coordinates/mean_value.py",
          "wp.adjoint[c] += wp.vec3(slopes.r)", "wp.adjoint[c] += wp.vec3(slopes.q)", "coordinates contracts"),
    Fault("line-index", "kernels/lattice/crossings.py",
          "return shape[1] * shape[2] + i * shape[2] + k", "return shape[1] * shape[2] + i * shape[1] + k",
          "lattice coordinates"),
    Fault("gap-side", "kernels/lattice/cage_map.py",
          "        if total[3] < lowest:", "        if total[3] > lowest:", "lattice coordinates deform"),
    Fault("restriction-weight", "kernels/lattice/harmonic.py",
          "total = 4.0 * system.values[center]", "total = 2.0 * system.values[center]", "lattice coordinates"),
    Fault("cell-weight-axis", "kernels/field/grid.py",
          "wz = wp.where(dk == 1, fz, 1.0 - fz)", "wz = wp.where(dk == 1, fx, 1.0 - fz)", "field"),
    Fault("pending-colour", "kernels/field/march.py",
          "looked_up = 1.0 - transmittance - pending", "looked_up = 1.0 - transmittance", "field render deform"),
    Fault("skip-by-one", "kernels/field/march.py",
          "after = first_sample(leave * inverse_step)", "after = first_sample(leave / step) + 1.0", "field render"),
    Fault("depth-clamp", "kernels/field/march.py",
          "return wp.where(opacity > DEPTH_MIN_ALPHA, depth / wp.max(opacity, DEPTH_MIN_ALPHA), wp.inf)",
          "return wp.where(opacity > DEPTH_MIN_ALPHA, depth, wp.inf)", "field render view"),
    Fault("inverse-axis", "kernels/edits/inverse.py", "bit = 4 >> axis", "bit = 1 << axis", "deform render"),
    Fault("march-middle", "kernels/render/march_cpu.h",
          "const float begin = steps_to_sample(ray[8]) * step;", "const float begin = ray[8] * step;", "deform render"),
    Fault("splat-slant", "kernels/splats/project.py", "l1 = -l0 * cr / rr", "l1 = l0 * cr / rr", "splats"),
    Fault("splat-antialias", "kernels/splats/project.py",
          "opacity *= wp.sqrt(sharp / blurred)", "opacity *= sharp / blurred", "splats"),
    Fault("mask-light", "kernels/view/compose.py",
          "mask[name, n] += light * masks[name, nearest_object, n]", "mask[name, n] += masks[name, nearest_object, n]",
          "deform view"),
    Fault("exposure-offset", "kernels/fitting/loss.py",
          "+ rgba[3] * rays.exposures[view, 1]", "+ rays.exposures[view, 1]", "fitting"),
    Fault("moment-decay", "kernels/fitting/rmsprop.py",
          "v = beta * moment + (1.0 - beta) * gradient * gradient", "v = beta * moment + gradient * gradient",
          "fitting"),
    Fault("background-draw", "kernels/fitting/loss.py",
          "random = wp.rand_init(seed + 1, n)", "random = wp.rand_init(seed, n)", "fitting"),
    # files
    Fault("ply-wide-colours", "warpcage/mesh/io/ply.py", '"u2": 65535.0}', '"u2": 255.0}', "mesh scene"),
    Fault("ply-budget", "warpcage/mesh/io/ply.py",
          "require_host_memory(need, f\"{path}: its {count} elements {name!r} need\")", "pass", "contracts mesh cage"),
    Fault("ply-short-list", "warpcage/mesh/io/ply.py", "if len(values) < taken or size == []:", "if size == []:",
          "contracts mesh cage"),
    Fault("spz-shift", "warpcage/splats/io/spz.py", "for shift in (0, 8, 16)]", "for shift in (0, 8, 15)]", "splats"),
    Fault("spz-room", "warpcage/splats/io/spz.py",
          "require_host_memory(_ROOM * size, f\"{path}: its {count} splats of degree {degree} need\")", "pass",
          "splats contracts"),
    Fault("spz-extended", "warpcage/splats/io/spz.py",
          "if extra < 0 or (extra and not flags & _EXTENDED):", "if extra < 0:", "splats"),
    Fault("colmap-rotation", "warpcage/scene/formats/colmap.py",
          "[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],",
          "[2 * (x * z + w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],", "scene"),
    Fault("colmap-no-rotation", "warpcage/scene/formats/colmap.py",
          "if not (np.isfinite(length) and length > 1e-12 and np.isfinite(self.translation).all()):",
          "if not np.isfinite(length):", "scene contracts"),
    Fault("blender-axes", "warpcage/scene/parsing.py",
          "TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])", "TO_OPENCV = np.diag([1.0, -1.0, 1.0, 1.0])", "scene"),
    # poses, films
    Fault("bend-sign", "warpcage/cage/poses.py",
          "start + arc_along + beyond * np.cos(phi) - offset * np.sin(phi)",
          "start + arc_along + beyond * np.cos(phi) + offset * np.sin(phi)", "cage"),
    Fault("smooth-velocity", "warpcage/view/motion.py",
          "value -= length * share * share * (1.0 - share) * velocities.at(index + 1)",
          "value -= length * share * share * (1.0 - share) * velocities.at(index)", "view films"),
    Fault("before-first-key", "warpcage/view/motion.py",
          "return values[max(index, 0)]", "return values[index]", "view films cage"),
    # scheduler and manifest
    Fault("one-try-more", "warpcage/studio/jobs/scheduler.py",
          "if charged is not None and self.attempts[charged] >= self.retries:",
          "if charged is not None and self.attempts[charged] > self.retries:", "jobs"),
    Fault("lost-beside-death", "warpcage/studio/jobs/scheduler.py",
          "self._retries.extend((item, groups[item], \"\") for item in begun[:-1])", "pass", "jobs"),
    Fault("recalled-for-ever", "warpcage/studio/jobs/scheduler.py",
          "worker.recalled = False  # what it still holds may be asked for later", "pass", "jobs"),
    Fault("retry-at-home", "warpcage/studio/jobs/scheduler.py",
          "elsewhere = failed_at != name or len(self._workers) == 1 or failed_at not in self._workers",
          "elsewhere = True", "jobs"),
    Fault("half-line", "warpcage/studio/jobs/manifest.py",
          "    if not line.endswith(b\"\\n\"):\n        return None\n", "", "jobs"),
    Fault("lost-lock", "warpcage/core/threads.py",
          "return threading.RLock() if device.is_cpu else _device_lock(device)",
          "return contextlib.nullcontext() if device.is_cpu else _device_lock(device)", "contracts"),
    # the editor's page
    Fault("page-angle", "warpcage/studio/editor/page/geometry/transform.js",
          ">= 0 ? -wrapped : wrapped;", ">= 0 ? wrapped : -wrapped;", "editor"),
    Fault("page-mirror", "warpcage/studio/editor/page/geometry/transform.js",
          "(k === axis ? -step : step)", "step", "editor"),
    Fault("page-face", "warpcage/studio/editor/page/geometry/pick.js",
          "if (near < least) [best, least] = [f, near];", "if (near > least || best < 0) [best, least] = [f, near];",
          "editor"),
    Fault("page-curve", "warpcage/studio/editor/page/panels/graph.js",
          "3 * (1 - t) * t * ((1 - t) * first + t * second) + t ** 3",
          "3 * (1 - t) * t * (t * first + (1 - t) * second) + t ** 3", "editor"),
]  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tree", type=pathlib.Path, default=ROOT, help="checkout whose tests are tried")
    parser.add_argument("--only", nargs="+", help="names of faults")
    parser.add_argument("--list", action="store_true", help="name them")
    parser.add_argument("--json", type=pathlib.Path, help="write what was caught by which test")
    args = parser.parse_args()
    chosen = [fault for fault in FAULTS if not args.only or fault.name in args.only]
    if args.list:
        print("\n".join(f"{fault.name:20} {fault.path}" for fault in chosen))
        return 0
    gone = [fault.name for fault in chosen if (args.tree / fault.path).read_text("utf-8").count(fault.right) != 1]
    if gone:
        print(f"what these replace is not there once: {' '.join(gone)}", file=sys.stderr)
        return 1
    caught: dict[str, str | None] = {}
    with tempfile.TemporaryDirectory() as temporary:
        copy = pathlib.Path(temporary) / "warpcage-copy"
        names = subprocess.check_output(
            ["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=args.tree, text=True
        )
        for name in filter(None, names.split("\0")):
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(args.tree / name, copy / name, follow_symlinks=False)
        for fault in chosen:
            begin = time.monotonic()
            caught[fault.name] = found = noticed_by(fault, copy)
            print(f"{fault.name:20} {time.monotonic() - begin:6.1f} s  {found or 'NOT CAUGHT'}", flush=True)
            if args.json:
                args.json.write_text(json.dumps(caught, indent=1) + "\n", encoding="utf-8")
    count = sum(each is not None for each in caught.values())
    print(f"{count} of {len(caught)} caught")
    return 0 if count == len(caught) else 1


def noticed_by(fault: Fault, copy: pathlib.Path) -> str | None:
    """The first test that fails with a fault, None where none does."""
    path = copy / fault.path
    right = path.read_text("utf-8")
    path.write_text(right.replace(fault.right, fault.wrong), encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    where = [str(next(copy.glob(f"tests/**/{name}/"))) for name in fault.tests.split()]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-o", f"cache_dir={copy.parent / 'cache'}", *where]
    try:
        done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True)
    finally:
        path.write_text(right, encoding="utf-8")
    failed = [line.split()[1] for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if done.returncode not in (0, 1, 2) or (done.returncode == 2 and not failed):  # 2: stopped by -x
        return f"pytest ended with {done.returncode}: {(failed or [done.stderr.strip()[-200:]])[0]}"
    return failed[0] if failed else None


if __name__ == "__main__":
    sys.exit(main())
