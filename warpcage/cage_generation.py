"""Cages around meshes and fields: voxelise, close, offset, decimate, and fit until the object is strictly inside.

After Xian, Lin and Gao 2009, "Automatic generation of coarse bounding cages from dense meshes": a voxelised outer
surface, smoothed and decimated, is made to enclose. Here the enclosure is kept on a distance field: the faces of the
cage, not the points of the object, are held at a distance, which costs nothing per point of the object.
"""

from __future__ import annotations

import numpy as np

from .cage import Cage
from .cage_check import winding_numbers
from .cage_intersections import intersecting_faces
from .cage_shell import ObjectShell

#: A node whose opacity across one voxel, or whose largest weight in any image, reaches this can be seen.
VISIBLE_OPACITY = 0.01

#: Closing radii tried, in lengths of the cage's edges: the first gives the tightest cage.
_CLOSINGS = (0.45, 0.7, 1.0, 1.5, 2.2, 3.3, 5.0)

_LEAST_COUNT, _MOST_COUNT = 8, 2000


def cage_around_mesh(mesh, vertex_count: int = 100, *, margin: float | None = None) -> Cage:
    """A cage of `vertex_count` vertices (within 10 %) that strictly encloses a mesh.

    mesh: trimesh.Trimesh, or anything with .vertices (n, 3) and .faces (f, 3), open or closed, of one or several parts.
    vertex_count: 8 to 2000; 30 to 200 suit deformation. margin: least distance between cage and mesh, world units;
    None takes 1 % of the mesh's size.

    The cage is closed, manifold, free of self-intersections and looks outward; the same input gives the same cage.
    Gaps narrower than about an edge of the cage are bridged; parts farther apart get closed parts of their own.
    Raises ValueError for a mesh that is empty, not finite or has bad indices, for a bad count or margin, or when no
    cage could be made.
    """
    vertex_count = _checked_count(vertex_count)
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
    margin = _checked_margin(0.01 * size if margin is None else margin)
    spacing = _spacing(np.ptp(vertices, axis=0), vertex_count)
    points = np.concatenate([vertices, _surface_points(vertices, faces, 0.5 * spacing)])
    # any point of a face lies within 0.5 / sqrt(3) spacings of the points on it
    return _cage_around_points(points, spacing, 0.29 * spacing, margin, vertex_count)


def cage_around_field(field, vertex_count: int = 100, *, margin: float | None = None,
                      threshold: float | None = None) -> Cage:
    """A cage of `vertex_count` vertices (within 10 %) that strictly encloses what can be seen of a field.

    field: VoxelField, or anything with .node_densities(), .bounds, .voxel_size and, if known, .node_weights().
    margin: least distance between the cage and the visible nodes, in voxels; None takes 2. threshold: see
    `visible_nodes`. The rest is as in `cage_around_mesh`.
    Raises ValueError for a field with nothing to see, densities that are not finite, a bad count or margin.
    """
    vertex_count = _checked_count(vertex_count)
    voxel_size = np.broadcast_to(np.asarray(field.voxel_size, dtype=np.float64), 3)
    margin = _checked_margin(2.0 if margin is None else margin) * voxel_size.max()
    points = visible_nodes(field, threshold)
    if not len(points):
        raise ValueError("the field shows nothing to put a cage around: lower the threshold")
    extent = np.maximum(np.ptp(points, axis=0), voxel_size)
    # a grid no finer than the field's, or its empty lines between nodes would count as gaps
    spacing = max(_spacing(extent, vertex_count), voxel_size.max())
    return _cage_around_points(points, spacing, 0.0, margin, vertex_count)


def visible_nodes(field, threshold: float | None = None) -> np.ndarray:
    """World positions (n, 3) of the nodes of a field that can be seen.

    threshold: density from which a node counts, one over world units. None counts nodes whose largest recorded weight
    in an image (`field.node_weights()`) is at least 0.01, or, where no weights were recorded, whose opacity across one
    voxel is: density >= -ln(0.99) / voxel side.
    """
    from .surface import node_grid

    densities, voxel_size = node_grid(field)
    weights = getattr(field, "node_weights", lambda: None)() if threshold is None else None
    if threshold is not None and not (np.isfinite(threshold) and threshold > 0.0):
        raise ValueError(f"threshold must be a positive density, got {threshold}")
    if weights is not None:
        visible = (np.asarray(weights) >= VISIBLE_OPACITY) & (densities > 0.0)
    elif threshold is not None:
        visible = densities >= threshold
    else:
        visible = densities >= -np.log1p(-VISIBLE_OPACITY) / np.prod(voxel_size) ** (1.0 / 3.0)
    return np.asarray(field.bounds, dtype=np.float64)[0] + (np.argwhere(visible) + 0.5) * voxel_size


def _cage_around_points(points, spacing, slack, margin, vertex_count) -> Cage:
    """Try ever wider closings until a cage comes out that holds; slack: how far the object may lie off its points."""
    size = np.ptp(points, axis=0).max()
    need = _needed(spacing, slack, margin)
    shell = ObjectShell(points, spacing, need + max(0.06 * size, 2.0 * spacing))
    edge = _edge_length(shell, need, vertex_count)
    reasons = []
    for closing in _CLOSINGS:
        # wide closings need no fine voxels
        coarse = max(spacing, closing * edge / 16.0)
        need = _needed(coarse, slack, margin)
        shell = ObjectShell(points, coarse, need + max(closing * edge, 2.0 * coarse))
        step = 2 if edge > 8.0 * coarse else 1
        vertices, faces = _decimated(*shell.surface(need + 0.4 * (shell.reach - need), step), vertex_count)
        vertices = _fitted(shell, vertices, faces, need)
        reason = _flaw(shell, vertices, faces, need, vertex_count)
        if not reason:
            return Cage(vertices, faces)
        reasons.append(reason)
    raise ValueError(f"no cage of {vertex_count} vertices could be made ({reasons[-1]}): ask for more vertices, a "
                     "smaller margin, or begin with Cage.box")


def _needed(spacing, slack, margin) -> float:
    """Distance from voxel centres at which the object is cleared by `margin`: it fills voxels to their corners."""
    return np.sqrt(0.75) * spacing + slack + margin


def _flaw(shell, vertices, faces, need, vertex_count) -> str:
    """Why a cage does not hold; empty when it does."""
    if abs(len(vertices) - vertex_count) > 0.1 * vertex_count:
        return f"decimation left {len(vertices)} vertices"
    cage = Cage(vertices, faces)
    try:
        cage.require_usable("it")
    except ValueError as error:
        return str(error)
    samples, _ = _face_samples(vertices, faces, _pieces(shell, vertices, cage.edges))
    if shell.object_distance(samples).min() < need:
        return "its faces cannot be kept off the object"
    if (winding_numbers(shell.one_voxel_a_part(), vertices, faces) < 0.5).any():
        return "it leaves a part of the object out"
    if len(intersecting_faces(vertices, faces)):
        return "it passes through itself"
    return ""


# -- Shape of the cage


def _edge_length(shell, level, vertex_count) -> float:
    """Edge of the equilateral triangles, two a vertex, that would cover the object's offset surface."""
    vertices, faces = shell.surface(level)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    return float(np.sqrt(2.0 * area / (np.sqrt(3.0) * vertex_count)))


def _decimated(vertices, faces, vertex_count) -> tuple[np.ndarray, np.ndarray]:
    """The surface with about `vertex_count` vertices: quadric edge collapse (Garland and Heckbert 1997)."""
    import pymeshlab

    # V - E + F = V - F / 2 does not change in a collapse that keeps the topology
    target = 2 * vertex_count - (2 * len(vertices) - len(faces))
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=int(target), qualitythr=1.0, preservenormal=True, preservetopology=True, planarquadric=True,
        planarweight=0.01,
    )  # fmt: skip
    result = meshes.current_mesh()
    return np.array(result.vertex_matrix()), np.array(result.face_matrix())


def _fitted(shell, vertices, faces, need, rounds: int = 60) -> np.ndarray:
    """Vertices moved so that every face keeps `need` from the object, close to it, and triangles are even.

    Alternates smoothing along the surface, a pull towards the object as far as the faces around a vertex allow, and a
    push of every sample of a face that is too close, shared over its corners by barycentric weight.
    """
    vertices = vertices.copy()
    edges = Cage(vertices, faces).edges
    level = need + 0.1 * shell.spacing
    for turn in range(3 * rounds):
        if turn < rounds:
            vertices = _smoothed(vertices, faces, edges, 0.3 * (1.0 - turn / rounds))
            vertices = _pulled(shell, vertices, faces, level)
        # coarse samples while the shape is found, then those that `_flaw` looks at
        pieces = 8 if turn < rounds else _pieces(shell, vertices, edges)
        vertices, worst = _pushed(shell, vertices, faces, level, pieces)
        if turn >= rounds and worst <= 0.05 * shell.spacing:
            break
    return vertices


def _smoothed(vertices, faces, edges, share) -> np.ndarray:
    """Each vertex a `share` of the way to the mean of its neighbours, along the surface only."""
    total, count = np.zeros_like(vertices), np.zeros(len(vertices))
    for a, b in ((0, 1), (1, 0)):
        np.add.at(total, edges[:, a], vertices[edges[:, b]])
        np.add.at(count, edges[:, a], 1.0)
    step = share * (total / count[:, None] - vertices)
    normals = _vertex_normals(vertices, faces)
    return vertices + step - np.einsum("vi,vi->v", step, normals)[:, None] * normals


def _pulled(shell, vertices, faces, level) -> np.ndarray:
    """Each vertex towards the object by half of the least room that the samples near it have."""
    samples, weights = _face_samples(vertices, faces, 6)
    room = shell.closed_distance(samples) - level
    least = np.full(len(vertices), np.inf)
    for k in range(3):
        near = weights[:, k] > 0.3
        np.minimum.at(least, faces[:, k], room[:, near].min(axis=1))
    return vertices - 0.5 * np.maximum(least, 0.0)[:, None] * shell.outward(vertices)


def _pushed(shell, vertices, faces, level, pieces) -> tuple[np.ndarray, float]:
    """Vertices moved outward so that the samples of their faces come to `level`, and the largest shortfall before."""
    samples, weights = _face_samples(vertices, faces, pieces)
    short = level - shell.closed_distance(samples)
    worst = float(short.max())
    f, s = np.nonzero(short > 0.0)
    if not len(f):
        return vertices, worst
    move = short[f, s, None] * shell.outward(samples[f, s])
    # the corners that carry a sample share its move so that the sample itself makes all of it (least squares)
    share = weights[s] / (weights[s] ** 2).sum(axis=1, keepdims=True)
    total, weight = np.zeros_like(vertices), np.zeros(len(vertices))
    # samples far too close count for more than those nearly clear, which a plain mean would let dilute the move
    urgency = weights[s] * short[f, s, None]
    for k in range(3):
        np.add.at(total, faces[f, k], (urgency[:, k] * share[:, k])[:, None] * move)
        np.add.at(weight, faces[f, k], urgency[:, k])
    return vertices + total / np.where(weight > 0.0, weight, 1.0)[:, None], worst


def _face_samples(vertices, faces, pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (f, s, 3) on a regular grid of each face, corners included, and their barycentric weights (s, 3)."""
    i, j = np.meshgrid(np.arange(pieces + 1), np.arange(pieces + 1), indexing="ij")
    kept = i + j <= pieces
    weights = np.stack([pieces - i[kept] - j[kept], i[kept], j[kept]], axis=1) / pieces
    return np.einsum("sk,fki->fsi", weights, vertices[faces]), weights


def _pieces(shell, vertices, edges) -> int:
    """Pieces to cut the sides of faces in so that samples lie about half a voxel apart."""
    longest = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).max()
    return int(np.clip(np.ceil(2.0 * longest / shell.spacing), 8, 40))


def _vertex_normals(vertices, faces) -> np.ndarray:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], np.cross(b - a, c - a))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


# -- Voxels


def _spacing(extent, vertex_count) -> float:
    """Side of a voxel: about 64^3 of them in the box, more for cages of many vertices, at most 160 along a side."""
    size = extent.max()
    finer = np.clip(vertex_count / 200.0, 1.0, 4.0) ** (1.0 / 3.0)
    filled = np.prod(np.maximum(extent, size / 160.0)) ** (1.0 / 3.0) / 64.0
    return float(max(filled, size / 160.0) / finer)


def _surface_points(vertices, faces, spacing) -> np.ndarray:
    """Points on faces no more than `spacing` from their neighbours: a regular grid on each, by number of pieces."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    pieces = np.maximum(np.ceil(longest / spacing).astype(np.int64), 1)
    found = []
    for count in np.unique(pieces[pieces > 1]):
        samples, _ = _face_samples(vertices, faces[pieces == count], int(count))
        found.append(samples.reshape(-1, 3))
    return np.concatenate(found) if found else np.zeros((0, 3))


def _checked_count(vertex_count) -> int:
    whole = isinstance(vertex_count, int | np.integer) and not isinstance(vertex_count, bool)
    if not whole or not _LEAST_COUNT <= vertex_count <= _MOST_COUNT:
        raise ValueError(f"vertex_count must be a whole number, {_LEAST_COUNT} to {_MOST_COUNT}, got {vertex_count!r}")
    return int(vertex_count)


def _checked_margin(margin) -> float:
    if not (np.isfinite(margin) and margin >= 0.0):
        raise ValueError(f"margin must be finite and not negative, got {margin}")
    return float(margin)
