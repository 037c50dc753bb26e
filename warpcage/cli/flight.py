"""Pictures from all cameras of a scene, or from cameras in between, for `warpcage render --cameras`."""

from __future__ import annotations

import pathlib

from ..view.film import cameras_along, write_gif, write_video
from ..view.pictures import write_png
from . import inputs, options, outputs, view

KINDS = ("interpolate", "given")

#: What belongs to a single picture.
SINGLE = ("disparity", "depth", "alpha", "masks", "camera", "eye", "target")


def add_arguments(parser) -> None:
    group = parser.add_argument_group("many pictures")
    group.add_argument(
        "--cameras",
        choices=KINDS,
        help="interpolate: go through the cameras of --scene, positions along a curve, rotations by the "
        "shortest turn; given: from each of them. The output is a folder, .mp4 or .gif then",
    )
    group.add_argument("--scene", metavar="SCENE[:SPLIT]", help="whose cameras, e.g. data/lego:test (split: train)")
    group.add_argument(
        "--frames",
        type=options.positive_int,
        metavar="N",
        help="pictures of --cameras interpolate (default: 8 from each camera to the next)",
    )


def run(args, background: dict) -> None:
    output = _checked_output(args.output)
    if args.scene is None:
        raise ValueError("--cameras needs --scene: whose cameras?")
    if any(getattr(args, name) is not None for name in SINGLE):
        name = next(name for name in SINGLE if getattr(args, name) is not None)
        raise ValueError(f"--cameras and --{name} exclude each other: that is for one picture")
    if args.cameras == "given" and args.frames is not None:
        raise ValueError("--frames belongs to --cameras interpolate")
    rest, posed = inputs.read_cages(args)
    cameras = chosen_cameras(args)
    field = inputs.read_field(args)
    renderer = field if rest is None else inputs.make_deformer(field, rest, args)
    if posed is not None:
        renderer.pose(posed)

    def pictures():
        for camera in cameras:
            frame = renderer.render(camera, **background)
            yield outputs.picture(frame, "rgb", camera, posed if args.overlay else None)

    _write(output, pictures())
    print(f"wrote {output}: {len(cameras)} pictures of {cameras[0].width}x{cameras[0].height}")


def chosen_cameras(args) -> list:
    cameras, size = view.scene_cameras(args.scene), view.image_size(args)
    if size is not None:
        cameras = [view.fitted(camera, *size) for camera in cameras]
    if args.cameras == "given":
        return cameras
    return cameras_along(cameras, args.frames or max(1, 8 * (len(cameras) - 1) + 1))


def _checked_output(text: str) -> pathlib.Path:
    path = pathlib.Path(text)
    if path.suffix:
        return options.check_output(text, (".mp4", ".gif"), "film (a folder of pictures has no ending)")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ValueError(f"{text!r} is there: --cameras writes a new or an empty folder, .mp4 or .gif")
    options.check_parent(path)
    return path


def _write(output: pathlib.Path, pictures) -> None:
    if output.suffix.lower() == ".mp4":
        write_video(output, pictures, 24.0)
    elif output.suffix.lower() == ".gif":
        write_gif(output, pictures, 15.0)
    else:
        for index, picture in enumerate(pictures):
            write_png(output / f"view_{index:04d}.png", picture)
