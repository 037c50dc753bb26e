"""Posed Gaussian splats against ground truth, and what each shortcut costs.

    python benchmarks/splats_truth.py --device cuda:0 --json docs/results/splats_truth.json --figures docs/pictures
    python benchmarks/splats_truth.py --quick

Splats are placed on the reference models by construction (splat_scenes.py), fitted to pictures of the models at rest
(warpcage.fit_splats; none of the test's views, and no pose), and posed by cages. The model goes where the same map
takes its vertices: forward ones by deform_points, backward ones (`map="backward"`, what voxels do) where Newton's
iteration in float64 finds them (truth_scenes.py). Its colours, shadows and highlights are carried along, and seen in
the direction J^-1 d, J the Jacobian of the map. Rows of one scene, pose, kind of coordinates and map:

- deformer: warpcage.Deformer.
- truth turned: the same pictures against a truth whose highlights are seen in the direction R^T d, R the rotation
  nearest to J: what files of splats can hold.
- no turn, no split, full opacity, GSDeformer: splat_shortcuts.py.
- forward: splats that went forward, in the place where the voxels of a backward map are.

PSNR is the mean over views; "gloss" scenes have broad and strong highlights, "long" ones few, long splats. "turn" is
the mean angle of R over the model, "stretch" the range of the singular values of J.
"""

from __future__ import annotations

import argparse
import pathlib
import time

import numpy as np
import warp as wp
from ground_truth import measure
from results import write_jpeg, write_results
from splat_scenes import splats_on_mesh
from splat_shortcuts import gsdeformer, with_opaque_pieces, without_splits, without_turns
from truth_scenes import CAGES, POSES, Place, View, cameras, on_white, pose_cages

import warpcage
from warpcage.core.devices import resolve_device
from warpcage.deform import splat_edits
from warpcage.reference.inverse_map import InverseMap
from warpcage.reference.models import subdivided_model
from warpcage.reference.raycast import CarriedMesh
from warpcage.splats.render import IMAGE_BLUR
from warpcage.view.frame import average_frame, finer_camera
from warpcage.view.pictures import contact_sheet

#: Light that is seen from everywhere, and changes with the direction.
GLOSS = {"highlight": 0.8, "shininess": 6.0}

#: Scene -> model, discs of a layer, how much longer than wide they are by its square, and light and texture.
SCENES = {
    "animal": ("animal", 25_000, 1.0, {}),
    "animal, gloss": ("animal", 25_000, 1.0, GLOSS),
    "bricks": ("bricks", 50_000, 1.0, {}),
    "bricks, gloss": ("bricks", 50_000, 1.0, GLOSS),
    "bricks, fine gloss": ("bricks", 120_000, 1.0, GLOSS),
    "chair, gloss": ("chair", 25_000, 1.0, GLOSS),
    "chair, fine gloss": ("chair", 120_000, 1.0, GLOSS),
    "animal, long": ("animal", 2_500, 3.0, {}),
    "chair, long": ("chair", 4_000, 12.0, {"texture": (0.0, 1.0)}),
}
KINDS = ("mean_value", "harmonic", "green")
MAPS = ("forward", "backward")

#: Step of the differences that Jacobians are found by, as a share of the cage's size.
DIFFERENCE = 2e-3

#: Pixels along each side that splats are drawn with for one of a picture: the truth has sharp pixels, and the blur of a
#: picture is for splats that were fitted with it.
FINER = 2

#: How many times as large as it was placed the fit may make a splat along an axis: it should stay where its matter is.
GROWTH = 1.5


def main() -> None:
    args = parse_arguments()
    wp.config.quiet = True
    device = resolve_device(args.device)
    rows, scenes = [], []
    sizes = {name: getattr(args, name) for name in ("size", "test_views", "fit_views", "fit_steps")}
    for name in args.scenes:
        begin = time.perf_counter()
        scene = SplatScene(name, args, device)
        scenes.append(scene.facts)
        print(scene.facts, flush=True)
        pictures = measure_scene(scene, rows, args)
        if args.figures and pictures:
            path = pathlib.Path(args.figures) / f"splats_truth_{name.replace(', ', '_')}.jpg"
            write_jpeg(path, contact_sheet(pictures, columns=3), quality=85)
        print(f"{name}: {time.perf_counter() - begin:.1f} s", flush=True)
        if args.json:  # after each scene, so that an interruption loses little
            write_results(args.json, device, scenes=scenes, rows=rows, **sizes)


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES))
    parser.add_argument("--poses", nargs="*", default=list(POSES))
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--maps", nargs="*", default=list(MAPS))
    parser.add_argument("--size", type=int, default=400, help="pixels along each side")
    parser.add_argument("--test-views", type=int, default=6)
    parser.add_argument("--fit-views", type=int, default=100, help="pictures at rest that splats are fitted to")
    parser.add_argument("--fit-steps", type=int, default=3000, help="0: splats as they were placed")
    parser.add_argument("--samples", type=int, default=3, help="rays along each side of a pixel, for the ray caster")
    parser.add_argument("--edge", type=float, default=0.08, help="longest edge of the models' triangles")
    parser.add_argument("--most", type=int, default=1 << 30, help="discs of a layer at most")
    parser.add_argument("--shown", nargs="*", default=["twist", "bend"], help="poses in the figures")
    parser.add_argument("--json")
    parser.add_argument("--figures", help="folder for pictures: truth, deformer, GSDeformer")
    parser.add_argument("--quick", action="store_true", help="small, on the CPU")
    args = parser.parse_args()
    if args.quick:
        args.device, args.size, args.test_views, args.samples, args.edge, args.most = "cpu", 80, 1, 2, 0.2, 3_000
        args.fit_views, args.fit_steps = 40, 150
        args.scenes, args.poses, args.kinds = ["animal, gloss", "chair, long"], ["bend"], ["mean_value"]
    return args


class SplatScene:
    """A model at rest, the splats on it, its cage, and its views."""

    def __init__(self, name: str, args, device):
        self.name, self.args, self.device = name, args, device
        self.model, count, aspect, light = SCENES[name]
        self.mesh = CarriedMesh(*subdivided_model(self.model, args.edge), device=device, **light)
        self.cage = warpcage.Cage.load(CAGES / f"{self.model}.obj")
        self.field = splats_on_mesh(self.mesh, min(count, args.most), aspect=aspect, device=device)
        views = self.views(Place(self.mesh.vertices, None, np.zeros(3)))
        self.facts = {"scene": name, "splats": len(self.field), "cage_vertices": len(self.cage.vertices)}
        if args.fit_steps:
            self.facts["placed"] = measure(self.pictures(self.field.splats, views), views, self.cage.size)
            self.field, self.facts["fit_seconds"] = self.fitted()
        self.facts |= measure(self.pictures(self.field.splats, views), views, self.cage.size)

    @property
    def has_pieces(self) -> bool:
        """Whether some splats are cut."""
        return bool(np.exp(self.field.contents.log_scales.max()) > 0.5 * splat_edits.LARGE * self.cage.size)

    def fitted(self) -> tuple[warpcage.SplatField, float]:
        """The splats, fitted to pictures at rest from all sides, and how many seconds that took."""
        args = self.args
        places = cameras(np.zeros(3), args.fit_views, args.size, sphere=True)
        rgba, _ = self.mesh.render(places, samples=args.samples)
        begin = time.perf_counter()
        field = warpcage.fit_splats(
            self.field,
            places,
            on_white(rgba),
            steps=args.fit_steps,
            supersampling=FINER,
            blur=IMAGE_BLUR / FINER**2,  # that of the finer picture
            antialias=True,
            growth=GROWTH,
            progress=False,
        )
        return field, time.perf_counter() - begin

    def place(self, posed, kind: str, map: str) -> Place:
        """Where a pose takes the model, and the Jacobians there of the map back to rest."""
        vertices = self.mesh.vertices
        if map == "backward":
            found = InverseMap(self.cage, posed, kind, device=self.device).invert(vertices)
            lost = int((found.residuals > 1e-8 * self.cage.size).sum())
            if lost:
                raise ValueError(f"{lost} vertices of {self.name} have no place in the {kind} pose")
            points, matrices = found.points, found.jacobians
        else:
            points = warpcage.deform_points(vertices, self.cage, posed, kind, device=self.device)
            matrices = np.linalg.inv(jacobians(vertices, self.cage, posed, kind, self.device))
        return Place(points, matrices, (points.min(axis=0) + points.max(axis=0)) / 2)

    def views(self, place: Place) -> list[View]:
        args = self.args
        places = cameras(place.middle, args.test_views, args.size, sphere=False)
        rgba, depth = self.mesh.render(places, posed=place.points, view_matrices=place.jacobians, samples=args.samples)
        return [View(*view) for view in zip(places, on_white(rgba), depth, strict=True)]

    def pictures(self, splats, views: list[View], field=None) -> list:
        """What the views see of splats, before white."""
        field = self.field if field is None else field
        options = {"colour": (1, 1, 1), "origin": field.center, "near": field.near, "antialias": True}
        fine = [field.renderer.render(splats, finer_camera(view.camera, FINER), **options) for view in views]
        return [average_frame(frame, FINER) for frame in fine]


def measure_scene(scene: SplatScene, rows: list[dict], args) -> list[np.ndarray]:
    """Add the rows of a scene, and return pictures: truth, deformer and GSDeformer of each pose that is shown."""
    poses = {name: cage for name, cage in pose_cages(scene.model, scene.cage).items() if name in args.poses}
    shown: dict[str, list] = {}
    for kind in args.kinds:
        ways = {map: Way(scene, kind, map=map) for map in dict.fromkeys(("forward", *args.maps))}
        for pose, posed in poses.items():
            for map in args.maps:
                place = scene.place(posed, kind, map)
                turned, facts = turned_place(place)
                truth = scene.views(place)
                measured = {"deformer": (ways[map].frames(posed, truth), truth)}
                if map == "backward":
                    measured["forward"] = ways["forward"].frames(posed, truth), truth
                else:
                    measured["truth turned"] = measured["deformer"][0], scene.views(turned)
                    shortcuts = ways[map].shortcuts(posed, truth)
                    measured |= {what: (frames, truth) for what, frames in shortcuts.items()}
                    if pose in args.shown and "GSDeformer" in shortcuts:
                        frames = measured["deformer"][0][0], shortcuts["GSDeformer"][0]
                        shown[pose] = [truth[0].image, *(np.clip(frame.rgb, 0, 1) for frame in frames)]
                for what, (frames, against) in measured.items():
                    row = {"scene": scene.name, "pose": pose, "kind": kind, "map": map, "what": what}
                    row |= facts | measure(frames, against, scene.cage.size, similarity=what == "deformer")
                    row["to_ceiling"] = row["psnr"] - scene.facts["psnr"]
                    rows.append(row)
                    print(row, flush=True)
    return [picture for line in shown.values() for picture in line]


class Way:
    """Deformers of one kind and map, bound once, and the shortcuts beside them."""

    def __init__(self, scene: SplatScene, kind: str, *, map: str):
        self.scene, self.kind = scene, kind
        options = {"coordinates": kind, "map": map}
        self.deformer = warpcage.Deformer(scene.field, scene.cage, **options)
        self.cut = {}
        if scene.has_pieces and map == "forward":
            for name, shortcut in (("no split", without_splits), ("full opacity", with_opaque_pieces)):
                with shortcut():
                    self.cut[name] = warpcage.Deformer(scene.field, scene.cage, **options)

    def frames(self, posed, views: list[View]) -> list:
        return self.scene.pictures(self.deformer.pose(posed).posed_splats(), views)

    def shortcuts(self, posed, views: list[View]) -> dict[str, list]:
        scene = self.scene
        frames = {"no turn": scene.pictures(without_turns(self.deformer.pose(posed).posed_splats()), views)}
        for name, deformer in self.cut.items():
            frames[name] = scene.pictures(deformer.pose(posed).posed_splats(), views)
        if self.kind == "mean_value":
            other = gsdeformer(scene.field, scene.cage, posed)
            frames["GSDeformer"] = scene.pictures(other.splats, views, other)
        return frames


def turned_place(place: Place) -> tuple[Place, dict]:
    """The same place with directions turned only, and how far the pose turns and stretches the model."""
    u, back, v = np.linalg.svd(place.jacobians)
    turns = u @ v
    angles = np.degrees(np.arccos(np.clip((np.einsum("nii->n", turns) - 1) / 2, -1, 1)))
    facts = {"turn": float(angles.mean()), "stretch": [float(1 / back.max()), float(1 / back.min())]}
    return Place(place.points, turns, place.middle), facts


def jacobians(points, cage, posed, kind: str, device) -> np.ndarray:
    """(n, 3, 3) of the forward map at points, by central differences."""
    step = DIFFERENCE * cage.size
    columns = []
    for axis in np.eye(3):
        ends = [
            warpcage.deform_points(points + side * step * axis, cage, posed, kind, device=device) for side in (1, -1)
        ]
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(columns, axis=2)


if __name__ == "__main__":
    main()
