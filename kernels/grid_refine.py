"""Choose, prune, dilate and refine the nodes of a sparse voxel grid.

Siblings: grid, rays, spherical_harmonics.
"""

import warp as wp

from .grid import VoxelGrid
from .rays import PinholeCamera
from .spherical_harmonics import mat93

wp.set_module_options({"enable_backward": False})


@wp.kernel
def carve_visual_hull(
    first: int,
    lower: wp.vec3,
    voxel_size: wp.vec3,
    cameras: wp.array(dtype=PinholeCamera),
    opaque_sums: wp.array3d(dtype=wp.int32),
    bounded: wp.array(dtype=wp.int32),
    mask: wp.array3d(dtype=wp.int32),
):
    """1 where no image shows a node's voxel as transparent (Laurentini 1994, conservative in the voxel's extent).

    opaque_sums: (views, h + 1, w + 1) summed-area tables of the opaque pixels. bounded: (views,) 1 where the silhouette
    keeps clear of the image's border, so that whatever lies beyond the image is transparent too. A voxel that no image
    sees is carved.
    """
    n = first + wp.tid()
    k = n % mask.shape[2]
    j = (n // mask.shape[2]) % mask.shape[1]
    i = n // (mask.shape[2] * mask.shape[1])
    x = lower + wp.cw_mul(wp.vec3(float(i), float(j), float(k)), voxel_size)
    radius = 0.5 * wp.length(voxel_size)
    views = int(0)
    kept = int(1)
    for view in range(cameras.shape[0]):
        camera = cameras[view]
        local = wp.transpose(camera.rotation) * (x - camera.centre)
        if local[2] > 2.0 * radius:
            # half-width of the voxel's bounding sphere in the image, with room for its perspective
            spread = radius / (local[2] - radius)
            u = local[0] / local[2] * camera.focal[0] + camera.principal_point[0]
            v = local[1] / local[2] * camera.focal[1] + camera.principal_point[1]
            ru = spread * camera.focal[0] * (1.0 + wp.abs(local[0] / local[2]))
            rv = spread * camera.focal[1] * (1.0 + wp.abs(local[1] / local[2]))
            opaque = int(0)
            if u + ru >= 0.0 and v + rv >= 0.0 and u - ru <= float(camera.width) and v - rv <= float(camera.height):
                u0 = wp.clamp(int(wp.floor(u - ru)), 0, camera.width - 1)
                u1 = wp.clamp(int(wp.floor(u + ru)), 0, camera.width - 1) + 1
                v0 = wp.clamp(int(wp.floor(v - rv)), 0, camera.height - 1)
                v1 = wp.clamp(int(wp.floor(v + rv)), 0, camera.height - 1) + 1
                opaque = (
                    opaque_sums[view, v1, u1] - opaque_sums[view, v0, u1]
                    - opaque_sums[view, v1, u0] + opaque_sums[view, v0, u0]
                )
            centred = u >= 0.0 and v >= 0.0 and u <= float(camera.width) and v <= float(camera.height)
            if centred:
                views += 1
            if opaque == 0 and (centred or bounded[view] == 1):
                kept = int(0)
                break
    mask[i, j, k] = wp.where(views > 0, kept, 0)


@wp.kernel
def dilate_mask(first: int, source: wp.array3d(dtype=wp.int32), mask: wp.array3d(dtype=wp.int32)):
    """1 where any of a node's 27 neighbours is set."""
    n = first + wp.tid()
    k = n % mask.shape[2]
    j = (n // mask.shape[2]) % mask.shape[1]
    i = n // (mask.shape[2] * mask.shape[1])
    value = int(0)
    for a in range(wp.max(i - 1, 0), wp.min(i + 2, mask.shape[0])):
        for b in range(wp.max(j - 1, 0), wp.min(j + 2, mask.shape[1])):
            for c in range(wp.max(k - 1, 0), wp.min(k + 2, mask.shape[2])):
                if source[a, b, c] != 0:
                    value = int(1)
    mask[i, j, k] = value


@wp.kernel
def mark_weighty_nodes(
    first: int,
    nodes: wp.array(dtype=wp.vec3i),
    weights: wp.array(dtype=wp.float32),
    threshold: float,
    mask: wp.array3d(dtype=wp.int32),
):
    """1 at the nodes of rows whose recorded weight reaches a threshold; the rest of `mask` is left."""
    row = first + wp.tid()
    if weights[row] >= threshold:
        mask[nodes[row][0], nodes[row][1], nodes[row][2]] = 1


@wp.kernel
def keep_linked(first: int, links: wp.array3d(dtype=wp.int32), mask: wp.array3d(dtype=wp.int32)):
    """Clear `mask` where there is no row: dilation may not bring back what was pruned before."""
    n = first + wp.tid()
    k = n % mask.shape[2]
    j = (n // mask.shape[2]) % mask.shape[1]
    i = n // (mask.shape[2] * mask.shape[1])
    if links[i, j, k] < 0:
        mask[i, j, k] = 0


@wp.kernel
def refine_mask(first: int, factor: int, source: wp.array3d(dtype=wp.int32), mask: wp.array3d(dtype=wp.int32)):
    """Each voxel into factor^3 (factor 1 copies)."""
    n = first + wp.tid()
    k = n % mask.shape[2]
    j = (n // mask.shape[2]) % mask.shape[1]
    i = n // (mask.shape[2] * mask.shape[1])
    mask[i, j, k] = source[i // factor, j // factor, k // factor]


@wp.kernel
def link_nodes(
    first: int,
    mask: wp.array3d(dtype=wp.int32),
    running_count: wp.array(dtype=wp.int32),
    links: wp.array3d(dtype=wp.int32),
    nodes: wp.array(dtype=wp.vec3i),
):
    """Number the set nodes in memory order. running_count: inclusive scan of the flat mask."""
    n = first + wp.tid()
    k = n % mask.shape[2]
    j = (n // mask.shape[2]) % mask.shape[1]
    i = n // (mask.shape[2] * mask.shape[1])
    row = int(-1)
    if mask[i, j, k] != 0:
        row = running_count[n] - 1
        nodes[row] = wp.vec3i(i, j, k)
    links[i, j, k] = row


@wp.kernel
def resample_rows(
    first: int,
    coarse: VoxelGrid,
    factor: int,
    nodes: wp.array(dtype=wp.vec3i),
    density: wp.array(dtype=wp.float32),
    sh: wp.array(dtype=mat93),
):
    """Values of fine nodes by trilinear interpolation among the coarse nodes that have rows (weights renormalised)."""
    row = first + wp.tid()
    node = nodes[row]
    g = (wp.vec3(float(node[0]), float(node[1]), float(node[2])) + wp.vec3(0.5, 0.5, 0.5)) / float(factor)
    g -= wp.vec3(0.5, 0.5, 0.5)
    total = float(0.0)
    value = float(0.0)
    coefficients = mat93(0.0)
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    for c in range(8):
        a = wp.clamp(i + (c >> 2), 0, coarse.links.shape[0] - 1)
        b = wp.clamp(j + ((c >> 1) & 1), 0, coarse.links.shape[1] - 1)
        d = wp.clamp(k + (c & 1), 0, coarse.links.shape[2] - 1)
        wx = wp.where((c >> 2) == 1, g[0] - float(i), 1.0 - g[0] + float(i))
        wy = wp.where(((c >> 1) & 1) == 1, g[1] - float(j), 1.0 - g[1] + float(j))
        wz = wp.where((c & 1) == 1, g[2] - float(k), 1.0 - g[2] + float(k))
        other = coarse.links[a, b, d]
        weight = wx * wy * wz
        if other >= 0 and weight > 0.0:
            total += weight
            value += weight * coarse.density[other]
            coefficients += weight * coarse.sh[other]
    if total > 0.0:
        value /= total
        coefficients = coefficients / total
    density[row] = value
    sh[row] = coefficients
