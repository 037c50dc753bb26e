"""All that is wrong with a cage, what it encloses, and what a pose does, as a CageReport."""

from __future__ import annotations

import numpy as np

from ..coordinates.coordinates import deform_points
from ..field.selection import NodeSelection, visible_nodes
from ..field.voxel_field import VoxelField
from ..mesh.match import matched_vertices
from ..mesh.mesh import ClosedMesh, TriangleMesh, require_mesh
from ..mesh.queries import inside_mesh, intersecting_faces
from ..mesh.validity import coincident_vertices, degenerate_faces, first_problem, inward_parts
from ..splats.splat_field import SplatField
from .report import COST_RESOLUTION, CageReport, PoseReport
from .upright import other_standing


def check_cage(
    cage: ClosedMesh,
    field: VoxelField | NodeSelection | SplatField | None = None,
    mesh: TriangleMesh | None = None,
    pose: ClosedMesh | None = None,
) -> CageReport:
    """Examine a cage; see `Cage.check`.
    Enclosure is defined for usable cages only: it is 0 for others, and their poses are not looked at."""
    if pose is not None:
        require_mesh(pose, "the pose must be")
    topology = cage.topology
    problem = first_problem(cage)
    mesh_points = None if mesh is None else np.asarray(mesh.vertices, dtype=np.float64)
    field_points = None if field is None else visible_nodes(field)
    objects = [points for points in (mesh_points, field_points) if points is not None]
    outside: list[np.ndarray] = []
    mesh_enclosed = _enclosed(cage, mesh_points, problem, "mesh has no vertices", outside)
    field_enclosed = _enclosed(cage, field_points, problem, "field has no visible voxels", outside)
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
        mesh_enclosed=mesh_enclosed, field_enclosed=field_enclosed,
        leaking_faces=_nearest_faces(cage, outside), hull_ratio=_hull_ratio(cage, objects),
        standing=_standing(cage, field, mesh), lattice_nodes=_lattice_nodes(cage),
        notes=tuple(getattr(field, "notes", ())), problem=problem,
        pose=None if pose is None or problem else check_pose(cage, pose),
    )  # fmt: skip


def _standing(cage: ClosedMesh, *things: object) -> str:
    """What speaks for another axis up, by the first object that does."""
    notes = [other_standing(cage, thing) for thing in things if thing is not None]
    return next((note for note in notes if note), "")


def _enclosed(
    cage: ClosedMesh, points: np.ndarray | None, problem: str, complaint: str, outside: list[np.ndarray]
) -> float | None:
    """Share of points inside, None without points; those outside are added to a list."""
    if points is None:
        return None
    if not len(points):
        raise ValueError(complaint)
    if problem:
        return 0.0
    inside = inside_mesh(points, cage)
    outside.append(points[~inside])
    return float(np.mean(inside))


def _nearest_faces(cage: ClosedMesh, outside: list[np.ndarray], most: int = 500) -> tuple:
    """(face, count) by the centre nearest to each point outside, the most frequent first.
    Of more than `most` points it takes every second, third, ..."""
    points = np.concatenate(outside) if outside else np.zeros((0, 3))
    if not len(points):
        return ()
    points = points[:: -(-len(points) // most)]
    centres = cage.vertices[cage.faces].mean(axis=1)
    nearest = np.argmin(((points[:, None] - centres[None]) ** 2).sum(axis=2), axis=1)
    faces, counts = np.unique(nearest, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return tuples(np.stack([faces[order], counts[order]], axis=1))


def _lattice_nodes(cage: ClosedMesh) -> int:
    """Nodes of a lattice of COST_RESOLUTION cells along the longest side, with its margins; 0 for no extent."""
    if cage.size == 0.0:
        return 0
    return int(np.prod(np.ceil(np.ptp(cage.bounds, axis=0) / cage.size * COST_RESOLUTION) + 6))


def _convexity(cage: ClosedMesh) -> float:
    """Volume over that of the convex hull; 0 for a flat cage."""
    hull = _hull_volume(cage.vertices[cage.topology.used_vertices])
    return cage.volume / hull if hull > 0.0 else 0.0


def _hull_ratio(cage: ClosedMesh, objects: list[np.ndarray]) -> float | None:
    """Volume over that of the convex hull of points (n, 3); None without points, or for flat ones."""
    hull = _hull_volume(np.concatenate(objects)) if objects else 0.0
    return cage.volume / hull if hull > 0.0 else None


def _hull_volume(points: np.ndarray) -> float:
    """Volume of the convex hull of points (n, 3); 0 for flat ones."""
    extent = np.ptp(points, axis=0)
    if len(points) < 4 or extent.min() <= 1e-12 * extent.max():
        return 0.0
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(points).volume)
    except QhullError:  # all in one plane
        return 0.0


def tuples(array: np.ndarray) -> tuple:
    """Rows of an array (n,) or (n, k) as n plain numbers or tuples."""
    return tuple(tuple(row) if isinstance(row, list) else row for row in np.asarray(array).tolist())


#: About how many samples are taken inside the posed cage.
_SAMPLES = 3000

#: Distance of the points of a finite difference, as a share of the size; float32 maps err by about 1e-6 of it.
_DIFFERENCE = 2e-3


def check_pose(rest: ClosedMesh, pose: ClosedMesh) -> PoseReport:
    """Examine a pose of a usable cage: the same mesh, in any order that `Cage.match` takes."""
    pose = rest.with_vertices(matched_vertices(rest, pose))
    problem = first_problem(pose)
    folds = tuples(intersecting_faces(pose.vertices, pose.faces))
    ratio = pose.volume / rest.volume
    if problem:
        return PoseReport(0, ratio, 0.0, 0.0, 0.0, 0.0, folds, problem)

    count, inverted, outside, stretch = sample_pose(rest, pose)
    return PoseReport(
        sample_count=count, volume_ratio=ratio, inverted_share=inverted, outside_share=outside,
        least_stretch=stretch[0], largest_stretch=stretch[1], intersecting_faces=folds, problem=problem,
    )  # fmt: skip


def sample_pose(
    rest: ClosedMesh, pose: ClosedMesh, samples: int = _SAMPLES
) -> tuple[int, float, float, tuple[float, float]]:
    """Number of samples in the posed cage, shares of them that the map posed -> rest folds and sends out of the rest
    cage, and least and largest stretch. Shares are 0 and stretches 1 where no sample fits; both cages are usable."""
    (points, _), step = grid_points(pose, samples), _DIFFERENCE * pose.size
    points = points[inside_mesh(points, pose)]
    offsets: np.ndarray = np.concatenate([np.zeros((1, 3)), step * np.eye(3)])
    stencil = points[:, None] + offsets
    stencil = stencil[inside_mesh(stencil[:, 1:].reshape(-1, 3), pose).reshape(-1, 3).all(axis=1)]
    if not len(stencil):
        return 0, 0.0, 0.0, (1.0, 1.0)
    mapped = deform_points(stencil.reshape(-1, 3), pose, rest, coordinates="mean_value")
    assert isinstance(mapped, np.ndarray)  # as the points are
    mapped = mapped.reshape(-1, 4, 3)
    # Forward differences. A sample is inverted where det J <= 0; elsewhere the pose stretches by 1 / s for each
    # singular value s of J.
    jacobian = (mapped[:, 1:] - mapped[:, :1]) / step
    inverted = np.linalg.det(jacobian) <= 0.0
    singular = np.linalg.svd(jacobian[~inverted], compute_uv=False)
    stretch = 1.0 / np.clip(singular, 1e-6, 1e6) if len(singular) else np.zeros((1, 3))
    outside = float(np.mean(~inside_mesh(mapped[:, 0], rest)))
    return len(stencil), float(inverted.mean()), outside, (float(stretch.min()), float(stretch.max()))


def grid_points(cage: ClosedMesh, samples: int) -> tuple[np.ndarray, float]:
    """Points (n, 3) of a grid over a cage's bounding box, `samples` or so inside, and their distance, world units."""
    lower, upper = cage.bounds
    spacing = (cage.volume / samples) ** (1.0 / 3.0)
    # begun aside, off the cage's planes of symmetry
    axes = [
        np.arange(low + 0.37 * min(spacing, high - low), high, spacing) for low, high in zip(lower, upper, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), spacing
