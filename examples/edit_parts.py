"""Parts of a scene, each moved by a cage of its own: copied, removed, and stretched without tearing off.

    python examples/edit_parts.py --out out                     # the brick excavator, fitted once and kept
    python examples/edit_parts.py --field bricks.npz --size 160 --device cpu

Boxes around the cabin, the bucket and the arm. Writes to the folder of --out: order.png (the scene, the cabin copied on
top of itself, the bucket removed besides, and the arm swung besides; the cages drawn over it), falloff.png (the arm
lifted by a cage that cuts it off, and the same with a falloff at the cut), clean.png (close up: the bucket removed by
its box; by the box with its walls snapped to gaps; and its fragments with it), carried.png (the bucket moved aside: its
fragments left where they were; and taken along; and the cage over that), the cages, and excavator.edits.json, which
`warpcage render --edits` takes.
"""

from __future__ import annotations

import argparse
import json
import pathlib

import numpy as np
import warp as wp

import warpcage
from warpcage.cage.snap import snap_to_gaps
from warpcage.core.devices import resolve_device
from warpcage.core.files import atomic_path
from warpcage.studio.editor.demo import demo_files
from warpcage.view.overlay import draw_cage
from warpcage.view.pictures import contact_sheet, write_png

#: Corners of the boxes, world units of the brick scene: x ahead, z up.
CABIN = ([-0.53, -0.03, -0.12], [0.25, 0.56, 0.6])
BUCKET = ([0.44, -0.6, -0.45], [1.02, 0.09, 0.06])
SMALL = ([0.44, -0.5, -0.3], [1.0, 0.09, 0.06])  # of the bucket
ARM = ([0.36, -0.6, -0.45], [1.09, 0.09, 0.93])


def main(argv=None) -> dict:
    args = parse_arguments(argv)
    wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads
    out, device = pathlib.Path(args.out), resolve_device(args.device)
    field = warpcage.VoxelField.load(args.field or demo_files(device)[0], device=device)
    camera = warpcage.Camera.look_at((2.1, -2.8, 1.5), (0, 0, 0.15), width=args.size, height=args.size, fov_degrees=38)
    cabin, bucket, arm = (warpcage.Cage.box(*corners, segments=3) for corners in (CABIN, BUCKET, ARM))
    on_top, swung = cabin.translate([0, 0, 0.7]), arm.rotate(-25, axis="z", center=[0.3, -0.25, 0])

    # each edit acts on what the ones before it left: the arm that swings has lost its bucket
    steps = [
        (warpcage.CageEdit(cabin, keep_source=True), on_top),
        (warpcage.CageEdit(bucket, remove=True), None),
        (warpcage.CageEdit(arm), swung),
    ]
    panels = [np.clip(field.render(camera).rgb, 0, 1)]
    for count in range(1, len(steps) + 1):
        panels += [panel(field, steps[:count], camera, args.resolution)]
    panels.append(panel(field, steps, camera, args.resolution, overlay=True))
    write_png(out / "order.png", contact_sheet(panels, columns=5))

    lifted = arm.translate([0.1, 0, 0.3])
    edits = [warpcage.CageEdit(arm), warpcage.CageEdit(arm, falloff=args.falloff)]
    panels = [panel(field, [(edit, lifted)], camera, args.resolution, overlay) for edit in edits for overlay in (0, 1)]
    write_png(out / "falloff.png", contact_sheet(panels, columns=4))

    # the box of the bucket is drawn by eye: its walls go to where they cut less, and what they cut off goes too
    close = warpcage.Camera.look_at(
        (2.1, -2.8, 1.5), (0.45, -0.2, 0), width=args.size, height=args.size, fov_degrees=22
    )
    snapped = snap_to_gaps(bucket, field, reach=0.1)
    cuts = [
        warpcage.CageEdit(cage, remove=True, fragments=size)
        for cage, size in ((bucket, 0), (snapped, 0), (snapped, 0.5))
    ]
    panels = [panel(field, [(edit, None)], close, args.resolution) for edit in cuts]
    write_png(out / "clean.png", contact_sheet(panels, columns=3))

    # a box that is drawn too small: what stands out of it and hangs on it alone goes along
    small = warpcage.Cage.box(*SMALL, segments=3)
    aside = small.rotate(20, axis="z").translate([0.05, -0.75, 0.1])
    beside = warpcage.Camera.look_at(
        (2.9, -1.9, 1.3), (0.5, -0.5, 0), width=args.size, height=args.size, fov_degrees=28
    )
    left, taken = ([(warpcage.CageEdit(small, fragments=most), aside)] for most in (0.0, 0.9))
    panels = [panel(field, steps, beside, args.resolution) for steps in (left, taken)]
    panels.append(panel(field, taken, beside, args.resolution, overlay=True))
    write_png(out / "carried.png", contact_sheet(panels, columns=3))

    for name, cage in {"cabin": cabin, "on_top": on_top, "bucket": bucket, "arm": arm, "swung": swung}.items():
        cage.save(out / f"{name}.obj")
    content = [
        {"cage": "cabin.obj", "posed": "on_top.obj", "keep": True},
        {"cage": "bucket.obj", "remove": True},
        {"cage": "arm.obj", "posed": "swung.obj"},
    ]
    with atomic_path(out / "excavator.edits.json") as path:
        path.write_text(json.dumps({"format": "warpcage edits", "version": 1, "edits": content}, indent=1) + "\n")
    held = warpcage.Deformer(field, edits[1], resolution=args.resolution).pose(lifted).deformed[0]
    moved = np.linalg.norm(held.vertices - arm.vertices, axis=1)
    assert moved.max() > 0.3 and moved.min() == 0.0, "the wall that cuts the arm is not held"
    return {"held_vertices": int((moved == 0.0).sum())}


def panel(field, steps, camera, resolution: int, overlay: bool = False) -> np.ndarray:
    """The scene that edits and poses leave, with the cages over it where asked for."""
    edits, poses = zip(*steps, strict=True)
    deformer = warpcage.Deformer(field, list(edits), resolution=resolution).pose(list(poses))
    picture = np.clip(deformer.render(camera).rgb, 0, 1)
    for edit, posed in zip(edits, deformer.deformed, strict=True):
        picture = draw_cage(picture, camera, edit.cage if posed is None else posed) if overlay else picture
    return picture


def parse_arguments(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", metavar="DIR", default="out", help="where results go (default: %(default)s)")
    parser.add_argument("--field", metavar="FILE", help="a field of the brick scene (default: the editor's demo)")
    parser.add_argument("--device", help='"cpu" or "cuda:0" (default: CUDA where there is one)')
    parser.add_argument("--size", type=int, default=300, help="pixels a side of a picture (default: %(default)s)")
    parser.add_argument("--resolution", type=int, default=96, help="cells of the maps' lattices (default: %(default)s)")
    parser.add_argument("--falloff", type=float, default=0.35, help="width of the band (default: %(default)s)")
    return parser.parse_args(argv)


if __name__ == "__main__":
    main()
