"""Bend Gaussian splats by a cage, and save them as a .ply that any viewer of splats opens.

    python examples/bend_splats.py --out out                              # data/splats/biker.compressed.ply
    python examples/bend_splats.py scene.ply --bend 40 --axis y --towards z --size 800

The file comes from the folder of WARPCAGE_DATA where none is given. Writes to the folder of --out: cage.obj, bent.ply,
and splats.png, four pictures: the splats as they are, with their cage, and bent, straight from the Deformer and from
the saved file.
"""

from __future__ import annotations

import argparse
import os
import pathlib

import numpy as np
import warp as wp

import warpcage
from warpcage.view.overlay import draw_cage
from warpcage.view.pictures import contact_sheet, write_png

DATA = pathlib.Path(os.environ.get("WARPCAGE_DATA", "../shared/data"))


def main(argv=None) -> dict:
    args = parse_arguments(argv)
    wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads
    out = pathlib.Path(args.out)
    field = warpcage.SplatField.load(args.splats, device=args.device)
    cage = warpcage.Cage.from_field(field, args.vertices, method="voxel")
    bent = cage.bend(args.bend, axis=args.axis, towards=args.towards)
    deformer = warpcage.Deformer(field, cage, coordinates=args.coordinates).pose(bent)

    out.mkdir(parents=True, exist_ok=True)
    cage.save(out / "cage.obj")
    warpcage.bake(deformer).save(out / "bent.ply")
    again = warpcage.SplatField.load(out / "bent.ply", device=args.device)

    low, high = field.shown_bounds
    center, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    away = np.array([-0.8, 0.0, -0.6]) - 0.15 * field.up
    camera = warpcage.Camera.look_at(center + 1.5 * size * away, center, up=field.up, width=args.size, height=args.size)
    still, posed, saved = (each.render(camera, background="grey").rgb for each in (field, deformer, again))
    write_png(out / "splats.png", contact_sheet([still, draw_cage(still, camera, cage), posed, saved]))
    print(f"{field.splat_count} splats of degree {field.degree}, {again.splat_count} bent: {out / 'bent.ply'}")
    return {"moved": warpcage.psnr(posed, still), "saved": warpcage.psnr(saved, posed), "count": again.splat_count}


def parse_arguments(argv) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("splats", nargs="?", default=DATA / "splats" / "biker.compressed.ply", help="file of splats")
    parser.add_argument("--out", default="out")
    parser.add_argument("--bend", type=float, default=50.0, help="degrees")
    parser.add_argument("--axis", default="y")
    parser.add_argument("--towards", default="z")
    parser.add_argument("--vertices", type=int, default=80, help="of the cage")
    parser.add_argument("--coordinates", default="mean_value")
    parser.add_argument("--size", type=int, default=480, help="pixels of a picture")
    parser.add_argument("--device")
    return parser.parse_args(argv)


if __name__ == "__main__":
    main()
