"""`warpcage select`, `clean`, `mesh` and `bake`: fields into parts, surfaces and other fields."""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
from typing import Any

import numpy as np

from ...cage.pose_file import DEFAULT_RATE, GLTF_ENDINGS
from ...core.checks import float32_spacing
from ...core.files import atomic_path, require_file
from ...core.memory import require_host_memory
from ...core.names import counted
from ...core.reports import say
from ...deform.bake import bake
from ...deform.stage import Stage
from ...edits.maps import carried_points
from ...errors import InputError
from ...field.io import VOLUME_ENDINGS
from ...field.surface import color_vertices
from ...field.texture import simplified, textured
from ...fitting.splats.from_voxels import to_splats
from ...mesh.io import MOTION_ENDINGS, write_shown_mesh
from ...mesh.io.ply import write_ply
from ...render.surface_file import SURFACE_ENDINGS
from ...select.clean import CleanOptions, clean_voxels
from ...select.objects import select_object
from ...select.selection import NodeSelection, painted_voxels, splat_matter, tinted
from ...select.selection_file import SELECTION_ENDINGS
from ...splats.clean import clean_splats
from ...splats.io import is_splat_file, splat_path
from ...splats.io.formats import endings_written
from ...splats.splat_field import AnyField, SplatField
from ...view.camera import Camera, CameraFile
from ...view.motion import frame_times
from ...view.pictures import write_png
from ..films.edits import Deformation
from ..films.render import require_voxels
from ..films.timeline import shown_corners
from . import shared
from .arguments import options
from .cameras import asset_resolver, camera_file, check_saved, chosen_camera, save_cameras, scene_cameras
from .shared import is_deformed, read_deformation


def _checked_fields(args: argparse.Namespace, volumes: tuple[str, ...] = ()) -> tuple[bool, pathlib.Path]:
    """Whether the field that becomes another is of splats, and where that one is written.
    volumes: endings of files of volumes that voxels may be written to."""
    args.field = str(splat_path(args.field))
    require_file(args.field, "field file")
    of_splats = is_splat_file(args.field)
    endings = endings_written() if of_splats else (".npz", *volumes)
    return of_splats, options.check_output(args.output, endings, "field file")


def run_bake(args: argparse.Namespace) -> None:
    if shared.is_stage(args.field):
        return _bake_stage(args)
    of_splats, output = _checked_fields(args, VOLUME_ENDINGS)
    is_volume = output.suffix.lower() in VOLUME_ENDINGS
    if is_volume and args.format is not None:
        raise InputError(f"--format is for .npz: {output.suffix} is a format of its own")
    if of_splats and (args.voxels is not None or args.format is not None):
        raise InputError("--voxels and --format are for fields of voxels: the ending of a splat file says its format")
    if args.frames is not None and (not of_splats or "#" not in output.name):
        raise InputError("--frames writes numbered files of splats: give -o NAME_####.ply, the # for the number")
    if args.overwrite and args.frames is None:
        raise InputError("--overwrite is for numbered files: give --frames, how many; one file is replaced anyway")
    if args.frames == 1:
        raise InputError("--frames 1 would write the pose at rest alone: give 2 or more, or leave it out")
    if args.frames is None and of_splats and "##" in output.name:
        raise InputError("-o with # for a number writes numbered files: give --frames, how many")
    if (args.selection is None and not is_volume and args.frame_file is None) or args.frames is not None:
        shared.require_deformation(args, "bake" if args.frames is None else "--frames")
    elif args.voxels is not None and not is_deformed(args):
        raise InputError("--voxels is for a deformed scene: what is only cut out keeps its voxels")
    field = shared.read_field(args)
    if args.selection is not None:
        field = NodeSelection.load(args.selection, field).cut_out()
    deformation = read_deformation(args, field)
    if deformation.edits:
        deformer = shared.make_deformer(field, deformation, args).pose(deformation.posed)
        if args.frames is not None:
            poses = (deformation.at(place) for place in np.linspace(0.0, deformation.pose_count - 1.0, args.frames))
            written = deformer.save_sequence(args.output, poses, overwrite=args.overwrite)
            print(f"wrote {counted(len(written), 'file')}, {written[0]} to {written[-1]}")
            return
        field = deformer.baked() if of_splats else bake(deformer, resolution=args.voxels)
    _write(field, output, args.format)


def _bake_stage(args: argparse.Namespace) -> None:
    """Merge the objects of a stage file."""
    given = ("frames", "overwrite", "selection", "cage", "edit", "edits", "frame_file")
    if wrong := [name for name in given if getattr(args, name) not in (None, False)]:
        raise InputError(f"--{wrong[0]} does not go with a scene file, whose objects are merged as they are")
    output = options.check_output(args.output, (".npz", *endings_written()), "field file")
    shared.require_field_scale(args)
    stage = Stage.load(args.field, device=shared.chosen_device(args))
    merged, to_voxels = stage.merged(resolution=args.voxels, convert=to_splats), output.suffix.lower() == ".npz"
    if isinstance(merged, SplatField) and to_voxels:
        raise InputError(f"splats are merged as splats: give -o with one of {', '.join(endings_written())}")
    _write(merged if isinstance(merged, SplatField) or to_voxels else to_splats(merged), output, args.format)


def _write(field: AnyField, output: pathlib.Path, format: str | None = None) -> None:
    if isinstance(field, SplatField):
        field.save(output)
        size = counted(field.splat_count, "splat")
    else:
        field.save(output, format=format or "warpcage")
        size = f"{counted(field.voxel_count, 'voxel')} in a grid of {'x'.join(map(str, field.resolution))}"
    print(f"wrote {output}: {size}, {output.stat().st_size / 1e6:.1f} MB")


#: The tint of what went.
GONE_COLOR = (0.95, 0.1, 0.1)


def run_clean(args: argparse.Namespace) -> None:
    of_splats, output = _checked_fields(args)
    preview = None if args.preview is None else options.check_output(args.preview, (".png",), "picture")
    check_saved(args)
    if args.views is None and (args.least_views is not None or args.least_weight is not None):
        raise InputError("--least-views and --least-weight belong to --views, the cameras that must show what is kept")
    if args.largest_scale is not None and not of_splats:
        raise InputError(f"--largest-scale is for files of splats, got {args.field!r}")
    field = shared.read_field(args)
    options_of_view = {"least_views": args.least_views, "least_weight": args.least_weight}
    wanted = CleanOptions(
        args.floaters,
        args.parts,
        None if args.views is None else named_views(args),
        **{name: value for name, value in options_of_view.items() if value is not None},
    )
    camera = None
    if preview is not None or args.save_camera:
        camera = chosen_camera(args, shown_corners(field))
    if isinstance(field, SplatField):
        cleaned = clean_splats(field, wanted, args.largest_scale)
    else:
        cleaned = clean_voxels(field, wanted)
    _write(cleaned.field, output)
    for note in cleaned.notes or ("nothing was removed",):
        print(note)
    if camera is not None:
        if preview is not None:
            of_gone = (
                field.painted(cleaned.gone) if isinstance(field, SplatField) else painted_voxels(field, cleaned.gone)
            )
            write_png(preview, tinted(field.render(camera).rgb, of_gone.render(camera), GONE_COLOR))
            print(f"wrote {preview}")
        save_cameras(args, [camera])


#: Formats that hold colours of vertices.
WITH_COLORS = (*MOTION_ENDINGS, ".ply", ".obj")


def run_mesh(args: argparse.Namespace) -> None:
    import trimesh

    output = options.check_output(args.output, SURFACE_ENDINGS, "mesh file")
    ending = output.suffix.lower()
    moves = ending in MOTION_ENDINGS
    if args.colors and ending not in WITH_COLORS:
        raise InputError(f"--colors: {ending} has no colours, {' '.join(WITH_COLORS)} have")
    if args.texture is not None and (ending not in GLTF_ENDINGS or args.colors):
        raise InputError("--texture is for glTF (.glb, .gltf), and takes the place of --colors")
    if args.frames is not None:
        shared.require_deformation(args, "--frames")
        if not moves or args.frames < 2:
            raise InputError(f"--frames takes 2 or more, and a file that holds motion ({' '.join(MOTION_ENDINGS)})")
    if not moves and len(args.posed or ()) > 1:
        raise InputError(f"{ending} holds one pose: give one --posed, or a file that holds motion")
    field = require_voxels(shared.read_field(args), "mesh")
    reader = shared.edit_reader(args, "smooth" if moves else None, timed=moves and args.frames is None)
    deformation = read_deformation(args, field, reader)
    colored = moves and args.texture is None if args.colors is None else args.colors

    selection = None if args.selection is None else NodeSelection.load(args.selection, field)
    mesh = field.extract_mesh(threshold=args.threshold, components=args.components, selection=selection)
    if args.faces is not None:
        mesh = simplified(mesh, args.faces)
    texture = None
    if args.texture is not None:
        parts = np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals), np.asarray(mesh.faces)
        origin, faces, texture = textured(field, *parts, args.texture)
        mesh = trimesh.Trimesh(mesh.vertices[origin], faces, process=False)
    if colored:
        color_vertices(field, mesh)
    colors = np.asarray(getattr(mesh.visual, "vertex_colors"))[:, :3] if colored else None  # noqa: B009
    frames, rate = _mesh_frames(np.asarray(mesh.vertices), deformation, args)
    if args.as_captured and field.straightening is not None:
        back = np.linalg.inv(field.straightening)
        frames = None if frames is None else frames @ back[:3, :3].T + back[:3, 3]
        mesh.apply_transform(back)
        if texture is not None:
            texture = dataclasses.replace(texture, normals=texture.normals @ back[:3, :3].T)
    if frames is not None and len(frames) == 1:
        mesh.vertices, frames = frames[0], None
    faces = np.asarray(mesh.faces, np.int32)
    if moves:
        shown = {"colors": None if colors is None else colors / 255.0, "frames": frames, "fps": rate}
        write_shown_mesh(output, mesh.vertices, faces, **shown, name=output.stem, texture=texture)
    else:
        with atomic_path(output) as temporary:
            if ending == ".ply" and _is_far(mesh):  # trimesh writes float32
                temporary.write_bytes(write_ply(np.asarray(mesh.vertices), faces, colors, comment=output.stem))
            else:
                mesh.export(temporary, file_type=ending[1:])
    if ending == ".stl" and _is_far(mesh):
        say(
            f"warning: {output}: STL holds float32, which rounds places so far from the origin to "
            f"{float32_spacing(float(np.abs(mesh.bounds).max())):.3g} units: the other formats keep them"
        )
    low, high = mesh.bounds
    print(
        f"wrote {output}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces{', with colours' * colored}"
        f"{'' if texture is None else f', a texture of {args.texture}x{args.texture}'}"
        f"{'' if frames is None else f', {len(frames)} frames at {rate:g} a second'}, from {low.round(3).tolist()} to "
        f"{high.round(3).tolist()}"
    )


#: Bytes of memory for a vertex of a frame: its place, and what is left of it while shapes are found.
FRAME_BYTES = 4 * 24


def _mesh_frames(
    vertices: np.ndarray, deformation: Deformation, args: argparse.Namespace
) -> tuple[np.ndarray | None, float]:
    """Where vertices go in each frame, (n, v, 3), one for a pose, and the rate; None where nothing is deformed."""
    if not deformation.edits:
        return None, DEFAULT_RATE
    film, last = deformation.film, deformation.pose_count - 1.0
    rate = DEFAULT_RATE if film is None or film.fps is None else film.fps
    if film is None:
        poses = [deformation.at(place) for place in np.linspace(0.0 if args.frames else last, last, args.frames or 1)]
    else:
        times = frame_times(film.length, rate, film.loop or "once")
        poses = [deformation.at_time(time) for time in times]
    options = {"coordinates": shared.shot_of(args).coordinates, "device": args.device}
    what = f"{counted(len(poses), 'frame')} of {len(vertices)} vertices need"
    require_host_memory(FRAME_BYTES * len(poses) * len(vertices), what)
    return np.stack([carried_points(vertices, deformation.edits, pose, **options) for pose in poses]), rate


#: A mesh so many times its size from the origin is rounded by float32 to more than 1e-6 of its size.
FAR = 16.0


def _is_far(mesh: Any) -> bool:
    return float(np.abs(mesh.bounds).max()) > FAR * float(np.ptp(mesh.bounds, axis=0).max())


def run_select(args: argparse.Namespace) -> None:
    output = options.check_output(args.output, SELECTION_ENDINGS, "selection file")
    preview = None if args.preview is None else options.check_output(args.preview, (".png",), "picture")
    check_saved(args)
    if not options.given(args, "point", "pixel", "in_box", "sphere", "in_cage", "masks", "depth"):
        raise InputError(
            "select needs a click (--point or --pixel) or a region (--in-box, --sphere, --in-cage, --masks or --depth)"
        )
    if (args.depth is None) != (args.views is None):
        raise InputError("--depth and --views go together: distances from the cameras of views")
    if args.masks is not None and args.depth is not None:
        raise InputError("--masks and --depth cannot be combined: give one of them")
    if args.plane == "none" and (args.plane_at is not None or args.clearance is not None):
        raise InputError("--plane-at and --clearance need a plane: leave out --plane none")
    field = shared.read_field(args)
    corners = shown_corners(field)
    camera = chosen_camera(args, corners) if args.pixel or preview or args.save_camera else None
    chosen = select_object(
        field,
        point=args.point,
        pixel=args.pixel,
        camera=camera if args.pixel else None,
        plane=None if args.plane == "none" else args.plane,
        plane_at=args.plane_at,
        up=args.up,
        clearance=args.clearance,
        parts=args.parts,
        floaters=args.floaters or 0.0,
        **_regions(args, field),
    )
    for note in chosen.notes:
        print(note)
    if preview is not None and camera is not None:
        write_png(preview, chosen.preview(camera))
    chosen.save(output)
    if camera is not None:
        save_cameras(args, [camera])
    low, high = chosen.points.min(axis=0), chosen.points.max(axis=0)
    print(
        f"wrote {output}: {_chosen_size(chosen)}, from {low.round(3).tolist()} to "
        f"{high.round(3).tolist()}{'' if preview is None else f', and {preview}'}"
    )


def _chosen_size(chosen: NodeSelection) -> str:
    """How much is chosen, as text such as "12000 voxels"."""
    of_splats, nodes = splat_matter(chosen), int(np.count_nonzero(chosen.mask))
    if of_splats is None:
        return counted(nodes, "voxel")
    splats = int(np.count_nonzero(of_splats.splats_in(chosen.mask)))
    return f"{counted(nodes, of_splats.node_name)} with {counted(splats, 'splat')}"


def _regions(args: argparse.Namespace, field: AnyField) -> dict:
    """The regions of the arguments, as `select_object` takes them."""
    given: dict = {}
    if args.in_box is not None:
        given["box"] = [args.in_box[:3], args.in_box[3:]]
    if args.sphere is not None:
        given["sphere"] = args.sphere
    if args.in_cage is not None:
        rest = asset_resolver().rest(args.in_cage, args.cage_up, field, object=args.cage_object, part=True)
        given["cage"] = rest.cage
    if args.masks is not None:
        given |= shared.scene_masks(args.masks, field)
    if args.depth is not None:
        given |= {"depth": args.depth, "cameras": named_views(args)}
    return given


def named_views(args: argparse.Namespace) -> list[Camera]:
    """The cameras that --views names."""
    if camera_file(args.views):
        return [key.camera for key in CameraFile.load(args.views)]
    return scene_cameras(args, args.views)
