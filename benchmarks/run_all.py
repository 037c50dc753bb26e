"""Run every benchmark; with --quick, small versions on the CPU, to see in a few minutes that all of them still run.

    python benchmarks/run_all.py --quick
    python benchmarks/run_all.py --device cuda:0 --data ../shared/data/lego_800 --cage lego_42.obj --out results

Each benchmark is a separate process. Its JSON file and its output go to --out (default: a temporary folder). The exit
status is 1 if one of them fails. Left out are blender_round_trip.py, which needs Blender, editor_servers.py, which
needs servers that warpcage does not use, editor_pictures.py, which makes the pictures of the README, and with --quick
those whose figures mean nothing at a small size (fit_profile.py: CUDA events).
"""

from __future__ import annotations

import argparse
import pathlib
import subprocess
import sys
import tempfile
import time

HERE = pathlib.Path(__file__).resolve().parent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small, on the CPU")
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--data", help="scene folder for the table and the fit; default: the brick model")
    parser.add_argument("--cage", help="42-vertex cage around that scene")
    parser.add_argument("--out", help="folder for results")
    parser.add_argument("--only", nargs="*", help="names of benchmarks, without .py")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        out = pathlib.Path(args.out or temporary)
        out.mkdir(parents=True, exist_ok=True)
        runs = quick_runs(out) if args.quick else full_runs(args, out)
        failed, begin = [], time.perf_counter()
        for name, options in runs.items():
            if args.only and name not in args.only:
                continue
            start = time.perf_counter()
            command = [sys.executable, str(HERE / f"{name}.py"), *map(str, options)]
            with open(out / f"{name}.txt", "w", encoding="utf-8") as log:
                status = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT).returncode
            print(f"{name:16} {'ok' if status == 0 else 'FAILED'} {time.perf_counter() - start:7.1f} s", flush=True)
            if status:
                failed.append(name)
                print((out / f"{name}.txt").read_text(encoding="utf-8")[-3000:])
        print(f"{len(failed)} failed, {time.perf_counter() - begin:.1f} s in all")
    return 1 if failed else 0


def quick_runs(out: pathlib.Path) -> dict[str, list]:
    """Options of each benchmark at a size for a CPU; prepare_quick.py makes the scene that two of them need."""
    scene, field, cage = out / "scene", out / "field.npz", out / "cage.obj"
    return {
        "prepare_quick": [out],
        "capture": [
            "--video",
            "--device",
            "cpu",
            "--width",
            192,
            "--degrees",
            100,
            "--video-frames",
            16,
            "--frames",
            10,
            "--json",
            out / "captures.json",
        ],
        "coordinates": [
            "--device",
            "cpu",
            "--resolution",
            16,
            24,
            "--runs",
            1,
            "--points",
            20000,
            "--json",
            out / "coordinates.json",
        ],
        "convergence": [
            "--device",
            "cpu",
            "--resolution",
            12,
            16,
            "--points",
            30,
            "--cuts",
            2,
            3,
            "--json",
            out / "convergence.json",
        ],
        "fit_curve": [
            "--data",
            scene,
            "--device",
            "cpu",
            "--points",
            1,
            "--option",
            "epochs=1.0",
            "resolution=48",
            "--json",
            out / "fit_curve.json",
        ],
        "deformed_render": [
            "--field",
            field,
            "--cage",
            cage,
            "--device",
            "cpu",
            "--size",
            48,
            "--resolution",
            24,
            "--runs",
            1,
            "--json",
            out / "deformed_render.json",
        ],
        "table1": ["--quick", "--json", out / "table1.json", "--figure", out / "table1.jpg"],
        "ground_truth": ["--quick", "--poses", "bend", "--json", out / "ground_truth.json", "--figures", out],
        "compile": ["--device", "cpu", "--warm-runs", 1, "--json", out / "compile.json"],
        "editor": [
            "--field",
            field,
            "--cage",
            cage,
            "--device",
            "cpu",
            "--size",
            200,
            150,
            "--seconds",
            2,
            "--json",
            out / "editor.json",
        ],
        "every_kernel": ["--device", "cpu"],
        "fit_scenes": [
            *("--kind", "thin", "--views", 8, "--size", 24, "--option", "least_steps=9"),
            *("--worst", out / "worst", "--json", out / "fits.json"),
        ],
        "fits_page": ["--results", out, "--page", out / "fits.md"],
        "captures_page": ["--results", out, "--page", out / "captures.md"],
        "soak": ["--poses", 20, "--fits", 4, "--refused", 200, "--json", out / "soak.json"],
        "page": ["--results", out, "--page", out / "page.md"],
    }


def full_runs(args, out: pathlib.Path) -> dict[str, list]:
    scene = (["--data", args.data] if args.data else []) + (["--cage", args.cage] if args.cage else [])
    runs = {
        "compile": ["--device", args.device, "--json", out / "compile.json"],
        "coordinates": ["--device", args.device, "--json", out / "coordinates.json"],
        "convergence": ["--device", args.device, "--json", out / "convergence.json"],
        "table1": [*scene, "--device", args.device, "--json", out / "table1.json", "--figure", out / "table1.jpg"],
        "ground_truth": ["--device", args.device, "--json", out / "ground_truth.json", "--figures", out],
        "every_kernel": ["--device", args.device],
        "soak": ["--device", args.device, "--json", out / "soak.json", "--figure", out / "soak.svg"],
    }
    if args.data:
        runs["fit_curve"] = ["--data", args.data, "--device", args.device, "--json", out / "fit_curve.json"]
    return runs


if __name__ == "__main__":
    sys.exit(main())
