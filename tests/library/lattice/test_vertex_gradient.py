"""Slopes by cages of the positions that a map has at its nodes, beside float64 formulas on the lattice as it lies."""

import numpy as np
import oracles
import pytest
import warp as wp
from scipy import sparse
from scipy.sparse.linalg import spsolve

from warpcage import Cage, PositionMap
from warpcage.coordinates import stretched_normals
from warpcage.kernels.lattice.nodes import INTERPOLATED, OUTSIDE, RING

KINDS = ("harmonic", "mean_value", "green", "maximum_likelihood")
REGULAR = -1
NEXT = ((0, -1), (0, 1), (1, -1), (1, 1), (2, -1), (2, 1))  # axis and step of each direction


def posed_map(kind, name, resolution, device, amount=0.05):
    random = np.random.default_rng(2)
    rest = Cage(*oracles.cage(name))
    posed = rest.with_vertices(1.3 * rest.vertices + amount * random.uniform(-1, 1, rest.vertices.shape) + [1, 0, -2])
    options = {"coordinates": kind, "resolution": resolution, "tolerance": 2e-6, "device": device}
    return PositionMap(rest, **options).pose(posed), rest, posed, random


def codes_of(position_map):
    levels, shape = position_map.launches.solver.nodes.levels, position_map.lattice.shape
    return levels.codes.numpy()[: np.prod(shape)].reshape(shape)


def slopes_on(position_map, nodes, random):
    """Random slopes (nodes,) by the positions of some nodes, and the array that has them."""
    slopes = np.zeros((*position_map.lattice.shape, 3), np.float32)
    chosen = random.normal(size=(len(nodes), 3)).astype(np.float32)
    slopes[tuple(nodes.T)] = chosen
    return chosen, wp.array(slopes, dtype=wp.vec3, device=position_map.device)


def check(found, loss, given, random, share=1e-3, step=1e-5):
    """Whether slopes say how a number changes, as the vertices of each cage move at random."""
    for number, slope in enumerate(found):
        slope = slope.numpy().astype(float)
        assert slope.shape == given[number].shape and np.isfinite(slope).all()
        along = random.normal(size=slope.shape)
        ends = [
            loss(*[each + (sign * along if n == number else 0.0) for n, each in enumerate(given)])
            for sign in (step, -step)
        ]
        expected = (ends[0] - ends[1]) / (2 * step)
        assert abs((slope * along).sum() - expected) < share * np.sqrt(((slope * along) ** 2).sum())


@pytest.mark.parametrize("name", ["icosphere", "concave"])
@pytest.mark.parametrize("kind", ["mean_value", "green", "maximum_likelihood"])
def test_closed_forms_are_differentiated_at_inside_nodes(kind, name, device):
    position_map, rest, posed, random = posed_map(kind, name, 40, device)
    count = 25 if kind == "maximum_likelihood" else 150  # whose oracle is slow
    codes = codes_of(position_map)
    nodes = np.concatenate(
        [random.permutation(np.argwhere(codes == code))[:count] for code in (REGULAR, int(INTERPOLATED))]
    )
    assert len(nodes) == 2 * count
    slopes, given = slopes_on(position_map, nodes, random)
    places = position_map.lattice.lower + nodes * position_map.lattice.spacing

    def loss(posed_vertices, rest_vertices):
        if kind != "green":
            weights = getattr(oracles, f"{kind}_weights")
            return (slopes * (weights(places, posed_vertices, rest.faces) @ rest_vertices)).sum()
        phi, psi = oracles.green_weights_in_closed_form(places, posed_vertices, rest.faces)
        normals = stretched_normals(posed.with_vertices(posed_vertices), rest.with_vertices(rest_vertices))
        return (slopes * (phi @ rest_vertices + psi @ normals)).sum()

    check(position_map.vertex_gradient(given), loss, (posed.vertices, rest.vertices), random)


class Laplace:
    """The equations of a harmonic map on its lattice in float64, with the links that are cut as they are."""

    def __init__(self, position_map):
        lattice, solver = position_map.lattice, position_map.launches.solver
        self.lattice, self.rows = lattice, solver.rows
        self.codes = codes_of(position_map)
        self.inside = np.argwhere(self.codes > OUTSIDE)
        self.number = np.full(self.codes.shape, -1)
        self.number[tuple(self.inside.T)] = np.arange(len(self.inside))
        links, faces = solver.rows.links.numpy(), solver.rows.faces.numpy()
        self.crossings = []  # number of the node, row, direction, face
        cut = self.codes[tuple(self.inside.T)]
        for number in np.flatnonzero(cut >= 0):
            row = cut[number]
            self.crossings += [(number, row, d, faces[row, d]) for d in range(6) if not (links[row] >> d) & 1]

    def crossed(self, posed, rest):
        """How far each crossing is from its node, cells, and the map there."""
        vertices = (posed - self.lattice.lower) / self.lattice.spacing
        found = {}
        for number, row, direction, face in self.crossings:
            axis, sign = NEXT[direction]
            a, b, c = vertices[self.lattice.cage.faces[face]]
            step = np.zeros(3)
            step[axis] = sign
            # node + theta step = a + s (b - a) + t (c - a)
            theta, s, t = np.linalg.solve(np.stack([-step, b - a, c - a], axis=1), self.inside[number] - a)
            found[row, direction] = theta, np.array([1 - s - t, s, t]) @ rest[self.lattice.cage.faces[face]]
        return found

    def solved(self, posed, rest):
        """Positions (inside nodes, 3), and the crossings."""
        crossed = self.crossed(posed, rest)
        entries, right = [], np.zeros((len(self.inside), 3))
        cuts = {(number, d): crossed[row, d] for number, row, d, _ in self.crossings}
        for number, node in enumerate(self.inside):
            diagonal = 0.0
            for d, (axis, sign) in enumerate(NEXT):
                if (number, d) in cuts:
                    theta, value = cuts[number, d]
                    diagonal += 1.0 / theta
                    right[number] += value / theta
                else:
                    other = node.copy()
                    other[axis] += sign
                    diagonal += 1.0
                    entries.append((number, self.number[tuple(other)], -1.0))
            entries.append((number, number, diagonal))
        i, j, values = zip(*entries, strict=True)
        return spsolve(sparse.csc_matrix((values, (i, j))), right), crossed

    def sources(self, node, crossed):
        """Of a node of ring 0: for each cut node beside it, the crossing between them, and the number of the inside
        node that the map is continued from; None where that is beyond another crossing."""
        found = []
        for d, (axis, sign) in enumerate(NEXT):
            beside, behind = node.copy(), node.copy()
            beside[axis] += sign
            behind[axis] += 2 * sign
            row = self.codes[tuple(beside)]
            if row >= 0:
                source = self.number[tuple(beside if crossed[row, d ^ 1][0] >= 0.5 else behind)]
                found.append(((row, d ^ 1), source if source >= 0 else None))
        return found

    def beyond(self, sources, values, crossed):
        """Position of a node of ring 0."""
        found = []
        for crossing, source in sources:
            theta, value = crossed[crossing]
            ratio = (1 - theta) / theta if self.was[crossing][0] >= 0.5 else (1 - theta) / (1 + theta)
            found.append(value + (value - values[source]) * ratio)
        return np.mean(found, axis=0)


@pytest.mark.parametrize("name", ["icosphere", "box"])
def test_harmonic_maps_are_differentiated_inside_and_next_to_the_cage(name, device):
    position_map, rest, posed, random = posed_map("harmonic", name, 12, device)
    oracle = Laplace(position_map)
    assert position_map.lattice.cage.operator is None  # triangles are taken as they are
    oracle.was = oracle.crossed(posed.vertices, rest.vertices)
    ring = np.argwhere(oracle.codes == int(RING))
    sources = [oracle.sources(node, oracle.was) for node in ring]
    clear = [all(source is not None for _, source in each) for each in sources]
    assert sum(clear) > 100
    ring, sources = ring[clear], [each for each, keep in zip(sources, clear, strict=True) if keep]
    slopes, given = slopes_on(position_map, np.concatenate([oracle.inside, ring]), random)
    inside, outside = np.split(slopes, [len(oracle.inside)])

    def positions(posed_vertices, rest_vertices):
        values, crossed = oracle.solved(posed_vertices, rest_vertices)
        return values, np.array([oracle.beyond(each, values, crossed) for each in sources])

    found = position_map.data.positions.numpy() + position_map.origin
    for nodes, values in zip((oracle.inside, ring), positions(posed.vertices, rest.vertices), strict=True):
        np.testing.assert_allclose(found[tuple(nodes.T)], values, atol=3e-5)

    def loss(*cages):
        one, other = positions(*cages)
        return (inside * one).sum() + (outside * other).sum()

    check(position_map.vertex_gradient(given), loss, (posed.vertices, rest.vertices), random)


@pytest.mark.parametrize("kind", KINDS)
def test_rings_go_back_to_the_rest_cage(kind, device):
    """All nodes, rings too, of a concave cage: differences as the rest cage moves, along which the map is smooth."""
    position_map, rest, posed, random = posed_map(kind, "concave", 16, device)
    wanted = np.argwhere(codes_of(position_map) != int(OUTSIDE))
    slopes, given = slopes_on(position_map, wanted, random)
    along, found = random.normal(size=rest.vertices.shape), position_map.vertex_gradient(given)[1].numpy()
    ends = []
    for step in (1e-2, -1e-2):
        other = PositionMap(
            rest.with_vertices(rest.vertices + step * along),
            coordinates=kind,
            resolution=16,
            tolerance=2e-6,
            origin=position_map.origin,
            device=device,
        ).pose(posed)
        ends.append((slopes * other.data.positions.numpy().astype(float)[tuple(wanted.T)]).sum())
    expected = (ends[0] - ends[1]) / 2e-2
    share = 1e-2 if kind in ("mean_value", "maximum_likelihood") else 2e-3  # its corrections next to the cage are held
    assert abs((found * along).sum() - expected) < share * np.sqrt(((found * along) ** 2).sum())


def test_polygons_get_slopes_of_their_own_vertices(device):
    """A cage of quads is solved on triangles around middles of faces: what is linear is undone, whatever these are."""
    vertices = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    rest = Cage(vertices, faces)
    rest = rest if rest.volume > 0 else Cage(vertices, [face[::-1] for face in faces])
    position_map = PositionMap(rest, coordinates="harmonic", resolution=12, device=device).pose(rest)
    slopes = np.zeros((*position_map.lattice.shape, 3), np.float32)
    node = np.argwhere(codes_of(position_map) > OUTSIDE)[100]
    slopes[tuple(node)] = [1, 2, 3]
    posed, back = position_map.vertex_gradient(wp.array(slopes, dtype=wp.vec3, device=device))
    assert posed.shape == back.shape == (8,)
    # shares of a node sum up to one, and carry the node's place
    place = position_map.lattice.lower + node * position_map.lattice.spacing
    weights = back.numpy()[:, 0]
    np.testing.assert_allclose(back.numpy(), weights[:, None] * [1, 2, 3], atol=1e-5)
    np.testing.assert_allclose([weights.sum(), *(weights @ rest.vertices)], [1, *place], atol=2e-4)
    np.testing.assert_allclose(posed.numpy(), -back.numpy(), atol=2e-3)  # the map is the identity


def test_what_has_no_gradient_is_refused(device):
    position_map, *_ = posed_map("biharmonic", "box", 8, device)
    with pytest.raises(ValueError, match="through biharmonic maps"):
        position_map.vertex_gradient(position_map.data.positions)
    position_map, *_ = posed_map("mean_value", "box", 8, device)
    with pytest.raises(ValueError, match="slopes by the nodes must be"):
        position_map.vertex_gradient(wp.zeros((2, 2, 2), dtype=wp.vec3, device=device))
