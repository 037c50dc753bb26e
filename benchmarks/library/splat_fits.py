"""Fits of splats: held-out PSNR and SSIM, seconds, splats, memory, time of a frame."""

from __future__ import annotations

import dataclasses
import itertools
import pathlib
import time

import numpy as np
import warp as wp
from common import DEVICE, FIT_OPTIONS, command, fit_options, option, quiet_device, write_results
from library.fits import QUALITIES, every_nth, memory_peak
from library.splats import times_by_turns

import warpcage
from warpcage.fitting.evaluation import ssim
from warpcage.fitting.splats import checked_splat_options
from warpcage.splats.io.contents import MIN_OPACITY

#: Views, and factor on their size and on the number of points, of the fit that compiles kernels.
WARM_VIEWS, WARM_SHRINK = 8, 8

#: Frames that are timed.
FRAMES = 60

HEAD = "scene            quality   seed  steps   splats  seconds      MB  PSNR dB  worst    SSIM  ms a frame"


@command(
    option("scene", nargs="+", help="scene folders, each FOLDER or FOLDER:DOWNSCALE"),
    option("--whole", action="store_true", help="whole pictures, whatever masks a scene has"),
    option("--background", default="black", help="color behind transparent pixels, and behind the splats"),
    option("--quality", nargs="+", default=["standard"], choices=QUALITIES),
    option("--seeds", type=int, nargs="+", default=[0], help="a fit of each"),
    FIT_OPTIONS,
    DEVICE,
    option("--save", action="store_true", help="keep the splats, as .ply"),
    option("--out", type=pathlib.Path, default=pathlib.Path("splat_fits"), help="folder for results and splats"),
)
def main(args) -> None:
    """Fits of splats: held-out PSNR and SSIM, seconds, splats, memory, time of a frame.

        python benchmarks splat-fits ../shared/data/bonsai --quality fast standard high --seeds 0 1 2
        python benchmarks splat-fits SCENE:2 --option NAME=VALUE --device cuda:0 --out results --save

    Every eighth picture by name is held out where a scene has no splits of its own. Seconds run from pictures in host
    memory to the finished splats; loading the pictures, and a small fit that compiles the kernels, come before.
    "memory" is the most that Warp's arrays have held on the GPU from the start of the process to the end of the fit,
    "memory_before" the same up to its begin: where the first is larger, it is the peak of this fit. Frames have the
    size of the pictures.
    """
    device, options, rows, compiled = quiet_device(args.device), fit_options(args.option), [], None
    print(HEAD)
    for given in args.scene:
        stem, train, test, facts = loaded(given, args)
        if compiled is None:
            compiled = seconds_of_fit(warm_scene(train), device, {"quality": "fast", **options})[0]
        for quality, seed in itertools.product(args.quality, args.seeds):
            chosen, before = {"quality": quality, "seed": seed, **options}, memory_peak(device)
            seconds, field = seconds_of_fit(train, device, chosen)
            row = facts | {
                "quality": quality,
                "seed": seed,
                "options": chosen,
                "steps": checked_splat_options({"quality": quality, **options}).steps,
                "compile_seconds": compiled,
                "seconds": seconds,
                "memory": memory_peak(device),
                "memory_before": before,
                "splats": len(field),
                "splats_seen": int((field.opacities >= MIN_OPACITY).sum()),
            }
            rows.append(row | scores(field, test, device))
            print(line(rows[-1]), flush=True)
            write_results(args.out / "splat_fits_ours.json", device, rows=rows)
            if args.save:
                field.save(args.out / f"{stem}_{quality}_{seed}.ply")


def line(row: dict) -> str:
    megabytes = "      -" if row["memory"] is None else f"{row['memory'] / 1e6:7.0f}"
    return (
        f"{row['scene'][-16:]:16} {row['quality']:8} {row['seed']:5d} {row['steps']:6d} {row['splats']:8d} "
        f"{row['seconds']:8.2f} {megabytes} {row['psnr']:8.2f} {row['psnr_worst']:6.2f} {row['ssim']:7.4f} "
        f"{row['frame_ms']:11.3f}"
    )


def seconds_of_fit(scene: warpcage.Scene, device, options: dict) -> tuple[float, warpcage.SplatField]:
    """Seconds of one fit, and its splats."""
    wp.synchronize_device(device)
    begin = time.perf_counter()
    field = warpcage.fit(scene, representation="splats", device=device, progress=False, **options)
    wp.synchronize_device(device)
    return time.perf_counter() - begin, field


def loaded(given: str, args) -> tuple[str, warpcage.Scene, warpcage.Scene, dict]:
    """Stem of file names, training views, held-out views and facts of a scene, FOLDER or FOLDER:DOWNSCALE."""
    folder, _, factor = given.partition(":")
    options = {"downscale": int(factor or 1), "background": args.background, "masks": not args.whole}
    begin = time.perf_counter()
    train, test = (warpcage.load_scene(folder, split=split, **options) for split in ("train", "test"))
    name = pathlib.Path(folder).resolve().name
    facts = {
        "scene": name + (f", 1/{factor}" if factor else ""),
        "views": len(train),
        "held_out": len(test),
        "size": train.images.shape[2:0:-1],
        "points": 0 if train.points is None else len(train.points),
        "load_seconds": time.perf_counter() - begin,
    }
    return f"{name}_{factor}" if factor else name, train, test, facts


def warm_scene(scene: warpcage.Scene) -> warpcage.Scene:
    """A few views of a scene, small, with few of its points."""
    few = every_nth(scene, max(1, len(scene) // WARM_VIEWS))
    height, width = (max(16, side // WARM_SHRINK) for side in few.images.shape[1:3])
    rows, columns = (
        np.arange(side) * full // side for side, full in zip((height, width), few.images.shape[1:3], strict=True)
    )
    parts = {"images": few.images, "alphas": few.alphas, "surroundings": few.surroundings}
    small = {name: None if part is None else part[:, rows][:, :, columns] for name, part in parts.items()}
    for name in ("points", "point_colors"):
        if getattr(scene, name) is not None:
            small[name] = getattr(scene, name)[::WARM_SHRINK]
    return dataclasses.replace(few, cameras=[camera.resized(width, height) for camera in few.cameras], **small)


def scores(field: warpcage.SplatField, test: warpcage.Scene, device) -> dict:
    """PSNR and structural similarity on held-out views, and the time of a frame of their size."""
    rows = []
    for name, camera, image in zip(test.names, test.cameras, test.images, strict=True):
        rgb = field.render(camera, background=test.background).rgb
        rows.append({"view": name, "psnr": warpcage.psnr(rgb, image), "ssim": ssim(rgb, image)})
    worst = min(rows, key=lambda row: row["psnr"])
    cameras = itertools.cycle(test.cameras)
    times = times_by_turns({"ms": lambda: field.render(next(cameras), background=test.background)}, device, FRAMES)
    return {
        "psnr": warpcage.mean_psnr(rows),
        "psnr_worst": worst["psnr"],
        "worst_view": worst["view"],
        "ssim": float(np.mean([row["ssim"] for row in rows])),
        "frame_ms": float(np.median(times["ms"])),
    }
