"""How the defaults of a fit do on scenes of several kinds: PSNR on held-out views, error of opacity, seconds, voxels.

    python benchmarks/fit_scenes.py --size 100 --json scenes.json
    python benchmarks/fit_scenes.py --size 400 --folder data/lego_800 data/mic_800 data/dtu_scan24_half data/fox:2 \
        --quality standard fast high --device cuda:0 --warm --json scenes.json --worst worst
    python benchmarks/fit_scenes.py --kind "20 views" thin --size 200 --views 60 --option epochs=16
    python benchmarks/fit_scenes.py --kind --folder data/lego_800:8 --every 4 --pose-noise 0.2 --jpeg 90
    python benchmarks/fit_scenes.py --kind --room --size 400 --whole --folder data/fox:2 data/dtu_scan24_half \
        --option "background='outer'" --warm
    python benchmarks/fit_scenes.py --kind --folder data/lego_800:8 --pose-noise 1 --refine-cameras

Seconds run from images in host memory to the finished field. Those of the first scene include the compilation of
kernels that are not in Warp's cache yet; with --warm a small fit compiles them before. The error of opacity is the mean
absolute difference to the alphas of the held-out views. --worst FOLDER keeps the worst views, each beside its picture.

--room adds a room of the project's own, seen by cameras in it, and what a fit would reach if all that is around the
object were known: the object alone, with opacity, before a white background. Beside the PSNR of whole pictures stands
that of the object's pixels ("psnr_inside"), by which the two compare. --whole takes whole pictures of each --folder
whatever masks it has. An option `background` is for whole pictures, and left out for those with opacity.

--pose-noise turns each training camera about a random axis by a normal angle of so many degrees; --jpeg packs the
training pictures as JPEG of that quality first. Held-out views stay as they are. With --refine-cameras there are two
more PSNRs: of held-out cameras moved by the similarity between the exact training cameras and the refined ones
("aligned"), and of held-out cameras fitted to the field one by one ("tuned").

"memory" is the most that Warp's arrays have held on the GPU from the start of the process to the end of the fit, before
it is evaluated; "memory_before" is the same up to its begin, evaluations of earlier fits included. Where the first is
larger, it is the peak of this fit alone: so the quality whose memory matters goes first. benchmarks/fits_page.py makes
a page of the JSON files.
"""

import argparse
import ast
import dataclasses
import pathlib
import time

import imageio.v3 as iio
import numpy as np
import trimesh
import warp as wp
from results import write_results

import warpcage
from warpcage.core.devices import resolve_device
from warpcage.fitting.cameras import tuned_scene
from warpcage.fitting.evaluation import evaluate, mean_psnr
from warpcage.reference.scenes import KINDS, room_views, synthetic_scene
from warpcage.view.alignment import picture_similarity, pose_errors
from warpcage.view.pictures import side_by_side, write_png

#: Training views that are rendered to see how far a fit goes beyond what it generalises.
TRAINING_VIEWS = 16

#: Views of a scene that are named as its worst.
WORST = 3


def measure(name, scene, test, exact, device, options: dict) -> tuple[dict, warpcage.VoxelField]:
    """One fit: what it reached, and its field. exact: the training cameras as they were before any noise."""
    before = memory_peak(device)
    begin = time.perf_counter()
    field = warpcage.fit(scene, device=device, progress=False, **options)
    wp.synchronize_device(device)
    seconds, memory = time.perf_counter() - begin, memory_peak(device)
    views = evaluate(field, test)
    row = {
        "scene": name,
        "views": len(scene),
        "size": scene.images.shape[1],
        "options": options,
        "psnr": mean_psnr(views),
        "psnr_training": mean_psnr(evaluate(field, every_nth(scene, max(1, len(scene) // TRAINING_VIEWS)))),
        "psnr_inside": inside(views),
        "alpha_error": None if test.surroundings is not None else alpha_error(field, test),
        "worst": sorted((row["psnr"], row["view"]) for row in views)[:WORST],
        "seconds": seconds,
        "memory": memory,
        "memory_before": before,
        "voxels": field.voxel_count,
        "resolution": field.resolution,
    }
    if field.refined_cameras is not None:
        row["psnr_aligned"] = mean_psnr(evaluate(field, aligned(field, test, exact)))
        row["psnr_tuned"] = mean_psnr(evaluate(field, tuned_scene(field, test)))
        errors = zip(
            ("turns", "shifts"), pose_errors(poses_of(field.refined_cameras.cameras), poses_of(exact)), strict=True
        )
        row |= {f"{what}_median": float(np.median(values)) for what, values in errors}
    return row, field


def inside(rows: list[dict]) -> float | None:
    """Mean PSNR of the object's pixels, where the views tell which those are."""
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
    pictures = test.images if field.background_model is None else test.whole
    stem = "_".join([row["scene"], row["options"].get("quality", "standard")])
    for place, (_, view) in enumerate(row["worst"]):
        index = list(test.names).index(view)
        pair = side_by_side([np.clip(field.render(test.cameras[index]).rgb, 0, 1), pictures[index]])
        write_png(folder / f"{stem}_{place}.png".replace(" ", "_").replace(",", "").replace("/", "_"), pair)


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


def scenes_of(args, device):
    """Yields (name, training views, test views)."""
    for kind in args.kind:
        train, test = synthetic_scene(
            kind, train_views=args.views, size=args.size, alpha=not args.opaque, device=device
        )
        yield kind, train, test, train.cameras
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", nargs="*", choices=list(KINDS), default=list(KINDS), help="which of our own scenes")
    parser.add_argument("--room", action="store_true", help="a room, and its object with known surroundings")
    parser.add_argument("--whole", action="store_true", help="whole pictures of each --folder, whatever its masks")
    parser.add_argument("--views", type=int, default=60, help="training views, for kinds that do not fix their number")
    parser.add_argument("--size", type=int, default=100, help="pixels along each side")
    parser.add_argument("--opaque", action="store_true", help="fit without the alphas")
    parser.add_argument("--folder", nargs="*", default=[], help="more scenes, each FOLDER or FOLDER:DOWNSCALE")
    parser.add_argument("--every", type=int, default=1, help="take every n-th training view of each --folder")
    parser.add_argument("--pose-noise", type=float, default=0.0, help="degrees that cameras of a --folder are turned")
    parser.add_argument("--jpeg", type=int, help="pack pictures of a --folder as JPEG of this quality, 1 to 95")
    parser.add_argument("--refine-cameras", action="store_true", help="refine cameras and exposures with the field")
    parser.add_argument("--quality", nargs="*", default=["standard"], choices=["fast", "standard", "high"])
    parser.add_argument("--device", default=None)
    parser.add_argument("--warm", action="store_true", help="compile kernels before the first fit")
    parser.add_argument("--option", nargs="*", default=[], help="FitOptions as name=value")
    parser.add_argument("--worst", help="folder for the worst views")
    parser.add_argument("--json", help="file for the results")
    args = parser.parse_args()
    device = resolve_device(args.device)
    options = {name: ast.literal_eval(value) for name, value in (pair.split("=", 1) for pair in args.option)}
    if args.warm:
        train, _ = synthetic_scene("bricks", train_views=8, size=32, device=device)
        for quality in args.quality:
            warpcage.fit(train, device=device, progress=False, quality=quality).render(train.cameras[0])
        whole = dataclasses.replace(train, alphas=None)
        warpcage.fit(whole, device=device, progress=False, background="outer", resolution=32).render(train.cameras[0])
    results = []
    print(f"{'scene':32} quality   views  PSNR dB  training  opacity  seconds    voxels  resolution")
    if args.refine_cameras:
        options["refine_cameras"] = True
    for name, scene, test, exact in scenes_of(args, device):
        for quality in args.quality:
            given = {"quality": quality, **options}
            if scene.alphas is not None:
                given.pop("background", None)
            row, field = measure(name, scene, test, exact, device, given)
            results.append(row)
            opacity = "      -" if row["alpha_error"] is None else f"{row['alpha_error']:.5f}"
            print(
                f"{name[-32:]:32} {quality:8}  {row['views']:5d}  {row['psnr']:7.2f}  {row['psnr_training']:8.2f}"
                f"  {opacity}  {row['seconds']:7.1f}  {row['voxels']:8d}  {'x'.join(map(str, row['resolution']))}",
                flush=True,
            )
            if field.refined_cameras is not None:
                print(f"{'':32} aligned {row['psnr_aligned']:.2f}, tuned {row['psnr_tuned']:.2f} dB", flush=True)
            if args.worst:
                write_worst(pathlib.Path(args.worst), row, field, test)
            if args.json:
                content = {"pose_noise": args.pose_noise, "jpeg": args.jpeg, "runs": results}
                write_results(args.json, device, **content)


if __name__ == "__main__":
    wp.config.log_level = wp.LOG_WARNING
    main()
