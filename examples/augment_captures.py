"""A data set of deformed captures, and a fit of one of them: random poses, pictures of each, a field again.

    python examples/augment_captures.py --out out                      # an excavator of bricks, rendered for this
    python examples/augment_captures.py --field lego.npz --cage cage.obj --poses 9 --out out

Each pose is seen by the same cameras, and is a scene folder of its own; pose 0 is the field at rest. A new field is
fitted to the pictures of that, and of the pose of --refit, but for every eighth picture. Both show those pictures
about equally well, and the one at rest does not show those of the pose: cameras, poses and pictures belong together.

Writes to the folder of --out: sweep.jsonl with sweep.poses.npy and sweep.cameras.json; dataset/pose_*/; poses.png (a
picture of each pose); refit.png (a held-out picture at rest and one deformed, each beside what the new field shows
there); summary.json.
"""

from __future__ import annotations

import argparse
import json
import pathlib

import warp as wp

import warpcage
from warpcage.core.files import atomic_path
from warpcage.demo.brick_scene import write_brick_scene
from warpcage.demo.viewpoints import reference_cameras, spread_eyes
from warpcage.fitting.evaluation import evaluate, mean_psnr
from warpcage.studio.jobs.run import run_jobs
from warpcage.studio.jobs.sweeps import GivenSource, RandomSource, write_sweep
from warpcage.view.pictures import contact_sheet, write_png


def main(argv=None) -> dict:
    wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads
    args = parse_arguments(argv)
    out = pathlib.Path(args.out)
    field_path, cage_path = inputs(args, out)
    rest = warpcage.Cage.load(cage_path)
    poses = warpcage.RandomPoses(rest, seed=args.seed, stretch=args.stretch)
    sweep = write_sweep(
        out / "sweep.jsonl",
        field=field_path,
        cage=cage_path,
        rest=rest,
        sources=[GivenSource([rest.vertices], "rest"), RandomSource(poses, args.poses - 1)],
        cameras=reference_cameras(spread_eyes(args.views, args.seed), rest.bounds.mean(axis=0), args.size),
        coordinates=[args.coordinates],
        defaults={"background": "transparent"} | ({"resolution": args.lattice} if args.lattice else {}),
    )
    report = run_jobs(sweep.jobs, out / "dataset", device=args.device)
    if report.failed:
        raise SystemExit(f"pictures failed: {report.failed}")

    folders = [out / "dataset" / f"pose_{pose:06d}" for pose in range(args.poses)]
    pictures = [warpcage.load_scene(folder, split="test").images[0] for folder in folders]
    write_png(out / "poses.png", contact_sheet(pictures))
    options = {} if args.epochs is None else {"epochs": args.epochs}
    psnr, panels, field = {}, [], None
    for pose in (0, args.refit):
        scene, held = (warpcage.load_scene(folders[pose], split=split) for split in ("train", "test"))
        if field is not None:
            psnr["the field at rest, of the pose"] = round(mean_psnr(evaluate(field, held)), 2)
        field = warpcage.fit(scene, device=args.device, seed=args.seed, quality=args.quality, progress=False, **options)
        psnr[f"pose {pose}"] = round(mean_psnr(evaluate(field, held)), 2)
        panels += [held.images[0], field.render(held.cameras[0], background="white").rgb]
    write_png(out / "refit.png", contact_sheet(panels, columns=2))
    summary = {"pictures": sweep.items, "psnr": psnr}
    with atomic_path(out / "summary.json") as temporary:
        temporary.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    shown = ", ".join(f"{name} {value:.2f} dB" for name, value in psnr.items())
    print(f"wrote {out}: {sweep.items} pictures of {args.poses} poses; held-out pictures of fits to them: {shown}")
    return summary


def inputs(args, out: pathlib.Path) -> tuple[pathlib.Path, pathlib.Path]:
    """Files of the field and its cage, which are made where they are not given."""
    if args.field and args.cage:
        return pathlib.Path(args.field), pathlib.Path(args.cage)
    field_path = pathlib.Path(args.field) if args.field else out / "field.npz"
    if not args.field:
        folder = write_brick_scene(out / "scene", train_views=args.views, size=args.size, device=args.device)
        options = {} if args.epochs is None else {"epochs": args.epochs}
        scene = warpcage.load_scene(folder)
        warpcage.fit(scene, device=args.device, quality=args.quality, progress=False, **options).save(field_path)
    cage_path = out / "cage.obj"
    warpcage.Cage.from_field(warpcage.VoxelField.load(field_path, device=args.device), args.vertices).save(cage_path)
    return field_path, cage_path


def parse_arguments(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="out", help="folder to write to (default: out)")
    parser.add_argument("--field", help="a field (.npz) instead of a fit of the brick scene")
    parser.add_argument("--cage", help="its cage (default: one is made)")
    parser.add_argument("--vertices", type=int, default=100, help="of the cage that is made (default: 100)")
    parser.add_argument("--poses", type=int, default=4, help="poses, with that at rest (default: 4)")
    parser.add_argument("--views", type=int, default=64, help="pictures of each pose (default: 64)")
    parser.add_argument("--size", type=int, default=128, help="pixels along each side (default: 128)")
    parser.add_argument("--refit", type=int, default=1, help="pose that a field is fitted to (default: 1)")
    parser.add_argument("--stretch", type=float, nargs=2, default=(0.5, 2.0), help="bounds of poses (default: 0.5 2)")
    parser.add_argument("--coordinates", default="harmonic", help="(default: harmonic)")
    parser.add_argument("--lattice", type=int, help="cells along the cage (default: by the size of pictures)")
    parser.add_argument("--quality", default="fast", help="of fits (default: fast)")
    parser.add_argument("--epochs", type=float, help="of fits (default: that of the quality)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", help="Warp device (default: CUDA where there is one)")
    return parser.parse_args(argv)


if __name__ == "__main__":
    main()
