"""The harmonic solver: its equations, their solution, and the weights that come of it."""

import warnings

import numpy as np
import oracles
import pytest
import warp as wp
from messages import MESSAGES
from oracles import points_beside_slot, reference_distance, slot_cages
from refusals import refused
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve
from trimesh.transformations import rotation_matrix

from warpcage import Cage
from warpcage.coordinates import harmonic_weights
from warpcage.core import limit_threads
from warpcage.lattice import CageLattice, HarmonicSolver, NodeSections

CAGES = ("icosphere", "box", "concave", "two boxes")


def solver_of(name, resolution, device, **options):
    cage = Cage(*oracles.cage(name))
    solver = HarmonicSolver(CageLattice(cage, resolution, device=device), **options)
    solver.prepare()
    return cage, solver


def random_values(cage, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, cage.vertices.shape).astype(np.float32)


def solved(solver, values):
    solver.solve_inside(wp.array(values, dtype=wp.vec3, device=solver.device))
    return solver.values.numpy().astype(float).reshape(*solver.lattice.shape, 3)


def ray_exit(cage, start, direction):
    """Distance to the nearest crossing of a ray with the cage, and its face: Moller and Trumbore 1997, in float64."""
    a, b, c = (cage.vertices[cage.faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    p = np.cross(direction, e2)
    det = (e1 * p).sum(axis=1)
    facing = np.abs(det) > 1e-14
    det = np.where(facing, det, 1.0)
    s = start - a
    u = (s * p).sum(axis=1) / det
    q = np.cross(s, e1)
    v = (q @ direction) / det
    t = (e2 * q).sum(axis=1) / det
    hit = facing & (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (t > 0)
    if not hit.any():
        return np.inf, None, None
    face = np.flatnonzero(hit)[np.argmin(t[hit])]
    return t[face], face, np.array([1 - u[face] - v[face], u[face], v[face]])


def direct_solution(cage, lattice, values):
    """The same discrete equations, set up from rays in float64 and solved directly: (nx, ny, nz, 3)."""
    inside = lattice.distance.numpy() < 0
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(inside.sum())
    rows, columns, entries = [], [], []
    right = np.zeros((inside.sum(), 3))
    for node in np.argwhere(inside):
        row = number[tuple(node)]
        start = lattice.lower + node * lattice.spacing
        for axis in range(3):
            for side in (-1, 1):
                direction = np.zeros(3)
                direction[axis] = side
                t, face, share = ray_exit(cage, start, direction)
                theta = t / lattice.spacing
                rows += [row]
                columns += [row]
                if theta < 1:
                    entries += [-1 / theta]
                    right[row] -= share @ values[cage.faces[face]] / theta
                else:
                    entries += [-1.0]
                    rows += [row]
                    columns += [number[tuple(node + direction.astype(int))]]
                    entries += [1.0]
    result = np.zeros((*inside.shape, 3))
    result[inside] = spsolve(coo_matrix((entries, (rows, columns))).tocsc(), right)
    return result, inside


@pytest.mark.parametrize("name", ["icosphere", "concave", "two boxes"])
def test_solution_of_the_discrete_equations(name, device):
    cage, solver = solver_of(name, 12, device, tolerance=2e-6)
    values = random_values(cage)
    expected, inside = direct_solution(cage, solver.lattice, values.astype(float))
    found = solved(solver, values)
    assert inside.sum() > 50
    assert np.abs(found - expected)[inside].max() < 1e-5
    assert np.abs(found[~inside]).max() == 0


@pytest.mark.parametrize("name", CAGES)
@pytest.mark.parametrize("resolution", [16, 48])
def test_cycles_are_few_at_every_resolution(name, resolution, device):
    cage, solver = solver_of(name, resolution, device)
    solved(solver, random_values(cage))
    assert 2 <= solver.cycles <= 7
    assert 0 < solver.residual <= 1e-5


def test_tolerance_bounds_the_error_and_saves_cycles(device):
    cage, exact = solver_of("concave", 40, device, tolerance=2e-6)
    values = random_values(cage)
    reference = solved(exact, values)
    cycles = []
    for tolerance in (1e-2, 1e-3, 1e-4, 1e-5):
        _, solver = solver_of("concave", 40, device, tolerance=tolerance)
        assert np.abs(solved(solver, values) - reference).max() < tolerance
        cycles.append(solver.cycles)
    assert cycles == sorted(cycles) and cycles[0] < cycles[-1] <= exact.cycles


def test_solver_can_be_used_again_for_another_pose(device):
    cage, solver = solver_of("fine icosphere", 32, device)
    values = random_values(cage)
    first = solved(solver, values)
    for pose in (cage.bend(60), cage):
        solver.lattice.lay(pose)
        solver.prepare()
        found = solved(solver, values)
    assert np.array_equal(found, first)


def test_launches_longer_than_the_lists_change_nothing(monkeypatch):
    """What a CUDA graph that was captured for a larger pose does."""
    cage, solver = solver_of("concave", 24, None)
    values = random_values(cage)
    expected, cycle = solved(solver, values), solver.launch_cycle
    longer = lambda sections: lambda: cycle(NodeSections(2 * sections.lengths + 1000))  # noqa: E731
    monkeypatch.setattr(solver, "cycle_runner", longer)
    # more levels may have launches of their own, which round otherwise
    assert np.abs(solved(solver, values) - expected).max() < 1e-6


@pytest.mark.parametrize("name", ["box", "concave"])
def test_threads_of_a_cpu_change_nothing(name):
    """Runs of nodes end within rows where threads take turns; others write beside them meanwhile."""
    cage, solver = solver_of(name, 88, "cpu")
    found = []
    for threads in (1, 2, 5, 5):
        with limit_threads(threads):
            found.append(solved(solver, random_values(cage)))
    assert all(np.array_equal(found[0], each) for each in found[1:])


@pytest.mark.parametrize("tolerance", [0.0, 1e-9, 1.0, -1e-5, "1e-5", float("nan")])
def test_tolerances_out_of_range_are_refused(tolerance, device):
    refused(lambda: solver_of("box", 8, device, tolerance=tolerance), match="tolerance must be")


# -- Weights at points


def points_up_to(name, count=150):
    """Inside points: random ones, and some very near faces, edges and vertices of the cage."""
    vertices, faces = oracles.cage(name)
    near = [oracles.points_by_the_cage(vertices, faces, kind, 1e-4, count)[0] for kind in ("face", "edge", "vertex")]
    near = np.concatenate(near)
    near = near[oracles.winding_numbers(near, vertices, faces) > 0.5]
    return np.concatenate([oracles.inside_points(vertices, faces, count), near])


@pytest.mark.parametrize("name", CAGES)
def test_linear_functions_are_reproduced_up_to_the_cage(name, device):
    cage = Cage(*oracles.cage(name))
    points = points_up_to(name)
    weights = harmonic_weights(points, cage, 24, device)
    assert weights.shape == (len(points), len(cage.vertices)) and weights.dtype == np.float32
    assert np.abs(weights.sum(axis=1) - 1).max() < 2e-5
    assert np.abs(weights.astype(float) @ cage.vertices - points).max() < 1e-5 * cage.size


@pytest.mark.parametrize(("name", "steps", "near"), [("icosphere", 2, 2e-2), ("box", 3, 1e-2), ("concave", 3, 1.5e-2)])
def test_weights_against_boundary_elements(name, steps, near, device):
    vertices, faces = oracles.cage(name)
    cage, points = Cage(vertices, faces), oracles.inside_points(vertices, faces, 200)
    expected = oracles.harmonic_oracle(vertices, faces, np.eye(len(vertices)), points, graded=steps)
    error = np.abs(harmonic_weights(points, cage, 64, device) - expected)
    # the elements themselves are good to some 1e-3 in the weights here: see benchmarks for finer ones
    assert np.sqrt((error**2).mean()) < 8e-4 and error.max() < near


def test_error_falls_with_the_square_of_the_spacing(device):
    """Against a fine lattice, at points clear of a convex cage."""
    vertices, faces = oracles.cage("icosphere")
    cage = Cage(vertices, faces)
    points = 0.55 * oracles.inside_points(vertices, faces, 200)
    fine = harmonic_weights(points, cage, 80, device)
    errors = [np.sqrt(((harmonic_weights(points, cage, cells, device) - fine) ** 2).mean()) for cells in (12, 24)]
    assert np.log2(errors[0] / errors[1]) > 1.7


@pytest.mark.parametrize("name", ["icosphere", "concave"])
def test_maximum_principle(name, device):
    cage, points = Cage(*oracles.cage(name)), points_up_to(name)
    weights = harmonic_weights(points, cage, 64, device)
    assert weights.min() > -1e-2 and weights.max() < 1 + 1e-2
    clear = reference_distance(points, cage.vertices, cage.faces) > 0.05 * cage.size
    assert clear.sum() > 50 and weights[clear].min() > -1e-5


@pytest.mark.parametrize("cells", [0.5, 1.1, 2.0])
def test_parts_of_a_cage_at_a_narrow_gap_do_not_know_of_each_other(cells, device):
    resolution, height = 32, 2.4 / 32  # about; points are up to two cells from the gap
    box, random = Cage.box((0, 0, 0), (1, 1, 1)), np.random.default_rng(0)
    offset = np.array([1 + cells * height, 0.03, 0.02])
    depth, across = random.uniform(1e-4, 2 * height, 2000), random.uniform(0.05, 0.95, (2000, 2))
    points = np.concatenate([np.column_stack([1 - depth, across]), np.column_stack([depth, across]) + offset])
    turn = rotation_matrix(np.radians(33), (0.3, 0.2, 1))[:3, :3]
    vertices = np.concatenate([box.vertices, box.vertices + offset])
    cage = Cage(vertices @ turn.T, np.concatenate([box.faces, box.faces + 8]))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        weights = harmonic_weights(points @ turn.T, cage, resolution, device)
    assert np.abs(weights[:2000, 8:]).max() < 1e-5
    assert np.abs(weights[2000:, :8]).max() < 1e-5
    assert np.abs(weights.astype(float) @ cage.vertices - points @ turn.T).max() < 1e-5 * cage.size
    assert any("narrower than a cell" in str(warning.message) for warning in caught) == (cells < 1)


def test_weights_beside_a_slot_are_those_of_a_finer_lattice(device):
    narrow, _, turn = slot_cages(1.5 / 32, 33)
    points = points_beside_slot(1.5 / 32, 32, turn)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # turned, some links cross it whole
        error = harmonic_weights(points, narrow, 32, device) - harmonic_weights(points, narrow, 96, device)
    assert np.sqrt((error**2).mean()) < 5e-3  # twice that with one value an outside node


def test_slivers_of_a_cage_have_weights_too(device):
    """A spike much thinner than a cell holds no inside node."""
    cage = Cage.box((0, 0, 0), (1, 1, 1))
    vertices = cage.vertices.copy()
    tip = np.argmax(vertices.sum(axis=1))
    vertices[tip] = [4, 1.05, 1.05]
    spiked = cage.with_vertices(vertices)
    points = np.linspace([0.5, 0.9, 0.9], vertices[tip], 60)
    points = points[spiked.contains(points, device=device)]
    assert len(points) > 30
    weights = harmonic_weights(points, spiked, 12, device)
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-4
    assert weights.min() > -0.2


def test_points_outside_are_refused_by_number_and_first(device):
    cage = Cage(*oracles.cage("box"))
    with pytest.raises(ValueError, match=MESSAGES["coordinates.rows_outside"]):
        harmonic_weights([[0, 0, 0], [1, 0, 0], [0, 2, 0]], cage, 16, device)
    weights = harmonic_weights([cage.vertices[0] * (1 + 5e-6)], cage, 16, device)  # on its skin
    assert weights[0, 0] == pytest.approx(1.0, abs=1e-2)
