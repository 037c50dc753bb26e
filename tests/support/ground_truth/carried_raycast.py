"""Ray casting of a deformed mesh that carries its colour and light along, as a posed radiance field does."""

# Where a ray meets the posed mesh, the same point of the mesh at rest is shaded as in mesh_raycast, with its texture,
# normal, shadows and light there. Vertex matrices take the view direction to rest space: with the Jacobian of the posed
# to rest map, Eq. 4 of "Deforming Radiance Fields with Cages" (ECCV 2022); with the mesh at rest as both and unit
# matrices, its picture at rest. The texture is solid: two octaves of Perlin noise of the place at rest over the faces'
# colours. Positions of each mesh are relative to one origin; depths are in the posed mesh's unit.

import warp as wp

from warpcage.kernels.demo.mesh_raycast import MeshLighting, sample_direction, shaded_color
from warpcage.kernels.view.rays import PinholeCamera

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})
TEXTURE_SEED = wp.constant(7)


@wp.struct
class SolidTexture:
    amplitude: float  # of the noise, 0 leaves colours plain
    frequency: float  # of the coarser octave, in the rest mesh's unit


@wp.func
def texture_factor(texture: SolidTexture, place: wp.vec3):
    """Factor on a colour at a position at rest, about 1 on average."""
    p = texture.frequency * place
    noise = wp.noise(wp.rand_init(TEXTURE_SEED), p) + 0.5 * wp.noise(wp.rand_init(TEXTURE_SEED + 1), 2.3 * p)
    return 1.0 + texture.amplitude * wp.clamp(2.0 * noise, -1.0, 1.0)


@wp.func
def vertex_mean(matrices: wp.array(dtype=wp.mat33), mesh: wp.uint64, face: int, u: float, v: float):
    """A matrix at each vertex, interpolated on a face."""
    a = matrices[wp.mesh_get_index(mesh, 3 * face)]
    b = matrices[wp.mesh_get_index(mesh, 3 * face + 1)]
    c = matrices[wp.mesh_get_index(mesh, 3 * face + 2)]
    return u * a + v * b + (1.0 - u - v) * c


@wp.kernel
def cast_carried_rays(
    first: int,
    posed: wp.uint64,
    rest: wp.uint64,
    face_colors: wp.array(dtype=wp.vec3),
    view_matrices: wp.array(dtype=wp.mat33),
    texture: SolidTexture,
    lighting: MeshLighting,
    light_stays: int,
    camera: PinholeCamera,
    side_samples: int,
    rgba: wp.array(dtype=wp.vec4),
    depth: wp.array(dtype=wp.float32),
):
    """One item per pixel, as in cast_mesh_rays; both meshes have the same faces. view_matrices (v,): posed to rest
    directions. depth (height * width,): mean distance over the samples that hit, inf unless all do."""
    # light_stays: 1 lights the posed mesh by lights fixed to the world, to compare; only its texture is from rest.
    item = first + wp.tid()
    column = item % camera.width
    row = item // camera.width
    color = wp.vec3(0.0, 0.0, 0.0)
    distance = float(0.0)
    hits = float(0.0)
    for k in range(side_samples * side_samples):
        x = float(column) + (float(k % side_samples) + 0.5) / float(side_samples)
        y = float(row) + (float(k // side_samples) + 0.5) / float(side_samples)
        direction = sample_direction(camera, x, y)
        query = wp.mesh_query_ray(posed, camera.center, direction, 1.0e6)
        if query.result:
            face = query.face
            place = wp.mesh_eval_position(rest, face, query.u, query.v)
            view = wp.normalize(vertex_mean(view_matrices, rest, face, query.u, query.v) * direction)
            normal = wp.mesh_eval_face_normal(rest, face)
            base = texture_factor(texture, place) * face_colors[face]
            lit = rest
            if light_stays == 1:
                lit = posed
                place = camera.center + query.t * direction
                view = direction
                normal = wp.normalize(query.normal)
            if wp.dot(normal, view) > 0.0:
                normal = -normal
            color += shaded_color(lit, lighting, base, place, normal, view)
            distance += query.t
            hits += 1.0
    count = float(side_samples * side_samples)
    if hits > 0.0:
        color = color / hits
    rgba[item] = wp.vec4(color[0], color[1], color[2], hits / count)
    depth[item] = wp.where(hits == count, distance / count, wp.inf)


@wp.kernel
def shade_surface_points(
    first: int,
    rest: wp.uint64,
    face_colors: wp.array(dtype=wp.vec3),
    texture: SolidTexture,
    lighting: MeshLighting,
    faces: wp.array(dtype=wp.int32),
    corners: wp.array(dtype=wp.vec2),
    directions: wp.array2d(dtype=wp.vec3),
    colors: wp.array2d(dtype=wp.vec3),
):
    """Colours (n, m) of points of the mesh at rest from several sides, directions (n, m): unit vectors from eye to
    point. One item per point. faces, corners (n,): face of a point, and its weights of the first two corners."""
    n = first + wp.tid()
    face = faces[n]
    place = wp.mesh_eval_position(rest, face, corners[n][0], corners[n][1])
    base = texture_factor(texture, place) * face_colors[face]
    normal = wp.mesh_eval_face_normal(rest, face)
    for m in range(directions.shape[1]):
        side = normal
        if wp.dot(normal, directions[n, m]) > 0.0:
            side = -normal
        colors[n, m] = shaded_color(rest, lighting, base, place, side, directions[n, m])
