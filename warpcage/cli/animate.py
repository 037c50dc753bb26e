"""`warpcage animate`: a film of a pose."""

import hashlib
import json
import pathlib

from . import options
from .render import background_option, with_overlay

NAME = "animate"
HELP = "render a film: from rest to the pose and back, the camera turning around it"
EXAMPLE = """\
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.mp4
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o bend.gif --frames 24 --turn 0 --size 240
  warpcage animate lego.npz --cage cage.obj --posed posed.obj -o frames/ --frames 240

An output without an ending is a folder of PNG files: run the same command again after an interruption and it renders
what is missing. Poses between rest and end lie on the straight way of each vertex; for large turns make poses in
between with `warpcage pose` and animate from one to the next.
"""

SETTINGS_NAME = "animation.json"


def add_arguments(parser):
    parser.add_argument("field", help="field file (.npz)")
    parser.add_argument("-o", "--output", required=True, metavar="FILM",
                        help="film (.mp4, .gif) or folder of PNG files")
    parser.add_argument("--frames", type=options.positive_int, default=48, metavar="N", help="(default: %(default)s)")
    parser.add_argument("--fps", type=options.positive_float, default=24.0,
                        help="frames a second (default: %(default)s)")
    parser.add_argument("--motion", choices=("swing", "once", "hold"), default="swing",
                        help="swing: to the pose and back; once: to the pose; hold: posed throughout "
                             "(default: %(default)s)")
    parser.add_argument("--turn", type=options.finite_float, default=360.0, metavar="DEGREES",
                        help="how far the camera goes around the target (default: %(default)s)")
    parser.add_argument("--overlay", action="store_true", help="draw the cage into the pictures")
    options.add_background(parser, "the field's own")
    options.add_deformation(parser)
    options.add_view(parser)
    options.add_device(parser)
    options.add_quiet(parser)


def run(args):
    output = _checked_output(args.output)
    if args.overlay and args.cage is None:
        raise ValueError("--overlay draws a cage: it needs --cage and --posed")
    rest, posed = options.read_cages(args)
    field = options.read_field(args)
    points = options.visible_points(field, rest, posed)
    camera, pivot = options.chosen_camera(args, points), options.chosen_target(args, points)
    cameras = turned_cameras(camera, pivot, args.up, args.turn, args.frames)
    renderer = field if rest is None else options.make_deformer(field, rest, args)
    shot = _Shot(renderer, rest, posed, cameras, args)

    from tqdm import tqdm

    from ..images import write_gif, write_video

    frames = tqdm(range(args.frames), desc="animate", disable=args.quiet)
    if output.suffix.lower() == ".mp4":
        write_video(output, map(shot.picture, frames), args.fps)
    elif output.suffix.lower() == ".gif":
        write_gif(output, map(shot.picture, frames), args.fps)
    else:
        kept = _write_folder(output, shot, frames, _settings(args, cameras))
        print(f"wrote {output}: {args.frames - kept} frames, {kept} were there")
        return
    print(f"wrote {output}: {args.frames} frames of {cameras[0].width}x{cameras[0].height}, "
          f"{output.stat().st_size / 1e6:.2f} MB")


class _Shot:
    """Renders frame by index, so that a folder can be taken up anywhere."""

    def __init__(self, renderer, rest, posed, cameras, args):
        from ..animation import pose_weights

        self.renderer, self.rest, self.posed, self.cameras, self.args = renderer, rest, posed, cameras, args
        self.weights = pose_weights(args.frames, args.motion)
        self.held = None  # the weight that the renderer is posed at

    def picture(self, index: int):
        from ..animation import pose_between

        camera = self.cameras[index]
        if self.rest is None:
            return self.renderer.render(camera, **background_option(self.args)).rgb
        weight = float(self.weights[index])
        cage = pose_between(self.rest, self.posed, weight)
        if weight != self.held:
            self.renderer.pose(cage)
            self.held = weight
        frame = self.renderer.render(camera, **background_option(self.args))
        return with_overlay(frame, camera, cage) if self.args.overlay else frame.rgb


def turned_cameras(camera, pivot, up, degrees: float, count: int):
    """`count` cameras: this one carried around the line through `pivot` along `up`; a full turn closes."""
    import numpy as np

    axis = np.asarray(up, np.float64)
    if np.linalg.norm(axis) == 0:
        raise ValueError("--up must not be 0 0 0")
    axis /= np.linalg.norm(axis)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    steps = count if degrees % 360 == 0 else max(1, count - 1)
    cameras = []
    for angle in np.radians(degrees) * np.arange(count) / steps:
        turn = np.eye(4)  # Rodrigues' formula
        turn[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
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
    names = ("frames", "motion", "turn", "overlay", "background", "coordinates", "resolution", "density")
    settings = {name: getattr(args, name) for name in names}
    settings["size"] = [cameras[0].width, cameras[0].height]
    settings["camera"] = hashlib.sha256(b"".join(camera.camera_to_world.tobytes() for camera in cameras)).hexdigest()
    for name in ("field", "cage", "posed"):
        path = getattr(args, name)
        settings[name] = None if path is None else hashlib.sha256(pathlib.Path(path).read_bytes()).hexdigest()
    return json.loads(json.dumps(settings))  # tuples as lists, as they come back from the file


def _write_folder(folder: pathlib.Path, shot: _Shot, frames, settings: dict) -> int:
    """Write the frames that are not there yet; returns how many were. Frames appear whole, so those there are good."""
    from ..files import atomic_path
    from ..images import write_png

    note = folder / SETTINGS_NAME
    if note.exists():
        try:
            found = json.loads(note.read_text(encoding="utf-8"))
        except ValueError:
            found = None
        if found != settings:
            changed = [name for name in settings if not isinstance(found, dict) or found.get(name) != settings[name]]
            raise ValueError(f"folder {str(folder)!r} holds frames of another film (other {', '.join(changed)}): "
                             "give another folder or empty this one")
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
