"""Fits: what they reach on scenes of several kinds."""

from __future__ import annotations

import dataclasses
import pathlib
import time

import imageio.v3 as iio
import numpy as np
import trimesh
import warp as wp
from common import DEVICE, FIT_OPTIONS, JSON, command, fit_options, option, seconds_of, write_jpeg, write_results
from ground_truth import CASUAL, KINDS, casual_scene, room_views, synthetic_scene

import warpcage
from warpcage import evaluate, mean_psnr
from warpcage.core import resolve_device
from warpcage.fitting import tuned_scene
from warpcage.view import contact_sheet, picture_similarity, pose_errors, shrink, side_by_side, write_png

#: Training views that are rendered to see how far a fit goes beyond what it generalizes, and views named as the worst.
TRAINING_VIEWS, WORST = 16, 3

#: Pixels along each side of a picture on a sheet, or a little more.
SHEET_PIXELS = 240

QUALITIES = ("fast", "standard", "high")


# Scenes


@command(
    option("--kind", nargs="*", choices=list(KINDS), default=list(KINDS), help="which of our own scenes"),
    option("--room", action="store_true", help="a room, and its object with known surroundings"),
    option("--made", nargs="*", choices=list(CASUAL), help="casual captures of our own; without names all of them"),
    option("--whole", action="store_true", help="whole pictures of each --folder, whatever its masks"),
    option("--views", type=int, default=60, help="training views, for kinds that do not fix their number"),
    option("--size", type=int, default=100, help="pixels along each side"),
    option("--opaque", action="store_true", help="fit without the alphas"),
    option("--folder", nargs="*", default=[], help="more scenes, each FOLDER or FOLDER:DOWNSCALE"),
    option("--every", type=int, default=1, help="take every n-th training view of each --folder"),
    option("--pose-noise", type=float, default=0.0, help="degrees that cameras of a --folder are turned"),
    option("--jpeg", type=int, help="pack pictures of a --folder as JPEG of this quality, 1 to 95"),
    option("--refine-cameras", action="store_true", help="refine cameras and exposures with the field"),
    option("--quality", nargs="*", default=["standard"], choices=QUALITIES),
    DEVICE,
    option("--warm", action="store_true", help="compile kernels before the first fit"),
    FIT_OPTIONS,
    option("--worst", help="folder for the worst views"),
    option("--sheet", help="JPEG of the worst view of each fit of a --made capture"),
    JSON,
)
def scenes(args) -> None:
    """How the defaults of a fit do on scenes of several kinds: held-out PSNR, error of opacity, seconds, voxels.

        python benchmarks fits scenes --size 100 --json scenes.json
        python benchmarks fits scenes --size 400 --folder data/lego_800 data/mic_800 data/dtu_scan24_half data/fox:2 \\
            --quality standard fast high --device cuda:0 --warm --json scenes.json --worst worst
        python benchmarks fits scenes --kind "20 views" thin --size 200 --views 60 --option epochs=16
        python benchmarks fits scenes --kind --folder data/lego_800:8 --every 4 --pose-noise 0.2 --jpeg 90
        python benchmarks fits scenes --kind --room --size 400 --whole --folder data/fox:2 data/dtu_scan24_half \\
            --option "background='outer'" --warm
        python benchmarks fits scenes --kind --folder data/lego_800:8 --pose-noise 1 --refine-cameras
        python benchmarks fits scenes --kind --whole --folder data/fox:2 data/tumbler data/can data/bonsai --made \\
            --size 800 --warm --json docs/results/scenes_1.json --sheet docs/pictures/fits_of_captures.jpg

    Seconds run from images in host memory to the finished field. Those of the first scene include the compilation of
    kernels that are not in Warp's cache yet; with --warm a small fit compiles them before. The error of opacity is the
    mean absolute difference to the alphas of the held-out views. --worst FOLDER keeps the worst views, each beside its
    picture.

    --room adds a room of the project's own, seen by cameras in it, and what a fit would reach if all that is around the
    object were known: the object alone, with opacity, before a white background. Beside the PSNR of whole pictures
    stands that of the object's pixels ("psnr_inside"), by which the two compare. --whole takes whole pictures of each
    --folder whatever masks it has. An option `background` is for whole pictures, and left out for those with opacity.

    --made adds casual captures that the project makes itself. Every eighth view of the walk is held out, as it was
    taken, and so are views away from the path, named "aside": their PSNR stands apart ("psnr_aside").

    --pose-noise turns each training camera about a random axis by a normal angle of so many degrees; --jpeg packs the
    training pictures as JPEG of that quality first. Held-out views stay as they are. With --refine-cameras there are
    three more PSNRs: of held-out cameras that moved along with the refined ones near them ("moved"), of those moved by
    the similarity between the exact training cameras and the refined ones ("aligned"), and of those fitted to the field
    one by one ("tuned").

    "memory" is the most that Warp's arrays have held on the GPU from the start of the process to the end of the fit,
    before it is evaluated; "memory_before" is the same up to its begin, evaluations of earlier fits included. Where the
    first is larger, it is the peak of this fit alone: so the quality whose memory matters goes first.
    "frame_milliseconds" is the median over the held-out views, on a GPU.
    """
    wp.config.log_level = wp.LOG_WARNING
    device = resolve_device(args.device)
    options = fit_options(args.option)
    if args.warm:
        train, _ = synthetic_scene("bricks", train_views=8, size=32, device=device)
        for quality in args.quality:
            warpcage.fit(train, device=device, progress=False, quality=quality).render(train.cameras[0])
        whole = dataclasses.replace(train, alphas=None)
        warpcage.fit(whole, device=device, progress=False, background="outer", resolution=32).render(train.cameras[0])
    results, sheet = [], []
    print(f"{'scene':32} quality   views  PSNR dB  training  opacity  seconds    voxels  resolution")
    if args.refine_cameras:
        options["refine_cameras"] = True
    for name, scene, test, exact in scenes_of(args, device):
        for quality in args.quality:
            given = {"quality": quality, **options}
            if scene.alphas is not None:
                given.pop("background", None)
            row, field = scene_row(name, scene, test, exact, device, given)
            results.append(row)
            opacity = "      -" if row["alpha_error"] is None else f"{row['alpha_error']:.5f}"
            print(
                f"{name[-32:]:32} {quality:8}  {row['views']:5d}  {row['psnr']:7.2f}  {row['psnr_training']:8.2f}"
                f"  {opacity}  {row['seconds']:7.1f}  {row['voxels']:8d}  {'x'.join(map(str, row['resolution']))}",
                flush=True,
            )
            if field.refined_cameras is not None:
                figures = ", ".join(f"{what} {row[f'psnr_{what}']:.2f}" for what in ("moved", "aligned", "tuned"))
                print(f"{'':32} {figures} dB", flush=True)
            if row["psnr_aside"] is not None:
                print(f"{'':32} off the path {row['psnr_aside']:.2f} dB", flush=True)
            if args.worst:
                write_worst(pathlib.Path(args.worst), row, field, test)
            if args.sheet and name in CASUAL:
                sheet.append((f"{name} {quality}", padded_pair(worst_pair(row, field, test, 0))))
                write_jpeg(args.sheet, contact_sheet([pair for _, pair in sheet], columns=2, gap=8))
            if args.json:
                content = {"pose_noise": args.pose_noise, "jpeg": args.jpeg, "runs": results}
                if sheet:
                    content["sheet"] = {"file": pathlib.Path(args.sheet).name, "fits": [label for label, _ in sheet]}
                write_results(args.json, device, **content)
            del field  # or the next fit's memory holds it too


def scenes_of(args, device):
    """Yields (name, training views, test views)."""
    for kind in args.kind:
        train, test = synthetic_scene(
            kind, train_views=args.views, size=args.size, alpha=not args.opaque, device=device
        )
        yield kind, train, test, train.cameras
    made = [] if args.made is None else args.made or list(CASUAL)
    for name in made:  # every eighth is held out
        train, test = casual_scene(name, views=args.views + args.views // 7 + 1, size=args.size, device=device)
        yield name, train, test, train.cameras
    if args.room:
        train, test = room_views(args.views, size=args.size, device=device)
        yield "room", train.whole, test.split, train.whole.cameras
        yield "room, surroundings known", train.object, test.object, train.object.cameras
    for folder in args.folder:
        path, _, factor = folder.partition(":")
        given = {"downscale": int(factor or 1), "masks": not args.whole}
        train, test = (warpcage.load_scene(path, split=split, **given) for split in ("train", "test"))
        if args.opaque:
            train = dataclasses.replace(train, alphas=None)
        exact = train.cameras[:: args.every]
        if args.pose_noise:
            train = shaken(train, args.pose_noise)
        if args.jpeg:
            train = squeezed(train, args.jpeg)
        name = pathlib.Path(path).name + (f", 1/{factor}" if factor else "")
        yield name if args.every == 1 else f"{name}, every {args.every}.", every_nth(train, args.every), test, exact


def scene_row(name, scene, test, exact, device, options: dict) -> tuple[dict, warpcage.VoxelField]:
    """One fit: what it reached, and its field. exact: the training cameras as they were before any noise."""
    before = memory_peak(device)
    begin = time.perf_counter()
    field = warpcage.fit(scene, device=device, progress=False, **options)
    wp.synchronize_device(device)
    seconds, memory = time.perf_counter() - begin, memory_peak(device)
    views = evaluate(field, test)
    aside = [row for row in views if row["view"].startswith("aside_")]
    row = {
        "scene": name,
        "views": len(scene),
        "size": scene.images.shape[1],
        "options": options,
        "psnr": mean_psnr([row for row in views if row not in aside]),
        "psnr_aside": mean_psnr(aside) if aside else None,
        "psnr_training": mean_psnr(evaluate(field, every_nth(scene, max(1, len(scene) // TRAINING_VIEWS)))),
        "psnr_inside": inside(views),
        "alpha_error": None if test.surroundings is not None else alpha_error(field, test),
        "worst": sorted((row["psnr"], row["view"]) for row in views)[:WORST],
        "seconds": seconds,
        "memory": memory,
        "memory_before": before,
        "frame_milliseconds": None if device.is_cpu else frame_milliseconds(field, test.cameras, device),
        "voxels": field.voxel_count,
        "resolution": field.resolution,
    }
    if field.refined_cameras is not None:
        row["psnr_moved"] = mean_psnr(evaluate(field, test, moved_along=True))
        row["psnr_aligned"] = mean_psnr(evaluate(field, aligned(field, test, exact)))
        row["psnr_tuned"] = mean_psnr(evaluate(field, tuned_scene(field, test)))
        errors = zip(
            ("turns", "shifts"), pose_errors(poses_of(field.refined_cameras.cameras), poses_of(exact)), strict=True
        )
        row |= {f"{what}_median": float(np.median(values)) for what, values in errors}
    return row, field


def frame_milliseconds(field, cameras, device) -> float:
    """Median over views of what a frame takes."""
    field.render(cameras[0])
    return 1e3 * float(
        np.median([seconds_of(lambda camera=camera: field.render(camera), device) for camera in cameras])
    )


def inside(rows: list[dict]) -> float | None:
    """Mean PSNR of the object's pixels, where alpha or masks separate them."""
    return float(np.mean([row["masked_psnr"] for row in rows])) if "masked_psnr" in rows[0] else None


def poses_of(cameras) -> np.ndarray:
    """(n, 4, 4) camera_to_world."""
    return np.array([camera.camera_to_world for camera in cameras])


def aligned(field, test, exact):
    """Test views moved from the world of the exact training cameras into that of the refined ones."""
    refined, (lower, upper) = field.refined_cameras.cameras, field.bounds
    points = lower + (upper - lower) * (0.2 + 0.3 * np.indices((3, 3, 3)).reshape(3, 27).T)
    motion = picture_similarity(poses_of(exact), poses_of(refined), points)
    zoom = float(np.mean([one.fx / other.fx for one, other in zip(refined, exact, strict=True)]))
    cameras = [
        dataclasses.replace(camera, fx=zoom * camera.fx, fy=zoom * camera.fy) for camera in motion.moved(test.cameras)
    ]
    return dataclasses.replace(test, cameras=cameras)


def memory_peak(device) -> int | None:
    """Most bytes that Warp's arrays have held on a GPU since the process began."""
    return None if device.is_cpu else int(wp.get_mempool_used_mem_high(device))


def alpha_error(field, scene) -> float | None:
    """Mean absolute difference of a field's opacity to a scene's, over its views."""
    if scene.alphas is None:
        return None
    pairs = zip(scene.cameras, scene.alphas, strict=True)
    return float(np.mean([np.abs(field.render(camera).alpha - alpha).mean() for camera, alpha in pairs]))


def write_worst(folder: pathlib.Path, row: dict, field, test) -> None:
    """The worst views of a fit as PNG files, what it renders on the left."""
    folder.mkdir(parents=True, exist_ok=True)
    stem = "_".join([row["scene"], row["options"].get("quality", "standard")])
    for place in range(len(row["worst"])):
        pair = side_by_side(worst_pair(row, field, test, place))
        write_png(folder / f"{stem}_{place}.png".replace(" ", "_").replace(",", "").replace("/", "_"), pair)


def worst_pair(row: dict, field, test, place: int) -> list[np.ndarray]:
    """What a fit renders of one of its worst views, and the picture."""
    index = list(test.names).index(row["worst"][place][1])
    pictures = test.images if field.background_model is None else test.whole
    return [np.clip(field.render(test.cameras[index]).rgb, 0, 1), pictures[index]]


def padded_pair(pair: list[np.ndarray]) -> np.ndarray:
    """Two pictures side by side, in a square each, so that portrait ones and others fit on one sheet."""
    height, width = pair[0].shape[:2]
    down, across = (max(height, width) - side for side in (height, width))
    room = ((down // 2, down - down // 2), (across // 2, across - across // 2), (0, 0))
    factor = max(1, max(height, width) // SHEET_PIXELS)
    return side_by_side([shrink(np.pad(image, room, constant_values=1.0), factor) for image in pair])


def shaken(scene, degrees: float):
    """The scene with cameras turned in place, each about a random axis by a normal angle."""
    random = np.random.default_rng(0)
    cameras = []
    for camera in scene.cameras:
        axis = random.normal(size=3)
        turn = trimesh.transformations.rotation_matrix(np.radians(degrees) * random.normal(), axis)
        cameras.append(dataclasses.replace(camera, camera_to_world=camera.camera_to_world @ turn))
    return dataclasses.replace(scene, cameras=cameras)


def squeezed(scene, quality: int):
    """The scene with its pictures through JPEG, in 8 bits."""
    images = [
        iio.imread(iio.imwrite("<bytes>", np.rint(255 * image).astype(np.uint8), extension=".jpg", quality=quality))
        for image in scene.images
    ]
    return dataclasses.replace(scene, images=np.stack(images).astype(np.float32) / 255)


def every_nth(scene, n: int):
    """Every n-th view of a scene, from the first."""
    parts = {name: getattr(scene, name) for name in ("images", "alphas", "surroundings", "cameras", "names")}
    return dataclasses.replace(scene, **{name: part if part is None else part[::n] for name, part in parts.items()})
