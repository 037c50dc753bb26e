"""Gaussian splats on the reference models by construction: flat discs on the surface, with its colours.

Each disc lies at a point of the surface, spread evenly, and reaches to its neighbours. Its harmonics are those that
best fit the ray caster's colour of the point, with texture, shadow and highlight, from all directions that see it.
"""

from __future__ import annotations

import numpy as np
import trimesh

import warpcage
from warpcage.reference.carried_mesh import CarriedMesh

#: Standard deviations of a disc: within the surface, as a share of the distance to its neighbours, and across it, as a
#: share of that.
SPREAD, THICKNESS = 0.4, 0.05

#: Opacity in the middle of a disc, and how far below the surface the second layer is, as a share of the same distance.
OPACITY, DEPTH = 0.99, 0.8

#: Weight that keeps harmonics small where no direction says otherwise.
RIDGE = 1e-3


def splats_on_mesh(
    mesh: CarriedMesh, count: int, *, aspect: float = 1.0, directions: int = 48, seed: int = 0, device=None
):
    """A SplatField of about `count` discs on a mesh at rest, and as many below them, `aspect` times longer one way and
    narrower the other."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    layers = []
    for layer in range(2):  # the second one closes what is left between the discs of the first
        points, faces = even_points(shape, count, seed + layer)
        corners = trimesh.triangles.points_to_barycentric(shape.triangles[faces], points)[:, :2]
        normals = shape.face_normals[faces]
        harmonics = fitted_harmonics(mesh, faces, corners, normals, directions, seed)
        spacing = np.sqrt(shape.area / len(points))
        scales = np.log(spacing * SPREAD * np.array([aspect, 1.0 / aspect, THICKNESS]))
        places = points - layer * DEPTH * spacing * normals
        layers.append((places, np.broadcast_to(scales, places.shape), turned_up(normals), harmonics))
    places, scales, turns, harmonics = (np.concatenate(parts) for parts in zip(*layers, strict=True))
    logits = np.full(len(places), np.log(OPACITY / (1 - OPACITY)))
    return warpcage.SplatField(
        places, scales, turns, logits, harmonics, background="white", up=(0, 0, 1), device=device
    )


def even_points(shape: trimesh.Trimesh, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points spread over a surface with few gaps: of four times as many random ones, those not near a chosen one."""
    from scipy.spatial import cKDTree

    points, faces = trimesh.sample.sample_surface(shape, 5 * count, seed=seed)
    normals = shape.face_normals[faces]
    radius = 0.82 * np.sqrt(shape.area / count)
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
    pairs = pairs[np.einsum("ij,ij->i", normals[pairs[:, 0]], normals[pairs[:, 1]]) > 0.3]  # both sides of a thin part
    first, second = pairs.min(axis=1), pairs.max(axis=1)
    order = np.argsort(second, kind="stable")
    first, second = first[order], second[order]
    begins = np.searchsorted(second, np.arange(len(points) + 1))
    kept = np.zeros(len(points), bool)
    for point in range(len(points)):
        kept[point] = not kept[first[begins[point] : begins[point + 1]]].any()
    return points[kept], faces[kept]


def fitted_harmonics(mesh: CarriedMesh, faces, corners, normals, count: int, seed: int) -> np.ndarray:
    """(n, 16, 3) least squares over directions of the half space that sees each point."""
    from warpcage.splats.harmonics import sh_basis

    rng = np.random.default_rng(seed)
    fitted = np.empty((len(faces), 16, 3), np.float32)
    for begin in range(0, len(faces), 4096):
        part = slice(begin, begin + 4096)
        towards = rng.normal(size=(len(faces[part]), count, 3))
        towards /= np.linalg.norm(towards, axis=2, keepdims=True)
        facing = np.einsum("nmc,nc->nm", towards, normals[part])
        towards *= np.where(facing > 0, -1, 1)[..., None]
        colours = mesh.shade(faces[part], corners[part], towards) - 0.5
        basis = sh_basis(towards)
        normal = basis.transpose(0, 2, 1) @ basis + RIDGE * count * np.diag([0.0] + [1.0] * 15)
        fitted[part] = np.linalg.solve(normal, basis.transpose(0, 2, 1) @ colours)
    return fitted


def turned_up(normals: np.ndarray) -> np.ndarray:
    """(n, 4) w x y z that turn z to unit normals."""
    q = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))], axis=1)
    down = q[:, 0] < 1e-9
    q[down] = (0, 1, 0, 0)
    return q / np.linalg.norm(q, axis=1, keepdims=True)
