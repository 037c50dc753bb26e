"""`warpcage animate`: a film of a pose."""

from __future__ import annotations

import hashlib
import json
import pathlib

from ..core.files import atomic_path
from ..view.film import axis_rotation, cameras_along, frame_places, write_gif, write_video
from ..view.pictures import write_png
from . import inputs, options, outputs, view
from .keyframes import Keyframes, is_preset, pose_file
from .render import background_option

NAME = "animate"
HELP = "render a film: from rest through the poses and back, the camera turning around it"
EXAMPLE = """\
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.mp4
  warpcage animate lego.npz --cage cage.obj --posed bend:45:y:z -o bend.gif --frames 24 --turn 0 --size 240
  warpcage animate lego.npz --cage cage.obj --posed one.obj two.obj rest -o walk.mp4 --motion once
  warpcage animate lego.npz --cage cage.obj --posed poses.json -o dance.mp4
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o frames/ --frames 240 --cameras data/lego:test

An output without an ending is a folder of PNG files: run the same command again after an interruption and it renders
what is missing. The film goes from rest through the poses of --posed in their order. Each vertex takes its own way from
pose to pose; where all poses are one preset, the amount of it changes, so that a bend stays an arc.
"""
SETTINGS_NAME = "animation.json"


def add_arguments(parser):
    parser.add_argument("field", help="field file (.npz)")
    parser.add_argument(
        "-o", "--output", required=True, metavar="FILM", help="film (.mp4, .gif) or folder of PNG files"
    )
    parser.add_argument("--frames", type=options.positive_int, default=48, metavar="N", help="(default: %(default)s)")
    parser.add_argument(
        "--fps", type=options.positive_float, default=24.0, help="frames a second (default: %(default)s)"
    )
    parser.add_argument(
        "--motion",
        choices=("swing", "once", "hold"),
        default="swing",
        help="swing: to the last pose and back; once: to the last pose; hold: posed throughout (default: %(default)s)",
    )
    parser.add_argument(
        "--interpolation",
        choices=("smooth", "linear"),
        default="smooth",
        help="linear: straight from pose to pose at one speed; smooth: through the poses without a "
        "jolt, gentle at both ends (default: %(default)s)",
    )
    path = parser.add_argument_group("camera path")
    path.add_argument(
        "--turn",
        type=options.finite_float,
        default=None,
        metavar="DEGREES",
        help="how far the camera goes around the target; 0 keeps it where it is (default: 360)",
    )
    path.add_argument(
        "--cameras",
        metavar="SCENE[:SPLIT]",
        help="go through the cameras of a scene's pictures instead, e.g. data/lego:test (split: train)",
    )
    parser.add_argument(
        "--show",
        choices=outputs.KINDS,
        default="rgb",
        help="rgb; alpha; depth (near is white) or disparity, of one scale for the film; masks: where "
        "the map folds, what it uncovers and loses, and a warning of their shares "
        "(default: %(default)s)",
    )
    parser.add_argument("--overlay", action="store_true", help="draw the cage into the pictures")
    options.add_background(parser, "the field's own")
    options.add_deformation(parser, keyframes=True)
    options.add_view(parser)
    options.add_scene_scale(parser)
    options.add_device(parser)
    options.add_quiet(parser)


def run(args):
    output = _checked_output(args.output)
    if args.overlay and args.cage is None:
        raise ValueError("--overlay draws a cage: it needs --cage and --posed")
    if args.show == "masks" and args.cage is None:
        raise ValueError("--show masks needs a deformation: --cage and --posed")
    rest = inputs.read_rest(args)
    keyframes = None if rest is None else Keyframes(rest, args.posed, args.interpolation, args.cage_up)
    field = inputs.read_field(args)
    points = inputs.visible_points(field) if rest is None else keyframes.vertices
    cameras = _chosen_cameras(args, points)
    renderer = field if rest is None else inputs.make_deformer(field, rest, args)
    shot = _Shot(renderer, keyframes, cameras, args)

    from tqdm import tqdm

    frames = tqdm(range(args.frames), desc="animate", disable=args.quiet)
    if output.suffix.lower() == ".mp4":
        write_video(output, map(shot.picture, frames), args.fps)
    elif output.suffix.lower() == ".gif":
        write_gif(output, map(shot.picture, frames), args.fps)
    else:
        kept = _write_folder(output, shot, frames, _settings(args, cameras))
        print(f"wrote {output}: {args.frames - kept} frames, {kept} were there")
        shot.warn()
        return
    print(
        f"wrote {output}: {args.frames} frames of {cameras[0].width}x{cameras[0].height}, "
        f"{output.stat().st_size / 1e6:.2f} MB"
    )
    shot.warn()


class _Shot:
    """Renders frame by index, so that a folder can be taken up anywhere."""

    def __init__(self, renderer, keyframes, cameras, args):
        self.renderer, self.keyframes, self.cameras, self.args = renderer, keyframes, cameras, args
        count = 1 if keyframes is None else len(keyframes.cages)
        self.places = frame_places(args.frames, count, args.motion, args.interpolation)
        self.held = None  # the place that the renderer is posed at
        self.shares: dict[str, list] = {}
        self.scale = self._scale() if args.show in ("depth", "disparity") else None

    def frame(self, index: int):
        """The frame, and the cage it shows."""
        cage = None
        if self.keyframes is not None:
            place = float(self.places[index])
            try:
                cage = self.keyframes.at(place)
                if place != self.held:
                    self.renderer.pose(cage)
                    self.held = place
            except ValueError as error:
                raise ValueError(f"frame {index}, between the poses: {error}") from error
        return self.renderer.render(self.cameras[index], **background_option(self.args)), cage

    def picture(self, index: int):
        frame, cage = self.frame(index)
        if self.args.show == "masks":
            for name, share in outputs.mask_shares(frame).items():
                self.shares.setdefault(name, []).append(share)
        drawn = cage if self.args.overlay else None
        return outputs.picture(frame, self.args.show, self.cameras[index], drawn, self.scale)

    def _scale(self):
        """From a few frames, always the same ones, so that a folder taken up again keeps its colours."""
        probes = sorted({round(share * (self.args.frames - 1)) for share in (0.0, 0.25, 0.5, 0.75)})
        return outputs.disparity_scale([self.frame(index)[0] for index in probes])

    def warn(self) -> None:
        """Say what the masks marked on average, if they were asked for."""
        outputs.warn_of_masks({name: sum(shares) / len(shares) for name, shares in self.shares.items()}, "the film")


def _chosen_cameras(args, points) -> list:
    """One camera a frame."""
    if args.cameras is None:
        camera, pivot = view.chosen_camera(args, points), view.chosen_target(args, points)
        return turned_cameras(camera, pivot, args.up, 360.0 if args.turn is None else args.turn, args.frames)
    if any(given is not None for given in (args.turn, args.camera, args.eye, args.target)):
        raise ValueError("--cameras and --turn, --camera, --eye or --target exclude each other")

    cameras, size = view.scene_cameras(args.cameras), view.image_size(args)
    if size is not None:
        cameras = [view.fitted(camera, *size) for camera in cameras]
    return cameras_along(cameras, args.frames, args.interpolation)


def turned_cameras(camera, pivot, up, degrees: float, count: int):
    """`count` cameras: this one carried around the line through `pivot` along `up`; a full turn closes."""
    import numpy as np

    axis = np.asarray(up, np.float64)
    if np.linalg.norm(axis) == 0:
        raise ValueError("--up must not be 0 0 0")
    axis /= np.linalg.norm(axis)
    steps = count if degrees % 360 == 0 else max(1, count - 1)
    cameras = []
    for angle in np.radians(degrees) * np.arange(count) / steps:
        turn = np.eye(4)
        turn[:3, :3] = axis_rotation(axis, angle)
        turn[:3, 3] = pivot - turn[:3, :3] @ pivot
        cameras.append(camera.moved(turn))
    return cameras


def _checked_output(text: str) -> pathlib.Path:
    path = pathlib.Path(text)
    if path.suffix:
        return options.check_output(text, (".mp4", ".gif"), "film (a folder has no ending)")
    if path.exists() and not path.is_dir():
        raise ValueError(f"film {text!r} is a file without an ending: give .mp4, .gif or a folder")
    options.check_parent(path)
    return path


def _settings(args, cameras) -> dict:
    """What decides how frames look, so that a folder never mixes two films."""
    names = (
        "frames",
        "motion",
        "interpolation",
        "turn",
        "show",
        "overlay",
        "background",
        "coordinates",
        "resolution",
        "density",
        "cage_up",
        "scene_scale",
    )
    settings = {name: getattr(args, name) for name in names}
    settings["size"] = [cameras[0].width, cameras[0].height]
    settings["camera"] = hashlib.sha256(b"".join(camera.camera_to_world.tobytes() for camera in cameras)).hexdigest()
    for name in ("field", "cage"):
        settings[name] = _fingerprint(getattr(args, name))
    settings["posed"] = [_fingerprint(text) for text in args.posed or ()]
    return json.loads(json.dumps(settings))  # tuples as lists, as they come back from the file


def _fingerprint(text: str | None) -> str | None:
    """What a file holds, or the preset itself."""
    if text is None or is_preset(text):
        return text
    path, name = pose_file(text) or (text, "")
    return hashlib.sha256(pathlib.Path(path).read_bytes() + name.encode()).hexdigest()


def _write_folder(folder: pathlib.Path, shot: _Shot, frames, settings: dict) -> int:
    """Write the frames that are not there yet; returns how many were. Frames appear whole, so those there are good."""
    note = folder / SETTINGS_NAME
    if note.exists():
        try:
            found = json.loads(note.read_text(encoding="utf-8"))
        except ValueError:
            found = None
        if found != settings:
            changed = [name for name in settings if not isinstance(found, dict) or found.get(name) != settings[name]]
            raise ValueError(
                f"folder {str(folder)!r} holds frames of another film (other {', '.join(changed)}): "
                "give another folder or empty this one"
            )
    elif folder.is_dir() and any(folder.glob("frame_*.png")):
        raise ValueError(f"folder {str(folder)!r} holds other frames (no {SETTINGS_NAME}): give another folder")
    else:
        with atomic_path(note) as temporary:
            temporary.write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")
    kept = 0
    for index in frames:
        path = folder / f"frame_{index:04d}.png"
        if path.is_file():
            kept += 1
        else:
            write_png(path, shot.picture(index))
    return kept
