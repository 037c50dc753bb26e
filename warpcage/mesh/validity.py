"""Whether coordinates can be computed on a closed mesh."""

from __future__ import annotations

import weakref

import numpy as np

from ..core.names import counted
from ..errors import InputError
from .faces import column_cross, column_dot, face_edges
from .mesh import ClosedMesh
from .patches import faces_of

#: A face lower than this share of the mesh's size has no normal in float32.
DEGENERATE_HEIGHT = 1e-7

#: Smallest and largest size: the powers of others leave the range of floats.
SMALLEST_SIZE, LARGEST_SIZE = 1e-32, 1e32

#: Solid angles, of faces from points, that are worked out at once.
NUMBERS_AT_ONCE = 1 << 12

#: Odd factors of a hash over three integers: two places almost never share one.
_PLACE_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)

#: What `require_usable` found, empty for usable meshes. Meshes are immutable and compared by identity.
_known_problems: weakref.WeakKeyDictionary[ClosedMesh, str] = weakref.WeakKeyDictionary()


def degenerate_faces(mesh: ClosedMesh) -> np.ndarray:
    """The faces (k,) without area, ascending: lower than 1e-7 of the mesh's size, or naming a vertex twice; of polygons
    those with a triangle of the surface like this."""
    a, b, c = mesh.corners
    double_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.sqrt(np.maximum.reduce([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))]))
    flat = np.flatnonzero(double_area <= DEGENERATE_HEIGHT * mesh.size * longest)
    return faces_of(mesh, flat)


def coincident_vertices(mesh: ClosedMesh) -> np.ndarray:
    """Used vertices at the same place in float32: (k, 2), the first vertex at a place, then another one there."""
    used = mesh.topology.used_vertices
    local = (mesh.vertices[used] - mesh.bounds.mean(axis=0)).astype(np.float32)
    _, first, place = np.unique(local + 0.0, axis=0, return_index=True, return_inverse=True)
    leader = first[place.reshape(-1)]
    extra = np.flatnonzero(leader != np.arange(len(used)))
    return np.stack([used[leader[extra]], used[extra]], axis=1)


def winding_numbers(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Winding numbers (n,) of a closed mesh about points (n, 3), in float64 on the host: 1 inside, 0 outside.
    For a few points only."""
    total = np.zeros(len(points))
    step = max(1, NUMBERS_AT_ONCE // max(1, len(faces)))
    for first in range(0, len(points), step):
        side = vertices.T[:, :, None] - points[first : first + step].T[:, None]  # (3, v, n)
        length = np.sqrt(column_dot(side, side))
        a, b, c = (side.take(faces[:, k], axis=1) for k in range(3))
        la, lb, lc = (length.take(faces[:, k], axis=0) for k in range(3))
        triple = column_dot(a, column_cross(b, c))  # solid angles / 4 pi (van Oosterom and Strackee 1983)
        below = la * lb * lc + column_dot(a, b) * lc + column_dot(b, c) * la + column_dot(c, a) * lb
        total[first : first + step] = 2.0 * np.arctan2(triple, below).sum(axis=0) / (4.0 * np.pi)
    return total


def inward_parts(mesh: ClosedMesh) -> np.ndarray:
    """Connected parts (k,) of a closed mesh, ascending, that look inward without being a cavity inside another part, or
    are flat."""
    volumes, surface = mesh.part_volumes(), mesh.surface
    parts, flat = surface.topology.parts, _flat_parts(mesh, volumes)
    wrong = []
    for part in np.flatnonzero((volumes <= 0.0) | flat):
        inside = surface.vertices[surface.faces[parts == part][:1, 0]]
        others = surface.faces[parts != part]
        if flat[part] or not len(others) or winding_numbers(inside, surface.vertices, others)[0] < 0.5:
            wrong.append(part)
    return np.asarray(wrong, dtype=np.int64)


def doubled_parts(mesh: ClosedMesh) -> np.ndarray:
    """Connected parts (k,) of a usable mesh, ascending, that look outward and lie within others that do."""
    if mesh.topology.part_count == 1:
        return np.zeros(0, np.int64)
    surface, doubled = mesh.surface, []
    parts = surface.topology.parts
    for part in np.flatnonzero(mesh.part_volumes() > 0.0):
        others = surface.faces[parts != part]
        corners = surface.vertices[np.unique(surface.faces[parts == part])]
        if all((winding_numbers(each, surface.vertices, others) > 0.5).all() for each in (corners[:1], corners)):
            doubled.append(part)
    return np.asarray(doubled, dtype=np.int64)


def _flat_parts(mesh: ClosedMesh, volumes: np.ndarray) -> np.ndarray:
    """Which connected parts of these volumes, (k,) bool, are so thin that rounding decides the sign of their volume."""
    u, v = face_edges(mesh.surface)
    normal = column_cross(u, v)
    areas = 0.5 * np.bincount(mesh.surface.topology.parts, weights=np.sqrt(column_dot(normal, normal)))
    return np.abs(volumes) <= 0.5 * DEGENERATE_HEIGHT * mesh.size * areas


def looks_usable(mesh: ClosedMesh) -> bool:
    """Whether a quick look finds nothing wrong: no vertices that may share a place, no low faces, no inward parts.
    For triangles whose topology has no problem; almost every usable pose passes, False needs a closer look."""
    topology = mesh.topology
    local = mesh.vertices - mesh.bounds.mean(axis=0)
    keys = (local.astype(np.float32) + np.float32(0.0)).view(np.uint32).astype(np.uint64) @ _PLACE_FACTORS
    keys = np.sort(keys if len(keys) == len(topology.used_vertices) else keys[topology.used_vertices])
    if (keys[1:] == keys[:-1]).any():
        return False
    u, v = face_edges(mesh)
    normal = column_cross(u, v)
    longest = np.maximum.reduce([column_dot(u, u), column_dot(v, v), column_dot(u - v, u - v)])
    if (column_dot(normal, normal) <= (DEGENERATE_HEIGHT * mesh.size) ** 2 * longest).any():
        return False
    cones = column_dot(local.T.take(mesh.faces[:, 0], axis=1), normal)
    cones -= 1.5 * DEGENERATE_HEIGHT * mesh.size * np.sqrt(column_dot(normal, normal))  # flat ones, see `_flat_parts`
    if topology.part_count == 1:
        return cones.sum() > 0.0
    return bool((np.bincount(topology.parts, weights=cones) > 0.0).all())


def first_problem(mesh: ClosedMesh) -> str:
    """What makes a mesh unusable: one line that follows its name, "is open: ..."; empty for a usable mesh."""
    if len(mesh.topology.open_edges) and (count := len(coincident_vertices(mesh))):
        return f"{mesh.topology.problem}, or merge the {counted(count, 'vertex', 'vertices')} at the place of another"
    problem = mesh.topology.problem or size_problem(mesh) or mesh.surface.topology.problem
    return problem or ("" if looks_usable(mesh.surface) else first_geometric_problem(mesh))


def size_problem(mesh: ClosedMesh) -> str:
    """What is wrong with the size of a mesh, as `first_problem`; empty for one without any size, which has other
    problems."""
    with np.errstate(over="ignore"):  # corners farther apart than the largest number
        size = mesh.size
    if size == 0.0 or SMALLEST_SIZE <= size <= LARGEST_SIZE:
        return ""
    return (
        f"has a size of {size:.3g} units: {SMALLEST_SIZE:g} to {LARGEST_SIZE:g} can be worked with, scale it to "
        "another unit"
    )


def first_geometric_problem(mesh: ClosedMesh) -> str:
    """What makes a mesh unusable whose topology has no problem, as `first_problem`."""
    coincident = coincident_vertices(mesh)
    if len(coincident):
        a, b = coincident[0]
        return (
            f"has {counted(len(coincident), 'vertex', 'vertices')} at the place of another, the first "
            f"{b} at that of {a}: merge or move them"
        )
    degenerate = degenerate_faces(mesh)
    if len(degenerate):
        return f"has degenerate faces: {len(degenerate)} without area, the first {degenerate[0]}: remove or widen them"
    if len(pairs := coincident_vertices(mesh.surface)):
        one, two = (faces_of(mesh, np.flatnonzero((mesh.surface.faces == k).any(axis=1))[:1])[0] for k in pairs[0])
        return f"has faces that touch in the middle, or on their edges, the first {one} and {two}: move them apart"
    inward = inward_parts(mesh)
    if len(inward):
        face, volumes = int(np.flatnonzero(mesh.topology.parts == inward[0])[0]), mesh.part_volumes()
        if _flat_parts(mesh, volumes)[inward[0]]:
            return f"is flat: the part with face {face} encloses no volume: move its sides apart"
        return (
            f"looks inward: the part with face {face} encloses volume {volumes[inward[0]]:.4g}: flip "
            "its faces to be anticlockwise seen from outside, or mirror it back where a pose mirrored it"
        )
    return ""


def require_usable(mesh: ClosedMesh, name: str = "cage") -> None:
    """Refuse a mesh on which coordinates cannot be computed, see `Cage.require_usable`; name: begins the message."""
    if not hasattr(mesh, "topology"):
        raise InputError(f"{name} must be a Cage, got {type(mesh).__name__}")
    problem = _known_problem(mesh)
    if problem:
        raise InputError(f"{name} {problem}")


def is_usable(mesh: ClosedMesh) -> bool:
    """Whether `require_usable` takes a mesh."""
    return not _known_problem(mesh)


def _known_problem(mesh: ClosedMesh) -> str:
    """`first_problem`, remembered."""
    problem = _known_problems.get(mesh)
    if problem is None:
        problem = _known_problems[mesh] = first_problem(mesh)
    return problem


def require_covered_once(mesh: ClosedMesh, kind: str, name: str = "cage") -> None:
    """Refuse a usable mesh with a part within another, for a kind of coordinates that sums over all faces."""
    doubled = doubled_parts(mesh)
    if len(doubled):
        face = int(np.flatnonzero(mesh.topology.parts == doubled[0])[0])
        raise InputError(
            f"{name} has parts inside each other that both look outward, the first with face {face}: {kind} "
            "coordinates do not hold there; remove it, flip its faces to make it a cavity, or take harmonic ones"
        )
