"""`warpcage info` and `kernels`: what files are, and kernels to take home."""

from __future__ import annotations

import argparse
import pathlib
import platform
from collections.abc import Sequence

import numpy as np
import warp as wp

from ...cage.cage import Cage
from ...cage.pose_file import GLTF_ENDINGS, PoseFile
from ...core.checks import format_lines, listed
from ...core.files import check_parent, read_json, seen_note
from ...core.kernel_files import copy_kernel, find_kernel, kernel_groups, kernel_names, kernel_summary
from ...core.modules import start_warp
from ...core.names import counted
from ...core.threads import cpu_threads
from ...edits.place import PLACE_KEYS, PlaceFile
from ...edits.stage_file import read_deformation, read_stage_file
from ...errors import InputError, MissingFileError
from ...field.surroundings import LayeredBackground, OuterField
from ...fitting.silhouettes import Silhouettes
from ...mesh.io import object_names
from ...mesh.io.formats import mesh_endings, mesh_formats
from ...mesh.io.gltf_animation import gltf_animation_names, read_gltf_motion
from ...mesh.io.usd import read_usd_motion
from ...scene.box import scene_box
from ...scene.box_picture import box_text, draw_box
from ...scene.camera_check import camera_doubt
from ...scene.coverage import draw_coverage, find_coverage
from ...scene.formats.datasets.splatting import CAMERAS, is_output, iterations, source_of, trained_background
from ...scene.formats.table import format_lines as scene_lines
from ...scene.formats.transforms import FRAME_FILE
from ...scene.load import holding_format, load_scene, scene_around
from ...scene.scene import Scene
from ...splats.io import is_splat_file, splat_path
from ...splats.io.contents import bounded_values
from ...splats.io.formats import SplatFormat, endings_read, format_to_read, splat_formats
from ...splats.io.gltf import gltf_counts
from ...splats.io.usd import USD_ENDINGS, usd_counts
from ...splats.splat_field import SplatField
from ...view.camera import Camera, CameraFile
from ...view.camera_file import camera_program
from ...view.pictures import contact_sheet, shrink, write_png
from ..films.edits import read_edits_file
from ..films.render import require_voxels
from . import shared
from .arguments import options
from .arguments.info import SHEET_PICTURES, SHEET_SIDE
from .cameras import named_scene, splatting_output

#: Plurals of what stages hold, where an s does not make them.
_PLURALS = {"mesh": ("mesh", "meshes"), "prim of splats": ("prim of splats", "prims of splats")}

#: Names and values, one per printed line.
Rows = list[tuple[str, object]]


def run_info(args: argparse.Namespace) -> None:
    shared.require_field_scale(args)
    sheet = None if args.sheet is None else options.check_output(args.sheet, (".png",), "contact sheet")
    box = None if args.box is None else options.check_output(args.box, (".png",), "picture")
    args.seen = None if args.seen is None else options.check_output(args.seen, (".png",), "picture")
    path = None if args.field is None else pathlib.Path(args.field)
    of_pictures = path is not None and path.is_dir() and (sheet or box or args.seen)
    of_splats = path is not None and path.exists() and is_splat_file(path) and not of_pictures
    if path is not None and is_output(path) and not splatting_output(str(path)):
        of_splats = False  # a scene that its splats were written to
    if not (path is not None and path.is_dir() and not of_splats):
        if sheet is not None:
            raise InputError(f"--sheet shows the pictures of a scene folder, got {args.field!r}")
        if box is not None:
            raise InputError(f"--box shows where the object of a scene folder is, got {args.field!r}")
        if args.seen is not None and not str(args.field).lower().endswith(".npz"):
            raise InputError(f"--seen shows what cameras of a scene folder or a field saw, got {args.field!r}")
    if path is None:
        rows = _machine()
    elif of_splats:
        rows = _splats(splat_path(path), args) + (_output(path) if path.is_dir() else [])
    elif path.is_dir():
        rows = _scene(path, args, sheet, box) + (_output(path) if is_output(path) else [])
    elif not path.exists():
        raise MissingFileError(f"file {args.field!r} is not there")
    elif path.suffix.lower() == ".npz":
        rows = _field(path, args)
    elif path.suffix.lower() in USD_ENDINGS and not (path.suffix.lower() != ".usdz" and usd_counts(path)["mesh"]):
        rows = [("kind", "USD stage"), *_held(path), ("file", _file_size(path))]
    elif path.suffix.lower() in mesh_endings():
        rows = _cage(path)
    elif path.suffix.lower() == ".json":
        rows = _json(path)
    else:
        raise InputError(
            f"{args.field!r} is not a field (.npz), splats ({' '.join(endings_read())}), cage "
            f"({' '.join(mesh_endings())}), poses, edits, cameras, places, a scene file (.json) or scene "
            f"folder{seen_note(path)}{scene_around(path)}"
        )
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:{width}}  {value}")


def _machine() -> Rows:
    start_warp()
    rows: Rows = [
        ("warpcage", options.package_version()),
        ("warp", wp.__version__),
        ("numpy", np.__version__),
        ("python", platform.python_version()),
        ("platform", platform.platform()),
    ]
    rows += [("meshes and cages", line) for line in format_lines(mesh_formats())]
    rows += [("splats", line) for line in format_lines(splat_formats())]
    rows += [("scenes", line) for line in scene_lines()]
    return rows + [(device.alias, device_line(device)) for device in wp.get_devices()]


def device_line(device: wp.Device) -> str:
    """A processor with its threads, or a GPU with its memory and architecture."""
    if device.is_cpu:
        return f"{platform.processor() or device.name}, {counted(cpu_threads(), 'thread')}"
    return f"{device.name}, {device.total_memory / 2**30:.1f} GiB, sm_{device.arch}"


def _field(path: pathlib.Path, args: argparse.Namespace) -> Rows:
    field = require_voxels(shared.read_field(args), "info")
    cameras = None if field.refined_cameras is None else field.refined_cameras.cameras
    share = field.voxel_count / (field.resolution[0] * field.resolution[1] * field.resolution[2])
    density = field.stored.density.numpy()
    weights = None if field.weights is None else field.weights.numpy()
    return [
        ("kind", "field"),
        ("resolution", "x".join(str(n) for n in field.resolution)),
        ("voxels", f"{field.voxel_count} ({100 * share:.1f} % of the box)"),
        ("bounds", _box(*field.bounds)),
        ("voxel size", field.voxel_size.round(6).tolist()),
        ("density", _range(density, "per world unit")),
        ("weights", "not recorded" if weights is None else _range(weights, "at most along any training ray")),
        ("background", field.background.round(3).tolist()),
        ("up", field.up.round(3).tolist()),
        ("straightened", _turn(field.straightening)),
        ("around it", _around(field.background_model)),
        *([("seen", _seen(cameras, field.bounds, field.up, args.seen))] if cameras is not None or args.seen else []),
        ("file", _file_size(path)),
    ]


def _splats(path: pathlib.Path, args: argparse.Namespace) -> Rows:
    of_file = SplatField.load(path, device=shared.chosen_device(args))
    args.field, layout, beside = str(path), of_file.contents.layout, path.parent / FRAME_FILE
    field = shared.in_world_of_scene(args, of_file, named_scene(args))
    assert isinstance(field, SplatField)
    return [
        ("kind", "splats"),
        ("format", format_to_read(path).name),
        *_held(path),
        ("splats", field.splat_count),
        ("harmonics", f"degree {field.degree}"),
        *_ranges(of_file, format_to_read(path)),
        *([("frame", f"of nerfstudio, as {beside} says: --frame takes it out")] if beside.is_file() else []),
        ("bounds", _box(*field.bounds)),
        ("most of it in", _box(*field.shown_bounds)),
        ("scales", _range(field.scales, "world units")),
        ("opacities", _range(field.opacities, "of 1")),
        ("layout", "packed" if layout is None else f"{len(layout.table.dtype.names or ())} properties a splat"),
        *([("antialias", "yes")] if field.antialias else []),
        ("up", field.up.round(3).tolist()),
        ("file", _file_size(path)),
    ]


def _ranges(field: SplatField, format: SplatFormat) -> Rows:
    """Numbers of splats that formats bound, what that of the file holds, and how many may have been cut."""
    rows: Rows = []
    for what, values in bounded_values(field.contents).items():
        text = _range(values, "").strip()
        if what in format.ranges and values.size:
            low, high, step = format.ranges[what]
            ends = int(np.count_nonzero((values < low + 0.25 * step) | (values > high - 0.25 * step)))
            text += f"; {format.endings[0]} holds {low:.4g} to {high:.4g}" + f", {ends} at its ends" * (ends > 0)
        rows.append((what, text))
    return rows


def _output(folder: pathlib.Path) -> Rows:
    """What else an output folder of 3D Gaussian Splatting holds; nothing for other folders of splats."""
    found = iterations(folder)
    if not found:
        return []
    rows: Rows = [("iterations", f"{', '.join(map(str, found))}" + ": the newest is read" * (len(found) > 1))]
    if (folder / CAMERAS).is_file():
        cameras = [key.camera for key in CameraFile.load(folder / CAMERAS)]
        last = len(cameras) - 1
        sizes = listed(dict.fromkeys(f"{camera.width}x{camera.height}" for camera in cameras), 3)
        rows.append(("cameras", f"{len(cameras)} of {sizes}: --camera {folder}:0 to :{last}"))
    rows.append(("background", trained_background(folder) or "not known"))
    try:
        return [*rows, ("pictures", source_of(folder))]
    except FileNotFoundError as error:
        return [*rows, ("pictures", str(error).removeprefix(f"{folder}: "))]


def _held(path: pathlib.Path) -> Rows:
    """What is in a stage of USD or the scene of a glTF file, and how long what moves takes."""
    ending = path.suffix.lower()
    if ending not in (*USD_ENDINGS, *GLTF_ENDINGS):
        return []
    counts = usd_counts(path) if ending in USD_ENDINGS else gltf_counts(path)
    named = [counted(count, *_PLURALS.get(kind, (kind,))) for kind, count in counts.items() if count]
    rows: Rows = [("holds", listed(named, none="no mesh, camera, skeleton or splats"))]
    if not counts["mesh"] or ending == ".usdz":
        return rows
    names = gltf_animation_names(path) if ending in GLTF_ENDINGS else []
    for name in names or [""]:
        rows += _frames(path, name)
    return rows


def _frames(path: pathlib.Path, name: str) -> Rows:
    """How many frames an animation has, "" for the one without a name, and how long they take; or the shapes."""
    read = read_usd_motion if path.suffix.lower() in USD_ENDINGS else read_gltf_motion
    try:
        motion = read(path, name)
    except ValueError as error:
        return [("moves", f"cannot be read: {error}")]
    if motion is None:
        return []
    if motion.times is None:
        return [("shapes", listed(motion.names))]
    long = f"{motion.times[-1]:.4g} s, {motion.fps:.6g} a second"
    return [(f"animation {name!r}" if name else "moves", f"{counted(len(motion.times), 'frame')} in {long}")]


def _turn(straightening: np.ndarray | None) -> str:
    """By how much a field was turned from the coordinates of its scene's files."""
    if straightening is None:
        return "no: coordinates of the scene's files"
    cosine = np.clip(0.5 * (np.trace(straightening[:3, :3]) - 1.0), -1.0, 1.0)
    return f"by {np.degrees(np.arccos(cosine)):.1f} degrees"


def _around(background: LayeredBackground | OuterField | None) -> str:
    if background is None:
        return "nothing"
    if isinstance(background, OuterField):
        return f"{background.voxel_count} voxels in {background.side}^3 of contracted space, to infinity"
    return (
        f"{background.layer_count} layers of 6x{background.side}x{background.side} cells, from "
        f"{background.half:.4g} to infinity around {background.center.round(4).tolist()}"
    )


def _cage(path: pathlib.Path) -> Rows:
    names = object_names(path)
    if len(names) > 1:
        return _objects(path, names)
    cage = Cage.load(path)
    try:
        cage.require_usable("the cage")
        state = "yes"
    except ValueError as error:
        state = f"no: {error}"
    return [
        ("kind", "cage"),
        *_held(path),
        ("vertices", len(cage.vertices)),
        ("faces", cage.face_count),
        ("edges", len(cage.edges)),
        ("bounds", _box(*cage.bounds)),
        ("size", f"{cage.size:.4g}"),
        ("volume", f"{cage.volume:.4g}"),
        ("usable", state),
        ("file", _file_size(path)),
    ]


def _objects(path: pathlib.Path, names: list[str]) -> Rows:
    """Each object of a mesh file of several."""
    rows: Rows = [("kind", f"{len(names)} objects: --cage-object chooses one as the cage")]
    for name in names:
        cage = Cage.load(path, object=name)
        counts = f"{counted(len(cage.vertices), 'vertex', 'vertices')}, {counted(cage.face_count, 'face')}"
        rows.append((f"object {name!r}", f"{counts}, {_box(*cage.bounds)}"))
    return [*rows, *_held(path), ("file", _file_size(path))]


def _json(path: pathlib.Path) -> Rows:
    """What a JSON file holds, by the format that it names."""
    kinds = {"warpcage poses": _poses, "warpcage cameras": _cameras, "warpcage edits": _edits}
    kinds |= {"warpcage stage": _stage, "warpcage place": _place}
    try:
        content = read_json(path, "file of warpcage", (dict, list))
        if program := camera_program(content):
            return [("kind", f"cameras of {program}"), *_cameras(path)[1:]]
        if content.keys() == {"transform", "scale"}:
            raise InputError("a frame of nerfstudio (dataparser_transforms.json): give it as --frame, beside its field")
        kind = content.get("format", "warpcage place" if content.keys() & PLACE_KEYS else None)  # hand-written
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    if kind == "warpcage session":
        raise InputError(f"{path}: a session of the editor: `warpcage edits {path}` lists its edits")
    if not isinstance(kind, str) or kind not in kinds:
        raise InputError(
            f"{path}: not a warpcage file: its format must be one of {', '.join(kinds)}{scene_around(path)}"
        )
    return kinds[kind](path)


def _cameras(path: pathlib.Path) -> Rows:
    cameras = CameraFile.load(path)
    rows: Rows = [("kind", "cameras"), ("cameras", len(cameras)), ("file", _file_size(path))]
    for index, key in enumerate(cameras):
        camera = key.camera
        place = f"{camera.width}x{camera.height} from {camera.center.round(4).tolist()}"
        place += "" if key.time is None else f", at {key.time:g} s"
        rows.append((f"camera {key.name or index!r}", place))
    return rows


def _poses(path: pathlib.Path) -> Rows:
    poses = PoseFile.load(path)
    rest = poses.rest
    rows = [
        ("kind", "poses"),
        ("keyframes", len(poses)),
        ("cage vertices", len(rest.vertices)),
        ("cage faces", rest.face_count),
        ("cage bounds", _box(*rest.bounds)),
        ("file", _file_size(path)),
    ]
    if poses.times or poses.cameras:
        rate = f", {poses.fps:g} frames a second" if poses.fps else ""
        rows.append(("film", f"{poses.length:g} s{rate}" + (f", {poses.loop}" if poses.loop else "")))
    for name in (*poses.timed, *(name for name in poses.names if name not in poses.times)):
        moved = np.linalg.norm(poses[name].vertices - rest.vertices, axis=1)
        at = f"at {poses.times[name]:g} s, {poses.easings.get(name, 'smooth')}: " if name in poses.times else ""
        count = counted(int((moved > 0).sum()), "vertex", "vertices")
        rows.append((f"pose {name!r}", f"{at}{count} moved by up to {moved.max():.4g}"))
    rows += [(f"camera {key.name!r}", f"at {key.time:g} s, {key.easing}") for key in poses.cameras]
    return rows


def _edits(path: pathlib.Path) -> Rows:
    edits = read_edits_file(path)
    numbered = [(f"edit {number}", edit) for number, edit in enumerate(edits, 1)]
    return [("kind", "edits"), ("edits", len(edits)), *numbered, ("file", _file_size(path))]


def _stage(path: pathlib.Path) -> Rows:
    objects = read_stage_file(path)
    rows: Rows = [("kind", "scene file"), ("objects", len(objects))]
    for each in objects:
        edits = counted(len(read_deformation(each["deformation"])[1]), "edit") if "deformation" in each else "no edits"
        hidden = ", hidden" if each.get("hidden") else ""
        rows.append((f"object {each['name']!r}", f"{each['field']}, {edits}, {_placed(each['place'])}{hidden}"))
    return [*rows, ("file", _file_size(path))]


def _place(path: pathlib.Path) -> Rows:
    places = PlaceFile.load(path)
    keys = [(f"at {time:g} s", _placed(PlaceFile(place))) for time, place in places.places.items()]
    return [("kind", "place"), *keys, ("file", _file_size(path))]


def _placed(places: PlaceFile) -> str:
    """Where an object stands, or how long it moves."""
    if len(places.places) > 1:
        return f"moves through {counted(len(places.places), 'place')} in {places.length:g} s"
    place = next(iter(places.places.values()))
    position, turn = (np.asarray(vector).tolist() for vector in (place.position, place.turn))
    return f"at {position}, turned by {turn} degrees, {place.scale:g} times as large"


def _scene(path: pathlib.Path, args: argparse.Namespace, sheet: pathlib.Path | None, box: pathlib.Path | None) -> Rows:
    form = args.format or holding_format(path).name
    scene = load_scene(path, split=args.split, format=form)
    sizes = sorted({(camera.width, camera.height) for camera in scene.cameras})
    centers = np.stack([each.center for each in scene.cameras])
    focal = np.array([[each.fx, each.fy] for each in scene.cameras])
    rows = [
        ("kind", "scene"),
        ("format", form),
        ("split", args.split),
        ("pictures", f"{len(scene)} of {' to '.join(f'{w}x{h}' for w, h in dict.fromkeys((sizes[0], sizes[-1])))}"),
        ("colours", _range(np.array([[image.min(), image.max()] for image in _cut(scene, scene.images)]), "of 1")),
        ("opacity", "no" if scene.alphas is None else f"yes, {_percent(scene, scene.alphas)} covered"),
        ("focal length", _range(focal, "pixels")),
        ("cameras in", _box(centers.min(axis=0), centers.max(axis=0))),
        ("up", scene.up.round(3).tolist()),
        ("bounds", "not given" if scene.bounds is None else _box(*scene.bounds)),
        *([("object", _object(scene, args, box))] if scene.alphas is None or box is not None else []),
        *([] if args.seen is None else [("seen", _seen(scene.cameras, _bounds(scene), scene.up, args.seen))]),
        ("memory", f"{(scene.images.nbytes + (0 if scene.alphas is None else scene.alphas.nbytes)) / 1e6:.0f} MB"),
    ]
    if scene.weights is not None:
        rows.append(("ignored", f"{_percent(scene, scene.weights == 0.0)} of pixels"))
    if (doubt := camera_doubt(scene)) is not None:
        rows.append(("doubtful", doubt))
    if sheet is not None:
        rows.append(("sheet", _write_sheet(scene, sheet)))
    return rows


def _cut(scene: Scene, array: np.ndarray) -> list[np.ndarray]:
    """What belongs to each picture of a scene of an array as large as the images."""
    return [scene.cut(index, array[index]) for index in range(len(scene))]


def _percent(scene: Scene, shares: np.ndarray) -> str:
    """The mean of shares (n, h, w) over the pixels of all pictures."""
    parts = _cut(scene, shares)
    return f"{100 * sum(float(part.sum()) for part in parts) / sum(part.size for part in parts):.1f} %"


def _seen(
    cameras: Sequence[Camera] | None, bounds: np.ndarray | None, up: np.ndarray, path: pathlib.Path | None
) -> str:
    """From where cameras saw an object in a box (2, 3), of which a map may be written."""
    if cameras is None or bounds is None:
        raise InputError("--seen needs cameras and a box of the object, which are not known: give another scene")
    coverage = find_coverage(cameras, bounds.mean(axis=0), up)
    if path is not None:
        write_png(path, draw_coverage(coverage, cameras, bounds))
    return coverage.summary() + ("" if path is None else f"; see {path}")


def _bounds(scene: Scene) -> np.ndarray | None:
    """The box of a scene's object, outlines not looked at; None where its cameras do not show it."""
    try:
        return scene_box(scene).bounds
    except ValueError:
        return None


def _object(scene: Scene, args: argparse.Namespace, path: pathlib.Path | None) -> str:
    """Where fits take the object to be, of which a picture may be written."""
    silhouettes = None if scene.alphas is None else Silhouettes(scene, shared.chosen_device(args))
    try:
        found = scene_box(scene, silhouettes)
    except ValueError as error:
        if path is not None:
            raise
        return str(error)
    if path is not None:
        write_png(path, draw_box(scene.cameras, scene.points, found))
    return f"{box_text(found.bounds)}, {found.reason}" + ("" if path is None else f"; see {path}")


def _write_sheet(scene: Scene, path: pathlib.Path) -> str:
    chosen = np.unique(np.linspace(0, len(scene) - 1, min(len(scene), SHEET_PICTURES)).round().astype(int))
    factor = max(1, -(-max(scene.images.shape[1:3]) // SHEET_SIDE))
    write_png(path, contact_sheet([shrink(scene.images[index], factor) for index in chosen]))
    return f"{path}, {len(chosen)} of {len(scene)} pictures"


def _box(low: np.ndarray, high: np.ndarray) -> str:
    return f"{low.round(4).tolist()} to {high.round(4).tolist()}"


def _range(values: np.ndarray, unit: str) -> str:
    """The smallest and the largest value of an array, with their unit."""
    if values.size == 0:
        return "none"
    low, high = float(values.min()), float(values.max())
    return f"{low:.4g} {unit}" if low == high else f"{low:.4g} to {high:.4g} {unit}"


def _file_size(path: pathlib.Path) -> str:
    size = path.stat().st_size
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


def run_kernels(args: argparse.Namespace) -> None:
    if args.action == "list":
        names = kernel_names()
        width = max(map(len, names))
        for name in names:
            print(f"{name:{width}}  {kernel_summary(name)}")
        return
    name, destination = args.name, pathlib.Path(args.destination)
    name = name if name in kernel_groups() else find_kernel(name)
    check_parent(destination)
    paths = copy_kernel(name, destination, alone=args.alone)
    module = f"{destination.resolve().name}.{name}".replace("/", ".")
    host = [path for path in paths if "host" in path.relative_to(destination).parts]
    print(f"{destination} holds {name} and all that it needs; use it as in: from {module} import ...")
    for path in paths:
        if path not in host:
            print(f"  {path}")
    if host:
        print(f"  {destination / 'host'}: {counted(len(host), 'module')} that launch kernels")
    what = "what kernels take, and how they are launched" if args.alone else "a call that runs as it stands"
    print(f"{what}: {destination / name.partition('/')[0] / 'README.md'}")
