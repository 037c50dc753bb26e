"""From a phone's pictures to a bent object: the stuffed fox on a wall, its neck stretched and its head turned.

    python examples/edit_fox.py --data data/fox --out out
    python examples/edit_fox.py --data data/fox --downscale 8 --quality fast --resolution 96 --device cpu   # 5 minutes

The pictures have no masks and show a room, not an object: a field is fitted to all of it. A click on the fox in one of
the pictures chooses it: what hangs together with that place and stands out from the wall, which is found. A cage goes
around that, ends at the wall, and leaves it out. Its neck is stretched and its head turned; the wall is held. Writes to
the folder of --out: views.png (held-out pictures over renders), chosen.png (what was chosen, tinted), edit.png (at
rest, posed, and the cage over it, from three of the pictures' cameras), fox.mp4, field.npz, selection.npz, the cages,
and summary.json.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import time

import numpy as np
import warp as wp

import warpcage
from warpcage.core.devices import resolve_device
from warpcage.core.files import atomic_path
from warpcage.studio.films.video import write_video
from warpcage.view.overlay import draw_cage
from warpcage.view.pictures import contact_sheet, write_png

#: The picture that is clicked in, by a part of its name, and the place in it, shares of its width and height: the fox's
#: forehead.
CLICK = ("0025", 0.45, 0.27)

#: How much longer the neck gets, and how far the head turns and nods, degrees.
STRETCH, TURN, NOD = 1.35, 30.0, 10.0

#: Where the neck ends and the head begins, as shares of the way from the wall to the nose.
NECK, HEAD = (0.06, 0.5), (0.3, 0.75)

#: A picture outside the edit may differ by so much, in [0, 1].
STILL = 0.02


def main(argv=None) -> dict:
    args = parse_arguments(argv)
    wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads
    out, device = pathlib.Path(args.out), resolve_device(args.device)
    train = warpcage.load_scene(args.data, downscale=args.downscale, orient="up")
    test = warpcage.load_scene(args.data, split="test", downscale=args.downscale, orient=train.straightening)

    start = time.perf_counter()
    if args.field:
        field = warpcage.VoxelField.load(args.field, device=device)
    else:
        options = {name: getattr(args, name) for name in ("epochs", "resolution") if getattr(args, name) is not None}
        field = warpcage.fit(train, device=device, quality=args.quality, **options)
        field.save(out / "field.npz", format="compact")
    seconds = time.perf_counter() - start
    psnr = float(np.mean([row["psnr"] for row in warpcage.evaluate(field, test)]))
    print(f"{psnr:.2f} dB on {len(test)} held-out views, fitted in {seconds:.0f} s", flush=True)
    pairs = range(0, len(test), max(1, len(test) // 4))
    write_png(
        out / "views.png",
        contact_sheet(
            [test.images[i] for i in pairs] + [field.render(test.cameras[i]).rgb for i in pairs], columns=len(pairs)
        ),
    )

    name, across, down = args.click
    number = next((i for i, each in enumerate(train.names) if name in each), None)
    if number is None:
        raise ValueError(f"no picture of {args.data!r} has {name!r} in its name: {train.names[0]!r} is one of them")
    camera = train.cameras[number]
    pixel = (int(float(across) * camera.width), int(float(down) * camera.height))
    start = time.perf_counter()
    fox = warpcage.select_object(field, pixel=pixel, camera=camera, plane="wall")
    choosing = time.perf_counter() - start
    fox.save(out / "selection.npz")
    print("; ".join(fox.notes), flush=True)
    views = [train.cameras[i] for i in np.linspace(0, len(train) - 1, 6).astype(int)]
    write_png(out / "chosen.png", contact_sheet([fox.preview(view) for view in views], columns=6))

    cage = warpcage.Cage.load(args.cage) if args.cage else warpcage.Cage.from_field(fox, vertex_count=args.vertices)
    posed = pose(cage, fox.floor.normal, field.up, 1.0)
    cage.save(out / "cage.obj")
    posed.save(out / "posed.obj")
    deformer = warpcage.Deformer(field, cage, resolution=args.lattice, device=device)
    still = show(out, deformer, cage, posed, [train.cameras[i] for i in args.views])
    if not args.no_video:
        width = min(args.film, camera.width)
        small = train.cameras[args.views[0]].resized(width, round(width * camera.height / camera.width))
        frames = (
            deformer.pose(pose(cage, fox.floor.normal, field.up, weight)).render(small).rgb
            for weight in 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(args.frames) / args.frames)
        )
        write_video(out / "fox.mp4", (np.clip(frame, 0, 1) for frame in frames), fps=24)
    figures = {
        "psnr": psnr,
        "seconds": seconds,
        "voxels": field.voxel_count,
        "train_views": len(train),
        "image_size": list(train.images.shape[2:0:-1]),
        "chosen_voxels": int(fox.mask.sum()),
        "choosing_seconds": choosing,
        "cage_vertices": len(cage.vertices),
        "enclosed": float(cage.contains(fox.points).mean()),
        "still": still,
        "notes": list(fox.notes),
        "device": device.name if device.is_cuda else "CPU",
    }
    with atomic_path(out / "summary.json") as temporary:
        temporary.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    assert still < STILL, f"the room moved: pixels that the edit does not reach changed by {still:.3f}"
    return figures


def parse_arguments(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", metavar="DIR", required=True, help="the fox: 50 pictures with a transforms.json")
    parser.add_argument("--out", metavar="DIR", default="out", help="where results go (default: %(default)s)")
    parser.add_argument("--device", help='"cpu" or "cuda:0" (default: CUDA where there is one)')
    parser.add_argument("--downscale", type=int, default=2, help="(default: %(default)s)")
    parser.add_argument("--quality", default="standard", choices=("fast", "standard", "high"))
    parser.add_argument("--epochs", type=float, help="passes over the pictures, for a fit shorter than --quality's")
    parser.add_argument("--resolution", type=int, help="voxels along the longest side (default: by the pictures)")
    parser.add_argument("--field", metavar="FILE", help="edit this field instead of fitting one")
    parser.add_argument(
        "--click",
        nargs=3,
        default=CLICK,
        metavar=("NAME", "ACROSS", "DOWN"),
        help="a picture by a part of its name, and a place in it as shares of its width and height",
    )
    parser.add_argument("--cage", metavar="FILE", help="use this cage around the fox instead of generating one")
    parser.add_argument("--vertices", type=int, default=100, help="of the cage (default: %(default)s)")
    parser.add_argument("--lattice", type=int, default=96, help="cells along the cage (default: %(default)s)")
    parser.add_argument("--views", type=int, nargs=3, default=(0, 12, 18), help="pictures whose cameras show the edit")
    parser.add_argument("--no-video", action="store_true")
    parser.add_argument("--frames", type=int, default=72, help="of the film (default: %(default)s)")
    parser.add_argument("--film", type=int, default=540, help="width of the film, pixels (default: %(default)s)")
    return parser.parse_args(argv)


def pose(cage, out_of_wall, up, weight: float):
    """The cage with its neck stretched out of the wall and its head turned aside, by a weight from 0 to 1."""
    sideways = np.cross(up, out_of_wall)
    longer = cage.stretch(1.0 + weight * (STRETCH - 1.0), axis=out_of_wall, limits=NECK)
    turned = longer.bend(weight * TURN, axis=out_of_wall, towards=sideways, limits=HEAD)
    return turned.bend(weight * NOD, axis=out_of_wall, towards=np.asarray(up), limits=HEAD)


def show(out, deformer, cage, posed, cameras) -> float:
    """Write edit.png. Returns how much pixels change that see neither cage, at most but for one in a thousand."""
    panels, changes = [], []
    for camera in cameras:
        before = deformer.pose(cage).render(camera).rgb
        after = deformer.pose(posed).render(camera).rgb
        panels += [before, after, draw_cage(np.clip(after, 0, 1), camera, posed)]
        aside = ~(covered(camera, cage) | covered(camera, posed))
        changes.append(np.abs(after - before).max(axis=-1)[aside])
    write_png(out / "edit.png", contact_sheet([np.clip(panel, 0, 1) for panel in panels], columns=3))
    return float(np.quantile(np.concatenate(changes), 0.999))


def covered(camera, cage) -> np.ndarray:
    """(h, w) bool, pixels that see a cage."""
    from skimage.draw import polygon

    mask = np.zeros((camera.height, camera.width), bool)
    pixels, depth = camera.project(cage.vertices)
    for face in cage.faces[(depth[cage.faces] > 0).all(axis=1)]:
        mask[polygon(pixels[face, 1], pixels[face, 0], mask.shape)] = True
    return mask


if __name__ == "__main__":
    main()
