"""Float64 (or longer) NumPy references for cages and their coordinates, written from other formulas than the kernels.

Those of coordinates take points (n, 3), vertices (v, 3), faces (f, 3) and return weights (n, v), psi (n, f) or values
(n, k).
"""

import functools

import numpy as np

GAUSS_POINTS = 24


def icosphere(subdivisions: int = 1):
    """Unit icosphere, its vertices moved a little (seed 0) so that nothing is symmetric: vertices, faces."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.array(mesh.vertices)
    return 0.5 * (vertices + 0.04 * np.random.default_rng(0).uniform(-1, 1, vertices.shape)), np.array(mesh.faces)


def box():
    """Box of sides 1, 0.8, 0.6 about the origin, 12 triangles."""
    import trimesh

    mesh = trimesh.creation.box((1.0, 0.8, 0.6))
    return np.array(mesh.vertices), np.array(mesh.faces)


def concave_l():
    """L-shaped prism, 1 x 1 x 0.5, with a reflex edge along z at (-0.1, -0.1)."""
    outline = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, -0.1], [-0.1, -0.1], [-0.1, 0.5], [-0.5, 0.5]])
    low = np.column_stack([outline, np.full(6, -0.25)])
    high = np.column_stack([outline, np.full(6, 0.25)])
    top = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    sides = [face for i in range(6) for j in [(i + 1) % 6] for face in ([i, j, j + 6], [i, j + 6, i + 6])]
    return np.concatenate([low, high]), np.concatenate([top[:, ::-1], top + 6, sides])


def two_boxes():
    """Two separate boxes side by side along x."""
    vertices, faces = box()
    return (
        np.concatenate([0.4 * vertices - [0.4, 0, 0], 0.5 * vertices + [0.4, 0, 0]]),
        np.concatenate([faces, faces + len(vertices)]),
    )


def cage_with_sliver(height: float):
    """An icosphere one face of which is cut in three, by a vertex this far inside one of its edges."""
    vertices, faces = icosphere(1)
    a, b, c = faces[0]
    middle = (vertices[a] + vertices[b]) / 2
    up = (vertices[c] - middle) / np.linalg.norm(vertices[c] - middle)
    new = len(vertices)
    return (
        single(np.concatenate([vertices, [middle + height * up]])),
        np.concatenate([faces[1:], [[a, b, new], [b, c, new], [c, a, new]]]),
    )


CAGES = {
    "icosphere": lambda: icosphere(1),
    "fine icosphere": lambda: icosphere(2),
    "box": box,
    "concave": concave_l,
    "two boxes": two_boxes,
}


def winding_numbers(points, vertices, faces):
    """Winding number (n,), from the spherical excess of each face: dihedral angles less pi."""
    points, corners = np.asarray(points, np.float64), np.asarray(vertices, np.float64)[faces]
    found = np.zeros(len(points))
    step = max(1, 20_000 // len(faces))  # points at once: what is in the cache is computed in a third of the time
    for first in range(0, len(points), step):
        x = points[first : first + step, :, None]
        a, b, c = ([corners[None, :, k, i] - x[:, i] for i in range(3)] for k in range(3))
        normals = [_cross(b, c), _cross(c, a), _cross(a, b)]
        lengths = [np.sqrt(_dot(normal, normal)) for normal in normals]
        excess = -np.pi
        for k, after in ((0, 1), (1, 2), (2, 0)):
            cosine = -_dot(normals[k], normals[after]) / np.maximum(lengths[k] * lengths[after], 1e-300)
            excess = excess + np.arccos(np.clip(cosine, -1, 1))
        found[first : first + step] = (np.sign(_dot(a, normals[0])) * excess).sum(axis=1) / (4 * np.pi)
    return found


def _cross(a, b):
    """Cross product of vectors given by their three coordinates."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _crossed(a, b):
    """Cross products of rows (n, 3): a third of the time of np.cross."""
    return np.stack(_cross(a.T, b.T), axis=1)


def _lengths(rows):
    return np.sqrt(_dot(rows.T, rows.T))


def inside_points(vertices, faces, count: int, seed: int = 1):
    """`count` uniform random points inside a closed mesh."""
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    return _inside_points(vertices.tobytes(), faces.tobytes(), count, seed).copy()


@functools.cache  # many tests ask for the same
def _inside_points(vertices, faces, count, seed):
    vertices, faces = np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3)
    random = np.random.default_rng(seed)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    found = np.zeros((0, 3))
    while len(found) < count:
        tried = random.uniform(low, high, (2 * count, 3))
        found = np.concatenate([found, tried[winding_numbers(tried, vertices, faces) > 0.5]])
    return found[:count]


def single(array):
    """Rounded to float32, in float64: what a kernel and a reference see alike."""
    return np.asarray(array, np.float32).astype(np.float64)


def cage(name):
    """A cage of CAGES with vertices that are float32 numbers."""
    vertices, faces = CAGES[name]()
    return single(vertices), faces


def unit_normals(vertices, faces):
    normal = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def points_near_planes(vertices, faces, height, count=250):
    """Inside points at a height off the plane of some face, and clear of the cage itself."""
    random = np.random.default_rng(5)
    points = inside_points(vertices, faces, 8 * count)
    which = random.integers(0, len(faces), len(points))
    normal = unit_normals(vertices, faces)[which]
    drop = np.einsum("nc,nc->n", vertices[faces[which, 0]] - points, normal) - height
    points = single(points + drop[:, None] * normal)
    return points[winding_numbers(points, vertices, faces) > 0.5][:count]


def points_by_the_cage(vertices, faces, kind, distance, count=300):
    """Points on random faces, edges or vertices, moved in by a distance along the mean normal there, and the weights of
    linear interpolation at the foot: (n, 3), (n, v)."""
    random = np.random.default_rng(6)
    which = random.integers(0, len(faces), count)
    share = random.dirichlet([1, 1, 1], count)
    if kind == "edge":
        share[:, 2] = 0
    if kind == "vertex":
        share[:, 1:] = 0
    share /= share.sum(axis=1, keepdims=True)
    weights = np.zeros((count, len(vertices)))
    np.put_along_axis(weights, faces[which], share, axis=1)
    normals = unit_normals(vertices, faces)
    touched = np.zeros((count, len(faces)))
    for f, face in enumerate(faces):
        touched[:, f] = weights[:, face].sum(axis=1) > 1 - 1e-9
    inward = -touched @ normals
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    return weights @ vertices + distance * inward, weights


def mean_value_weights(points, vertices, faces, dtype=np.longdouble):
    """Half-angle form of Ju, Schaefer and Warren 2005, figure 4 (points on no face): (n, v).

    Extended precision by default: the form cancels next to the planes of faces.
    """
    points, vertices = np.asarray(points, dtype), np.asarray(vertices, dtype)
    offsets = vertices[None] - points[:, None]
    distance = np.sqrt((offsets**2).sum(axis=2))
    unit = offsets / distance[:, :, None]
    weights = np.zeros(distance.shape, dtype)
    for face in faces:
        u = unit[:, face]
        chord = np.sqrt(((u[:, [1, 2, 0]] - u[:, [2, 0, 1]]) ** 2).sum(axis=2))
        theta = 2 * np.arcsin(np.minimum(chord / 2, 1))
        half = theta.sum(axis=1, keepdims=True) / 2
        after, before, sine = [1, 2, 0], [2, 0, 1], np.sin(theta)
        c = 2 * np.sin(half) * np.sin(half - theta) / (sine[:, after] * sine[:, before]) - 1
        side = np.sign((u[:, 0] * _crossed(u[:, 1], u[:, 2])).sum(axis=1))
        s = side[:, None] * np.sqrt(np.maximum(1 - c**2, 0))
        numerator = theta - c[:, after] * theta[:, before] - c[:, before] * theta[:, after]
        denominator = distance[:, face] * sine[:, after] * s[:, before]
        ok = denominator != 0
        add = np.where(ok, numerator / np.where(ok, denominator, 1), 0)
        for k in range(3):
            weights[:, face[k]] += add[:, k]
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float64)


def seen_faces(points, vertices, faces):
    """Faces as maximum likelihood coordinates have them (points on no face): weights of the corners in the integral m
    of the unit directions over the solid angle, (n, f, 3), m (n, f, 3), and that of the cosine, 0 from outside, (n, f).
    """
    points, corners = np.asarray(points, np.float64), np.asarray(vertices, np.float64)[faces]
    offsets = corners[None] - points[:, None, None]
    unit = offsets / np.linalg.norm(offsets, axis=3, keepdims=True)
    mean = np.zeros((len(points), len(faces), 3))
    for k in range(3):  # angle times normal of the planes through the sides
        u, v = unit[:, :, k], unit[:, :, (k + 1) % 3]
        plane = np.cross(u, v)
        plane /= np.maximum(np.linalg.norm(plane, axis=2, keepdims=True), 1e-300)
        mean += plane * np.arcsin(np.minimum(np.linalg.norm(u - v, axis=2, keepdims=True) / 2, 1))
    normals = unit_normals(vertices, faces)
    behind = np.einsum("fi,nfi->nf", normals, offsets[:, :, 0]) < 1e-12 * np.ptp(corners)
    systems = np.where(behind[..., None, None], np.eye(3), np.swapaxes(offsets, 2, 3))
    weights = np.linalg.solve(systems, mean[..., None])[..., 0]
    return weights, mean, np.where(behind, 0.0, np.einsum("fi,nfi->nf", normals, mean))


def seen_faces_by_quadrature(points, vertices, faces):
    """The same, each integral as it is defined, by Gauss quadrature on each face (points clear of the cage)."""
    hats, share = _triangle_rule()
    corners, normals = np.asarray(vertices, np.float64)[faces], unit_normals(vertices, faces)
    double_areas = np.linalg.norm(_crossed(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    offset = np.einsum("qk,fki->fqi", hats, corners)[None] - np.asarray(points)[:, None, None]
    distance = np.linalg.norm(offset, axis=3)
    cosine = np.einsum("nfqi,fi->nfq", offset, normals) / distance
    angle = share * double_areas[:, None] * cosine / distance**2  # solid angle of each node
    mean = np.einsum("nfq,nfqi->nfi", angle / distance, offset)
    weights = np.einsum("nfq,qk->nfk", angle / distance, hats)
    return weights, mean, np.where(angle[..., 0] > 0, (angle * cosine).sum(axis=2), 0.0)


def maximum_likelihood_weights(points, vertices, faces, seen=seen_faces):
    """The convex problem of each point (inside, on no face), solved by SciPy's trust region: (n, v). Shares y of faces
    have the largest sum of p log y of all whose directions cancel and whose sum is that of p."""
    from scipy.optimize import minimize, root

    corner_weights, means, priors = seen(points, vertices, faces)
    weights = np.zeros((len(points), len(vertices)))
    for row, corners, mean, prior in zip(weights, corner_weights, means, priors, strict=True):
        held = prior > 0
        prior, length = prior[held], np.linalg.norm(mean[held], axis=1)
        shape = np.column_stack([prior, prior, prior]) / prior.sum()
        direction = mean[held] / length[:, None]

        def value(phi, direction=direction, prior=prior):
            inside = 1 + direction @ phi
            return -(prior / prior.sum()) @ np.log(inside) if (inside > 0).all() else np.inf

        def slope(phi, direction=direction, shape=shape):
            return -(shape * direction / (1 + direction @ phi)[:, None]).sum(axis=0)

        def bend(phi, direction=direction, shape=shape):
            return (shape * direction / (1 + direction @ phi)[:, None] ** 2).T @ direction

        found = minimize(value, np.zeros(3), jac=slope, hess=bend, method="trust-exact", options={"gtol": 1e-6})
        found = root(slope, found.x, jac=bend, tol=1e-14)
        assert np.abs(slope(found.x)).max() < 1e-12
        y = prior / (1 + direction @ found.x)
        np.add.at(row, faces[held], (y / length)[:, None] * corners[held])
    return weights / weights.sum(axis=1, keepdims=True)


def _triangle_rule():
    """Gauss quadrature of a triangle: barycentric nodes (q, 3), and weights (q,) that add up to a half."""
    x, w = np.polynomial.legendre.leggauss(GAUSS_POINTS)
    x, w = (x + 1) / 2, w / 2
    s, t = (grid.reshape(-1) for grid in np.meshgrid(x, x, indexing="ij"))
    # the square folded on the triangle
    return np.stack([1 - s, s * (1 - t), s * t], axis=1), (w[:, None] * w[None]).reshape(-1) * s


def quad_cage(cells: int, bend: float, seed: int = 0):
    """A cube of side one of so many quads along each edge, whose vertices are off by about `bend` of a quad's side."""
    numbers, faces = {}, []
    for axis, side in ((axis, side) for axis in range(3) for side in (0, cells)):
        for i, j in np.ndindex(cells, cells):
            corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
            places = [tuple(np.roll((side, *corner), axis).tolist()) for corner in corners]
            face = [numbers.setdefault(place, len(numbers)) for place in places]
            faces.append(face if side else face[::-1])
    vertices = np.array(list(numbers)) / cells - 0.5
    return vertices + np.random.default_rng(seed).normal(size=vertices.shape) * (bend / cells), np.array(faces)


def bilinear(u, v):
    """Weights of the corners (0, 0), (1, 0), (1, 1), (0, 1): (..., 4)."""
    return np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1)


def on_quads(vertices, quads, count, seed=0):
    """Points on bilinear patches, their unit normals, and their weights: (count, 3), (count, 3), (count, v)."""
    random = np.random.default_rng(seed)
    quads = np.asarray(quads)[random.integers(len(quads), size=count)]
    u, v = random.uniform(size=(2, count))
    shares, corners = bilinear(u, v), vertices[quads]
    by_u = (1 - v)[:, None] * (corners[:, 1] - corners[:, 0]) + v[:, None] * (corners[:, 2] - corners[:, 3])
    by_v = (1 - u)[:, None] * (corners[:, 3] - corners[:, 0]) + u[:, None] * (corners[:, 2] - corners[:, 1])
    weights = np.zeros((count, len(vertices)))
    weights[np.arange(count)[:, None], quads] = shares
    normals = np.cross(by_u, by_v)
    return (shares[:, :, None] * corners).sum(axis=1), normals / np.linalg.norm(normals, axis=1, keepdims=True), weights


def quad_mean_value_weights(points, vertices, quads, order=12):
    """Mean value coordinates (n, v) by definition: integrals of the bilinear basis over distance over solid angles of
    bilinear patches, by Gauss-Legendre rules on squares that are quartered until they are clear of the point. float64;
    points on no patch."""
    nodes, shares = np.polynomial.legendre.leggauss(order)
    nodes, shares = (nodes + 1) / 2, np.outer(shares, shares) / 4
    weights = np.zeros((len(points), len(vertices)))
    for quad in np.asarray(quads):
        seen = vertices[quad] - np.asarray(points, np.float64)[:, None]
        rows, squares = np.arange(len(points)), np.tile([0.0, 0.0, 1.0], (len(points), 1))  # u, v of a corner, and side
        while len(rows):
            ends = squares[:, None, :2] + squares[:, None, 2:] * [[0, 0], [1, 0], [1, 1], [0, 1]]
            corners = np.einsum("tci,tij->tcj", bilinear(ends[..., 0], ends[..., 1]), seen[rows])
            middles = corners.mean(axis=1)
            radii = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
            clear = np.linalg.norm(middles, axis=1) > 2.5 * radii
            u, v = (squares[clear, k, None] + squares[clear, 2, None] * nodes for k in (0, 1))
            around = seen[rows[clear]]
            a, b, c, d = (around[:, k, None] for k in range(4))
            # slopes: each varies along the other direction alone
            along_u = (1 - v[..., None]) * (b - a) + v[..., None] * (c - d)
            along_v = (1 - u[..., None]) * (d - a) + u[..., None] * (c - b)
            basis = bilinear(u[:, :, None], v[:, None, :])
            x, normal = basis @ around[:, None], np.cross(along_u[:, None], along_v[:, :, None])
            value = np.einsum("tijc,tijc->tij", x, normal) / np.einsum("tijc,tijc->tij", x, x) ** 2 * shares
            found = np.einsum("tij,tijk->tk", value, basis) * squares[clear, 2:] ** 2
            np.add.at(weights, (rows[clear, None], quad), found)
            halves = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * 0.5
            parts = squares[~clear, None, :2] + squares[~clear, None, 2:] * halves
            side = np.broadcast_to(squares[~clear, None, 2:] / 2, (*parts.shape[:2], 1))
            rows, squares = np.repeat(rows[~clear], 4), np.concatenate([parts, side], axis=2).reshape(-1, 3)
    return weights / weights.sum(axis=1, keepdims=True)


def green_weights(points, vertices, faces):
    """Pseudo-code of Lipman, Levin and Cohen-Or 2008, appendix (points inside, on no plane): phi (n, v), psi (n, f)."""
    points, vertices = np.asarray(points, np.float64), np.asarray(vertices, np.float64)
    phi, psi = np.zeros((len(points), len(vertices))), np.zeros((len(points), len(faces)))
    zero = np.zeros_like(points)
    for f, face in enumerate(faces):
        corner = [vertices[i] - points for i in face]
        normal = np.cross(vertices[face[1]] - vertices[face[0]], vertices[face[2]] - vertices[face[0]])
        normal /= np.linalg.norm(normal)
        foot = (corner[0] @ normal)[:, None] * normal
        one, each, across = np.zeros(len(points)), [], []
        for k in range(3):
            v, w = corner[k], corner[(k + 1) % 3]
            sign = np.sign(_crossed(v - foot, w - foot) @ normal)
            one += sign * _gc_tri_int(foot, v, w, zero)
            each.append(_gc_tri_int(zero, w, v, zero))
            q = _crossed(w, v)
            across.append(q / _lengths(q)[:, None])
        one = -np.abs(one)
        psi[:, f] = -one
        w = one[:, None] * normal + sum(across[k] * each[k][:, None] for k in range(3))
        for k in range(3):
            n = across[(k + 1) % 3]
            phi[:, face[k]] += (n * w).sum(axis=1) / (n * corner[k]).sum(axis=1)
    return phi, psi


def _gc_tri_int(p, v1, v2, eta):
    """Integral of the Green's function over the triangle p, v1, v2: GCTriInt of the paper."""

    def angle(a, b):
        return np.arctan2(_lengths(_crossed(a, b)), _dot(a.T, b.T))

    alpha, beta = angle(v2 - v1, p - v1), angle(v1 - p, v2 - p)
    lam = ((p - v1) ** 2).sum(axis=1) * np.sin(alpha) ** 2
    c = ((p - eta) ** 2).sum(axis=1)

    def term(theta):
        s, cosine = np.sin(theta), np.cos(theta)
        inner = 1 - 2 * c * cosine / (c * (1 + cosine) + lam + np.sqrt(lam**2 + lam * c * s**2))
        log = np.log(2 * np.sqrt(lam) * s**2 / (1 - cosine) ** 2 * inner)
        root = np.sqrt(c)
        return -np.sign(s) / 2 * (2 * root * np.arctan(root * cosine / np.sqrt(lam + s**2 * c)) + np.sqrt(lam) * log)

    return -np.abs(term(np.pi - alpha) - term(np.pi - alpha - beta) - np.sqrt(c) * beta) / (4 * np.pi)


def green_weights_by_quadrature(points, vertices, faces):
    """The defining integrals by Gauss quadrature on each face (points clear of the cage): phi (n, v), psi (n, f)."""
    hats, weight = _triangle_rule()
    phi, psi = np.zeros((len(points), len(vertices))), np.zeros((len(points), len(faces)))
    for f, face in enumerate(faces):
        normal = np.cross(vertices[face[1]] - vertices[face[0]], vertices[face[2]] - vertices[face[0]])
        offset = hats @ vertices[face] - np.asarray(points)[:, None]
        distance = np.linalg.norm(offset, axis=2)
        psi[:, f] = (weight / distance).sum(axis=1) * np.linalg.norm(normal) / (4 * np.pi)
        kernel = weight * (offset @ normal) / distance**3 / (4 * np.pi)
        for k in range(3):
            phi[:, face[k]] += kernel @ hats[:, k]
    return phi, psi


def green_weights_in_closed_form(points, vertices, faces):
    """The layer potentials in float64: phi (n, v), psi (n, f). Good to 1e-7 of the cage, where GCTriInt loses digits.

    For points off the planes of faces next to them.
    """
    psi, phi = _layers(points, vertices[faces], np.eye(len(vertices))[faces])
    return phi, psi


def harmonic_oracle(vertices, faces, boundary_values, points, subdivisions: int = 2, graded: int | None = None):
    """Harmonic function inside a closed cage whose values on the cage are linear on each face, by boundary elements.

    boundary_values (v, k), points (n, 3) inside; every face is cut in 4**subdivisions elements of constant flux,
    collocated at their centroids: 1,280 elements solve in a second. graded: in (2 * graded)**2 instead, whose sides
    shrink towards the edges of the face, where fluxes are singular. Returns (n, k).
    """
    vertices, values = np.asarray(vertices, np.float64), np.asarray(boundary_values, np.float64)
    size = np.ptp(vertices, axis=0).max()
    center = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    corners, data = ((vertices - center) / size)[faces], values[faces]  # (f, 3, 3), (f, 3, k)
    if graded is not None:
        corners, data = _graded(corners, graded), _graded(data, graded)
    for _ in range(0 if graded is not None else subdivisions):
        corners, data = _quartered(corners), _quartered(data)
    middles = corners.mean(axis=1)
    single, boundary = _layers(middles, corners, data, own=True)
    flux = np.linalg.solve(single, data.mean(axis=1) - boundary)
    single, boundary = _layers((np.asarray(points, np.float64) - center) / size, corners, data)
    return boundary + single @ flux


def _quartered(corners):
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate([np.stack(part, axis=1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])


def _graded(corners, steps, power=2.0):
    """Triangles (f, 3, k) cut on a grid of barycentric coordinates that is finer towards all three edges."""
    count = 2 * steps
    s = np.linspace(0, 1, count + 1)
    s = np.where(s < 0.5, (2 * s) ** power, 2 - (2 - 2 * s) ** power) / 2
    i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
    k = count - i - j
    grid = np.stack([s[i], s[j], s[np.maximum(k, 0)]], axis=-1)
    grid /= grid.sum(axis=-1, keepdims=True)
    up = [(i, j) for i in range(count) for j in range(count - i)]
    down = [(i, j) for i in range(count - 1) for j in range(count - 1 - i)]
    shares = [(grid[i + 1, j], grid[i, j + 1], grid[i, j]) for i, j in up]
    shares += [(grid[i + 1, j + 1], grid[i, j + 1], grid[i + 1, j]) for i, j in down]
    return np.einsum("eac,fck->feak", np.array(shares), corners).reshape(-1, 3, corners.shape[2])


def _layers(points, corners, data, own=False, block=256):
    """Single layer matrix (n, f) of constant densities, and double layer (n, k) of the linear data on the triangles.

    own: the points are the centroids of the triangles, in order; each takes its own triangle's limit from inside.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    edges = np.stack([c - b, a - c, b - a], axis=1)
    lengths = np.linalg.norm(edges, axis=2)
    normal = np.cross(b - a, c - a)
    double_area = np.linalg.norm(normal, axis=1)
    normal = normal / double_area[:, None]
    outward = np.cross(edges, normal[:, None]) / lengths[:, :, None]  # in the plane, away from the triangle
    single, double = np.zeros((len(points), len(corners))), np.zeros((len(points), data.shape[2]))
    for start in range(0, len(points), block):
        p = corners[None] - points[start : start + block, None, None]  # (m, f, 3, 3)
        r = np.linalg.norm(p, axis=3)
        height = np.einsum("mfc,fc->mf", p[:, :, 0], normal)
        rim = np.einsum("mfic,fic->mfi", p[:, :, [1, 2, 0]], outward)  # distance of the foot behind edge i
        log = 2 * np.arctanh(np.minimum(lengths / (r[:, :, [1, 2, 0]] + r[:, :, [2, 0, 1]]), 1 - 1e-15))
        dots = np.einsum("mfic,mfic->mfi", p[:, :, [1, 2, 0]], p[:, :, [2, 0, 1]])
        angle = 2 * np.arctan2(height * double_area, r.prod(axis=2) + (dots * r).sum(axis=2))
        if own:
            rows = np.arange(len(angle))
            angle[rows, start + rows] = 2 * np.pi
        single[start : start + block] = ((rim * log).sum(axis=2) - height * angle) / (4 * np.pi)
        pull = np.einsum("mfi,fic->mfc", log, outward)
        barycentric = rim * lengths / double_area[:, None]
        slope = -outward * (lengths / double_area[:, None])[:, :, None]
        hats = (barycentric * angle[:, :, None] - height[:, :, None] * np.einsum("fic,mfc->mfi", slope, pull)) / (
            4 * np.pi
        )
        double[start : start + block] = np.einsum("mfi,fik->mk", hats, data)
    return single, double


def shuffled_cage(cage, seed=0):
    """The same mesh with vertices, faces and first corners in another order, and the new place of each vertex."""
    from warpcage import Cage

    rng = np.random.default_rng(seed)
    new = rng.permutation(len(cage.vertices))
    vertices = np.empty_like(cage.vertices)
    vertices[new] = cage.vertices
    faces = new[cage.faces][rng.permutation(len(cage.faces))]
    turn = (rng.integers(0, 3, len(faces))[:, None] + np.arange(3)) % 3
    return Cage(vertices, np.take_along_axis(faces, turn, axis=1))


def reference_distance(points, vertices, faces):
    """(n,) to the nearest triangle."""
    import trimesh

    nearest = np.full(len(points), np.inf)
    for face in faces:
        corners = np.repeat(vertices[face][None], len(points), axis=0)
        foot = trimesh.triangles.closest_point(corners, points)
        nearest = np.minimum(nearest, np.linalg.norm(foot - points, axis=1))
    return nearest


def arms(slot):
    """A prism 1 x 0.9 x 0.4 with a slot of this width between two arms: vertices, faces."""
    half = slot / 2
    outline = np.array([[-0.5, -0.45], [0.5, -0.45], [0.5, 0.45], [half, 0.45], [half, -0.1], [-half, -0.1],
                        [-half, 0.45], [-0.5, 0.45]])  # fmt: skip
    top = np.array([[0, 1, 5], [1, 4, 5], [1, 2, 4], [2, 3, 4], [0, 5, 7], [5, 6, 7]])
    sides = [face for i in range(8) for j in [(i + 1) % 8] for face in ([i, j, j + 8], [i, j + 8, i + 8])]
    vertices = np.concatenate([np.column_stack([outline, np.full(8, height)]) for height in (-0.2, 0.2)])
    return vertices, np.concatenate([top[:, ::-1], top + 8, sides])


def slot_cages(width, degrees, axis=(0.3, 0.2, 1)):
    """A narrow slot, the pose that opens it, and the turn of both."""
    import trimesh

    from warpcage import Cage

    vertices, faces = arms(width)
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), axis)[:3, :3]
    moved = vertices.copy()
    tips = vertices[:, 1] > 0.3
    moved[tips, 0] += np.where(vertices[tips, 0] > 0, 0.05, -0.05)
    return Cage(vertices @ turn.T, faces), Cage(moved @ turn.T, faces), turn


def points_beside_slot(width, cells, turn, count=3000):
    """Points within three cells of the walls of a slot."""
    random = np.random.default_rng(0)
    side = np.where(random.random(count) < 0.5, 1, -1)
    away = width / 2 + random.uniform(1e-4, 3 / cells, count)
    points = [side * away, random.uniform(-0.15, 0.449, count), random.uniform(-0.199, 0.199, count)]
    return np.column_stack(points) @ turn.T


def look_up(position_map, points):
    """Positions (n, 3) float64 in world units and signed distances (n,)."""
    import warp as wp

    from warpcage.core import launch
    from warpcage.kernels.lattice.cage_map import sample_map

    device = position_map.device
    local = wp.array((points - position_map.origin).astype(np.float32), dtype=wp.vec3, device=device)
    positions = wp.empty(len(points), dtype=wp.vec3, device=device)
    distance = wp.empty(len(points), dtype=float, device=device)
    launch(sample_map, len(points), [position_map.data, local], [positions, distance], device=device)
    return positions.numpy() + position_map.origin, distance.numpy()
