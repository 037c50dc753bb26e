"""Arguments that several commands share, and what they may be."""

from __future__ import annotations

import argparse
import fractions
import pathlib

from ..fitting.memory import memory_size

CAGE_ENDINGS = (".obj", ".ply", ".off", ".glb", ".gltf")
COORDINATES = ("harmonic", "mean_value", "green")
DENSITIES = ("opacity", "paper")


def package_version() -> str:
    from importlib import metadata

    try:
        return metadata.version("warpcage")
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"


def add_device(parser) -> None:
    parser.add_argument(
        "--device", metavar="NAME", help='Warp device, "cpu" or "cuda:0" (default: CUDA where there is one)'
    )


def add_scene_scale(parser) -> None:
    parser.add_argument(
        "--scene-scale",
        type=positive_ratio,
        default=1.0,
        metavar="FACTOR",
        help="factor that a scene's positions were multiplied by before its field was fitted, which is "
        "undone: 2/3 for Plenoxels checkpoints of NeRF-synthetic scenes (default: 1)",
    )


def add_cage_up(parser) -> None:
    parser.add_argument(
        "--cage-up",
        choices=("y", "z"),
        help="axis that points up in cage files (default: y for glTF, z for the others; Blender's OBJ "
        "export has y unless told otherwise)",
    )


def add_quiet(parser) -> None:
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def add_background(parser, default_text: str, more: str = "") -> None:
    parser.add_argument(
        "--background",
        type=colour,
        metavar="COLOUR",
        help=f"white, black, grey or three numbers in [0, 1] such as 0.2,0.3,0.4 (default: {default_text}){more}",
    )


def add_masks(parser) -> None:
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--no-masks",
        dest="masks",
        action="store_false",
        default=True,
        help="leave a scene's mask files alone: pictures are taken whole, background and all",
    )
    group.add_argument(
        "--split-masks",
        dest="masks",
        action="store_const",
        const="split",
        help="split the pictures at the masks: the object, and its surroundings as layers behind it",
    )


def add_deformation(parser, *, keyframes: bool = False) -> None:
    group = parser.add_argument_group("deformation (leave --cage and --posed out to show the field as it is)")
    group.add_argument("--cage", metavar="REST", help="cage around the undeformed object (.obj .ply .off .glb .gltf)")
    posed = (
        "the same cage, vertices moved: a cage file, a keyframe of a pose file (poses.json:NAME) or a preset such "
        "as bend:40:x:z, twist:60 or scale:0.8"
    )
    if keyframes:
        posed += "; several, or all of a pose file (poses.json), are keyframes one after another"
    group.add_argument("--posed", metavar="POSED", nargs="+" if keyframes else None, help=posed)
    add_cage_up(group)
    group.add_argument("--coordinates", choices=COORDINATES, default="harmonic", help="kind (default: %(default)s)")
    group.add_argument(
        "--resolution",
        type=lattice_resolution,
        default=128,
        metavar="N",
        help='lattice cells along the longest side of the cage, or "precise" to evaluate the '
        "coordinates at every sample (mean_value and green only) (default: %(default)s)",
    )
    group.add_argument(
        "--density",
        choices=DENSITIES,
        default="opacity",
        help="opacity: parts keep their opacity when they are scaled; paper: density as the paper "
        "has it (default: %(default)s)",
    )


def add_view(parser) -> None:
    group = parser.add_argument_group("view (default: from above and aside, the whole object in the picture)")
    group.add_argument(
        "--camera",
        metavar="SCENE:[SPLIT:]INDEX",
        help="camera of a scene's picture, e.g. data/lego:test:3 (split: train)",
    )
    group.add_argument("--eye", type=float, nargs=3, metavar=("X", "Y", "Z"), help="where the camera is")
    group.add_argument("--target", type=float, nargs=3, metavar=("X", "Y", "Z"), help="what it looks at")
    group.add_argument(
        "--up",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="direction that is up in the picture (default: as the field's cameras were held)",
    )
    group.add_argument(
        "--fov",
        type=field_of_view,
        default=40.0,
        metavar="DEGREES",
        help="horizontal field of view (default: %(default)s)",
    )
    group.add_argument(
        "--size",
        type=positive_int,
        nargs="+",
        metavar="PIXELS",
        help="width, or width and height (default: 400, or the size of --camera's picture)",
    )


# Values


def positive_int(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, got {text!r}")
    return value


def positive_float(text: str) -> float:
    value = finite_float(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"must be positive, got {text!r}")
    return value


def positive_ratio(text: str) -> float:
    try:
        value = float(fractions.Fraction(text))
    except (ValueError, ZeroDivisionError, OverflowError):
        value = 0.0
    if value <= 0:
        raise argparse.ArgumentTypeError(f"must be positive, a number or a ratio such as 2/3, got {text!r}")
    return value


def memory(text: str) -> int:
    try:
        return memory_size(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def finite_float(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a finite number, got {text!r}")
    return value


def field_of_view(text: str) -> float:
    value = finite_float(text)
    if not 0 < value < 180:
        raise argparse.ArgumentTypeError(f"must lie between 0 and 180 degrees, got {text!r}")
    return value


def lattice_resolution(text: str) -> int | None:
    return None if text == "precise" else positive_int(text)


def colour(text: str):
    """A name as it is, or three numbers; which names and numbers there are, the library says."""
    parts = text.split(",")
    if len(parts) == 1:
        return text
    try:
        return tuple(float(part) for part in parts)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a name or three numbers such as 0.2,0.3,0.4, got {text!r}") from None


def check_output(path: str, endings: tuple[str, ...], what: str) -> pathlib.Path:
    """`path`, refused before any long work where it has another ending, is a folder or lies under a file."""
    path = pathlib.Path(path)
    if path.suffix.lower() not in endings:
        raise ValueError(f"{what} {str(path)!r} must end in {' or '.join(endings)}")
    if path.is_dir():
        raise ValueError(f"{what} {str(path)!r} is a folder")
    check_parent(path)
    return path


def check_parent(path: pathlib.Path) -> None:
    for parent in path.parents:
        if parent.exists():
            if not parent.is_dir():
                raise ValueError(f"{str(path)!r} cannot be written: {str(parent)!r} is no folder")
            return


def require_folder(path: str) -> None:
    if not pathlib.Path(path).is_dir():
        raise FileNotFoundError(f"scene folder {path!r} is not there")
