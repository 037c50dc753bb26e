"""What commands share: fields, cages and views from their arguments."""

from __future__ import annotations

import argparse
import pathlib
import re
import sys
from fractions import Fraction
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ...cage.cage import Cage
from ...cage.up_axis import object_points
from ...core.checks import warn_renamed
from ...core.devices import resolve_device
from ...core.files import PathLike, require_file
from ...core.names import TRANSPARENT
from ...core.spec import options_of
from ...deform.deformer import Deformer
from ...deform.stage import Stage
from ...edits.edits import MAX_CELLS, picture_cells
from ...edits.place import Place
from ...edits.spec import EditSpec, held_walls
from ...edits.stage_file import STAGE_ENDING, free_name
from ...errors import InputError
from ...mesh.io import ENDINGS
from ...mesh.queries import inside_mesh
from ...render.belonging import SceneViews, likeness, mismatch, moved_field, out_of_frame
from ...render.surface_mesh import load_object
from ...scene.formats.transforms import FRAME_FILE, read_frame
from ...scene.load import load_scene
from ...scene.scene import Scene
from ...splats.io import is_splat_file, splat_path
from ...splats.splat_field import AnyField, SplatField, load_field
from ...view.alignment import Similarity
from ...view.camera import Camera
from ..films import render
from ..films.edits import Deformation, EditReader, read_edits_file
from ..films.session_file import is_session, session_edits
from ..films.timeline import Objects, shown_corners
from ..spec.film import FilmSpec
from .arguments.options import positive_float
from .cameras import asset_resolver, named_scene


def edit_reader(
    args: argparse.Namespace, interpolation: str | None = None, *, timed: bool = False, fps: Fraction | None = None
) -> EditReader:
    """What reads the edits of a command."""
    defaults = {name: getattr(args, name, None) for name in ("falloff", "fragments")}
    defaults |= {"up": args.cage_up, "object": args.cage_object}
    return EditReader(asset_resolver(), interpolation, defaults, posed_up(args), timed, fps)


def read_deformation(args: argparse.Namespace, field: AnyField, reader: EditReader | None = None) -> Deformation | None:
    """The deformation that a command's options name, None where nothing is deformed; the field gives the axes of cage
    files. reader: None takes one pose an edit."""
    reader = reader or edit_reader(args)
    ways = [f"--{name}" for name in ("cage", "edit", "edits") if getattr(args, name) is not None]
    if len(ways) > 1:
        raise InputError(f"{ways[0]} and {ways[1]} do not go together: name each cage of several by --edit")
    if args.posed is not None and args.cage is None:
        raise InputError("--posed needs --cage, the same cage at rest")
    if args.cage is not None:
        if args.posed is None and not getattr(args, "overlay", False):
            raise InputError(
                "--cage and --posed go together: the cage at rest and the same cage posed (--overlay shows it at rest)"
            )
        texts = args.posed if isinstance(args.posed, list) else [args.posed or "rest"]
        return Deformation([reader.edit(EditSpec(args.cage, texts[0]), texts, field)])
    if args.edits is not None:
        return edits_of_file(args.edits, reader, field)
    specs = [parse_edit(text) for text in args.edit or ()]
    return reader.edits(specs, field) if specs else None


def edits_of_file(path: str, reader: EditReader, field: AnyField) -> Deformation:
    """The deformation of an edits file, or of a session of the editor."""
    if is_session(path):
        return session_edits(path, reader.interpolation)[0]
    return reader.edits(read_edits_file(path), field)


def posed_up(args: argparse.Namespace) -> str | None:
    """The axis that points up in posed cage files, None where it is to be found."""
    return getattr(args, "posed_up", None) or args.cage_up


#: How an edit is written in one argument.
EDIT_SHAPE = "CAGE:POSED, CAGE:POSED:keep, CAGE:POSED:falloff=WIDTH or CAGE:remove"

#: The last option after the cages, and how their values are read.
_LAST_OPTION = re.compile(r"(?:(.*):)?(?:(keep|remove)|(falloff|fragments|crumbs|held|object)=([^:]*))", re.DOTALL)
_VALUES = {"falloff": positive_float, "fragments": positive_float, "held": lambda text: held_walls(text, "held")}

#: A text that is none of them, after a posed cage: only glTF and pose files hold objects with names.
_SLIP = re.compile(r".+\.(?:obj|ply|off):([^:/\\]+)", re.IGNORECASE | re.DOTALL)

#: The cage is what goes up to the first ending of a cage file that a colon or the end follows: so the colon of a
#: Windows drive (C:\cage.obj) separates nothing.
_CAGE = re.compile(rf"(.+?(?:{'|'.join(map(re.escape, ENDINGS))}))(?::(.*))?", re.IGNORECASE | re.DOTALL)


def parse_edit(text: str) -> EditSpec:
    """An edit of --edit: CAGE:POSED, then ":keep", ":remove", ":falloff=WIDTH", ":held=WALLS", ":fragments=SIZE",
    ":object=NAME"."""
    found = _CAGE.fullmatch(text)
    if found is None:
        raise InputError(f"--edit {text!r} names no cage file ({' '.join(ENDINGS)}): write {EDIT_SHAPE}")
    cage, posed = found.groups()
    options: dict[str, Any] = {}
    try:
        while posed and (found := _LAST_OPTION.fullmatch(posed)) and not pathlib.Path(posed).exists():
            posed, flag, name, value = found.groups()
            if name == "crumbs":
                warn_renamed("crumbs=", "fragments=")
                name = "fragments"
            options[flag or name] = True if flag else _VALUES.get(name, str)(value)
        if posed and (slip := _SLIP.fullmatch(posed)) and not pathlib.Path(posed).exists():
            raise InputError(
                f"{slip[1]!r} is unknown in an edit, which takes keep, remove, falloff=, held=, fragments= and object="
            )
        if not posed and not options.get("remove"):
            raise InputError(f"there is no posed cage: write {EDIT_SHAPE}")
        return EditSpec(cage, posed or None, **options)
    except (ValueError, argparse.ArgumentTypeError) as error:
        raise InputError(f"--edit {text!r}: {error}") from None


def parse_add(text: str) -> tuple[str, str | None, str | None]:
    """Field, place file and edits file of a value of --add: FIELD, FIELD:PLACE or FIELD:PLACE:EDITS; "" is none."""
    # the colon of a Windows drive (C:\field.npz) separates nothing
    parts = re.split(r":(?![\\/])|(?<!^[A-Za-z])(?<!:[A-Za-z]):", text)
    if len(parts) > 3 or not parts[0]:
        raise InputError(f"--add {text!r} must be FIELD, FIELD:PLACE.json or FIELD:PLACE.json:EDITS.json")
    field, place, edits = (*parts, "", "")[:3]
    return field, place or None, edits or None


def is_deformed(args: argparse.Namespace) -> bool:
    """Whether options name a deformation."""
    return any(getattr(args, name, None) is not None for name in ("cage", "edit", "edits"))


def chosen_device(args: argparse.Namespace) -> wp.Device:
    return resolve_device(args.device)


def read_field(args: argparse.Namespace) -> AnyField:
    """The field file of a command, voxels or splats, on the chosen device, in the world of the scene that its options
    name; sets `args.straightening`, and `args.up` where --up is not given."""
    return in_world_of_scene(args, read_field_file(args), named_scene(args))


def read_field_file(args: argparse.Namespace) -> AnyField:
    """The same in the coordinates of its file."""
    args.field = str(splat_path(args.field))
    require_file(args.field, "field file")  # before Warp starts, which takes a while
    if is_splat_file(args.field):
        require_field_scale(args)
    elif getattr(args, "antialias", None) is not None:
        raise InputError(f"--antialias is for files of splats, got {args.field!r}")
    elif getattr(args, "map", None) == "forward":
        raise InputError(f"--map forward is for files of splats, voxels are looked up backward, got {args.field!r}")
    field = load_field(args.field, scene_scale=args.scene_scale, device=chosen_device(args))
    if getattr(args, "up", field) is None:  # a command with a view
        args.up = tuple(field.up)
    args.straightening = field.straightening  # cameras of scenes are moved by it
    return field


def in_world_of_scene(
    args: argparse.Namespace, field: AnyField, named: tuple[pathlib.Path, SceneViews] | None
) -> AnyField:
    """A field taken out of nerfstudio's frame where that is asked for, or a file beside says so and it then shows the
    scene's pictures; fields that do not are reported. named: folder and views of the scene, in its files' world."""
    source = None if named is None else named[1].to_source
    given = getattr(args, "frame_file", None)
    if given is not None:
        frame = read_frame(given)
        motion = out_of_frame(frame, source)
        field = moved_field(field, motion)
        _say_moved(args, given, frame, motion)
    if named is None:
        return field
    folder, views = named[0], named[1].moved(field.straightening)
    if (reason := mismatch(field, views)) is None:
        return field
    beside = {path.resolve(): path for path in (pathlib.Path(args.field).parent / FRAME_FILE, folder / FRAME_FILE)}
    for path in beside.values() if given is None and isinstance(field, SplatField) else ():
        if path.is_file():
            frame = read_frame(path)
            motion = out_of_frame(frame, source)
            if not likeness(field, views.glimpses, motion).is_doubtful:
                _say_moved(args, path, frame, motion)
                return moved_field(field, motion)
            reason += f", nor does {path}"
    print(
        f"warpcage: warning: {args.field} and the cameras of {folder} do not belong together: {reason}", file=sys.stderr
    )
    return field


def _say_moved(args: argparse.Namespace, path: PathLike, frame: Similarity, motion: Similarity) -> None:
    """Report that a field was taken out of nerfstudio's frame; set `args.is_moved` and `args.frame_motion`."""
    args.is_moved, args.frame_motion = True, motion  # camera paths of nerfstudio go along
    print(
        f"warpcage: {args.field} is moved out of nerfstudio's coordinates by {path}: {1.0 / frame.scale:.4g} times as "
        "large, turned and moved to where its dataset is",
        file=sys.stderr,
    )


def read_scene(args: argparse.Namespace, background: str | ArrayLike, orient: str | None = None) -> Scene:
    """The scene folder of a command, by its --split, --downscale, --format and --masks. See `load_scene`."""
    return load_scene(
        args.scene,
        split=args.split,
        downscale=args.downscale,
        format=args.format,
        background=background,
        masks=args.masks,
        orient=orient,
        cameras=args.cameras,
        model=args.model,
    )


def is_field(path: str) -> bool:
    """Whether a file is a field: voxels (.npz) or splats."""
    return path.lower().endswith(".npz") or is_splat_file(path)


def is_stage(path: str) -> bool:
    """Whether a file is that of a stage, by its ending."""
    return path.lower().endswith(STAGE_ENDING)


def scene_masks(path: str, field: AnyField) -> dict[str, Any]:
    """The masks of a scene's object and their cameras, as `select_nodes` takes them: of its training pictures, in the
    world of a field."""
    scene = load_scene(path, orient=field.straightening)
    if scene.alphas is None:
        raise InputError(f"the pictures of scene {path!r} have no opacity to take as masks")
    masks = scene.alphas
    if scene.weights is not None:  # the object may be wherever pixels do not say that it is not
        masks = np.where(scene.weights > 0.0, masks, 1.0)
    return {"masks": [scene.cut(index, mask) for index, mask in enumerate(masks)], "cameras": scene.cameras}


def require_field_scale(args: argparse.Namespace) -> None:
    """Raises ValueError for --scene-scale where no field takes it."""
    if getattr(args, "scene_scale", 1.0) != 1.0 and not str(args.field).lower().endswith(".npz"):
        raise InputError(f"--scene-scale is for fields (.npz), got {args.field!r}")


def require_deformation(args: argparse.Namespace, what: str) -> None:
    """Raises ValueError where no cage is given for something that needs one; what: how the message calls it."""
    if not is_deformed(args):
        alone = " (or --cage alone, at rest)" if what == "--overlay" else ""
        raise InputError(f"{what} needs a deformation: --cage and --posed{alone}, --edit or --edits")


#: Points of an object that --frame posed looks at, and the share of them that lies out of the cages by chance.
FRAMED_POINTS, MIN_STAYING = 5000, 0.005


def visible_points(field: AnyField, deformation: Deformation | None, frame: str | None) -> np.ndarray:
    """(n, 3) points around what a picture shows, world units: vertices of the cages at rest and posed (frame "posed")
    with what lies in none of them and stays, else the corners of the field's box."""
    # Usually the field at rest, so that pictures before and after an edit, and of all its poses, can be compared.
    if deformation is not None and frame == "posed":
        seen = staying = object_points(field, FRAMED_POINTS)
        for edit in deformation.edits:
            staying = staying[~inside_mesh(staying, edit.cage)]
        few = len(staying) <= MIN_STAYING * len(seen)
        return deformation.vertices if few else np.concatenate([deformation.vertices, staying])
    return shown_corners(field)


def make_deformer(field: AnyField, deformation: Deformation, args: argparse.Namespace) -> Deformer:
    """The Deformer of the deformation options, not posed yet."""
    return Deformer(field, deformation.edits, **shot_of(args).deformer_options(MAX_CELLS))


def set_lattice(args: argparse.Namespace, camera: Camera) -> None:
    """Choose the lattice by the size of a camera's picture, where --resolution is not given."""
    if args.resolution is None:
        args.resolution = picture_cells(camera)


def posed_scene(
    field: AnyField, deformation: Deformation | None, args: argparse.Namespace
) -> tuple[AnyField | Deformer, list[Cage]]:
    """What renders the scene in its last pose, the field itself where nothing moves, and the cages of an overlay."""
    if deformation is None or deformation.is_still:
        cages = [] if deformation is None else deformation.posed
        return field, [cage for cage in cages if cage is not None]
    deformer = make_deformer(field, deformation, args).pose(deformation.posed)
    return deformer, render.drawn_cages(deformer)


def is_transparent(args: argparse.Namespace) -> bool:
    """Whether pictures have opacity instead of a background; refuses both."""
    if args.transparent and args.background not in (None, TRANSPARENT):
        raise InputError("--transparent cannot be combined with --background: give one of them")
    return args.transparent or args.background == TRANSPARENT


def shot_of(args: argparse.Namespace) -> FilmSpec:
    """How the options of a command have pictures made; those that it does not have are the defaults."""
    given = {name: getattr(args, name, None) for name in options_of(FilmSpec)}
    if getattr(args, "transparent", False) and is_transparent(args):
        given["background"] = TRANSPARENT
    return FilmSpec(**{name: value for name, value in given.items() if value is not None})


def require_fillable(args: argparse.Namespace, field: AnyField) -> None:
    """Raises ValueError where --fill has nothing to fill."""
    if not args.fill:
        return
    require_deformation(args, "--fill")
    if args.background is not None or args.transparent:
        raise InputError("--fill continues the field's own background: it cannot be combined with --background")
    render.require_fillable(field, "--fill")


def read_shot(
    args: argparse.Namespace, reader: EditReader | None = None, *, of_voxels: str = ""
) -> tuple[AnyField, Deformation | None, Objects | None]:
    """The field of a command, its deformation, and the scene of several objects that they stand in; None: no such.
    reader: None takes one pose an edit; of_voxels: an option of the command that needs a field of voxels."""
    if args.fill and (args.add or is_stage(args.field)):
        raise InputError("--fill is for one field: leave it out for a scene of several objects")
    reader, stage, deformation, moving = reader or edit_reader(args), None, None, []
    if of_file := is_stage(args.field):
        stage = _read_stage(args)
        field: Any = next(iter(stage.items.values())).field  # a mesh is shown as the stage has it
    else:
        field = read_field(args)
    if of_voxels:
        render.require_voxels(field, of_voxels)
    if stage is None:
        require_fillable(args, field)
        deformation = read_deformation(args, field, reader)
        if not args.add and not getattr(args, "save_stage", None):
            return field, deformation, None
        stage = Stage(device=field.device).add(pathlib.Path(args.field).stem, field, path=args.field)
    for text in args.add or ():
        path, place, edits = parse_add(text)
        name = free_name(pathlib.Path(path).stem, stage.items)
        path = require_file(splat_path(path), "field file")
        scene_object: Any = load_object(path, device=field.device)
        if edits is not None:
            added = edits_of_file(edits, reader, scene_object)
            scene_object = make_deformer(scene_object, added, args).pose(added.posed)
            moving.append((scene_object, added))
        stage.add(name, scene_object, place=place, path=path)
    return field, deformation, Objects(stage, of_file=of_file, moving=moving)


def _read_stage(args: argparse.Namespace) -> Stage:
    """The stage of a stage file; sets `args.straightening`, and `args.up` where --up is not given."""
    if is_deformed(args):
        raise InputError("the objects of a scene file have cages of their own: leave --cage, --edit and --edits out")
    require_field_scale(args)
    stage = Stage.load(args.field, device=chosen_device(args))
    first = next(iter(stage.items.values()))
    args.up = tuple(stage.up) if args.up is None else args.up
    args.straightening = first.field.straightening if first.places.at(0.0) == Place() else None
    return stage
