"""Edits of a captured object in front of its unmoved background, as in Fig. 5 of the paper: DTU scan 24, the toy house.

    python examples/edit_dtu.py --data data/dtu_scan24 --out out
    python examples/edit_dtu.py --data data/dtu_scan24 --downscale 8 --device cpu     # pictures of 100 x 75, minutes

The pictures are split at the masks: the object is fitted by voxels, its surroundings by layers behind them. (--whole
takes whole pictures instead, so that the fit itself divides them between the object's voxels and coarser ones around.)
Two edits follow: a box made by hand around one wing of the house, stretched upwards, and a cage generated around the
object, twisted and tapered. Writes to the folder of --out: edits.png (top row: the scene at rest, then one row per
edit; from left to right the picture, the cage over it, the object's disparity), falloff.png (the wing and its box;
stretched; the same with a falloff, so that it does not tear off), fill.png (the house removed, and moved aside: as
fitted; with what no picture showed filled; the masks), views.png (held-out pictures over renders), field.npz, the cages
and summary.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
import time

import numpy as np
import warp as wp

import warpcage
from warpcage.cage.walls import cut_faces
from warpcage.core.devices import resolve_device
from warpcage.core.files import atomic_path
from warpcage.view.frame_parts import mask_picture
from warpcage.view.overlay import draw_cage
from warpcage.view.pictures import color_disparity, contact_sheet, disparity_range, write_png

#: A box around the wing on the right, above its ground floor, in the house's own upright axes (see `upright_axes`).
WING = ([-1.05, -0.62, -0.15], [0.05, 0.47, 0.66])

#: Around the house without the blocks behind it, in the same axes.
HOUSE = ([-1.1, -1.05, -0.75], [1.0, 0.55, 0.66])


def main(argv=None) -> dict:
    args = parse_arguments(argv)
    wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads
    out, device = pathlib.Path(args.out), resolve_device(args.device)
    options = {"downscale": args.downscale, "masks": False if args.whole else "split"}
    train = warpcage.load_scene(args.data, **options)
    masked = warpcage.load_scene(args.data, downscale=args.downscale)
    test = warpcage.load_scene(args.data, split="test", downscale=args.downscale, masks="split")

    start = time.perf_counter()
    if args.field:
        field = warpcage.VoxelField.load(args.field, device=device)
    else:
        epochs = {} if args.epochs is None else {"epochs": args.epochs}
        field = warpcage.fit(train, device=device, quality=args.quality, **epochs)
        field.save(out / "field.npz", format="compact")
    seconds = time.perf_counter() - start
    rows = warpcage.evaluate(field, test)
    figures = {name: float(np.mean([row[name] for row in rows])) for name in ("masked_psnr", "psnr")}
    print(
        f"{figures['masked_psnr']:.2f} dB inside the masks of {len(test)} held-out views, {figures['psnr']:.2f} dB "
        f"on whole pictures, fitted in {seconds:.0f} s",
        flush=True,
    )
    columns = [0, len(test) // 3, len(test) // 2, 2 * len(test) // 3]
    write_png(
        out / "views.png",
        contact_sheet(
            [test.whole[i] for i in columns] + [field.render(test.cameras[i]).rgb for i in columns],
            columns=len(columns),
        ),
    )

    axes = upright_axes(masked)
    box = turned(warpcage.Cage.box(*WING, segments=(3, 3, 3)), axes)
    generated = warpcage.Cage.load(args.cage) if args.cage else generate(field, masked, axes)
    edits = {
        "box": (box, posed(box, axes, lambda cage: cage.stretch(1.35, axis="z", center=cage.bounds[0]))),
        "generated": (
            generated,
            posed(
                generated,
                axes,
                lambda cage: cage.twist(-28, axis="z", limits=(0.1, 1.0)).taper(0.75, axis="z", limits=(0.1, 1.0)),
            ),
        ),
    }
    camera = test.cameras[min(args.view, len(test) - 1)]
    camera = camera.resized(args.width, round(args.width * camera.height / camera.width))
    camera = dataclasses.replace(camera, fx=0.85 * camera.fx, fy=0.85 * camera.fy)  # so that the edits fit in
    figures["unmoved"] = show(out, field, edits, camera)
    show_falloff(out, field, *edits["box"], camera, args.falloff)
    figures["filled"] = show_fill(out, field, turned(warpcage.Cage.box(*HOUSE, segments=2), axes), axes, camera)
    for name, (rest, moved) in edits.items():
        rest.save(out / f"{name}.obj")
        moved.save(out / f"{name}_posed.obj")
    figures |= {
        "seconds": seconds,
        "voxels": field.voxel_count,
        "train_views": len(train),
        "test_views": len(test),
        "image_size": list(train.images.shape[2:0:-1]),
        "views": rows,
        "device": device.name if device.is_cuda else "CPU",
    }
    with atomic_path(out / "summary.json") as temporary:
        temporary.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    assert figures["unmoved"] < 1e-5, "the background moved"
    return figures


def parse_arguments(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", metavar="DIR", required=True, help="DTU scan 24 in the IDR layout")
    parser.add_argument("--out", metavar="DIR", default="out", help="where results go (default: %(default)s)")
    parser.add_argument("--device", help='"cpu" or "cuda:0" (default: CUDA where there is one)')
    parser.add_argument("--downscale", type=int, default=1, help="(default: %(default)s)")
    parser.add_argument("--quality", default="standard", choices=("fast", "standard", "high"))
    parser.add_argument("--epochs", type=float, help="passes over the pictures, for a fit shorter than --quality's")
    parser.add_argument("--whole", action="store_true", help="fit whole pictures; the masks only choose what to edit")
    parser.add_argument("--field", metavar="FILE", help="edit this field instead of fitting one")
    parser.add_argument("--cage", metavar="FILE", help="use this cage around the object instead of generating one")
    parser.add_argument("--width", type=int, default=480, help="of each picture in edits.png (default: %(default)s)")
    parser.add_argument("--falloff", type=float, default=0.3, help="width of the band (default: %(default)s)")
    parser.add_argument("--view", type=int, default=4, help="held-out view to show (default: %(default)s)")
    return parser.parse_args(argv)


def generate(field, scene, axes):
    """A cage around what all masks show to be the object, without the blocks behind it."""
    chosen = warpcage.select_nodes(field, cameras=scene.cameras, masks=list(scene.alphas), floaters=0.1)
    inside = chosen.mask.copy()
    inside[chosen.mask] = turned(warpcage.Cage.box(*HOUSE), axes).contains(chosen.points)
    return warpcage.Cage.from_field(warpcage.NodeSelection(field, inside, chosen.notes), vertex_count=100)


def upright_axes(scene) -> np.ndarray:
    """(3, 3) rows: sideward, towards the cameras, up."""
    up = scene.up
    towards = np.mean([camera.center for camera in scene.cameras], axis=0)
    towards -= (towards @ up) * up
    towards /= np.linalg.norm(towards)
    return np.stack([np.cross(towards, up), towards, up])


def turned(cage, axes):
    """A cage given in upright axes, in world axes."""
    return cage.with_vertices(cage.vertices @ axes)


def posed(cage, axes, pose):
    """A pose along the upright axes, of a cage in world axes."""
    upright = cage.with_vertices(cage.vertices @ axes.T)
    return cage.with_vertices(pose(upright).vertices @ axes)


def show(out, field, edits, camera) -> float:
    """Write edits.png. Returns the largest change of a pixel that shows only background before and after."""
    before = field.render(camera)
    frames = [(before, None)]
    unmoved = 0.0
    for rest, moved in edits.values():
        frame = warpcage.Deformer(field, rest).pose(moved).render(camera)
        frames.append((frame, moved))
        empty = (before.alpha < 1e-6) & (frame.alpha < 1e-6)
        unmoved = max(unmoved, float(np.abs(frame.rgb - before.rgb)[empty].max(initial=0.0)))
    scale = disparity_range(np.stack([np.where(frame.alpha > 0.5, frame.disparity, 0) for frame, _ in frames]))
    panels = []
    for frame, cage in frames:
        picture = np.clip(frame.rgb, 0, 1)
        drawn = picture
        for each in [rest for rest, _ in edits.values()] if cage is None else [cage]:
            drawn = draw_cage(drawn, camera, each)
        panels += [picture, drawn, color_disparity(frame.disparity, alpha=frame.alpha, scale=scale)]
    write_png(out / "edits.png", contact_sheet(panels, columns=3))
    return unmoved


def show_falloff(out, field, rest, moved, camera, width: float) -> None:
    """Write falloff.png: a part that its cage tears off, and the same faded to rest at the walls that cut it."""
    held = "cut" if len(cut_faces(rest, field)) else "still"
    edits = [warpcage.CageEdit(rest), warpcage.CageEdit(rest, falloff=width, held=held)]
    panels = [draw_cage(np.clip(field.render(camera).rgb, 0, 1), camera, rest)]
    panels += [np.clip(warpcage.Deformer(field, edit).pose(moved).render(camera).rgb, 0, 1) for edit in edits]
    write_png(out / "falloff.png", contact_sheet(panels, columns=3))


def show_fill(out, field, house, axes, camera) -> float:
    """Write fill.png. Returns the share of the picture that is made up where the house is taken away."""
    aside = house.translate(-0.7 * axes[0])
    panels, shares = [], []
    for edit, pose in ((warpcage.CageEdit(house, remove=True), None), (warpcage.CageEdit(house), aside)):
        frame = warpcage.Deformer(field, edit).pose([pose]).render(camera)
        filled = warpcage.fill_unseen(frame, field, camera)
        panels += [np.clip(frame.rgb, 0, 1), np.clip(filled.rgb, 0, 1), mask_picture(filled)]
        shares.append(float((filled.filled > 0.5).mean()))
    write_png(out / "fill.png", contact_sheet(panels, columns=3))
    return shares[0]


if __name__ == "__main__":
    main()
