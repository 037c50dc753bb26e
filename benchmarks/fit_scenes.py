"""How the defaults of a fit do on scenes of several kinds: PSNR on held-out views, seconds, voxels.

    python benchmarks/fit_scenes.py --size 100 --json scenes.json
    python benchmarks/fit_scenes.py --kind "20 views" thin --size 200 --views 60 --option epochs=16
    python benchmarks/fit_scenes.py --kind --data ../shared/data/lego_800 --every 4 --downscale 8

Seconds run from images in host memory to the finished field; the first scene's hold the compilation of kernels that are
not in Warp's cache yet.
"""

import argparse
import ast
import json
import platform
import time

import warp as wp

import warpcage
from warpcage.fitting.evaluation import evaluate, mean_psnr
from warpcage.reference.fit_scenes import KINDS, synthetic_scene


def measure(name, scene, test, device, options: dict) -> dict:
    begin = time.perf_counter()
    field = warpcage.fit(scene, device=device, progress=False, **options)
    wp.synchronize_device(device)
    seconds = time.perf_counter() - begin
    return {
        "scene": name,
        "views": len(scene),
        "size": scene.images.shape[1],
        "options": options,
        "psnr": mean_psnr(evaluate(field, test)),
        "psnr_training": mean_psnr(evaluate(field, scene)),
        "seconds": seconds,
        "voxels": field.voxel_count,
        "resolution": field.resolution,
    }


def every_nth(scene, n: int):
    """Every n-th view of a scene, from the first."""
    alphas = None if scene.alphas is None else scene.alphas[::n]
    return warpcage.Scene(scene.images[::n], alphas, scene.cameras[::n], scene.background, scene.names[::n])


def without_alphas(scene):
    return warpcage.Scene(scene.images, None, scene.cameras, scene.background, scene.names)


def scenes_of(args, device):
    """(name, training views, test views) one after another."""
    for kind in args.kind:
        train, test = synthetic_scene(
            kind, train_views=args.views, size=args.size, alpha=not args.opaque, device=device
        )
        yield kind, train, test
    if args.data:
        train, test = (
            warpcage.load_scene(args.data, split=split, downscale=args.downscale) for split in ("train", "test")
        )
        if args.opaque:
            train = without_alphas(train)
        yield f"{args.data}, every {args.every}.", every_nth(train, args.every), test


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", nargs="*", choices=list(KINDS), default=list(KINDS), help="which of our own scenes")
    parser.add_argument("--views", type=int, default=60, help="training views, of the kinds that do not fix it")
    parser.add_argument("--size", type=int, default=100, help="pixels a side")
    parser.add_argument("--opaque", action="store_true", help="leave the alphas out")
    parser.add_argument("--data", help="one more scene: a folder with train and test splits")
    parser.add_argument("--downscale", type=int, default=8, help="of --data")
    parser.add_argument("--every", type=int, default=4, help="take every n-th training view of --data")
    parser.add_argument("--device", default=None)
    parser.add_argument("--option", nargs="*", default=[], help="FitOptions as name=value")
    parser.add_argument("--json", help="file for the results")
    args = parser.parse_args()
    device = warpcage.core.devices.resolve_device(args.device)
    options = {name: ast.literal_eval(value) for name, value in (pair.split("=", 1) for pair in args.option)}
    results = []
    print(f"{'scene':32} views  PSNR dB  training  seconds    voxels  resolution")
    for name, scene, test in scenes_of(args, device):
        row = measure(name, scene, test, device, options)
        results.append(row)
        size = "x".join(str(n) for n in row["resolution"])
        print(
            f"{name[-32:]:32} {row['views']:5d}  {row['psnr']:7.2f}  {row['psnr_training']:8.2f}"
            f"  {row['seconds']:7.1f}  {row['voxels']:8d}  {size}",
            flush=True,
        )
        if args.json:
            with open(args.json, "w", encoding="utf-8") as file:
                content = {"device": device.name or platform.processor(), "warp": wp.__version__, "runs": results}
                json.dump(content, file, indent=1)


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_WARNING
    main()
