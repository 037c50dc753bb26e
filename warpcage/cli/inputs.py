"""What a command works on: its device, field, cages and Deformer."""

from __future__ import annotations

from ..cage.cage import Cage
from ..core.devices import resolve_device
from ..core.files import require_file
from ..deform.deformer import Deformer
from ..field.voxel_field import VoxelField
from .keyframes import read_pose


def quiet_warp() -> None:
    """Keep Warp's start-up lines out of a command's output."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING


def chosen_device(args):
    quiet_warp()
    return resolve_device(args.device)


def read_field(args):
    """The field file of a command on the chosen device; the file is looked for before Warp starts."""
    require_file(args.field, "field file")
    device = chosen_device(args)

    field = VoxelField.load(args.field, scene_scale=args.scene_scale, device=device)
    if getattr(args, "up", field) is None:  # a command with a view
        args.up = tuple(field.up)
    return field


def require_field_scale(args) -> None:
    """Refuse --scene-scale where no field takes it."""
    if getattr(args, "scene_scale", 1.0) != 1.0 and not str(args.field).lower().endswith(".npz"):
        raise ValueError(f"--scene-scale is for fields (.npz), got {args.field!r}")


def visible_points(field, rest=None, posed=None):
    """(n, 3) points around what there is to see: the vertices of both cages, or the corners of the field's box."""
    import numpy as np

    if rest is not None:
        return np.concatenate([rest.vertices, posed.vertices])
    low, high = field.bounds
    return np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 1, high, low)


def read_rest(args):
    """The cage of --cage, or None where the field is shown as it is."""
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
    rest = read_rest(args)
    return (None, None) if rest is None else (rest, read_pose(rest, args.posed, args.cage_up))


def make_deformer(field, rest, args):
    return Deformer(field, rest, coordinates=args.coordinates, resolution=args.resolution, density=args.density)
