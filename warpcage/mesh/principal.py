"""Principal axes of a mesh: the directions that it has of its own, however it stands in the world."""

from __future__ import annotations

import numpy as np

from .closed_mesh import ClosedMesh

#: The axes by name, the longest first.
OWN_AXES = ("long", "middle", "short")

#: Axes along which a mesh reaches nearly as far as along the next one are not told apart: least ratio of variances.
_LEAST_RATIO = 1.05


def principal_axes(mesh: ClosedMesh) -> tuple[np.ndarray, np.ndarray]:
    """Principal axes of a mesh's surface, whatever the size of its faces: (3, 3) unit vectors, one a row, right-handed,
    and (3,) variances along them, world units squared, the longest first."""
    corners = np.stack(mesh.corners, axis=1)
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    total = max(float(areas.sum()), 1e-300)
    corners = corners - (areas[:, None] * corners.mean(axis=1)).sum(axis=0) / total
    middles = corners.mean(axis=1)
    # the covariance of the area: of a face of area A with corners a, b, c and middle m, about the middle of all, it is
    # A / 12 (9 m m' + a a' + b b' + c c')
    second = 9.0 * np.einsum("f,fi,fj->ij", areas, middles, middles)
    second += np.einsum("f,fki,fkj->ij", areas, corners, corners)
    variances, vectors = np.linalg.eigh(second / (12.0 * total))
    axes = vectors.T[::-1].copy()
    # towards the positive side of the world axis that each is nearest to
    for axis in axes[:2]:
        axis *= np.sign(axis[np.argmax(np.abs(axis))])
    axes[2] = np.cross(axes[0], axes[1])
    return axes, variances[::-1]


def own_axis(mesh: ClosedMesh, name: str) -> str | np.ndarray:
    """A mesh's own axis (3,) by its name: "long", "middle" or "short", "-long" against it; other names are left as they
    are."""
    plain = name[1:] if name[:1] in ("-", "+") else name
    if plain not in OWN_AXES:
        return name
    axes, variances = principal_axes(mesh)
    index = OWN_AXES.index(plain)
    for one in (index - 1, index):
        if 0 <= one < 2 and variances[one] < _LEAST_RATIO * variances[one + 1]:
            raise ValueError(
                f"the cage has no {plain!r} axis: it reaches as far in other directions; name x, y, z or a direction"
            )
    return -axes[index] if name[0] == "-" else axes[index]
