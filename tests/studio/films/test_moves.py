"""Moves of a camera by name, and the course of a film."""

import importlib

import numpy as np
import pytest
from refusals import refused

from warpcage import Camera, turntable
from warpcage.studio.films.moves import MovingCamera, camera_moves

PIVOT, UP = np.array([0.5, -1.0, 0.25]), np.array([0.0, 0.6, 0.8])
START = turntable(PIVOT, 3.0, 20.0, 5, up=UP)[1]


def moving(moves, count=11, rate=24.0, start=START):
    return MovingCamera(start, PIVOT, UP, camera_moves(moves), count, rate)


def heights(camera):
    offset = camera.center - PIVOT
    return np.linalg.norm(offset), np.degrees(np.arcsin(offset @ UP / np.linalg.norm(offset)))


def test_a_turn_by_name_is_that_of_a_turntable():
    ring = turntable(PIVOT, 3.0, 20.0, 5, up=UP)
    turn = moving("turn", 5)
    for frame in range(-1, 5):
        np.testing.assert_allclose(turn.at(frame).camera_to_world, ring[(frame + 1) % 5].camera_to_world, atol=1e-12)
    part = moving("turn:72", 9)
    np.testing.assert_allclose(part.at(8).camera_to_world, ring[2].camera_to_world, atol=1e-12)
    half = part.at(4.0).center - PIVOT
    np.testing.assert_allclose(np.linalg.norm(half), 3.0)


@pytest.mark.parametrize("share", [0.4, 2.5])
def test_a_dolly_goes_along_its_axis_to_a_share_of_the_distance(share):
    camera = moving(f"dolly:{share}")
    np.testing.assert_allclose(camera.at(0).camera_to_world, START.camera_to_world)
    np.testing.assert_allclose(heights(camera.at(10)), (3.0 * share, 20.0))
    ways = np.array([camera.at(frame).center - START.center for frame in range(11)])
    steps = np.linalg.norm(np.diff(ways, axis=0), axis=1)
    assert steps.argmax() in (4, 5) and steps[0] < 0.3 * steps.max() and steps[-1] < 0.3 * steps.max()
    np.testing.assert_array_equal(camera.at(4).rotation, START.rotation)


@pytest.mark.parametrize("degrees, goal", [(30, 50), (-45, -25), (100, 89)])
def test_a_crane_rises_and_keeps_its_target_and_distance(degrees, goal):
    camera = moving(f"crane:{degrees}").at(10)
    np.testing.assert_allclose(heights(camera), (3.0, goal))
    np.testing.assert_allclose(camera.project(PIVOT[None])[0], [[200.0, 200.0]], atol=1e-6)
    assert abs(camera.rotation[:, 0] @ UP) < 1e-9  # it stays level


def test_a_hand_held_camera_shakes_by_its_seed_and_by_seconds():
    shaken = moving("hand-held:3", 240)
    cameras = [shaken.at(frame) for frame in range(240)]
    turns = np.array([camera.rotation[:, 2] @ START.rotation[:, 2] for camera in cameras])
    degrees = np.degrees(np.arccos(np.clip(turns, -1, 1)))
    ways = np.array([camera.center - START.center for camera in cameras])
    assert 0.2 < degrees.max() < 1.0 and 0.005 < np.linalg.norm(ways, axis=1).max() < 0.03
    assert np.linalg.norm(np.diff(ways, axis=0), axis=1).max() < 0.006  # no jolts
    same, other = moving("hand-held:3", 9, rate=48.0), moving("hand-held:4", 240)
    np.testing.assert_allclose(same.at(20).camera_to_world, cameras[10].camera_to_world, atol=1e-12)
    assert np.abs(other.at(10).camera_to_world - cameras[10].camera_to_world).max() > 1e-4


def test_what_is_followed_stays_in_the_middle():
    def place(part, frame=0.0):
        assert part == "2"
        return PIVOT + (0.1 * frame, 0.05 * frame, -0.02 * frame)

    camera = moving("dolly:0.5+follow:2")
    for frame in (0, 3, 7.5):
        seen = camera.at(frame, lambda part, frame=frame: place(part, frame))
        np.testing.assert_allclose(seen.project(place("2", frame)[None])[0], [[200.0, 200.0]], atol=1e-6)
        np.testing.assert_array_equal(seen.center, moving("dolly:0.5").at(frame).center)
        assert abs(seen.rotation[:, 0] @ UP) < 1e-9


@pytest.mark.parametrize(
    "moves", ["turn:far", "dolly:0", "dolly:-1", "hand-held:0.5", "crane:nan", "turn+spin", "turn+"]
)
def test_moves_that_are_none(moves):
    refused(lambda: camera_moves(moves), match="is not a move: turn")
    assert camera_moves("scene:test") is None and camera_moves("turntable.json") is None


def test_moves_that_cannot_be_from_there():
    above = Camera.look_at(PIVOT + 2.0 * UP, PIVOT, up=(1.0, 0.0, 0.0))
    away = Camera.look_at(PIVOT + (1.0, 0.0, 0.0), PIVOT + (2.0, 0.0, 0.0))
    for moves, start in (("crane", above), ("dolly", away)):
        with pytest.raises(ValueError, match="above or below|behind it"):
            moving(moves, start=start).at(3)


@pytest.mark.filterwarnings("ignore::FutureWarning")
@pytest.mark.parametrize(
    ("module", "name", "home"),
    [
        ("view", "write_film", "video"),
        ("view", "camera_moves", "moves"),
        ("view", "frame_places", "motion"),
        ("view.motion", "pose_weights", "motion"),
    ],
)
def test_names_that_moved_are_found_where_they_were(module, name, home):
    found = getattr(importlib.import_module(f"warpcage.{module}"), name)
    assert found is getattr(importlib.import_module(f"warpcage.studio.films.{home}"), name)
