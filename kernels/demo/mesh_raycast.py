"""Ray casting of a triangle mesh with one colour per face, for the pictures of the reference scenes."""

import warp as wp

from ..core.gradients import forward_only_in
from ..view.rays import PinholeCamera

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (float, wp.vec3))

#: Directions in which a surface point looks for nearby matter.
OPENNESS_RAYS = wp.constant(6)


@wp.struct
class MeshLighting:
    """The light of the scene. Reach and offset are lengths in the unit of the mesh."""

    key_direction: wp.vec3  # towards the light that casts shadows
    key_color: wp.vec3
    fill_direction: wp.vec3  # towards the light that casts none
    fill_color: wp.vec3
    sky_color: wp.vec3  # ambient on faces that look up (+z)
    ground_color: wp.vec3  # ambient on faces that look down
    highlight: float  # strength of the specular term
    shininess: float  # its exponent
    reach: float  # matter nearer than this darkens the ambient light
    offset: float  # secondary rays start this far off the surface


@wp.func
def sample_direction(camera: PinholeCamera, x: float, y: float):
    """Unit direction through the point (x, y) of the image plane, pixels."""
    a = (x - camera.principal_point[0]) / camera.focal[0]
    b = (y - camera.principal_point[1]) / camera.focal[1]
    return wp.normalize(camera.rotation * wp.vec3(a, b, 1.0))


@wp.func
def openness(mesh: wp.uint64, position: wp.vec3, normal: wp.vec3, reach: float):
    """Share in [0, 1] of fixed directions above a surface that are free of matter; nearer matter counts more."""
    free = float(0.0)
    total = float(0.0)
    for i in range(OPENNESS_RAYS):
        z = (float(i) + 0.5) / float(OPENNESS_RAYS)  # a Fibonacci hemisphere about +z, mirrored to the surface's side
        r = wp.sqrt(1.0 - z * z)
        turn = 2.3999632 * float(i)
        direction = wp.vec3(r * wp.cos(turn), r * wp.sin(turn), z)
        cosine = wp.dot(direction, normal)
        if cosine < 0.0:
            direction = -direction
            cosine = -cosine
        share = 1.0
        query = wp.mesh_query_ray(mesh, position, direction, reach)
        if query.result:
            share = query.t / reach
        free += cosine * share
        total += cosine
    return forward_only(free / wp.max(total, 1.0e-6), position)


@wp.func
def shaded_color(
    mesh: wp.uint64, lighting: MeshLighting, color: wp.vec3, position: wp.vec3, normal: wp.vec3, view: wp.vec3
):
    """Colour of a surface point as the eye sees it; `view` points from the eye to the surface."""
    start = position + lighting.offset * normal
    up = 0.5 * normal[2] + 0.5
    ambient = up * lighting.sky_color + (1.0 - up) * lighting.ground_color
    light = openness(mesh, start, normal, lighting.reach) * ambient
    light += wp.max(wp.dot(normal, lighting.fill_direction), 0.0) * lighting.fill_color

    highlight = wp.vec3(0.0, 0.0, 0.0)
    cosine = wp.dot(normal, lighting.key_direction)
    if cosine > 0.0:
        shadow = wp.mesh_query_ray(mesh, start, lighting.key_direction, 1.0e6)
        if not shadow.result:
            light += cosine * lighting.key_color
            half = wp.normalize(lighting.key_direction - view)
            gloss = wp.pow(wp.max(wp.dot(normal, half), 0.0), lighting.shininess)
            highlight = lighting.highlight * gloss * lighting.key_color
    shaded = wp.cw_mul(color, light) + highlight
    return wp.vec3(wp.min(shaded[0], 1.0), wp.min(shaded[1], 1.0), wp.min(shaded[2], 1.0))


@wp.kernel
def cast_mesh_rays(
    first: int,
    mesh: wp.uint64,
    face_colors: wp.array(dtype=wp.vec3),
    lighting: MeshLighting,
    camera: PinholeCamera,
    side_samples: int,
    rgba: wp.array(dtype=wp.vec4),
):
    """One item per pixel: side_samples^2 samples on a regular grid, averaged to straight (not premultiplied) RGBA.
    face_colors (f,); rgba (height * width,): the color is the mean over the samples that hit (0 if none does)."""
    item = first + wp.tid()
    column = item % camera.width
    row = item // camera.width
    color = wp.vec3(0.0, 0.0, 0.0)
    hits = float(0.0)
    for k in range(side_samples * side_samples):
        x = float(column) + (float(k % side_samples) + 0.5) / float(side_samples)
        y = float(row) + (float(k // side_samples) + 0.5) / float(side_samples)
        direction = sample_direction(camera, x, y)
        query = wp.mesh_query_ray(mesh, camera.center, direction, 1.0e6)
        if query.result:
            normal = wp.normalize(query.normal)
            if wp.dot(normal, direction) > 0.0:
                normal = -normal
            position = camera.center + query.t * direction
            color += shaded_color(mesh, lighting, face_colors[query.face], position, normal, direction)
            hits += 1.0
    if hits > 0.0:
        color = color / hits
    rgba[item] = wp.vec4(color[0], color[1], color[2], hits / float(side_samples * side_samples))


@wp.kernel
def measure_mesh_distance(
    first: int, mesh: wp.uint64, farthest: float, points: wp.array(dtype=wp.vec3), distances: wp.array(dtype=float)
):
    """distances (n,): negative inside; `farthest` for points that are farther from the mesh."""
    n = first + wp.tid()
    point = points[n]
    distances[n] = farthest
    query = wp.mesh_query_point_sign_winding_number(mesh, point, farthest)
    if query.result:
        foot = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        distances[n] = query.sign * wp.length(point - foot)
