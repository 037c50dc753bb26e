"""What a command works on: its device, field, cages and Deformer."""

from __future__ import annotations

import argparse

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..core.devices import resolve_device
from ..core.files import require_file
from ..core.names import BACKGROUNDS
from ..deform.deformer import Deformer
from ..deform.fill import fill_unseen
from ..deform.picture_cells import MOST_CELLS, picture_cells
from ..field.voxel_field import VoxelField
from ..scene.load import load_scene
from ..scene.scene import Scene
from ..splats.io import is_splat_file
from ..splats.splat_field import AnyField, SplatField, load_field
from ..view.camera import Camera
from ..view.frame import Frame
from . import options, verbosity
from .deformation import Deformation, is_deformed


def quiet_warp() -> None:
    """Keep Warp's start-up lines and those of its modules out of a command's output, but for --verbose."""
    if not verbosity.verbose:
        wp.config.log_level = wp.LOG_WARNING


def chosen_device(args: argparse.Namespace) -> wp.Device:
    """The device of --device."""
    quiet_warp()
    return resolve_device(args.device)


def read_field(args: argparse.Namespace) -> AnyField:
    """The field file of a command, voxels or splats, on the chosen device; sets `args.straightening`, and `args.up`
    where --up is not given."""
    require_file(args.field, "field file")  # before Warp starts, which takes a while
    if is_splat_file(args.field):
        require_field_scale(args)
    elif getattr(args, "antialias", None):
        raise ValueError(f"--antialias is for files of splats, got {args.field!r}")
    elif getattr(args, "map", None) == "forward":
        raise ValueError(f"--map forward is for files of splats, voxels are looked up backward, got {args.field!r}")
    field = load_field(args.field, scene_scale=args.scene_scale, device=chosen_device(args))
    if getattr(args, "up", field) is None:  # a command with a view
        args.up = tuple(field.up)
    # Cameras of scenes are moved by it.
    args.straightening = field.straightening
    return field


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
    )


def is_field(path: str) -> bool:
    """Whether a file is a field: voxels (.npz) or splats."""
    return path.lower().endswith(".npz") or is_splat_file(path)


def require_voxels(field: AnyField, what: str) -> VoxelField:
    """A field of voxels. Raises ValueError for splats; what: what is asked for, as the message begins."""
    if isinstance(field, SplatField):
        raise ValueError(f"{what} is for fields of voxels (.npz), this one is of splats")
    return field


def masked_scene(path: str, field: VoxelField) -> Scene:
    """The training pictures of a scene in the world of a field, as masks of its object."""
    scene = load_scene(path, orient=field.straightening)
    if scene.alphas is None:
        raise ValueError(f"the pictures of scene {path!r} have no opacity to take as masks")
    return scene


def require_field_scale(args: argparse.Namespace) -> None:
    """Raises ValueError for --scene-scale where no field takes it."""
    if getattr(args, "scene_scale", 1.0) != 1.0 and not str(args.field).lower().endswith(".npz"):
        raise ValueError(f"--scene-scale is for fields (.npz), got {args.field!r}")


def require_deformation(args: argparse.Namespace, what: str) -> None:
    """Raises ValueError where no cage is given for something that needs one; what: how the message calls it."""
    if not is_deformed(args):
        alone = " (or --cage alone, at rest)" if what == "--overlay" else ""
        raise ValueError(f"{what} needs a deformation: --cage and --posed{alone}, --edit or --edits")


def visible_points(field: AnyField, deformation: Deformation | None, frame: str | None) -> np.ndarray:
    """(n, 3) points around what a picture shows, world units: vertices of the cages at rest and posed (frame "posed"),
    else the corners of the field's box."""
    # The field at rest is the usual one, so that pictures before and after an edit, and of all its poses, can be
    # compared.
    if deformation is not None and frame == "posed":
        return deformation.vertices
    low, high = field.shown_bounds if isinstance(field, SplatField) else field.bounds
    return np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 1, high, low)


def make_deformer(field: AnyField, deformation: Deformation, args: argparse.Namespace) -> Deformer:
    """The Deformer of the deformation options, not posed yet."""
    options = {"coordinates": args.coordinates, "resolution": lattice_cells(args), "density": args.density}
    return Deformer(field, deformation.edits, **options, map=args.map)


def lattice_cells(args: argparse.Namespace) -> int | None:
    """The lattice of --resolution, None for none; the finest usual one where `set_lattice` chose none."""
    return MOST_CELLS if args.resolution == options.BY_SIZE else args.resolution


def set_lattice(args: argparse.Namespace, camera: Camera) -> None:
    """Choose the lattice by the size of a camera's picture, where --resolution is not given."""
    if args.resolution == options.BY_SIZE:
        args.resolution = picture_cells(camera)


def posed_renderer(field: AnyField, deformation: Deformation | None, args: argparse.Namespace) -> AnyField | Deformer:
    """What renders the scene: the field itself, or a posed Deformer where something is deformed."""
    if deformation is None or deformation.is_still:
        return field
    return make_deformer(field, deformation, args).pose(deformation.posed)


def is_transparent(args: argparse.Namespace) -> bool:
    """Whether pictures have opacity instead of a background; refuses both, and unknown ones, before any long work."""
    known = (*BACKGROUNDS, options.TRANSPARENT)
    if isinstance(args.background, str) and args.background not in known:
        raise ValueError(
            f"--background {args.background!r} is not known: {', '.join(known)}, or three numbers in [0, 1] such as "
            "0.2,0.3,0.4"
        )
    if args.transparent and args.background not in (None, options.TRANSPARENT):
        raise ValueError("--transparent cannot be combined with --background: give one of them")
    return args.transparent or args.background == options.TRANSPARENT


def render_view(renderer: AnyField | Deformer, camera: Camera, args: argparse.Namespace) -> Frame:
    """The view of a camera before the chosen background; what no picture showed is filled where --fill asks for it."""
    splats = {"antialias": True} if args.antialias else {}
    frame = renderer.render(camera, **background_option(args), **splats)
    if not args.fill or frame.reveal is None:
        return frame
    field = renderer.field if isinstance(renderer, Deformer) else renderer
    return fill_unseen(frame, require_voxels(field, "--fill"), camera)


def require_fillable(args: argparse.Namespace, field: AnyField) -> None:
    """Raises ValueError where --fill has nothing to fill."""
    if not args.fill:
        return
    require_deformation(args, "--fill")
    if args.background is not None or args.transparent:
        raise ValueError("--fill continues the field's own background: it cannot be combined with --background")
    if field.background_model is None:
        raise ValueError("--fill: behind this field there is one colour, so that nothing is missing where it shows")


def drawn_cages(renderer: AnyField | Deformer, deformation: Deformation | None) -> list[Cage]:
    """The cages that an overlay shows: as the Deformer has them, whose held walls stay at rest."""
    if deformation is None:
        return []
    posed = renderer.deformed if isinstance(renderer, Deformer) else None
    return deformation.drawn(deformation.posed if posed is None else posed)


def background_option(args: argparse.Namespace) -> dict:
    """The option `background` of a render, empty where the field's own is taken. Behind opacity there is black."""
    if is_transparent(args):
        return {"background": "black"}
    return {} if args.background is None else {"background": args.background}
