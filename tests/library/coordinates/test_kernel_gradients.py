"""Gradients of the closed forms where a kernel of somebody's own calls them, beside central differences in float64."""

import numpy as np
import oracles
import pytest
import warp as wp

from warpcage import Cage, PositionMap
from warpcage.kernels.coordinates import green, mean_value
from warpcage.kernels.core import loads
from warpcage.kernels.lattice import cage_map
from warpcage.mesh.mesh import prepared_fans

COUNT = 24
SLIVER = "sliver"

if not wp.is_cuda_available():
    wp.set_module_options({"optimization_level": 0})  # compiled in half the time


@wp.kernel
def move(
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    is_green: int,
    moved: wp.array(dtype=wp.vec3),
):
    n = wp.tid()
    if is_green == 1:
        moved[n] = green.green_position(points[n], vertices, faces, fans, targets, normals, 1.0)
    else:
        moved[n] = mean_value.mean_value_position(points[n], vertices, faces, fans, targets, 1.0)


@wp.kernel
def weigh_faces(corners: wp.array2d(dtype=wp.vec3), found: wp.array2d(dtype=float)):
    """Mean value weights, Green's phi and psi, and mean value weights as faces far from the point have them."""
    n = wp.tid()
    a = corners[n, 0]
    b = corners[n, 1]
    c = corners[n, 2]
    weights = mean_value.face_weights(a, b, c, 1.0).weights
    integrals = green.face_integrals(a, b, c, 1.0)
    edge = mean_value.face_edge(b, a)
    det = wp.dot(wp.cross(b - a, c - a), a)
    far = mean_value.far_face_weights(edge, mean_value.face_edge(b, c), mean_value.face_edge(c, a), det)
    for k in range(3):
        found[n, k] = weights[k]
        found[n, 3 + k] = integrals.phi[k]
        found[n, 7 + k] = far[k]
    found[n, 6] = integrals.psi


def cage_of(name):
    return oracles.cage_with_sliver(1e-3) if name == SLIVER else oracles.cage(name)


def weights_of(kind, points, vertices, faces):
    if kind == "mean_value":
        return oracles.mean_value_weights(points, vertices, faces), np.zeros((len(points), len(faces)))
    return oracles.green_weights_in_closed_form(points, vertices, faces)


class Problem:
    """loss = sum of directions . moved points, its gradients by a wp.Tape, and the float64 formula of the same."""

    def __init__(self, kind, name, points):
        random = np.random.default_rng(3)
        self.kind, self.points = kind, oracles.single(points)
        self.vertices, faces = cage_of(name)
        topology = Cage(self.vertices, faces).topology
        self.faces = topology.fans.faces
        self.targets = oracles.single(self.vertices + 0.2 * random.normal(size=self.vertices.shape))
        self.normals = oracles.single(random.normal(size=self.faces.shape))
        self.directions = oracles.single(random.normal(size=self.points.shape))

    def loss(self, points=None, vertices=None):
        """(n,), of each point."""
        phi, psi = weights_of(
            self.kind,
            self.points if points is None else points,
            self.vertices if vertices is None else vertices,
            self.faces,
        )
        return ((phi @ self.targets + psi @ self.normals) * self.directions).sum(axis=1)

    def differences_by_points(self, step=1e-5):
        """Central differences (n, 3): of each point, whose loss no other one changes."""
        ahead, behind = ([self.loss(points=self.points + s * step) for s in np.eye(3)] for step in (step, -step))
        return (np.array(ahead) - np.array(behind)).T / (2 * step)

    def difference_by_vertices(self, along):
        """Central difference of the sum of losses as vertices move along (v, 3)."""
        ahead, behind = (self.loss(vertices=self.vertices + step * along).sum() for step in (1e-5, -1e-5))
        return (ahead - behind) / 2e-5

    def gradients(self, device, wanted=("points", "vertices", "targets", "normals")):
        arrays = {
            name: wp.array(getattr(self, name), dtype=wp.vec3, device=device, requires_grad=name in wanted)
            for name in ("points", "vertices", "targets", "normals")
        }
        faces = wp.array(self.faces, dtype=wp.vec3i, device=device)
        fans = prepared_fans(arrays["vertices"], faces, 1.0)
        inputs = [arrays["points"], arrays["vertices"], faces, fans, arrays["targets"], arrays["normals"]]
        moved = go_back(move, [*inputs, int(self.kind == "green")], self.directions)
        return {name: arrays[name].grad.numpy() for name in wanted}, moved


def go_back(kernel, inputs, along):
    """Launch a kernel that finds an array of a vector, or of three numbers, of each thread, and go back along this."""
    device = inputs[0].device
    dtype = wp.vec3 if along.shape[-1] == 3 else float
    given = wp.array(along, dtype=dtype, device=device)
    found = wp.zeros(given.shape, dtype=dtype, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(kernel, len(along), inputs, [found], device=device)
    tape.backward(grads={found: given})
    return found.numpy()


def differences(loss, host, step):
    """Central differences of a number by each entry of an array."""
    by = np.zeros(host.shape)
    for place in np.ndindex(host.shape):
        change = np.zeros(host.shape)
        change[place] = step
        by[place] = (loss(host + change) - loss(host - change)) / (2 * step)
    return by


def close(found, expected, share):
    scale = np.abs(expected).max()
    assert np.isfinite(found).all() and np.abs(found).max() > 0.1 * scale > 0
    np.testing.assert_allclose(found, expected, atol=share * scale, rtol=share)


@pytest.mark.parametrize("name", ["icosphere", "box", "concave", "two boxes", SLIVER])
@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_gradients_are_central_differences(kind, name, device):
    vertices, faces = cage_of(name)
    problem = Problem(kind, name, 0.97 * oracles.inside_points(vertices, faces, COUNT))
    found, moved = problem.gradients(device)
    np.testing.assert_allclose((moved * problem.directions).sum(axis=1), problem.loss(), atol=1e-4)
    close(found["points"], problem.differences_by_points(), 1e-4)
    some = range(len(vertices)) if len(vertices) < 20 else [*range(0, len(vertices), 5), len(vertices) - 1]
    steps = np.eye(3 * len(vertices)).reshape(-1, 3, len(vertices), 3)[some].reshape(-1, len(vertices), 3)
    steps = [*steps, *np.random.default_rng(4).normal(size=(3, len(vertices), 3))]  # and of all at once
    expected = np.array([problem.difference_by_vertices(step) for step in steps])
    close((found["vertices"] * steps).sum(axis=(1, 2)), expected, 1e-4)
    phi, psi = weights_of(kind, problem.points, problem.vertices, problem.faces)
    close(found["targets"], phi.T @ problem.directions, 1e-4)
    if kind == "green":
        close(found["normals"], psi.T @ problem.directions, 1e-4)


def special_points(where):
    """A cage, points, where to take differences instead, their step, and the largest error."""
    if where == "planes":  # of far faces: they weigh nothing there and still have slopes, which differences across see
        points = np.array([[-0.3, -0.1, 0.1], [-0.4, -0.1, -0.05], [-0.1, -0.3, 0.1], [-0.1, -0.4, 0.02]])
        return "concave", points, points, 1e-3, 2e-3
    vertices, faces = cage_of("icosphere")
    if where == "on":  # slopes are those of inside
        on = np.einsum("k,fki->fi", [0.5, 0.3, 0.2], vertices[faces[:6]])
        return "icosphere", on, on - 1e-4 * oracles.unit_normals(vertices, faces)[:6], 1e-6, 1e-2
    points, _ = oracles.points_by_the_cage(vertices, faces, "face", where, count=12)
    return "icosphere", points, points, 1e-3 * where, 2e-3


@pytest.mark.parametrize("where", ["planes", 1e-2, 1e-3, "on"])
@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_gradients_by_points_next_to_the_cage_and_in_planes_of_faces(kind, where, device):
    name, points, instead, step, share = special_points(where)
    found, _ = Problem(kind, name, points).gradients(device, ("points",))
    close(found["points"], Problem(kind, name, instead).differences_by_points(step), share)


def test_gradients_of_some_arrays_alone(device):
    """Arrays that no gradient is asked of have no memory for one, and nothing is written there."""
    problem = Problem("green", "box", 0.9 * oracles.inside_points(*cage_of("box"), 8))
    alone, _ = problem.gradients(device, ("points",))
    together, _ = problem.gradients(device)
    np.testing.assert_array_equal(alone["points"], together["points"])


def test_faces_alone(device):
    """Seen from the origin. On the face the whole functions have no slope, NaN; the part for far faces has no loops and
    goes through Warp's own adjoints, quick roots in them too."""
    corners = oracles.single(np.random.default_rng(5).normal(size=(10, 3, 3)))
    corners[9] = [[1, 0, 0], [-1, 1, 0], [-1, -1, 0]]
    directions = np.random.default_rng(6).normal(size=(10, 10)).astype(np.float32)
    for columns, of_face, share in ((range(3), raw_mean_value, 1e-4), (range(3, 7), raw_green, 1e-4),
                                    (range(7, 10), raw_mean_value, 1e-3)):  # fmt: skip
        along = np.where(np.isin(np.arange(10), columns), directions, 0)
        given = wp.array(corners, dtype=wp.vec3, device=device, requires_grad=True)
        go_back(weigh_faces, [given], along)
        faces = zip(corners[:9], along[:9, columns], strict=True)
        by = np.array([differences(lambda moved, w=w, f=of_face: f(moved) @ w, face, 1e-6) for face, w in faces])
        close(given.grad.numpy()[:9], by, share)
        assert np.isnan(given.grad.numpy()[9]).all()


def raw_green(corners):
    phi, psi = oracles.green_weights_in_closed_form(np.zeros((1, 3)), corners, np.array([[0, 1, 2]]))
    return np.array([*phi[0], psi[0, 0]])


def raw_mean_value(corners):
    """Weights of one face, not normalised: Floater, Kos and Reimers 2005."""
    crosses = np.cross(corners[[1, 2, 0]], corners[[2, 0, 1]])
    sines, cosines = np.linalg.norm(crosses, axis=1), (corners[[1, 2, 0]] * corners[[2, 0, 1]]).sum(axis=1)
    mean = (crosses * (np.arctan2(sines, cosines) / sines)[:, None]).sum(axis=0)
    return crosses @ mean / (2 * np.linalg.det(corners))


@wp.kernel
def read_quickly(
    numbers: wp.array(dtype=float),
    vectors: wp.array(dtype=wp.vec3),
    rows: wp.array(dtype=wp.vec4),
    grid: wp.array3d(dtype=float),
    found: wp.array2d(dtype=float),
):
    n = wp.tid()
    x = numbers[n]
    found[n, 0] = loads.reciprocal_root(x)
    found[n, 1] = loads.near_root(x)
    found[n, 2] = loads.near_exp(x)
    found[n, 3] = loads.near_reciprocal(x)
    vector = loads.vec3_entry(vectors, n)
    found[n, 4] = vector[0] * vector[1] * vector[2]
    row = loads.vec4_entry(rows, n)
    found[n, 5] = row[0] * row[3] + row[1] * row[2]
    found[n, 6] = loads.trilinear_entry(grid, vector, x)


def test_quick_reads_and_roots(device):
    """Functions in C++, through which Warp passes no gradients unless they are given."""
    random = np.random.default_rng(2)
    hosts = {
        "numbers": random.uniform(0.5, 3.0, 6),
        "vectors": random.uniform(0.1, 2.9, (6, 3)),
        "rows": random.normal(size=(6, 4)),
        "grid": random.normal(size=(4, 4, 4)),
    }
    hosts["vectors"][5] = [9, 9, 9]  # beyond the grid
    dtypes = {"numbers": float, "vectors": wp.vec3, "rows": wp.vec4, "grid": float}
    along = random.normal(size=(6, 7)).astype(np.float32)

    def loss(numbers, vectors, rows, grid):
        x, (i, j, k) = numbers, np.minimum(vectors.astype(int), 2).T
        u, v, w = (vectors - np.stack([i, j, k], axis=1)).T
        mixed = sum(
            grid[i + p, j + q, k + r] * (u if p else 1 - u) * (v if q else 1 - v) * (w if r else 1 - w)
            for p in (0, 1)
            for q in (0, 1)
            for r in (0, 1)
        )
        mixed = np.where((vectors < 3).all(axis=1), mixed, x)
        product = rows[:, 0] * rows[:, 3] + rows[:, 1] * rows[:, 2]
        columns = [1 / np.sqrt(x), np.sqrt(x), np.exp(x), 1 / x, vectors.prod(axis=1), product, mixed]
        return (np.stack(columns, axis=1) * along).sum()

    arrays = {name: wp.array(hosts[name], dtype=dtypes[name], device=device, requires_grad=True) for name in hosts}
    go_back(read_quickly, list(arrays.values()), along)
    for name, host in hosts.items():
        by = differences(lambda moved, name=name: loss(**{**hosts, name: moved}), host, 1e-5)
        close(arrays[name].grad.numpy(), by, 2e-4)


@wp.kernel
def look_up(points: wp.array(dtype=wp.vec3), data: cage_map.CageMap, moved: wp.array(dtype=wp.vec3)):
    n = wp.tid()
    moved[n] = cage_map.map_position(data, points[n])


def test_the_map_on_a_lattice(device):
    """By the point; of a similarity the slopes are the same everywhere."""
    vertices, faces = cage_of("icosphere")
    turn = oracles.single(np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0])
    turn *= np.sign(np.linalg.det(turn))
    deformed = Cage(vertices @ turn.T, faces)
    position_map = PositionMap(Cage(vertices, faces), coordinates="mean_value", resolution=24, device=device)
    data = position_map.pose(deformed).data
    points = 0.6 * oracles.inside_points(deformed.vertices, faces, 30)
    along = np.random.default_rng(2).normal(size=(30, 3)).astype(np.float32)
    given = wp.array(points, dtype=wp.vec3, device=device, requires_grad=True)
    go_back(look_up, [given, data], along)
    np.testing.assert_allclose(given.grad.numpy(), along @ turn.T, atol=2e-3)


def test_ways_back_compile_for_cuda_without_a_gpu(tmp_path, pytestconfig):
    """As kernels that people write are compiled, with their ways back; those that did once are not compiled again."""
    module, cache = wp.get_module(__name__), getattr(pytestconfig, "cache", None)
    identifier = module.get_module_identifier()
    if cache is None or cache.get("cuda/ways_back", None) != identifier:
        wp.compile_aot_module(module, arch=75, module_dir=str(tmp_path), use_ptx=True)
        (binary,) = tmp_path.glob("*.ptx")
        assert binary.stat().st_size > 10_000
    if cache is not None:
        cache.set("cuda/ways_back", identifier)
