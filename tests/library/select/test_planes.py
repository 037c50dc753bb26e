"""Planes in a surface: against planes that are known, in float64."""

import numpy as np
import pytest
from fields import GridField
from refusals import refused
from scenes import FLOOR_TOP, TABLE_TOP, TableScene, tilt
from scipy.ndimage import gaussian_filter

from warpcage.select import Plane, blocks, find_planes, fit_planes, surface_points, surrounds


def sheet(random, normal, offset, count, noise, size=1.0):
    """Points on a plane, a disc of a size, and their normals, both with noise."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    across = np.linalg.svd(normal[None])[2][1:]
    angle, radius = random.uniform(0, 2 * np.pi, count), size * np.sqrt(random.uniform(0, 1, count))
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    points = flat @ across + (offset + noise * random.standard_normal(count))[:, None] * normal
    normals = normal + 0.15 * random.standard_normal((count, 3))
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("clutter", [0.0, 0.5, 0.85])
def test_a_plane_in_clutter(clutter):
    random = np.random.default_rng(3)
    normal = np.array([0.2, -0.3, 0.9]) / np.linalg.norm([0.2, -0.3, 0.9])
    points, normals = sheet(random, normal, 0.37, 2000, 0.005)
    count = int(2000 * clutter / (1 - clutter))
    fog = random.uniform(-1, 1, (count, 3))
    ways = random.standard_normal((count, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    planes = fit_planes(np.concatenate([points, fog]), np.concatenate([normals, ways]), 0.02)
    best = planes[0]
    assert np.degrees(np.arccos(best.normal @ normal)) < 0.3 and abs(best.offset - 0.37) < 0.002
    assert best.share == pytest.approx(1 - clutter, abs=0.02) and 0.004 < best.spread < 0.008


def test_fog_alone_has_no_plane():
    random = np.random.default_rng(5)
    ways = random.standard_normal((5000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    assert fit_planes(random.uniform(-1, 1, (5000, 3)), ways, 0.03) == []


def test_weights_decide_which_plane_is_the_largest():
    random = np.random.default_rng(7)
    one, two = sheet(random, (0, 0, 1), 0.0, 3000, 0.003), sheet(random, (1, 0, 0), 0.5, 6000, 0.003)
    points, normals = (np.concatenate(each) for each in zip(one, two, strict=True))
    assert abs(fit_planes(points, normals, 0.02)[0].normal[0]) > 0.99
    weights = np.r_[np.ones(3000), np.full(6000, 0.05)]
    assert fit_planes(points, normals, 0.02, weights=weights)[0].normal[2] > 0.99


def test_tops_that_happen_to_lie_in_one_plane_are_none():
    random = np.random.default_rng(9)
    floor = sheet(random, (0, 0, 1), 0.0, 4000, 0.003)
    patches = [sheet(random, (0, 0, 1), 0.0, 150, 0.003, size=0.05) for _ in range(4)]
    tops = [
        (points + place, normals)
        for (points, normals), place in zip(
            patches, ([0.6, 0, 0.4], [-0.6, 0, 0.4], [0, 0.6, 0.4], [0, -0.6, 0.4]), strict=True
        )
    ]
    points, normals = (np.concatenate(each) for each in zip(floor, *tops, strict=True))
    assert [round(plane.offset, 2) for plane in fit_planes(points, normals, 0.02)] == [0.0]


@pytest.mark.parametrize("degrees", [0.0, 7.0, 20.0])
def test_floor_and_table_of_a_scene_that_is_held_askew(degrees):
    scene = TableScene(degrees=degrees)
    voxel = 2.0 / scene.count
    planes = find_planes(scene.field)
    heights = {}
    for plane in planes[:2]:
        assert np.degrees(np.arccos(min(plane.normal @ scene.world((0, 0, 1)), 1.0))) < 0.5
        heights[round(plane.offset, 1)] = plane.offset
    # the outermost nodes of matter lie on average half a voxel inside it
    assert abs(heights[-0.8] + 0.5 * voxel - FLOOR_TOP) < 0.5 * voxel
    assert abs(heights[-0.2] + 0.5 * voxel - TABLE_TOP) < 0.5 * voxel


def test_kinds_of_planes_go_by_what_is_up():
    scene = TableScene(degrees=40.0, fragments=False)
    assert not [plane for plane in find_planes(scene.field) if plane.share > 0.1]  # 40 degrees off
    up = scene.world((0, 0, 1))
    assert find_planes(scene.field, up=up)[0].normal @ up > 0.999
    block = np.zeros((32, 32, 32))
    block[6:26, 4:28, 8:24] = 100.0
    walls = find_planes(GridField(block), "wall")
    assert sorted(map(tuple, np.round([plane.normal for plane in walls]).astype(int).tolist())) == [
        (-1, 0, 0), (0, -1, 0), (0, 1, 0), (1, 0, 0)
    ]  # fmt: skip
    (top,) = find_planes(GridField(block), up=(0.2, 0, 1))
    assert np.allclose(top.normal, [0, 0, 1], atol=0.02) and len(find_planes(GridField(block), "any")) == 6
    assert find_planes(scene.field, "any", up=(1, 0, 0))[0].normal @ up > 0.999
    refused(lambda: find_planes(scene.field, "sky"), match="plane must be one of ground, wall, any")
    refused(lambda: find_planes(scene.field, up=(0, 0, 0)), match="up must be a direction")


def test_a_wall_that_is_rough_for_its_voxels():
    """As fields of many voxels have them: bumps of three voxels, whose slopes lean by 45 degrees and more."""
    random = np.random.default_rng(11)
    bumps = gaussian_filter(random.standard_normal((200, 192)), 2.0, mode="wrap")
    heights = 20.0 + 3.0 * bumps / bumps.std() + 0.05 * np.arange(200)[:, None]
    voxel = 0.01
    size = np.array([200, 192, 60]) * voxel
    field = GridField(np.where(np.arange(60) < heights[..., None], 500.0, 0.0), lower=(0, 0, 0), upper=size)
    plane = find_planes(field)[0]
    true = np.array([-0.05, 0.0, 1.0]) / np.hypot(0.05, 1.0)
    assert np.degrees(np.arccos(plane.normal @ true)) < 1.0 and plane.share > 0.5
    middle = np.array([100.0, 96.0, heights.mean()]) * voxel
    assert abs(float(plane.heights(middle))) < 1.5 * voxel
    assert 1.5 * voxel < plane.spread < 4.0 * voxel and len(plane.points) > 20_000


def test_blocks_of_nodes():
    values = np.random.default_rng(0).uniform(0, 1, (5, 4, 7))
    cut = blocks(values, 3)
    assert cut.shape == (2, 3, 2, 3, 3, 3) and np.isclose(cut.sum(), values.sum())
    assert cut[1, 1, 0, 2, 2, 0] == values[4, 2, 6] and cut[1, 2, 1, 1, 0, 0] == 0.0


def test_normals_of_a_ball_point_away_from_its_middle():
    x = (np.indices((40,) * 3) + 0.5) / 20 - 1
    field = GridField(np.where((x**2).sum(axis=0) < 0.36, 200.0, 0.0))
    points, normals, weights = surface_points(field)
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert len(points) > 2000 and (weights == 1.0).all()
    assert np.degrees(np.arccos(np.einsum("ni,ni->n", normals, outward).clip(-1, 1))).max() < 12
    assert find_planes(field) == []


def test_a_plane_goes_on_around_a_cup_and_not_around_the_back_of_a_seat():
    grid = np.stack(np.meshgrid(np.arange(-1, 1, 0.05), np.arange(-1, 1, 0.05), [0.0]), axis=-1).reshape(-1, 3)
    seat = Plane((0, 0, 1), 0.0, points=grid)
    column = np.stack(np.meshgrid([-0.1, 0, 0.1], [-0.1, 0, 0.1], np.arange(0.1, 1, 0.05)), axis=-1).reshape(-1, 3)
    back = column * [9, 0.5, 1] + [0, 0.98, 0]
    assert surrounds(seat, column, 0.05) and not surrounds(seat, back, 0.05)
    hat = 0.9 * grid + [0, 0, 0.5]  # its shadow is nearly as large as the plane
    assert not surrounds(seat, np.concatenate([column, hat]), 0.05)
    assert surrounds(Plane((0, 0, 2), 0.0, points=grid @ tilt(0)), column, 0.05)


def test_a_plane_is_one():
    assert np.allclose(Plane((0, 0, 2), 0.5).heights([[1, 2, 3], [0, 0, 0.5]]), [2.5, 0.0])
    refused(lambda: Plane((0, 0, 0), 1.0), match="must not be zero")
