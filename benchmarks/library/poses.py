"""Known poses found again from ray cast pictures of the posed model."""

from __future__ import annotations

import pathlib
import time

import numpy as np
from common import DEVICE, JSON, QUICK, command, option, quiet_device, write_jpeg, write_results

import warpcage
from warpcage.fitting import error_image
from warpcage.view import contact_sheet

from .truth import POSES, SCENES, TruthScene, inverted, pose_cages

#: What is known of a pose, and where a fit begins: pictures, masks, depths, landmarks, degrees off about z.
CASES = {
    "8 pictures": (8, False, False, 0, 0),
    "8 pictures, masks": (8, True, False, 0, 0),
    "8 pictures, start 40 degrees off": (8, False, False, 0, 40),
    "2 pictures": (2, False, False, 0, 0),
    "2 pictures, masks": (2, True, False, 0, 0),
    "2 pictures, depth": (2, False, True, 0, 0),
    "1 picture": (1, False, False, 0, 0),
    "1 picture, depth": (1, False, True, 0, 0),
    "1 picture, 8 landmarks in space": (1, False, False, 8, 0),
}

#: Pixels along each side of a cell of the figure, about.
SHOWN = 256

#: RMS as a share of the cage's size below which a pose counts as found.
FOUND = 0.01


#: What scenes of ground truth are made of.
SCENE_OPTIONS = (
    option("--scenes", nargs="*", default=list(SCENES), help="models, or mesh files with colours, a cage .obj beside"),
    option("--representation", default="voxels", choices=("voxels", "splats"), help="what the fields are"),
    option("--kind", default="mean_value", help="coordinates of the truth and of the fit"),
    option("--resolution", type=int, default=64, help="cells of the map's lattice"),
    option("--size", type=int, default=400, help="pixels along each side"),
    option("--train-views", type=int, default=120),
    option("--samples", type=int, default=3, help="rays along each side of a pixel, for the ray caster"),
    option("--edge", type=float, default=0.08, help="longest edge of the models' triangles"),
    option("--cuts", type=int, default=2, help="cuts of each face into boundary elements, for harmonic truth"),
    option("--quality", default="standard", help="quality of the fits of the fields"),
)

#: The same for a quick run.
SMALL = {"device": "cpu", "scenes": ["animal"], "size": 48, "train_views": 30, "samples": 2, "resolution": 24}
SMALL |= {"edge": 0.15, "cuts": 1, "quality": "fast"}


@command(
    DEVICE,
    *SCENE_OPTIONS,
    option("--poses", nargs="*", default=list(POSES)),
    option(
        "--cases", nargs="*", default=["8 pictures"], choices=list(CASES), help="what is known; default: 8 pictures"
    ),
    option("--figure", help="picture (.jpg): target, start, found, difference, a line for each scene's last pose"),
    JSON,
    QUICK,
)
def known(args) -> None:
    """Known poses found again: the error of fit_pose from pictures that a ray caster made of the posed model.

        python benchmarks poses known --device cuda:0 --json docs/results/poses_known.json --figure fit_pose.jpg
        python benchmarks poses known --quick

    A field is fitted to pictures of the model at rest. The truth of a pose is the model itself, its vertices posed in
    float64 (truth.py), seen by 8 cameras around it; fit_pose begins with the cage at rest. "rms" is the root mean
    square, over the model's vertices, of the distance between where the true and the found pose take them, as a share
    of the cage's size; "start" the same of the start; "worst" the largest distance. A pose counts as found below 1 %.
    """
    if args.quick:
        vars(args).update(SMALL, poses=["bend"])
    args.test_views = 8
    device = quiet_device(args.device)
    rows, lines = [], []
    for name in args.scenes:
        scene = TruthScene(name, args, device)
        deformer = _deformer(scene, args)
        line = []
        for pose, posed in pose_cages(name, scene.cage).items():
            if pose not in args.poses:
                continue
            views = scene.posed_views(posed, args.kind)[0]["carried"]
            truth = _places(scene, posed, args.kind)

            def distances(cage, truth=truth, scene=scene):
                return np.linalg.norm(_places(scene, cage, args.kind) - truth, axis=1) / scene.cage.size

            for case in args.cases:
                start = scene.cage.rotate(CASES[case][4], axis="z")
                begin = time.perf_counter()
                found = warpcage.fit_pose(deformer, _targets(case, scene, views, truth), start=start)
                seconds = time.perf_counter() - begin
                off = distances(found.cage)
                row = {
                    "scene": pathlib.Path(name).stem,
                    "pose": pose,
                    "case": case,
                    "start": _rms(distances(start)),
                    "rms": _rms(off),
                }
                row |= {"worst": float(off.max()), "seconds": seconds, "loss": found.loss}
                row["evaluations"] = sum(len(step.losses) for step in found.history)
                rows.append(row)
                print(row, flush=True)
                rest, seen = (
                    deformer.posed(cage).render(views[0].camera, background="white").rgb for cage in (start, found.cage)
                )
                line = [views[0].image, rest, seen, error_image(seen, views[0].image)]
                if args.json:
                    given = {
                        name: getattr(args, name)
                        for name in ("size", "train_views", "kind", "resolution", "quality", "representation")
                    }
                    write_results(args.json, device, **given, rows=rows)
        lines.append(line)
    for case in args.cases:
        of_case = [row["rms"] for row in rows if row["case"] == case]
        print(f"{case}: {sum(rms < FOUND for rms in of_case)} of {len(of_case)} found, median {np.median(of_case):.2%}")
    if args.figure:
        side = max(1, SHOWN // args.size)  # small pictures are shown with large pixels
        cells = [np.clip(cell, 0, 1).repeat(side, axis=0).repeat(side, axis=1) for line in lines for cell in line]
        sheet = contact_sheet(cells, columns=4)
        write_jpeg(pathlib.Path(args.figure), sheet, quality=85)


@command(DEVICE, *SCENE_OPTIONS, option("--frames", type=int, default=60), JSON, QUICK)
def followed(args) -> None:
    """A bend there and back, followed from picture to picture: the error of fit_poses at each frame.

        python benchmarks poses followed --device cuda:0 --json docs/results/poses_followed.json
        python benchmarks poses followed --quick

    Each frame is 8 ray cast pictures of the model, bent by up to 45 degrees and back; fits begin with the pose before.
    """
    if args.quick:
        vars(args).update(SMALL, frames=3)
    args.test_views = 8
    device, rows = quiet_device(args.device), []
    for name in args.scenes:
        scene = TruthScene(name, args, device)
        deformer, targets, truths = _deformer(scene, args), [], []
        for number in range(args.frames):
            degrees = 45 * np.sin(np.pi * (number + 1) / (args.frames + 1))
            pose = scene.cage.bend(degrees, axis="x", towards="z")
            targets.append(_targets("8 pictures", scene, scene.posed_views(pose, args.kind)[0]["carried"], np.empty(0)))
            truths.append(_places(scene, pose, args.kind))
        begin = time.perf_counter()
        file = warpcage.fit_poses(deformer, targets)
        seconds = time.perf_counter() - begin
        for found, truth in zip([file[key] for key in file.times], truths, strict=True):
            off = np.linalg.norm(_places(scene, found, args.kind) - truth, axis=1) / scene.cage.size
            rows.append(
                {
                    "scene": pathlib.Path(name).stem,
                    "rms": _rms(off),
                    "worst": float(off.max()),
                    "seconds": seconds / args.frames,
                }
            )
        rms = [row["rms"] for row in rows[-args.frames :]]
        third = max(len(rms) // 3, 1)
        print(
            f"{name}: {args.frames} frames, {seconds / args.frames:.2f} s each; rms median {np.median(rms):.2%}, worst "
            f"{max(rms):.2%}; first third {np.mean(rms[:third]):.2%}, last third {np.mean(rms[-third:]):.2%}",
            flush=True,
        )
    if args.json:
        write_results(args.json, device, size=args.size, kind=args.kind, frames=args.frames, rows=rows)


def _deformer(scene: TruthScene, args) -> warpcage.Deformer:
    """A field fitted to pictures of a model at rest, and its cage."""
    options = {"representation": args.representation, "quality": args.quality, "device": scene.device}
    field = warpcage.fit(scene.training(), progress=False, **options)
    resolution = args.resolution if args.representation == "voxels" else None
    return warpcage.Deformer(field, scene.cage, coordinates=args.kind, resolution=resolution, device=scene.device)


def _places(scene: TruthScene, posed: warpcage.Cage, kind: str) -> np.ndarray:
    """(v, 3) where a pose takes the vertices of a model."""
    return inverted(scene.name, scene.mesh, scene.cage, posed, kind, scene.device, cuts=scene.cuts).points


def _targets(case: str, scene: TruthScene, views: list, truth: np.ndarray) -> warpcage.PoseTargets:
    """What a case knows of a pose; views all around come first."""
    count, has_masks, has_depth, landmarks, _ = CASES[case]
    chosen = [views[round(number * len(views) / count * 0.75) % len(views)] for number in range(count)]
    chosen = views if count == len(views) else chosen
    parts: dict = {"images": np.stack([view.image for view in chosen])}
    depths = np.stack([view.depth for view in chosen])
    if has_masks:  # of whole pixels: those at the rim count as the background
        parts["alphas"] = np.isfinite(depths).astype(np.float32)
    if has_depth:
        parts["depths"] = depths
    if landmarks:
        picked = np.random.default_rng(0).choice(len(truth), landmarks, replace=False)
        parts |= {"points": scene.mesh.vertices[picked], "positions": truth[picked]}
    return warpcage.PoseTargets([view.camera for view in chosen], **parts)


def _rms(distances: np.ndarray) -> float:
    return float(np.sqrt((distances**2).mean()))
