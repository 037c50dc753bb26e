"""What commands share: fields, cages and views from their arguments."""

from __future__ import annotations

import argparse
import functools
import pathlib
import re
from fractions import Fraction
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ...cage.up_axis import object_points
from ...core.checks import warn_renamed
from ...core.devices import resolve_device
from ...core.files import PathLike, require_file
from ...core.names import TRANSPARENT
from ...core.reports import say
from ...core.spec import options_of
from ...deform.deformer import Deformer
from ...deform.stage import Stage
from ...edits.edits import MAX_CELLS, picture_cells
from ...edits.place import Place
from ...edits.spec import EditSpec
from ...edits.stage_file import free_name, is_stage
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
from ..films.session.session_file import is_session, session_edits
from ..films.timeline import Objects, shown_corners
from ..spec.film import FilmSpec
from ..spec.scene import SceneSpec
from .arguments import options
from .cameras import asset_resolver, named_scene


def edit_reader(
    args: argparse.Namespace, interpolation: str | None = None, *, timed: bool = False, fps: Fraction | None = None
) -> EditReader:
    """What reads the edits of a command."""
    defaults = {name: getattr(args, name, None) for name in ("falloff", "fragments")}
    defaults |= {"up": args.cage_up, "object": args.cage_object}
    return EditReader(asset_resolver(), interpolation, defaults, posed_up(args), timed, fps)


def read_deformation(args: argparse.Namespace, field: AnyField, reader: EditReader | None = None) -> Deformation:
    """The deformation that a command's options name; the field gives the axes of cage files.
    reader: None takes one pose an edit."""
    reader = reader or edit_reader(args)
    ways = options.given(args, "cage", "edit", "edits")
    if len(ways) > 1:
        raise InputError(f"--{ways[0]} and --{ways[1]} do not go together: name each cage of several by --edit")
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
    return reader.edits([parse_edit(text) for text in args.edit or ()], field)


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
_VALUES = {
    name: functools.partial(options_of(EditSpec)[name].values.parse, name=name)
    for name in ("falloff", "fragments", "held")
}

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
    settings: dict[str, Any] = {}
    try:
        while posed and (found := _LAST_OPTION.fullmatch(posed)) and not pathlib.Path(posed).exists():
            posed, flag, name, value = found.groups()
            if name == "crumbs":
                warn_renamed("crumbs=", "fragments=")
                name = "fragments"
            settings[flag or name] = True if flag else _VALUES.get(name, str)(value)
        if posed and (slip := _SLIP.fullmatch(posed)) and not pathlib.Path(posed).exists():
            raise InputError(
                f"{slip[1]!r} is unknown in an edit, which takes keep, remove, falloff=, held=, fragments= and object="
            )
        if not posed and not settings.get("remove"):
            raise InputError(f"there is no posed cage: write {EDIT_SHAPE}")
        return EditSpec(cage, posed or None, **settings)
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
    return bool(options.given(args, "cage", "edit", "edits"))


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
    field = load_field(args.field, scene_scale=args.scene_scale or 1.0, device=chosen_device(args))
    if getattr(args, "up", field) is None:  # a command with a view
        args.up = tuple(field.up)
    args.straightening = field.straightening  # cameras of scenes are moved by it
    return field


def in_world_of_scene(
    args: argparse.Namespace, field: AnyField, named: tuple[pathlib.Path, SceneViews] | None
) -> AnyField:
    """A field out of nerfstudio's frame where that is asked for, or a file beside says so, and pictures agree; what
    is unlike them is reported, where it is no pose. named: folder and views of the scene, in its files' world."""
    source = None if named is None else named[1].to_source
    given = getattr(args, "frame_file", None)
    if given is not None:
        frame = read_frame(given)
        field = _moved(args, field, given, frame, out_of_frame(frame, source))
    if named is None:
        return field
    folder, views = named[0], named[1].moved(field.straightening)
    if (found := mismatch(field, views)) is None:
        return field
    reason = found.text
    beside = {path.resolve(): path for path in (pathlib.Path(args.field).parent / FRAME_FILE, folder / FRAME_FILE)}
    for path in beside.values() if given is None and isinstance(field, SplatField) else ():
        if path.is_file():
            frame = read_frame(path)
            motion = out_of_frame(frame, source)
            if not likeness(field, views.glimpses, motion).is_doubtful:
                return _moved(args, field, path, frame, motion)
            reason += f", nor does {path}"
    if found.may_be_pose and is_deformed(args):
        return field
    say(f"warning: {args.field} and the cameras of {folder} do not belong together: {reason}")
    return field


def _moved(
    args: argparse.Namespace, field: AnyField, path: PathLike, frame: Similarity, motion: Similarity
) -> AnyField:
    """A field taken out of nerfstudio's frame, which is reported; sets `args.is_moved` and `args.frame_motion`."""
    moved = moved_field(field, motion)
    args.is_moved, args.frame_motion = True, motion  # camera paths of nerfstudio go along
    say(
        f"{args.field} is moved out of nerfstudio's coordinates by {path}: {1.0 / frame.scale:.4g} times as "
        "large, turned and moved to where its dataset is"
    )
    return moved


def read_scene(args: argparse.Namespace, background: str | ArrayLike, orient: str | None = None) -> Scene:
    """The scene folder of a command, by its --split, --downscale, --format and --masks. See `load_scene`."""
    spec: dict[str, Any] = {name: getattr(args, name) for name in options_of(SceneSpec)} | {"background": background}
    return load_scene(args.scene, **spec, orient=orient, model=args.model)


def is_field(path: str) -> bool:
    """Whether a file is a field: voxels (.npz) or splats."""
    return path.lower().endswith(".npz") or is_splat_file(path)


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


def require_other_file(output: pathlib.Path, cage: str) -> None:
    """Refuse to write a pose over the cage at rest."""
    if output.exists() and pathlib.Path(cage).exists() and output.samefile(cage):
        raise InputError(
            f"-o {output} is the cage at rest itself, which is needed beside a posed one: name another file"
        )


def require_field_scale(args: argparse.Namespace) -> None:
    """Raises ValueError for --scene-scale where no field takes it."""
    if getattr(args, "scene_scale", None) not in (None, 1.0) and not str(args.field).lower().endswith(".npz"):
        raise InputError(f"--scene-scale is for fields (.npz), got {args.field!r}")


def require_deformation(args: argparse.Namespace, what: str) -> None:
    """Raises ValueError where no cage is given for something that needs one; what: how the message calls it."""
    if not is_deformed(args):
        alone = " (or --cage alone, at rest)" if what == "--overlay" else ""
        raise InputError(f"{what} needs a deformation: --cage and --posed{alone}, --edit or --edits")


#: Points of an object that --frame posed looks at, and the share of them that lies out of the cages by chance.
FRAMED_POINTS, MIN_STAYING = 5000, 0.005


def seen_points(
    args: argparse.Namespace, field: AnyField, deformation: Deformation, objects: Objects | None
) -> np.ndarray:
    """(n, 3) points around what a picture shows, world units: with --frame posed the vertices of the cages, at rest and
    posed, and what lies in none of them and stays; else the corners of the field's box. With those of other objects."""
    # Usually the field at rest, so that pictures before and after an edit, and of all its poses, can be compared.
    points = shown_corners(field)
    if deformation.edits and args.frame == "posed":
        seen = staying = object_points(field, FRAMED_POINTS)
        for edit in deformation.edits:
            staying = staying[~inside_mesh(staying, edit.cage)]
        few = len(staying) <= MIN_STAYING * len(seen)
        points = deformation.vertices if few else np.concatenate([deformation.vertices, staying])
    return points if objects is None else objects.points(points)


def make_deformer(field: AnyField, deformation: Deformation, args: argparse.Namespace) -> Deformer:
    """The Deformer of the deformation options, not posed yet."""
    return Deformer(field, deformation.edits, **shot_of(args).deformer_options(MAX_CELLS))


def set_lattice(args: argparse.Namespace, camera: Camera) -> None:
    """Choose the lattice by the size of a camera's picture, where --resolution is not given."""
    if args.resolution is None:
        args.resolution = picture_cells(camera)


def shot_of(args: argparse.Namespace) -> FilmSpec:
    """How the options of a command have pictures made; those that it does not have are the defaults."""
    given = {name: getattr(args, name) for name in options.given(args, *options_of(FilmSpec))}
    if getattr(args, "transparent", False):
        if args.background not in (None, TRANSPARENT):
            raise InputError("--transparent cannot be combined with --background: give one of them")
        given["background"] = TRANSPARENT
    return FilmSpec(**given)


def read_shot(
    args: argparse.Namespace, reader: EditReader | None = None, *, of_voxels: str = ""
) -> tuple[AnyField, Deformation, Objects | None]:
    """The field of a command, its deformation, and the scene of several objects that they stand in; None: it is alone.
    reader: None takes one pose an edit; of_voxels: an option of the command that needs a field of voxels."""
    shot_of(args).check()
    if args.fill and (args.add or is_stage(args.field)):
        raise InputError("--fill is for one field: leave it out for a scene of several objects")
    for option in ("--overlay" if args.overlay else "", of_voxels, "--fill" if args.fill else ""):
        if option:
            require_deformation(args, option)
    reader, stage, deformation, moving = reader or edit_reader(args), None, Deformation(), []
    if of_file := is_stage(args.field):
        stage = _read_stage(args)
        field: Any = next(iter(stage.items.values())).field  # a mesh is shown as the stage has it
    else:
        field = read_field(args)
    if of_voxels:
        render.require_voxels(field, of_voxels)
    if stage is None:
        if args.fill:
            render.require_fillable(field, "--fill")
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
