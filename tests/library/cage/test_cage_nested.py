"""Decimation that only moves outward."""

import numpy as np
import pytest
import trimesh
from refusals import refused
from skimage.measure import marching_cubes
from test_cage_generation import winding

from warpcage import Cage
from warpcage.cage import EdgeCollapses, progressive_hull
from warpcage.cage.generate import cage_around_mesh
from warpcage.cage.generate.mirror import Mirror, joined_halves
from warpcage.cage.generate.shell import decimated
from warpcage.mesh import intersecting_faces


def surfaces():
    torus = trimesh.creation.torus(1.0, 0.3, major_sections=40, minor_sections=16)
    return {
        "ball": Cage.icosphere([1, 2, 3], 1.0, 3),
        "box": Cage.box([0, 0, 0], [1, 2, 3], segments=7),
        "torus": Cage(torus.vertices, torus.faces),
    }


@pytest.mark.parametrize(("name", "most"), [("ball", 1.2), ("box", 1.05), ("torus", 1.8)])
def test_every_surface_holds_the_one_before(name, most):
    fine = before = surfaces()[name]
    for count in (160, 80):
        cage = Cage(*progressive_hull(before.vertices, before.faces, count))
        cage.require_usable()
        assert len(cage.vertices) == count and not len(intersecting_faces(cage.vertices, cage.faces))
        assert cage.topology.genus == fine.topology.genus
        # middles of faces of the surface before, a hair below it, are inside this one
        corners = before.vertices[before.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        below = corners.mean(axis=1) - 1e-6 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
        assert (winding(below, cage.vertices, cage.faces) > 0.99).all()
        assert cage.volume > before.volume * (1.0 - 1e-9)
        before = cage
    assert before.volume < most * fine.volume


def test_a_box_keeps_its_corners_and_edges():
    box = surfaces()["box"]
    cage = Cage(*progressive_hull(box.vertices, box.faces, 60))
    assert cage.volume < 1.01 * box.volume and np.allclose(cage.bounds, box.bounds, atol=0.05)


@pytest.mark.parametrize("apart", [False, True])
def test_halves_of_a_mirror_are_decimated_alike(apart):
    """Outward, in pairs, down to a count that is odd too; what lies on the plane stays there."""
    x, y, z = np.meshgrid(
        np.linspace(-1.4, 1.4, 29), np.linspace(0.0, 0.4, 9), np.linspace(-1.4, 1.4, 29), indexing="ij"
    )
    values = (np.hypot(x, z) - 1.0) ** 2 + y * y - 0.087
    half, faces, _, _ = marching_cubes(np.moveaxis(values, 0, 1), 0.0, spacing=(0.05, 0.1, 0.1))
    plane = (0, 0.0)
    fine = Cage(*joined_halves(*decimated(half.astype(float), faces.astype(int), 160), plane))
    assert fine.volume == pytest.approx(2 * np.pi**2 * 0.087, rel=0.05)
    fine.require_usable()
    cage = Cage(*progressive_hull(fine.vertices, fine.faces, 81, apart=apart, mirror=Mirror.of(fine.vertices, plane)))
    cage.require_usable()
    assert len(cage.vertices) in (80, 81) and cage.topology.genus == 1
    mirror = Mirror.of(cage.vertices, plane)
    np.testing.assert_allclose(mirror(cage.vertices), cage.vertices, rtol=0, atol=1e-12)
    assert (np.abs(cage.vertices[mirror.partner == np.arange(len(cage.vertices)), 0]) < 1e-12).all()
    assert (
        winding(
            fine.vertices - 1e-3 * trimesh.Trimesh(fine.vertices, fine.faces, process=False).vertex_normals,
            cage.vertices,
            cage.faces,
        )
        > 0.99
    ).all()


def test_it_stops_where_no_collapse_is_left():
    tetrahedron = trimesh.creation.icosahedron()
    vertices, _ = progressive_hull(tetrahedron.vertices, tetrahedron.faces, 4)
    assert 4 <= len(vertices) <= 12
    again = progressive_hull(tetrahedron.vertices, tetrahedron.faces, 12)
    assert np.array_equal(again[0], tetrahedron.vertices)


def collapse_in_numpy(vertices, faces, edge, side):
    """The least cost of a collapse and its place, face by face; None where there is none."""
    u, v = edge
    of_u, of_v = (set(np.flatnonzero((faces == end).any(axis=1))) for end in edge)
    near = [set(faces[sorted(of)].reshape(-1)) - {end} for of, end in ((of_u, u), (of_v, v))]
    degrees = np.bincount(faces.reshape(-1))
    across = [w for f in of_u & of_v for w in faces[f] if w not in edge]
    merged = degrees[u] + degrees[v] - 4
    if len(near[0] & near[1]) != 2 or min(degrees[across]) <= 3 or not 3 <= merged <= 10:
        return None
    around = sorted(of_u | of_v)
    a, b, c = (vertices[faces[around, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    double_area = np.linalg.norm(cross, axis=1)
    normals = cross / double_area[:, None]
    offsets = (normals * a).sum(axis=1)
    mean = cross.sum(axis=0) / np.linalg.norm(cross.sum(axis=0))
    middle = 0.5 * (vertices[u] + vertices[v])
    squares = (double_area[:, None, None] * normals[:, :, None] * normals[:, None]).sum(axis=0)
    hold = 1e-2 * np.trace(squares)
    right = (double_area * offsets) @ normals + hold * middle
    best = None
    for base in (middle, vertices[u], vertices[v], np.linalg.solve(squares + hold * np.eye(3), right)):
        below, climb = offsets - normals @ base, normals @ mean
        short = below > 1e-9 * side
        if (climb[short] < 0.05).any():
            continue
        lift = (below[short] / climb[short]).max(initial=0.0)
        if lift > side:
            continue
        place = base + lift * mean
        cost = (double_area * (normals @ place - offsets)).sum() / 6.0 / side**3
        kept = [k for k, f in enumerate(around) if f not in of_u & of_v]
        corners = np.where(np.isin(faces[around], edge)[..., None], place, vertices[faces[around]])[kept]
        sides = np.roll(corners, -1, axis=1) - corners
        turned, lengths = np.cross(sides[:, 0], sides[:, 1]), np.linalg.norm(sides, axis=2)
        area = np.linalg.norm(turned, axis=1)
        even = 2.0 * np.sqrt(3.0) * area / (lengths**2).sum(axis=1)
        if not ((turned * normals[kept]).sum(axis=1) > 0.2 * area).all() or not (even > 0.15).all():
            continue
        cost = cost + 0.05 * (lengths.max() / side) ** 3 + 0.02 * (1.0 / even - 1.0).sum()
        if best is None or cost < best[0] - 1e-9:
            best = cost, place
    return best


@pytest.mark.parametrize("sizing", [None, lambda x: np.exp(0.5 * x[:, 0])])
def test_collapses_are_measured_as_by_numpy(sizing):
    """Of surfaces as they come about: some collapses are refused for their shape, some for what they would join."""
    fine = surfaces()["torus"]
    for count in (300, 60):
        vertices, faces = progressive_hull(fine.vertices, fine.faces, count)
        found, some = EdgeCollapses(vertices, faces, 0.3, sizing), 0
        assert len(found.edges) == len(faces) * 3 // 2
        for edge, place, cost in zip(found.edges.tolist(), found.places, found.costs, strict=True):
            side = 0.3 if sizing is None else 0.3 * sizing(vertices[edge].mean(axis=0, keepdims=True))[0]
            best = collapse_in_numpy(vertices, faces, edge, side)
            assert (cost >= 1e300) == (best is None)
            if best is not None:
                assert cost == pytest.approx(best[0], abs=1e-8) and np.allclose(place, best[1], atol=1e-8)
                some += 1
        assert 10 < some < len(found.edges)


def test_a_sizing_puts_vertices_where_it_asks_for_short_edges():
    """Twice as many a length, so four times as many an area; as a cage, too, at any place and scale."""
    fine, mesh = surfaces()["ball"], trimesh.creation.icosphere(subdivisions=4).apply_scale(20.0)

    def sizing(x, middle=1.0, scale=1.0):
        return np.where(x[:, 0] > middle, 0.5 * scale, scale)

    hull = Cage(*progressive_hull(fine.vertices, fine.faces, 100, sizing=sizing))
    cage = Cage(*cage_around_mesh(mesh, 100, sizing=lambda x: sizing(x, 0.0, 7.0)))
    for found, middle in ((hull, 1.0), (cage, 0.0)):
        found.require_usable()
        dense = np.count_nonzero(found.vertices[:, 0] > middle) / len(found.vertices)
        assert abs(len(found.vertices) - 100) <= 10 and 0.65 < dense < 0.85
    assert cage.contains(mesh.vertices).all() and cage.volume < 1.25 * mesh.volume


@pytest.mark.parametrize(
    "sizing", [lambda x: np.zeros(len(x)), lambda x: np.ones(3), lambda x: np.full(len(x), np.nan)]
)
def test_a_sizing_that_gives_no_lengths_is_refused(sizing):
    fine = surfaces()["ball"]
    refused(lambda: progressive_hull(fine.vertices, fine.faces, 100, sizing=sizing), "a sizing must give")
