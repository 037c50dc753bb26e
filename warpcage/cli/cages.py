"""`warpcage cage` and `check`: cages made around an object, and examined."""

from __future__ import annotations

import argparse
import json
import pathlib
from typing import TYPE_CHECKING, Any

import numpy as np

from ..cage.cage import Cage
from ..cage.generate import checked_count
from ..cage.pose_file import is_preset
from ..cage.snap import cut_matter, snap_to_gaps
from ..cage.up_axis import load_standing
from ..core.checks import checked_bounds
from ..core.files import require_file
from ..errors import InputError
from ..field.closer import is_splats, matter_around
from ..field.selection import NodeSelection, select_nodes
from ..field.surface import extract_mesh
from ..mesh.io import ALL_OBJECTS, read_object
from ..mesh.io.formats import mesh_endings
from . import shared
from .arguments import options
from .pose_words import ending, pose_file, posed_up, read_pose, say_standing

if TYPE_CHECKING:
    import trimesh

#: Distance of a box or a cylinder from the object by default, as a share of the object's size.
MARGIN = 0.03


def run_cage(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, tuple(mesh_endings("write")), "cage file")
    _check_combination(args)
    shared.require_field_scale(args)
    is_field = shared.is_field(args.field)
    if is_field and args.object is not None:
        raise InputError(f"--object names an object of a mesh file, {args.field!r} is a field")
    thing: Any = shared.read_field(args) if is_field else read_mesh(args.field, args.object)
    if args.snap is not None:
        if not is_field:
            raise InputError(f"--snap needs a field (.npz), got {args.field!r}")
        _snap(shared.require_voxels(thing, "--snap"), args, output)
        return
    if any(value is not None for value in _selection(args).values()):
        thing = _selected(thing, is_field, args)
    if args.box or args.cylinder:
        mesh = extract_mesh(thing, components="all") if is_field else thing
        cage = _box_around(mesh, args) if args.box else _cylinder_around(mesh, args)
    else:
        make = Cage.from_field if is_field else Cage.from_mesh
        cage = make(
            thing,
            vertex_count=args.vertices or 100,
            margin=args.margin,
            method=args.method or "auto",
            symmetry=args.symmetry,
        )
    cage.require_usable("the cage")
    cage.save(output, up=args.cage_up)
    print(f"wrote {output}: {len(cage.vertices)} vertices, {len(cage.faces)} faces")


def _snap(field: Any, args: argparse.Namespace, output: pathlib.Path) -> None:
    """Move the walls of a cage to gaps, and say how much less they cut."""
    cage = Cage.load(args.snap, up=args.cage_up, object=args.cage_object)
    snapped = snap_to_gaps(cage, field, args.reach)
    snapped.save(output, up=args.cage_up)
    before, after = cut_matter(cage, field), cut_matter(snapped, field)
    less = "which cut no matter" if not before else f"which cut {100 * (1 - after / before):.0f} % less matter"
    print(f"wrote {output}: {len(snapped.vertices)} vertices, {len(snapped.faces)} faces, {less}")


def _check_combination(args: argparse.Namespace) -> None:
    if (args.snap is None) != (args.reach is None):
        raise InputError("--snap needs --reach, how far its walls may move, and --reach belongs to --snap")
    if args.snap is not None and any(value is not None for value in _selection(args).values()):
        raise InputError("--snap looks at all of the field: leave the options out that select a part of it")
    needs = {
        "segments": ("box", args.box),
        "axis": ("cylinder", args.cylinder),
        "sides": ("cylinder", args.cylinder),
        "rings": ("cylinder", args.cylinder),
    }
    for name, (shape, chosen) in needs.items():
        if getattr(args, name) is not None and not chosen:
            raise InputError(f"--{name} belongs to --{shape}")
    if args.vertices is not None and (args.box or args.cylinder):
        raise InputError(
            "--vertices is for a cage wrapped around the object: a box takes --segments, a cylinder --sides and --rings"
        )
    if args.vertices is not None:
        checked_count(args.vertices, "--vertices")
    for name in ("method", "symmetry"):
        if getattr(args, name) is not None and (args.box or args.cylinder):
            raise InputError(f"--{name} is for a cage wrapped around the object")
    if args.segments is not None and len(args.segments) not in (1, 3):
        raise InputError(f"--segments takes one number or three, got {len(args.segments)}")


def _selection(args: argparse.Namespace) -> dict:
    """What select_nodes takes, and a selection file; None where an option is not given."""
    return {
        "selection": args.selection,
        "box": args.in_box,
        "masks": args.masks,
        "seed": args.seed,
        "parts": args.parts,
        "floaters": args.floaters,
    }


def _selected(field: Any, is_field: bool, args: argparse.Namespace) -> NodeSelection:
    """The chosen nodes of a field. What was left out is printed."""
    chosen = {name: value for name, value in _selection(args).items() if value is not None}
    if not is_field:
        raise InputError(f"--{'in-box' if 'box' in chosen else next(iter(chosen))} is for fields, not for meshes")
    selected = field
    if "selection" in chosen:
        selected = NodeSelection.load(chosen.pop("selection"), field)
        if not chosen:
            return selected
    if "box" in chosen:
        chosen["box"] = [args.in_box[:3], args.in_box[3:]]
        if selected is field and is_splats(
            field
        ):  # a part of a place is looked at as closely as the whole of an object
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
    if path.suffix.lower() not in options.MESH_ENDINGS:
        raise InputError(
            f"mesh file {str(path)!r} must end in {' or '.join(options.MESH_ENDINGS)}, or in .npz for a field"
        )
    if object is not None or path.suffix.lower() == ".glb":  # strips and fans too, split vertices joined
        found = read_object(path, object=object or ALL_OBJECTS)
        return trimesh.Trimesh(found.vertices, found.faces, process=False)
    try:
        mesh = trimesh.load(path, force="mesh", process=False, maintain_order=True)
    except Exception as error:
        raise InputError(f"{path} cannot be read as a mesh, it is cut off or damaged: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        if path.suffix.lower() == ".ply":
            read_object(path)  # which tells of points without faces
        raise InputError(f"{path} holds no triangles")
    return mesh


def _margin(mesh: trimesh.Trimesh, args: argparse.Namespace) -> float:
    return MARGIN * float(mesh.extents.max()) if args.margin is None else args.margin


def _box_around(mesh: trimesh.Trimesh, args: argparse.Namespace) -> Cage:
    margin = _margin(mesh, args)
    segments = args.segments or [1]
    low, high = mesh.bounds
    return Cage.box(low - margin, high + margin, segments=segments[0] if len(segments) == 1 else tuple(segments))


def _cylinder_around(mesh: trimesh.Trimesh, args: argparse.Namespace) -> Cage:
    """Around the middle of the bounding box, wide enough for the flat sides to clear every vertex."""
    margin, axis, sides = _margin(mesh, args), args.axis or "z", args.sides or 12
    if sides < 3:
        raise InputError(f"a cylinder needs at least 3 sides, got {sides}")
    center = mesh.bounds.mean(axis=0)
    along = "xyz".index(axis)
    reach = np.linalg.norm(np.delete(mesh.vertices - center, along, axis=1), axis=1).max() + margin
    height = mesh.extents[along] + 2 * margin
    return Cage.cylinder(center, reach / np.cos(np.pi / sides), height, axis=axis, sides=sides, rings=args.rings or 4)


def run_check(args: argparse.Namespace) -> int:
    shared.require_field_scale(args)
    output = (
        None if args.repair is None else options.check_output(args.repair, tuple(mesh_endings("write")), "cage file")
    )

    thing = _enclosed(args)
    reference = next(iter(thing.values()), None)
    cage, standing = load_standing(
        Cage, args.cage, up=args.cage_up, reference=reference, anywhere=True, object=args.cage_object
    )
    if standing.turned:  # the table says what else there is
        say_standing(args.cage, standing, "--cage-up")
    pose = None if args.posed is None else _pose(args, cage, standing.up)
    notes = ()
    if output is not None:
        cage, notes = cage.repair()
        cage.save(output)
    report = cage.check(**thing, pose=pose)
    if args.json:
        print(json.dumps(report.as_dict() | {"file": args.cage, "repaired": list(notes)}, indent=1))
    else:
        for note in notes or (() if output is None else ("nothing to repair",)):
            print(f"repair: {note}")
        print(report)
    return 0 if report.usable and not report.standing else 1


def _pose(args: argparse.Namespace, cage: Cage, expected: str) -> Cage:
    """The pose of --posed; expected: the axis that points up in the cage's file."""
    if is_preset(args.posed) or pose_file(args.posed):
        return read_pose(cage, args.posed, usable=False)
    likely = expected if ending(args.posed) == ending(args.cage) else None
    pose, standing = load_standing(Cage, args.posed, up=posed_up(args), reference=cage, expected=likely)
    say_standing(args.posed, standing, "--posed-up")
    return pose


def _enclosed(args: argparse.Namespace) -> dict:
    """The object of --object, as Cage.check takes it."""
    if args.field is None:
        return {}
    if shared.is_field(args.field):
        return {"field": shared.read_field(args)}
    return {"mesh": read_mesh(args.field)}
