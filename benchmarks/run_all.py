"""Run every benchmark; with --quick, small versions on the CPU, to see in a few minutes that all of them still run.

    python benchmarks/run_all.py --quick
    python benchmarks/run_all.py --scenes ../shared/data --cage lego_42.obj --gpus 0 1 --seconds 1500 --out results

Each benchmark is a separate process. Its JSON file and its output go to --out (default: a temporary folder). The exit
status is 1 if one of them fails. The full ones (`full_runs.py`) go over the GPUs of a machine, one process a GPU at a
time, the most important first; what would not end within --seconds is left out and named. Left out of --quick are
blender_round_trip.py, which needs Blender, editor_servers.py, which needs servers that warpcage does not use,
editor_pictures.py, which makes the pictures of the README, select_page.py, which needs the fox's pictures, and those
whose figures mean nothing at a small size (fit_profile.py and fit_split.py: CUDA events).
"""

from __future__ import annotations

import argparse
import pathlib
import sys
import tempfile

from full_runs import Run, full_runs, run_over_gpus

HERE = pathlib.Path(__file__).resolve().parent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small, on the CPU")
    parser.add_argument("--scenes", type=pathlib.Path, help="folder of lego_800, mic_800, dtu_scan24_half, fox, splats")
    parser.add_argument("--cage", help="cage around Lego, of 42 vertices or so")
    parser.add_argument("--gpus", nargs="+", default=["0"], help="numbers of the GPUs that runs are given to")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="when all must have ended")
    parser.add_argument("--out", help="folder for results")
    parser.add_argument("--only", nargs="*", help="names of benchmarks, without .py")
    parser.add_argument("--list", action="store_true", help="say what would be run, and how long it may take")
    args = parser.parse_args()
    if not args.quick and args.scenes is None:
        parser.error("give --quick, or --scenes with the scenes of the full runs")
    with tempfile.TemporaryDirectory() as temporary:
        out = pathlib.Path(args.out or temporary).resolve()
        out.mkdir(parents=True, exist_ok=True)
        if args.quick:
            runs = [
                Run(name, [sys.executable, str(HERE / f"{name}.py"), *map(str, options)])
                for name, options in quick_runs(out).items()
            ]
        else:
            runs = full_runs(args.scenes.resolve(), args.cage and pathlib.Path(args.cage).resolve(), out)
        runs = [run for run in runs if not args.only or run.name in args.only]
        if args.list:
            for run in runs:
                print(f"{run.name:24} {run.seconds:6.0f} s, {run.gpus} GPU: {' '.join(run.command[1:])}")
            return 0
        return run_over_gpus(runs, [] if args.quick else args.gpus, args.seconds, out)


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
            out / "frames.json",
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
        "splats": ["--device", "cpu", "--count", 3000, "--sizes", 80, "--json", out / "splats_times.json"],
        "splat_poses": [
            *("--device", "cpu", "--kinds", "mean_value", "--count", 2000, "--rounds", 2),
            *("--json", out / "splat_poses.json"),
        ],
        "splats_truth": ["--quick", "--json", out / "splats_truth.json", "--figures", out],
        "splats_page": ["--results", out, "--page", out / "splats.md"],
        "fits_page": ["--results", out, "--page", out / "fits.md"],
        "frames_page": ["--results", out, "--page", out / "frames.md"],
        "captures_page": ["--results", out, "--page", out / "captures.md"],
        "soak": ["--poses", 20, "--fits", 4, "--refused", 200, "--json", out / "soak.json"],
        "film_memory": ["--frames", 200, "--timed", 8, "--size", 320, 180, "--json", out / "film_memory.json"],
        "batch_scale": [
            *("--items", 20_000, "--workers", 50, "--frames", 20, "--messages", 2000),
            *("--json", out / "batch_scale.json", "--page", out / "batch_scale.md"),
        ],
        "batch_gpus": [
            *("--field", field, "--cage", cage, "--scene", scene, "--frames", 12, "--size", 48, "--fits", 2),
            *("--downscale", 4, "--workers", 1, 2, "--device", "cpu", "--json", out / "batch_gpus.json"),
        ],
        "batch_handing_out": ["--items", 120, "--turns", 1, "--megabytes", 8, "--json", out / "handing_out.json"],
        "batch_memory": ["--items", 200, "--json", out / "batch_memory.json"],
        "page": ["--results", out, "--page", out / "page.md"],
    }


if __name__ == "__main__":
    sys.exit(main())
