"""`warpcage render` and `animate`: pictures, flights, pictures of many poses, films."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Sequence

from ...cage.cage import Cage
from ...core.files import check_parent
from ...core.names import TRANSPARENT, counted, named_errors
from ...core.reports import say
from ...edits.stage_file import STAGE_ENDING
from ...errors import InputError
from ...view import frame_parts
from ...view.camera import Camera
from ...view.exr import require_openexr
from ...view.frame_parts import MASKS
from ...view.pictures import picture_cuts, write_png
from ..films.edits import Deformation
from ..films.film import Film, Moment
from ..films.motion import cameras_along, path_cameras
from ..films.render import Look, Scene, drawn_cages, picture_task
from ..films.timeline import Objects
from ..films.video import FILM_ENDINGS, film_size, require_clear_film
from . import shared
from .arguments import options
from .arguments.render import STEPS
from .cameras import camera_file, camera_keys, check_saved, chosen_camera, save_cameras, sized_cameras, warn_of_edges


def check_target(args: argparse.Namespace, output: pathlib.Path) -> None:
    """Raises ValueError where a film or a folder cannot hold what is asked for, before any long work."""
    if output.suffix and args.format is not None:
        raise InputError("--format is for folders of pictures: the file ending of a film says its format")
    _require_format(args.format or "")
    if shared.shot_of(args).background == TRANSPARENT:
        require_clear_film(output)
    check_saved(args)


def _require_format(path: str) -> None:
    """Raises ValueError for an OpenEXR file where its library is not installed."""
    if path.lower().endswith("exr"):
        require_openexr()


def size_text(width: int, height: int, output: pathlib.Path) -> str:
    """The size of what is written as text, with the reason where it differs from that of the pictures."""
    written = film_size(width, height, output.suffix.lower())
    cut = f" (cut from {width}x{height}: an MP4 has even sides)" if written != (width, height) else ""
    return f"{written[0]}x{written[1]}{cut}"


def warn_of_masks(shares: dict[str, float], where: str = "the picture") -> None:
    """Print a line on stderr for each mask that marks anything; where: how the line calls the picture."""
    for name, share in shares.items():
        if share > 0:
            say(f"warning: {100 * share:.2f} % of {where} {MASKS[name][1]}")


#: Frames per second of films.
VIDEO_RATE, GIF_RATE = 24, 15

#: Options for one picture, of any number of poses and of any number of cameras.
SINGLE_POSE = ("disparity", "depth", "alpha", "masks")

SINGLE_CAMERA = (*SINGLE_POSE, "camera", "view", "frame", "eye", "target")


def _film(args: argparse.Namespace, cameras: Sequence[Camera], moment: Moment) -> Film:
    """The pictures of some cameras, one after the other."""
    look = Look.of(shared.shot_of(args))
    return Film(len(cameras), lambda frames: [cameras[int(frame)] for frame in frames], moment, look)


def _posed_film(
    args: argparse.Namespace,
    cameras: Sequence[Camera],
    field: shared.AnyField,
    deformation: Deformation,
    objects: Objects | None,
) -> Film:
    """What cameras see of the scene in its last pose; where nothing moves, of the field itself."""
    shared.set_lattice(args, cameras[0])
    renderer, cages = field, [cage for cage in deformation.posed if cage is not None]
    if not deformation.is_still:
        renderer = shared.make_deformer(field, deformation, args).pose(deformation.posed)
        cages = drawn_cages(renderer)
    return _film(args, cameras, lambda frame: (renderer if objects is None else objects.with_main(renderer), cages))


def _run_flight(args: argparse.Namespace) -> None:
    """Render what each of several cameras sees."""
    if pathlib.Path(args.output).suffix:
        output = options.check_output(args.output, FILM_ENDINGS, "film (a folder of pictures has no ending)")
    else:
        output = _new_folder(args.output, "--cameras writes a new or an empty folder, or a film")
    check_target(args, output)
    if args.scene is None:
        raise InputError("--cameras needs --scene, the scene of the cameras")
    if given := options.given(args, *SINGLE_CAMERA):
        raise InputError(f"--cameras cannot be combined with --{given[0]}, which is for one picture")
    if args.cameras == "given" and args.frames is not None:
        raise InputError("--frames belongs to --cameras interpolate")
    shot = shared.read_shot(args)
    cameras = _chosen_cameras(args)
    film = _posed_film(args, cameras, *shot)
    save_cameras(args, cameras)
    if output.suffix:
        film.write(output, GIF_RATE if output.suffix.lower() == ".gif" else VIDEO_RATE, loop=True)
    else:
        film.write_pictures(output / f"view_{index:04d}.{args.format or 'png'}" for index in range(len(cameras)))
    size = size_text(cameras[0].width, cameras[0].height, output)
    print(f"wrote {output}: {counted(len(cameras), 'picture')} of {size}")


def _chosen_cameras(args: argparse.Namespace) -> list[Camera]:
    """One camera per picture."""
    if keys := camera_keys(args, args.scene) if camera_file(args.scene) else []:
        cameras = [key.camera for key in keys]
    else:
        cameras = sized_cameras(args, args.scene)
    if args.cameras == "given":
        return cameras
    count = args.frames or max(1, STEPS * (len(cameras) - 1) + 1)
    return path_cameras(keys, count) if keys else cameras_along(cameras, count)


def _new_folder(text: str, what: str) -> pathlib.Path:
    """A folder that holds nothing yet; what: what a message says about it."""
    path = pathlib.Path(text)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{text!r} exists already: {what}")
    check_parent(path)
    return path


def _run_many_poses(args: argparse.Namespace) -> None:
    """Render each of several poses. The field is read once, and its lattice is made once."""
    folder = _new_folder(args.output, "pictures of several poses go into a new or an empty folder")
    if given := options.given(args, *SINGLE_POSE):
        raise InputError(f"--{given[0]} is for one picture: give the name of a picture with -o")
    check_target(args, folder)
    field, deformation, objects = shared.read_shot(args, shared.edit_reader(args, "linear"))
    camera = chosen_camera(args, shared.seen_points(args, field, deformation, objects))
    shared.set_lattice(args, camera)
    deformer = shared.make_deformer(field, deformation, args)
    count = max(1, deformation.pose_count - 1)

    def moment(index: float) -> tuple[Scene, list[Cage]]:
        number = int(index) + 1
        with named_errors(f"pose {number} of {count}"):
            deformer.pose(deformation.at(float(min(number, deformation.pose_count - 1))))
        return deformer if objects is None else objects.with_main(deformer), drawn_cages(deformer)

    digits, ending = max(4, len(str(count))), args.format or "png"
    names = (f"pose_{number:0{digits}d}.{ending}" for number in range(1, count + 1))
    _film(args, [camera] * count, moment).write_pictures(folder / name for name in names)
    save_cameras(args, [camera])
    print(f"wrote {folder}: {counted(count, 'picture')} of {camera.width}x{camera.height}")


def run_render(args: argparse.Namespace) -> None:
    if args.cameras is not None:
        return _run_flight(args)
    if args.scene is not None or args.frames is not None:
        raise InputError("--scene and --frames belong to --cameras")
    if not pathlib.Path(args.output).suffix and shared.is_deformed(args):
        return _run_many_poses(args)
    if args.posed is not None and len(args.posed) > 1:
        raise InputError(f"{len(args.posed)} poses make as many pictures: give a folder with -o, which has no ending")
    if args.format is not None:
        raise InputError("--format is for folders of pictures: the file ending of a single one says its format")
    output = options.check_output(args.output, (".png", ".exr"), "picture")
    _require_format(args.output)
    check_saved(args)
    kinds = options.given(args, *SINGLE_POSE)
    extra = {kind: options.check_output(getattr(args, kind), (".png",), "picture") for kind in kinds}
    if args.save_stage is not None and not shared.is_stage(args.save_stage):
        raise InputError(f"--save-stage writes a file that ends in {STAGE_ENDING}, got {args.save_stage!r}")
    field, deformation, objects = shared.read_shot(args, of_voxels="" if args.masks is None else "--masks")
    camera = chosen_camera(args, shared.seen_points(args, field, deformation, objects))
    warn_of_edges(args, camera, deformation)
    image, frame, _ = _posed_film(args, [camera], field, deformation, objects).taken(0)
    with picture_cuts(output) as cuts:
        write, _ = picture_task(output, image, frame, camera, cuts)
        write()
    for kind, path in extra.items():
        write_png(path, frame_parts.picture(frame, kind))
    save_cameras(args, [camera])
    if not (frame.alpha > 0.0).any():
        places = " to ".join(str(corner.round(3).tolist()) for corner in field.bounds)
        say(
            f"warning: nothing is in the picture: the camera at {camera.center.round(3).tolist()} does "
            f"not look at the field, which reaches from {places}"
        )
    if args.save_stage is not None and objects is not None:
        objects.stage.save(args.save_stage)
    names = " and ".join(map(str, [output, *extra.values()]))
    print(f"wrote {names}: {frame.width}x{frame.height}, {100 * float(frame.alpha.mean()):.1f} % covered")
    if args.masks is not None:
        warn_of_masks(frame_parts.mask_shares(frame))
