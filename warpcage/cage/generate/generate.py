"""Cages around meshes and fields: by the paper's voxels, by a tight shell, or the tighter of both."""
# Whatever the method, the enclosure is kept on a distance field: the faces of the cage, not the points of the object,
# are held at a distance, which costs nothing per point of the object.

from __future__ import annotations

import sys

import numpy as np

from ...core.checks import checked_margin
from ...field.planes import Plane
from ...field.selection import visible_nodes
from ...field.surface import require_field
from .floor import ended_at
from .offset import shell_cage
from .points import _spacing, checked_count, surface_points
from .voxel import voxel_cage

#: Points of a mesh that are all looked at; of more, one in each cell of a tenth of a voxel.
_MOST_POINTS = 1_000_000


def cage_around_mesh(
    mesh,
    vertex_count: int = 100,
    *,
    margin: float | None = None,
    method: str = "auto",
    symmetry: str | None = None,
    progress: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of a cage of about `vertex_count` vertices around a mesh; see `Cage.from_mesh`.
    `margin`: least distance between cage and mesh, world units; None takes 1 % of the mesh's size."""
    vertex_count = checked_count(vertex_count)
    if not (hasattr(mesh, "vertices") and hasattr(mesh, "faces")):
        raise ValueError(f"a mesh must have vertices and faces, as a trimesh.Trimesh, got {type(mesh).__name__}")
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    faces = np.asarray(mesh.faces, dtype=np.int64)
    if not len(vertices) or not len(faces):
        raise ValueError(f"the mesh is empty: it has {len(vertices)} vertices and {len(faces)} faces")
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise ValueError(f"the mesh is not finite: vertex {row} is {vertices[row].tolist()}")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"the mesh's faces must be (f, 3) indices from 0 to {len(vertices) - 1}")
    size = np.ptp(vertices, axis=0).max()
    if size == 0.0:
        raise ValueError("the mesh has no extent: all its vertices are in one place")
    margin = checked_margin(0.01 * size if margin is None else margin)
    spacing = _spacing(np.ptp(vertices, axis=0), vertex_count)
    points = np.concatenate([vertices, surface_points(vertices, faces, 0.5 * spacing)])
    # any point of a face lies within 0.5 / sqrt(3) spacings of the points on it
    slack = 0.29 * spacing
    if len(points) > _MOST_POINTS:  # long, narrow faces: a point stands for those less than a diagonal away
        cell = np.floor((points - points.min(axis=0)) / (0.1 * spacing)).astype(np.int64)
        # numbered row by row: sorted in a fraction of the time of rows of three
        _, one = np.unique(np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1)), return_index=True)
        points, slack = points[one], slack + np.sqrt(3.0) * 0.1 * spacing
    return _cage_around_points(points, spacing, slack, margin, vertex_count, method, symmetry, progress)


def cage_around_field(
    field,
    vertex_count: int = 100,
    *,
    margin: float | None = None,
    threshold: float | None = None,
    method: str = "auto",
    symmetry: str | None = None,
    progress: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of a cage of `vertex_count` vertices (within 10 %) around what a field shows.
    `margin`: least distance to the visible voxels (boxes of a voxel's size around nodes), in voxels; None takes 1."""
    vertex_count = checked_count(vertex_count)
    require_field(field)
    voxel_size = np.broadcast_to(np.asarray(field.voxel_size, dtype=np.float64), 3)
    # by default a voxel, so that the cage holds all that trilinear interpolation spreads around visible nodes
    margin = checked_margin(1.0 if margin is None else margin) * voxel_size.max()
    points = visible_nodes(field, threshold)
    if not len(points):
        raise ValueError("the field shows nothing to put a cage around: lower the threshold")
    extent = np.maximum(np.ptp(points, axis=0), voxel_size)
    # a grid no finer than the field's, or its empty lines between nodes would count as gaps
    spacing = max(_spacing(extent, vertex_count), voxel_size.max())
    corner = 0.5 * float(np.linalg.norm(voxel_size))
    # a plane above which the nodes lie: the cage ends there, and leaves what the object stands on outside
    floor = getattr(field, "floor", None)
    return _cage_around_points(points, spacing, corner, margin, vertex_count, method, symmetry, progress, floor)


def _cage_around_points(
    points, spacing, slack, margin, vertex_count, method, symmetry, progress, floor: Plane | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The tightest cage of the methods asked for; slack: how far the object may lie off its points; floor: where it
    ends."""
    makers = {"shell": shell_cage, "voxel": voxel_cage}
    if method not in ("auto", *makers):
        raise ValueError(f"method must be 'auto', 'shell' or 'voxel', got {method!r}")
    if symmetry not in (None, "x", "y", "z"):
        raise ValueError(f"symmetry must be 'x', 'y' or 'z', the normal of the mirror plane, or None, got {symmetry!r}")
    if symmetry is not None and method == "shell":
        raise ValueError("symmetry needs method 'voxel' (or 'auto', which takes it then), not 'shell'")
    if method == "auto":
        makers = {"voxel": voxel_cage} if symmetry is not None else makers
    else:
        makers = {method: makers[method]}
    # in units of the object, about its middle, without the last digits: neither scale nor place may decide a tie
    middle, size = 0.5 * (points.min(axis=0) + points.max(axis=0)), float(np.ptp(points, axis=0).max()) or spacing
    points = np.round((points - middle) / size, 9)
    spacing, slack, margin = (float(np.round(length / size, 9)) for length in (spacing, slack + 2e-9 * size, margin))
    found, reasons = [], []
    for name, make in makers.items():
        _tell(progress, f"{name}: {len(points)} points, to be enclosed by {vertex_count} vertices")
        try:
            cage = make(points, spacing, slack, margin, vertex_count, symmetry)
        except ValueError as error:
            reasons.append(f"{name}: {error}")
            _tell(progress, f"{name}: none ({error})")
            continue
        cage = cage.with_vertices(middle + size * cage.vertices)
        if floor is not None:
            try:
                cage = cage.with_vertices(ended_at(floor, cage, middle + size * points, size * spacing))
            except ValueError as error:
                reasons.append(f"{name}: {error}")
                _tell(progress, f"{name}: none ({error})")
                continue
        _tell(progress, f"{name}: {len(cage.vertices)} vertices, volume {cage.volume:.4g}")
        found.append(cage)
    if not found:
        raise ValueError(
            f"no cage of {vertex_count} vertices could be made ({'; '.join(reasons)}): ask for more "
            "vertices, a smaller margin, or begin with Cage.box"
        )
    best = min(found, key=lambda cage: cage.volume)
    return best.vertices, best.faces


def _tell(progress, line: str) -> None:
    if progress:
        print(f"cage {line}", file=sys.stderr, flush=True)
