"""`warpcage evaluate`: compare a field with pictures that it was not fitted to."""

from __future__ import annotations

import argparse
import json

from ..core.files import atomic_path
from ..fitting.cameras import tuned_scene
from ..fitting.evaluation import comparison, error_image, evaluation_report, in_world_of
from ..view.pictures import side_by_side, write_png
from . import inputs, options


def run(args: argparse.Namespace) -> None:
    report = None if args.json is None else options.check_output(args.json, (".json",), "report")
    worst = None if args.worst is None else options.check_output(args.worst, (".png",), "picture")
    options.require_folder(args.scene)
    field = inputs.require_voxels(inputs.read_field(args), "evaluate")

    background = field.background if args.background is None else args.background
    scene = inputs.read_scene(args, background)
    scene = in_world_of(field, scene)
    if args.tune_cameras:
        scene = tuned_scene(field, scene)
        print("the poses of these views were fitted to the field: the figures say how good it is, not where they are")
    found = evaluation_report(field, scene, progress=not args.quiet)
    rows, index = found.rows, found.worst
    width = max(len("view"), *(len(row["view"]) for row in rows))
    similarities, masked = found.mean_ssim is not None, found.mean_masked_psnr is not None
    means = {"view": "mean", "psnr": found.mean_psnr, "ssim": found.mean_ssim, "masked_psnr": found.mean_masked_psnr}
    print(f"{'view':{width}}  PSNR dB" + ("    SSIM" if similarities else "") + ("  in mask dB" if masked else ""))
    for row in [*rows, means]:
        print(
            f"{row['view']:{width}}  {row['psnr']:7.2f}"
            + (f"  {row['ssim']:6.4f}" if similarities else "")
            + (f"  {row['masked_psnr']:10.2f}" if row.get("masked_psnr") is not None else "")
        )
    if worst is not None:
        behind, images = comparison(field, scene)
        image, rgb = images[index], field.render(scene.cameras[index], background=behind).rgb
        write_png(worst, side_by_side([image, rgb, error_image(rgb, image)]))
        print(f"wrote {worst}: view {rows[index]['view']}, its picture, the render, and their difference")
    if report is not None:
        content = {
            "field": args.field,
            "scene": args.scene,
            "split": args.split,
            "downscale": args.downscale,
            "tuned_cameras": args.tune_cameras,
            **found.to_json(),
        }
        with atomic_path(report) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
