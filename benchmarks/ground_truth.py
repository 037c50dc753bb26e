"""Deformed fields against ground truth: fields of ray cast models, posed by cages, beside the models posed in float64.

    python benchmarks/ground_truth.py --device cuda:0 --json docs/results/ground_truth.json --figures docs/pictures
    python benchmarks/ground_truth.py --quick

For each scene a field is fitted to pictures of the model at rest. Its PSNR, SSIM and depth error on test views at rest
are the ceiling: a deformed field can hardly be better than the field. Then the same for each pose, kind of coordinates
and lattice resolution ("null" is precise), against pictures of the posed model; what that is, and how it is lit, is in
truth_scenes.py. "fit of the pose" is a field fitted to as many pictures of the pose itself, which tells what any field
can show of this very scene. Depth errors are means over pixels that truth and field both cover, as a share of the
cage's size.

Against the harmonic truth also: other truths of the light, half the march step, the paper's density; and what the
shortcuts of shortcuts.py cost, at 128 cells. "march" rows are composited by this script, so that they check the
deformer's frames and show the colour of plain directions beside that of mapped ones.
"""

from __future__ import annotations

import argparse
import pathlib
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import shortcuts
import warp as wp
from results import write_jpeg, write_results
from truth_scenes import POSES, SCENES, TRUTHS, TruthScene, View, pose_cages

import warpcage
from warpcage.fitting.evaluation import ssim
from warpcage.view.pictures import contact_sheet

KINDS = ("mean_value", "harmonic", "green")


def main() -> None:
    args = parse_arguments()
    wp.config.quiet = True
    device = warpcage.core.devices.resolve_device(args.device)
    scenes, rows = [], []
    for name in args.scenes:
        begin = time.perf_counter()
        scene = TruthScene(
            name,
            size=args.size,
            train_views=args.train_views,
            test_views=args.test_views,
            longest_edge=args.edge,
            samples=args.samples,
            cuts=args.cuts,
            device=device,
        )
        field = warpcage.fit(scene.training(), device=device, quality=args.quality, progress=False)
        views = scene.rest_views()
        ceiling = measure([field.render(view.camera) for view in views], views, scene.cage.size)
        facts = {
            "scene": name,
            "voxels": field.voxel_count,
            "field_resolution": list(field.resolution),
            "cage_vertices": len(scene.cage.vertices),
            "mesh_faces": len(scene.mesh.faces),
            **ceiling,
        }
        print(facts, flush=True)
        scenes.append(facts)
        measured, pictures = measure_scene(scene, field, ceiling["psnr"], args)
        rows += measured
        if args.figures:
            lines = [line for pose, line in pictures.items() if pose in args.shown]
            sheet = contact_sheet([cell for line in lines for cell in line], columns=4)
            write_jpeg(pathlib.Path(args.figures) / f"ground_truth_{name}.jpg", sheet, quality=85)
        print(f"{name}: {time.perf_counter() - begin:.1f} s", flush=True)
        if args.json:  # after each scene: what was measured is kept
            write_results(
                args.json,
                device,
                size=args.size,
                train_views=args.train_views,
                test_views=args.test_views,
                samples=args.samples**2,
                quality=args.quality,
                cuts=args.cuts,
                middle=args.middle,
                scenes=scenes,
                rows=rows,
            )


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--poses", nargs="*", help="names of truth_scenes.pose_cages; default: all")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--resolution", type=int, nargs="*", default=[64, 128, 256])
    parser.add_argument("--middle", type=int, default=128, help="resolution of the extra rows")
    parser.add_argument("--extra", nargs="*", default=["bend"], help="poses of march and nearest-voxel rows")
    parser.add_argument("--refit", nargs="*", default=list(POSES), help="poses that a field of their own is fitted to")
    parser.add_argument("--size", type=int, default=400, help="pixels a side")
    parser.add_argument("--train-views", type=int, default=120)
    parser.add_argument("--test-views", type=int, default=6)
    parser.add_argument("--samples", type=int, default=3, help="a side of a pixel, of the ray caster")
    parser.add_argument("--edge", type=float, default=0.08, help="longest edge of the models' triangles")
    parser.add_argument("--cuts", type=int, default=3, help="of the boundary elements")
    parser.add_argument("--quality", default="standard", help="of the fits")
    parser.add_argument("--shown", nargs="*", default=["twist", "bend"], help="poses in the figure")
    parser.add_argument("--json")
    parser.add_argument("--figures", help="folder for pictures: at rest, truth, deformed field, error x 5")
    parser.add_argument("--quick", action="store_true", help="small, on the CPU")
    args = parser.parse_args()
    if args.quick:
        args.device, args.size, args.train_views, args.test_views, args.samples = "cpu", 64, 40, 2, 2
        args.scenes, args.poses, args.resolution, args.middle = ["animal"], ["rigid", "bend"], [32], 32
        args.edge, args.cuts, args.quality, args.refit = 0.15, 1, "fast", ["bend"]
    return args


def measure_scene(scene, field, ceiling: float, args):
    """Rows of one scene, and for each pose a line of pictures."""
    rows, pictures = [], {}
    for pose, posed in pose_cages(scene.name, scene.cage).items():
        if args.poses and pose not in args.poses:
            continue
        for kind in args.kinds:
            truths, facts = scene.posed_views(posed, kind, TRUTHS if kind == "harmonic" else ("carried",))
            views = truths["carried"]

            def report(frames, what="frame", against=views, **more):
                row = {
                    "scene": scene.name,
                    "pose": pose,  # noqa: B023 (used at once)
                    "kind": kind,  # noqa: B023
                    "what": what,  # noqa: B023 (used at once)
                    **more,
                    **measure(frames, against, scene.cage.size, similarity=what == "frame"),
                }
                row["to_ceiling"] = row["psnr"] - ceiling
                rows.append(row)
                print({name: value for name, value in row.items() if value is not None}, flush=True)

            for resolution in args.resolution + [None] * (kind != "harmonic"):
                deformer = warpcage.Deformer(field, scene.cage, coordinates=kind, resolution=resolution).pose(posed)
                frames = [deformer.render(view.camera) for view in views]
                report(frames, resolution=resolution, **facts)
                if kind == "harmonic" and resolution == args.middle:
                    if pose in args.refit:
                        own = warpcage.fit(
                            scene.posed_training(posed, kind),
                            device=deformer.field.device,
                            quality=args.quality,
                            progress=False,
                        )
                        report([own.render(view.camera) for view in views], "fit of the pose", resolution=resolution)
                    pictures[pose] = picture_line(scene, views[0], frames[0])
                    report_more(deformer, posed, views, truths, frames, report, args, pose in args.extra)
    return rows, pictures


def report_more(deformer, posed, views, truths, frames, report, args, slow: bool) -> None:
    """The rows of one harmonic pose beside the plain ones."""
    middle = {"resolution": args.middle}
    for truth in TRUTHS[1:]:
        report(frames, f"truth {truth}", truths[truth], **middle)
    report([deformer.render(view.camera, step=0.5 * deformer.field.step) for view in views], "half step", **middle)
    paper = warpcage.Deformer(
        deformer.field, deformer.edits[0].cage, coordinates="harmonic", resolution=args.middle, density="paper"
    ).pose(posed)
    report([paper.render(view.camera) for view in views], "density paper", **middle)
    for plain in (False, True) if slow else ():
        marched = [shortcuts.march(deformer, view.camera, plain_directions=plain, stride=2) for view in views[:1]]
        thinned = [View(view.camera, view.image[::2, ::2], view.depth[::2, ::2]) for view in views[:1]]
        report(marched, "march, plain directions" if plain else "march", thinned, **middle)
    for threshold in (0.5, 0.98):
        shortcuts.use_weight_sums(deformer.pose(posed), threshold)
        report([deformer.render(view.camera) for view in views], f"weight sum {threshold}", **middle)
    if slow:
        unknowns = shortcuts.use_nearest_voxels(deformer.pose(posed), posed)
        report([deformer.render(view.camera) for view in views], "nearest voxel", **middle, unknowns=unknowns)


def measure(frames, views, size: float, *, similarity: bool = True) -> dict:
    """Mean PSNR (dB) and SSIM over views, and mean depth error as a share of `size` (None for bare pictures)."""

    def one(frame, view):
        bare = isinstance(frame, np.ndarray)
        rgb = frame if bare else frame.rgb
        error = None
        if not bare:
            both = np.isfinite(view.depth) & np.isfinite(frame.depth) & (frame.alpha > 0.5)
            error = np.abs(frame.depth[both] - view.depth[both])
        return float(warpcage.psnr(rgb, view.image)), ssim(rgb, view.image) if similarity else None, error

    for frame in frames:
        if not isinstance(frame, np.ndarray):
            frame.rgb, frame.alpha, frame.depth  # noqa: B018 (copied to the host here, one after the other)
    with ThreadPoolExecutor() as pool:
        psnrs, ssims, errors = zip(*pool.map(one, frames, views), strict=True)
    result = {"psnr": float(np.mean(psnrs))} | ({"ssim": float(np.mean(ssims))} if similarity else {})
    if errors[0] is not None:
        together = np.concatenate(errors)
        result |= {"depth_mean": float(together.mean() / size), "depth_median": float(np.median(together) / size)}
    return result


def picture_line(scene, view, frame) -> list[np.ndarray]:
    """At rest, truth, deformed field, and five times their difference on white."""
    rest = scene.rest_views()[0].image
    rgb = np.clip(frame.rgb, 0, 1)
    return [rest, view.image, rgb, np.clip(1 - 5 * np.abs(rgb - view.image), 0, 1)]


if __name__ == "__main__":
    main()
