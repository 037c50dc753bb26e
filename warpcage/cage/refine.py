"""Edit a cage by hand: divide it, take vertices away without uncovering the object, make it symmetric."""

from __future__ import annotations

import numpy as np

from ..mesh.closed_mesh import ClosedMesh
from .poses import axis_index


def subdivided(cage: ClosedMesh, times: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Every face cut in four at the middles of its edges, `times` times; the surface stays where it is.

    The vertices of the cage keep their numbers, new ones follow. Raises ValueError for times outside 1 .. 4.
    """
    if not isinstance(times, int | np.integer) or not 1 <= times <= 4:
        raise ValueError(f"times must be 1 to 4, got {times!r}")
    vertices, faces = cage.vertices, cage.faces.astype(np.int64)
    for _ in range(times):
        pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        edges, middle = np.unique(pairs, axis=0, return_inverse=True)
        ab, bc, ca = middle.reshape(3, -1) + len(vertices)
        a, b, c = faces.T
        faces = np.concatenate(
            [np.stack(corner, axis=1) for corner in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
        )
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
    return vertices, faces


def symmetrised(cage: ClosedMesh, axis: str = "x", *, centre: float | None = None, keep: str = "both") -> np.ndarray:
    """Vertices moved so that the cage is its own mirror image across the plane at `centre` along `axis`.

    The cage must be nearly symmetric already: each vertex is paired with the one nearest to its mirror image. centre:
    world units, the middle of the bounding box by default. keep: "both" takes means, "+" or "-" copies the half on that
    side to the other. Faces stay; squares may be cut along other diagonals on both sides.
    Raises ValueError where the vertices do not pair, or for other names.
    """
    along = axis_index(axis)
    if keep not in ("both", "+", "-"):
        raise ValueError(f"keep must be 'both', '+' or '-', got {keep!r}")
    middle = float(cage.bounds[:, along].mean()) if centre is None else float(centre)
    if not np.isfinite(middle):
        raise ValueError(f"centre must be finite, got {centre}")
    own = cage.vertices
    mirrored = own.copy()
    mirrored[:, along] = 2.0 * middle - mirrored[:, along]
    partner = np.array([np.argmin(((own - image) ** 2).sum(axis=1)) for image in mirrored])
    alone = np.flatnonzero(partner[partner] != np.arange(len(own)))
    if len(alone):
        raise ValueError(
            f"{len(alone)} vertices have no partner across the plane {axis} = {middle:.4g}, the first "
            f"{alone[0]}: move the plane with centre, or make the cage with symmetry={axis!r}"
        )
    across = mirrored[partner]
    if keep == "both":
        return 0.5 * (own + across)
    side = (own[:, along] >= middle) == (keep == "+")
    middle_ones = partner == np.arange(len(own))
    kept = np.where(side[:, None], own, across)
    return np.where(middle_ones[:, None], 0.5 * (own + across), kept)
