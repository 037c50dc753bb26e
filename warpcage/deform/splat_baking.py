"""Posed splats as fields of their own, and sequences of their files."""

import pathlib
import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..core.checks import checked_path, checked_whole, listed, warn_caller
from ..core.files import PathLike
from ..core.names import counted
from ..errors import InputError
from ..splats.binding import turned_harmonics
from ..splats.io.contents import SplatContents, chosen_layout, logits_of, rotation_matrices
from ..splats.io.formats import format_to_write
from ..splats.splat_field import SplatField
from .splat_edits import SplatEdits


def write_sequence(path: PathLike, fields: Iterable[SplatField], first: int, overwrite: bool) -> list[pathlib.Path]:
    """See `Deformer.save_sequence`; fields: one for each file, made when it is written."""
    pattern = checked_path(path, "the name of a sequence")
    marks = re.findall("#+", pattern.name)
    if len(marks) != 1:
        raise InputError(f"a sequence needs one run of # in its name, such as walk_####.ply, got {pattern.name!r}")
    format_to_write(pattern)
    checked_whole(first, "first", 0)
    written: list[pathlib.Path] = []
    for number, field in enumerate(fields, first):
        for other in [] if written or not overwrite else numbered_files(pattern, marks[0]):
            other.unlink()
        written.append(pattern.with_name(pattern.name.replace(marks[0], str(number).zfill(len(marks[0])))))
        field.save(written[-1])
    others = [file.name for file in numbered_files(pattern, marks[0]) if file not in written] if written else []
    if others:
        warn_caller(
            f"beside the {counted(len(written), 'file')} of this sequence are {len(others)} of another one, which "
            f"players take for its own: {listed(others, 3)}; they are removed with overwrite"
        )
    return written


def numbered_files(pattern: pathlib.Path, marks: str) -> list[pathlib.Path]:
    """The files of a name with a number for its marks, in their order; none where there is no such folder."""
    before, after = (re.escape(part) for part in pattern.name.split(marks))
    numbered = re.compile(f"{before}[0-9]{{{len(marks)},}}{after}")
    names = sorted(pattern.parent.iterdir()) if pattern.parent.is_dir() else []
    return [path for path in names if numbered.fullmatch(path.name) and path.is_file()]


def baked_field(field: SplatField, posed: Any, edits: SplatEdits) -> SplatField:
    """The splats of a pose that can be seen, as files have them."""
    opacities = posed.opacities.numpy().astype(np.float64)
    kept = np.flatnonzero(opacities > 0.0)
    nodes = edits.instances.nodes[kept]
    rows = edits.tree.rows[nodes]
    jacobians = edits.carried.jacobians.numpy()[kept].astype(np.float64)
    held = field.contents

    # what is a splat of the file, and did not move
    places = posed.centers.numpy()[kept]
    whole = edits.tree.parents[nodes] < 0
    still = whole & (jacobians == np.eye(3)).all(axis=(1, 2)) & (places == edits.centers.numpy()[kept]).all(axis=1)
    same = whole & (posed.opacities.numpy()[kept] == field.opacities[rows].astype(np.float32))

    centers = np.where(still[:, None], held.centers[rows], (places.astype(np.float64) + edits.origin))
    axes, scales, _ = np.linalg.svd(jacobians @ edits.tree.factors[nodes])
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    log_scales = np.log(np.maximum(scales, np.finfo(np.float32).tiny)).astype(np.float32)
    turns = posed.turns.numpy()[kept].astype(np.float64)
    harmonics = held.harmonics[rows]
    harmonics[~still] = turned_harmonics(harmonics[~still], _matrices(turns[~still]))
    contents = SplatContents(
        centers.astype(held.centers.dtype),
        np.where(still[:, None], held.log_scales[rows], log_scales),
        np.where(still[:, None], held.quaternions[rows], quaternions_of(axes)).astype(np.float32),
        np.where(same, held.logits[rows], logits_of(np.minimum(opacities[kept], 1.0 - 1e-7))),
        harmonics,
        chosen_layout(held.layout, rows),
    )
    return SplatField.from_contents(contents, device=field.device, **field.view_options())


def quaternions_of(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions (n, 4) w x y z of rotations (n, 3, 3)."""
    r = rotations
    trace = np.einsum("nii->n", r)
    # four ways, of which the one with the largest number is taken
    squares = np.stack([trace, *(2.0 * r[:, k, k] - trace for k in range(3))], axis=1)
    best = np.argmax(squares, axis=1)
    w, x, y, z = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1], 1.0 + squares
    xy, xz, yz = r[:, 0, 1] + r[:, 1, 0], r[:, 0, 2] + r[:, 2, 0], r[:, 1, 2] + r[:, 2, 1]
    ways = np.stack(
        [
            np.stack([z[:, 0], w, x, y], axis=1),
            np.stack([w, z[:, 1], xy, xz], axis=1),
            np.stack([x, xy, z[:, 2], yz], axis=1),
            np.stack([y, xz, yz, z[:, 3]], axis=1),
        ],
        axis=1,
    )
    chosen = ways[np.arange(len(r)), best]
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


def _matrices(turns: np.ndarray) -> np.ndarray:
    """(n, 3, 3) rotations of Warp's quaternions x y z w."""
    return rotation_matrices(np.roll(turns, 1, axis=1))
