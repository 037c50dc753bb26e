"""What a command works on: its device, field, cages and Deformer."""

from __future__ import annotations

import argparse

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..core.devices import resolve_device
from ..core.files import require_file
from ..deform.deformer import Deformer
from ..field.voxel_field import VoxelField
from .keyframes import read_pose


def quiet_warp() -> None:
    """Keep Warp's start-up lines out of a command's output."""
    wp.config.log_level = wp.LOG_WARNING


def chosen_device(args: argparse.Namespace) -> wp.Device:
    """The device of --device."""
    quiet_warp()
    return resolve_device(args.device)


def read_field(args: argparse.Namespace) -> VoxelField:
    """The field file of a command on the chosen device. Where --up is not given it becomes the field's own."""
    require_file(args.field, "field file")  # before Warp starts, which takes a while
    field = VoxelField.load(args.field, scene_scale=args.scene_scale, device=chosen_device(args))
    if getattr(args, "up", field) is None:  # a command with a view
        args.up = tuple(field.up)
    return field


def require_field_scale(args: argparse.Namespace) -> None:
    """Raises ValueError for --scene-scale where no field takes it."""
    if getattr(args, "scene_scale", 1.0) != 1.0 and not str(args.field).lower().endswith(".npz"):
        raise ValueError(f"--scene-scale is for fields (.npz), got {args.field!r}")


def require_deformation(args: argparse.Namespace, what: str) -> None:
    """Raises ValueError where no cage is given for something that needs one; what: how the message calls it."""
    if args.cage is None:
        raise ValueError(f"{what} needs a deformation: --cage and --posed")


def visible_points(field: VoxelField, rest: Cage | None = None, posed: Cage | None = None) -> np.ndarray:
    """Points around what there is to see.

    Args:
        field: The field that is shown.
        rest: The cage at rest. None shows the field as it is.
        posed: The posed cage. None shows the field as it is.

    Returns:
        (n, 3) the vertices of both cages, or the corners of the field's box, world units.
    """
    if rest is not None and posed is not None:
        return np.concatenate([rest.vertices, posed.vertices])
    low, high = field.bounds
    return np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 1, high, low)


def read_rest(args: argparse.Namespace) -> Cage | None:
    """The cage of --cage, or None where the field is shown as it is."""
    if (args.cage is None) != (args.posed is None):
        raise ValueError("--cage and --posed go together: the cage at rest and the same cage posed")
    if args.cage is None:
        return None
    rest = Cage.load(args.cage, up=args.cage_up)
    rest.require_usable(f"cage {args.cage!r}")
    return rest


def read_cages(args: argparse.Namespace) -> tuple[Cage, Cage] | None:
    """The cages of --cage and --posed, or None where the field is shown as it is.

    A posed cage whose vertices or faces come in another order is matched, which a line on stderr says, or refused where
    it does not fit.
    """
    rest = read_rest(args)
    return None if rest is None else (rest, read_pose(rest, args.posed, args.cage_up))


def make_deformer(field: VoxelField, rest: Cage, args: argparse.Namespace) -> Deformer:
    """The Deformer of the deformation options, not posed yet."""
    return Deformer(field, rest, coordinates=args.coordinates, resolution=args.resolution, density=args.density)


def posed_renderer(
    field: VoxelField, cages: tuple[Cage, Cage] | None, args: argparse.Namespace
) -> VoxelField | Deformer:
    """What renders the scene: the field itself, or a posed Deformer where there are cages at rest and posed."""
    return field if cages is None else make_deformer(field, cages[0], args).pose(cages[1])


def background_option(args: argparse.Namespace) -> dict:
    """The option `background` of a render, empty where the field's own is taken."""
    return {} if args.background is None else {"background": args.background}
