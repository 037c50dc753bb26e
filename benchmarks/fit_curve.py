"""PSNR on held-out views against seconds of fitting.

    python benchmarks/fit_curve.py --data ../shared/data/lego_800 --device cuda:0 --json curve.json
    python benchmarks/fit_curve.py --data ../shared/data/lego_800 --downscale 8 --option footprint=0.7 epochs=16

Clock: from the images in host memory to the finished field, kernels compiled beforehand, evaluations left out.
"""

import argparse
import ast
import json
import time

import numpy as np
import warp as wp

import warpcage
from warpcage.evaluation import evaluate, mean_psnr
from warpcage.optimize import FieldOptimizer


def measure(scene, test, device, points: int, options: dict) -> dict:
    warm_up = FieldOptimizer(scene, device=device, **{**options, "epochs": 1e-3})
    while warm_up.step_count < warm_up.total_steps:
        warm_up.step()
    warm_up.finish()
    del warm_up

    curve, spent, begin = [], 0.0, time.perf_counter()
    optimizer = FieldOptimizer(scene, device=device, **options)
    wp.synchronize_device(device)
    setup = time.perf_counter() - begin
    marks = np.linspace(0, optimizer.total_steps, points + 1)[1:].astype(int)
    for mark in marks:
        while optimizer.step_count < mark:
            optimizer.step()
        wp.synchronize_device(device)
        spent += time.perf_counter() - begin
        curve.append({
            "seconds": round(spent, 3), "steps": optimizer.step_count, "resolution": max(optimizer.field.resolution),
            "voxels": optimizer.field.voxel_count, "psnr": round(mean_psnr(evaluate(optimizer.field, test)), 3),
        })
        print(curve[-1], flush=True)
        begin = time.perf_counter()
    field = optimizer.finish()
    wp.synchronize_device(device)
    spent += time.perf_counter() - begin
    rows = evaluate(field, test)
    camera = test.cameras[0]
    times = []
    for _ in range(8):
        begin = time.perf_counter()
        field.render(camera)
        wp.synchronize_device(device)
        times.append(time.perf_counter() - begin)
    peak = wp.get_mempool_used_mem_high(device) if wp.get_device(device).is_cuda else 0
    return {
        "options": options, "seconds": round(spent, 3), "setup_seconds": round(setup, 3), "psnr": mean_psnr(rows),
        "voxels": field.voxel_count, "resolution": field.resolution, "batch_rays": optimizer.batch_rays,
        "rays_per_second": round(optimizer.total_steps * optimizer.batch_rays / spent),
        "render_milliseconds": round(1e3 * float(np.median(times)), 3), "peak_device_bytes": peak, "curve": curve,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="scene folder with train and test splits")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--device", default=None)
    parser.add_argument("--points", type=int, default=6, help="points on the curve")
    parser.add_argument("--option", nargs="*", action="append", help="FitOptions as name=value; repeat for more runs")
    parser.add_argument("--json", help="file for the results")
    args = parser.parse_args()
    wp.config.quiet = True
    device = warpcage.devices.resolve_device(args.device)
    scene = warpcage.load_scene(args.data, downscale=args.downscale)
    test = warpcage.load_scene(args.data, split="test", downscale=args.downscale)
    results = []
    for run in args.option or [[]]:
        options = {name: ast.literal_eval(value) for name, value in (pair.split("=", 1) for pair in run)}
        print(options, flush=True)
        results.append(measure(scene, test, device, args.points, options))
        print({name: value for name, value in results[-1].items() if name != "curve"}, flush=True)
        if args.json:
            with open(args.json, "w", encoding="utf-8") as file:
                json.dump({"device": device.name, "warp": wp.__version__, "runs": results}, file, indent=1)


if __name__ == "__main__":
    main()
