"""`warpcage fit`: fit a field to pictures."""

from __future__ import annotations

import argparse

from ..core.names import FIT_BACKGROUNDS, counted
from ..fitting.fit import fit
from ..fitting.memory import memory_size
from . import inputs, options


def run(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, (".npz",), "field file")
    checkpoint = None if args.checkpoint is None else options.check_output(args.checkpoint, (".npz",), "checkpoint")
    if args.max_memory is not None:
        args.max_memory = memory_size(args.max_memory)
    options.require_folder(args.scene)
    device = inputs.chosen_device(args)

    is_kind = args.background in FIT_BACKGROUNDS
    kind = args.background if is_kind else "auto"
    colour = "white" if is_kind or args.background is None else args.background
    scene = inputs.read_scene(args, colour, orient="up" if args.straighten else None)
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
