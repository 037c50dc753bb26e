"""Posed Gaussian splats against ground truth, and what each shortcut costs.

    python benchmarks/splats_truth.py --device cuda:0 --json docs/results/splats_truth.json --figures docs/pictures
    python benchmarks/splats_truth.py --quick

Splats are placed on the reference models by construction (splat_scenes.py), so that what they show at rest is known,
and posed by cages. Truth of a pose: the model with its vertices where the same map takes them (deform_points), its
colours, shadows and highlights carried along and seen in the direction J^-1 d, J the Jacobian of the map; see
truth_scenes.py.
Rows of one scene, pose and kind of coordinates:

- deformer: warpcage.Deformer.
- no turn: harmonics as they are at rest.
- no split: splats that are large beside the bend stay whole.
- full opacity: the pieces of a split splat are as opaque as the whole.
- GSDeformer: seven points of each splat, its centre and one standard deviation along each axis both ways, are moved by
  mean value coordinates; half the differences are its new axes; where the two halves of an axis turn against each
  other by more than 15 degrees it is cut in two there, both as opaque as the whole; harmonics as they are (after Huang
  et al., "GSDeformer", 2024: our own reading of it).

PSNR is the mean over views; "gloss" scenes have broad and strong highlights, "long" ones few, long splats.
"""

from __future__ import annotations

import argparse
import contextlib
import pathlib
import time

import numpy as np
import warp as wp
from ground_truth import measure
from results import write_jpeg, write_results
from splat_scenes import splats_on_mesh
from truth_scenes import CAGES, POSES, View, cameras, pose_cages

import warpcage
from warpcage.core.devices import resolve_device
from warpcage.deform import splat_edits
from warpcage.kernels.splats.splats import Splats
from warpcage.reference.carried_mesh import CarriedMesh
from warpcage.reference.models import subdivided_model
from warpcage.splats import splitting
from warpcage.splats.splat_field import SplatField
from warpcage.view.pictures import contact_sheet

#: Scene -> model, splats, and the light: "gloss" is seen from everywhere, and changes with the direction.
SCENES = {
    "animal": ("animal", 60_000, {}),
    "animal, gloss": ("animal", 60_000, {"highlight": 0.8, "shininess": 6.0}),
    "animal, long": ("animal", 2_500, {}),
    "chair, gloss": ("chair", 60_000, {"highlight": 0.8, "shininess": 6.0}),
    "bricks": ("bricks", 60_000, {}),
}

#: How much longer than wide the splats of "long" scenes are, by its square: they are cut where they are bent.
LONG = 3.0
KINDS = ("mean_value", "harmonic", "green")

#: Step of the differences that Jacobians are found by, as a share of the cage's size.
DIFFERENCE = 2e-3

#: Two halves of an axis that turn against each other by more than this are cut apart, degrees.
CUT_DEGREES = 15.0


def main() -> None:
    args = parse_arguments()
    wp.config.quiet = True
    device = resolve_device(args.device)
    rows, scenes = [], []
    for name in args.scenes:
        begin = time.perf_counter()
        model, count, light = SCENES[name]
        mesh = CarriedMesh(*subdivided_model(model, args.edge), device=device, **light)
        cage = warpcage.Cage.load(CAGES / f"{model}.obj")
        aspect = LONG if name.endswith("long") else 1.0
        field = splats_on_mesh(mesh, min(count, args.most), aspect=aspect, device=device)
        views = truth_views(mesh, np.zeros(3), None, None, args)
        ceiling = measure([picture(field, field.splats, view) for view in views], views, cage.size)
        scenes.append({"scene": name, "splats": len(field), "cage_vertices": len(cage.vertices), **ceiling})
        print(scenes[-1], flush=True)
        line = []
        for pose, posed in pose_cages(model, cage).items():
            if pose not in args.poses:
                continue
            for kind in args.kinds:
                truth, frames = measure_pose(mesh, cage, posed, kind, field, args)
                for what, shown in frames.items():
                    rows.append({"scene": name, "pose": pose, "kind": kind, "what": what})
                    rows[-1] |= measure(shown, truth, cage.size, similarity=what == "deformer")
                    rows[-1]["to_ceiling"] = rows[-1]["psnr"] - ceiling["psnr"]
                    print(rows[-1], flush=True)
                if pose in args.shown and "GSDeformer" in frames:
                    line += [view.image for view in truth[:1]]
                    line += [np.clip(frames[what][0].rgb, 0, 1) for what in ("deformer", "GSDeformer")]
        if args.figures and line:
            path = pathlib.Path(args.figures) / f"splats_truth_{name.replace(', ', '_')}.jpg"
            write_jpeg(path, contact_sheet(line, columns=3), quality=85)
        print(f"{name}: {time.perf_counter() - begin:.1f} s", flush=True)
        if args.json:
            write_results(args.json, device, size=args.size, test_views=args.test_views, scenes=scenes, rows=rows)
    print(table(scenes, rows))


def table(scenes, rows) -> str:
    """The rows in Markdown: PSNR of the deformer, and how far below it each shortcut is, dB."""
    shortcuts = ["no turn", "no split", "full opacity", "GSDeformer"]
    ceilings = {scene["scene"]: scene["psnr"] for scene in scenes}
    lines = ["| scene | at rest | pose | kind | deformer | " + " | ".join(shortcuts) + " |", "| --- " * 9 + "|"]
    for row in rows:
        if row["what"] != "deformer":
            continue
        place = ("scene", "pose", "kind")
        beside = {other["what"]: other["psnr"] for other in rows if all(other[key] == row[key] for key in place)}
        cells = [f"{beside[name] - row['psnr']:+.2f}" if name in beside else "–" for name in shortcuts]
        names = [row["scene"], f"{ceilings[row['scene']]:.2f}", row["pose"], row["kind"].replace("_", " ")]
        lines.append("| " + " | ".join([*names, f"{row['psnr']:.2f}", *cells]) + " |")
    return "\n".join(lines)


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--poses", nargs="*", default=list(POSES))
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--size", type=int, default=400, help="pixels along each side")
    parser.add_argument("--test-views", type=int, default=6)
    parser.add_argument("--samples", type=int, default=3, help="rays along each side of a pixel, for the ray caster")
    parser.add_argument("--edge", type=float, default=0.08, help="longest edge of the models' triangles")
    parser.add_argument("--most", type=int, default=1 << 30, help="splats of a scene at most")
    parser.add_argument("--shown", nargs="*", default=["twist", "bend"], help="poses in the figures")
    parser.add_argument("--json")
    parser.add_argument("--figures", help="folder for pictures: truth, deformer, GSDeformer")
    parser.add_argument("--quick", action="store_true", help="small, on the CPU")
    args = parser.parse_args()
    if args.quick:
        args.device, args.size, args.test_views, args.samples, args.edge, args.most = "cpu", 160, 2, 2, 0.15, 20_000
        args.scenes, args.poses, args.kinds = ["animal, gloss", "animal, long"], ["rigid", "bend"], ["mean_value"]
    return args


def measure_pose(mesh, cage, posed, kind: str, field: SplatField, args):
    """The truth of a pose, and the frames of each way to show it."""
    points = warpcage.deform_points(mesh.vertices, cage, posed, kind, device=mesh.device)
    back = np.linalg.inv(jacobians(mesh.vertices, cage, posed, kind, mesh.device))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    truth = truth_views(mesh, middle, points, back, args)

    def deformed(turned=True):
        splats = warpcage.Deformer(field, cage, coordinates=kind).pose(posed).posed_splats()
        return [picture(field, splats if turned else without_turns(splats), view) for view in truth]

    frames = {"deformer": deformed(), "no turn": deformed(turned=False)}
    if np.exp(field.contents.log_scales.max()) > 0.5 * splat_edits.LARGE * cage.size:  # some are cut
        with constants(splat_edits, LARGE=1e30):
            frames["no split"] = deformed()
        table = splitting._TABLE.copy()
        table[:, 1] = table[:, 2] = table[:, 0]
        with constants(splitting, _TABLE=table):
            frames["full opacity"] = deformed()
    if kind == "mean_value":
        other = gsdeformer(field, cage, posed)
        frames["GSDeformer"] = [picture(other, other.splats, view) for view in truth]
    return truth, frames


@contextlib.contextmanager
def constants(module, **values):
    """Other values of a module's constants, for a while."""
    before = {name: getattr(module, name) for name in values}
    vars(module).update(values)
    yield
    vars(module).update(before)


def truth_views(mesh: CarriedMesh, target, points, back, args) -> list[View]:
    places = cameras(target, args.test_views, args.size, sphere=False)
    rgba, depth = mesh.render(places, posed=points, view_matrices=back, samples=args.samples)
    images = (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]).astype(np.float32)
    return [View(*view) for view in zip(places, images, depth, strict=True)]


def picture(field: SplatField, splats, view: View):
    """These splats were not fitted, so that the blur of a picture must add nothing to them."""
    return field.renderer.render(
        splats, view.camera, colour=(1, 1, 1), origin=field.center, near=field.near, antialias=True
    )


def without_turns(splats):
    """The same splats with harmonics as they are at rest."""
    plain = Splats()
    for name in ("centres", "covariances", "opacities", "harmonics", "degree", "rows"):
        setattr(plain, name, getattr(splats, name))
    plain.turns = wp.empty(0, dtype=wp.quat, device=splats.centres.device)
    return plain


def jacobians(points, cage, posed, kind: str, device) -> np.ndarray:
    """(n, 3, 3) of the map at points, by central differences."""
    step = DIFFERENCE * cage.size
    columns = []
    for axis in np.eye(3):
        ends = [
            warpcage.deform_points(points + side * step * axis, cage, posed, kind, device=device) for side in (1, -1)
        ]
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=2)


def gsdeformer(field: SplatField, cage, posed) -> SplatField:
    """The field as seven points of each splat deform it."""
    held = field.contents
    centres, axes = held.centres.astype(np.float64), field.rotations * field.scales[:, None, :]
    rows = np.arange(len(field))
    for axis in range(3):  # where it is bent it is cut in two
        low, middle, high = moved_points(cage, posed, centres, axes[:, :, axis])
        halves = [(ends / np.linalg.norm(ends, axis=1, keepdims=True)) for ends in (middle - low, high - middle)]
        bent = np.einsum("ij,ij->i", *halves) < np.cos(np.radians(CUT_DEGREES))
        half = 0.5 * axes[bent, :, axis]
        pieces = axes[bent].copy()
        pieces[:, :, axis] = half
        centres = np.concatenate([centres[~bent], centres[bent] - half, centres[bent] + half])
        axes = np.concatenate([axes[~bent], pieces, pieces])
        rows = np.concatenate([rows[~bent], rows[bent], rows[bent]])
    ends = [moved_points(cage, posed, centres, axes[:, :, axis]) for axis in range(3)]
    factors = np.stack([(high - low) / 2 for low, _, high in ends], axis=2)
    u, scales, _ = np.linalg.svd(factors)
    u[:, :, 2] *= np.sign(np.linalg.det(u))[:, None]
    quaternions = np.array([wp.quat_from_matrix(wp.mat33(*matrix.ravel())) for matrix in u])[:, [3, 0, 1, 2]]
    values = (np.log(np.maximum(scales, 1e-12)), quaternions, held.logits[rows], held.harmonics[rows])
    return SplatField(ends[0][1], *values, background="white", up=field.up, device=field.device)


def moved_points(cage, posed, centres, offsets) -> list[np.ndarray]:
    """Where mean value coordinates take the points before, in and behind each centre."""
    return [warpcage.deform_points(centres + side * offsets, cage, posed) for side in (-1, 0, 1)]


if __name__ == "__main__":
    main()
