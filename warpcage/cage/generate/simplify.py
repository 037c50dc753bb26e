"""Fewer vertices around the same object."""

from __future__ import annotations

import numpy as np

from ...core.checks import checked_margin
from ...field.selection import visible_nodes
from ...mesh.mesh import ClosedMesh
from ...mesh.queries import inside_mesh
from ...mesh.validity import require_usable
from .fitting import cleared
from .nested import nested
from .offset import decimated, flaw
from .points import checked_count, surface_points
from .shell import ObjectShell


def simplified_cage(vertices, faces, points, spacing, need, vertex_count) -> tuple[np.ndarray, np.ndarray]:
    """A cage decimated outward, or else plainly, then moved off points (p, 3) where faces come nearer than `need`."""
    reasons = []
    for decimate, closing in ((nested, 0.0), (decimated, 0.05), (decimated, 0.1), (decimated, 0.2), (decimated, 0.4)):
        reach = need + max(2.0 * spacing, closing * np.ptp(points, axis=0).max())
        shell = ObjectShell(points, spacing, reach, need)
        found, triangles = decimate(vertices, faces, vertex_count)
        if abs(len(found) - vertex_count) > 0.1 * vertex_count:
            reasons.append(f"decimation left {len(found)} vertices")
            continue
        found = cleared(shell, found, triangles, need)
        reason = flaw(shell, found, triangles, need)
        if not reason:
            return found, triangles
        reasons.append(reason)
    raise ValueError(f"no cage of {vertex_count} vertices encloses the same ({reasons[-1]}): ask for more vertices")


def simplified(
    cage: ClosedMesh, vertex_count: int, *, field=None, mesh=None, margin: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3), about `vertex_count` (within a tenth), and faces (f, 3) that enclose a field's visible voxels
    and a mesh, or else the cage itself, from `margin` world units off."""
    require_usable(cage, "the cage")
    vertex_count = checked_count(vertex_count)
    if vertex_count >= len(cage.vertices):
        raise ValueError(f"the cage has {len(cage.vertices)} vertices already: ask for fewer, got {vertex_count}")
    margin = checked_margin(margin)
    thing = cage if mesh is None and field is None else mesh
    spacing, slack, points = cage.size / 96.0, 0.0, []
    if thing is not None:
        vertices, faces = np.asarray(thing.vertices, dtype=np.float64), np.asarray(thing.faces, dtype=np.int64)
        points += [vertices, surface_points(vertices, faces, 0.5 * spacing)]
        slack = 0.29 * spacing  # how far a face may lie off the points on it
    if field is not None:
        points.append(visible_nodes(field))
        spacing = max(spacing, float(np.max(field.voxel_size)))
        slack = max(slack, 0.5 * float(np.linalg.norm(np.broadcast_to(field.voxel_size, 3))))
    if not any(map(len, points)):
        raise ValueError("there is nothing to enclose: the object is empty")
    # part by part: few vertices tell most objects that are not enclosed from those that are
    if thing is not cage and not all(inside_mesh(part, cage).all() for part in points):
        raise ValueError("the cage does not enclose the object even before: check(field=...) says where")
    return simplified_cage(cage.vertices, cage.faces, np.concatenate(points), spacing, slack + margin, vertex_count)
