"""From where cameras saw an object: gaps, heights, arcs that a film may turn through, and the map of it."""

import json

import numpy as np
import pytest
from runs import run, succeed

from warpcage import Camera
from warpcage.demo import write_brick_scene
from warpcage.scene import draw_coverage, find_coverage
from warpcage.view import axis_rotation, read_image

MIDDLE = np.array([3.0, -2.0, 0.5])


def ring(azimuths, elevations=(20.0,), middle=MIDDLE, distance=4.0):
    """Cameras that look at a place from angles around and above it, degrees."""
    cameras = []
    for turn, rise in ((turn, rise) for turn in np.radians(azimuths) for rise in np.radians(elevations)):
        way = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
        cameras.append(Camera.look_at(middle + distance * way, middle, width=40, height=30))
    return cameras


def eye_at(azimuth):
    return ring([azimuth])[0].center


def test_angles_by_hand():
    seen = find_coverage(ring(np.arange(100, 261, 20), (-10, 35)), MIDDLE)
    assert seen.around == pytest.approx(200.0) and seen.elevation == pytest.approx((-10.0, 35.0))
    np.testing.assert_allclose(seen.seam % 360, 0.0, atol=1e-6)
    full = find_coverage(ring(np.arange(0, 360, 30)), MIDDLE)
    assert full.around == pytest.approx(30.0) and full.arc(eye_at(12)) is None


@pytest.mark.parametrize(
    "azimuth, arc", {-175: (-35, 45), -20: (-10, 50), 40: (-70, -10), 95: (55, 135), 179: (-29, 51)}.items()
)
def test_a_camera_may_turn_to_where_others_stood(azimuth, arc):
    """Two groups, and angles begin anew within one: that of the camera counts, or else the nearest one."""
    found = find_coverage(ring([150, 170, 190, 210, 230, -30, 0, 30]), MIDDLE).arc(eye_at(azimuth))
    np.testing.assert_allclose(found, arc, atol=1e-6)


def test_what_is_up_and_where_the_world_is_do_not_matter():
    cameras = ring(np.arange(10, 140, 15), (0, 30))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = axis_rotation(np.array([0.6, 0.0, 0.8]), 2.0), (50.0, 7.0, -3.0)
    moved = [camera.moved(motion) for camera in cameras]
    here = find_coverage(cameras, MIDDLE)
    there = find_coverage(moved, motion[:3, :3] @ MIDDLE + motion[:3, 3], motion[:3, :3] @ (0, 0, 7.0))
    assert there.around == pytest.approx(here.around) and there.elevation == pytest.approx(here.elevation)
    np.testing.assert_allclose(there.arc(moved[3].center), here.arc(cameras[3].center), atol=1e-6)
    np.testing.assert_allclose(there.shares(3), here.shares(3), atol=0.01)


def test_cameras_that_look_elsewhere_saw_nothing():
    away = [Camera.look_at(eye_at(azimuth), 2 * eye_at(azimuth) - MIDDLE) for azimuth in range(0, 360, 30)]
    seen = find_coverage(ring([80, 100, 120]) + away, MIDDLE)
    assert seen.around == pytest.approx(320.0) and len(seen.directions) == 3


def test_shares_of_directions_are_those_of_caps():
    """A cap of 20 degrees is (1 - cos 20) / 2 of the sphere; three cameras at one place are enough there."""
    cap = 0.5 * (1.0 - np.cos(np.radians(20.0)))
    seen = find_coverage(ring([50] * 3, (60,)) + ring([-90], (-45,)), MIDDLE)
    assert seen.shares(1)[0] == pytest.approx(2 * cap, abs=2e-3)
    assert seen.shares(3) == pytest.approx((cap, 2 * cap), abs=2e-3)


def test_the_map_shows_what_few_cameras_saw():
    cameras = ring([90] * 3) + ring([-90])
    bounds = np.stack([MIDDLE - 0.2, MIDDLE + 0.2])
    drawn = draw_coverage(find_coverage(cameras, MIDDLE), cameras, bounds)
    colors = {tuple(color) for color in (drawn.reshape(-1, 3) * 255).round().astype(int)[::7]}
    assert {(224, 224, 224), (246, 178, 107), (196, 228, 186)} <= colors
    without = draw_coverage(find_coverage(cameras[:3], MIDDLE), cameras[:3], bounds)
    left = (without[:400, :800].reshape(-1, 3) * 255).round().astype(int)
    assert (246, 178, 107) not in set(map(tuple, left))


def test_info_says_what_was_seen_and_draws_it(tmp_path, capsys):
    write_brick_scene(tmp_path / "scene", train_views=8, test_views=1, size=24, device="cpu")
    entries = json.loads((tmp_path / "scene" / "transforms_train.json").read_text())
    succeed(tmp_path, "info", "@scene", "--seen", "@seen.png")
    said = capsys.readouterr().out
    line = next(line for line in said.splitlines() if line.startswith("seen"))
    eyes = np.array([frame["transform_matrix"] for frame in entries["frames"]])[:, :3, 3]
    assert "degrees around it" in line and "seen.png" in line and len(eyes) == 8
    assert read_image(tmp_path / "seen.png").shape[1] > 1000
    (tmp_path / "cage.obj").write_text("v 0 0 0\n")
    assert run(tmp_path, "info", "@cage.obj", "--seen", "@no.png") == 2
    assert "--seen" in capsys.readouterr().err and not (tmp_path / "no.png").exists()
