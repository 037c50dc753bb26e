"""Corrections of mean value maps next to the cage: what they are, by float64 formulas, and that look-up errs less."""

import itertools

import numpy as np
import oracles
import pytest
import trimesh
from oracles import look_up
from test_position_map import inside_points, pose_noisily

from warpcage import Cage, PositionMap
from warpcage.lattice import VertexWeightSolver, continue_to_rings

STEPS = np.array(list(itertools.product((0, 1), repeat=3)))


class Maps:
    """A map with and without corrections, flat, its nodes in world units, and its lists of nodes."""

    def __init__(self, name, resolution, device):
        self.rest = Cage(*oracles.cage(name))
        self.deformed = pose_noisily(self.rest, 0.1)
        options = {"coordinates": "mean_value", "resolution": resolution, "device": device}
        self.corrected = PositionMap(self.rest, **options).pose(self.deformed)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                VertexWeightSolver,
                "continue_map",
                lambda self, *inputs: continue_to_rings(self.lattice, self.nodes.levels, self.rows, *inputs),
            )
            self.plain = PositionMap(self.rest, **options).pose(self.deformed)
        lattice, nodes = self.corrected.lattice, self.corrected.launches.solver.nodes
        self.lower, self.spacing, self.shape = lattice.lower, lattice.spacing, lattice.shape
        self.after, self.before = (
            each.data.positions.numpy().reshape(-1, 3) + self.rest.bounds.mean(axis=0)
            for each in (self.corrected, self.plain)
        )
        starts = np.concatenate([[0], np.cumsum(nodes.sections.lengths)])
        listed = nodes.levels.nodes.numpy()
        self.cut, self.ring_0, self.ring_1 = (listed[starts[s] : starts[s + 1]] for s in (2, 3, 4))

    def place(self, nodes):
        return self.lower + self.spacing * np.stack(np.unravel_index(nodes, self.shape), axis=1)

    def on_cage(self, points):
        """The points of the cage nearest to points, and their values."""
        surface = trimesh.Trimesh(self.deformed.vertices, self.deformed.faces, process=False)
        nearest, _, face = trimesh.proximity.closest_point_naive(surface, points)
        weights = trimesh.triangles.points_to_barycentric(surface.triangles[face], nearest)
        return nearest, np.einsum("nk,nkc->nc", weights, self.rest.vertices[self.rest.faces[face]])

    def exact(self, points):
        return oracles.mean_value_weights(points, self.deformed.vertices, self.deformed.faces) @ self.rest.vertices

    def linked(self, points, theta, away):
        """Values at the ends of links: where they cross the cage, if they are shorter than a cell, else at nodes."""
        ends = points + theta * away
        return np.where(theta < 1, self.on_cage(ends)[1], self.exact(ends))


@pytest.fixture(scope="module")
def maps(request):
    """Of the box and the concave cage, on all devices."""
    made = {}

    def get(name, device):
        if (name, str(device)) not in made:
            made[name, str(device)] = Maps(name, 20, device)
        return made[name, str(device)]

    return get


@pytest.mark.parametrize("name", ["box", "concave"])
def test_cut_nodes_move_by_a_sixteenth_of_their_second_differences(name, maps, device):
    m = maps(name, device)
    rows = m.corrected.launches.solver.rows
    fractions = rows.fractions.numpy()[: len(m.cut)].astype(float)
    steady = (fractions > 0.26).all(axis=1)
    assert steady.sum() > 100
    x, theta = m.place(m.cut)[steady], fractions[steady]
    here = m.exact(x)
    total = np.zeros_like(here)
    for axis in range(3):
        away = np.eye(3)[axis] * m.spacing
        back, ahead = theta[:, 2 * axis, None], theta[:, 2 * axis + 1, None]
        slopes = (m.linked(x, ahead, away) - here) / ahead + (m.linked(x, back, -away) - here) / back
        total += 2 * slopes / (ahead + back)
    assert np.abs(total).max() > 1e-2
    assert np.abs(m.after[m.cut][steady] - (here - total / 16)).max() < 1e-5


@pytest.mark.parametrize("name", ["box", "concave"])
def test_ring_nodes_move_by_the_misfit_at_the_cage(name, maps, device):
    m = maps(name, device)
    nearest, expected = m.on_cage(m.place(m.ring_0))
    misfit = expected - look_up(m.plain, nearest)[0]
    moved = m.after[m.ring_0] - m.before[m.ring_0]
    close = np.abs(moved - 1.25 * misfit).max(axis=1) < 1e-4
    assert close.mean() > 0.98
    assert not moved[~close].any()  # between inside nodes, or the cell has corners that no inside node is next to
    assert np.abs(moved[close]).max() > 1e-3


@pytest.mark.parametrize("name", ["box", "concave"])
def test_other_nodes_stay(name, maps, device):
    m = maps(name, device)
    others = np.setdiff1d(np.arange(len(m.after)), np.concatenate([m.cut, m.ring_0, m.ring_1]))
    assert np.array_equal(m.after[others], m.before[others])


@pytest.mark.parametrize("name", ["box", "concave"])
def test_look_up_errs_less(name, maps, device):
    m = maps(name, device)
    points = inside_points(m.deformed, 10_000)
    near = look_up(m.plain, points)[1] > -1.5 * m.spacing
    points = points[near]
    expected = m.exact(points)
    before, after = (np.abs(look_up(each, points)[0] - expected) for each in (m.plain, m.corrected))
    assert near.sum() > 3000
    assert np.sqrt((after**2).mean()) < 0.9 * np.sqrt((before**2).mean())
    assert np.quantile(after, 0.999) < np.quantile(before, 0.999)
