"""`warpcage bake`: a deformed scene as a field of its own."""

from __future__ import annotations

import argparse

import numpy as np

from ..core.files import require_file
from ..core.names import counted
from ..deform.bake import bake
from ..deform.splat_deformer import SplatDeformer
from ..field.selection import NodeSelection
from ..splats.io import is_splat_file
from . import inputs, options
from .deformation import Deformation, is_deformed, read_deformation


def run(args: argparse.Namespace) -> None:
    require_file(args.field, "field file")
    of_splats = is_splat_file(args.field)
    output = options.check_output(args.output, options.SPLAT_ENDINGS if of_splats else (".npz",), "field file")
    if of_splats and (args.voxels is not None or args.format is not None):
        raise ValueError("--voxels and --format are for fields of voxels: the ending of a splat file says its format")
    if args.frames is not None and (not of_splats or "#" not in output.name):
        raise ValueError("--frames writes numbered files of splats: give -o NAME_####.ply, the # for the number")
    if args.overwrite and args.frames is None:
        raise ValueError("--overwrite is for numbered files: give --frames, how many; one file is replaced anyway")
    if args.frames == 1:
        raise ValueError("--frames 1 would write the pose at rest alone: give 2 or more, or leave it out")
    if args.frames is None and of_splats and "##" in output.name:
        raise ValueError("-o with # for a number writes numbered files: give --frames, how many")
    if args.selection is None:
        inputs.require_deformation(args, "bake")
    elif args.voxels is not None and not is_deformed(args):
        raise ValueError("--voxels is for a deformed scene: what is only cut out keeps its voxels")
    field = inputs.read_field(args)
    deformation = read_deformation(args, field)
    if args.selection is not None:
        field = NodeSelection.load(args.selection, inputs.require_voxels(field, "--selection")).cut_out()
    if deformation is None:
        baked = inputs.require_voxels(field, "--selection")
    else:
        deformer = inputs.make_deformer(field, deformation, args).pose(deformation.posed)
        if isinstance(deformer, SplatDeformer):
            if args.frames is not None:
                return _write_sequence(deformer, deformation, args)
            splats = deformer.baked()
            splats.save(output)
            print(f"wrote {output}: {counted(splats.splat_count, 'splat')}, {output.stat().st_size / 1e6:.1f} MB")
            return
        baked = bake(deformer, resolution=args.voxels)
    baked.save(output, format=args.format or "warpcage")
    size = "x".join(map(str, baked.resolution))
    print(
        f"wrote {output}: {counted(baked.voxel_count, 'voxel')} in a grid of {size}, "
        f"{output.stat().st_size / 1e6:.1f} MB"
    )


def _write_sequence(deformer: SplatDeformer, deformation: Deformation, args: argparse.Namespace) -> None:
    """Files of the poses from rest to the last one, evenly."""
    places = np.linspace(0.0, deformation.pose_count - 1.0, args.frames)
    written = deformer.save_sequence(args.output, (deformation.at(place) for place in places), overwrite=args.overwrite)
    print(f"wrote {counted(len(written), 'file')}, {written[0]} to {written[-1]}")
