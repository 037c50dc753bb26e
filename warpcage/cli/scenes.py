"""`warpcage capture`, `fit` and `evaluate`: from pictures to fields, and how good they are."""

from __future__ import annotations

import argparse
import json

from ..captures.capture import capture
from ..core.files import atomic_path
from ..core.names import FIT_BACKGROUNDS, counted
from ..fitting.cameras import tuned_scene
from ..fitting.evaluation import comparison, error_image, evaluation_report, in_world_of
from ..fitting.fit import fit
from ..fitting.memory import memory_size
from ..view.pictures import side_by_side, write_png
from . import shared
from .arguments import options


def run_capture(args: argparse.Namespace) -> None:
    report = capture(
        args.source,
        args.output,
        frames=args.frames,
        feature_size=args.feature_size,
        seed=args.seed,
        progress=not args.quiet,
    )
    print(f"wrote {args.output}: {report.summary()}")
    for sentence in report.advice:
        print(f"  {sentence}")


def run_evaluate(args: argparse.Namespace) -> None:
    report = None if args.json is None else options.check_output(args.json, (".json",), "report")
    worst = None if args.worst is None else options.check_output(args.worst, (".png",), "picture")
    options.require_folder(args.scene)
    field = shared.require_voxels(shared.read_field(args), "evaluate")

    background = field.background if args.background is None else args.background
    scene = shared.read_scene(args, background)
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


def run_fit(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, (".npz",), "field file")
    checkpoint = None if args.checkpoint is None else options.check_output(args.checkpoint, (".npz",), "checkpoint")
    if args.max_memory is not None:
        args.max_memory = memory_size(args.max_memory)
    options.require_folder(args.scene)
    device = shared.chosen_device(args)

    is_kind = args.background in FIT_BACKGROUNDS
    kind = args.background if is_kind else "auto"
    color = "white" if is_kind or args.background is None else args.background
    scene = shared.read_scene(args, color, orient="up" if args.straighten else None)
    names = ("resolution", "epochs", "variation", "max_memory")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if args.bounds is not None:
        given["bounds"] = [args.bounds[:3], args.bounds[3:]]
    field = fit(
        scene,
        quality=args.quality,
        device=device,
        seed=args.seed,
        progress=not args.quiet,
        background=kind,
        checkpoint=checkpoint,
        checkpoint_seconds=args.checkpoint_seconds,
        refine_cameras=args.refine_cameras,
        **given,
    )
    field.save(output)
    if field.refined_cameras is not None:
        beside = field.refined_cameras.save(output.with_suffix(".cameras.json"))
        print(f"wrote {beside}: {counted(len(field.refined_cameras), 'refined camera')}")
    size = "x".join(str(n) for n in field.resolution)
    behind = "" if field.background_model is None else f", {field.background_model.summary}"
    print(
        f"wrote {output}: {counted(field.voxel_count, 'voxel')} in a grid of {size}{behind}, "
        f"{output.stat().st_size / 1e6:.1f} MB"
    )
