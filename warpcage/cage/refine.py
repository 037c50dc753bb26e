"""Finer and symmetric versions of a cage."""

from __future__ import annotations

import numpy as np

from ..core.checks import axis_index, checked_number, checked_whole
from ..core.names import agreed, counted
from ..mesh.mesh import ClosedMesh


def subdivided(cage: ClosedMesh, times: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Every face cut in four at the middles of its edges, 1 to 4 times; vertices (v, 3) begin with the cage's."""
    vertices, faces = cage.vertices, cage.faces.astype(np.int64)
    for _ in range(checked_whole(times, "times", 1, 4)):
        vertices, faces = cut_in_four(vertices, faces)
    return vertices, faces


def cut_in_four(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every face cut in four at the middles of its edges: vertices (v + e, 3), the given ones first, faces (4 f, 3)."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, middle = np.unique(pairs, axis=0, return_inverse=True)
    ab, bc, ca = middle.reshape(3, -1) + len(vertices)
    a, b, c = faces.T
    divided = [np.stack(corner, axis=1) for corner in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    return np.concatenate([vertices, vertices[edges].mean(axis=1)]), np.concatenate(divided)


def symmetrised(cage: ClosedMesh, axis: str = "x", *, centre: float | None = None, keep: str = "both") -> np.ndarray:
    """Vertices (v, 3) of a nearly symmetric cage, its own mirror image across a plane at `centre`, world units.
    `keep`: "both" takes the mean of both halves, "+" or "-" copies the half on that side to the other."""
    # Faces stay, so squares may be cut along other diagonals on both sides.
    along = axis_index(axis)
    if keep not in ("both", "+", "-"):
        raise ValueError(f"keep must be 'both', '+' or '-', got {keep!r}")
    middle = float(cage.bounds[:, along].mean()) if centre is None else checked_number(centre, "centre")
    own = cage.vertices
    mirrored = own.copy()
    mirrored[:, along] = 2.0 * middle - mirrored[:, along]
    # each vertex is paired with the one nearest to its mirror image
    partner = np.array([np.argmin(((own - image) ** 2).sum(axis=1)) for image in mirrored])
    alone = np.flatnonzero(partner[partner] != np.arange(len(own)))
    if len(alone):
        raise ValueError(
            f"{counted(len(alone), 'vertex', 'vertices')} {agreed(len(alone), 'has', 'have')} no partner "
            f"across the plane {axis} = {middle:.4g}, the first "
            f"{alone[0]}: move the plane with centre, or make the cage with symmetry={axis!r}"
        )
    across = mirrored[partner]
    if keep == "both":
        return 0.5 * (own + across)
    side = (own[:, along] >= middle) == (keep == "+")
    middle_ones = partner == np.arange(len(own))
    kept = np.where(side[:, None], own, across)
    return np.where(middle_ones[:, None], 0.5 * (own + across), kept)
