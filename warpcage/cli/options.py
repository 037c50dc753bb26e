"""Arguments that several commands share, and what they stand for."""

from __future__ import annotations

import argparse
import pathlib
import sys

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
    parser.add_argument("--device", metavar="NAME",
                        help='Warp device, "cpu" or "cuda:0" (default: CUDA where there is one)')


def add_cage_up(parser) -> None:
    parser.add_argument("--cage-up", choices=("y", "z"),
                        help="axis that points up in cage files (default: y for glTF, z for the others; Blender's OBJ "
                             "export has y unless told otherwise)")


def add_quiet(parser) -> None:
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def add_background(parser, default_text: str, more: str = "") -> None:
    parser.add_argument("--background", type=colour, metavar="COLOUR",
                        help="white, black, grey or three numbers in [0, 1] such as 0.2,0.3,0.4 "
                             f"(default: {default_text}){more}")


def add_masks(parser) -> None:
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--no-masks", dest="masks", action="store_false", default=True,
                       help="leave a scene's mask files alone: pictures are taken whole, background and all")
    group.add_argument("--split-masks", dest="masks", action="store_const", const="split",
                       help="split the pictures at the masks: the object, and its surroundings as layers behind it")


def add_deformation(parser, *, keyframes: bool = False) -> None:
    group = parser.add_argument_group("deformation (leave --cage and --posed out to show the field as it is)")
    group.add_argument("--cage", metavar="REST", help="cage around the undeformed object (.obj .ply .off .glb .gltf)")
    posed = ("the same cage, vertices moved: a cage file, a keyframe of a pose file (poses.json:NAME) or a preset such "
             "as bend:40:x:z, twist:60 or scale:0.8")
    if keyframes:
        posed += "; several, or all of a pose file (poses.json), are keyframes one after another"
    group.add_argument("--posed", metavar="POSED", nargs="+" if keyframes else None, help=posed)
    add_cage_up(group)
    group.add_argument("--coordinates", choices=COORDINATES, default="harmonic", help="kind (default: %(default)s)")
    group.add_argument("--resolution", type=lattice_resolution, default=128, metavar="N",
                       help='lattice cells along the longest side of the cage, or "precise" to evaluate the '
                            "coordinates at every sample (mean_value and green only) (default: %(default)s)")
    group.add_argument("--density", choices=DENSITIES, default="opacity",
                       help="opacity: parts keep their opacity when they are scaled; paper: density as the paper "
                            "has it (default: %(default)s)")


def add_view(parser) -> None:
    group = parser.add_argument_group("view (default: from above and aside, the whole object in the picture)")
    group.add_argument("--camera", metavar="SCENE:[SPLIT:]INDEX",
                       help="camera of a scene's picture, e.g. data/lego:test:3 (split: train)")
    group.add_argument("--eye", type=float, nargs=3, metavar=("X", "Y", "Z"), help="where the camera is")
    group.add_argument("--target", type=float, nargs=3, metavar=("X", "Y", "Z"), help="what it looks at")
    group.add_argument("--up", type=float, nargs=3, metavar=("X", "Y", "Z"),
                       help="direction that is up in the picture (default: as the field's cameras were held)")
    group.add_argument("--fov", type=field_of_view, default=40.0, metavar="DEGREES",
                       help="horizontal field of view (default: %(default)s)")
    group.add_argument("--size", type=positive_int, nargs="+", metavar="PIXELS",
                       help="width, or width and height (default: 400, or the size of --camera's picture)")


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


def memory(text: str) -> int:
    from ..fit_memory import memory_size

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


# What the arguments stand for


def quiet_warp() -> None:
    """Keep Warp's start-up lines out of a command's output."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING


def chosen_device(args):
    from ..devices import resolve_device

    quiet_warp()
    return resolve_device(args.device)


def read_field(args):
    """The field file of a command on the chosen device; the file is looked for before Warp starts."""
    from ..files import require_file

    require_file(args.field, "field file")
    device = chosen_device(args)
    from ..field import VoxelField

    field = VoxelField.load(args.field, device=device)
    if getattr(args, "up", field) is None:  # a command with a view
        args.up = tuple(field.up)
    return field


def visible_points(field, rest=None, posed=None):
    """(n, 3) points around what there is to see: the vertices of both cages, or the corners of the field's box."""
    import numpy as np

    if rest is not None:
        return np.concatenate([rest.vertices, posed.vertices])
    low, high = field.bounds
    return np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 1, high, low)


def read_rest(args):
    """The cage of --cage, or None where the field is shown as it is."""
    from ..cage import Cage

    if (args.cage is None) != (args.posed is None):
        raise ValueError("--cage and --posed go together: the cage at rest and the same cage posed")
    if args.cage is None:
        return None
    rest = Cage.load(args.cage, up=args.cage_up)
    rest.require_usable(f"cage {args.cage!r}")
    return rest


def read_cages(args):
    """Rest and posed cage of add_deformation, or (None, None); a posed cage in another order is matched, which a
    line on stderr says, or refused where it does not fit."""
    from .keyframes import read_pose

    rest = read_rest(args)
    return (None, None) if rest is None else (rest, read_pose(rest, args.posed, args.cage_up))


def matched(rest, posed, name: str):
    """`posed` with the vertices and faces of `rest` in their order, saying so where they came in another."""
    import numpy as np

    try:
        found = rest.match(posed)
    except ValueError as error:
        raise ValueError(f"cage {name!r} does not fit its rest cage: {error}") from None
    if not np.array_equal(posed.faces, rest.faces) or len(posed.vertices) != len(rest.vertices):
        print(f"warpcage: cage {name!r} comes in another order than its rest cage: matched", file=sys.stderr)
    if lies_on_its_side(rest.vertices, found.vertices):
        print(f"warpcage: warning: cage {name!r} would lie much nearer to its rest cage with another axis up: write "
              "both with the same one (see --cage-up)", file=sys.stderr)
    return found


def lies_on_its_side(rest, posed) -> bool:
    """Whether vertices (v, 3) halve their root mean square distance to those at rest when y and z up are exchanged."""
    import numpy as np

    x, y, z = posed.T
    exchanged = [np.stack(turned, axis=1) for turned in ((x, -z, y), (x, z, -y))]
    here, *there = (np.linalg.norm(vertices - rest) for vertices in (posed, *exchanged))
    return min(there) < 0.5 * here


def make_deformer(field, rest, args):
    from ..deformer import Deformer

    return Deformer(field, rest, coordinates=args.coordinates, resolution=args.resolution, density=args.density)


def image_size(args) -> tuple[int, int] | None:
    if args.size is None:
        return None
    if len(args.size) > 2:
        raise ValueError(f"--size takes a width, or a width and a height, got {len(args.size)} numbers")
    return args.size[0], args.size[-1]


def chosen_camera(args, points):
    """The camera of add_view; points (n, 3) that should be seen where none is given."""
    from ..camera import Camera
    from ..views import framing_orbit

    size = image_size(args)
    if args.camera is not None:
        if args.eye is not None or args.target is not None:
            raise ValueError("--camera and --eye / --target exclude each other")
        camera = scene_camera(args.camera)
        return camera if size is None else fitted(camera, *size)
    width, height = size or (400, 400)
    view = {"up": args.up, "fov_degrees": args.fov, "width": width, "height": height}
    framed = framing_orbit(points, 1, elevation_degrees=25.0, start_degrees=-60.0, **view)[0]
    if args.eye is None and args.target is None:
        return framed
    target = chosen_target(args, points)
    eye = framed.centre + target - middle(points) if args.eye is None else args.eye
    return Camera.look_at(eye, target, **view)


def chosen_target(args, points):
    """(3,) what the camera of add_view looks at, or turns around: the middle of what there is to see by default."""
    import numpy as np

    return middle(points) if args.target is None else np.asarray(args.target, np.float64)


def middle(points):
    """(3,) middle of the bounding box of points (n, 3)."""
    return (points.min(axis=0) + points.max(axis=0)) / 2


def fitted(camera, width: int, height: int):
    """The same view at another size; refused where that would squeeze it."""
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        raise ValueError(f"--size {width} {height} would squeeze a {camera.width}x{camera.height} picture: give "
                         f"{width} {round(width * camera.height / camera.width)}")
    return camera.resized(width, height)


def scene_cameras(text: str) -> list:
    """The cameras that SCENE[:SPLIT] names, in the order of the pictures."""
    from ..scene import load_scene

    path, split = text, "train"
    if not pathlib.Path(path).exists() and ":" in path:
        path, _, split = path.rpartition(":")
    return load_scene(path, split=split).cameras


def scene_camera(text: str):
    """The camera that SCENE:[SPLIT:]INDEX names."""
    path, separator, index = text.rpartition(":")
    if not separator or not index.isdigit():
        raise ValueError(f"--camera must be SCENE:INDEX or SCENE:SPLIT:INDEX, got {text!r}")
    cameras = scene_cameras(path)
    if int(index) >= len(cameras):
        raise ValueError(f"{path!r} has pictures 0 to {len(cameras) - 1}, got {index}")
    return cameras[int(index)]
