"""`warpcage bake`: a deformed scene as a field of its own."""

from __future__ import annotations

import argparse

from ..deform.bake import bake
from . import inputs, options
from .deformation import read_deformation


def run(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, (".npz",), "field file")
    inputs.require_deformation(args, "bake")
    field = inputs.read_field(args)
    deformation = read_deformation(args, field)
    assert deformation is not None
    deformer = inputs.make_deformer(field, deformation, args).pose(deformation.posed)
    baked = bake(deformer, resolution=args.voxels)
    baked.save(output, format=args.format)
    size = "x".join(map(str, baked.resolution))
    print(f"wrote {output}: {baked.voxel_count} voxels in a grid of {size}, {output.stat().st_size / 1e6:.1f} MB")
