"""Agreement of matches with cameras: made scenes whose cameras are right, torn in two, inside out, or a few wrong."""

import numpy as np
import pytest
from correspondences import FOCAL, correspondences, inside_out, orbit, seen, torn_in_two

from warpcage import Camera
from warpcage.scene import agreement_of, ahead_share, held_groups, rays_meet


def measured(slopes, matches, poses):
    return agreement_of(slopes, matches, poses, np.full(len(poses), 1.0 / FOCAL))


def test_right_cameras():
    poses = orbit(20)
    slopes, matches = correspondences(poses)
    found = measured(slopes, matches, poses)
    assert found.share > 0.93 and [len(group) for group in found.groups] == [20]
    assert len(found.pairs) == len(matches) and (found.counts == 60).all()
    exact = measured(*correspondences(poses, noise=0.0, wrong=0.0), poses)
    assert exact.share == 1.0


@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_the_unit_and_place_of_the_world_do_not_matter(scale):
    poses = orbit(8)
    slopes, matches = correspondences(poses)
    moved = poses.copy()
    moved[:, :3, 3] = scale * (poses[:, :3, 3] + [5.0, -3.0, 2.0])
    assert (measured(slopes, matches, moved).agreeing == measured(slopes, matches, poses).agreeing).all()


@pytest.mark.parametrize("seam", [0, 1])
def test_cameras_torn_in_two(seam):
    """The second part moves as one: it agrees in itself, and not with the first, but for a few pairs at a seam."""
    poses = orbit(24)
    slopes, matches = correspondences(poses, apart=5)
    torn = torn_in_two(poses, 14)
    if seam:  # one pair across agrees: as if its pictures showed something else, which moved along
        relative = np.linalg.inv(torn[13]) @ torn[14]
        other = np.random.default_rng(1).uniform(-1, 1, (60, 3)) + [0, 0, 4.0]
        extra = [seen(other, np.eye(4)), seen(other, relative)]
        slopes[13], slopes[14] = (np.concatenate([slopes[k + 13], extra[k]]) for k in (0, 1))
        matches[13, 14] = np.stack([np.arange(60, 120)] * 2, axis=1)
    found = measured(slopes, matches, torn)
    assert [group.tolist() for group in found.groups] == [list(range(14)), list(range(14, 24))]
    total, good = found.across(found.groups[1])
    across = [(a, b) for a, b in matches if a < 14 <= b]
    assert total == 60 * len(across) and good <= 60 * seam + 0.2 * total
    assert found.share < measured(slopes, matches, poses).share + seam


def test_one_camera_that_is_wrong():
    poses = orbit(12)
    slopes, matches = correspondences(poses)
    poses[5, :3, 3] += [0.0, 0.0, 1.0]
    found = measured(slopes, matches, poses)
    assert [group.tolist() for group in found.groups] == [[*range(5), *range(6, 12)], [5]]


def test_pictures_without_a_camera_do_not_count():
    poses = orbit(10)
    slopes, matches = correspondences(poses)
    poses[4] = np.nan
    found = measured(slopes, matches, poses)
    assert not (found.pairs == 4).any() and all(4 not in group for group in found.groups)
    assert sum(map(len, found.groups)) == 9


def test_cameras_inside_out():
    """What all cameras look at lies behind them, and matches show that they are wrong."""
    poses = orbit(14, degrees=80.0)
    slopes, matches = correspondences(poses)
    turned = inside_out(poses)
    views = [[Camera(FOCAL, FOCAL, 400, 300, 800, 600, pose) for pose in each] for each in (poses, turned)]
    assert ahead_share(views[0]) == 1.0 and ahead_share(views[1]) == 0.0
    assert measured(slopes, matches, turned).share < 0.7 < measured(slopes, matches, poses).share


def test_cameras_that_look_one_way_have_nothing_behind_them():
    poses = [np.eye(4) for _ in range(3)]
    for k, pose in enumerate(poses):
        pose[0, 3] = k
    assert ahead_share([Camera(FOCAL, FOCAL, 400, 300, 800, 600, pose) for pose in poses]) == 1.0


POINT = np.array([0.2, -0.1, 5.0])


@pytest.mark.parametrize(
    ("place", "missed", "meets"),
    [
        (POINT, 0.0, True),
        (POINT, 0.9, True),  # pixels, across the plane of both rays: half of it for each camera
        (POINT, 6.0, False),
        (np.array([1.0, 0.4, -3.0]), 0.0, False),  # behind both
        (POINT * 1e6, 0.0, True),  # parallel: no depth
        (-POINT * 1e6, 0.0, True),  # the same rays
    ],
)
def test_where_rays_meet(place, missed, meets):
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, 0, 3] = 1.0
    first, second = (seen(place[None], pose) for pose in poses)
    second[0, 1] += missed / FOCAL
    assert rays_meet(first, second, poses, np.full(2, 1.0 / FOCAL)).tolist() == [meets]


def test_groups_of_pictures_that_nothing_joins():
    groups = held_groups(np.arange(6), np.array([[0, 2], [2, 4], [1, 3], [3, 5]]), np.array([5, 4, 3, -3]))
    assert [group.tolist() for group in groups] == [[0, 2, 4], [1, 3], [5]]
