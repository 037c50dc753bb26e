"""Posed splats as fields of their own, and sequences of their files."""

import pathlib
import re
import warnings
from typing import Any

import numpy as np

from ..core.checks import listed
from ..core.names import counted
from ..splats.binding import turned_harmonics
from ..splats.io.contents import SplatContents, chosen_layout, logits_of, rotation_matrices
from ..splats.splat_field import SplatField
from .splat_edits import SplatEdits


def warn_of_others(pattern: pathlib.Path, marks: str, written: list[pathlib.Path]) -> None:
    """Say which files of another sequence a player would take for this one's."""
    ours = {path.name for path in written}
    others = [path.name for path in numbered_files(pattern, marks) if path.name not in ours] if written else []
    if others:
        warnings.warn(
            f"beside the {counted(len(written), 'file')} of this sequence lie {len(others)} of another one, which "
            f"players take for its own: {listed(others, 3)}; they are removed with overwrite",
            stacklevel=3,
        )


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
