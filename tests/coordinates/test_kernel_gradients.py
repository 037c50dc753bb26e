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


@wp.kernel
def move_by_mean_value(
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    moved: wp.array(dtype=wp.vec3),
):
    n = wp.tid()
    moved[n] = mean_value.mean_value_position(points[n], vertices, faces, fans, targets, 1.0)


@wp.kernel
def move_by_green(
    points: wp.array(dtype=wp.vec3),
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    fans: wp.array(dtype=wp.vec4),
    targets: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    moved: wp.array(dtype=wp.vec3),
):
    n = wp.tid()
    moved[n] = green.green_position(points[n], vertices, faces, fans, targets, normals, 1.0)


@wp.kernel
def weigh_faces(
    corners: wp.array2d(dtype=wp.vec3),
    weights: wp.array(dtype=wp.vec3),
    phi: wp.array(dtype=wp.vec3),
    psi: wp.array(dtype=float),
):
    n = wp.tid()
    weights[n] = mean_value.face_weights(corners[n, 0], corners[n, 1], corners[n, 2], 1.0).weights
    integrals = green.face_integrals(corners[n, 0], corners[n, 1], corners[n, 2], 1.0)
    phi[n] = integrals.phi
    psi[n] = integrals.psi


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

    def differences(self, what, rows, step=1e-5):
        """Central differences of the loss by rows of points or vertices."""
        base, by = getattr(self, what), np.zeros((len(rows), 3))
        for row, which in enumerate(rows):
            for axis in range(3):
                low, high = base.copy(), base.copy()
                low[which, axis] -= step
                high[which, axis] += step
                change = self.loss(**{what: high}) - self.loss(**{what: low})
                by[row, axis] = change.sum() / (2 * step)
        return by

    def gradients(self, device, wanted=("points", "vertices", "targets", "normals")):
        arrays = {
            name: wp.array(getattr(self, name), dtype=wp.vec3, device=device, requires_grad=name in wanted)
            for name in ("points", "vertices", "targets", "normals")
        }
        faces = wp.array(self.faces, dtype=wp.vec3i, device=device)
        fans = prepared_fans(arrays["vertices"], faces, 1.0)
        moved = wp.zeros(len(self.points), dtype=wp.vec3, device=device, requires_grad=True)
        inputs = [arrays["points"], arrays["vertices"], faces, fans, arrays["targets"]]
        kernel = move_by_mean_value
        if self.kind == "green":
            kernel, inputs = move_by_green, [*inputs, arrays["normals"]]
        with wp.Tape() as tape:
            wp.launch(kernel, len(self.points), inputs, [moved], device=device)
        tape.backward(grads={moved: wp.array(self.directions, dtype=wp.vec3, device=device)})
        return {name: arrays[name].grad.numpy() for name in wanted}, moved.numpy()


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
    close(found["points"], problem.differences("points", range(COUNT)), 1e-4)
    close(found["vertices"], problem.differences("vertices", range(len(vertices))), 1e-4)
    phi, psi = weights_of(kind, problem.points, problem.vertices, problem.faces)
    close(found["targets"], phi.T @ problem.directions, 1e-4)
    if kind == "green":
        close(found["normals"], psi.T @ problem.directions, 1e-4)


@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_points_in_the_planes_of_far_faces(kind, device):
    """Faces that weigh nothing there still have slopes: differences across the plane see them."""
    points = np.array([[-0.3, -0.1, 0.1], [-0.4, -0.1, -0.05], [-0.1, -0.3, 0.1], [-0.1, -0.4, 0.02]])
    problem = Problem(kind, "concave", points)
    found, _ = problem.gradients(device, ("points",))
    close(found["points"], problem.differences("points", range(len(points)), step=1e-3), 2e-3)


@pytest.mark.parametrize("distance", [1e-2, 1e-3])
@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_points_next_to_the_cage(kind, distance, device):
    vertices, faces = cage_of("icosphere")
    points, _ = oracles.points_by_the_cage(vertices, faces, "face", distance, count=12)
    problem = Problem(kind, "icosphere", points)
    found, _ = problem.gradients(device, ("points",))
    close(found["points"], problem.differences("points", range(12), step=1e-3 * distance), 2e-3)


@pytest.mark.parametrize("kind", ["mean_value", "green"])
def test_points_on_the_cage_have_slopes_of_inside(kind, device):
    vertices, faces = cage_of("icosphere")
    corners = vertices[faces[:6]]
    normal = oracles.unit_normals(vertices, faces)[:6]
    on = np.einsum("k,fki->fi", [0.5, 0.3, 0.2], corners)
    inner = Problem(kind, "icosphere", on - 1e-4 * normal)
    found, _ = Problem(kind, "icosphere", on).gradients(device, ("points",))
    close(found["points"], inner.differences("points", range(6), step=1e-6), 1e-2)


def test_gradients_of_some_arrays_alone(device):
    """Arrays that no gradient is asked of have no memory for one, and nothing is written there."""
    problem = Problem("green", "box", 0.9 * oracles.inside_points(*cage_of("box"), 8))
    alone, _ = problem.gradients(device, ("points",))
    together, _ = problem.gradients(device)
    np.testing.assert_array_equal(alone["points"], together["points"])


def test_faces_alone(device):
    """face_weights and face_integrals, of faces seen from the origin; on the face they have no slope: NaN."""
    corners = oracles.single(np.random.default_rng(5).normal(size=(10, 3, 3)))
    directions = np.random.default_rng(6).normal(size=(10, 7)).astype(np.float32)
    corners[9] = [[1, 0, 0], [-1, 1, 0], [-1, -1, 0]]
    given = wp.array(corners, dtype=wp.vec3, device=device, requires_grad=True)
    weights, phi = (wp.zeros(10, dtype=wp.vec3, device=device, requires_grad=True) for _ in range(2))
    psi = wp.zeros(10, dtype=float, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(weigh_faces, 10, [given], [weights, phi, psi], device=device)

    def slopes(**wanted):
        tape.zero()
        outputs = {"weights": weights, "phi": phi, "psi": psi}
        tape.backward(
            grads={
                array: wp.array(wanted[name] if name in wanted else np.zeros(array.numpy().shape), dtype=array.dtype)
                for name, array in outputs.items()
            }
        )
        return given.grad.numpy()

    def face_of(kind, moved):
        found = np.zeros((10, 4))
        for n in range(9):
            if kind == "phi":
                one, two = oracles.green_weights_in_closed_form(np.zeros((1, 3)), moved[n], np.array([[0, 1, 2]]))
                found[n] = [*one[0], two[0, 0]]
            else:
                found[n, :3] = raw_mean_value(moved[n])
        return found

    def differences(kind, along):
        by = np.zeros((10, 3, 3))
        for corner in range(3):
            for axis in range(3):
                step = np.zeros((3, 3))
                step[corner, axis] = 1e-6
                change = face_of(kind, corners + step) - face_of(kind, corners - step)
                by[:, corner, axis] = (change * along).sum(axis=1) / 2e-6
        return by[:9]

    found = slopes(weights=directions[:, :3])
    close(found[:9], differences("weights", np.pad(directions[:, :3], ((0, 0), (0, 1)))), 1e-4)
    assert np.isnan(found[9]).all()
    found = slopes(phi=directions[:, 3:6], psi=directions[:, 6])
    close(found[:9], differences("phi", directions[:, 3:]), 1e-4)
    assert np.isnan(found[9]).all()


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
    """Functions in C++, through which Warp passes nothing unless told how."""
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
    found = wp.zeros((6, 7), dtype=float, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(read_quickly, 6, list(arrays.values()), [found], device=device)
    tape.backward(grads={found: wp.array(along, dtype=float, device=device)})
    for name, host in hosts.items():
        by = np.zeros(host.shape)
        for place in np.ndindex(host.shape):
            low, high = host.copy(), host.copy()
            low[place] -= 1e-5
            high[place] += 1e-5
            by[place] = (loss(**{**hosts, name: high}) - loss(**{**hosts, name: low})) / 2e-5
        close(arrays[name].grad.numpy(), by, 2e-4)


@wp.kernel
def weigh_far_faces(corners: wp.array2d(dtype=wp.vec3), weights: wp.array(dtype=wp.vec3)):
    n = wp.tid()
    a = corners[n, 0]
    b = corners[n, 1]
    c = corners[n, 2]
    det = wp.dot(wp.cross(b - a, c - a), a)
    edge_ba = mean_value.face_edge(b, a)
    weights[n] = mean_value.far_face_weights(edge_ba, mean_value.face_edge(b, c), mean_value.face_edge(c, a), det)


def test_parts_of_a_face_alone(device):
    """Functions without loops go through Warp's own adjoints, quick roots in them too."""
    corners = oracles.single(np.random.default_rng(7).normal(size=(10, 3, 3)))
    along = np.random.default_rng(8).normal(size=(10, 3)).astype(np.float32)
    given = wp.array(corners, dtype=wp.vec3, device=device, requires_grad=True)
    weights = wp.zeros(10, dtype=wp.vec3, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(weigh_far_faces, 10, [given], [weights], device=device)
    tape.backward(grads={weights: wp.array(along, dtype=wp.vec3, device=device)})
    by = np.zeros((10, 3, 3))
    for n in range(10):
        for corner, axis in np.ndindex(3, 3):
            step = np.zeros((3, 3))
            step[corner, axis] = 1e-6
            by[n, corner, axis] = (
                (raw_mean_value(corners[n] + step) - raw_mean_value(corners[n] - step)) @ along[n] / 2e-6
            )
    np.testing.assert_allclose(given.grad.numpy(), by, rtol=2e-3, atol=2e-3 * np.abs(by).mean())


@wp.kernel
def look_up(data: cage_map.CageMap, points: wp.array(dtype=wp.vec3), moved: wp.array(dtype=wp.vec3)):
    n = wp.tid()
    moved[n] = cage_map.map_position(data, points[n])


def test_the_map_on_a_lattice(device):
    """By the point; of a similarity the slopes are the same everywhere."""
    vertices, faces = cage_of("icosphere")
    turn = oracles.single(np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0])
    turn *= np.sign(np.linalg.det(turn))
    deformed = Cage(vertices @ turn.T, faces)
    data = (
        PositionMap(Cage(vertices, faces), coordinates="mean_value", resolution=24, device=device).pose(deformed).data
    )
    points = 0.6 * oracles.inside_points(deformed.vertices, faces, 30)
    along = np.random.default_rng(2).normal(size=(30, 3)).astype(np.float32)
    given = wp.array(points, dtype=wp.vec3, device=device, requires_grad=True)
    moved = wp.zeros(30, dtype=wp.vec3, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(look_up, 30, [data, given], [moved], device=device)
    tape.backward(grads={moved: wp.array(along, dtype=wp.vec3, device=device)})
    np.testing.assert_allclose(given.grad.numpy(), along @ turn.T, atol=2e-3)


@pytest.mark.parametrize("arch", [75])
def test_ways_back_compile_for_cuda_without_a_gpu(arch, tmp_path, monkeypatch):
    """As kernels that people write are compiled by default, with their ways back."""
    module = wp.get_module(__name__)
    module.get_module_identifier()  # its name in the cache, of the level that users get, is kept
    monkeypatch.setattr(wp.config, "optimization_level", 2)
    wp.compile_aot_module(module, arch=arch, module_dir=str(tmp_path), use_ptx=arch == 75)
    (binary,) = tmp_path.glob("*.ptx" if arch == 75 else "*.cubin")
    assert binary.stat().st_size > 10_000
