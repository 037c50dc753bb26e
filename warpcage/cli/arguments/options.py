"""Options that several commands share, those of deformations too, and the values that they take."""

from __future__ import annotations

import argparse
import fractions
import pathlib
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

from ...core.names import BACKGROUNDS, COORDINATES, DENSITIES, FIELD_COORDINATES, SPLAT_MAPS, TRANSPARENT
from ...errors import InputError, MissingFileError

CAGE_ENDINGS = (".obj", ".ply", ".off", ".glb", ".gltf")

MESH_ENDINGS = (".obj", ".ply", ".off", ".stl", ".glb")

SELECTION_ENDINGS = (".npz", ".json")

#: Files of splats that are written: 3DGS' and SuperSplat's .ply, those of web viewers, Niantic's, PlayCanvas' and glTF.
SPLAT_ENDINGS = (".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".glb")

#: Those that are read. A folder of SOG has a meta.json.
SPLATS_READ = (*SPLAT_ENDINGS, ".gltf", ".ksplat", "meta.json")

#: What a film may show of its frames.
PICTURE_KINDS = ("rgb", "alpha", "depth", "disparity", "masks")

#: Sides that pictures are taken from.
VIEWS = ("corner", "front", "back", "left", "right", "top", "bottom")

#: Colours behind pictures, for help texts.
COLOR_NAMES = ", ".join(BACKGROUNDS)

#: The lattice where --resolution is not given.
BY_SIZE = "by size"

#: What takes arguments: a parser, or a group of its arguments; and what adds those of a command.
Arguments = argparse._ActionsContainer
AddArguments = Callable[[argparse.ArgumentParser], None]


class OldName(argparse.Action):
    """An option by its old name, which the next version does not know."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        old, new = self.option_strings[0], self.dest.replace("_", "-")
        warnings.warn(f"{old} is called --{new} now: the next version knows that name alone", stacklevel=2)
        setattr(namespace, self.dest, values)


class Command(NamedTuple):
    """A command as the parser knows it; `module` of warpcage.cli has run_NAME(args), loaded when it is chosen."""

    help: str  # one line
    example: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    module: str


#: All commands by their names.
COMMANDS: dict[str, Command] = {}


def command(name: str, help: str, example: str, module: str = "") -> Callable[[AddArguments], AddArguments]:
    """Decorates what adds the arguments of a command; module: that of warpcage.cli, else the one of the same name."""

    def keep(add: AddArguments) -> AddArguments:
        COMMANDS[name] = Command(help, example, add, module or add.__module__.rpartition(".")[2])
        return add

    return keep


def package_version() -> str:
    from importlib import metadata

    try:
        return metadata.version("warpcage")
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"


def add_field(parser: Arguments) -> None:
    """The field that a command reads."""
    parser.add_argument("field", help=f"field file: voxels (.npz) or splats ({' '.join(SPLATS_READ)})")


def add_output(parser: Arguments, metavar: str, help: str) -> None:
    """What a command writes."""
    parser.add_argument("-o", "--output", required=True, metavar=metavar, help=help)


def add_scene(parser: Arguments, split: str) -> None:
    """The scene that a command reads, and which of its pictures; split: the default."""
    parser.add_argument("scene", help="folder with pictures and cameras")
    parser.add_argument("--split", default=split, help="which pictures (default: %(default)s)")
    add_scene_format(parser)
    add_masks(parser)
    parser.add_argument(
        "--downscale", default=1, help="shrink the pictures by averaging N x N pixels (default: %(default)s)", **COUNT
    )
    parser.add_argument(
        "--cameras",
        metavar="FILE",
        help="camera file (.json) that has a camera for each picture, by its name, instead of those of the scene: as "
        "`fit --refine-cameras` writes it",
    )
    parser.add_argument(
        "--model",
        metavar="NAME",
        help='which of several models in a scene, such as "1" (default: the one with most pictures)',
    )


def add_scene_format(parser: Arguments) -> None:
    parser.add_argument("--format", metavar="NAME", help="scene format (default: detected)")


def add_device(parser: Arguments) -> None:
    parser.add_argument(
        "--device", metavar="NAME", help='Warp device, "cpu" or "cuda:0" (default: CUDA where there is one)'
    )


def add_scene_scale(parser: Arguments) -> None:
    """The factor of scenes whose positions were scaled before a fit."""
    parser.add_argument(
        "--scene-scale",
        type=positive_ratio,
        default=1.0,
        metavar="FACTOR",
        help="undo a scaling: the factor by which the positions of a scene were multiplied before its field was "
        "fitted, 2/3 for Plenoxels checkpoints of NeRF-synthetic scenes (default: 1)",
    )


def add_scale_and_device(parser: Arguments) -> None:
    """What commands that read a field end with."""
    add_scene_scale(parser)
    add_device(parser)


def add_cage_up(parser: Arguments, *, found: bool = False, posed: bool = False) -> None:
    """The axis that points up in cage files; found: whether there is an object to find it by; posed: poses too."""
    default = "y for glTF, z for other formats; Blender exports OBJ with y unless told otherwise"
    if found:
        default = "found by what the cage holds of the object; where that does not tell, y for glTF, z for others"
    parser.add_argument("--cage-up", choices=("y", "z"), help=f"axis that points up in cage files (default: {default})")
    parser.add_argument(
        "--cage-object",
        metavar="NAME",
        help="the object that is the cage in a file of several (OBJ, glTF); '*' takes all as one cage",
    )
    if posed:
        parser.add_argument(
            "--posed-up",
            choices=("y", "z"),
            help="axis that points up in posed cage files (default: that of --cage-up; or found, file by file, where "
            "it is not given)",
        )


def add_quiet(parser: Arguments) -> None:
    """A switch for the progress bar."""
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def add_background(parser: Arguments, default_text: str, more: str = "") -> None:
    """The colour behind pictures; default_text: what it is by default, more: what the help says besides."""
    parser.add_argument(
        "--background",
        type=color,
        metavar="COLOUR",
        help=f"{COLOR_NAMES}, or three numbers in [0, 1] such as 0.2,0.3,0.4 (default: {default_text}){more}",
    )


def add_clear_background(parser: Arguments) -> None:
    """The background of pictures that may have none, and the files that a folder of them holds."""
    add_background(parser, "the field's own", f"; {TRANSPARENT}: none, for files that keep opacity")
    parser.add_argument("--transparent", action="store_true", help=f"the same as --background {TRANSPARENT}")
    parser.add_argument(
        "--format",
        choices=("png", "exr"),
        default=None,
        help="what a folder of pictures holds: png (straight colours), or exr (linear light, multiplied by opacity, "
        "with depth) (default: png)",
    )


def add_masks(parser: Arguments) -> None:
    """What to do with the mask files of a scene."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--no-masks",
        dest="masks",
        action="store_false",
        default=True,
        help="ignore the mask files of a scene: whole pictures are used, with their background",
    )
    group.add_argument(
        "--split-masks",
        dest="masks",
        action="store_const",
        const="split",
        help="split the pictures at the masks, into the object and its surroundings, which become layers behind it",
    )
    group.add_argument(
        "--weight-masks",
        dest="masks",
        action="store_const",
        const="weights",
        help="ignore what is black in the masks, such as people who walk by; pictures stay whole",
    )


def add_selection(parser: Arguments, what: str = "only what is chosen") -> None:
    """A selection of the field; what: what becomes of it."""
    parser.add_argument("--selection", metavar="FILE", help=f"{what} by warpcage select (.npz, .json)")


def add_in_box(parser: Arguments) -> None:
    parser.add_argument("--in-box", help="what lies between two opposite corners, world units", **BOX)


def add_parts(parser: Arguments) -> None:
    """Which connected parts of an object are kept."""
    parser.add_argument("--parts", help="the N largest connected parts", **COUNT)
    parser.add_argument(
        "--floaters",
        help="leave out connected parts with fewer voxels than this share of the largest, e.g. 0.01",
        **positive("SHARE"),
    )


def add_fill(parser: Arguments) -> None:
    parser.add_argument(
        "--fill",
        action="store_true",
        default=None,
        help="fill the background that an edit uncovers and no picture showed by a smooth continuation of what is "
        "around it; masks show it violet (default: it is shown as the fit left it)",
    )


def add_antialias(parser: Arguments) -> None:
    parser.add_argument(
        "--antialias",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="splats only: weaken those that are smaller than a pixel, for files that were fitted in that way "
        "(Mip-Splatting); others get thinner where they are far away (default: as the file says)",
    )


def add_view(parser: Arguments) -> None:
    """The camera of a picture."""
    group = parser.add_argument_group(
        "view (default: from above and to one side, with the whole object in the picture)"
    )
    group.add_argument(
        "--camera",
        metavar="FILE[:NAME]|SCENE:[SPLIT:]INDEX",
        help="camera of a file (--save-camera writes one; .glb and .gltf as Blender exports them), or of a scene's "
        "picture, e.g. data/lego:test:3 (default split: train)",
    )
    group.add_argument(
        "--view", choices=VIEWS, help="side that the camera looks from, with the field's up (default: corner)"
    )
    group.add_argument(
        "--frame",
        choices=("rest", "posed"),
        help="what is in the picture where no camera is given: the field at rest, so that pictures of all poses can "
        "be compared, or the cages at rest and posed (default: rest)",
    )
    group.add_argument("--save-camera", metavar="FILE", help="also write the camera, or all of a film (.json)")
    group.add_argument(
        "--eye", type=float, nargs=3, metavar=("X", "Y", "Z"), help="position of the camera, world units"
    )
    group.add_argument(
        "--target", type=float, nargs=3, metavar=("X", "Y", "Z"), help="point that it looks at, world units"
    )
    group.add_argument(
        "--up",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="direction that points up in the picture (default: up in the training pictures of the field)",
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
        help="width, or width and height; a width alone makes a square, or keeps the shape of --camera's picture "
        "(default: 400, or the size of --camera's picture)",
        **PIXELS,
    )


def add_deformation(
    parser: Arguments,
    *,
    keyframes: bool = False,
    several: bool = False,
    usual_resolution: str = "by the picture's size, a cell for 5 pixels, 64 to 128",
) -> None:
    """Add the cages of a deformation and how it is computed; several poses make a film (keyframes) or pictures.
    usual_resolution: what the help says of the lattice where it is not given."""
    group = parser.add_argument_group(
        "deformation (--cage and --posed, or --edit, or --edits; without them the field is shown as it is)"
    )
    group.add_argument("--cage", metavar="REST", help=f"cage around the undeformed object ({' '.join(CAGE_ENDINGS)})")
    posed = (
        "the same cage with its vertices moved: a cage file, a keyframe of a pose file (poses.json:NAME), or a preset "
        "such as bend:40:x:z, twist:60 or scale:0.8"
    )
    if keyframes:
        posed += (
            ". Several, or all keyframes of a pose file (poses.json), follow one another. An animated glTF file "
            "(walk.glb), numbered files (walk_####.obj) or their folder are taken frame for frame"
        )
    if several:
        posed += ". Several, or all keyframes of a pose file, make a picture each, in a folder"
    group.add_argument("--posed", metavar="POSED", nargs="+" if keyframes or several else None, help=posed)
    add_edits(group)
    add_cage_up(group, found=True, posed=True)
    group.add_argument(
        "--coordinates",
        choices=COORDINATES,
        default=FIELD_COORDINATES,
        help="kind of coordinates (default: %(default)s)",
    )
    group.add_argument(
        "--resolution",
        type=lattice_resolution,
        default=BY_SIZE,
        metavar="N",
        help='lattice cells along the longest side of the cage, or "precise" to evaluate the '
        f"coordinates at every sample (mean_value and green only) (default: {usual_resolution})",
    )
    group.add_argument(
        "--density",
        choices=DENSITIES,
        default="opacity",
        help="opacity: parts keep their opacity when they are scaled; paper: they keep their density, as in the paper "
        "(default: %(default)s)",
    )
    add_map(group)


def add_things(parser: Arguments, *, saved: bool = False) -> None:
    """Add what is shown beside the field, in one scene; saved: whether the scene is kept as a file."""
    group = parser.add_argument_group("several things in one scene (FIELD may be a stage file, .stage.json, too)")
    group.add_argument(
        "--add",
        action="append",
        metavar="FIELD[:PLACE[:EDITS]]",
        help="also show another field, where a place file (.json) says, posed by an edits file (.json) of its own; "
        'repeat it for more. A place file: {"position": [1, 0, 0], "turn": [0, 0, 90], "scale": 0.5}',
    )
    if saved:
        group.add_argument("--save-stage", metavar="FILE", help="also write the scene as one file (.stage.json)")


def add_map(parser: Arguments) -> None:
    parser.add_argument(
        "--map",
        choices=SPLAT_MAPS,
        help="splats only. forward: they move by the coordinates of the cage at rest; backward: they go where voxels "
        "under the same cage would be (default: forward)",
    )


def add_edits(parser: Arguments) -> None:
    parser.add_argument(
        "--edit",
        action="append",
        metavar="CAGE:POSED[:keep]",
        help="one of several edits; give it again for the next, which acts on what the ones before it left. POSED as "
        "for --posed. CAGE:POSED:keep leaves a copy where it was, CAGE:remove takes away what is in the cage, "
        "CAGE:POSED:falloff=WIDTH is a --falloff of its own",
    )
    parser.add_argument(
        "--falloff",
        help="hold the walls of a cage that cut through matter, and let the edit fade to rest in a band of this width "
        "inside them, world units, so that a part does not tear off (default: no wall is held)",
        **positive("WIDTH"),
    )
    parser.add_argument(
        "--fragments",
        help="take pieces smaller than this, world units, that a cage cuts off its part, along with the part (default: "
        "they stay)",
        **positive("SIZE"),
    )
    parser.add_argument("--crumbs", dest="fragments", action=OldName, type=positive_float, help=argparse.SUPPRESS)
    parser.add_argument(
        "--edits",
        metavar="FILE",
        help="all edits from a file (warpcage edits writes one), or those of a session of the editor (.session.json)",
    )


# Values


def whole_from(least: int) -> Callable[[str], int]:
    """Takes whole numbers from `least` on."""

    def whole(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {least}, got {text!r}")
        return value

    return whole


positive_int, whole_number = whole_from(1), whole_from(0)


def positive_float(text: str) -> float:
    value = finite_float(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"must be positive, got {text!r}")
    return value


def positive_fraction(text: str) -> fractions.Fraction:
    """A number above 0, or a ratio of two such as 2/3, exactly."""
    try:
        # the digits of 1e999999999 would take all memory: a float is bounded, and its text has few digits
        value = fractions.Fraction(text if "/" in text else repr(float(text)))
    except (ValueError, ZeroDivisionError):
        value = fractions.Fraction(0)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"must be positive, a number or a ratio such as 2/3, got {text!r}")
    return value


def positive_ratio(text: str) -> float:
    """The same as a float."""
    try:
        return float(positive_fraction(text))
    except OverflowError:
        raise argparse.ArgumentTypeError(f"must be a number that a float can hold, got {text!r}") from None


def finite_float(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a finite number, got {text!r}")
    return value


def length(text: str, unit: str = "") -> float:
    """A finite number from 0 on, world units."""
    value = finite_float(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"must be 0 or more{unit}, got {text!r}")
    return value


def seconds(text: str) -> float:
    """A finite number from 0 on."""
    return length(text, " seconds")


def field_of_view(text: str) -> float:
    """Degrees between 0 and 180, both left out."""
    value = finite_float(text)
    if not 0 < value < 180:
        raise argparse.ArgumentTypeError(f"must lie between 0 and 180 degrees, got {text!r}")
    return value


def lattice_resolution(text: str) -> int | str | None:
    """A whole number of at least 1, None for "precise", or BY_SIZE."""
    return text if text == BY_SIZE else None if text == "precise" else positive_int(text)


def color(text: str) -> str | tuple[float, ...]:
    """A name, or numbers between commas. The library checks them."""
    parts = text.split(",")
    if len(parts) == 1:
        return text
    try:
        return tuple(float(part) for part in parts)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a name or three numbers such as 0.2,0.3,0.4, got {text!r}") from None


def check_output(text: str, endings: tuple[str, ...], what: str) -> pathlib.Path:
    """Check the path of an output before any long work; endings: such as ".png"; what: how messages call the file."""
    path = pathlib.Path(text)
    if path.suffix.lower() not in endings:
        raise InputError(f"{what} {str(path)!r} must end in {' or '.join(endings)}")
    if path.is_dir():
        raise InputError(f"{what} {str(path)!r} is a folder")
    check_parent(path)
    return path


def check_parent(path: pathlib.Path) -> None:
    """Raises ValueError for a path below something that is not a folder."""
    for parent in path.parents:
        if parent.exists():
            if not parent.is_dir():
                raise InputError(f"{str(path)!r} cannot be written: {str(parent)!r} is not a folder")
            return


def require_folder(path: str) -> None:
    """Raises FileNotFoundError where there is no such scene folder."""
    if not pathlib.Path(path).is_dir():
        what = "is a file" if pathlib.Path(path).is_file() else "is not there"
        raise MissingFileError(f"scene folder {path!r} {what}")


#: How options take a number of things, a length, a point, a box of two corners, and the size of pictures.
COUNT: dict[str, Any] = {"type": positive_int, "metavar": "N"}
LENGTH: dict[str, Any] = {"type": length, "metavar": "LENGTH"}
POINT: dict[str, Any] = {"type": finite_float, "nargs": 3, "metavar": ("X", "Y", "Z")}
BOX: dict[str, Any] = {"type": finite_float, "nargs": 6, "metavar": ("X0", "Y0", "Z0", "X1", "Y1", "Z1")}
PIXELS: dict[str, Any] = {"type": positive_int, "nargs": "+", "metavar": "PIXELS"}


def positive(metavar: str) -> dict[str, Any]:
    """How options take a number above 0."""
    return {"type": positive_float, "metavar": metavar}
