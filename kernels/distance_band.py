"""Signed distance to a cage on the nodes of a lattice: exact in a narrow band, clamped outside it.

The sign comes from the crossings of lattice lines with the cage, so it is exact at nodes; the size is the distance to
the nearest face, gathered a block of nodes at a time so that outputs of different items are disjoint. Units: node
units (see crossings) for vertices, world units for the result. Siblings: containment, crossings.
"""

import warp as wp

from .containment import triangle_distance_squared
from .crossings import LineCrossings, is_inside

wp.set_module_options({"enable_backward": False})

#: Half-width of the band, in cells.
BAND = wp.constant(4.0)


@wp.func
def box_gap_squared(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Squared distance from x to the bounding box of triangle abc."""
    below = wp.min(wp.min(a, b), c) - x
    above = x - wp.max(wp.max(a, b), c)
    gap = wp.max(wp.max(below, above), wp.vec3(0.0, 0.0, 0.0))
    return wp.dot(gap, gap)


@wp.kernel
def mark_inside(first: int, crossings: LineCrossings, spacing: float, distance: wp.array3d(dtype=float)):
    """distance (nx, ny, nz): -BAND * spacing at inside nodes, +BAND * spacing at others. One item a node."""
    n = first + wp.tid()
    k = n % distance.shape[2]
    j = (n / distance.shape[2]) % distance.shape[1]
    i = n / (distance.shape[2] * distance.shape[1])
    distance[i, j, k] = wp.where(is_inside(crossings, i, j, k), -BAND * spacing, BAND * spacing)


@wp.kernel
def measure_band(
    first: int,
    block: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    spacing: float,
    distance: wp.array3d(dtype=float),
):
    """Distances nearer than BAND cells, with the signs that `distance` (nx, ny, nz) holds. One item a block."""
    item = first + wp.tid()
    ny = (distance.shape[1] + block - 1) / block
    nz = (distance.shape[2] + block - 1) / block
    i0 = (item / (ny * nz)) * block
    j0 = ((item / nz) % ny) * block
    k0 = (item % nz) * block
    i1 = wp.min(i0 + block, distance.shape[0])
    j1 = wp.min(j0 + block, distance.shape[1])
    k1 = wp.min(k0 + block, distance.shape[2])

    half = 0.5 * float(block - 1)
    centre = wp.vec3(float(i0) + half, float(j0) + half, float(k0) + half)
    reach = BAND + half * wp.sqrt(3.0)
    for f in range(faces.shape[0]):
        face = faces[f]
        a = vertices[face[0]]
        b = vertices[face[1]]
        c = vertices[face[2]]
        if box_gap_squared(centre, a, b, c) > reach * reach:
            continue
        if triangle_distance_squared(centre, a, b, c) > reach * reach:
            continue
        for i in range(i0, i1):
            for j in range(j0, j1):
                for k in range(k0, k1):
                    x = wp.vec3(float(i), float(j), float(k))
                    known = distance[i, j, k]
                    found = wp.sqrt(triangle_distance_squared(x, a, b, c)) * spacing
                    if found < wp.abs(known):
                        found = wp.max(found, 1.0e-30)  # a node on the cage keeps its side
                        distance[i, j, k] = wp.where(known < 0.0, -found, found)
