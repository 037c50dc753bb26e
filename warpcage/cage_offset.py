"""A tight cage: the object closed and offset, decimated, and drawn close while its faces keep their distance."""

from __future__ import annotations

import numpy as np

from .cage import Cage
from .cage_check import winding_numbers
from .cage_fitting import face_samples, fitted, pieces
from .cage_intersections import intersecting_faces
from .cage_shell import ObjectShell

#: Closing radii tried, in lengths of the cage's edges: the first gives the tightest cage.
_CLOSINGS = (0.45, 0.7, 1.0, 1.5, 2.2, 3.3, 5.0)


def shell_cage(points, spacing, slack, margin, vertex_count, symmetry=None) -> Cage:
    """Try ever wider closings until a cage comes out that holds; slack: how far the object may lie off its points."""
    size = np.ptp(points, axis=0).max()
    need = needed(spacing, slack, margin)
    shell = ObjectShell(points, spacing, need + max(0.06 * size, 2.0 * spacing))
    edge = edge_length(shell, need, vertex_count)
    reasons = []
    for closing in _CLOSINGS:
        # wide closings need no fine voxels
        coarse = max(spacing, closing * edge / 16.0)
        need = needed(coarse, slack, margin)
        shell = ObjectShell(points, coarse, need + max(closing * edge, 2.0 * coarse))
        step = 2 if edge > 8.0 * coarse else 1
        vertices, faces = decimated(*shell.surface(need + 0.4 * (shell.reach - need), step), vertex_count)
        vertices = fitted(shell, vertices, faces, need)
        reason = flaw(shell, vertices, faces, need, vertex_count)
        if not reason:
            return Cage(vertices, faces)
        reasons.append(reason)
    raise ValueError(reasons[-1])


def simplified_cage(vertices, faces, points, spacing, margin, vertex_count) -> Cage:
    """A cage that is simplified, then moved outward only where its faces come too near to points (p, 3)."""
    reasons = []
    for closing in (0.0, 0.05, 0.1, 0.2, 0.4):
        need = needed(spacing, 0.0, margin)
        shell = ObjectShell(points, spacing, need + max(2.0 * spacing, closing * np.ptp(points, axis=0).max()))
        found, triangles = decimated(vertices, faces, vertex_count)
        found = fitted(shell, found, triangles, need, tighten=False)
        reason = flaw(shell, found, triangles, need, vertex_count)
        if not reason:
            return Cage(found, triangles)
        reasons.append(reason)
    raise ValueError(f"no cage of {vertex_count} vertices encloses the same ({reasons[-1]}): ask for more vertices")


def needed(spacing, slack, margin) -> float:
    """Distance from voxel centres at which the object is cleared by `margin`: it fills voxels to their corners."""
    return np.sqrt(0.75) * spacing + slack + margin


def flaw(shell, vertices, faces, need, vertex_count) -> str:
    """Why a cage does not hold; empty when it does."""
    if abs(len(vertices) - vertex_count) > 0.1 * vertex_count:
        return f"decimation left {len(vertices)} vertices"
    cage = Cage(vertices, faces)
    try:
        cage.require_usable("it")
    except ValueError as error:
        return str(error)
    samples, _ = face_samples(vertices, faces, pieces(shell, vertices, cage.edges))
    if shell.object_distance(samples).min() < need:
        return "its faces cannot be kept off the object"
    if (winding_numbers(shell.one_voxel_a_part(), vertices, faces) < 0.5).any():
        return "it leaves a part of the object out"
    if len(intersecting_faces(vertices, faces)):
        return "it passes through itself"
    return ""


def edge_length(shell, level, vertex_count) -> float:
    """Edge of the equilateral triangles, two a vertex, that would cover the object's offset surface."""
    vertices, faces = shell.surface(level)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    return float(np.sqrt(2.0 * area / (np.sqrt(3.0) * vertex_count)))


def decimated(vertices, faces, vertex_count) -> tuple[np.ndarray, np.ndarray]:
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
