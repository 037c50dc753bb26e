"""`warpcage capture`, `fit`, `fit-pose` and `evaluate`: from pictures to fields and poses, and how good they are."""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib

from ...core.files import atomic_path
from ...core.names import FIT_BACKGROUNDS, counted
from ...core.spec import names_of, options_of
from ...deform.deformer import Deformer
from ...edits.edits import MAX_CELLS
from ...errors import InputError
from ...field.voxel_field import VoxelField
from ...fitting.cameras import tuned_scene
from ...fitting.evaluation import (
    comparison,
    error_image,
    evaluation_report,
    in_world_of,
    moved_scene,
    refined_cameras_of,
)
from ...fitting.fit import fit
from ...fitting.memory import memory_size
from ...mesh.io.formats import mesh_endings
from ...pose_fits.fit import fit_pose
from ...pose_fits.targets import PoseTargets
from ...render.belonging import SceneViews
from ...scene.formats.datasets.splatting import is_output
from ...scene.load import load_scene
from ...splats.io.formats import endings_written
from ...splats.splat_field import SplatField
from ...view.pictures import side_by_side, write_png
from ..captures.capture import capture
from ..films.render import require_voxels
from ..spec.scene import SPLAT_FIT, VOXEL_FIT, FitSpec
from . import shared
from .arguments import options
from .cameras import asset_resolver


def run_capture(args: argparse.Namespace) -> None:
    given = {name: getattr(args, name) for name in "pictures masks turntable frames feature_size seed".split()}
    report = capture(args.source, args.output, **given, progress=not args.quiet)
    print(f"wrote {args.output}: {report.summary()}")
    for sentence in report.advice:
        print(f"  {sentence}")
    print(f"  warpcage fit {args.output} -o place.ply makes splats of it: best for whole captures")


def run_evaluate(args: argparse.Namespace) -> None:
    report = None if args.json is None else options.check_output(args.json, (".json",), "report")
    worst = None if args.worst is None else options.check_output(args.worst, (".png",), "picture")
    if args.scene is None:
        if not is_output(pathlib.Path(args.field)):
            raise InputError("give the folder of the scene: only output folders of 3D Gaussian Splatting name theirs")
        args.scene = args.field
    options.require_folder(args.scene)
    field = shared.read_field_file(args)

    background = field.background if args.background is None else args.background
    scene = shared.read_scene(args, background)
    field = shared.in_world_of_scene(args, field, (pathlib.Path(args.scene), SceneViews.of(scene)))
    scene, given = in_world_of(field, scene), None
    if args.tune_cameras:
        scene = tuned_scene(require_voxels(field, "--tune-cameras"), scene)
        print("cameras were fitted to the field first: the figures rate the field, not the cameras")
    elif refined_cameras_of(field) is not None and not args.given_cameras:
        scene, given = moved_scene(field, scene), scene
        print("cameras were moved as the refined ones near them were, without a look at their pictures")
    found = evaluation_report(field, scene, given=given, progress=not args.quiet)
    rows, index = found.rows, scene.names.index(found.rows[found.worst]["view"])
    width = max(len("view"), *(len(row["view"]) for row in rows))
    similarities, masked = found.mean_ssim is not None, found.mean_masked_psnr is not None
    means = {"view": "mean", "psnr": found.mean_psnr, "ssim": found.mean_ssim, "masked_psnr": found.mean_masked_psnr}
    print(f"{'view':{width}}  PSNR dB" + ("    SSIM" if similarities else "") + ("  in mask dB" if masked else ""))
    for row in [*rows, means]:
        print(
            f"{row['view']:{width}}  {row['psnr']:7.2f}"
            + (f"  {row['ssim']:6.4f}" if row.get("ssim") is not None else " " * 8 * similarities)
            + (f"  {row['masked_psnr']:10.2f}" if row.get("masked_psnr") is not None else "")
        )
    if found.given_psnr is not None:
        print(f"with the cameras as they were given the mean is {found.given_psnr:.2f} dB")
    if worst is not None:
        behind, images = comparison(field, scene)
        rgb = field.render(scene.cameras[index], background=behind).rgb
        image = scene.cut(index, images[index])
        write_png(worst, side_by_side([image, rgb, error_image(rgb, image)]))
        print(f"wrote {worst}: view {scene.names[index]}, its picture, the render, and their difference")
    if report is not None:
        content = {name: getattr(args, name) for name in ("field", "scene", "split", "downscale")}
        content |= {"tuned_cameras": args.tune_cameras, **found.to_json()}
        with atomic_path(report) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


#: Options of `warpcage fit` that only one kind of field has.
VOXEL_OPTIONS = (*names_of(FitSpec, VOXEL_FIT), "bounds", "refine_cameras", "check_cameras")
SPLAT_OPTIONS = names_of(FitSpec, SPLAT_FIT)


def run_fit(args: argparse.Namespace) -> None:
    kind, endings = args.representation, endings_written()
    if kind is None:
        kind = "splats" if args.output.lower().endswith(endings) else "voxels"
    output = options.check_output(args.output, endings if kind == "splats" else (".npz",), "field file")
    checkpoint = None if args.checkpoint is None else options.check_output(args.checkpoint, (".npz",), "checkpoint")
    preview = None if args.preview is None else options.check_output(args.preview, (".png",), "picture")
    for name in VOXEL_OPTIONS if kind == "splats" else SPLAT_OPTIONS:
        if getattr(args, name):
            raise InputError(f"--{name.replace('_', '-')} is not for fits of {kind}")
    if args.max_memory is not None:
        args.max_memory = memory_size(args.max_memory)
    options.require_folder(args.scene)
    device = shared.chosen_device(args)

    names_behind = args.background in FIT_BACKGROUNDS
    if kind == "splats" and args.background in ("outer", "layers"):
        raise InputError(f"--background {args.background} is for voxels: splats reach as far as the pictures do")
    behind = args.background if names_behind else "auto"
    color = "white" if names_behind or args.background is None else args.background
    scene = shared.read_scene(args, color, orient="up" if args.straighten else None)
    names = (*options_of(FitSpec), "refine_cameras", "checkpoint_seconds")
    given = {name: getattr(args, name) for name in names if getattr(args, name)}
    given |= {"checkpoint": checkpoint, "preview": preview, "device": device, "progress": not args.quiet}
    if args.check_cameras:
        given["refine_cameras"] = "auto"
    if args.bounds is not None:
        given["bounds"] = [args.bounds[:3], args.bounds[3:]]
    field = fit(scene, representation=kind, background=behind, **given)
    field.save(output)
    if isinstance(field, VoxelField) and field.refined_cameras is not None:
        beside = field.refined_cameras.save(output.with_suffix(".cameras.json"))
        print(f"wrote {beside}: {counted(len(field.refined_cameras), 'refined camera')}")
    print(f"wrote {output}: {_described(field)}, {output.stat().st_size / 1e6:.1f} MB")


def _described(field: VoxelField | SplatField) -> str:
    """What a field is made of."""
    if isinstance(field, SplatField):
        return counted(field.splat_count, "splat")
    size = "x".join(str(n) for n in field.resolution)
    behind = "" if field.background_model is None else f", {field.background_model.summary}"
    return f"{counted(field.voxel_count, 'voxel')} in a grid of {size}{behind}"


def run_fit_pose(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, tuple(mesh_endings("write")), "cage file")
    shared.require_other_file(output, args.cage)
    options.require_folder(args.pictures)
    field, resolver = shared.read_field_file(args), asset_resolver()
    rest = resolver.rest(args.cage, args.cage_up, field, object=args.cage_object)
    start = None if args.start is None else resolver.pose(rest, args.start, shared.posed_up(args))
    scene = load_scene(
        args.pictures,
        split=args.split,
        downscale=args.downscale,
        background="white" if args.background is None else args.background,
        orient=field.straightening,
    )
    deformer = Deformer(field, rest.cage, **shared.shot_of(args).deformer_options(MAX_CELLS))
    targets = PoseTargets.of(scene)
    if args.background is not None:
        targets = dataclasses.replace(targets, background=args.background)
    given = {name: getattr(args, name) for name in "parameters regularize restarts max_pixels exposure seed".split()}
    found = fit_pose(deformer, targets, start=start, **given, progress=not args.quiet)
    found.cage.save(output, up=args.cage_up or rest.ups.get(output.suffix.lower()))
    evaluations = sum(len(step.losses) for step in found.history)
    print(f"wrote {output}: {counted(len(scene), 'picture')}, {evaluations} evaluations, loss {found.loss:.3g}")
