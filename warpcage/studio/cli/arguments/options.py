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

from ....core.names import TRANSPARENT, shown
from ....core.spec import Values, color_of, defaults_of, fraction, names_of, number, options_of, positive, whole
from ....edits.spec import EditSpec
from ....errors import InputError, MissingFileError, StateError
from ....package import renamed_line
from ...spec.film import FilmSpec
from ...spec.scene import FitSceneSpec, FitSpec
from ...spec.shot import DEFORMATION, PICTURE

# Values


def typed(values: Values) -> Callable[[str], Any]:
    """Takes what an option of a spec takes."""

    def value(text: str) -> Any:
        try:
            return values.parse(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error).strip()) from None

    return value


positive_int, whole_number = typed(whole(1)), typed(whole(0))
positive_float, positive_fraction, finite_float = typed(positive()), typed(fraction()), typed(number())
length = seconds = typed(number(0.0))


def _field_of_view(value: Any, name: str) -> float:
    if not 0.0 < number().check(value, name) < 180.0:
        raise InputError(f"{name} must lie between 0 and 180 degrees, got {shown(value)}")
    return value


def color(text: str) -> str | tuple[float, ...]:
    """A name, or numbers between commas. The library checks them."""
    try:
        return color_of(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a name or three numbers such as 0.2,0.3,0.4, got {text!r}") from None


def given(args: argparse.Namespace, *names: str) -> list[str]:
    """Which of some options of a command were given."""
    return [name for name in names if getattr(args, name, None) is not None]


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
        try:
            setattr(namespace, self.dest, self._size(values))
        except argparse.ArgumentTypeError as error:
            parser.error(f"argument {option_string}: {error}")

    def _size(self, values: list[str]) -> PictureSize:
        parts = [part for value in values for part in re.sub(r"^(\d+)[x×](\d+)$", r"\1 \2", value).split()]
        widen, shape = parts[-1:] == ["widen"], None
        parts = parts[:-1] if widen else parts
        if parts and ":" in parts[-1]:
            try:
                shape = positive_fraction(parts.pop().replace(":", "/"))
            except argparse.ArgumentTypeError:
                raise argparse.ArgumentTypeError(f"a shape is two numbers such as 16:9, got {values[-1]!r}") from None
        sides = [positive_int(part) for part in parts]
        if len(sides) > (2 if shape is None else 1) or not (sides or shape):
            what = "a width, or a width and a height, or a shape such as 16:9"
            raise argparse.ArgumentTypeError(f"takes {what}, got {' '.join(values)!r}")
        width, height = (*sides, None, None)[:2]
        return PictureSize(width, height, shape, widen)


# Declarations


class OldName(argparse.Action):
    """An option by its old name."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        old, new = self.option_strings[0], self.dest.replace("_", "-")
        warnings.warn(renamed_line(old, f"--{new}"), stacklevel=2)
        setattr(namespace, self.dest, values)


class _FrameWord(argparse.Action):
    """Takes the value of --frame: what a picture is framed by, or the file of the frame that a field is in."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: Any, values: Any, option_string: Any = None) -> None:
        if str(values).lower().endswith(".json"):
            namespace.frame_file = values
        elif values in ("rest", "posed"):
            setattr(namespace, self.dest, values)
        else:
            parser.error(f"argument {option_string}: takes rest, posed or a .json file, got {values!r}")


#: Options of specs that are flags, by spec and name and by flag alone: that of the first spec that has it.
SPEC_FLAGS: dict[str, tuple[type, str]] = {}
for _spec in (EditSpec, FilmSpec, FitSceneSpec, FitSpec):
    for _name, _option in options_of(_spec).items():
        if _option.flag:
            SPEC_FLAGS[f"{_spec.__name__}.{_name}"] = _spec, _name
            SPEC_FLAGS.setdefault(_option.flag.split()[0], (_spec, _name))


def _spec_row(spec: type, name: str, default_help: str) -> tuple[str, dict[str, Any]]:
    """The row of an option of a spec, and keyword arguments of `add_argument`; default_help: what the default of a
    command does, empty for that of the spec."""
    option, default = options_of(spec)[name], defaults_of(spec)[name]
    option = option._replace(default_help=default_help) if default_help else option
    row, values, settings = f"{option.flag}  {option.full_help}", option.values, {"dest": name, "default": default}
    if spec is FilmSpec:  # None is a flag that is not given: `shot_of` puts in the default
        row, settings["default"] = row.replace("%(default)s", str(default)), None
    if values.schema.get("type") == "boolean":
        action = argparse.BooleanOptionalAction if default is None else "store_true"
        return row, settings | {"action": action, "default": None}
    return row, settings | ({"choices": values.choices} if values.choices else {"type": typed(values)})


def flags_of(spec: type, group: str, *without: str) -> str:
    """The rows of a group of a spec's options, but of some."""
    rows = (f"{spec.__name__}.{name}" for name in names_of(spec, group) if name not in without)
    return "\n".join(row for row in rows if row in SPEC_FLAGS)


#: What takes the values of options that stand for them so.
TYPES = {
    "N": positive_int,
    **dict.fromkeys(("X", "X0", "DEGREES"), finite_float),
    **dict.fromkeys(("FACTOR", "SHARE", "SIGMA", "WEIGHT", "WIDTH"), positive_float),
    "LENGTH": length,
    "RATE": positive_fraction,
    "COLOUR": color,
}

#: Files of cages, meshes and splats, as help texts have them: the formats themselves are known with NumPy alone.
CAGES, MESHES, SPLATS = (
    f"such as {endings}; `warpcage info` lists all" for endings in (".obj or .glb", ".obj or .stl", ".ply or .spz")
)

#: Options of several commands, which name them alone.
SHARED = f"""
field  field file: voxels (.npz) or splats ({SPLATS}), or an output folder of 3D Gaussian
    Splatting
--cage-object NAME  the object that is the cage in a file of several (OBJ, glTF, USD); '*' takes all as one cage
--device NAME  Warp device, "cpu" or "cuda:0" (default: CUDA where there is one)
--floaters SHARE  leave out connected parts with fewer voxels than this share of the largest, e.g. 0.01
--in-box X0 Y0 Z0 X1 Y1 Z1  what is in the box between two opposite corners, world units
--masks SCENE  what is opaque, or white in the masks, in every training picture of a scene
--parts N  only the N largest connected parts
--posed-up  axis that points up in posed cage files (default: that of --cage-up; without it, guessed for each file)
--quiet  no progress bar
--selection FILE  only the object of a selection file (warpcage select writes one: .npz, .json)
"""

#: How their values are taken, and those of options below, or of commands whose help differs.
SHARED_VALUES: dict[str, Any] = {
    "as": {"dest": "representation", "choices": ("voxels", "splats")},
    "cage_up": ("y", "z"),
    "crumbs": {"dest": "fragments", "action": OldName, "type": length},
    "add": {"action": "append"},
    "edit": {"action": "append"},
    "frame": {"action": _FrameWord},
    "fov": typed(Values(_field_of_view, convert=float)),
    "no_masks": {"dest": "masks", "action": "store_false", "default": True},
    "output": {"required": True},
    "posed_up": ("y", "z"),
    "size": {"action": _PictureSizes},
    "split_masks": {"dest": "masks", "action": "store_const", "const": "split"},
    "view": ("corner", "front", "back", "left", "right", "top", "bottom"),
    "weight_masks": {"dest": "masks", "action": "store_const", "const": "weights"},
}

#: The axis that points up in cage files: that of their format, or found by an object that is there.
CAGE_UP, CAGE_UP_FOUND = (
    f"--cage-up  axis that points up in cage files (default: {default})\n--cage-object"
    for default in (
        "y for glTF, z for other formats; Blender exports OBJ with y up unless its export settings say z",
        "guessed from the object; if unsure, y for glTF, z for others",
    )
)

#: What commands that read a field end with.
SCALE_AND_DEVICE = """
options:
--scene-scale
--device
"""

#: How pictures are made, and the files that a folder of them holds.
PICTURES = f"""
{flags_of(FilmSpec, PICTURE, "show", "format")}
--transparent  the same as --background {TRANSPARENT}
FilmSpec.format
"""

#: What is said of a file of --frame.
FRAME_HELP = """a
    dataparser_transforms.json of nerfstudio: moves splats from its coordinates into those of the dataset"""

#: That of commands without a view, and how its value is taken.
FRAME = f"--frame FILE  {FRAME_HELP}"
FRAME_VALUE = {"dest": "frame_file"}

#: Degrees of the horizontal field of view where --fov is not given.
FOV = 40.0

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
--fov DEGREES  horizontal field of view (default: {FOV})
--size PIXELS...  width, width and height, or aspect ratio: 800, 1920x1080, 16:9 or 1080 9:16. A width alone makes a
    square, or keeps the aspect ratio of --camera's picture. Another aspect ratio crops that picture; add the word widen
    to see more at its sides instead (default: 400, or the size of --camera's picture)
"""


#: The scene that a command reads, and which of its pictures.
SCENE = """
scene  folder with pictures and cameras
--split
FitSceneSpec.format
one of:
--no-masks  ignore the mask files of a scene: whole pictures are used, with their background
--split-masks  split pictures by the masks, into the object and its surroundings, which become layers behind it
--weight-masks  ignore pixels that are black in the masks, such as passers-by, and use all others
options:
--downscale
--cameras
--model NAME  which of several models in a scene, such as "1" (default: the one with most pictures)
"""


#: What several values of --posed make of a film.
FOLLOWING = """. Several, or all keyframes of a pose file (poses.json), follow one another. An animated glTF file
    (walk.glb), numbered files (walk_####.obj) or their folder give one pose a frame"""


def deformation(posed: str = "POSED", several: str = "", resolution: str = "") -> str:
    """The cages of a deformation and how it is computed; resolution: what its default is; others as of `cages`."""
    flags = flags_of(FilmSpec, DEFORMATION, "coordinates").replace("resolution", f"resolution {resolution}")
    return cages(posed, several) + flags


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
--falloff
--fragments
--crumbs SIZE  {argparse.SUPPRESS}
--edits FILE  edits file (warpcage edits writes one), or a session of the editor (.session.json)
{CAGE_UP_FOUND}
--posed-up
--coordinates
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
        key, _, default_help = row.partition(" ")
        usual = None
        if "  " not in row:
            known = None if key in _SHARED_ROWS else SPEC_FLAGS.get(key)
            row, usual = (_SHARED_ROWS[row], None) if known is None else _spec_row(*known, default_help.strip())
        flag, help = row.split("  ", 1)
        help = argparse.SUPPRESS if help == argparse.SUPPRESS else help  # which argparse knows by its identity
        name, *metavars = flag.split()
        key = "output" if name == "-o" else name.lstrip("-").replace("-", "_")
        names = ("-o", "--output") if name == "-o" else (name,)
        usual = SHARED_VALUES.get(key, {}) if usual is None else usual
        group.add_argument(*names, help=help, **_settings(left.pop(key, usual), metavars, name))
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
