"""Made matches of pictures around an object, and cameras that are wrong in known ways."""

import numpy as np

from warpcage import Camera

FOCAL = 700.0


def orbit(count, degrees=300.0):
    """Poses (n, 4, 4) that walk around the origin and look at it, OpenCV axes."""
    turns = np.radians(np.linspace(0, degrees, count))
    return np.array(
        [Camera.look_at([4 * np.cos(t), 4 * np.sin(t), 1.5], [0, 0, 0], fov_degrees=60).camera_to_world for t in turns]
    )


def seen(points, pose):
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    return local[:, :2] / local[:, 2:]


def correspondences(poses, *, apart=3, noise=0.3, wrong=0.02, seed=0):
    """Slopes of 60 points in all pictures, and matches of each with those up to `apart` on; some are wrong by lot."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (60, 3))
    slopes = [seen(points, pose) + rng.normal(0, noise / FOCAL, (60, 2)) for pose in poses]
    matches = {}
    for a in range(len(poses)):
        for b in range(a + 1, min(a + apart + 1, len(poses))):
            rows = np.stack([np.arange(60), np.arange(60)], axis=1)
            lot = rng.random(60) < wrong
            rows[lot, 1] = rng.integers(0, 60, lot.sum())
            matches[a, b] = rows
    return slopes, matches


def torn_in_two(poses, first):
    """The cameras from `first` on move as one, to another place and turned by a quarter."""
    torn, turn = poses.copy(), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    torn[first:, :3, :3] = turn @ poses[first:, :3, :3]
    torn[first:, :3, 3] = poses[first:, :3, 3] @ turn.T + [3.0, 6.0, 0.0]
    return torn


def inside_out(poses):
    """In the same places, but each turned the other way from the middle one: they look away from each other's views."""
    turned = np.linalg.inv(poses[len(poses) // 2]) @ poses
    mirror = np.diag([1.0, 1.0, -1.0])
    turned[:, :3, :3] = mirror @ turned[:, :3, :3] @ mirror
    return turned
