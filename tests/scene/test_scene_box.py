"""The box of a scene's object from the points of a reconstruction."""

import numpy as np
import pytest

from warpcage.scene import are_inliers, bulk_box

SEEN = np.array([[-2.0] * 3, [2.0] * 3])


def scattered(random, low, high, count):
    return random.uniform(low, high, (count, 3))


def scene_points():
    """A floor, a body on it, a thin arm above with one point in a hundred and fifty, and a few mistakes far above."""
    random = np.random.default_rng(0)
    floor = scattered(random, [-1, -1, -0.02], [1, 1, 0.0], 3000)
    body = scattered(random, [-0.3, -0.3, 0.0], [0.3, 0.3, 0.4], 1500)
    arm = scattered(random, [0.1, -0.03, 0.4], [0.16, 0.03, 1.0], 30)
    mistakes = np.array([[0.9, 0.0, 1.6], [-0.8, 0.5, 1.7], [0.0, -0.9, 1.9], [0.2, 0.9, 1.8]])
    return np.concatenate([floor, body]), arm, mistakes


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_thin_part_above_the_bulk_is_in_the_box_and_mistakes_are_not(axis, sign):
    bulk, arm, mistakes = (sign * np.roll(each, axis - 2, axis=1) for each in scene_points())
    up = sign * np.eye(3)[axis]
    without, found = (bulk_box(np.concatenate([bulk, *more, mistakes]), SEEN, up) for more in ([], [arm]))
    heights = lambda box: np.sort(box @ up)  # noqa: E731
    assert 1.0 < heights(found)[1] < 1.3 and heights(without)[1] < 0.7
    others = [each for each in range(3) if each != axis]
    np.testing.assert_allclose(found[:, others], without[:, others], atol=0.02)
    np.testing.assert_allclose(heights(found)[0], heights(without)[0], atol=0.02)
    level = bulk_box(np.concatenate([bulk, arm, mistakes]), SEEN, np.eye(3)[others[0]])
    assert heights(level)[1] < 0.85  # nothing says that this is up


def test_points_alone_are_those_without_others_near_them():
    random = np.random.default_rng(1)
    points = random.normal(size=(300, 3))
    apart = np.sort(np.linalg.norm(points[:, None] - points[None], axis=-1), axis=1)
    assert np.array_equal(are_inliers(points, 0.5), apart[:, 5] <= 0.5)
    assert 20 < are_inliers(points, 0.5).sum() < 280 and not are_inliers(points[:5], 1e9).any()


def test_few_points_and_points_in_one_place_make_no_box():
    assert bulk_box(np.zeros((7, 3)), SEEN, np.eye(3)[2]) is None
    assert bulk_box(np.zeros((70, 3)), SEEN, np.eye(3)[2]) is None
