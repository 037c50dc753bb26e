"""`warpcage select`: choose an object of a scene."""

from __future__ import annotations

import argparse

import numpy as np

from ..core.names import counted
from ..field.objects import select_object
from ..field.voxel_field import VoxelField
from ..view.camera import Camera, CameraFile
from ..view.pictures import write_png
from . import inputs, options, view
from .standing import read_rest


def run(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, options.SELECTION_ENDINGS, "selection file")
    preview = None if args.preview is None else options.check_output(args.preview, (".png",), "picture")
    view.check_saved(args)
    regions = (args.in_box, args.sphere, args.in_cage, args.masks, args.depth)
    if all(given is None for given in (args.point, args.pixel, *regions)):
        raise ValueError(
            "select needs a click (--point or --pixel) or a region (--in-box, --sphere, --in-cage, --masks or --depth)"
        )
    if (args.depth is None) != (args.views is None):
        raise ValueError("--depth and --views go together: distances from the cameras of views")
    if args.masks is not None and args.depth is not None:
        raise ValueError("--masks and --depth cannot be combined: give one of them")
    if args.plane == "none" and (args.plane_at is not None or args.clearance is not None):
        raise ValueError("--plane none leaves nothing out: --plane-at and --clearance belong to a plane")
    field = inputs.require_voxels(inputs.read_field(args), "select")
    low, high = field.bounds
    corners = np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 1, high, low)
    camera = view.chosen_camera(args, corners) if args.pixel or preview or args.save_camera else None
    chosen = select_object(
        field,
        point=args.point,
        pixel=args.pixel,
        camera=camera if args.pixel else None,
        plane=None if args.plane == "none" else args.plane,
        plane_at=args.plane_at,
        up=args.up,
        clearance=args.clearance,
        parts=args.parts,
        floaters=args.floaters or 0.0,
        **_regions(args, field),
    )
    for note in chosen.notes:
        print(note)
    if preview is not None and camera is not None:
        write_png(preview, chosen.preview(camera))
    chosen.save(output)
    if camera is not None:
        view.save_cameras(args, [camera])
    low, high = chosen.points.min(axis=0), chosen.points.max(axis=0)
    print(
        f"wrote {output}: {counted(int(np.count_nonzero(chosen.mask)), 'voxel')}, from {low.round(3).tolist()} to "
        f"{high.round(3).tolist()}{'' if preview is None else f', and {preview}'}"
    )


def _regions(args: argparse.Namespace, field: VoxelField) -> dict:
    """The regions of the arguments, as `select_object` takes them."""
    given: dict = {}
    if args.in_box is not None:
        given["box"] = [args.in_box[:3], args.in_box[3:]]
    if args.sphere is not None:
        given["sphere"] = args.sphere
    if args.in_cage is not None:
        given["cage"] = read_rest(args.in_cage, args.cage_up, field, part=True)[0]
    if args.masks is not None:
        scene = inputs.masked_scene(args.masks, field)
        given |= {"masks": scene.alphas, "cameras": scene.cameras}
    if args.depth is not None:
        given |= {"depth": args.depth, "cameras": _depth_views(args)}
    return given


def _depth_views(args: argparse.Namespace) -> list[Camera]:
    if view.camera_file(args.views):
        return [key.camera for key in CameraFile.load(args.views)]
    return view.scene_cameras(args, args.views)
