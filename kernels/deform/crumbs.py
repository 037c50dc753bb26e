"""Crumbs of an edit: small pieces of matter outside its rest cage, which hang on what is in it and go with it."""

# Which cells between voxels hold any of a crumb is kept exactly, one byte a cell, so that matter two voxels away stays
# where it is however coarse the lattice of the map.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.struct
class CrumbCells:
    """The cells between voxels that crumbs lie in. `marks` without entries: there are none."""

    lower: wp.vec3  # position of the voxel at the lower corner of cell (0, 0, 0)
    inverse_voxel_size: wp.vec3
    marks: wp.array3d(dtype=wp.uint8)  # 1 where any of a cell's eight corners is a voxel of a crumb


@wp.func
def in_crumbs(crumbs: CrumbCells, x: wp.vec3):
    """Whether a point of the scene at rest lies in a cell that holds any of a crumb."""
    if crumbs.marks.shape[0] == 0:
        return False
    g = wp.cw_mul(x - crumbs.lower, crumbs.inverse_voxel_size)
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    found = bool(False)
    if i >= 0 and j >= 0 and k >= 0:
        if i < crumbs.marks.shape[0] and j < crumbs.marks.shape[1] and k < crumbs.marks.shape[2]:
            found = crumbs.marks[i, j, k] != wp.uint8(0)
    return found
