"""Posed splats against ground truth, and what each shortcut of other tools costs."""

from __future__ import annotations

import contextlib
import pathlib
import time

import numpy as np
import trimesh
import warp as wp
from common import DEVICE, JSON, KINDS, QUICK, command, option, quiet_device, write_jpeg, write_results
from ground_truth import CarriedMesh, subdivided_model
from library.truth import CAGES, POSES, Place, View, cameras, inverted, measure, on_white, pose_cages

import warpcage
from warpcage import SplatField
from warpcage.deform import quaternions_of, splat_edits
from warpcage.kernels.splats.splats import Splats
from warpcage.splats import IMAGE_BLUR, binding
from warpcage.view import average_frame, contact_sheet, finer_camera

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

MAPS = ("forward", "backward")

#: Step of the differences that Jacobians are found by, as a share of the cage's size.
DIFFERENCE = 2e-3

#: Pixels along each side that splats are drawn with for one of a picture: the truth has sharp pixels, and the blur of a
#: picture is for splats that were fitted with it.
FINER = 2

#: How many times as large as it was placed the fit may make a splat along an axis: it should stay where its matter is.
GROWTH = 1.5

#: Two halves of an axis that turn against each other by more than this are cut apart, degrees.
CUT_DEGREES = 15.0


@command(
    DEVICE,
    option("--scenes", nargs="*", default=list(SCENES)),
    option("--poses", nargs="*", default=list(POSES)),
    option("--kinds", nargs="*", default=list(KINDS)),
    option("--maps", nargs="*", default=list(MAPS)),
    option("--size", type=int, default=400, help="pixels along each side"),
    option("--test-views", type=int, default=6),
    option("--fit-views", type=int, default=100, help="pictures at rest that splats are fitted to"),
    option("--fit-steps", type=int, default=3000, help="0: splats as they were placed"),
    option("--samples", type=int, default=3, help="rays along each side of a pixel, for the ray caster"),
    option("--edge", type=float, default=0.08, help="longest edge of the models' triangles"),
    option("--most", type=int, default=1 << 30, help="discs of a layer at most"),
    option("--shown", nargs="*", default=["twist", "bend"], help="poses in the figures"),
    JSON,
    option("--figures", help="folder for pictures: truth, deformer, GSDeformer"),
    QUICK,
)
def main(args) -> None:
    """Posed Gaussian splats against ground truth, and what each shortcut costs.

        python benchmarks splats-truth --device cuda:0 --json splats_truth.json --figures docs/pictures
        python benchmarks splats-truth --quick

    Splats are placed on the reference models by construction (flat discs on the surface, with its colors), fitted to
    pictures of the models at rest (warpcage.fit_splats; none of the test's views, and no pose), and posed by cages. The
    model goes where the same map takes its vertices: forward ones by deform_points, backward ones (`map="backward"`,
    what voxels do) where Newton's iteration in float64 finds them (truth.py). Its colors, shadows and highlights are
    carried along, and seen in the direction J^-1 d, J the Jacobian of the map. Rows of one scene, pose, kind of
    coordinates and map:

    - deformer: warpcage.Deformer.
    - truth turned: the same pictures against a truth whose highlights are seen in the direction R^T d, R the rotation
      nearest to J: what files of splats can hold.
    - no turn: harmonics as they are at rest.
    - no split: splats that are large beside the bend stay whole.
    - full opacity: the pieces of a split splat are as opaque as the whole.
    - GSDeformer: seven points of each splat, its center and one standard deviation along each axis both ways, are moved
      by mean value coordinates; half the differences are its new axes; where the two halves of an axis turn against
      each other by more than 15 degrees it is cut in two there, both as opaque as the whole; harmonics as they are
      (after Huang et al., "GSDeformer", 2024: our own reading of it).
    - forward: splats that went forward, in the place where the voxels of a backward map are.

    PSNR is the mean over views; "gloss" scenes have broad and strong highlights, "long" ones few, long splats. "turn"
    is the mean angle of R over the model, "stretch" the range of the singular values of J.
    """
    if args.quick:
        args.device, args.size, args.test_views, args.samples, args.edge, args.most = "cpu", 80, 1, 2, 0.2, 3_000
        args.fit_views, args.fit_steps = 40, 150
        args.scenes, args.poses, args.kinds = ["animal, gloss", "chair, long"], ["bend"], ["mean_value"]
    device = quiet_device(args.device)
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
        write_results(
            args.json, device, scenes=scenes, rows=rows, **sizes
        )  # after each scene, so that an interruption loses little


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
            found = inverted(self.name, self.mesh, self.cage, posed, kind, self.device)
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
        options = {"color": (1, 1, 1), "origin": field.center, "near": field.near, "antialias": True}
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


# Shortcuts of other tools


def without_turns(splats):
    """The same splats with harmonics as they are at rest."""
    plain = Splats()
    for name in ("centers", "covariances", "opacities", "harmonics", "degree", "rows"):
        setattr(plain, name, getattr(splats, name))
    plain.turns = wp.empty(0, dtype=wp.quat, device=splats.centers.device)
    return plain


def without_splits():
    """A context in which Deformers leave every splat whole."""
    return _constants(splat_edits, LARGE=1e30)


def with_opaque_pieces():
    """A context in which the pieces of a splat are as opaque as the whole."""
    table = binding._TABLE.copy()
    table[:, 1] = table[:, 2] = table[:, 0]
    return _constants(binding, _TABLE=table)


@contextlib.contextmanager
def _constants(module, **values):
    """Other values of a module's constants, for a while."""
    before = {name: getattr(module, name) for name in values}
    vars(module).update(values)
    try:
        yield
    finally:
        vars(module).update(before)


def gsdeformer(field: SplatField, cage, posed) -> SplatField:
    """The field as seven points of each splat deform it."""
    held = field.contents
    centers, axes = held.centers.astype(np.float64), field.rotations * field.scales[:, None, :]
    rows = np.arange(len(field))
    for axis in range(3):  # where it is bent it is cut in two
        low, middle, high = _moved_points(cage, posed, centers, axes[:, :, axis])
        halves = [(ends / np.linalg.norm(ends, axis=1, keepdims=True)) for ends in (middle - low, high - middle)]
        bent = np.einsum("ij,ij->i", *halves) < np.cos(np.radians(CUT_DEGREES))
        half = 0.5 * axes[bent, :, axis]
        pieces = axes[bent].copy()
        pieces[:, :, axis] = half
        centers = np.concatenate([centers[~bent], centers[bent] - half, centers[bent] + half])
        axes = np.concatenate([axes[~bent], pieces, pieces])
        rows = np.concatenate([rows[~bent], rows[bent], rows[bent]])
    ends = [_moved_points(cage, posed, centers, axes[:, :, axis]) for axis in range(3)]
    factors = np.stack([(high - low) / 2 for low, _, high in ends], axis=2)
    turns, scales, _ = np.linalg.svd(factors)
    turns[:, :, 2] *= np.sign(np.linalg.det(turns))[:, None]
    values = np.log(np.maximum(scales, 1e-12)), quaternions_of(turns), held.logits[rows], held.harmonics[rows]
    return SplatField(ends[0][1], *values, background="white", up=field.up, device=field.device)


def _moved_points(cage, posed, centers, offsets) -> list[np.ndarray]:
    """Where mean value coordinates take the points before, in and behind each centre."""
    return [warpcage.deform_points(centers + side * offsets, cage, posed) for side in (-1, 0, 1)]


# Splats on the reference models. Each disc lies at a point of the surface that is not within another part of the model,
# spread evenly, and reaches to its neighbors, or as far as there is matter below it: discs do not stand out over edges.
# Its harmonics are those that best fit the ray caster's color of the point, with texture, shadow and highlight, from
# all directions that see it.

#: Standard deviations of a disc: within the surface, as a share of the distance to its neighbors, and across it, as a
#: share of that.
SPREAD, THICKNESS = 0.4, 0.05

#: Opacity in the middle of a disc, and how far below the surface the second layer is, as a share of the same distance.
OPACITY, DEPTH = 0.99, 0.8

#: A disc is made shorter along an axis, by the first of these factors that keeps the places so many standard deviations
#: from its middle this near to the matter, in standard deviations of a round disc. The last is taken anyway.
SHORTER, RIM, CLEARANCE = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15), 1.5, 0.25

#: Directions in the surface of which the long axis of a disc takes that in which it can be longest.
ANGLES = 8

#: Weight that keeps harmonics small where no direction says otherwise.
RIDGE = 1e-3


def splats_on_mesh(
    mesh: CarriedMesh, count: int, *, aspect: float = 1.0, directions: int = 48, seed: int = 0, device=None
):
    """A SplatField of discs on a mesh at rest, up to `count` if no part is within another, and as many below them,
    `aspect` times longer one way and narrower the other."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    layers = []
    for layer in range(2):  # the second one closes what is left between the discs of the first
        points, faces = even_points(shape, count, seed + layer)
        spacing = np.sqrt(shape.area / len(points))
        normals = shape.face_normals[faces]
        places = points - layer * DEPTH * spacing * normals
        seen = mesh.signed_distances(points + 1e-4 * shape.scale * normals) > 0.0
        kept = seen & (mesh.signed_distances(places) < 0.1 * SPREAD * spacing)
        points, faces, normals, places = (each[kept] for each in (points, faces, normals, places))
        corners = trimesh.triangles.points_to_barycentric(shape.triangles[faces], points)[:, :2]
        harmonics = fitted_harmonics(mesh, faces, corners, normals, directions, seed)
        axes, scales = fitted_discs(mesh, places, normals, spacing * SPREAD, aspect)
        layers.append((places, np.log(scales), quaternions_of(axes), harmonics))
    places, scales, turns, harmonics = (np.concatenate(parts) for parts in zip(*layers, strict=True))
    logits = np.full(len(places), np.log(OPACITY / (1 - OPACITY)))
    return warpcage.SplatField(
        places, scales, turns, logits, harmonics, background="white", up=(0, 0, 1), device=device
    )


def fitted_discs(mesh: CarriedMesh, places, normals, spread: float, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Axes (n, 3, 3), one per column, and standard deviations (n, 3) of discs that do not stand out over edges."""
    side = np.where(np.abs(normals[:, :1]) < 0.5, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    u = np.cross(normals, side)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normals, u)
    along, longest = u, np.zeros(len(places))
    for angle in np.pi * np.arange(ANGLES if aspect > 1.0 else 1) / ANGLES:
        axis = np.cos(angle) * u + np.sin(angle) * v
        length = fitting_length(mesh, places, axis, spread * aspect, spread)
        longer = length > longest
        along, longest = np.where(longer[:, None], axis, along), np.where(longer, length, longest)
    across = np.cross(normals, along)
    lengths = [longest, fitting_length(mesh, places, across, spread / aspect, spread), np.full(len(places), spread)]
    scales = np.stack(lengths, axis=1) * np.array([1.0, 1.0, THICKNESS])
    return np.stack([along, across, normals], axis=2), scales


def fitting_length(mesh: CarriedMesh, places, axis, length: float, spread: float) -> np.ndarray:
    """(n,) standard deviation along unit axes, at most `length`, that keeps the rim of a disc at the matter."""
    fitting = np.full(len(places), SHORTER[-1] * length)
    for factor in SHORTER[-2::-1]:
        reach = RIM * factor * length * axis
        beyond = [mesh.signed_distances(places + sign * reach) for sign in (-1, 1)]
        fits = np.maximum(*beyond) <= CLEARANCE * spread
        fitting[fits] = factor * length
    return fitting


def even_points(shape: trimesh.Trimesh, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points spread over a surface with few gaps: of four times as many random ones, those not near a chosen one."""
    from scipy.spatial import cKDTree

    points, faces = trimesh.sample.sample_surface(shape, 5 * count, seed=seed)
    normals = shape.face_normals[faces]
    radius = 0.82 * np.sqrt(shape.area / count)
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
    pairs = pairs[np.einsum("ij,ij->i", normals[pairs[:, 0]], normals[pairs[:, 1]]) > 0.3]  # both sides of a thin part
    first, second = pairs.min(axis=1), pairs.max(axis=1)
    order = np.argsort(second, kind="stable")
    first, second = first[order], second[order]
    begins = np.searchsorted(second, np.arange(len(points) + 1))
    kept = np.zeros(len(points), bool)
    for point in range(len(points)):
        kept[point] = not kept[first[begins[point] : begins[point + 1]]].any()
    return points[kept], faces[kept]


def fitted_harmonics(mesh: CarriedMesh, faces, corners, normals, count: int, seed: int) -> np.ndarray:
    """(n, 16, 3) least squares over directions of the half space that sees each point."""
    from warpcage.splats import sh_basis

    rng = np.random.default_rng(seed)
    fitted = np.empty((len(faces), 16, 3), np.float32)
    for begin in range(0, len(faces), 4096):
        part = slice(begin, begin + 4096)
        towards = rng.normal(size=(len(faces[part]), count, 3))
        towards /= np.linalg.norm(towards, axis=2, keepdims=True)
        facing = np.einsum("nmc,nc->nm", towards, normals[part])
        towards *= np.where(facing > 0, -1, 1)[..., None]
        colors = mesh.shade(faces[part], corners[part], towards) - 0.5
        basis = sh_basis(towards)
        normal = basis.transpose(0, 2, 1) @ basis + RIDGE * count * np.diag([0.0] + [1.0] * 15)
        fitted[part] = np.linalg.solve(normal, basis.transpose(0, 2, 1) @ colors)
    return fitted
