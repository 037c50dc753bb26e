"""What is wrong with a cage, and what it encloses: the first problem in a line, or all of them in a CageReport."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .cage_intersections import intersecting_faces
from .cage_report import COST_RESOLUTION, CageReport
from .face_geometry import column_cross, column_dot, face_edges

if TYPE_CHECKING:
    from .cage import Cage

#: A face lower than this share of the cage's size has no normal in float32.
DEGENERATE_HEIGHT = 1e-7

#: Odd numbers that turn three words into one which is all but surely another for another place.
_PLACE_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


def check_cage(cage: Cage, field=None, mesh=None, pose=None) -> CageReport:
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
        from .cage_generation import visible_nodes

        points = visible_nodes(field)
        shares["field"] = _enclosed(cage, points, problem, "field has no visible voxels", outside)
        objects.append(points)
    if pose is not None:
        from .pose_check import check_pose

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
    inside = cage.contains(points)
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


def degenerate_faces(cage: Cage) -> np.ndarray:
    """Indices of the faces whose height is below 1e-7 of the cage's size, or that name a vertex twice."""
    a, b, c = cage.corners
    double_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.sqrt(np.maximum.reduce([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))]))
    return np.flatnonzero(double_area <= DEGENERATE_HEIGHT * cage.size * longest)


def coincident_vertices(cage: Cage) -> np.ndarray:
    """(k, 2): used vertices that are the same in float32, each with the first of its place."""
    used = cage.topology.used_vertices
    local = (cage.vertices[used] - cage.bounds.mean(axis=0)).astype(np.float32)
    _, first, place = np.unique(local + 0.0, axis=0, return_index=True, return_inverse=True)
    leader = first[place.reshape(-1)]
    extra = np.flatnonzero(leader != np.arange(len(used)))
    return np.stack([used[leader[extra]], used[extra]], axis=1)


def winding_numbers(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Winding number of a closed mesh about points (n, 3), float64 on the host: (n,). For a few points only.

    Sum of signed solid angles over 4 pi (van Oosterom and Strackee 1983, "The solid angle of a plane triangle").
    """
    total = np.zeros(len(points))
    for first in range(0, len(points), 4096):
        a, b, c = (vertices[faces[:, k]][None] - points[first : first + 4096, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(side, axis=2) for side in (a, b, c))
        triple = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
        below = (la * lb * lc + np.einsum("nfi,nfi->nf", a, b) * lc + np.einsum("nfi,nfi->nf", b, c) * la
                 + np.einsum("nfi,nfi->nf", c, a) * lb)
        total[first : first + 4096] = 2.0 * np.arctan2(triple, below).sum(axis=1) / (4.0 * np.pi)
    return total


def inward_parts(cage: Cage) -> np.ndarray:
    """Indices of connected parts that look inward without being a cavity inside another part (closed cages only)."""
    volumes = cage.part_volumes()
    parts = cage.topology.parts
    wrong = []
    for part in np.flatnonzero(volumes <= 0.0):
        inside = cage.vertices[cage.faces[parts == part][:1, 0]]
        others = cage.faces[parts != part]
        if volumes[part] == 0.0 or not len(others) or winding_numbers(inside, cage.vertices, others)[0] < 0.5:
            wrong.append(part)
    return np.asarray(wrong, dtype=np.int64)


def looks_usable(cage: Cage) -> bool:
    """Whether a cage of good topology passes at once: no vertices that may share a place, no low faces, all parts look
    outward. A pose of a known cage is all but always done with this; False says that a closer look is needed."""
    topology = cage.topology
    local = cage.vertices - cage.bounds.mean(axis=0)
    keys = (local.astype(np.float32) + np.float32(0.0)).view(np.uint32).astype(np.uint64) @ _PLACE_FACTORS
    keys = np.sort(keys if len(keys) == len(topology.used_vertices) else keys[topology.used_vertices])
    if (keys[1:] == keys[:-1]).any():
        return False
    u, v = face_edges(cage)
    normal = column_cross(u, v)
    longest = np.maximum.reduce([column_dot(u, u), column_dot(v, v), column_dot(u - v, u - v)])
    if (column_dot(normal, normal) <= (DEGENERATE_HEIGHT * cage.size) ** 2 * longest).any():
        return False
    cones = column_dot(local.T[:, cage.faces[:, 0]], normal)
    if topology.part_count == 1:
        return cones.sum() > 0.0
    return bool((np.bincount(topology.parts, weights=cones) > 0.0).all())


def first_problem(cage: Cage) -> str:
    """What makes the cage unusable, in one line without its name; empty for a usable cage."""
    if cage.topology.problem:
        return cage.topology.problem
    return "" if looks_usable(cage) else first_geometric_problem(cage)


def first_geometric_problem(cage: Cage) -> str:
    """The same of a cage whose topology is good."""
    topology = cage.topology
    coincident = coincident_vertices(cage)
    if len(coincident):
        a, b = coincident[0]
        return (f"has {len(coincident)} vertices at the place of another, the first {b} at that of {a}: "
                "merge or move them")
    degenerate = degenerate_faces(cage)
    if len(degenerate):
        return f"has degenerate faces: {len(degenerate)} without area, the first {degenerate[0]}: remove or widen them"
    inward = inward_parts(cage)
    if len(inward):
        face = int(np.flatnonzero(topology.parts == inward[0])[0])
        return (f"looks inward: the part with face {face} encloses volume {cage.part_volumes()[inward[0]]:.4g}: flip "
                "its faces to be anticlockwise seen from outside")
    return ""
