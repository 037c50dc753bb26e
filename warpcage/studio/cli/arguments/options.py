"""How options are declared, those that several commands share, and the values that they take."""

from __future__ import annotations

import argparse
import dataclasses
import fractions
import pathlib
import re
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

from ....coordinate_kinds import names_where
from ....core.names import BACKGROUNDS, COORDINATES, DENSITIES, FIELD_COORDINATES, SPLAT_MAPS, TRANSPARENT
from ....errors import InputError, MissingFileError, StateError

#: Files of cages and meshes that hold motion too.
MOTION_ENDINGS = (".glb", ".gltf", ".usd", ".usda", ".usdc")

CAGE_ENDINGS = (".obj", ".ply", ".off", *MOTION_ENDINGS)

MESH_ENDINGS = (".obj", ".ply", ".off", ".stl", *MOTION_ENDINGS)

SELECTION_ENDINGS = (".npz", ".json")

#: Files of splats that are written: 3DGS' and SuperSplat's .ply, of web viewers, Niantic's, PlayCanvas', glTF and USD.
SPLAT_ENDINGS = (".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".glb", ".usd", ".usda", ".usdc", ".usdz")

#: Those that are read. A folder of SOG has a meta.json.
SPLATS_READ = (*SPLAT_ENDINGS, ".gltf", ".ksplat", "meta.json")

#: What a film may show of its frames.
PICTURE_KINDS = ("rgb", "alpha", "depth", "disparity", "masks")

#: Sides that pictures are taken from.
VIEWS = ("corner", "front", "back", "left", "right", "top", "bottom")

#: The lattice where --resolution is not given.
BY_SIZE = "by size"


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


#: Moments that motion blur is the mean of, where their number is not given, and most of them.
SUBFRAMES, MAX_SUBFRAMES = 8, 256


def shutter(text: str) -> tuple[float, int]:
    """The share of a frame that a shutter is open, of degrees above 0 to 360, and the number of moments in it."""
    degrees, separator, number = text.partition(":")
    try:
        angle, count = float(degrees), int(number) if separator else SUBFRAMES
    except ValueError:
        angle, count = 0.0, 0
    if not (0.0 < angle <= 360.0 and 1 <= count <= MAX_SUBFRAMES):
        raise argparse.ArgumentTypeError(
            f"must be degrees above 0 to 360, or with a number of moments up to {MAX_SUBFRAMES}, as in 180 or 180:16, "
            f"got {text!r}"
        )
    return angle / 360.0, count


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


def float_where(fits: Callable[[float], bool], wanted: str) -> Callable[[str], float]:
    """Takes finite numbers in a range."""

    def value_of(text: str) -> float:
        value = finite_float(text)
        if not fits(value):
            raise argparse.ArgumentTypeError(f"must {wanted}, got {text!r}")
        return value

    return value_of


positive_float = float_where(lambda value: value > 0, "be positive")
length = float_where(lambda value: value >= 0, "be 0 or more")  # world units
seconds = float_where(lambda value: value >= 0, "be 0 or more seconds")
field_of_view = float_where(lambda value: 0 < value < 180, "lie between 0 and 180 degrees")


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
    from ....core.files import check_parent  # with NumPy, which help does without

    path = pathlib.Path(text)
    if path.suffix.lower() not in endings:
        raise InputError(f"{what} {str(path)!r} must end in {' or '.join(endings)}")
    if path.is_dir():
        raise InputError(f"{what} {str(path)!r} is a folder")
    check_parent(path)
    return path


def require_folder(path: str) -> None:
    """Raises FileNotFoundError where there is no such scene folder."""
    from ....core.files import seen_note  # with NumPy, which help does without

    if not pathlib.Path(path).is_dir():
        what = f"is a file{seen_note(path)}" if pathlib.Path(path).is_file() else "is not there"
        raise MissingFileError(f"scene folder {path!r} {what}")


@dataclasses.dataclass(frozen=True)
class PictureSize:
    """What --size asks for."""

    width: int | None = None
    height: int | None = None
    shape: fractions.Fraction | None = None  # width over height, of a width or of none
    widen: bool = False  # show more than the camera's picture where its shape is another

    @property
    def is_shaped(self) -> bool:
        """Whether it says more than a width."""
        return self.height is not None or self.shape is not None

    def of(self, width: int, height: int) -> tuple[int, int]:
        """Width and height where only a shape is given, of a camera of a picture of some size, not magnified."""
        if self.shape is None:
            across = width if self.width is None else self.width
            return across, self.height or across
        most = max if self.widen else min
        across = self.width or round(most(width, height * self.shape))
        return max(1, across), max(1, round(across / self.shape))


class _PictureSizes(argparse.Action):
    """Reads the values of --size."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option_string: Any = None) -> None:
        parts = [part for word in values for part in re.sub(r"^(\d+)[x×](\d+)$", r"\1 \2", word).split()]
        widen = parts[-1] == "widen"
        parts = parts[:-1] if widen else parts
        shape = None
        if parts and ":" in parts[-1]:
            try:
                shape = positive_fraction(parts.pop().replace(":", "/"))
            except argparse.ArgumentTypeError:
                parser.error(f"argument {option_string}: a shape is two numbers such as 16:9, got {values[-1]!r}")
        try:
            numbers = [positive_int(word) for word in parts]
        except argparse.ArgumentTypeError as error:
            parser.error(f"argument {option_string}: {error}")
        if len(numbers) > (2 if shape is None else 1) or not (numbers or shape):
            parser.error(
                f"argument {option_string}: takes a width, or a width and a height, or a shape such as 16:9, got "
                f"{' '.join(values)!r}"
            )
        width, height = (*numbers, None, None)[:2]
        setattr(namespace, self.dest, PictureSize(width, height, shape, widen))


# Declarations


class OldName(argparse.Action):
    """An option by its old name, which the next version does not know."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        old, new = self.option_strings[0], self.dest.replace("_", "-")
        warnings.warn(f"{old} is called --{new} now: the old name goes with the next version", stacklevel=2)
        setattr(namespace, self.dest, values)


class _FrameWord(argparse.Action):
    """Takes the word of --frame: what a picture is framed by, or the file of the frame that a field is in."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option_string: Any = None) -> None:
        if values.lower().endswith(".json"):
            namespace.frame_file = values
        elif values in ("rest", "posed"):
            setattr(namespace, self.dest, values)
        else:
            parser.error(f"argument {option_string}: takes rest, posed or a .json file, got {values!r}")


#: What takes the values of options that stand for them so.
TYPES = {
    "N": positive_int,
    **dict.fromkeys(("X", "X0", "DEGREES"), finite_float),
    **dict.fromkeys(("FACTOR", "SHARE", "SIGMA", "WEIGHT", "WIDTH"), positive_float),
    "LENGTH": length,
    "RATE": positive_fraction,
    "COLOUR": color,
}

#: Endings and colours, as help texts have them.
CAGES, MESHES, SPLATS = map(" ".join, (CAGE_ENDINGS, MESH_ENDINGS, SPLAT_ENDINGS))
COLORS = f"{', '.join(BACKGROUNDS)}, or three numbers in [0, 1] such as 0.2,0.3,0.4"

#: Options of several commands, which name them alone.
SHARED = f"""
field  field file: voxels (.npz) or splats ({" ".join(SPLATS_READ)}), or an output
    folder of 3D Gaussian Splatting
--antialias  splats only: antialiasing of Mip-Splatting, for files trained with it; other files get too thin in the
    distance by it (default: as the file says)
--cage-object NAME  the object that is the cage in a file of several (OBJ, glTF); '*' takes all as one cage
--device NAME  Warp device, "cpu" or "cuda:0" (default: CUDA where there is one)
--fill  fill background that an edit uncovers and no picture showed with a smooth continuation of its surroundings;
    violet in masks (default: leave it as fitted)
--floaters SHARE  leave out connected parts with fewer voxels than this share of the largest, e.g. 0.01
--format NAME  scene format (default: detected)
--in-box X0 Y0 Z0 X1 Y1 Z1  what is in the box between two opposite corners, world units
--map  splats only. forward: move them by the coordinates of the cage at rest; backward: put them where voxels under the
    same cage would go (default: forward)
--masks SCENE  what is opaque, or white in the masks, in every training picture of a scene
--parts N  only the N largest connected parts
--posed-up  axis that points up in posed cage files (default: that of --cage-up; without it, guessed for each file)
--quiet  no progress bar
--scene-scale FACTOR  undo a scaling: the factor by which the positions of a scene were multiplied before its field was
    fitted, 2/3 for Plenoxels checkpoints of NeRF-synthetic scenes (default: 1)
--selection FILE  only the object of a selection file (warpcage select writes one: .npz, .json)
"""

#: How their values are taken, and those of options below, or of commands whose help differs.
SHARED_VALUES: dict[str, Any] = {
    "antialias": {"action": argparse.BooleanOptionalAction, "default": None},
    "as": {"dest": "representation", "choices": ("voxels", "splats")},
    "cage_up": ("y", "z"),
    "crumbs": {"dest": "fragments", "action": OldName, "type": positive_float},
    "coordinates": {"choices": COORDINATES, "default": FIELD_COORDINATES},
    "density": {"choices": DENSITIES, "default": "opacity"},
    "downscale": 1,
    "add": {"action": "append"},
    "edit": {"action": "append"},
    "fill": {"action": "store_true", "default": None},
    "fragments": positive_float,
    "frame": {"action": _FrameWord},
    "fov": {"type": field_of_view, "default": 40.0},
    "map": SPLAT_MAPS,
    "no_masks": {"dest": "masks", "action": "store_false", "default": True},
    "output": {"required": True},
    "posed_up": ("y", "z"),
    "resolution": {"type": lattice_resolution, "default": BY_SIZE},
    "scene_scale": {"type": positive_ratio, "default": 1.0},
    "size": {"action": _PictureSizes},
    "split_masks": {"dest": "masks", "action": "store_const", "const": "split"},
    "view": VIEWS,
    "weight_masks": {"dest": "masks", "action": "store_const", "const": "weights"},
}

#: The axis that points up in cage files: that of their format, or found by an object that is there.
CAGE_UP = """
--cage-up  axis that points up in cage files (default: y for glTF, z for other formats; Blender exports OBJ with y up
    unless its export settings say z)
--cage-object
"""

CAGE_UP_FOUND = """
--cage-up  axis that points up in cage files (default: guessed from the object; if unsure, y for glTF, z for others)
--cage-object
"""

#: What commands that read a field end with.
SCALE_AND_DEVICE = """
options:
--scene-scale
--device
"""

#: The background of pictures that may have none, and the files that a folder of them holds.
CLEAR_BACKGROUND = f"""
--background COLOUR  {COLORS} (default: the field's own); {TRANSPARENT}: none, for file formats with an alpha channel
--transparent  the same as --background {TRANSPARENT}
--format  file format in a folder of pictures: png (alpha not premultiplied), or exr (linear light, premultiplied alpha,
    with depth) (default: png)
"""

#: What is said of a file of --frame.
FRAME_HELP = """a
    dataparser_transforms.json of nerfstudio: moves splats from its coordinates into those of the dataset"""

#: That of commands without a view, and how its value is taken.
FRAME = f"--frame FILE  {FRAME_HELP}"
FRAME_VALUE = {"dest": "frame_file"}

#: The camera of a picture.
VIEW = f"""
view (default: from above and to one side, with the whole object in the picture):
--camera FILE[:NAME]|SCENE:[SPLIT:]INDEX  a camera file (--save-camera writes one; .glb and .gltf as Blender exports
    them), or the camera of a scene's picture, e.g. data/lego:test:3 (default split: train)
--view  side that the camera looks from; up is the field's (default: corner)
--frame rest|posed|FILE  what the picture frames where no camera is given: rest: the object at rest, so that pictures of
    all poses can be compared; posed: the cages at rest and posed, and everything outside them (default: rest);
    {FRAME_HELP}
--save-camera FILE  also write the camera to a file (.json); of a film, all its cameras
--eye X Y Z  position of the camera, world units
--target X Y Z  point that it looks at, world units
--up X Y Z  direction that points up in the picture (default: up in the training pictures of the field)
--fov DEGREES  horizontal field of view (default: %(default)s)
--size PIXELS...  width, width and height, or aspect ratio: 800, 1920x1080, 16:9 or 1080 9:16. A width alone makes a
    square, or keeps the aspect ratio of --camera's picture. Another aspect ratio crops that picture; add the word widen
    to see more at its sides instead (default: 400, or the size of --camera's picture)
"""


#: The scene that a command reads, and which of its pictures.
SCENE = """
scene  folder with pictures and cameras
--split  which pictures of a scene, such as train or test (default: %(default)s)
--format
one of:
--no-masks  ignore the mask files of a scene: whole pictures are used, with their background
--split-masks  split pictures by the masks, into the object and its surroundings, which become layers behind it
--weight-masks  ignore pixels that are black in the masks, such as passers-by, and use all others
options:
--downscale N  shrink the pictures by averaging N x N pixels (default: %(default)s)
--cameras FILE  camera file (.json) with a camera for each picture, by its name, instead of those of the scene; `fit
    --refine-cameras` writes one
--model NAME  which of several models in a scene, such as "1" (default: the one with most pictures)
"""


#: What several values of --posed make of a film.
FOLLOWING = """. Several, or all keyframes of a pose file (poses.json), follow one another. An animated glTF file
    (walk.glb), numbered files (walk_####.obj) or their folder give one pose a frame"""


def deformation(
    posed: str = "POSED", several: str = "", resolution: str = "by the picture's size, a cell for 5 pixels, 64 to 128"
) -> str:
    """The cages of a deformation and how it is computed; resolution: the usual lattice; others as of `cages`."""
    return f"""{cages(posed, several)}\
--resolution N  lattice cells along the longest side of the cage, or "precise" to evaluate the coordinates at every
    sample ({" and ".join(names_where("is_precise"))} only) (default: {resolution})
--density  what parts keep when they are scaled. opacity: their opacity; paper: their density, as in the paper
    (Deforming Radiance Fields with Cages) (default: %(default)s)
--map
"""


def cages(posed: str = "POSED", several: str = "") -> str:
    """The cages of a deformation and their coordinates; posed: metavar; several: what several poses do."""
    return f"""
deformation (--cage and --posed, or --edit, or --edits; without them the field is shown as it is):
--cage REST  cage around the undeformed object ({CAGES})
--posed {posed}  the same cage with its vertices moved: a cage file, a keyframe of a pose file (poses.json:NAME), or a
    preset such as bend:40:x:z, twist:60 or scale:0.8{several}
--edit CAGE:POSED[:keep]  one of several edits; repeat it for the next, which acts on the result of those before it.
    POSED as for --posed. CAGE:POSED:keep leaves a copy in place, CAGE:remove deletes what is in the cage,
    CAGE:POSED:falloff=WIDTH has a --falloff of its own
--falloff WIDTH  hold the sides of a cage that cut through the object, and fade the edit out in a band of this width
    inside them, world units, so that a part does not tear off (default: no side is held)
--fragments SIZE  take loose pieces that a cage cuts off along with its part, up to this size, world units (default:
    they stay)
--crumbs SIZE  {argparse.SUPPRESS}
--edits FILE  edits file (warpcage edits writes one), or a session of the editor (.session.json)
{CAGE_UP_FOUND}
--posed-up
--coordinates  kind of cage coordinates (default: %(default)s)
"""


def objects(more: str = "") -> str:
    """What is shown beside the field, in one scene; more: other rows of the group."""
    return f"""
several objects in one scene (FIELD may also be a scene file, .stage.json):
--add FIELD[:PLACE[:EDITS]]  add another field, or a mesh (.glb .obj .ply), placed by a place file (.json) and posed by
    an edits file (.json) of its own; repeat it for more. A place file:
    {{"position": [1, 0, 0], "turn": [0, 0, 90], "scale": 0.5}}
{more}"""


def add_rows(parser: argparse.ArgumentParser, *texts: str, **values: Any) -> None:
    """Add options: rows as `--help` has them, "--name METAVAR  help", further lines indented, or names of SHARED; one
    that ends with a colon begins a group. values: what takes the value of an option, see `_settings`."""
    group: argparse._ActionsContainer = parser
    left = dict(values)
    for row in _rows("\n".join(texts)):
        if row.endswith(":") and "  " not in row:
            title = row[:-1]
            if title in ("one of", "one of these"):  # the latter is required
                group = parser.add_mutually_exclusive_group(required=title == "one of these")
            else:
                group = parser if title == "options" else parser.add_argument_group(title)
            continue
        flag, help = (row if "  " in row else _SHARED_ROWS[row]).split("  ", 1)
        help = argparse.SUPPRESS if help == argparse.SUPPRESS else help  # which argparse knows by its identity
        name, *metavars = flag.split()
        key = "output" if name == "-o" else name.lstrip("-").replace("-", "_")
        names = ("-o", "--output") if name == "-o" else (name,)
        group.add_argument(*names, help=help, **_settings(left.pop(key, SHARED_VALUES.get(key, {})), metavars, name))
    if left:
        raise StateError(f"no row has {', '.join(left)}")


def _rows(text: str) -> list[str]:
    """Rows without the breaks of their lines."""
    found = re.split(r"\n(?=\S)", "\n" + text)
    return [re.sub(r"\s*\n\s*", " ", row.strip()) for row in found if row.strip()]


_SHARED_ROWS = {row.split()[0]: row for row in _rows(SHARED)}


def _settings(value: Any, metavars: list[str], name: str) -> dict[str, Any]:
    """Keyword arguments of `add_argument`; value: a type, a tuple of choices, a dictionary of such, or a default."""
    first, several = (metavars[0].removesuffix("..."), metavars[0].endswith("...")) if metavars else ("", False)
    known: dict[str, Any] = {"type": TYPES[first]} if first in TYPES else {}
    if metavars:
        known["metavar"] = tuple(metavars) if len(metavars) > 1 else first
    if several or len(metavars) > 1:
        known["nargs"] = "+" if several else len(metavars)
    if callable(value):
        return known | {"type": value}
    if isinstance(value, tuple):
        return known | {"choices": value}
    if not isinstance(value, dict):
        return known | {"default": value}
    return known | value if value or metavars or not name.startswith("-") else {"action": "store_true"}


class Command(NamedTuple):
    """A command as the parser knows it; `module` of `studio.cli` has run_NAME(args), loaded when it is chosen."""

    help: str  # one line
    example: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    module: str


#: All commands by their names.
COMMANDS: dict[str, Command] = {}


def command(
    name: str,
    module: str,
    help: str,
    example: str,
    /,
    *rows: str,
    more: Callable[[argparse.ArgumentParser], object] = lambda parser: None,
    **values: Any,
) -> None:
    """Declare a command by its rows (`add_rows`); more: called with its parser afterwards."""

    def add(parser: argparse.ArgumentParser) -> None:
        add_rows(parser, *rows, **values)
        more(parser)

    COMMANDS[name] = Command(help, example, add, module)


def package_version() -> str:
    from importlib import metadata

    try:
        return metadata.version("warpcage")
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"
