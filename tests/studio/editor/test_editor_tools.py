"""The mathematics of the editor's page, in a headless Chromium, against NumPy."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from page_probe import HEIGHT, VIEW, WIDTH, Modules, camera, flat, hull, looked, projected, whole
from polygon_cages import mixed_prism
from scipy.optimize import minimize_scalar
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import warpcage
from warpcage.cage import move
from warpcage.view import eased_share


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    return np.random.default_rng(3).normal(size=(40, 3))


# cameras -----------------------------------------------------------------------------------------------------------


def test_points_are_projected_as_by_matrices(page: Modules, points: np.ndarray) -> None:
    found = page.call("geometry/camera", "projectAll", camera(page), flat(points))
    np.testing.assert_allclose(np.reshape(found, (-1, 3)), projected(VIEW, points), rtol=1e-9, atol=1e-7)


def test_rays_go_through_what_they_show(page: Modules, points: np.ndarray) -> None:
    made = camera(page)
    for point in points[:5]:
        x, y, _ = projected(VIEW, point)
        ray = page.call("geometry/camera", "rayThrough", made, x, y)
        along = (point - VIEW["eye"]) / np.linalg.norm(point - VIEW["eye"])
        np.testing.assert_allclose(ray, along, atol=1e-12)


@pytest.mark.parametrize(("across", "upward"), [(0.4, 0.0), (0.0, 0.3), (-0.7, -0.2)])
def test_orbits_turn_about_the_worlds_up_and_the_views_right(page: Modules, across: float, upward: float) -> None:
    found = page.call("geometry/camera", "orbit", VIEW, across, upward, [0, 0, 1])
    first = Rotation.from_rotvec([0, 0, -across])
    right = first.apply(looked(VIEW)[0])
    turn = Rotation.from_rotvec(-upward * right) * first
    expected = np.array(VIEW["target"]) + turn.apply(np.subtract(VIEW["eye"], VIEW["target"]))
    np.testing.assert_allclose(found["eye"], expected, atol=1e-12)
    np.testing.assert_allclose(looked(found), turn.apply(looked(VIEW)), atol=1e-12)


def test_orbits_stop_at_the_poles(page: Modules) -> None:
    found = page.call("geometry/camera", "orbit", VIEW | {"up": [0, 0, 1]}, 0.0, 9.0, [0, 0, 1])
    back = np.subtract(found["eye"], found["target"])
    np.testing.assert_allclose(back / np.linalg.norm(back), [0, 0, 1], atol=1e-7)
    again = page.call("geometry/camera", "orbit", found, 0.0, -0.5, [0, 0, 1])
    assert np.isclose(np.subtract(again["eye"], again["target"])[2], np.linalg.norm(back) * np.cos(0.5), atol=1e-6)


def test_pans_keep_the_target_under_the_hand_and_zooms_its_pixel(page: Modules) -> None:
    target = np.array(VIEW["target"])
    panned = page.call("geometry/camera", "pan", VIEW, 30, -20, HEIGHT)
    np.testing.assert_allclose(projected(panned, target)[:2], [WIDTH / 2 + 30, HEIGHT / 2 - 20], atol=1e-8)
    zoomed = page.call("geometry/camera", "zoom", VIEW, 0.25)
    np.testing.assert_allclose(np.subtract(zoomed["eye"], target) * 4, np.subtract(VIEW["eye"], target))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0.0, -1.0, 0.0), (0.1, 0.2, -0.9)])
def test_named_views_are_upright_and_at_right_angles(page: Modules, up: tuple[float, float, float]) -> None:
    named = page.call("geometry/camera", "namedDirections", list(up))
    unit = np.array(up) / np.linalg.norm(up)
    np.testing.assert_allclose(named["top"][0], unit)
    np.testing.assert_allclose(np.cross(named["right"][0], unit), named["front"][0], atol=1e-12)
    for name in ("front", "back", "left", "right"):
        direction, upwards = named[name]
        assert np.isclose(np.dot(direction, unit), 0)
        np.testing.assert_allclose(upwards, unit)
    # In the view from the front, what lies to the right of the scene is on the right of the picture
    view = page.call("geometry/camera", "lookFrom", VIEW, *named["front"])
    np.testing.assert_allclose(looked(view)[0], named["right"][0], atol=1e-9)


@pytest.mark.parametrize("aspect", [0.4, 1.0, 2.5])
def test_a_framed_view_shows_all_points(page: Modules, points: np.ndarray, aspect: float) -> None:
    view = page.call("geometry/camera", "frameAll", VIEW, flat(points), aspect)
    pixels = projected(view, points, HEIGHT * aspect, HEIGHT)
    assert (pixels[:, 2] > 0).all()
    assert (pixels[:, 0] >= 0).all() and (pixels[:, 0] <= HEIGHT * aspect).all()
    assert (pixels[:, 1] >= 0).all() and (pixels[:, 1] <= HEIGHT).all()
    half = [HEIGHT * aspect / 2, HEIGHT / 2]
    assert (np.abs(pixels[:, :2] - half) / half).max() > 0.8  # and not from afar


# topology ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0), (0.1, -0.9, 0.2)])
@pytest.mark.parametrize("scale", [1.0, 37.0, 2e-3])
def test_the_grid_is_the_ground_beneath_the_field(page: Modules, up: tuple[float, ...], scale: float) -> None:
    bounds = scale * np.array([[-1.3, 0.2, -0.4], [0.9, 1.7, 2.6]])
    lines = page.call("view/grid", "groundLines", bounds.tolist(), list(up))
    corners = bounds[np.indices((2, 2, 2)).reshape(3, 8).T, np.arange(3)]
    high, ends = np.divide(up, np.linalg.norm(up)), np.array([line["ends"] for line in lines])
    np.testing.assert_allclose(ends @ high, (corners @ high).min(), atol=1e-9 * scale)
    ways = ends[:, 1] - ends[:, 0]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    steps = set()
    for way in (ways[0], ways[-1]):  # two families of lines, at right angles
        own = [i for i in range(len(lines)) if abs(ways[i] @ way) > 0.5]
        places = ends[own, 0] @ (across := np.cross(high, way))
        reach = corners @ across
        assert places.min() <= reach.min() and reach.max() <= places.max() and 4 <= len(own) <= 12
        np.testing.assert_allclose(np.abs(places), np.abs([lines[i]["value"] for i in own]), atol=1e-9 * scale)
        steps.add(f"{np.diff(np.sort(places)).mean():.6e}")
        ours = {lines[i]["axis"] for i in own if lines[i]["value"] == 0}
        named = [k for k in range(3) if abs(way[k]) > 1 - 1e-6]
        assert ours <= {*named, -1} and (not named or ours <= set(named))
    (step,) = steps
    assert step.startswith(("1.000000e", "2.000000e", "5.000000e"))


@pytest.fixture(scope="module")
def two_parts(page: Modules) -> tuple[np.ndarray, np.ndarray, Any]:
    first, faces = hull(30, 1)
    second, more = hull(12, 2)
    points, faces = np.concatenate([first, second + 5]), np.concatenate([faces, more + 30])
    made = page.call("geometry/topology", "makeTopology", faces.tolist(), len(points))
    made["faces"], made["edges"] = whole(faces), whole(made["edges"])
    return points, faces, made


def matrix(faces: np.ndarray, count: int) -> np.ndarray:
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    out = np.zeros((count, count), bool)
    out[pairs[:, 0], pairs[:, 1]] = out[pairs[:, 1], pairs[:, 0]] = True
    return out


def test_edges_neighbors_and_parts(two_parts: tuple[np.ndarray, np.ndarray, Any]) -> None:
    points, faces, made = two_parts
    adjacent = matrix(faces, len(points))
    edges = np.reshape(made["edges"]["int32"], (-1, 2))
    assert sorted(map(tuple, edges.tolist())) == list(zip(*np.nonzero(np.triu(adjacent)), strict=True))
    for i, near in enumerate(made["neighbors"]):
        assert sorted(near) == np.flatnonzero(adjacent[i]).tolist()
    for face, numbers in zip(faces, np.reshape(made["faceEdges"], (-1, 3)), strict=True):
        for k in range(3):
            assert set(edges[numbers[k]]) == {face[k], face[(k + 1) % 3]}
    count, parts = connected_components(coo_matrix(adjacent))
    assert count == 2 and np.array_equal(parts == parts[0], np.array(made["parts"]) == made["parts"][0])


def test_polygons_have_edges_and_no_diagonals(page: Modules) -> None:
    cage = mixed_prism()
    polygons = page.call("geometry/topology", "wholePolygons", cage.face_array.tolist())
    assert polygons == [list(face) for face in cage.polygons]
    made = page.call("geometry/topology", "makeTopology", polygons, len(cage.vertices))
    edges = np.reshape(made["edges"], (-1, 2))
    assert sorted(map(tuple, edges.tolist())) == sorted(map(tuple, cage.edges.tolist()))
    for i, near in enumerate(made["neighbors"]):
        assert sorted(near) == sorted({*cage.edges[cage.edges[:, 0] == i, 1], *cage.edges[cage.edges[:, 1] == i, 0]})
    triangles, owner = np.reshape(made["faces"], (-1, 3)), made["owner"]
    assert np.bincount(owner).tolist() == [len(face) - 2 for face in polygons]
    for corners, number, numbers in zip(triangles, owner, np.reshape(made["faceEdges"], (-1, 3)), strict=True):
        assert set(corners) <= set(polygons[number])
        for k in range(3):
            side = {corners[k], corners[(k + 1) % 3]}
            assert numbers[k] < 0 or set(edges[numbers[k]]) == side
            assert (numbers[k] >= 0) == any(side == set(edge) for edge in edges.tolist())
    within = page.call("geometry/topology", "facesWithin", polygons, {"set": list(range(5))})
    assert within == [0]


def test_linked_grow_shrink_and_invert(page: Modules, two_parts: tuple[np.ndarray, np.ndarray, Any]) -> None:
    points, faces, made = two_parts
    adjacent = matrix(faces, len(points))
    chosen = np.zeros(len(points), bool)
    chosen[[0, 3, *np.flatnonzero(adjacent[0])]] = True

    def after(name: str, mask: np.ndarray) -> list[int]:
        return sorted(page.call("geometry/topology", name, made, {"set": np.flatnonzero(mask).tolist()}))

    assert after("linked", chosen) == list(range(30))
    assert after("grow", chosen) == np.flatnonzero(chosen | adjacent[chosen].any(axis=0)).tolist()
    assert after("shrink", chosen) == np.flatnonzero(chosen & ~adjacent[~chosen].any(axis=0)).tolist()
    assert after("invert", chosen) == np.flatnonzero(~chosen).tolist()
    within = page.call("geometry/topology", "facesWithin", faces.tolist(), {"set": np.flatnonzero(chosen).tolist()})
    assert within == np.flatnonzero(chosen[faces].all(axis=1)).tolist()


def test_normals_and_the_side_that_looks_at_the_eye(page: Modules) -> None:
    points, faces = hull(40, 5)
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flipped = (normals * corners.mean(axis=1)).sum(axis=1) < 0
    faces[flipped] = faces[flipped][:, ::-1]
    normals[flipped] *= -1
    volume = page.call("geometry/topology", "signedVolume", whole(faces), flat(points))
    assert np.isclose(volume, 6 * ConvexHull(points).volume)
    made = page.call("geometry/topology", "makeTopology", faces.tolist(), len(points))
    eye = np.array([3.0, 1.0, -2.0])
    front = ((eye - points[faces[:, 0]]) * normals).sum(axis=1) > 0
    seen = page.call("geometry/topology", "facing", {**made, "faces": whole(faces)}, flat(points), eye.tolist(), 1)
    assert np.flatnonzero(seen["vertices"]).tolist() == sorted(set(faces[front].ravel().tolist()))
    around = page.call("geometry/topology", "normalAround", whole(faces), flat(points), {"set": [4]})
    np.testing.assert_allclose(around, normals[(faces == 4).any(axis=1)].sum(axis=0), atol=1e-12)


# picking -----------------------------------------------------------------------------------------------------------


def test_rectangle_and_lasso(page: Modules) -> None:
    rng = np.random.default_rng(9)
    screen = np.column_stack([rng.uniform(0, 100, (200, 2)), rng.choice([-1.0, 2.0], 200, p=[0.1, 0.9])])
    found = page.call("geometry/pick", "inRectangle", flat(screen), 70, 20, 30, 60)
    x, y, z = screen.T
    assert np.array_equal(found, (x >= 30) & (x <= 70) & (y >= 20) & (y <= 60) & (z > 0))

    angles = np.linspace(0, 2 * np.pi, 25)[:-1]
    reach = 30 + 15 * np.sin(3 * angles)  # a star: simple, not convex
    path = np.column_stack([50 + reach * np.cos(angles), 50 + reach * np.sin(angles)])
    inside = page.call("geometry/pick", "inLasso", flat(screen), path.ravel().tolist())
    away = path[None] - screen[:, None, :2]
    turn = np.arctan2(away[..., 1], away[..., 0])
    steps = (np.diff(np.concatenate([turn, turn[:, :1]], axis=1), axis=1) + np.pi) % (2 * np.pi) - np.pi
    assert np.array_equal(inside, (np.abs(steps.sum(axis=1)) > 1) & (z > 0))
    assert 20 < sum(inside) < 180


def test_a_brush_takes_what_is_near_its_path(page: Modules) -> None:
    rng = np.random.default_rng(10)
    screen = np.column_stack([rng.uniform(0, 100, (300, 2)), rng.choice([-1.0, 2.0], 300, p=[0.1, 0.9])])
    path, radius = np.array([[20, 30], [70, 35], [60, 80.0]]), 12.0
    away = np.full(300, np.inf)
    for share in np.linspace(0, 1, 4001):
        for begin, end in itertools.pairwise(path):
            away = np.minimum(away, np.linalg.norm(screen[:, :2] - begin - share * (end - begin), axis=1))
    sure = np.abs(away - radius) > 0.05
    found = np.array(page.call("geometry/pick", "inBrush", flat(screen), path.ravel().tolist(), radius))
    assert np.array_equal(found[sure], ((away <= radius) & (screen[:, 2] > 0))[sure]) and 40 < found.sum() < 200
    dab = np.array(page.call("geometry/pick", "inBrush", flat(screen), [50, 50], radius))
    near = np.linalg.norm(screen[:, :2] - 50, axis=1) <= radius
    assert np.array_equal(dab, near & (screen[:, 2] > 0))


def test_what_is_under_the_pointer(page: Modules) -> None:
    screen = np.array([[10, 10, 5.0], [12, 10, 2.0], [60, 10, 1.0], [10, 60, 1.0], [10, 12, -1.0]])
    assert page.call("geometry/pick", "vertexAt", flat(screen), 11, 10, 8) == 1  # of two alike, the nearer to the eye
    assert page.call("geometry/pick", "vertexAt", flat(screen), 90, 90, 8) == -1
    edges = whole([[0, 2], [0, 3], [2, 4]])
    assert page.call("geometry/pick", "edgeAt", flat(screen), edges, 30, 13, 8) == 0
    assert page.call("geometry/pick", "edgeAt", flat(screen), edges, 14, 40, 8) == 1
    assert page.call("geometry/pick", "edgeAt", flat(screen), edges, 40, 40, 8) == -1
    faces = whole([[0, 2, 3], [1, 2, 3]])
    assert page.call("geometry/pick", "faceAt", flat(screen), faces, 20, 20) == 1  # the foremost
    assert page.call("geometry/pick", "faceAt", flat(screen), faces, 90, 20) == -1


def test_regions_take_whole_edges_and_faces_by_their_middle(page: Modules) -> None:
    script = """
    const [screen, faces, done] = arguments;
    Promise.all([import("/geometry/pick.js"), import("/geometry/topology.js")]).then(([pick, topology]) => {
      const made = topology.makeTopology(faces, screen.length / 3);
      const points = Float64Array.from(screen);
      const inside = pick.region(points, (s) => pick.inRectangle(s, 0, 0, 10, 10));
      const modes = ["vertex", "edge", "face"];
      done(modes.map((mode) => [...pick.verticesInRegion(mode, made, points, inside)].sort((a, b) => a - b)));
    });
    """
    screen = [[1, 1, 1], [9, 1, 1], [1, 14, 1], [30, 30, 1], [5, 5, 1]]
    faces = [[0, 1, 2], [1, 2, 3]]
    found = page.driver.execute_async_script(script, np.ravel(screen).tolist(), faces)
    assert found == [[0, 1, 4], [0, 1], [0, 1, 2]]


def test_hidden_is_what_lies_behind_matter(page: Modules) -> None:
    """Against a ball of radius 1 in the middle, seen analytically."""
    view = {"eye": [0.0, -5.0, 0.5], "target": [0, 0, 0], "up": [0, 0, 1], "fov": 40.0}
    eye, (width, height), (near, far) = np.array(view["eye"]), (160, 120), (0.5, 50.0)

    def to_ball(ray: np.ndarray) -> np.ndarray:
        middle = -(ray @ eye)
        root = middle**2 - (eye @ eye - 1)
        return np.where(root > 0, middle - np.sqrt(np.maximum(root, 0)), np.inf)

    y, x = np.mgrid[0:height, 0:width] + 0.5
    half = np.tan(np.radians(20))
    rays = np.stack([(2 * x / width - 1) * half * width / height, (1 - 2 * y / height) * half, -np.ones_like(x)], -1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)) @ looked(view)
    depth = to_ball(rays)
    seen = np.isfinite(depth)
    value = np.zeros(depth.shape, int)
    value[seen] = np.round(1 + 65534 * np.log(depth[seen] / near) / np.log(far / near)).astype(int)
    data = {"uint16": value.ravel().tolist()}
    map_ = {"width": width, "height": height, "near": near, "far": far, "data": data}
    read = page.call("geometry/pick", "depthAt", map_, 80.4, 60.9)
    assert np.isclose(read, depth[60, 80], rtol=2e-4)
    assert page.call("geometry/pick", "depthAt", map_, 0.5, 0.5) is None  # JSON's way of saying infinity
    seen_by = page.call("geometry/camera", "makeCamera", view, width, height)
    for x, y in ((80.4, 60.9), (71.2, 48.7), (93.0, 66.1)):
        place = np.array(page.call("geometry/pick", "surfacePoint", map_, seen_by, x, y))
        assert np.isclose(np.linalg.norm(place), 1.0, atol=4e-3)  # on the ball
        np.testing.assert_allclose(projected(view, place, width, height)[:2], [x, y], atol=1e-6)
    assert page.call("geometry/pick", "surfacePoint", map_, seen_by, 3.0, 3.0) is None

    points = np.random.default_rng(4).uniform(-2, 2, (300, 3))
    rays = (points - eye) / np.linalg.norm(points - eye, axis=1)[:, None]
    beyond = np.linalg.norm(points - eye, axis=1) - to_ball(rays) - 0.05
    gap = np.arccos(rays @ (-eye / np.linalg.norm(eye))) - np.arcsin(1 / np.linalg.norm(eye))
    sure = (np.abs(gap) > 0.02) & ~(np.abs(beyond) < 0.02)  # not at the ball's rim, nor at the limit
    found = page.call("geometry/pick", "hiddenPoints", map_, camera(page, view, width, height), flat(points), 0.05)
    assert np.array_equal(np.array(found)[sure] == 1, (beyond > 0)[sure]) and 20 < sum(found) < 280
    assert not any(page.call("geometry/pick", "hiddenPoints", None, None, flat(points), 0.05))


# transforms --------------------------------------------------------------------------------------------------------

SHAPES = {
    "smooth": lambda t: (1 - t) ** 2 * (1 + 2 * t),
    "sphere": lambda t: np.sqrt(1 - t**2),
    "linear": lambda t: 1 - t,
    "sharp": lambda t: (1 - t) ** 2,
    "constant": lambda t: np.ones_like(t),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_weights_fall_off_with_the_distance_to_the_selection(page: Modules, points: np.ndarray, shape: str) -> None:
    chosen = [2, 7, 31]
    distance = np.linalg.norm(points[:, None] - points[chosen][None], axis=2).min(axis=1)
    expected = np.where(distance < 1.1, SHAPES[shape](np.minimum(distance / 1.1, 1)), 0)
    found = page.call("geometry/transform", "weightsOf", flat(points), {"set": chosen}, 1.1, shape)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    alone = page.call("geometry/transform", "weightsOf", flat(points), {"set": chosen}, 0, shape)
    assert np.flatnonzero(alone).tolist() == chosen and max(alone) == 1


def test_moves_are_those_of_the_library(page: Modules, points: np.ndarray) -> None:
    weights = page.call("geometry/transform", "weightsOf", flat(points), {"set": [1, 5]}, 0.9, "smooth")
    found = page.call("geometry/transform", "moved", flat(points), flat(weights), [0.3, -0.2, 0.5])
    expected = move(points, [0.3, -0.2, 0.5], group=[1, 5], radius=0.9)
    np.testing.assert_allclose(np.reshape(found, (-1, 3)), expected, atol=1e-14)


def test_rotations_and_scalings_by_weight(page: Modules, points: np.ndarray) -> None:
    weights = np.random.default_rng(1).uniform(0, 1, len(points)) * (np.arange(len(points)) % 3 > 0)
    pivot, axis = np.array([0.2, -0.4, 0.1]), np.array([1.0, 2.0, -2.0]) / 3
    found = page.call("geometry/transform", "rotated", flat(points), flat(weights), pivot.tolist(), axis.tolist(), 2.5)
    turns = Rotation.from_rotvec(weights[:, None] * 2.5 * axis)
    np.testing.assert_allclose(np.reshape(found, (-1, 3)), pivot + turns.apply(points - pivot), atol=1e-12)

    basis, factors = Rotation.random(random_state=2).as_matrix(), np.array([2.0, 0.5, -1.0])
    args = (pivot.tolist(), basis.tolist(), factors.tolist())
    found = page.call("geometry/transform", "scaled", flat(points), flat(weights), *args)
    local = (points - pivot) @ basis.T * (1 + weights[:, None] * (factors - 1))
    np.testing.assert_allclose(np.reshape(found, (-1, 3)), pivot + local @ basis, atol=1e-12)


def mirror_case() -> tuple[np.ndarray, np.ndarray]:
    """A cage with a plane of symmetry x = 0.7, and who is whose partner; the last vertex has none."""
    rng = np.random.default_rng(6)
    right = np.column_stack([rng.uniform(0.8, 2, 12), rng.normal(size=(12, 2))])
    left = right * [-1, 1, 1] + [1.4, 0, 0] + rng.uniform(-1e-4, 1e-4, (12, 3))
    middle = np.column_stack([np.full(5, 0.7), rng.normal(size=(5, 2))])
    ends = np.array([[-1.5, 9, 9], [2.9, -9, -9.5], [1.2, 3, 3]])  # the box's middle is the plane
    rest = np.concatenate([right, left, middle, ends])
    partners = np.concatenate([np.arange(12) + 12, np.arange(12), np.arange(24, 29), [-1, -1, -1]])
    return rest, partners


def test_partners_in_mirror_image(page: Modules) -> None:
    rest, partners = mirror_case()
    found = page.call("geometry/transform", "mirrorOf", flat(rest), 0)
    assert found["partners"] == partners.tolist() and np.isclose(found["plane"], 0.7)


@pytest.mark.parametrize("side", [1, -1])
def test_symmetric_edits_stay_symmetric(page: Modules, side: int) -> None:
    rest, partners = mirror_case()
    mirror = page.call("geometry/transform", "mirrorOf", flat(rest), 0)
    chosen = [3, 24] if side > 0 else [15, 24]
    assert page.call("geometry/transform", "leadingSide", flat(rest), mirror, {"set": chosen}, -1) == side
    assert page.call("geometry/transform", "leadingSide", flat(rest), mirror, {"set": chosen}, 20) == -1
    assert sorted(page.call("geometry/transform", "withPartners", mirror, {"set": chosen})) == [3, 15, 24]
    result = rest + np.random.default_rng(0).normal(size=rest.shape)
    found = page.call("geometry/transform", "mirrored", flat(rest), flat(rest), flat(result), mirror, side)
    step = np.reshape(found, (-1, 3)) - rest
    paired = partners >= 0
    np.testing.assert_allclose(step[paired], step[partners[paired]] * [-1, 1, 1], atol=1e-14)
    leads = (rest[:, 0] - 0.7) * side > 0.01
    np.testing.assert_allclose(step[leads & paired], (result - rest)[leads & paired], atol=1e-14)
    assert (step[24:29, 0] == 0).all() and np.allclose(step[29:], (result - rest)[29:])


@pytest.mark.parametrize("axes", ["world", "view", "local"])
def test_axes_are_right_handed(page: Modules, axes: str) -> None:
    normal = [0.1, 2.0, -0.4]
    basis = np.array(page.call("geometry/transform", "basisOf", axes, camera(page), normal))
    np.testing.assert_allclose(basis @ basis.T, np.eye(3), atol=1e-12)
    assert np.isclose(np.linalg.det(basis), 1)
    expected = {"world": [0, 0, 1], "view": looked(VIEW)[2], "local": np.array(normal) / np.linalg.norm(normal)}
    np.testing.assert_allclose(basis[2], expected[axes], atol=1e-12)


@pytest.mark.parametrize(
    ("keys", "value"),
    [
        ("1.5", 1.5),
        ("-.25", -0.25),
        ("5-", -5),
        ("5--", 5),
        ("12<3", 13),
        ("1,5", 1.5),
        ("1..5", 1.5),
        ("-", 7),
        ("", 7),
    ],
)
def test_typed_numbers(page: Modules, keys: str, value: float) -> None:
    script = """
    const [keys, done] = arguments;
    import("/geometry/transform.js").then(({ Typed }) => {
      const typed = new Typed(2);
      for (const key of keys) typed.take(key === "<" ? "Backspace" : key);
      const first = typed.value(0, 7);
      const next = [typed.take("Tab"), typed.take("3"), typed.value(1, 7), typed.take("G"), typed.value(0, 7)];
      done([first, next]);
    });
    """
    first, next_ = page.driver.execute_async_script(script, keys)
    assert first == value and next_ == [True, True, 3, False, value]


def test_steps(page: Modules) -> None:
    assert page.call("geometry/transform", "snapped", 0.37, 0) == 0.37
    assert np.isclose(page.call("geometry/transform", "snapped", 0.37, 0.05), 0.35)
    assert np.isclose(page.call("geometry/transform", "snapped", -0.38, 0.05), -0.4)


# drags -------------------------------------------------------------------------------------------------------------

PIVOT = np.array([0.3, -0.2, 0.4])


def at(point: np.ndarray) -> np.ndarray:
    return projected(VIEW, point)[:2]


@pytest.mark.parametrize("allowed", [(True, True, True), (True, True, False), (False, True, True)])
def test_what_is_under_the_pointer_stays_under_it(page: Modules, allowed: tuple[bool, ...]) -> None:
    start, end = at(PIVOT), at(PIVOT) + [70, -45]
    basis = np.eye(3)
    args = (PIVOT.tolist(), start.tolist(), end.tolist(), basis.tolist(), list(allowed))
    offset = np.array(page.call("geometry/transform", "offsetOf", camera(page), *args))
    np.testing.assert_allclose(at(PIVOT + offset), end, atol=1e-8)
    held = looked(VIEW)[2:] if all(allowed) else basis[~np.array(allowed)]
    np.testing.assert_allclose(held @ offset, 0, atol=1e-12)


@pytest.mark.parametrize("k", range(3))
def test_along_an_axis_the_nearest_place_is_taken(page: Modules, k: int) -> None:
    start, end = at(PIVOT), at(PIVOT) + [40, -60]
    axis = np.eye(3)[k]
    args = (PIVOT.tolist(), start.tolist(), end.tolist(), np.eye(3).tolist(), [i == k for i in range(3)])
    offset = np.array(page.call("geometry/transform", "offsetOf", camera(page), *args))
    ray = np.array(page.call("geometry/camera", "rayThrough", camera(page), *end.tolist()))

    def gap(t: float) -> float:
        away = PIVOT + t * axis - VIEW["eye"]
        return float(np.linalg.norm(away - ray * (away @ ray)))

    best = minimize_scalar(gap, bounds=(-10, 10), method="bounded", options={"xatol": 1e-9}).x
    np.testing.assert_allclose(offset, best * axis, atol=1e-6)


def test_an_axis_that_points_at_the_eye_does_not_run_away(page: Modules) -> None:
    axis = PIVOT - VIEW["eye"]
    x = axis / np.linalg.norm(axis)
    y = np.cross(x, [0, 0, 1.0])
    basis = np.stack([x, y / np.linalg.norm(y), np.cross(x, y / np.linalg.norm(y))])
    for allowed in ([True, False, False], [True, True, False]):
        args = (PIVOT.tolist(), at(PIVOT).tolist(), (at(PIVOT) + [40, 30]).tolist(), basis.tolist(), allowed)
        offset = page.call("geometry/transform", "offsetOf", camera(page), *args)
        assert np.linalg.norm(offset) < 60 * np.linalg.norm(axis) / HEIGHT


@pytest.mark.parametrize("sense", [1, -1])
def test_a_rotation_follows_the_pointer(page: Modules, sense: int) -> None:
    axis = sense * (np.array(VIEW["eye"]) - PIVOT)
    axis /= np.linalg.norm(axis)
    arm = np.cross(axis, [0, 0, 1.0])
    start = at(PIVOT + 0.5 * arm)
    end = at(PIVOT + Rotation.from_rotvec(0.8 * axis).apply(0.5 * arm))
    args = (PIVOT.tolist(), start.tolist(), end.tolist(), axis.tolist())
    assert np.isclose(page.call("geometry/transform", "angleOf", camera(page), *args), 0.8, atol=0.02)


def test_a_scaling_follows_the_pointer(page: Modules) -> None:
    start = at(PIVOT) + [30, 40]
    for factor in (2.5, 0.0, -1.0):
        end = at(PIVOT) + np.multiply([30, 40], factor)
        args = (PIVOT.tolist(), start.tolist(), end.tolist())
        assert np.isclose(page.call("geometry/transform", "factorOf", camera(page), *args), factor)


# boxes and curves --------------------------------------------------------------------------------------------------


def test_a_box_is_that_of_what_is_near(page: Modules) -> None:
    """A slab seen from the front, a wall far behind it: the wall is left out, and the hidden side goes back."""
    rng = np.random.default_rng(3)
    slab = np.column_stack([rng.uniform(-1, 1, 600), np.full(600, -0.4), rng.uniform(-0.5, 0.5, 600)])
    wall = np.column_stack([rng.uniform(-3, 3, 600), np.full(600, 9.0), rng.uniform(-2, 2, 600)])
    eye = {"eye": [0, -5, 0], "forward": [0, 1, 0], "focal": 500}
    bounds = [[-4, -4, -4], [4, 4, 4]]
    found = page.call("tools/box", "boxAround", np.vstack([slab, wall]).tolist(), np.eye(3).tolist(), eye, 250, bounds)
    low, high = np.array(found["lower"]), np.array(found["upper"])
    np.testing.assert_allclose(low, [-1, -0.4, -0.5], atol=0.08)
    np.testing.assert_allclose(high, [1, 0.6, 0.5], atol=0.08)  # as deep as it is high: it is flat along the view
    near = page.call(
        "tools/box", "boxAround", slab.tolist(), np.eye(3).tolist(), eye, 250, [[-4, -4, -4], [4, -0.1, 4]]
    )
    assert near["upper"][1] == pytest.approx(-0.1, abs=0.05)  # not beyond the field


def test_faces_of_boxes_and_of_nothing_else(page: Modules) -> None:
    turn = Rotation.from_euler("xyz", [0.5, 0.2, -1.0]).as_matrix()
    cage = warpcage.Cage.box((-1, -0.5, 0), (1, 0.7, 0.4))
    rest = cage.vertices @ turn.T
    topology = {"count": 8}
    given = {"faces": cage.faces.ravel().tolist(), "topology": topology, "rest": flat(rest)["float64"], "sense": 1}
    faces = page.call("tools/box", "boxFaces", given)
    normals = np.array([face["normal"] for face in faces])
    assert len(faces) == 6
    for sign in (1, -1):
        for axis in turn.T:
            assert (np.linalg.norm(normals - sign * axis, axis=1) < 1e-9).sum() == 1
    for face in faces:
        np.testing.assert_allclose(face["middle"], rest[face["corners"]].mean(axis=0), atol=1e-12)
        assert np.dot(face["middle"] - rest.mean(axis=0), face["normal"]) > 0
        pulled = np.reshape(page.call("tools/box", "pulledFace", flat(rest), face, 0.3, 2.0), (-1, 3))
        expected = rest.copy()
        expected[face["corners"]] += 0.3 * np.array(face["normal"])
        np.testing.assert_allclose(pulled, expected, atol=1e-12)
        thin = np.reshape(page.call("tools/box", "pulledFace", flat(rest), face, -9.0, 2.0), (-1, 3))
        assert np.ptp(thin @ face["normal"]) == pytest.approx(0.04)
    sheared = rest + 0.3 * rest[:, [2]] * [1.0, 0, 0]
    assert (
        page.call("tools/box", "boxFaces", given | {"rest": flat(sheared)["float64"]}) != []
    )  # a slanted box has faces
    broken = rest.copy()
    broken[0] += 0.2
    assert page.call("tools/box", "boxFaces", given | {"rest": flat(broken)["float64"]}) == []
    assert page.call("tools/box", "boxFaces", given | {"topology": {"count": 9}}) == []


@pytest.mark.parametrize("numbers", [(0.25, 0.1, 0.25, 1.0), (0.9, -0.5, 0.1, 1.5)])
def test_drawn_curves_are_those_of_the_library(page: Modules, numbers: tuple[float, ...]) -> None:
    places = np.array(page.call("panels/graph", "curvePlaces", list(numbers)))
    assert places[0].tolist() == [0, 0] and places[-1].tolist() == [1, 1] and (np.diff(places[:, 0]) > 0).all()
    gone = [eased_share({"bezier": list(numbers)}, share) for share in places[1:-1, 0]]
    np.testing.assert_allclose(places[1:-1, 1], gone, atol=1e-9)


def test_measures_are_in_words(page: Modules) -> None:
    long, parts = page.call("tools/ruler", "measured", [1, 2, 3], [4, 2, -1])
    assert long == "5 units" and parts == ["x 3", "y 0", "z -4"]
