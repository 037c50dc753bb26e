"""What is wrong with a cage, and what it encloses: the first problem in a line, or all of them in a CageReport."""

from __future__ import annotations

import numpy as np

from ..coordinates.deform import deform_points
from ..field.selection import visible_nodes
from ..mesh.closed_mesh import ClosedMesh
from ..mesh.containment import inside_mesh
from ..mesh.intersections import intersecting_faces
from ..mesh.match import matched_vertices
from ..mesh.usable import coincident_vertices, degenerate_faces, first_problem, inward_parts
from .report import COST_RESOLUTION, CageReport, PoseReport


def check_cage(cage: ClosedMesh, field=None, mesh=None, pose=None) -> CageReport:
    """Examine a cage: see `Cage.check`. Raises ValueError for a mesh or a field with nothing in it, or a pose that does
    not match.

    Enclosure is only defined for a usable cage; it is 0 otherwise.
    """
    topology = cage.topology
    problem = first_problem(cage)
    shares, outside, objects = {"mesh": None, "field": None}, [], []
    if mesh is not None:
        points = np.asarray(mesh.vertices, dtype=np.float64)
        shares["mesh"] = _enclosed(cage, points, problem, "mesh has no vertices", outside)
        objects.append(points)
    if field is not None:
        points = visible_nodes(field)
        shares["field"] = _enclosed(cage, points, problem, "field has no visible voxels", outside)
        objects.append(points)
    if pose is not None:
        pose = check_pose(cage, pose) if not problem else None
    closed = topology.closed and topology.manifold
    return CageReport(
        vertex_count=len(cage.vertices), face_count=len(cage.faces), part_count=topology.part_count,
        genus=topology.genus, volume=cage.volume, size=cage.size, convexity=_convexity(cage),
        open_edges=tuples(topology.open_edges), crowded_edges=tuples(topology.crowded_edges),
        pinched_vertices=tuples(topology.pinched_vertices), clashing_edges=tuples(topology.clashing_edges),
        degenerate_faces=tuples(degenerate_faces(cage)), coincident_vertices=tuples(coincident_vertices(cage)),
        inward_parts=tuples(inward_parts(cage)) if closed else (),
        intersecting_faces=tuples(intersecting_faces(cage.vertices, cage.faces)),
        unused_vertices=tuples(topology.unused_vertices),
        mesh_enclosed=shares["mesh"], field_enclosed=shares["field"],
        leaking_faces=_nearest_faces(cage, outside), hull_ratio=_hull_ratio(cage, objects),
        lattice_nodes=_lattice_nodes(cage), notes=tuple(getattr(field, "notes", ())), problem=problem, pose=pose,
    )  # fmt: skip


def _enclosed(cage, points, problem, complaint, outside) -> float:
    """Share of points inside; those outside are added to a list."""
    if not len(points):
        raise ValueError(complaint)
    if problem:
        return 0.0
    inside = inside_mesh(points, cage)
    outside.append(points[~inside])
    return float(np.mean(inside))


def _nearest_faces(cage, outside, most: int = 500) -> tuple:
    """(face, count) by the centre nearest to each point outside, the most frequent first; an even choice of points."""
    points = np.concatenate(outside) if outside else np.zeros((0, 3))
    if not len(points):
        return ()
    points = points[:: -(-len(points) // most)]
    centres = cage.vertices[cage.faces].mean(axis=1)
    nearest = np.argmin(((points[:, None] - centres[None]) ** 2).sum(axis=2), axis=1)
    faces, counts = np.unique(nearest, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return tuples(np.stack([faces[order], counts[order]], axis=1))


def _lattice_nodes(cage) -> int:
    """Nodes of a lattice of COST_RESOLUTION cells along the longest side, with its margins; 0 for no extent."""
    if cage.size == 0.0:
        return 0
    return int(np.prod(np.ceil(np.ptp(cage.bounds, axis=0) / cage.size * COST_RESOLUTION) + 6))


def _convexity(cage) -> float:
    """Volume over that of the convex hull; 0 for a flat cage."""
    hull = _hull_volume(np.concatenate(cage.corners))
    return cage.volume / hull if hull > 0.0 else 0.0


def _hull_ratio(cage, objects) -> float | None:
    """Volume over that of the convex hull of points (n, 3); None without points, or for flat ones."""
    hull = _hull_volume(np.concatenate(objects)) if objects else 0.0
    return cage.volume / hull if hull > 0.0 else None


def _hull_volume(points) -> float:
    extent = np.ptp(points, axis=0)
    if len(points) < 4 or extent.min() <= 1e-12 * extent.max():
        return 0.0
    import trimesh

    try:
        return float(trimesh.convex.convex_hull(points).volume)
    except Exception:  # all in one plane, as its solver says in its own way
        return 0.0


def tuples(array) -> tuple:
    """Rows of an array as (tuples of) plain numbers."""
    return tuple(tuple(row) if isinstance(row, list) else row for row in np.asarray(array).tolist())


#: Samples inside the posed cage, about.
_SAMPLES = 3000

#: Distance of the points of a finite difference, as a share of the size: float32 maps err by about 1e-6 of it.
_DIFFERENCE = 2e-3


def check_pose(rest: ClosedMesh, pose: ClosedMesh) -> PoseReport:
    """Examine a pose (in any order that `Cage.match` takes) of a usable cage. Raises ValueError where it does not fit.

    The map posed -> rest is sampled on a grid inside the posed cage; its Jacobian J by forward differences. A sample is
    inverted where det J <= 0; elsewhere the pose stretches by 1 / s for each singular value s of J.
    """
    pose = rest.with_vertices(matched_vertices(rest, pose))
    problem = first_problem(pose)
    folds = tuples(intersecting_faces(pose.vertices, pose.faces))
    ratio = pose.volume / rest.volume
    if problem:
        return PoseReport(0, ratio, 0.0, 0.0, 0.0, 0.0, folds, problem)

    points, step = _grid(pose), _DIFFERENCE * pose.size
    offsets = np.concatenate([np.zeros((1, 3)), step * np.eye(3)])
    stencil = points[:, None] + offsets
    stencil = stencil[inside_mesh(stencil.reshape(-1, 3), pose).reshape(-1, 4).all(axis=1)]
    if not len(stencil):
        return PoseReport(0, ratio, 0.0, 0.0, 1.0, 1.0, folds, problem)
    mapped = deform_points(stencil.reshape(-1, 3), pose, rest, coordinates="mean_value").reshape(-1, 4, 3)
    jacobian = (mapped[:, 1:] - mapped[:, :1]) / step
    inverted = np.linalg.det(jacobian) <= 0.0
    singular = np.linalg.svd(jacobian[~inverted], compute_uv=False)
    stretch = 1.0 / np.clip(singular, 1e-6, 1e6) if len(singular) else np.zeros((1, 3))
    return PoseReport(
        sample_count=len(stencil), volume_ratio=ratio, inverted_share=float(inverted.mean()),
        outside_share=float(np.mean(~inside_mesh(mapped[:, 0], rest))),
        least_stretch=float(stretch.min()), largest_stretch=float(stretch.max()),
        intersecting_faces=folds, problem=problem,
    )  # fmt: skip


def _grid(cage: ClosedMesh) -> np.ndarray:
    """Points (n, 3) of a grid over the cage's bounding box, off its planes of symmetry."""
    lower, upper = cage.bounds
    spacing = (cage.volume / _SAMPLES) ** (1.0 / 3.0)
    axes = [
        np.arange(low + 0.37 * min(spacing, high - low), high, spacing) for low, high in zip(lower, upper, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
