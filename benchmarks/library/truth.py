"""Deformed fields against ground truth: ray cast models posed in float64, the shortcuts of earlier code, coverage.

Truth of a pose: a Deformer shows at x what the field holds at phi(x), phi from coordinates of the *deformed* cage. So a
vertex p of the model belongs where phi(x) = p, which Newton's iteration finds in float64
(ground_truth/inverse_map.py: closed forms, or boundary elements for harmonic coordinates). Coordinates on the rest
cage applied to the deformed one, the usual way with meshes, are another map.

Light: a captured field holds the light that fell on the object at rest, so the truth carries color, shadows and
highlights along, seen in the direction J d with J the Jacobian of phi (the limit of the paper's Eq. 4). TRUTHS names
two others, to measure what this costs against a new capture: "turned" takes highlights along by the rotation nearest to
J only, "relit" lights the posed object by lights fixed to the world.
"""

from __future__ import annotations

import dataclasses
import pathlib
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import trimesh
import warp as wp
from common import DEVICE, HERE, JSON, KINDS, QUICK, command, option, quiet_device, write_jpeg, write_results
from ground_truth import CarriedMesh, InverseMap, subdivided_model

import warpcage
from warpcage import Scene
from warpcage.fitting import ssim
from warpcage.view import contact_sheet

SCENES = ("bricks", "animal", "chair")
POSES = ("rigid", "twist", "bend", "stretch", "local")
TRUTHS = ("carried", "turned", "relit")
CAGES = HERE / "cages"
FOV_DEGREES, DISTANCE = 39.6, 4.0


# Fields


@command(
    DEVICE,
    option("--scenes", nargs="*", default=list(SCENES)),
    option("--poses", nargs="*", help="names of pose_cages; default: all"),
    option("--kinds", nargs="*", default=list(KINDS)),
    option("--resolution", type=int, nargs="*", default=[64, 128, 256]),
    option("--middle", type=int, default=128, help="resolution of the extra rows"),
    option("--extra", nargs="*", default=["bend"], help="poses of march and nearest-voxel rows"),
    option("--refit", nargs="*", default=list(POSES), help="poses to which a separate field is fitted"),
    option("--size", type=int, default=400, help="pixels along each side"),
    option("--train-views", type=int, default=120),
    option("--test-views", type=int, default=6),
    option("--samples", type=int, default=3, help="rays along each side of a pixel, for the ray caster"),
    option("--edge", type=float, default=0.08, help="longest edge of the models' triangles"),
    option("--cuts", type=int, default=3, help="cuts of each face into boundary elements"),
    option("--quality", default="standard", help="quality of the fits"),
    option("--shown", nargs="*", default=["twist", "bend"], help="poses in the figure"),
    JSON,
    option("--figures", help="folder for pictures: at rest, truth, deformed field, error x 5"),
    QUICK,
)
def fields(args) -> None:
    """Deformed fields against ground truth: fields of ray cast models posed by cages, and the models posed in float64.

        python benchmarks truth fields --device cuda:0 --json docs/results/ground_truth.json --figures docs/pictures
        python benchmarks truth fields --quick

    For each scene a field is fitted to pictures of the model at rest. Its PSNR, SSIM and depth error on test views at
    rest are the ceiling: a deformed field can hardly be better than the field. The same is measured for each pose, kind
    of coordinates and lattice resolution ("null" is precise), against pictures of the posed model; truth.py says what
    those are and how they are lit. "fit of the pose" is a field fitted to as many pictures of the pose itself, which
    shows what any field can achieve on this scene. Depth errors are means over pixels that truth and field both cover,
    as a share of the cage's size.

    Against the harmonic truth these are measured too: other kinds of light, half the march step, the paper's density,
    and the cost of shortcuts at 128 cells:

    - nearest voxel: harmonic boundary values are put at the lattice nodes nearest to the cage's surface instead of at
      the crossings of grid edges with it, and Laplace's equation is solved for the rest;
    - weight sum: weights are zero at nodes outside the cage, and a sample counts as inside where the interpolated sum
      of weights exceeds a threshold (0.98 in the authors' published code); the sum is not divided out. No distance to
      the cage is known;
    - march, plain directions: the field is asked for its color along the direction of the ray in posed space. "march"
      rows are composited here. They check the deformer's frames, and are what plain directions are compared with.
    """
    if args.quick:
        args.device, args.size, args.train_views, args.test_views, args.samples = "cpu", 48, 30, 2, 2
        args.scenes, args.poses, args.resolution, args.middle = ["animal"], ["rigid", "bend"], [32], 32
        args.edge, args.cuts, args.quality, args.refit = 0.15, 1, "fast", ["bend"]
    device = quiet_device(args.device)
    scenes, rows = [], []
    for name in args.scenes:
        begin = time.perf_counter()
        scene = TruthScene(name, args, device)
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
        if args.json:  # after each scene, so that an interruption loses little
            names = ("size", "train_views", "test_views", "quality", "cuts", "middle")
            given = {name: getattr(args, name) for name in names} | {"samples": args.samples**2}
            write_results(args.json, device, **given, scenes=scenes, rows=rows)


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
                    "what": what,
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
    """The extra rows of one harmonic pose."""
    middle = {"resolution": args.middle}
    for truth in TRUTHS[1:]:
        report(frames, f"truth {truth}", truths[truth], **middle)
    report([deformer.render(view.camera, step=0.5 * deformer.field.step) for view in views], "half step", **middle)
    paper = warpcage.Deformer(
        deformer.field, deformer.edits[0].cage, coordinates="harmonic", resolution=args.middle, density="paper"
    ).pose(posed)
    report([paper.render(view.camera) for view in views], "density paper", **middle)
    for plain in (False, True) if slow else ():
        marched = [march(deformer, view.camera, plain_directions=plain, stride=2) for view in views[:1]]
        thinned = [View(view.camera, view.image[::2, ::2], view.depth[::2, ::2]) for view in views[:1]]
        report(marched, "march, plain directions" if plain else "march", thinned, **middle)
    for threshold in (0.5, 0.98):
        use_weight_sums(deformer.pose(posed), threshold)
        report([deformer.render(view.camera) for view in views], f"weight sum {threshold}", **middle)
    if slow:
        unknowns = use_nearest_voxels(deformer.pose(posed), posed)
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
            frame.rgb, frame.alpha, frame.depth  # noqa: B018 (copied to the host here, one after another)
    with ThreadPoolExecutor() as pool:
        psnrs, ssims, errors = zip(*pool.map(one, frames, views), strict=True)
    result = {"psnr": float(np.mean(psnrs))} | ({"ssim": float(np.mean(ssims))} if similarity else {})
    if errors[0] is not None:
        together = np.concatenate(errors)
        result |= {"depth_mean": float(together.mean() / size), "depth_median": float(np.median(together) / size)}
    return result


def picture_line(scene, view, frame) -> list[np.ndarray]:
    """At rest, truth, deformed field, and five times the difference of the last two on white."""
    rest = scene.rest_views()[0].image
    rgb = np.clip(frame.rgb, 0, 1)
    return [rest, view.image, rgb, np.clip(1 - 5 * np.abs(rgb - view.image), 0, 1)]


# Coverage


@command(
    DEVICE,
    option("--size", type=int, default=200),
    option("--test-views", type=int, default=4),
    option("--edge", type=float, default=0.15),
    JSON,
)
def coverage(args) -> None:
    """How much of the test pictures of `truth fields` the object covers, at rest and posed.

        python benchmarks truth coverage --device cpu --json docs/results/coverage.json

    The PSNR of a picture falls by 10 log10 of the share that is covered, whatever the field. What a pose loses or gains
    that way is not due to the deformation. Poses use mean value coordinates; the other kinds differ little.
    """
    device = quiet_device(args.device)
    rows = []
    vars(args).update(train_views=1, samples=1, cuts=1)
    for name in SCENES:
        scene = TruthScene(name, args, device)
        rest = covered(scene.rest_views())
        for pose, cage in pose_cages(name, scene.cage).items():
            posed = covered(scene.posed_views(cage, "mean_value")[0]["carried"])
            decibels = float(-10 * np.log10(posed / rest))
            rows.append({"scene": name, "pose": pose, "rest": rest, "posed": posed, "decibels": decibels})
            print(rows[-1], flush=True)
    write_results(args.json, device, size=args.size, test_views=args.test_views, rows=rows)


def covered(views) -> float:
    """Mean share of the pixels that the object covers."""
    return float(np.mean([np.isfinite(view.depth).mean() for view in views]))


# Models at rest and posed


def pose_cages(name: str, rest: warpcage.Cage) -> dict[str, warpcage.Cage]:
    """The moderate poses of a scene: each moves parts by 0.1 to 0.4 of the cage's size."""
    bend_axis, towards = {"animal": ("x", "y"), "chair": ("z", "y")}.get(name, ("x", "z"))
    corner = rest.vertices[rest.vertices.sum(axis=1).argmax()]  # of models of other files
    offset, center = {
        "bricks": ((0.25, -0.15, 0.2), (1.0, 0.0, 0.5)),
        "animal": ((0.1, 0.25, 0.2), (0.9, 0.0, 0.7)),
        "chair": ((-0.25, 0.2, 0.1), (-0.4, 0.0, 0.9)),
    }.get(name, (0.1 * rest.size * np.array([1.0, -0.6, 0.8]), corner))
    return {
        "rigid": rest.rotate(35, axis="x").rotate(50, axis="z"),
        "twist": rest.twist(45),
        "bend": rest.bend(45, axis=bend_axis, towards=towards),
        "stretch": rest.stretch(1.5, axis="x", limits=(0.4, 0.9)),
        "local": rest.move(offset, center=center, radius=0.9),
    }


def cameras(target, count: int, size: int, *, sphere: bool) -> list[warpcage.Camera]:
    """Spread evenly over the sphere (training), or once around between 5 and 50 degrees up (test)."""
    k = np.arange(count) + 0.5
    turn = 2 * np.pi * k * (np.sqrt(5) - 1) / 2 if sphere else 2 * np.pi * k / count
    height = 1 - 2 * k / count if sphere else np.sin(np.radians(27.5 + 22.5 * np.sin(2 * turn + 0.5)))
    flat = np.sqrt(1 - height**2)
    eyes = np.asarray(target) + DISTANCE * np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    return [warpcage.Camera.look_at(eye, target, fov_degrees=FOV_DEGREES, width=size, height=size) for eye in eyes]


@dataclasses.dataclass
class View:
    """A camera, what it must see on white (h, w, 3), and the depth (h, w), inf where a pixel is not covered whole."""

    camera: warpcage.Camera
    image: np.ndarray
    depth: np.ndarray


@dataclasses.dataclass
class Place:
    """Vertices of a posed model (v, 3), the Jacobians there of the map back to rest (v, 3, 3), and the middle."""

    points: np.ndarray
    jacobians: np.ndarray
    middle: np.ndarray


class TruthScene:
    """A model, its cage, its training pictures, and its views at rest and in any pose.

    name: of SCENES, or a mesh file with colours, its cage in an .obj of the same name beside it.
    """

    def __init__(self, name: str, args, device):
        self.name, self.size, self.train_views, self.test_views = name, args.size, args.train_views, args.test_views
        self.samples, self.cuts, self.device = args.samples, args.cuts, device
        if name in SCENES:
            self.mesh = CarriedMesh(*subdivided_model(name, args.edge), device=device)
            self.cage = warpcage.Cage.load(CAGES / f"{name}.obj")
        else:
            shown: Any = trimesh.load(name, force="mesh", process=False)
            colors = shown.visual.face_colors[:, :3] / 255.0
            self.mesh = CarriedMesh(shown.vertices, shown.faces, colors, texture=(0.0, 1.0), device=device)
            self.cage = warpcage.Cage.load(pathlib.Path(name).with_suffix(".obj"))
        self._placed = None

    def training(self) -> Scene:
        """The pictures at rest that the field is fitted to, with alpha."""
        return self._pictures((0, 0, 0), None, None)

    def posed_training(self, posed: warpcage.Cage, kind: str) -> Scene:
        """As many "carried" pictures of a pose, from all around it, to which a field of the pose itself is fitted."""
        place = self._place(posed, kind)
        return self._pictures(place.middle, place.points, place.jacobians)

    def _pictures(self, target, points, matrices) -> Scene:
        views = cameras(target, self.train_views, self.size, sphere=True)
        rgba, _ = self.mesh.render(views, posed=points, view_matrices=matrices, samples=self.samples)
        return Scene(images=on_white(rgba), cameras=views, alphas=rgba[..., 3])

    def rest_views(self) -> list[View]:
        return self._views(np.zeros(3), None, None, False)

    def posed_views(self, posed: warpcage.Cage, kind: str, truths=("carried",)) -> tuple[dict[str, list[View]], dict]:
        """Views of each of `truths`, and facts about the pose. Raises ValueError where a vertex has no place."""
        place = self._place(posed, kind)
        u, stretch, v = np.linalg.svd(place.jacobians)
        matrices = {"carried": place.jacobians, "turned": u @ v, "relit": None}
        views = {truth: self._views(place.middle, place.points, matrices[truth], truth == "relit") for truth in truths}
        facts = {
            "largest_move": float(np.linalg.norm(place.points - self.mesh.vertices, axis=1).max()),
            "stretch": [float(1 / stretch.max()), float(1 / stretch.min())],
        }
        return views, facts

    def _place(self, posed: warpcage.Cage, kind: str) -> Place:
        """Where a pose takes the model; the last one is kept."""
        if self._placed is None or self._placed[0] is not posed or self._placed[1] != kind:
            found = inverted(self.name, self.mesh, self.cage, posed, kind, self.device, cuts=self.cuts)
            middle = (found.points.min(axis=0) + found.points.max(axis=0)) / 2
            self._placed = posed, kind, Place(found.points, found.jacobians, middle)
        return self._placed[2]

    def _views(self, target, points, matrices, light_stays) -> list[View]:
        places = cameras(target, self.test_views, self.size, sphere=False)
        rgba, depth = self.mesh.render(
            places, posed=points, view_matrices=matrices, light_stays=light_stays, samples=self.samples
        )
        return [View(*view) for view in zip(places, on_white(rgba), depth, strict=True)]


def on_white(rgba: np.ndarray) -> np.ndarray:
    """(..., 3) float32 colors of pictures with opacity (..., 4), before white."""
    return (rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]).astype(np.float32)


def inverted(name: str, mesh, cage, posed, kind: str, device, **options):
    """Where the vertices of a model go by the map of a pose. Raises ValueError where one has no place."""
    found = InverseMap(cage, posed, kind, device=device, **options).invert(mesh.vertices)
    lost = int((found.residuals > 1e-8 * cage.size).sum())
    if lost:
        raise ValueError(f"{lost} vertices of {name} have no place in the {kind} pose")
    return found


# A small scene


@command(option("folder", type=pathlib.Path, help="where scene, field.npz and cage.obj go"))
def prepare(args) -> None:
    """Make the small brick scene, field and cage that the quick benchmarks of run_all.py use.

    python benchmarks truth prepare FOLDER
    """
    from warpcage.demo import write_brick_scene

    folder = args.folder
    write_brick_scene(folder / "scene", train_views=24, test_views=2, size=48, device="cpu")
    scene = warpcage.load_scene(folder / "scene")
    warpcage.fit(scene, device="cpu", quality="fast", epochs=1.0, progress=False).save(folder / "field.npz")
    warpcage.Cage.load(CAGES / "bricks.obj").save(folder / "cage.obj")


# Shortcuts of earlier code, put into a posed Deformer


def use_nearest_voxels(deformer, posed, tolerance: float = 1e-5) -> int:
    """Replace the harmonic map of a deformer posed to the cage `posed`. Returns the number of unknowns."""
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import cg

    edit = deformer.posed_edits().lattices.posed()[0][0]
    cage_map, origin, rest = edit.deformed, deformer.field.center, deformer.edits[0].cage
    distance, positions = cage_map.distance.numpy(), cage_map.positions.numpy().astype(np.float64)
    lower, spacing = np.array(cage_map.lower) + origin, cage_map.spacing
    fixed, values = _surface_values(posed, rest.vertices - origin, lower, spacing, distance.shape)
    flat = positions.reshape(-1, 3)
    flat[fixed] = values
    unknown = distance.ravel() < 0
    unknown[fixed] = False
    number = np.full(unknown.size, -1)
    number[unknown] = np.arange(unknown.sum())  # rows of the unknowns
    rows, columns, right = [], [], np.zeros((unknown.sum(), 3))
    nodes = np.flatnonzero(unknown)
    for stride in (distance.shape[1] * distance.shape[2], distance.shape[2], 1):
        for neighbor in (nodes - stride, nodes + stride):
            known = ~unknown[neighbor]
            right[known] += flat[neighbor[known]]
            rows.append(np.flatnonzero(~known))
            columns.append(number[neighbor[~known]])
    diagonal = np.arange(len(nodes))
    rows, columns = np.concatenate([*rows, diagonal]), np.concatenate([*columns, diagonal])
    entries = np.concatenate([np.full(len(rows) - len(nodes), -1.0), np.full(len(nodes), 6.0)])
    matrix = csr_array((entries, (rows, columns)))
    for axis in range(3):
        flat[nodes, axis], info = cg(matrix, right[:, axis], x0=flat[nodes, axis], rtol=tolerance, maxiter=2000)
        if info:
            raise ValueError("the nearest-voxel solution did not converge")
    cage_map.positions.assign(positions.astype(np.float32))
    _remark(deformer, edit)
    return len(nodes)


def _surface_values(cage, targets, lower, spacing, shape):
    """Nodes nearest to points spread over the cage, and for each the mean of the targets interpolated at its points."""
    a, b, c = (cage.vertices[cage.faces[:, k]] for k in range(3))
    longest = np.max([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)])
    steps = int(np.ceil(3 * longest / spacing))
    i, j = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1), indexing="ij")
    keep = i + j <= steps
    shares = np.stack([i[keep], j[keep], steps - i[keep] - j[keep]], axis=1) / steps
    places = np.einsum("sk,fkc->fsc", shares, cage.vertices[cage.faces]).reshape(-1, 3)
    values = np.einsum("sk,fkc->fsc", shares, targets[cage.faces]).reshape(-1, 3)
    nodes = np.ravel_multi_index(np.rint((places - lower) / spacing).astype(int).T, shape)
    found, inverse, counts = np.unique(nodes, return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(inverse, values[:, k]) for k in range(3)], axis=1)
    return found, total / counts[:, None]


def use_weight_sums(deformer, threshold: float) -> None:
    """Decide inside or outside, in both cages of a posed deformer, by the sum of weights."""
    edit = deformer.posed_edits().lattices.posed()[0][0]
    origin = deformer.field.center
    inside = edit.deformed.distance.numpy() < 0
    positions = edit.deformed.positions.numpy()
    positions[~inside] = -origin  # a sum of zero weights is the world's origin
    edit.deformed.positions.assign(positions)
    edit.deformed.distance.assign(((threshold - inside) * edit.deformed.spacing).astype(np.float32))
    rest = edit.rest.distance.numpy() < 0
    # the case is only asked for beside the deformed cage; `leaves`, which earlier code did not know, is left alone
    edit.rest.distance = wp.array(
        np.where(rest, -4.0, 4.0).astype(np.float32) * np.float32(edit.rest.spacing),
        dtype=float,
        device=deformer.device,
    )
    _remark(deformer, edit)


def _remark(deformer, edit) -> None:
    """Let a deformer's tables follow a map that was changed under it."""
    edit.deformed.side_index = wp.zeros(0, dtype=int, device=deformer.device)
    deformer.posed_edits().lattices.settle_cells()


def march(deformer, camera, *, plain_directions: bool, stride: int = 1, chunk: int = 4_000_000) -> np.ndarray:
    """A frame of a posed deformer on white, (h, w, 3), composited from Deformer.to_canonical and VoxelField.sample.

    stride: take every stride-th pixel along each side. Samples are one march step of the field apart, and opacity
    follows canonical arc length, as in the deformer's own frames.
    """
    frame = deformer.render(camera, background="white")
    field, step = deformer.field, deformer.field.step
    alpha = frame.alpha[::stride, ::stride]
    seen = np.flatnonzero(alpha.ravel() > 1e-4)
    centers, directions = (part[::stride, ::stride].reshape(-1, 3)[seen] for part in camera.rays())
    corners = np.concatenate([field.bounds, deformer.deformed[0].bounds])
    distance = np.linalg.norm(corners.mean(axis=0) - camera.center)
    reach = 0.5 * np.linalg.norm(np.ptp(corners, axis=0))
    t = np.arange(max(distance - reach, step), distance + reach, step)
    image = np.ones((alpha.size, 3))
    rays = max(1, chunk // len(t))
    for first in range(0, len(seen), rays):
        part = slice(first, first + rays)
        x = (centers[part, None] + t[:, None] * directions[part, None]).astype(np.float32)
        d = np.broadcast_to(directions[part, None], x.shape).astype(np.float32)
        canonical, along, region = deformer.to_canonical(x.reshape(-1, 3), d.reshape(-1, 3))
        rgb, density = field.sample(canonical, d.reshape(-1, 3) if plain_directions else along)
        region, canonical = region.reshape(x.shape[:2]), canonical.reshape(x.shape)
        density = np.where(region == 1, 0.0, density.reshape(x.shape[:2]))
        arc = np.full(density.shape, step)
        both = (region[:, :-1] == 2) & (region[:, 1:] == 2)
        arc[:, :-1][both] = np.linalg.norm(np.diff(canonical, axis=1), axis=2)[both]
        depth = np.cumsum(density * arc, axis=1)
        light = np.exp(-np.concatenate([np.zeros((len(depth), 1)), depth], axis=1))
        weight = light[:, :-1] - light[:, 1:]
        image[seen[part]] = (weight[..., None] * rgb.reshape(*x.shape[:2], 3)).sum(axis=1) + light[:, -1:]
    return image.reshape(*alpha.shape, 3)
