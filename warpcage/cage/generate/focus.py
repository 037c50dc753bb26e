"""Where a cage gets more vertices: near points or a selection, or where the poses of another cage bend it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...core.arrays import as_host_points
from ...core.checks import checked_number
from ...core.names import counted
from ...errors import InputError
from ...mesh.mesh import ClosedMesh
from ...select.selection import NodeSelection, visible_nodes
from .decimate import Sizing
from .distance import one_a_cell

#: Shares of the object's size: how far about points edges are shortest, and over which distance they grow.
_NEAR, _GROWTH = 0.05, 0.15

#: Side of the cells, as a share of the object's size, of each of which one point stands for all.
_CELL = 0.1 * _NEAR

#: Least deviation from rigid that counts as bending, as a share of the edges about a vertex.
_MIN_BEND = 1e-3

#: Vertices of the posed cage that a place takes its bending from.
_NEIGHBORS = 4

MAX_FINER = 8.0


def focused(focus: Any, finer: float, size: float, points: np.ndarray) -> Sizing:
    """Relative lengths of edges, 1 / `finer` in the focus and 1 far from it; see `Cage.from_mesh`. size: of the object,
    world units; points (n, 3): of it."""
    from scipy.spatial import KDTree

    finer = checked_number(finer, "finer", 1.0, MAX_FINER)
    if focus is None:
        return None
    points = points[one_a_cell(points, _CELL * size)]
    shares = (_bent(_poses(focus)) if _has_poses(focus) else _near(_points(focus), size))(points)
    if not shares.any():
        raise InputError("the focus is nowhere near the object: give it in the object's world units")
    if finer == 1.0:
        return None
    # of the object's nearest point: surfaces that are decimated lie farther off a small object than a focus reaches
    tree = KDTree(points, leafsize=32, balanced_tree=False)
    return lambda x: finer ** -shares[tree.query(x)[1]]


def _has_poses(focus: Any) -> bool:
    """Whether a focus is a PoseFile, or a cage at rest and poses of it."""
    meshes = isinstance(focus, list | tuple) and len(focus) > 0 and all(isinstance(e, ClosedMesh) for e in focus)
    return meshes or (hasattr(focus, "rest") and hasattr(focus, "names"))


def _poses(focus: Any) -> list[ClosedMesh]:
    """The cage at rest and its poses."""
    if isinstance(focus, list | tuple):
        rest, *poses = focus
        poses = [rest.match(pose) for pose in poses]
    else:
        rest, poses = focus.rest, [focus[name] for name in focus.names]
    if not poses:
        raise InputError("focus has a cage at rest and no pose: nothing says where it bends")
    return [rest, *poses]


def _points(focus: Any) -> np.ndarray:
    """(n, 3) points of a selection, or those given."""
    if isinstance(focus, NodeSelection):
        points = visible_nodes(focus)
    else:
        try:
            points = as_host_points(focus, name="focus")
        except InputError as error:
            raise InputError(f"{error}; it takes points, a selection, a PoseFile, or [rest, pose, ...]") from None
    if not len(points):
        raise InputError("focus has no points: select what should get more vertices")
    return points


def _near(points: np.ndarray, size: float):
    """A function of places (n, 3): 1 near the points, 0 far from them, between in proportion to the distance."""
    from scipy.spatial import KDTree

    tree = KDTree(points)

    def share(x: np.ndarray) -> np.ndarray:
        distance = np.asarray(tree.query(x)[0])
        return np.clip(1.0 - (distance - _NEAR * size) / (_GROWTH * size), 0.0, 1.0)

    return share


def _bent(cages: Sequence[ClosedMesh]):
    """A function of places (n, 3): the bending of the nearest vertices of a cage at rest, its largest being 1."""
    from scipy.spatial import KDTree

    rest, *poses = cages
    bending = np.max([bending_of(rest, pose) for pose in poses], axis=0)
    if bending.max() < _MIN_BEND:
        raise InputError(
            f"focus bends nowhere: {counted(len(poses), 'pose')} of it {'move' if len(poses) > 1 else 'moves'} the "
            "whole cage alike"
        )
    tree, count = KDTree(rest.vertices), min(_NEIGHBORS, len(rest.vertices))
    relative = bending / bending.max()

    def share(x: np.ndarray) -> np.ndarray:
        distances, nearest = tree.query(x, count)
        weights = 1.0 / np.maximum(distances, 1e-9 * rest.size) ** 2
        return (weights * relative[nearest]).sum(axis=1) / weights.sum(axis=1)

    return share


def bending_of(rest: ClosedMesh, pose: ClosedMesh) -> np.ndarray:
    """(v,) how far the edges about each vertex are from a turn of those at rest, as a share of their length."""
    # the rotations of as-rigid-as-possible surfaces (Sorkine and Alexa 2007), whose energy this is
    ends = np.concatenate([rest.edges, rest.edges[:, ::-1]])
    before, after = (mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]] for mesh in (rest, pose))
    moments = np.zeros((len(rest.vertices), 3, 3))
    np.add.at(moments, ends[:, 0], before[:, :, None] * after[:, None, :])
    u, _, v = np.linalg.svd(moments)
    turned = np.linalg.det(np.matmul(u, v)) < 0.0
    u[turned, :, 2] *= -1.0
    expected = np.einsum("ei,eij->ej", before, np.matmul(u, v)[ends[:, 0]])
    off, total = (
        np.bincount(ends[:, 0], (each * each).sum(axis=1), len(rest.vertices)) for each in (after - expected, before)
    )
    return np.sqrt(off / np.where(total > 0.0, total, 1.0))
