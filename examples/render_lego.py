"""From pictures to a bent object: fit a field, put a cage around it, bend it, render pictures and a film.

    python examples/render_lego.py --out out                        # an excavator of bricks, rendered for this
    python examples/render_lego.py --data data/lego --quick         # NeRF-synthetic Lego, shrunk to about 100 pixels
    python examples/render_lego.py --data data/lego --device cuda:0

Writes to the folder of --out: deformed.png (the view at rest above the deformed one; from left to right the picture,
the cage over it, the disparity), bend.mp4 and bend.gif (the bend comes and goes while the camera turns around the
object), mesh.obj, cage.obj, posed.obj, field.npz, and summary.json with figures.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import json
import pathlib
import platform
import time

import numpy as np
import warp as wp

import warpcage
from warpcage.core.devices import resolve_device
from warpcage.core.files import atomic_path
from warpcage.core.threads import cpu_threads
from warpcage.demo.brick_scene import write_brick_scene
from warpcage.fitting.evaluation import evaluate, mean_psnr
from warpcage.studio.films.motion import pose_weights
from warpcage.studio.films.video import write_gif, write_video
from warpcage.view.camera import framing_orbit
from warpcage.view.overlay import draw_cage
from warpcage.view.pictures import color_disparity, contact_sheet, disparity_range, to_uint8, write_png


def main(argv=None) -> dict:
    wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads
    args = parse_arguments(argv)
    out = pathlib.Path(args.out)
    device = resolve_device(args.device)
    seconds: dict[str, float] = {}

    with stage("scene", seconds):
        data = args.data
        if data is None:
            data = write_brick_scene(out / "scene", train_views=args.views, size=args.size, device=device)
        downscale = quick_downscale(data) if args.quick else 1
        train = warpcage.load_scene(data, split="train", downscale=downscale)
        test = warpcage.load_scene(data, split="test", downscale=downscale)
    with stage("fit", seconds):
        options = {} if args.epochs is None else {"epochs": args.epochs}
        field = warpcage.fit(train, device=device, seed=args.seed, **options)
        field.save(out / "field.npz")
    with stage("evaluate", seconds):
        test_psnr = mean_psnr(evaluate(field, test))
    with stage("mesh", seconds):
        mesh = field.extract_mesh(components="all")  # thin shells of a coarse field may lie apart
        with atomic_path(out / "mesh.obj") as temporary:
            mesh.export(temporary, file_type="obj")
    with stage("cage", seconds):
        if args.cage:
            cage = warpcage.Cage.load(args.cage)
        else:
            cage = warpcage.Cage.from_field(field, vertex_count=args.vertices)
        cage.save(out / "cage.obj")
    with stage("pose", seconds):
        bend = {"axis": longest_side(cage), "towards": "z"}
        posed = cage.bend(args.bend, **bend)
        posed.save(out / "posed.obj")
        deformer = warpcage.Deformer(field, cage, coordinates=args.coordinates, resolution=args.lattice)
        deformer.pose(posed)

    with stage("pictures", seconds):
        points = np.concatenate([cage.vertices, posed.vertices])  # so that both states are in the picture
        side = {"x": -60.0, "y": 30.0}[bend["axis"]]
        size = {"width": args.picture, "height": args.picture}
        camera = framing_orbit(points, 1, start_degrees=side, fill=0.98, **size)[0]
        frames = [(field.render(camera), cage), (deformer.render(camera), posed)]
        scale = disparity_range(np.stack([frame.disparity for frame, _ in frames]))
        panels = []
        for frame, drawn in frames:
            panels += [
                frame.rgb,
                draw_cage(frame.rgb, camera, drawn),
                color_disparity(frame.disparity, alpha=frame.alpha, scale=scale),
            ]
        write_png(out / "deformed.png", contact_sheet(panels, columns=3))
    if not args.no_video:
        with stage("film", seconds):
            size = {"width": args.film, "height": args.film}
            cameras = framing_orbit(points, args.frames, start_degrees=side, fill=1.0, **size)
            film = list(bend_film(deformer, cage, cameras, args.bend, bend))
            write_video(out / "bend.mp4", film, fps=15)
            write_gif(out / "bend.gif", film, fps=15, colors=64)

    summary = {
        "scene": str(args.data or "brick model"),
        "train_views": len(train),
        "test_views": len(test),
        "image_size": [train.images.shape[2], train.images.shape[1]],
        "test_psnr": test_psnr,
        "seconds": seconds | {"all": sum(seconds.values())},
        "voxels": field.voxel_count,
        "resolution": field.resolution,
        "cage_vertices": len(cage.vertices),
        "cage_faces": len(cage.faces),
        "pose": {"bend": args.bend, **bend},
        "device": device.name if device.is_cuda else f"CPU, {cpu_threads()} threads",
        "versions": {"python": platform.python_version()}
        | {name: importlib.metadata.version(name) for name in ("warpcage", "warp-lang", "numpy", "trimesh")},
    }
    with atomic_path(out / "summary.json") as temporary:
        temporary.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    check(out, frames, test_psnr, args)
    print(f"{test_psnr:.2f} dB on {len(test)} test views, {summary['seconds']['all']:.0f} s in all: {out}/deformed.png")
    return summary


def parse_arguments(argv):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", metavar="DIR", help="scene with splits train and test (default: a brick scene)")
    parser.add_argument("--out", metavar="DIR", default="out", help="where results go (default: %(default)s)")
    parser.add_argument("--device", help='"cpu" or "cuda:0" (default: CUDA where there is one)')
    parser.add_argument("--quick", action="store_true", help="shrink pictures to about 100 pixels, smaller results")
    parser.add_argument("--seed", type=int, default=0, help="(default: %(default)s)")
    parser.add_argument("--bend", type=float, default=45.0, metavar="DEGREES", help="(default: %(default)s)")
    parser.add_argument("--coordinates", default="harmonic", choices=("harmonic", "mean_value", "green"))
    parser.add_argument("--cage", metavar="FILE", help="use this cage instead of making one")
    parser.add_argument("--vertices", type=int, default=100, help="vertices of a cage made here (default: %(default)s)")
    parser.add_argument("--no-video", action="store_true", help="leave bend.mp4 and bend.gif out")
    small = parser.add_argument_group("sizes (default: by --quick and device)")
    small.add_argument("--size", type=int, default=100, help="pixels of a brick picture's side (default: %(default)s)")
    small.add_argument("--views", type=int, default=60, help="training views of the brick scene (default: %(default)s)")
    small.add_argument("--epochs", type=float, help="passes over the pictures, for a fit shorter than the standard one")
    small.add_argument("--picture", type=int, help="pixels of one panel of deformed.png")
    small.add_argument("--frames", type=int, help="frames of the film")
    small.add_argument("--film", type=int, help="pixels of the film")
    small.add_argument("--lattice", type=int, help="cells of the cage's lattice along its longest side")
    args = parser.parse_args(argv)
    # a GPU takes milliseconds for poses and frames, a CPU seconds
    large = resolve_device(args.device).is_cuda and not args.quick
    sizes = (("picture", 800, 280), ("frames", 90, 36), ("film", 480, 220), ("lattice", 128, 64))
    for name, on_gpu, otherwise in sizes:
        if getattr(args, name) is None:
            setattr(args, name, on_gpu if large else otherwise)
    return args


@contextlib.contextmanager
def stage(name: str, seconds: dict):
    """Time a stage and print it."""
    start = time.perf_counter()
    yield
    wp.synchronize()
    seconds[name] = time.perf_counter() - start
    print(f"{name:9} {seconds[name]:6.1f} s", flush=True)


def quick_downscale(data) -> int:
    """The factor that brings a scene's pictures to about 100 pixels."""
    full = warpcage.load_scene(data, split="test").images.shape[2]
    return max(1, round(full / 100))


def longest_side(cage) -> str:
    """The horizontal axis along which the object is longest: a bend shows best there."""
    return "xy"[int(np.argmax(np.ptp(cage.bounds, axis=0)[:2]))]


def bend_film(deformer, cage, cameras, degrees: float, bend: dict):
    """Frames (h, w, 3) uint8: the bend comes and goes while the camera turns around it."""
    for camera, weight in zip(cameras, pose_weights(len(cameras)), strict=True):
        deformer.pose(cage.bend(weight * degrees, **bend))
        yield to_uint8(deformer.render(camera).rgb)


def check(out, frames, test_psnr: float, args):
    """Checks that every run must pass."""
    names = ["deformed.png", "mesh.obj", "cage.obj", "posed.obj", "field.npz", "summary.json"]
    names += [] if args.no_video else ["bend.mp4", "bend.gif"]
    for name in names:
        assert (out / name).stat().st_size > 0, name
    assert test_psnr > 15.0, f"the field does not look like the scene: {test_psnr:.1f} dB"
    (canonical, _), (deformed, _) = frames
    assert np.isfinite(deformed.rgb).all()
    assert np.abs(canonical.rgb - deformed.rgb).mean() > 0.01, "the bend does not show"
    assert 0.6 < deformed.alpha.sum() / canonical.alpha.sum() < 1.7, "the bend lost or made matter"


if __name__ == "__main__":
    main()
