"""Options of deformations: cages, poses, edits, coordinates."""

from __future__ import annotations

import argparse

from ...core.names import COORDINATES, DENSITIES, FIELD_COORDINATES, SPLAT_MAPS
from . import options


def add_deformation(
    parser: options.Arguments,
    *,
    keyframes: bool = False,
    several: bool = False,
    usual_resolution: str = "by the picture's size, a cell for 5 pixels, 64 to 128",
) -> None:
    """Add the cages of a deformation and how it is computed; several poses make a film (keyframes) or pictures.
    usual_resolution: what the help says of the lattice where it is not given."""
    group = parser.add_argument_group(
        "deformation (--cage and --posed, or --edit, or --edits; without them the field is shown as it is)"
    )
    group.add_argument(
        "--cage", metavar="REST", help=f"cage around the undeformed object ({' '.join(options.CAGE_ENDINGS)})"
    )
    posed = (
        "the same cage with its vertices moved: a cage file, a keyframe of a pose file (poses.json:NAME), or a preset "
        "such as bend:40:x:z, twist:60 or scale:0.8"
    )
    if keyframes:
        posed += (
            ". Several, or all keyframes of a pose file (poses.json), follow one another. An animated glTF file "
            "(walk.glb), numbered files (walk_####.obj) or their folder are taken frame for frame"
        )
    if several:
        posed += ". Several, or all keyframes of a pose file, make a picture each, in a folder"
    group.add_argument("--posed", metavar="POSED", nargs="+" if keyframes or several else None, help=posed)
    add_edits(group)
    options.add_cage_up(group, found=True, posed=True)
    group.add_argument(
        "--coordinates",
        choices=COORDINATES,
        default=FIELD_COORDINATES,
        help="kind of coordinates (default: %(default)s)",
    )
    group.add_argument(
        "--resolution",
        type=options.lattice_resolution,
        default=options.BY_SIZE,
        metavar="N",
        help='lattice cells along the longest side of the cage, or "precise" to evaluate the '
        f"coordinates at every sample (mean_value and green only) (default: {usual_resolution})",
    )
    group.add_argument(
        "--density",
        choices=DENSITIES,
        default="opacity",
        help="opacity: parts keep their opacity when they are scaled; paper: they keep their density, as in the paper "
        "(default: %(default)s)",
    )
    add_map(group)


def add_map(parser: options.Arguments) -> None:
    """The way that splats move."""
    parser.add_argument(
        "--map",
        choices=SPLAT_MAPS,
        help="splats only. forward: they move by the coordinates of the cage at rest; backward: they go where voxels "
        "under the same cage would be (default: forward)",
    )


def add_edits(parser: options.Arguments) -> None:
    """Several edits of one scene."""
    parser.add_argument(
        "--edit",
        action="append",
        metavar="CAGE:POSED[:keep]",
        help="one of several edits; give it again for the next, which acts on what the ones before it left. POSED as "
        "for --posed. CAGE:POSED:keep leaves a copy where it was, CAGE:remove takes away what is in the cage, "
        "CAGE:POSED:falloff=WIDTH is a --falloff of its own",
    )
    parser.add_argument(
        "--falloff",
        type=options.positive_float,
        metavar="WIDTH",
        help="hold the walls of a cage that cut through matter, and let the edit fade to rest in a band of this width "
        "inside them, world units, so that a part does not tear off (default: no wall is held)",
    )
    parser.add_argument(
        "--fragments",
        type=options.positive_float,
        metavar="SIZE",
        help="take pieces smaller than this, world units, that a cage cuts off its part, along with the part (default: "
        "they stay)",
    )
    parser.add_argument(
        "--crumbs", dest="fragments", action=options.OldName, type=options.positive_float, help=argparse.SUPPRESS
    )
    parser.add_argument(
        "--edits",
        metavar="FILE",
        help="all edits from a file (warpcage edits writes one), or those of a session of the editor (.session.json)",
    )
