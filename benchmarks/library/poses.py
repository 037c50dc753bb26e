"""Known poses found again from ray cast pictures of the posed model, and between two captures of a phone."""

from __future__ import annotations

import dataclasses
import pathlib
import tempfile
import time

import numpy as np
from common import DEVICE, JSON, QUICK, command, option, quiet_device, write_jpeg, write_results
from ground_truth import TEXTURE, CarriedMesh, InverseMap, PhonePath, subdivided_model, table_scene, take_picture

import warpcage
from warpcage.fitting import error_image
from warpcage.view import contact_sheet

from .captures import errors, similarity
from .truth import CAGES, POSES, SCENES, TruthScene, inverted, pose_cages

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


# Two captures

#: Each capture: the way of the phone, and factors of red, green and blue that its pictures are taken with.
WALKS = {
    "rest": (PhonePath(degrees=330, rise=(14, 45), shake=(0.2, 0.05), waves=3.5, nearer=0.1, seed=1), (1.0, 1.0, 1.0)),
    "bent": (
        PhonePath(
            degrees=260, start=20, distance=3.9, rise=(10, 52), shake=(0.25, 0.05), waves=2.3, nearer=0.15, seed=2
        ),
        (0.9, 0.85, 0.76),
    ),
}

#: Degrees that a phone's pictures show across; share of the time between two in which rows are read; quality of JPEG.
WIDE, READOUT, JPEG_QUALITY = 62.0, 0.03, 92

#: What is compared: pictures of the second capture, and whether exposures are found.
CAPTURED_CASES = {"all pictures": (None, True), "8 pictures": (8, True), "all pictures, one exposure": (None, False)}


@command(
    DEVICE,
    option("--scene", default="animal", choices=SCENES),
    option("--degrees", type=float, default=45.0, help="by which the object is bent sideways between the captures"),
    option("--pictures", type=int, nargs=2, default=[40, 24], help="of each capture"),
    option("--size", type=int, nargs=2, default=[320, 240], help="width and height of the pictures"),
    option("--samples", type=int, default=2, help="rays along each side of a pixel, for the ray caster"),
    option("--edge", type=float, default=0.08, help="longest edge of the model's triangles"),
    option("--drift", type=float, nargs=2, default=[0.1, 0.03], help="of exposures, and of colours, up and down"),
    option(
        "--folder", type=pathlib.Path, help="where pictures/ and both/, the capture, are kept; both/ is not made anew"
    ),
    option("--true-cameras", action="store_true", help="no capture: what its errors cost"),
    option("--known-cage", action="store_true", help="the model's own cage, not one around what is selected"),
    option("--vertices", type=int, default=100, help="of the cage around what is selected"),
    option("--downscale", type=int, default=1, help="of the pictures that the field is fitted to"),
    option("--quality", default="fast", help="of the fit of the field"),
    option("--resolution", type=int, help="of the field"),
    option("--cells", type=int, default=64, help="of the map's lattice"),
    option("--max-pixels", type=int, default=320, help="of the pictures that the pose is fitted to"),
    option("--restarts", type=int, default=32),
    option("--cases", nargs="*", default=["all pictures"], choices=list(CAPTURED_CASES)),
    option("--figure", help="picture (.jpg): target, start, found, difference of three pictures"),
    JSON,
    QUICK,
)
def captured(args) -> None:
    """A pose found between two captures of a phone, through the program as a user runs it.

        python benchmarks poses captured --device cuda:0 --json docs/results/poses_captured.json
        python benchmarks poses captured --quick

    A ray caster films a model on a table in a room, twice: on other ways, with exposures and white balances that drift
    and differ, and with the model bent in between, its light and shadows as they fall then. `capture` finds the cameras
    of all pictures together; a field is fitted to the first ones, the object is chosen by a click, a cage put around
    it, and `fit_pose` gets the second ones, whole. "rms" is as in `poses known`, after the similarity that takes the
    true cameras' places nearest to those found; parts of the model that the cage does not hold stay.
    """
    if args.quick:
        vars(args).update(device="cpu", pictures=[20, 5], size=[64, 48], samples=1, edge=0.2, true_cameras=True)
        vars(args).update(known_cage=True, resolution=48, cells=24, max_pixels=64, restarts=0, degrees=30.0)
    device = quiet_device(args.device)
    seen = phone_object(args.scene, args.degrees, args.edge, device)
    with tempfile.TemporaryDirectory() as temporary:
        both, true = two_captures(args.folder or pathlib.Path(temporary), seen, args)
    rotation, scale, shift = similarity(*(np.array([each.center for each in part]) for part in (true, both.cameras)))
    seen = seen.moved(scale, rotation, shift)
    first, second = (both.subset([k for k, name in enumerate(both.names) if label in name]) for label in WALKS)
    begin = time.perf_counter()
    options = {"quality": args.quality, "device": device, "progress": False}
    field = warpcage.fit(first, **options | ({} if args.resolution is None else {"resolution": args.resolution}))
    facts = {"fit_seconds": time.perf_counter() - begin, "cameras": errors(both.cameras, true, seen.bounds / scale)}
    facts["psnr"] = warpcage.mean_psnr(warpcage.evaluate(field, first.subset(slice(0, None, 8))))
    print(facts, flush=True)
    cage = seen.cage if args.known_cage else chosen_cage(field, first.cameras[0], seen, args.vertices)
    deformer = warpcage.Deformer(field, cage, coordinates="mean_value", resolution=args.cells)
    rows = []
    for case in args.cases:
        count, exposure = CAPTURED_CASES[case]
        chosen = second if count is None else second.subset(np.linspace(0, len(second) - 1, count).round())
        begin = time.perf_counter()
        given = {"exposure": exposure, "max_pixels": args.max_pixels, "restarts": args.restarts}
        found = warpcage.fit_pose(deformer, chosen, **given)
        row = {"scene": args.scene, "case": case, "pictures": len(chosen), "seconds": time.perf_counter() - begin}
        for name, pose in (("start", cage), ("rms", found.cage)):
            off = np.linalg.norm(seen.places(cage, pose) - seen.posed, axis=1) / seen.cage.size
            row[name] = _rms(off)
        rows.append(row | {"worst": float(off.max()), "median": float(np.median(off)), "loss": found.loss})
        print(rows[-1], flush=True)
    names = ("pictures", "size", "degrees", "drift", "true_cameras", "known_cage", "quality", "max_pixels", "restarts")
    write_results(args.json, device, **{name: getattr(args, name) for name in names}, **facts, rows=rows)
    if args.figure:
        cells = []
        for number in np.linspace(0, len(second) - 1, 5).round().astype(int)[1:4]:
            image, camera = second.images[number], second.cameras[number]
            start, end = (deformer.posed(pose).render(camera).rgb for pose in (cage, found.cage))
            gain = (image * end).sum(axis=(0, 1)) / (end**2).sum(axis=(0, 1))
            cells += [image, start, end, error_image(np.clip(gain * end, 0, 1), image)]
        write_jpeg(pathlib.Path(args.figure), contact_sheet([np.clip(cell, 0, 1) for cell in cells], columns=4))


@dataclasses.dataclass(frozen=True)
class PhoneObject:
    """A model on a table, its cage and its pose."""

    mesh: CarriedMesh  # of all, the model's vertices first
    faces: np.ndarray  # (f, 3) of the model
    rest: np.ndarray  # (v, 3) the model's vertices
    posed: np.ndarray  # (v, 3) where the pose takes them
    cage: warpcage.Cage

    @property
    def bounds(self) -> np.ndarray:
        """(2, 3) a box around the model in both poses."""
        both = np.concatenate([self.rest, self.posed])
        return np.stack([both.min(axis=0), both.max(axis=0)])

    def moved(self, scale: float, rotation: np.ndarray, shift: np.ndarray) -> PhoneObject:
        """Model and cage after a similarity; the mesh stays."""
        rest, posed, corners = (
            scale * each @ rotation.T + shift for each in (self.rest, self.posed, self.cage.vertices)
        )
        return dataclasses.replace(self, rest=rest, posed=posed, cage=self.cage.with_vertices(corners))

    def places(self, cage: warpcage.Cage, pose: warpcage.Cage) -> np.ndarray:
        """(v, 3) where a pose of a cage takes the model; what the cage does not hold stays."""
        found = InverseMap(cage, pose, "mean_value", device=self.mesh.device).invert(self.rest)
        return np.where((found.residuals > 1e-8 * cage.size)[:, None], self.rest, found.points)


def phone_object(name: str, degrees: float, edge: float, device) -> PhoneObject:
    """A model on a table, bent sideways by its cage, so that it stays on the table."""
    vertices, faces, colors = subdivided_model(name, edge)
    mesh = CarriedMesh(*table_scene((vertices, faces, colors)), texture=TEXTURE, device=device)
    rest = mesh.vertices[: len(vertices)]
    cage = warpcage.Cage.load(CAGES / f"{name}.obj").translate((rest - vertices)[0])
    pose = cage.bend(degrees, axis="x", towards="y")
    return PhoneObject(mesh, faces, rest, InverseMap(cage, pose, "mean_value", device=device).invert(rest).points, cage)


def two_captures(folder: pathlib.Path, seen: PhoneObject, args) -> tuple[warpcage.Scene, list[warpcage.Camera]]:
    """The pictures of both captures with their cameras as a capture finds them, and the true cameras."""
    scene, pictures, true = folder / "both", folder / "pictures", {}
    for (label, (route, gain)), count in zip(WALKS.items(), args.pictures, strict=True):
        even, random = np.linspace(0, 1, count), np.random.default_rng(route.seed)
        waves = np.sin(2 * np.pi * (random.uniform(0.7, 2, 4) * even[:, None] + random.uniform(0, 1, 4)))
        random = np.random.default_rng(route.seed)
        steps = np.clip(even + 0.3 / count * random.uniform(-1, 1, count), 0, 1)
        gains = np.asarray(gain) * np.exp(args.drift[0] * waves[:, :1] + args.drift[1] * waves[:, 1:])
        for number, (step, light) in enumerate(zip(steps, gains, strict=True)):
            name = f"{label}_{number:03d}"
            true[name] = phone_camera(args.size, route.pose(step))
            if not scene.exists():
                image = phone_picture(seen, route, step, true[name], READOUT / count, label == "bent", args.samples)
                write_jpeg(pictures / f"{name}.jpg", np.clip(light * image, 0, 1), quality=JPEG_QUALITY)
    if args.true_cameras:
        images = [warpcage.view.read_image(pictures / f"{name}.jpg")[..., :3] for name in sorted(true)]
        cameras, low, high = [true[name] for name in sorted(true)], *seen.bounds
        bounds = np.stack([low - 0.1, high + 0.1])
        return warpcage.Scene(np.stack(images), None, cameras, names=sorted(true), bounds=bounds), cameras
    if not scene.exists():
        print(warpcage.capture(pictures, scene, progress=False).summary(), flush=True)
    both = warpcage.load_scene(scene, split="all", downscale=args.downscale)
    return both, [true[name] for name in both.names]


def phone_camera(size: list[int], pose: np.ndarray) -> warpcage.Camera:
    width, height = size
    focal = 0.5 * width / np.tan(np.radians(WIDE) / 2)
    return warpcage.Camera(focal, focal, width / 2, height / 2, width, height, pose)


def phone_picture(seen, route, step: float, camera, readout: float, is_bent: bool, samples: int) -> np.ndarray:
    """A picture (h, w, 3) whose rows are taken one after another; lights stay where they are."""
    vertices = np.concatenate([seen.posed if is_bent else seen.rest, seen.mesh.vertices[len(seen.rest) :]])

    def render(cameras):
        return seen.mesh.render(cameras, posed=vertices, light_stays=True, samples=samples)[0][..., :3]

    return take_picture(render, route, step, camera, readout=readout, strips=8)[0]


def chosen_cage(field, camera: warpcage.Camera, seen: PhoneObject, count: int) -> warpcage.Cage:
    """A cage around what a click on the object chooses, in the middle of its thickest part, as a hand would."""
    from scipy.ndimage import distance_transform_edt

    alone = CarriedMesh(seen.rest, seen.faces, np.ones(seen.faces.shape), device=seen.mesh.device)
    depth = distance_transform_edt(alone.render([camera], samples=1)[0][0, ..., 3])
    row, column = np.unravel_index(depth.argmax(), depth.shape)
    chosen = warpcage.select_object(field, camera=camera, pixel=(int(column), int(row)))
    return warpcage.Cage.from_field(chosen, count)


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
