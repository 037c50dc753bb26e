"""Visual hull: the voxels that no silhouette shows as empty (Laurentini 1994), and those that enough cameras see."""

import warp as wp

from ..core.lanes import grid_place
from ..view.rays import PinholeCamera

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: A silhouette that leaves the image may reach this many times as far along the border as beyond it.
BEYOND_SPREAD = wp.constant(3.0)


@wp.kernel
def sum_rows(first: int, opaque: wp.array3d(dtype=wp.uint8), sums: wp.array3d(dtype=wp.int32)):
    """Running sums along each image row, sums[v, y + 1, x + 1] = opaque[v, y, 0] + .. + opaque[v, y, x]. One item per
    row. opaque: (views, h, w) 0 or 1; sums: (views, h + 1, w + 1), zero before."""
    n = first + wp.tid()
    view = n // opaque.shape[1]
    y = n % opaque.shape[1]
    total = int(0)
    for x in range(opaque.shape[2]):
        total += int(opaque[view, y, x])
        sums[view, y + 1, x + 1] = total


@wp.kernel
def sum_columns(first: int, sums: wp.array3d(dtype=wp.int32)):
    """Running sums down each column of the result of sum_rows: summed-area tables (Crow 1984). One item per column."""
    n = first + wp.tid()
    view = n // sums.shape[2]
    x = n % sums.shape[2]
    total = int(0)
    for y in range(sums.shape[1]):
        total += sums[view, y, x]
        sums[view, y, x] = total


@wp.kernel
def carve_visual_hull(
    first: int,
    lower: wp.vec3,
    voxel_size: wp.vec3,
    cameras: wp.array(dtype=PinholeCamera),
    opaque_sums: wp.array3d(dtype=wp.int32),
    bounded: wp.array(dtype=wp.int32),
    mask: wp.array3d(dtype=wp.uint8),
):
    """mask: 1 where no image shows a node's voxel as transparent. One item per node. lower: centre of the first voxel.
    opaque_sums: (views, h + 1, w + 1) summed-area tables of the opaque pixels."""
    # Laurentini 1994, conservative in the voxel's extent. bounded: (views,) 1 where a silhouette keeps clear of the
    # border: all beyond is transparent. Else a voxel beyond is carved if nothing is opaque along the border within
    # BEYOND_SPREAD times its distance from the image: silhouettes widen no faster. So are voxels that no image sees.
    i, j, k = grid_place(first + wp.tid(), mask.shape[1], mask.shape[2])
    x = lower + wp.cw_mul(wp.vec3(float(i), float(j), float(k)), voxel_size)
    radius = 0.5 * wp.length(voxel_size)
    views = int(0)
    kept = int(1)
    for view in range(cameras.shape[0]):
        camera = cameras[view]
        local = wp.transpose(camera.rotation) * (x - camera.center)
        if local[2] > 2.0 * radius:
            # half-width of the voxel's bounding sphere in the image, with room for its perspective
            spread = radius / (local[2] - radius)
            u = local[0] / local[2] * camera.focal[0] + camera.principal_point[0]
            v = local[1] / local[2] * camera.focal[1] + camera.principal_point[1]
            ru = spread * camera.focal[0] * (1.0 + wp.abs(local[0] / local[2]))
            rv = spread * camera.focal[1] * (1.0 + wp.abs(local[1] / local[2]))
            width = float(camera.width)
            height = float(camera.height)
            opaque = int(0)
            beyond_u = wp.max(wp.max(-u, u - width), 0.0)
            beyond_v = wp.max(wp.max(-v, v - height), 0.0)
            if bounded[view] == 0:
                ru += beyond_u + BEYOND_SPREAD * beyond_v
                rv += beyond_v + BEYOND_SPREAD * beyond_u
            if u + ru >= 0.0 and v + rv >= 0.0 and u - ru <= width and v - rv <= height:
                u0 = wp.clamp(int(wp.floor(u - ru)), 0, camera.width - 1)
                u1 = wp.clamp(int(wp.floor(u + ru)), 0, camera.width - 1) + 1
                v0 = wp.clamp(int(wp.floor(v - rv)), 0, camera.height - 1)
                v1 = wp.clamp(int(wp.floor(v + rv)), 0, camera.height - 1) + 1
                opaque = (
                    opaque_sums[view, v1, u1]
                    - opaque_sums[view, v0, u1]
                    - opaque_sums[view, v1, u0]
                    + opaque_sums[view, v0, u0]
                )
            if beyond_u + beyond_v <= 0.0:
                views += 1
            if opaque == 0:
                kept = int(0)
                break
    mask[i, j, k] = wp.uint8(wp.where(views > 0, kept, 0))


@wp.kernel
def keep_seen_voxels(
    first: int,
    lower: wp.vec3,
    voxel_size: wp.vec3,
    cameras: wp.array(dtype=PinholeCamera),
    least: int,
    mask: wp.array3d(dtype=wp.uint8),
):
    """Clears `mask` at the nodes that fewer than `least` cameras have in their image. One item per node."""
    i, j, k = grid_place(first + wp.tid(), mask.shape[1], mask.shape[2])
    x = lower + wp.cw_mul(wp.vec3(float(i), float(j), float(k)), voxel_size)
    views = int(0)
    for view in range(cameras.shape[0]):
        camera = cameras[view]
        local = wp.transpose(camera.rotation) * (x - camera.center)
        if local[2] > 0.0:
            u = local[0] / local[2] * camera.focal[0] + camera.principal_point[0]
            v = local[1] / local[2] * camera.focal[1] + camera.principal_point[1]
            if u >= 0.0 and v >= 0.0 and u <= float(camera.width) and v <= float(camera.height):
                views += 1
    if views < least:
        mask[i, j, k] = wp.uint8(0)
