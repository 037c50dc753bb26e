"""`warpcage cage`, `check`, `pose`, `edits` and `edit`: make, examine and pose cages, also in the browser."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import json
import os
import pathlib
import sys
import warnings
import webbrowser
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ...cage.axes import axis_of, default_towards, with_up
from ...cage.cage import Cage
from ...cage.generate import checked_count
from ...cage.generate.mirror import mirror_axes
from ...cage.pose_file import PoseFile
from ...cage.presets import is_preset
from ...cage.snap import cut_matter, snap_to_gaps
from ...cage.up_axis import load_standing
from ...core.checks import checked_bounds
from ...core.files import check_parent, require_file, seen_note
from ...core.names import counted
from ...errors import InputError
from ...field.surface import extract_mesh
from ...mesh.io import ALL_OBJECTS, MOTION_ENDINGS, read_object
from ...mesh.io.formats import mesh_endings, mesh_format
from ...render.surface_file import SURFACE_ENDINGS, load_trimesh
from ...select.objects import is_splats, matter_around
from ...select.selection import NodeSelection, select_nodes
from ...splats.io import splat_path
from ...splats.splat_field import load_field
from ...view.camera import CameraKey
from ..films.edits import Deformation, read_edits_file, write_edits_file
from ..films.render import require_voxels
from ..films.resolve import AssetResolver, RestCage, ending
from ..films.session.session_file import free_session_path, is_session, session_edits, session_path
from . import shared
from .arguments import options
from .cameras import asset_resolver, named_camera
from .shared import parse_edit, posed_up

if TYPE_CHECKING:
    import trimesh

#: Distance of a box or a cylinder from the object by default, as a share of the object's size.
MARGIN = 0.03

#: Options of `warpcage cage` that select a part of a field.
PARTS = ("selection", "in_box", "masks", "seed", "parts", "floaters")

#: Where sessions of the demo are kept, in the current folder.
DEMO_FOLDER = pathlib.Path("warpcage-demo")


def run_cage(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, tuple(mesh_endings("write")), "cage file")
    _check_combination(args)
    shared.require_field_scale(args)
    is_field = shared.is_field(args.field)
    if is_field and args.object is not None:
        raise InputError(f"--object names an object of a mesh file, {args.field!r} is a field")
    scene_object: Any = shared.read_field(args) if is_field else read_mesh(args.field, args.object)
    if args.snap is not None:
        if not is_field:
            raise InputError(f"--snap needs a field (.npz), got {args.field!r}")
        _snap(require_voxels(scene_object, "--snap"), args, output)
        return
    if options.given(args, *PARTS):
        scene_object = _selected(scene_object, is_field, args)
    if args.box or args.cylinder:
        cage = _shape_around(extract_mesh(scene_object, components="all") if is_field else scene_object, args)
    else:
        make = Cage.from_field if is_field else Cage.from_mesh
        cage = make(
            scene_object,
            vertex_count=args.vertices or 100,
            margin=args.margin,
            method=args.method or "auto",
            symmetry=args.symmetry,
            detail=args.detail or "even",
            focus=_focus(args, scene_object if is_field else None),
            finer=2.0 if args.finer is None else args.finer,
            faces=args.faces or "triangles",
        )
    cage.require_usable("the cage")
    cage.save(output, up=args.cage_up)
    if not mesh_format(output, "write").polygons:  # the file has the triangles
        cage = Cage(cage.vertices, cage.faces)
    print(f"wrote {output}: {len(cage.vertices)} vertices, {cage.face_count} faces{_made_of(cage, args)}")


def _focus(args: argparse.Namespace, field: Any) -> NodeSelection | PoseFile | None:
    """Where edges are shorter: a selection of the field, or poses."""
    if args.focus is None:
        return None
    if pathlib.Path(args.focus).suffix.lower() != ".npz":
        return PoseFile.load(args.focus)
    if field is None:
        raise InputError(f"--focus {args.focus!r} is a selection, which is of a field: a mesh takes poses")
    return NodeSelection.load(args.focus, getattr(field, "field", field))


def _made_of(cage: Cage, args: argparse.Namespace) -> str:
    """Which share of the faces are quads, and the plane of symmetry, where these were asked for."""
    quads = sum(len(face) == 4 for face in cage.polygons)
    said = f", {100 * quads / cage.face_count:.0f} % of them quads" if args.faces == "quads" else ""
    if args.symmetry == "auto":
        axes = mirror_axes(cage.vertices)
        said += f", symmetric across {', '.join(axes)}" if axes else ", symmetric across no axis: the object is not"
    return said


def _snap(field: Any, args: argparse.Namespace, output: pathlib.Path) -> None:
    """Move the sides of a cage to gaps, and say how much less they cut."""
    cage = Cage.load(args.snap, up=args.cage_up, object=args.cage_object)
    snapped = snap_to_gaps(cage, field, args.reach)
    snapped.save(output, up=args.cage_up)
    before, after = cut_matter(cage, field), cut_matter(snapped, field)
    less = "which cuts through nothing" if not before else f"which cuts through {100 * (1 - after / before):.0f} % less"
    print(f"wrote {output}: {len(snapped.vertices)} vertices, {snapped.face_count} faces, {less}")


def _check_combination(args: argparse.Namespace) -> None:
    if (args.snap is None) != (args.reach is None):
        raise InputError("--snap needs --reach, how far its sides may move, and --reach belongs to --snap")
    if args.snap is not None and options.given(args, *PARTS):
        raise InputError("--snap looks at all of the field: leave the options out that select a part of it")
    for name, shape in {"segments": "box", **dict.fromkeys(("axis", "sides", "rings"), "cylinder")}.items():
        if getattr(args, name) is not None and not getattr(args, shape):
            raise InputError(f"--{name} belongs to --{shape}")
    if args.vertices is not None and (args.box or args.cylinder):
        raise InputError(
            "--vertices is for a cage wrapped around the object: a box takes --segments, a cylinder --sides and --rings"
        )
    if args.vertices is not None:
        checked_count(args.vertices, "--vertices")
    names = options.given(args, "method", "symmetry", "detail", "focus", "finer", "faces")
    if names and (args.box or args.cylinder):
        raise InputError(f"--{names[0]} is for a cage wrapped around the object")
    if args.finer is not None and args.focus is None:
        raise InputError("--finer says how much finer a cage is in its --focus: give one")
    if args.segments is not None and len(args.segments) not in (1, 3):
        raise InputError(f"--segments takes one number or three, got {len(args.segments)}")


def _selected(field: Any, is_field: bool, args: argparse.Namespace) -> NodeSelection:
    """The chosen nodes of a field. What was left out is printed."""
    chosen = {name: getattr(args, name) for name in options.given(args, *PARTS)}
    if not is_field:
        raise InputError(f"--{'in-box' if 'in_box' in chosen else next(iter(chosen))} is for fields, not for meshes")
    selected = NodeSelection.load(chosen.pop("selection"), field) if "selection" in chosen else field
    if not chosen:
        return selected
    if (box := chosen.pop("in_box", None)) is not None:
        chosen["box"] = [box[:3], box[3:]]
        # a part of a place is looked at as closely as the whole of an object
        if selected is field and is_splats(field):
            selected = matter_around(field, checked_bounds(chosen["box"], "box"))
    if "masks" in chosen:
        chosen |= shared.scene_masks(args.masks, field)
    selection = select_nodes(selected, **chosen)
    for note in selection.notes:
        print(note)
    return selection


def read_mesh(name: str, object: str | None = None) -> trimesh.Trimesh:
    """Read a mesh file: vertices in the order of the file, z up (glTF, which has y up, is turned).
    object: the name of one object of it; None takes all."""
    import trimesh

    path = require_file(name, "mesh file")
    if path.suffix.lower() not in SURFACE_ENDINGS:
        raise InputError(
            f"mesh file {str(path)!r} must end in {' or '.join(SURFACE_ENDINGS)}, or in .npz for a field"
            f"{seen_note(path)}"
        )
    if object is not None or path.suffix.lower() in MOTION_ENDINGS:  # strips and fans too, split vertices joined
        found = read_object(path, object=object or ALL_OBJECTS)
        return trimesh.Trimesh(found.vertices, found.faces, process=False)
    return load_trimesh(path)


def _shape_around(mesh: trimesh.Trimesh, args: argparse.Namespace) -> Cage:
    """A box around a mesh; or a cylinder around the middle of its bounding box, wide enough for the flat sides to clear
    every vertex."""
    margin = MARGIN * float(mesh.extents.max()) if args.margin is None else args.margin
    if args.box:
        segments = args.segments or [1]
        low, high = mesh.bounds
        return Cage.box(low - margin, high + margin, segments=segments[0] if len(segments) == 1 else tuple(segments))
    axis, sides = args.axis or "z", args.sides or 12
    if sides < 3:
        raise InputError(f"a cylinder needs at least 3 sides, got {sides}")
    center = mesh.bounds.mean(axis=0)
    along = "xyz".index(axis)
    reach = np.linalg.norm(np.delete(mesh.vertices - center, along, axis=1), axis=1).max() + margin
    height = mesh.extents[along] + 2 * margin
    return Cage.cylinder(center, reach / np.cos(np.pi / sides), height, axis=axis, sides=sides, rings=args.rings or 4)


def run_check(args: argparse.Namespace) -> int:
    shared.require_field_scale(args)
    endings = tuple(mesh_endings("write"))
    output = None if args.repair is None else options.check_output(args.repair, endings, "cage file")
    scene_object = _enclosed(args)
    reference = next(iter(scene_object.values()), None)
    cage, standing = load_standing(
        Cage, args.cage, up=args.cage_up, reference=reference, anywhere=True, object=args.cage_object
    )
    if standing.turned:  # the table says what else there is
        asset_resolver().report_standing(args.cage, standing, "--cage-up")
    pose = None if args.posed is None else _pose(args, cage, standing.up)
    notes = ()
    if output is not None:
        cage, notes = cage.repair()
        cage.save(output)
    report = cage.check(**scene_object, pose=pose)
    if args.json:
        print(json.dumps(report.as_dict() | {"file": args.cage, "repaired": list(notes)}, indent=1))
    else:
        for note in notes or (() if output is None else ("nothing to repair",)):
            print(f"repair: {note}")
        print(report)
    return 0 if report.usable and not report.standing else 1


def _pose(args: argparse.Namespace, cage: Cage, expected: str) -> Cage:
    """The pose of --posed; expected: the axis that points up in the cage's file."""
    resolver, rest = asset_resolver(), RestCage(cage)
    if is_preset(args.posed) or ending(resolver.split(args.posed)[0]) == ".json":
        return resolver.pose(rest, args.posed)
    if resolver.keyframes(rest, args.posed, posed_up(args))[0] is not None:  # a file that moves
        return resolver.pose(rest, args.posed, posed_up(args))
    likely = expected if ending(args.posed) == ending(args.cage) else None
    pose, standing = load_standing(Cage, args.posed, up=posed_up(args), reference=cage, expected=likely)
    resolver.report_standing(args.posed, standing, "--posed-up")
    return pose


def _enclosed(args: argparse.Namespace) -> dict:
    """The object of --object, as Cage.check takes it."""
    if args.field is None:
        return {}
    if shared.is_field(args.field):
        return {"field": shared.read_field(args)}
    return {"mesh": read_mesh(args.field)}


def run_edits(args: argparse.Namespace) -> None:
    if args.file is None and not args.edit:
        raise InputError("give an edits file to read, or --edit for each edit to write")
    if args.edit and args.output is None:
        raise InputError("--edit needs -o, the edits file to write")
    output = None if args.output is None else options.check_output(args.output, (".json",), "edits file")
    if args.file is not None and is_session(args.file):
        if output is not None:
            raise InputError(f"{args.file} is a session of the editor, which --edits takes as it is: it needs no -o")
        deformation, names = session_edits(args.file)
        _list(args.file, deformation, names)
        return
    specs = [] if args.file is None else read_edits_file(args.file)
    specs += [parse_edit(text) for text in args.edit or ()]
    reader = shared.edit_reader(args, "smooth")
    deformation = reader.edits(specs)
    if output is not None:
        write_edits_file(output, [reader.completed(edit) for edit in specs])
    _list(f"wrote {output}" if output is not None else str(args.file), deformation, [str(edit) for edit in specs])


def _list(what: str, deformation: Deformation, names: list[str]) -> None:
    """Print a line for each edit."""
    count = len(names)
    print(f"{what}: {count} edit{'s'[: count > 1]}{', in this order' if count > 1 else ''}")
    for number, (name, part) in enumerate(zip(names, deformation.parts, strict=True), 1):
        poses = f", {len(part.poses)} poses" if len(part.poses) > 1 else ""
        print(f"  {number}. {name} ({len(part.edit.cage.vertices)} vertices{poses})")


#: Options for pose files alone.
OPTIONS = ("key", "at", "easing", "posed", "camera", "remove", "fps", "loop")

#: Those of them that a cage that moves takes too.
MOTION_OPTIONS = {"posed", "fps", "loop"}


def run_pose_keys(args: argparse.Namespace, output: pathlib.Path) -> None:
    """Add a key to a pose file, or all keys of a file that moves, and say what the film is then."""
    resolver = asset_resolver()
    rest = read_cage(args, resolver)
    file = PoseFile.load(output, rest.cage) if output.exists() else PoseFile(rest.cage)
    if args.key is None:
        _add_all(file, args, rest, resolver)
    elif args.remove:
        _remove(file, args, output)
    else:
        _add_key(file, args, rest, resolver)
    if not len(file) and not file.cameras:
        raise InputError(f"{str(output)!r} would hold no key: remove the file instead")
    _save(file, args, output)


def _save(file: PoseFile, args: argparse.Namespace, output: pathlib.Path) -> None:
    """Write poses with the rate and the end of the film that options give, and print what they are."""
    file.fps = file.fps if args.fps is None else float(args.fps)
    file.loop = args.loop or file.loop
    file.save(output)
    print(f"wrote {output}: {_described(file)}")


def _write_motion(args: argparse.Namespace, output: pathlib.Path) -> None:
    """Write the frames of a pose file, or of another file that moves, as a cage that moves."""
    rest = read_cage(args, asset_resolver()).cage
    if not args.posed or is_preset(args.posed):
        raise InputError("a cage that moves needs --posed, a pose file (.json) or another file of poses")
    rate = None if args.fps is None else float(args.fps)
    _save(PoseFile.load(args.posed, rest, up=args.cage_up, fps=rate), args, output)


def _add_key(file: PoseFile, args: argparse.Namespace, rest: RestCage, resolver: AssetResolver) -> None:
    name = args.key
    if not name.strip():
        raise InputError("--key needs a name")
    timed = [other for other in file.times if other != name]
    if args.at is None and timed and name not in file.times:
        raise InputError(f"--key {name!r} needs --at SECONDS: the other keys of the file have times")
    untimed = [other for other in file.names if other != name and other not in file.times]
    if args.at is not None and untimed:
        raise InputError(f"--at: key {untimed[0]!r} of the file has no time; give all keys times, or none")
    alone = args.posed is None and not args.steps
    if args.camera is not None:
        _add_camera(file, args)
        if alone:
            return  # a camera and no pose
    if name not in file or not alone:  # otherwise another time or easing of the pose that is there
        posed = rest.cage if args.posed is None else resolver.pose(rest, args.posed, posed_up(args))
        file[name] = stepped(posed, args)
    if args.at is not None:
        same = [other for other in timed if file.times[other] == args.at]
        if same:
            raise InputError(
                f"key {same[0]!r} of the file is at {args.at:g} s too: give another time (for a jump give the key "
                "before it --easing hold)"
            )
        file.times[name] = args.at
    if args.easing is not None:
        file.easings[name] = args.easing


def _add_camera(file: PoseFile, args: argparse.Namespace) -> None:
    held = [key for key in file.cameras if key.name == args.key]
    time = args.at if args.at is not None or not held else held[0].time
    if time is None:
        raise InputError(f"--key {args.key!r} needs --at SECONDS: a camera is reached at a time")
    easing = args.easing or (held[0].easing if held else "smooth")
    key = CameraKey(named_camera(args, args.camera), time, args.key, easing)
    same = [other for other in file.cameras if other.name != args.key and other.time == time]
    if same:
        raise InputError(f"camera {same[0].name!r} of the file is at {time:g} s too: give another time")
    file.cameras = [other for other in file.cameras if other.name != args.key] + [key]


def _add_all(file: PoseFile, args: argparse.Namespace, rest: RestCage, resolver: AssetResolver) -> None:
    """All keys of --posed, in the place of those of their names."""
    if args.posed is None:
        if args.at is None and args.easing is None and not args.steps and not args.remove and (args.fps or args.loop):
            return  # rate and loop alone
        raise InputError("a pose file needs --key NAME, or --posed with a file that moves")
    for name in ("at", "easing", "camera", "steps", "remove"):
        if getattr(args, name):
            raise InputError(f"{'steps of the pose go' if name == 'steps' else f'--{name} goes'} with --key")
    up = posed_up(args)
    film = resolver.film(rest, [args.posed], up, args.fps)
    if film is None:
        poses = resolver.poses(rest, args.posed, up)
        film, key = resolver.keyframes(rest, args.posed, up)
        if film is None or key or (len(poses) < 2 and ending(args.posed) != ".json"):
            raise InputError(f"{args.posed!r} holds one pose: give it a name, --key NAME")
    if bool(film.times) != bool(file.times) and len(file):
        raise InputError("keys with times and keys without do not go into one pose file: write another one")
    for name in film.names:
        film[name].require_usable(f"keyframe {name!r} of {args.posed!r}")
        file[name] = film[name]
        if name in film.times:
            file.times[name] = film.times[name]
        if name in film.easings:
            file.easings[name] = film.easings[name]
    file.fps, file.loop = film.fps or file.fps, film.loop or file.loop
    resolver.report_jumps(file, args.posed)


def _remove(file: PoseFile, args: argparse.Namespace, output: pathlib.Path) -> None:
    for name in ("at", "easing", "posed", "camera", "steps"):
        if getattr(args, name):
            raise InputError(f"--remove takes a key out: leave {'the steps' if name == 'steps' else f'--{name}'} out")
    cameras = [key for key in file.cameras if key.name != args.key]
    if args.key not in file and len(cameras) == len(file.cameras):
        raise InputError(f"{output}: there is no key {args.key!r} to remove")
    file.cameras = cameras
    if args.key in file:
        del file[args.key]


def _described(file: PoseFile) -> str:
    """The keys and the film in a line."""
    if not file.times and not file.cameras:
        return f"{counted(len(file), 'key')} without times: {', '.join(file.names)}"
    names = [f"{name} at {file.times[name]:g} s" for name in file.timed]
    shown = names if len(names) <= 8 else [*names[:3], "...", names[-1]]
    end = f", {file.loop}" if file.loop else ""
    rate = f", {file.fps:g} frames a second" if file.fps else ""
    cameras = [f"{key.name or 'camera'} at {key.time:g} s" for key in file.cameras]
    shown += [f"cameras {', '.join(cameras[:8])}"] if cameras else []
    return f"{counted(len(file) + len(cameras), 'key')} over {file.length:g} s{rate}{end}: {', '.join(shown)}"


def run_pose(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, (*mesh_endings("write"), ".json"), "cage file")
    if output.suffix.lower() == ".json":
        run_pose_keys(args, output)
        return
    given = [name for name in OPTIONS if getattr(args, name)]
    if output.suffix.lower() in MOTION_ENDINGS and given and not args.steps and set(given) <= MOTION_OPTIONS:
        _write_motion(args, output)
        return
    if given:
        raise InputError(f"--{given[0]} is for keys of a pose file: give one with -o (.json)")
    if not args.steps:
        raise InputError("no step given: --bend, --twist, --taper, --stretch, --scale, --rotate or --translate")
    shared.require_other_file(output, args.cage)
    rest = read_cage(args, asset_resolver())
    stepped(rest.cage, args).save(output, up=args.cage_up or rest.ups.get(ending(str(output))))
    steps = (f"{name} {value if isinstance(value, float) else tuple(value)}" for name, value in args.steps)
    print(f"wrote {output}: {', '.join(steps)}")


def read_cage(args: argparse.Namespace, resolver: AssetResolver) -> RestCage:
    """The cage of the command. With --object the axis is found by that field, and `args.up` becomes the field's unless
    --up is given too."""
    field = None if args.object is None else load_field(require_file(splat_path(args.object), "field file"))
    if field is not None and args.up is None:
        args.up = tuple(field.up)
    args.straightening = None if field is None else field.straightening  # for cameras of its scene
    rest = resolver.rest(args.cage, args.cage_up, field, object=args.cage_object, part=True)
    return dataclasses.replace(rest, field_up=args.up)


def stepped(cage: Cage, args: argparse.Namespace) -> Cage:
    """A cage after the steps of the command, usable."""
    for name, value in args.steps or ():
        if name == "scale":
            if len(value) not in (1, 3):
                raise InputError(f"--scale takes one factor or three, got {len(value)}")
            value = value[0] if len(value) == 1 else tuple(value)
        cage = getattr(cage, name)(value, **_options(name, cage, args))
    cage.require_usable("the posed cage")
    return cage


def _options(name: str, cage: Cage, args: argparse.Namespace) -> dict:
    """Keyword arguments of the step's method of Cage."""
    if name == "translate":
        return {}
    chosen = {"center": args.center}
    if name != "scale":
        chosen["axis"] = axis_of(with_up(args.axis, args.up))
    if name == "bend":
        chosen["towards"] = default_towards(cage, chosen["axis"])
        if args.towards is not None:
            chosen["towards"] = axis_of(with_up(args.towards, args.up))
    if name in ("bend", "twist", "taper", "stretch"):
        chosen["limits"] = tuple(args.limits)
    return chosen


def run_edit(args: argparse.Namespace) -> None:
    from ..editor.demo import demo_files  # here, as cages are posed without what fits and serves
    from ..editor.edit import edit, require_libraries
    from ..editor.objects import stage_field

    # each pose would say so anew, with other numbers; the page shows what the cage does
    warnings.filterwarnings("ignore", message="a cage has gaps narrower")
    if (args.field is None) == (not args.demo):
        raise InputError("edit needs a field file, or --demo")
    try:
        require_libraries()
    except ImportError as error:  # not for want of warpcage's own
        raise InputError(str(error)) from None
    device = shared.chosen_device(args)
    if args.demo:
        if args.cage or args.selection:
            raise InputError("--demo brings its own cage: leave --cage and --selection out")
        if not args.session:
            check_parent(DEMO_FOLDER / "session")
        args.field, demo_cage = map(str, demo_files(device))
    args.field = str(splat_path(args.field))
    require_file(args.field, "field file")
    kept = pathlib.Path(args.session) if args.session else session_path(args.field)
    if args.demo and not args.session:  # what is made with it belongs to the user: caches are emptied
        if kept.exists() and not args.new:
            print(f"an earlier session of the demo exists: continue it with --session {kept}", file=sys.stderr)
        kept = DEMO_FOLDER / kept.name
        kept.parent.mkdir(exist_ok=True)
    if kept.exists() and (args.cage or args.selection) and not args.new:
        option = "--cage" if args.cage else "--selection"
        raise InputError(
            f"{str(kept)!r} holds a session of this field: leave {option} out to go on with it, or give --new"
        )
    own = stage_field(pathlib.Path(args.field)) if shared.is_stage(args.field) else args.field
    scale = args.scene_scale or 1.0
    field = load_field(own, scene_scale=scale, device=device)
    rest = functools.partial(asset_resolver().rest, object=args.cage_object, part=True)
    cages = [rest(path, args.cage_up, field).cage for path in args.cage or ()]
    if args.selection:
        cages.append(Cage.from_field(NodeSelection.load(args.selection, field)))
    if args.demo and (args.new or not kept.exists()):
        cages = [Cage.load(demo_cage)]
    options = {
        "field_path": args.field,
        "scene_scale": scale,
        "host": args.host,
        "port": args.port,
        "allowed_hosts": args.allow_host,
    }
    with set_aside(kept) if args.new and kept.exists() else contextlib.nullcontext():
        try:
            editor = edit(field, cages or None, session=kept, **options)
        except InputError as error:
            if not str(error).startswith(f"{kept}: "):
                raise
            raise InputError(f"{error} (--new sets that file aside and begins anew)") from None
    with editor:
        print(f"edit {args.field} at {editor.url}\n(Ctrl+C ends; the session is kept in {kept})", flush=True)
        if not args.no_browser and not _opened(editor.url):
            print("no browser could be opened here: open the address above", file=sys.stderr)
        try:
            editor.wait()
        except KeyboardInterrupt as interrupt:  # the way to end it: all is kept
            if type(interrupt) is not KeyboardInterrupt:  # a signal that asks any program to end
                raise
            print()


@contextlib.contextmanager
def set_aside(path: pathlib.Path) -> Iterator[None]:
    """Give a session's file the first free name of NAME.1.session.json, NAME.2.session.json, ...
    Where the block ends with an error, it gets its own name back."""
    other = free_session_path(path)
    os.rename(path, other)
    try:
        yield
    except BaseException:
        if not os.path.lexists(path):
            os.rename(other, path)
        raise
    print(f"the earlier session is now {other}")


def _opened(url: str) -> bool:
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False
