"""Recover the vertex order of a posed cage whose file was written with vertices or faces in another order."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..core.arrays import is_device_array
from ..errors import InputError
from .mesh import ClosedMesh, Mesh, MeshTopology, connected_parts, require_mesh
from .patches import edges_of
from .surface import PolygonFaces


def posed_mesh(rest: Mesh, pose: Any, what: str) -> Mesh:
    """A pose as callers give it: a mesh with the faces of `rest`, or vertices (v, 3) of any library in its order.
    `what` begins the message where it is neither."""
    if isinstance(pose, np.ndarray) or is_device_array(pose):
        return rest.with_vertices(pose)
    require_mesh(pose, what, "a Cage or an array of its vertices")
    require_same_faces(rest, pose)
    return with_faces_of(rest, pose)


def with_faces_of(rest: Mesh, pose: Mesh) -> Mesh:
    """A pose of the same faces, refined as those of `rest` are: the cage at rest says what is between corners."""
    return pose if pose.polygon_faces is rest.polygon_faces else rest.with_vertices(pose.vertices)


def require_same_faces(rest: ClosedMesh, deformed: ClosedMesh) -> None:
    """Refuse two meshes whose faces are not the same in the same order, and say whether `Cage.match` helps."""
    if rest.faces is deformed.faces:
        return
    same_count = len(rest.vertices) == len(deformed.vertices)
    if same_count and _are_same(rest, deformed):
        return
    try:
        matched_vertices(rest, deformed)
    except ValueError as error:
        raise InputError(str(error).replace("the pose", "the deformed cage", 1)) from None
    if same_count and (_same_triangles(rest, deformed) or _same_polygons(rest, deformed)):
        pairs = enumerate(zip(rest.polygons, deformed.polygons, strict=False))
        first, own, other = next((k, list(one), list(two)) for k, (one, two) in pairs if one != two)
        raise InputError(
            f"the deformed cage has the rest cage's faces in another order, from face {first} "
            f"({other}, not {own}): pass rest.match(deformed)"
        )
    what = f"faces on {len(deformed.vertices)} vertices, not on {len(rest.vertices)}"
    if same_count:
        what = "vertices in another order"
    raise InputError(f"the deformed cage has the rest cage's {what}: pass rest.match(deformed)")


#: Walks replayed at once: bounds the memory for large, regular cages.
_WALKS = 256

#: The best match must have moved the vertices less than this share of what the second best has.
_CLEARLY_BETTER = 0.98

#: A pose moves the vertices that it has in the cage's order by less than this share of what another order would.
_BY_CHANCE = 0.05


def matched_vertices(rest: ClosedMesh, pose: ClosedMesh) -> np.ndarray:
    """The vertices (v, 3) float64 of a pose in the order of its rest mesh; unused ones of `rest` stay where they are.
    A ValueError begins with "the pose ", and says how the two differ."""
    return in_order(rest, pose.vertices, matched_order(rest, pose))


def in_order(rest: ClosedMesh, vertices: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Vertices (v, 3) of a pose, or (n, 3) of a frame of it, by a `matched_order`."""
    return np.where((order < 0)[:, None], rest.vertices, vertices[order])


def _are_same(rest: ClosedMesh, deformed: ClosedMesh) -> bool:
    """Whether two meshes have the same faces in the same order, or one has the polygons of the other cut somehow."""
    one, two = rest.polygon_faces, deformed.polygon_faces
    if np.array_equal(rest.faces, deformed.faces):
        return True
    if one is not None and two is not None:
        return one.same_as(two)
    return _same_polygons(rest, deformed)


def _same_polygons(one: ClosedMesh, two: ClosedMesh) -> bool:
    """Whether one of two meshes has polygons, which the other has in any order, whole or cut along any diagonals."""
    return any(
        outer.polygon_faces is not None and _are_cut(outer.polygon_faces, inner)
        for outer, inner in ((one, two), (two, one))
    )


def _are_cut(polygons: PolygonFaces, mesh: ClosedMesh) -> bool:
    """Whether the faces of a mesh of the same vertices are polygons, whole or cut along any diagonals."""
    if polygons.triangles.shape != mesh.faces.shape:
        return False
    count, (first, second, _) = polygons.vertex_count, polygons.fanned().T
    start, end, owner = edges_of(mesh, np.arange(mesh.face_count))
    keys, outline = start * count + end, first * count + second
    order = np.argsort(outline)
    place = order[np.minimum(np.searchsorted(outline[order], keys), len(outline) - 1)]
    on_outline = outline[place] == keys
    diagonals, back = keys[~on_outline], (end * count + start)[~on_outline]
    one, two = np.argsort(diagonals), np.argsort(back)
    if not np.isin(outline, keys).all() or not np.array_equal(diagonals[one], back[two]):
        return False
    # what diagonals hold together is a polygon: its outline is that of one, and there are as many
    across = owner[~on_outline]
    part, parts = connected_parts(mesh.face_count, across[one], across[two])
    pairs = np.unique(np.stack([part[owner[on_outline]], polygons.owner[place[on_outline]]], axis=1), axis=0)
    return len(pairs) == parts == len(polygons.sizes)


def matched_order(rest: ClosedMesh, pose: ClosedMesh) -> np.ndarray:
    """(v,) numbers of a pose's vertices in the order of its rest mesh, -1 for unused ones; errors as above."""
    # Also accepts faces in another order or begun at another corner, quads cut along other diagonals, and vertices in
    # any order or repeated at one place, as programs write that store one normal for each corner.
    own, same_count = np.arange(len(pose.vertices)), len(rest.vertices) == len(pose.vertices)
    polygons = rest.polygon_faces is not None or pose.polygon_faces is not None
    if same_count and (
        np.array_equal(rest.faces, pose.faces)
        or (_same_polygons(rest, pose) if polygons else _same_triangles(rest, pose))
    ):
        return own
    # triangles say little of the quads that they were: what fits by chance moves the vertices farther
    in_place = same_count and not polygons and _same_patches(rest, pose)
    try:
        order = _found_order(rest, pose)
    except InputError:
        if in_place:
            return own
        raise
    if same_count:
        here, there = (float(((in_order(rest, pose.vertices, k) - rest.vertices) ** 2).sum()) for k in (own, order))
        if in_place and here <= there:
            return own
        if here < _BY_CHANCE * there:
            raise InputError(
                "the pose has the cage's vertices in their order, but other faces between them: save both with the "
                "same faces"
            )
    return order


def _found_order(rest: ClosedMesh, pose: ClosedMesh) -> np.ndarray:
    """`matched_order` by what is connected to what."""
    vertices, faces = pose.vertices, pose.faces.astype(np.int64)
    repeats = _used_count(faces) > _used_count(rest.faces)
    if repeats:
        faces = _welded(vertices, faces)
    complaint = _counts_differ(rest, pose, faces)
    if complaint:
        raise InputError(f"the pose {complaint}")
    if rest.topology.closed and rest.volume * pose.volume < 0.0:
        raise InputError("the pose has the cage's faces turned inside out: flip its normals (it was mirrored)")
    if rest.polygon_faces is None or pose.polygon_faces is None:
        order = _correspondence(_Mesh.of(rest.vertices, rest.faces), _Mesh.of(vertices, faces))
    else:  # without diagonals, which depend on the corner that a face begins at
        order = _correspondence(_fanned(rest, rest.polygon_faces), _fanned(pose, pose.polygon_faces, repeats))
    if order is None and (rest.polygon_faces is None) != (pose.polygon_faces is None):
        raise InputError(
            "the pose is another mesh than the cage, or has its vertices in another order and its quads cut otherwise: "
            "save it with the faces of the cage, or with its vertices in the cage's order"
        )
    if order is None:
        raise InputError(f"the pose {_difference(rest, vertices, faces)}")
    matched = np.full(len(rest.vertices), -1)
    used = np.unique(rest.faces)
    matched[used] = order[used]
    return matched


def _same_triangles(one: ClosedMesh, two: ClosedMesh) -> bool:
    """Whether triangles of the same vertices are the same but for their order and the corner that each begins at."""
    return one.faces.shape == two.faces.shape and not len(_cut(one.faces, two.faces)) + len(_cut(two.faces, one.faces))


def _same_patches(rest: ClosedMesh, pose: ClosedMesh) -> bool:
    """Whether triangles of the same vertices cover the same polygons: equal but for order and for diagonals."""
    if rest.faces.shape != pose.faces.shape:
        return False
    left, right = _cut(rest.faces, pose.faces), _cut(pose.faces, rest.faces)
    outline = _outline(left)
    if len(left) != len(right) or not np.array_equal(outline, _outline(right)):
        return False
    # a vertex within a patch could be that of another: only polygons, whose vertices all lie on their outline
    on_outline = np.isin(left, outline).all() and np.isin(right, outline).all()
    parts = MeshTopology(len(rest.vertices), left).part_count  # a ring, which may fit by chance, has an edge a triangle
    return bool(on_outline) and len(left) == len(outline) - 2 * parts


def _cut(faces: np.ndarray, others: np.ndarray) -> np.ndarray:
    """The faces that are not among the others, whatever corner they begin at."""
    count = int(max(faces.max(), others.max())) + 1
    keys, other = (np.ravel_multi_index(tuple(_turned(each).T), (count,) * 3) for each in (faces, others))
    return faces[~np.isin(keys, other)]


def _outline(faces: np.ndarray) -> np.ndarray:
    """Directed edges (k, 2) of a patch that no face of it walks the other way, sorted."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2).astype(np.int64)
    keys, back = (edges[:, k] * (1 << 31) + edges[:, 1 - k] for k in (0, 1))
    edges = edges[~np.isin(keys, back)]
    return edges[np.lexsort(edges.T)]


def _turned(faces: np.ndarray) -> np.ndarray:
    """Faces with the lowest index first, direction kept."""
    faces = np.asarray(faces, dtype=np.int64)
    return np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)


def _used_count(faces: np.ndarray) -> int:
    return len(np.unique(faces))


def _part_count(faces: np.ndarray) -> int:
    label, _ = connected_parts(int(faces.max()) + 1, faces[:, [0, 1]].reshape(-1), faces[:, [1, 2]].reshape(-1))
    return len(np.unique(label[faces[:, 0]]))


def _welded(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces that name the first of all vertices at exactly one place."""
    _, first, place = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)
    faces = first[place.reshape(-1)][faces]
    return faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def _counts_differ(rest: ClosedMesh, pose: ClosedMesh, faces: np.ndarray) -> str:
    """How the numbers of vertices or faces differ, empty where they agree; faces: those of the pose, welded or not."""
    if _used_count(faces) != _used_count(rest.faces):
        merged = _used_count(pose.faces) - _used_count(faces)
        hint = f" ({merged} more at the places of others)" if merged else ""
        parts, own = (_part_count(each) for each in (faces, rest.faces))
        advice = (
            "pose the cage itself, without adding or removing vertices"
            if parts <= own
            else f"it has {parts} parts, the cage {own}: save the cage alone, without other objects"
        )
        return f"has {_used_count(faces)} vertices{hint}, the cage {_used_count(rest.faces)}: {advice}"
    if len(faces) != len(rest.faces):
        return f"has {len(faces)} faces, the cage {len(rest.faces)}: pose the cage itself, without editing faces"
    return ""


def _difference(rest: ClosedMesh, vertices: np.ndarray, faces: np.ndarray) -> str:
    """Why meshes with equal numbers of vertices and faces do not match."""
    ours, theirs = _edge_keys(rest.faces), _edge_keys(faces)
    differing = np.setdiff1d(theirs, ours)
    if len(rest.vertices) == len(vertices) and 0 < len(differing) < 0.5 * len(ours):
        a, b = divmod(int(differing[0]), 1 << 32)
        return (
            f"has {len(differing)} of {len(ours)} edges that the cage does not have, the first from vertex {a} to {b}: "
            "save both with the same faces"
        )
    own, posed = (np.sort(np.bincount(each.reshape(-1))[np.unique(each)]) for each in (rest.faces, faces))
    if not np.array_equal(own, posed):
        return "has other numbers of faces around its vertices than the cage: it is another mesh"
    return "is connected in another way than the cage, whatever the order of its vertices: it is another mesh"


def _edge_keys(faces: np.ndarray) -> np.ndarray:
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2).astype(np.int64)
    return np.unique((edges.min(axis=1) << 32) + edges.max(axis=1))


@dataclasses.dataclass(frozen=True)
class _Mesh:
    """Half-edge 3 i + k starts at corner k of face i; twin (3 f + 1,) leads across the edge, to 3 f if it is open."""

    vertices: np.ndarray
    faces: np.ndarray
    twin: np.ndarray
    color: np.ndarray  # (v,) uint64, equal for vertices that look the same up to a few edges away
    part: np.ndarray  # (f,)
    part_count: int

    @classmethod
    def of(cls, vertices: np.ndarray, faces: np.ndarray, middles: int = 0) -> _Mesh:
        """middles: how many of the vertices, the last ones, are none of the mesh, but of the middles of its faces."""
        faces = np.asarray(faces, dtype=np.int64)
        start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
        keys, back = start * len(vertices) + end, end * len(vertices) + start
        order = np.argsort(keys, kind="stable")
        place = np.minimum(np.searchsorted(keys[order], back), len(keys) - 1)
        twin = np.where(keys[order][place] == back, order[place], len(keys))
        has = np.flatnonzero(twin < len(keys))
        part, count = connected_parts(len(faces), has // 3, twin[has] // 3)
        colors = _colors(len(vertices), start, end, middles)
        return cls(vertices, faces, np.append(twin, len(keys)), colors, part, count)


def _fanned(mesh: ClosedMesh, polygons: PolygonFaces, repeats: bool = False) -> _Mesh:
    """A mesh of polygons as triangles around their middles; repeats: with vertices at one place made one."""
    middles = np.add.reduceat(mesh.vertices[polygons.corners], polygons.starts, axis=0) / polygons.sizes[:, None]
    vertices, faces = np.concatenate([mesh.vertices, middles]), polygons.fanned()
    return _Mesh.of(vertices, _welded(vertices, faces) if repeats else faces, len(middles))


def _colors(count: int, start: np.ndarray, end: np.ndarray, middles: int, rounds: int = 6) -> np.ndarray:
    """(v,) uint64 by colour refinement (Weisfeiler and Leman 1968) over neighbours, the same for any numbering.
    The last ones, so many `middles`, look like no other."""
    color = np.bincount(start, minlength=count).astype(np.uint64)
    color[count - middles :] += np.uint64(1 << 32)
    for _ in range(rounds):
        total = np.zeros(count, dtype=np.uint64)
        np.add.at(total, start, _mixed(color)[end])
        np.add.at(total, end, _mixed(color + np.uint64(7))[start])
        color = _mixed(color ^ (total * np.uint64(0x9E3779B97F4A7C15)))
    return color


def _mixed(value: np.ndarray) -> np.ndarray:
    value = (value ^ (value >> np.uint64(31))) * np.uint64(0xBF58476D1CE4E5B9)
    return (value ^ (value >> np.uint64(29))) * np.uint64(0x94D049BB133111EB)


def _correspondence(rest: _Mesh, pose: _Mesh) -> np.ndarray | None:
    """(v,) vertex of the pose for each used vertex of the rest mesh, or None."""
    # A map between connected, consistently wound meshes that keeps faces is fixed by where it sends one half-edge: a
    # walk over the cage's faces is replayed from every half-edge of the pose at once; what arrives without a
    # contradiction is a match. Symmetric cages have several: the vertices that moved least decide, a tie is an error.
    order = np.full(len(rest.vertices), -1, dtype=np.int64)
    found = []
    for part in range(rest.part_count):
        walk = _walk(rest, np.flatnonzero(rest.part == part))
        for other in range(pose.part_count):
            if np.count_nonzero(pose.part == other) == len(walk[0]):
                found += [(*costs, part, other, images) for costs, images in _replayed(rest, pose, walk, other)]
    found.sort(key=lambda each: each[0])  # parts take their best partner, the surest first
    taken, partner = set(), {}
    for cost, unlike, part, other, images in found:
        if part in partner or other in taken:
            continue
        rest_of = [each for each in found if each[2] == part and each[4] is not images and each[3] not in taken]
        ties = [cost >= _CLEARLY_BETTER * each[0] for each in rest_of if each[3] != other]
        # laid over one part, a move or a scale of all is the same in each way
        ties += [unlike >= _CLEARLY_BETTER * each[1] for each in rest_of if each[3] == other]
        if any(ties):
            raise InputError(
                "the pose fits the cage in several ways that move its vertices equally far: save it with "
                "its vertices in the cage's order"
            )
        taken.add(other)
        partner[part] = images
    if len(partner) < rest.part_count:
        return None
    for vertices, images in partner.values():
        order[vertices] = images
    return order


def _walk(mesh: _Mesh, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An order of the part's faces in which each is entered over an edge of an earlier one: the half-edge (n,) over
    which each is entered, and where it came from (n, 2): place in this list and corner."""
    corner = mesh.color[mesh.faces[faces]].reshape(-1)
    kind = _mixed(corner * np.uint64(3) + np.roll(mesh.color[mesh.faces[faces]], -1, axis=1).reshape(-1))
    _, which, count = np.unique(kind, return_inverse=True, return_counts=True)
    first = int(np.argmin(count[which]))  # the half-edge whose ends are the least like others
    entered, origin = [int(faces[first // 3]) * 3 + first % 3], [(0, 0)]
    place = {entered[0] // 3}
    for n in range(len(faces)):
        for k in range(3):
            half = int(mesh.twin[entered[n] // 3 * 3 + (entered[n] + k) % 3])
            if half < 3 * len(mesh.faces) and half // 3 not in place:
                place.add(half // 3)
                entered.append(half)
                origin.append((n, k))
    return np.array(entered), np.array(origin)


def _replayed(
    rest: _Mesh, pose: _Mesh, walk: tuple[np.ndarray, np.ndarray], part: int
) -> list[tuple[tuple[float, float], tuple[np.ndarray, np.ndarray]]]:
    """(costs, (vertices, images)) of each way to lay the walk over a part of the pose; costs: squared displacement, and
    how unlike the two are, 0 to 2, wherever and however large they are."""
    entered, origin = walk
    corners = _corners(entered)
    trail = rest.faces.reshape(-1)[corners].reshape(-1)
    vertices, first = np.unique(trail, return_index=True)
    halves = np.flatnonzero(np.repeat(pose.part == part, 3))
    begins = pose.faces.reshape(-1)[_corners(halves)[:, :2]]
    halves = halves[(pose.color[begins] == rest.color[trail[:2]]).all(axis=1)]
    found = []
    for block in (halves[k : k + _WALKS] for k in range(0, len(halves), _WALKS)):
        image = np.empty((len(block), len(entered)), dtype=np.int64)
        image[:, 0] = block
        for n in range(1, len(entered)):
            back, k = origin[n]
            half = image[:, back]
            image[:, n] = pose.twin[np.where(half < 3 * len(pose.faces), half // 3 * 3 + (half + k) % 3, half)]
        image = image[(image < 3 * len(pose.faces)).all(axis=1)]
        if not len(image):
            continue
        ends = pose.faces.reshape(-1)[_corners(image)].reshape(len(image), -1)
        images = ends[:, first]
        # every corner must agree with the first visit to its vertex, and no two vertices may share an image
        well = (images[:, np.searchsorted(vertices, trail)] == ends).all(axis=1)
        well &= (np.diff(np.sort(images, axis=1), axis=1) > 0).all(axis=1)
        for row in images[well]:
            cost = float(((pose.vertices[row] - rest.vertices[vertices]) ** 2).sum())
            one, two = (each - each.mean(axis=0) for each in (pose.vertices[row], rest.vertices[vertices]))
            lengths = np.linalg.norm(one) * np.linalg.norm(two)
            unlike = 1.0 - float((one * two).sum() / lengths) if lengths > 0.0 else 1.0
            found.append(((cost, unlike), (vertices, row)))
    return found


def _corners(half: np.ndarray) -> np.ndarray:
    """(..., 3) half-edges of a face in its direction, from the given one on."""
    half = np.asarray(half)[..., None]
    return half // 3 * 3 + (half + np.arange(3)) % 3
