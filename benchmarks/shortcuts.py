"""Shortcuts of earlier code, put into a posed Deformer so that their cost can be measured. For benchmarks only.

nearest_voxel: harmonic boundary values are put at the lattice nodes nearest to the cage's surface instead of at the
crossings of grid edges with it, and Laplace's equation is solved for the rest.
weight_sum: weights are zero at nodes outside the cage, and a sample counts as inside where the interpolated sum of
weights exceeds a threshold (0.98 in the authors' published code); the sum is not divided out. No distance to the cage
is known.
plain_directions: the field is asked for its colour along the direction of the ray in posed space.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warpcage.core.devices import launch
from warpcage.kernels.deform.cells import mark_edit_cases
from warpcage.kernels.deform.edits import LatticeEdit


def use_nearest_voxels(deformer, posed, tolerance: float = 1e-5) -> int:
    """Replace the harmonic map of a deformer posed to the cage `posed`. Returns the number of unknowns."""
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import cg

    edit = deformer._edits.posed()[0][0]
    cage_map, origin, rest = edit.deformed, deformer.field.center, deformer.edits[0].cage
    distance, positions = cage_map.distance.numpy(), cage_map.positions.numpy().astype(np.float64)
    lower, spacing = np.array(cage_map.lower) + origin, cage_map.spacing
    fixed, values = _surface_values(posed, rest.vertices - origin, lower, spacing, distance.shape)
    flat = positions.reshape(-1, 3)
    flat[fixed] = values
    unknown = distance.ravel() < 0
    unknown[fixed] = False
    number = np.full(unknown.size, -1)
    number[unknown] = np.arange(unknown.sum())  # rows of the unknowns
    rows, columns, right = [], [], np.zeros((unknown.sum(), 3))
    nodes = np.flatnonzero(unknown)
    for stride in (distance.shape[1] * distance.shape[2], distance.shape[2], 1):
        for neighbour in (nodes - stride, nodes + stride):
            known = ~unknown[neighbour]
            right[known] += flat[neighbour[known]]
            rows.append(np.flatnonzero(~known))
            columns.append(number[neighbour[~known]])
    diagonal = np.arange(len(nodes))
    rows, columns = np.concatenate([*rows, diagonal]), np.concatenate([*columns, diagonal])
    entries = np.concatenate([np.full(len(rows) - len(nodes), -1.0), np.full(len(nodes), 6.0)])
    matrix = csr_array((entries, (rows, columns)))
    for axis in range(3):
        flat[nodes, axis], info = cg(matrix, right[:, axis], x0=flat[nodes, axis], rtol=tolerance, maxiter=2000)
        if info:
            raise ValueError("the nearest-voxel solution did not converge")
    cage_map.positions.assign(positions.astype(np.float32))
    _remark(deformer, edit)
    return len(nodes)


def _surface_values(cage, targets, lower, spacing, shape):
    """Nodes nearest to points spread over the cage, and the mean of the targets' interpolation over each one's."""
    a, b, c = (cage.vertices[cage.faces[:, k]] for k in range(3))
    longest = np.max([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)])
    steps = int(np.ceil(3 * longest / spacing))
    i, j = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1), indexing="ij")
    keep = i + j <= steps
    shares = np.stack([i[keep], j[keep], steps - i[keep] - j[keep]], axis=1) / steps
    places = np.einsum("sk,fkc->fsc", shares, cage.vertices[cage.faces]).reshape(-1, 3)
    values = np.einsum("sk,fkc->fsc", shares, targets[cage.faces]).reshape(-1, 3)
    nodes = np.ravel_multi_index(np.rint((places - lower) / spacing).astype(int).T, shape)
    found, inverse, counts = np.unique(nodes, return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(inverse, values[:, k]) for k in range(3)], axis=1)
    return found, total / counts[:, None]


def use_weight_sums(deformer, threshold: float) -> None:
    """Tell inside from outside, in both cages of a posed deformer, by the sum of weights."""
    edit = deformer._edits.posed()[0][0]
    origin = deformer.field.center
    inside = edit.deformed.distance.numpy() < 0
    positions = edit.deformed.positions.numpy()
    positions[~inside] = -origin  # a sum of zero weights is the world's origin
    edit.deformed.positions.assign(positions)
    edit.deformed.distance.assign(((threshold - inside) * edit.deformed.spacing).astype(np.float32))
    rest = edit.rest.distance.numpy() < 0
    # the case is only asked for beside the deformed cage; `leaves`, which earlier code did not know, is left alone
    edit.rest.distance = wp.array(
        np.where(rest, -4.0, 4.0).astype(np.float32) * np.float32(edit.rest.spacing),
        dtype=float,
        device=deformer.device,
    )
    _remark(deformer, edit)


def _remark(deformer, edit) -> None:
    """Let a deformer's tables follow a map that was changed under it."""
    edits = deformer._edits
    edit.deformed.side_index = wp.zeros(0, dtype=int, device=deformer.device)
    launch(mark_edit_cases, edit.cells.size, [edit], [edit.cells], device=deformer.device)
    edits.array = wp.array(edits._structs, dtype=LatticeEdit, device=deformer.device)
    edits.scene, edits._marked_step = None, 0.0


def march(deformer, camera, *, plain_directions: bool, stride: int = 1, chunk: int = 4_000_000) -> np.ndarray:
    """A frame of a posed deformer on white, (h, w, 3), composited from Deformer.to_canonical and VoxelField.sample.

    stride: only every so many pixels along either side. Samples one march step of the field apart, opacity by canonical
    arc length, as the deformer's own frames have it.
    """
    frame = deformer.render(camera, background="white")
    field, step = deformer.field, deformer.field.step
    alpha = frame.alpha[::stride, ::stride]
    seen = np.flatnonzero(alpha.ravel() > 1e-4)
    centres, directions = (part[::stride, ::stride].reshape(-1, 3)[seen] for part in camera.rays())
    corners = np.concatenate([field.bounds, deformer.deformed[0].bounds])
    distance = np.linalg.norm(corners.mean(axis=0) - camera.centre)
    reach = 0.5 * np.linalg.norm(np.ptp(corners, axis=0))
    t = np.arange(max(distance - reach, step), distance + reach, step)
    image = np.ones((alpha.size, 3))
    rays = max(1, chunk // len(t))
    for first in range(0, len(seen), rays):
        part = slice(first, first + rays)
        x = (centres[part, None] + t[:, None] * directions[part, None]).astype(np.float32)
        d = np.broadcast_to(directions[part, None], x.shape).astype(np.float32)
        canonical, along, region = deformer.to_canonical(x.reshape(-1, 3), d.reshape(-1, 3))
        rgb, density = field.sample(canonical, d.reshape(-1, 3) if plain_directions else along)
        region, canonical = region.reshape(x.shape[:2]), canonical.reshape(x.shape)
        density = np.where(region == 1, 0.0, density.reshape(x.shape[:2]))
        arc = np.full(density.shape, step)
        both = (region[:, :-1] == 2) & (region[:, 1:] == 2)
        arc[:, :-1][both] = np.linalg.norm(np.diff(canonical, axis=1), axis=2)[both]
        depth = np.cumsum(density * arc, axis=1)
        light = np.exp(-np.concatenate([np.zeros((len(depth), 1)), depth], axis=1))
        weight = light[:, :-1] - light[:, 1:]
        image[seen[part]] = (weight[..., None] * rgb.reshape(*x.shape[:2], 3)).sum(axis=1) + light[:, -1:]
    return image.reshape(*alpha.shape, 3)
