"""Captures against true cameras: of a video that the project ray casts, and of pictures whose cameras are known."""

from __future__ import annotations

import argparse
import itertools
import pathlib
import tempfile
import time

import numpy as np
import warp as wp
from common import DEVICE, JSON, UsageError, command, option, write_results
from ground_truth import PhonePath, write_phone_video

import warpcage
from warpcage.view import shrink


@command(
    option("--video", action="store_true", help="the ray cast video"),
    option("--width", type=int, default=384, help="of the video, pixels; a multiple of 32"),
    option("--video-frames", type=int, default=120, help="frames that the video has"),
    option("--frames", type=int, default=48, help="frames that are taken of it"),
    option("--degrees", type=float, default=250.0, help="that its camera walks around"),
    option("--fit", action="store_true", help="also compare fits of the video with found and true cameras"),
    option("--downscale", type=int, default=1, help="of the pictures that are fitted"),
    option("--resolution", type=int, help="of these fits"),
    option("--epochs", type=float, help="of these fits"),
    option("--quality", default="fast", help="of these fits"),
    option("--folder", nargs="*", default=[], help="scenes whose cameras are known; their pictures are captured"),
    option("--source", type=pathlib.Path, help="folder of pictures that is captured in place of the scene's own"),
    option("--pictures", type=pathlib.Path, help="text file that names those of them that are used"),
    option("--feature-size", type=int, default=800),
    DEVICE,
    JSON,
)
def main(args) -> None:
    """Captures against true cameras: of a video that the project ray casts, and of pictures whose cameras are known.

        python benchmarks captures --video --fit --json docs/results/captures_1_video.json
        python benchmarks captures --folder ../shared/data/fox --json docs/results/captures_2_fox.json

    Found cameras are compared after the similarity that fits their places best (rotation, place as a share of the
    cameras' distance from the object), and by the turns from each picture to the next and between any two, which need
    no alignment. --fit fits the captured scene and one of the same frames with the true cameras, and compares PSNR on
    frames held out.
    """
    if not args.video and not args.folder:
        raise UsageError("give --video, --folder, or both")
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        if args.video:
            runs.append(video_run(pathlib.Path(folder), args))
            print(runs[-1])
        for number, scene in enumerate(args.folder):
            runs.append(folder_run(pathlib.Path(scene), pathlib.Path(folder) / str(number), args))
            print(runs[-1])
    write_results(args.json, args.device, runs=runs)


def captured(source: pathlib.Path, output: pathlib.Path, **options) -> tuple[warpcage.CaptureReport, dict]:
    """A capture, and the time that it took."""
    began, used = time.perf_counter(), time.process_time()
    report = warpcage.capture(source, output, **options)
    low, high = report.elevation
    return report, {
        "pictures": len(report.pictures),
        "registered": report.registered_count,
        "seconds": time.perf_counter() - began,
        "cpu_seconds": time.process_time() - used,
        "reprojection_error": report.error,
        "points": report.points,
        "agreement": report.facts["share_of_matches_that_agree"],
        "around": 360 - report.around,
        "elevation": [low, high],
        "size": list(report.size),
    }


def folder_run(folder: pathlib.Path, output: pathlib.Path, args: argparse.Namespace) -> dict:
    """The pictures of a scene without its cameras, or others of the same names."""
    scene = warpcage.load_scene(folder, split="all", masks=False)
    own = (folder / "images", folder / "image", folder)
    pictures = args.source or next(each for each in own if any(each.glob("*.[pj][np]g")))
    _, run = captured(pictures, output, feature_size=args.feature_size, pictures=args.pictures)
    found = warpcage.load_scene(output, split="all")
    true = dict(zip(scene.names, scene.cameras, strict=True))
    both = [(camera, true[name]) for name, camera in zip(found.names, found.cameras, strict=True) if name in true]
    label = f"{folder.name}, {args.pictures.stem}" if args.pictures else folder.name
    return {"scene": label, **run, **errors(*zip(*both, strict=True), scene.bounds)}


def video_run(folder: pathlib.Path, args: argparse.Namespace) -> dict:
    """The ray cast video."""
    video, scene = folder / "walk.mp4", folder / "scene"
    size = (args.width, args.width * 3 // 4)
    true = write_phone_video(
        video,
        frames=args.video_frames,
        size=size,
        route=PhonePath(degrees=args.degrees),
        exposure=0.12,
        readout=0.2,
        exposures=2,
        device=args.device,
    )
    _report, run = captured(video, scene, frames=args.frames, feature_size=args.feature_size)
    found = warpcage.load_scene(scene, split="all")
    numbers = [int(name.removeprefix("frame_")) for name in found.names]
    blurred = sum(number % 6 == 5 for number in numbers)
    result = {"scene": f"video, {args.video_frames} frames", **run, "long_exposures_taken": blurred}
    result |= errors(found.cameras, [true[number] for number in numbers], np.array([[-1.0] * 3, [1.0] * 3]))
    return result | (compared_fits(video, scene, found, true, args) if args.fit else {})


def errors(found, true, bounds) -> dict:
    """How far found cameras are from true ones; the medians, and the largest."""
    a, b = (np.array([camera.camera_to_world for camera in cameras]) for cameras in (found, true))
    rotation, scale, shift = similarity(a[:, :3, 3], b[:, :3, 3])
    turns = [angle(rotation @ x, y) for x, y in zip(a[:, :3, :3], b[:, :3, :3], strict=True)]
    middle = b[:, :3, 3].mean(axis=0) if bounds is None else np.mean(bounds, axis=0)
    orbit = np.linalg.norm(b[:, :3, 3] - middle, axis=1).mean()
    off = 100 * np.linalg.norm(scale * a[:, :3, 3] @ rotation.T + shift - b[:, :3, 3], axis=1) / orbit

    def turn(i: int, j: int) -> float:
        return angle(a[i, :3, :3].T @ a[j, :3, :3], b[i, :3, :3].T @ b[j, :3, :3])

    way = np.median(np.linalg.norm(np.diff(b[:, :3, 3], axis=0), axis=1))
    steps = [turn(k, k + 1) for k in range(len(a) - 1)]
    pairs = [turn(i, j) for i, j in itertools.combinations(range(len(a)), 2)]
    return {
        "rotation_degrees": float(np.median(turns)),
        "rotation_largest": max(turns),
        "place_percent": float(np.median(off)),
        "place_largest": float(off.max()),
        "place_steps": float(np.median(off) * orbit / 100 / way),
        "next_degrees": float(np.median(steps)),
        "pair_degrees": float(np.median(pairs)),
        "focal_found": found[0].fx,
        "focal_true": true[0].fx,
    }


def compared_fits(video, folder, found, true, args) -> dict:
    """PSNR of fits of the same frames with found and with true cameras, on the same held-out ones."""
    import av

    numbers = [int(name.removeprefix("frame_")) for name in found.names]
    with av.open(str(video)) as container:
        decoded = {k: f.to_ndarray(format="rgb24") for k, f in enumerate(container.decode(video=0)) if k in numbers}
    images = np.stack([decoded[number] for number in numbers]).astype(np.float32) / 255
    a = np.array([camera.center for camera in found.cameras])
    b = np.array([true[number].center for number in numbers])
    rotation, scale, shift = similarity(a, b)
    low, high = found.bounds
    corners = np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 1, high, low)
    corners = scale * corners @ rotation.T + shift
    images = np.stack([shrink(image, args.downscale) for image in images])
    height, width = images.shape[1:3]
    cameras = [true[number].resized(width, height) for number in numbers]
    held = np.arange(len(numbers)) % 8 == 0
    bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
    scenes = {
        "found": [warpcage.load_scene(folder, split=split, downscale=args.downscale) for split in ("train", "test")],
        "true": [
            warpcage.Scene(images[part], None, [c for c, p in zip(cameras, part, strict=True) if p], bounds=bounds)
            for part in (~held, held)
        ],
    }
    options = {name: getattr(args, name) for name in ("resolution", "epochs") if getattr(args, name) is not None}
    result = {"options": options, "fitted_size": [width, height]}
    for name, (train, test) in scenes.items():
        began = time.perf_counter()
        field = warpcage.fit(train, device=args.device, quality=args.quality, **options)
        result[f"psnr_{name}"] = warpcage.mean_psnr(warpcage.evaluate(field, test))
        result[f"fit_seconds_{name}"] = time.perf_counter() - began
    return {"quality": args.quality, **result, "fit_device": wp.get_device(args.device).name}


def similarity(found: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Rotation, scale and shift that take places (n, 3) nearest to others (Umeyama 1991)."""
    middle, goal = found.mean(axis=0), true.mean(axis=0)
    u, s, v = np.linalg.svd((true - goal).T @ (found - middle))
    signs = np.array([1.0, 1.0, np.linalg.det(u @ v)])
    rotation = u @ np.diag(signs) @ v
    scale = float((s * signs).sum() / ((found - middle) ** 2).sum())
    return rotation, scale, goal - scale * rotation @ middle


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Degrees between two rotations."""
    return float(np.degrees(2 * np.arcsin(min(1.0, np.linalg.norm(a - b) / np.sqrt(8)))))
