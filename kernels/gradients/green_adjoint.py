"""Slopes of Green maps and weights of many points by the cage, face by face, and of stretched normals."""

# P = sum_i phi_i t_i + sum_f psi_f N_f, and L a number of which g = dL/dP is known at each point: dL is the sum over
# faces of sum_i (g . t_i) dphi_i + (g . N_f) dpsi, of the corners of that face alone (coordinates/face_slopes.py).
# Where there are rows (n, v) and face_rows (n, f), L is the sum of rows . phi + face_rows . psi. See
# mean_value_adjoint.py for how points are shared out.

import warp as wp

from ..coordinates.face_slopes import STEP_INSIDE, FaceLayers, distance_to_face, green_layers
from ..coordinates.green import SURFACE
from ..mesh.fans import near_plane_limit

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

_ZERO = wp.constant(wp.float64(0.0))


@wp.kernel
def place_off_cage(
    first: int,
    points: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    size: float,
    places: wp.array(dtype=wp.vec3),
):
    """places (n,): the points, those on the cage STEP_INSIDE it, where slopes jump; slopes (n,) or (0,): points where
    they are zero count for nothing."""
    n = first + wp.tid()
    x = points[n]
    y = x
    f = int(0)
    if slopes.shape[0] > 0:
        if wp.length_sq(slopes[n]) == 0.0:
            f = faces.shape[0]
    while f < faces.shape[0]:
        face = faces[f]
        a = vertices[face[0]] - x
        b = vertices[face[1]] - x
        c = vertices[face[2]] - x
        normal = wp.cross(b - a, c - a)
        det = wp.dot(normal, a)
        if det * det <= near_plane_limit(normal, b - a, c - a, size):
            p = wp.vec3d(a)
            q = wp.vec3d(b)
            r = wp.vec3d(c)
            exact = wp.cross(q - p, r - p)
            if wp.length(exact) > _ZERO and distance_to_face(p, q, r) < SURFACE * wp.float64(size):
                y = wp.vec3(wp.vec3d(x) - wp.normalize(exact) * (STEP_INSIDE * wp.float64(size)))
        f += 1
    places[n] = y


@wp.func
def point_layers(
    n: int,
    f: int,
    face: wp.vec3i,
    places: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    targets: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    face_rows: wp.array2d(dtype=float),
):
    """phi and psi of a face at a point, and slopes of what the point adds to L by its corners."""
    y = places[n]
    p = wp.vec3d(vertices[face[0]] - y)
    q = wp.vec3d(vertices[face[1]] - y)
    r = wp.vec3d(vertices[face[2]] - y)
    by_phi = wp.vec3()
    by_psi = float(0.0)
    if rows.shape[0] > 0:
        by_phi = wp.vec3(rows[n, face[0]], rows[n, face[1]], rows[n, face[2]])
        by_psi = face_rows[n, f]
    else:
        slope = slopes[n]
        by_phi = wp.vec3(
            wp.dot(slope, targets[face[0]]), wp.dot(slope, targets[face[1]]), wp.dot(slope, targets[face[2]])
        )
        by_psi = wp.dot(slope, normals[f])
    layers = FaceLayers()
    if wp.length(wp.cross(q - p, r - p)) > _ZERO:
        layers = green_layers(p, q, r, wp.vec3d(by_phi), wp.float64(by_psi))
    return layers


@wp.kernel
def sum_green_corners(
    first: int,
    places: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    face_rows: wp.array2d(dtype=float),
    by_vertices: wp.array3d(dtype=wp.vec3),
    by_targets: wp.array3d(dtype=wp.vec3),
    by_normals: wp.array2d(dtype=wp.vec3),
):
    """Add slopes of L by corners of faces in the cage and by their targets, both (parts, f, 3), and by what psi
    multiplies, (parts, f), over each part of the points. One item per part and face."""
    item = first + wp.tid()
    f = item % faces.shape[0]
    part = item / faces.shape[0]
    face = faces[f]
    by_p = wp.vec3d()
    by_q = wp.vec3d()
    by_r = wp.vec3d()
    to_p = wp.vec3d()
    to_q = wp.vec3d()
    to_r = wp.vec3d()
    to_normal = wp.vec3d()
    n = part
    while n < places.shape[0]:
        slope = wp.vec3d()
        is_wanted = True
        if rows.shape[0] == 0:
            slope = wp.vec3d(slopes[n])
            is_wanted = wp.length_sq(slope) > _ZERO
        if is_wanted:
            layers = point_layers(n, f, face, places, slopes, vertices, targets, normals, rows, face_rows)
            by_p += layers.slopes.p
            by_q += layers.slopes.q
            by_r += layers.slopes.r
            to_p += layers.phi[0] * slope
            to_q += layers.phi[1] * slope
            to_r += layers.phi[2] * slope
            to_normal += layers.psi * slope
        n += by_vertices.shape[0]
    by_vertices[part, f, 0] = by_vertices[part, f, 0] + wp.vec3(by_p)
    by_vertices[part, f, 1] = by_vertices[part, f, 1] + wp.vec3(by_q)
    by_vertices[part, f, 2] = by_vertices[part, f, 2] + wp.vec3(by_r)
    by_targets[part, f, 0] = by_targets[part, f, 0] + wp.vec3(to_p)
    by_targets[part, f, 1] = by_targets[part, f, 1] + wp.vec3(to_q)
    by_targets[part, f, 2] = by_targets[part, f, 2] + wp.vec3(to_r)
    by_normals[part, f] = by_normals[part, f] + wp.vec3(to_normal)


@wp.kernel
def slope_green_points(
    first: int,
    places: wp.array(dtype=wp.vec3),
    slopes: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    targets: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=float),
    face_rows: wp.array2d(dtype=float),
    by_points: wp.array(dtype=wp.vec3),
):
    """by_points (n,): slopes of L by the points, what is left of those by the cage, as all moves together."""
    n = first + wp.tid()
    total = wp.vec3d()
    f = int(0)
    while f < faces.shape[0]:
        layers = point_layers(n, f, faces[f], places, slopes, vertices, targets, normals, rows, face_rows)
        total -= layers.slopes.p + layers.slopes.q + layers.slopes.r
        f += 1
    by_points[n] = wp.vec3(total)


@wp.kernel
def slope_stretched_normals(
    first: int,
    vertices: wp.array(dtype=wp.vec3),
    targets: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    by_normals: wp.array2d(dtype=wp.vec3),
    by_vertices: wp.array3d(dtype=wp.vec3),
    by_targets: wp.array3d(dtype=wp.vec3),
):
    """Add to part 0 the slopes of stretched normals N = stretch n, by the corners of each face of the cage `vertices`
    and of the one `targets` that it is stretched to, from by_normals (parts, f) = dL / dN. One item per face."""
    # u, v: two edges of a face in the cage, D = |u x v|; s, t: the same in the target, n their unit normal.
    #   stretch = sqrt(E / 2) / D,   E = |s|^2 |v|^2 - 2 (s.t)(u.v) + |t|^2 |u|^2    (Lipman et al. 2008)
    f = first + wp.tid()
    face = faces[f]
    grad = wp.vec3d()
    for part in range(by_normals.shape[0]):
        grad += wp.vec3d(by_normals[part, f])
    u = wp.vec3d(vertices[face[1]]) - wp.vec3d(vertices[face[0]])
    v = wp.vec3d(vertices[face[2]]) - wp.vec3d(vertices[face[0]])
    s = wp.vec3d(targets[face[1]]) - wp.vec3d(targets[face[0]])
    t = wp.vec3d(targets[face[2]]) - wp.vec3d(targets[face[0]])
    cross = wp.cross(u, v)
    size = wp.length(cross)
    normal = wp.cross(s, t)
    length = wp.length(normal)
    if size == _ZERO or length == _ZERO:  # such faces have no normal
        return
    half = wp.float64(0.5)
    two = wp.float64(2.0)
    unit = normal / length
    energy = wp.dot(s, s) * wp.dot(v, v) - two * wp.dot(s, t) * wp.dot(u, v) + wp.dot(t, t) * wp.dot(u, u)
    stretch = wp.sqrt(half * energy) / size
    by_stretch = wp.dot(grad, unit)
    by_energy = by_stretch * wp.float64(0.25) / (stretch * size * size)
    by_size = -by_stretch * stretch / size
    axis = cross / size
    by_u = two * by_energy * (wp.dot(t, t) * u - wp.dot(s, t) * v) + by_size * wp.cross(v, axis)
    by_v = two * by_energy * (wp.dot(s, s) * v - wp.dot(s, t) * u) + by_size * wp.cross(axis, u)
    by_normal = (stretch / length) * (grad - by_stretch * unit)
    by_s = two * by_energy * (wp.dot(v, v) * s - wp.dot(u, v) * t) + wp.cross(t, by_normal)
    by_t = two * by_energy * (wp.dot(u, u) * t - wp.dot(u, v) * s) + wp.cross(by_normal, s)
    by_vertices[0, f, 0] = by_vertices[0, f, 0] - wp.vec3(by_u + by_v)
    by_vertices[0, f, 1] = by_vertices[0, f, 1] + wp.vec3(by_u)
    by_vertices[0, f, 2] = by_vertices[0, f, 2] + wp.vec3(by_v)
    by_targets[0, f, 0] = by_targets[0, f, 0] - wp.vec3(by_s + by_t)
    by_targets[0, f, 1] = by_targets[0, f, 1] + wp.vec3(by_s)
    by_targets[0, f, 2] = by_targets[0, f, 2] + wp.vec3(by_t)
