"""`warpcage info`: what a file holds, or what this machine has."""

import pathlib
import platform

from . import options

NAME = "info"
HELP = "describe a field, a cage or a scene; without a file: versions and devices"
EXAMPLE = """\
  warpcage info
  warpcage info lego.npz
  warpcage info cage.obj
  warpcage info data/lego
"""


def add_arguments(parser):
    parser.add_argument("field", metavar="file", nargs="?", help="field (.npz), cage (.obj .ply .off) or scene folder")
    parser.add_argument("--split", default="train", help="split of a scene (default: %(default)s)")
    options.add_device(parser)


def run(args):
    if args.field is None:
        rows = _machine()
    elif (path := pathlib.Path(args.field)).is_dir():
        rows = _scene(path, args)
    elif path.suffix.lower() == ".npz":
        rows = _field(path, args)
    elif path.suffix.lower() in options.CAGE_ENDINGS:
        rows = _cage(path)
    elif not path.exists():
        raise FileNotFoundError(f"file {args.field!r} is not there")
    else:
        raise ValueError(f"{args.field!r} is no field (.npz), cage ({' '.join(options.CAGE_ENDINGS)}) or scene folder")
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:{width}}  {value}")


def _machine():
    import numpy
    import warp

    options.quiet_warp()
    warp.init()
    rows = [("warpcage", options.package_version()), ("warp", warp.__version__), ("numpy", numpy.__version__),
            ("python", platform.python_version()), ("platform", platform.platform())]
    return rows + [(device.alias, _device_line(device)) for device in warp.get_devices()]


def _device_line(device) -> str:
    if device.is_cpu:
        from ..devices import CPU_THREADS

        return f"{platform.processor() or device.name}, {CPU_THREADS} threads"
    return f"{device.name}, {device.total_memory / 2**30:.1f} GiB, sm_{device.arch}"


def _field(path, args):
    field = options.read_field(args)
    low, high = field.bounds
    share = field.voxel_count / (field.resolution[0] * field.resolution[1] * field.resolution[2])
    return [("kind", "field"), ("resolution", "x".join(str(n) for n in field.resolution)),
            ("voxels", f"{field.voxel_count} ({100 * share:.1f} % of the box)"),
            ("bounds", f"{low.round(4).tolist()} to {high.round(4).tolist()}"),
            ("voxel size", field.voxel_size.round(6).tolist()), ("background", field.background.round(3).tolist()),
            ("file", f"{path.stat().st_size / 1e6:.1f} MB")]


def _cage(path):
    options.quiet_warp()
    from ..cage import Cage

    cage = Cage.load(path)
    low, high = cage.bounds
    try:
        cage.require_usable("the cage")
        state = "yes"
    except ValueError as error:
        state = f"no: {error}"
    return [("kind", "cage"), ("vertices", len(cage.vertices)), ("faces", len(cage.faces)), ("edges", len(cage.edges)),
            ("bounds", f"{low.round(4).tolist()} to {high.round(4).tolist()}"), ("size", f"{cage.size:.4g}"),
            ("volume", f"{cage.volume:.4g}"), ("usable", state)]


def _scene(path, args):
    import numpy as np

    from ..scene import load_scene

    scene = load_scene(path, split=args.split)
    camera = scene.cameras[0]
    centres = np.stack([each.centre for each in scene.cameras])
    low, high = centres.min(axis=0), centres.max(axis=0)
    return [("kind", "scene"), ("split", args.split), ("pictures", f"{len(scene)} of {camera.width}x{camera.height}"),
            ("opacity", "no" if scene.alphas is None else f"yes, {100 * float(scene.alphas.mean()):.1f} % covered"),
            ("focal length", f"{camera.fx:.2f} pixels"),
            ("cameras in", f"{low.round(3).tolist()} to {high.round(3).tolist()}")]
