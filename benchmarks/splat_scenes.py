"""Gaussian splats on the reference models by construction: flat discs on the surface, with its colours.

Each disc lies at a point of the surface that is not within another part of the model, spread evenly, and reaches to its
neighbours, or as far as there is matter below it: discs do not stand out over edges. Its harmonics are those that best
fit the ray caster's colour of the point, with texture, shadow and highlight, from all directions that see it.
"""

from __future__ import annotations

import numpy as np
import trimesh

import warpcage
from warpcage.deform.splat_deformer import quaternions_of
from warpcage.reference.raycast import CarriedMesh

#: Standard deviations of a disc: within the surface, as a share of the distance to its neighbours, and across it, as a
#: share of that.
SPREAD, THICKNESS = 0.4, 0.05

#: Opacity in the middle of a disc, and how far below the surface the second layer is, as a share of the same distance.
OPACITY, DEPTH = 0.99, 0.8

#: A disc is made shorter along an axis, by the first of these factors that keeps the places so many standard deviations
#: from its middle this near to the matter, in standard deviations of a round disc. The last is taken anyway.
SHORTER, RIM, CLEARANCE = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15), 1.5, 0.25

#: Directions in the surface of which the long axis of a disc takes that in which it can be longest.
ANGLES = 8

#: Weight that keeps harmonics small where no direction says otherwise.
RIDGE = 1e-3


def splats_on_mesh(
    mesh: CarriedMesh, count: int, *, aspect: float = 1.0, directions: int = 48, seed: int = 0, device=None
):
    """A SplatField of discs on a mesh at rest, up to `count` if no part is within another, and as many below them,
    `aspect` times longer one way and narrower the other."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    layers = []
    for layer in range(2):  # the second one closes what is left between the discs of the first
        points, faces = even_points(shape, count, seed + layer)
        spacing = np.sqrt(shape.area / len(points))
        normals = shape.face_normals[faces]
        places = points - layer * DEPTH * spacing * normals
        seen = mesh.signed_distances(points + 1e-4 * shape.scale * normals) > 0.0
        kept = seen & (mesh.signed_distances(places) < 0.1 * SPREAD * spacing)
        points, faces, normals, places = (each[kept] for each in (points, faces, normals, places))
        corners = trimesh.triangles.points_to_barycentric(shape.triangles[faces], points)[:, :2]
        harmonics = fitted_harmonics(mesh, faces, corners, normals, directions, seed)
        axes, scales = fitted_discs(mesh, places, normals, spacing * SPREAD, aspect)
        layers.append((places, np.log(scales), quaternions_of(axes), harmonics))
    places, scales, turns, harmonics = (np.concatenate(parts) for parts in zip(*layers, strict=True))
    logits = np.full(len(places), np.log(OPACITY / (1 - OPACITY)))
    return warpcage.SplatField(
        places, scales, turns, logits, harmonics, background="white", up=(0, 0, 1), device=device
    )


def fitted_discs(mesh: CarriedMesh, places, normals, spread: float, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Axes (n, 3, 3), one per column, and standard deviations (n, 3) of discs that do not stand out over edges."""
    side = np.where(np.abs(normals[:, :1]) < 0.5, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    u = np.cross(normals, side)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normals, u)
    along, longest = u, np.zeros(len(places))
    for angle in np.pi * np.arange(ANGLES if aspect > 1.0 else 1) / ANGLES:
        axis = np.cos(angle) * u + np.sin(angle) * v
        length = fitting_length(mesh, places, axis, spread * aspect, spread)
        longer = length > longest
        along, longest = np.where(longer[:, None], axis, along), np.where(longer, length, longest)
    across = np.cross(normals, along)
    lengths = [longest, fitting_length(mesh, places, across, spread / aspect, spread), np.full(len(places), spread)]
    scales = np.stack(lengths, axis=1) * np.array([1.0, 1.0, THICKNESS])
    return np.stack([along, across, normals], axis=2), scales


def fitting_length(mesh: CarriedMesh, places, axis, length: float, spread: float) -> np.ndarray:
    """(n,) standard deviation along unit axes, at most `length`, that keeps the rim of a disc at the matter."""
    fitting = np.full(len(places), SHORTER[-1] * length)
    for factor in SHORTER[-2::-1]:
        reach = RIM * factor * length * axis
        beyond = [mesh.signed_distances(places + sign * reach) for sign in (-1, 1)]
        fits = np.maximum(*beyond) <= CLEARANCE * spread
        fitting[fits] = factor * length
    return fitting


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
    from warpcage.splats.binding import sh_basis

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
