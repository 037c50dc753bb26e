"""Ray casting of triangle meshes with colours of vertices and pictures on them, front to back."""

# A ray meets the triangles one after another through Warp's bounding volume hierarchy, and what it meets is put before
# what is behind it (Porter and Duff, "Compositing Digital Images", SIGGRAPH 1984): textures may be cut out or clear.

import warp as wp

from ..view.rays import PinholeCamera, pixel_direction

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Values for a face without a picture: colours of its vertices as they are, or under a headlight.
NO_PICTURE = wp.constant(-1)
HEADLIGHT = wp.constant(-2)

#: Light that a face under the headlight gives when it is seen along its surface; 1 when it is seen from the front.
MIN_LIGHT = wp.constant(0.3)

#: Clear surfaces that a ray passes at most, and the light behind which nothing is looked for.
MAX_SURFACES = wp.constant(32)
MIN_TRANSMITTANCE = wp.constant(1.0e-3)


@wp.struct
class SurfaceColors:
    """The colours of a mesh of v vertices and f faces; all RGBA, straight opacity, of sRGB as pictures have it."""

    faces: wp.array(dtype=wp.int32)  # (3 f,) numbers of vertices
    colors: wp.array(dtype=wp.vec4)  # (v,) in [0, 1], which pictures are multiplied by
    uv: wp.array(dtype=wp.vec2)  # (v,) places in the pictures, 0 to 1 from the upper left corner
    face_pictures: wp.array(dtype=wp.int32)  # (f,) number of a picture, NO_PICTURE or HEADLIGHT
    pictures: wp.array(dtype=wp.vec3i)  # (pictures,) first texel, width and height of each
    texels: wp.array(dtype=wp.vec4ub)  # of all pictures, row after row


@wp.func
def texel_color(mesh_colors: SurfaceColors, picture: wp.vec3i, column: int, row: int):
    """Colour of a texel of a picture that goes on in all directions."""
    x = column % picture[1]  # as in C: negative for negative columns
    y = row % picture[2]
    x = wp.where(x < 0, x + picture[1], x)
    y = wp.where(y < 0, y + picture[2], y)
    texel = mesh_colors.texels[picture[0] + y * picture[1] + x]
    return wp.vec4(float(texel[0]), float(texel[1]), float(texel[2]), float(texel[3])) / 255.0


@wp.func
def picture_color(mesh_colors: SurfaceColors, picture: wp.vec3i, uv: wp.vec2):
    """Bilinear colour of a picture, whose texels have their centres at halves."""
    x = (uv[0] - wp.floor(uv[0])) * float(picture[1]) - 0.5
    y = (uv[1] - wp.floor(uv[1])) * float(picture[2]) - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    a = x - float(column)
    b = y - float(row)
    upper = (1.0 - a) * texel_color(mesh_colors, picture, column, row)
    upper += a * texel_color(mesh_colors, picture, column + 1, row)
    lower = (1.0 - a) * texel_color(mesh_colors, picture, column, row + 1)
    lower += a * texel_color(mesh_colors, picture, column + 1, row + 1)
    return (1.0 - b) * upper + b * lower


@wp.func
def surface_color(mesh_colors: SurfaceColors, face: int, u: float, v: float, cosine: float):
    """Colour of a point of a face; u, v: barycentric weights of its first two corners; cosine: of ray and normal."""
    i = mesh_colors.faces[3 * face]
    j = mesh_colors.faces[3 * face + 1]
    k = mesh_colors.faces[3 * face + 2]
    w = 1.0 - u - v
    color = u * mesh_colors.colors[i] + v * mesh_colors.colors[j] + w * mesh_colors.colors[k]
    number = mesh_colors.face_pictures[face]
    if number >= 0:
        uv = u * mesh_colors.uv[i] + v * mesh_colors.uv[j] + w * mesh_colors.uv[k]
        return wp.cw_mul(color, picture_color(mesh_colors, mesh_colors.pictures[number], uv))
    if number == HEADLIGHT:
        light = MIN_LIGHT + (1.0 - MIN_LIGHT) * wp.abs(cosine)
        return wp.vec4(light * color[0], light * color[1], light * color[2], color[3])
    return color


@wp.kernel
def cast_surface_rays(
    first: int,
    mesh: wp.uint64,
    mesh_colors: SurfaceColors,
    camera: PinholeCamera,  # in the mesh's coordinates and units
    farthest: float,  # how far rays go
    skip: float,  # how far behind a clear surface the next one is looked for
    behind: wp.vec3,
    rgb: wp.array(dtype=wp.vec3),
    alpha: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """One item a pixel, through its centre; rgb before `behind`, alpha and depth (h * w,): mean distance of what is
    seen, inf for nothing."""
    n = first + wp.tid()
    direction = pixel_direction(camera, n % camera.width, n // camera.width)
    color = wp.vec3()
    light = float(1.0)
    total = float(0.0)
    begin = float(0.0)
    met = int(0)
    while met < MAX_SURFACES and light > MIN_TRANSMITTANCE and begin < farthest:
        query = wp.mesh_query_ray(mesh, camera.center + begin * direction, direction, farthest - begin)
        if query.result:
            distance = begin + query.t
            cosine = wp.dot(wp.normalize(query.normal), direction)
            own = surface_color(mesh_colors, query.face, query.u, query.v, cosine)
            weight = light * wp.clamp(own[3], 0.0, 1.0)
            color += weight * wp.vec3(own[0], own[1], own[2])
            total += weight * distance
            light -= weight
            begin = distance + skip
            met += 1
        else:
            begin = farthest
    covered = 1.0 - light
    rgb[n] = color + light * behind
    alpha[n] = covered
    depth[n] = wp.where(covered > 0.0, total / wp.max(covered, 1.0e-12), wp.inf)
