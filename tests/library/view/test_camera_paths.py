"""Cameras in files, and between keys."""

import dataclasses
import json

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused

from warpcage import Cage, Camera, CameraFile, CameraKey, camera_at, turntable
from warpcage.studio.films.motion import path_cameras
from warpcage.view import axis_rotation, eased_share, timed_keys

LENS = {"fov_degrees": 50, "width": 60, "height": 40}


def some_cameras(count=5, seed=0):
    """Around a point, at several distances, held at several angles."""
    rng = np.random.default_rng(seed)
    cameras = []
    for angle in np.linspace(0.0, 4.0, count):
        eye = [2.0 + 3 * np.cos(angle), 3 * np.sin(angle), rng.normal()]
        camera = Camera.look_at(eye, (2.0, 0.1, 0.2), up=rng.normal(size=3) * 0.2 + [0, 0, 1], **LENS)
        cameras.append(dataclasses.replace(camera, fx=50.0 + angle, cx=30.5))
    return cameras


def same(one, two, tolerance=0.0):
    numbers = [[c.fx, c.fy, c.cx, c.cy, c.width, c.height, *c.camera_to_world.ravel()] for c in (one, two)]
    return np.abs(np.subtract(*numbers)).max() <= tolerance


def test_files_keep_every_bit(tmp_path):
    cameras = some_cameras()
    keys = [
        CameraKey(cameras[0], 0.0, "first"),
        CameraKey(cameras[1], 0.1, "näxt", "hold", (1, 2, 3)),
        CameraKey(cameras[2], 7),
    ]
    CameraFile(keys, fps=29.97, loop="ping-pong").save(tmp_path / "path.json")
    found = CameraFile.load(tmp_path / "path.json")
    assert all(same(one.camera, two.camera) for one, two in zip(keys, found, strict=True))
    for one, two in zip(keys, found, strict=True):
        assert (one.time, one.name, one.easing) == (two.time, two.name, two.easing)
    np.testing.assert_array_equal(found[1].target, [1, 2, 3])
    assert found[0].target is None and (found.fps, found.loop) == (29.97, "ping-pong")
    cameras[3].save(tmp_path / "one.json")
    assert same(Camera.load(tmp_path / "one.json"), cameras[3])
    assert same(Camera.load(tmp_path / "path.json", "näxt"), cameras[1])
    assert same(Camera.load(tmp_path / "path.json", "2"), cameras[2])


def test_files_that_cannot_be_read_are_refused_in_one_line(tmp_path):
    CameraFile(some_cameras(2)).save(tmp_path / "good.json")
    good = json.loads((tmp_path / "good.json").read_text())

    def with_camera(**changes):
        return good | {"cameras": [good["cameras"][0] | changes]}

    cases = {
        "its format is 'poses'": good | {"format": "poses"},
        "this warpcage reads up to 1": good | {"version": 2},
        "a whole number from 1": good | {"version": 1.5},
        "at least one": good | {"cameras": []},
        "not a camera file": {"format": "warpcage cameras", "version": 1},
        "a list of at least one": good | {"cameras": {}},
        "camera 0: focal lengths must be positive": with_camera(fx=-1),
        "camera 0: camera_to_world must be a finite": with_camera(camera_to_world=[[1, 2], [3, 4]]),
        "from 0 on, got -1": with_camera(time=-1),
        "easing must be one of": with_camera(easing="wobble"),
        "easing must have four numbers": with_camera(easing={"bezier": [1, 2]}),
        "must be a text": with_camera(name=3),
        "target of a camera must be 3 finite numbers": with_camera(target=[1, 2]),
        "the rate of a camera file must be": good | {"fps": 0},
        "loop must be one of": good | {"loop": "round"},
    }
    for said, content in cases.items():
        (tmp_path / "bad.json").write_text(json.dumps(content))
        refused(lambda: CameraFile.load(tmp_path / "bad.json"), said, "bad.json")
    head = b'{"format": "warpcage cameras", "version": 1'
    for data, said in (
        (b"\n", "it is empty"),
        (b"\xff\xfe\x00", "it holds no text"),
        (b"[" * 100_000, ""),
        (head[:20], "its JSON breaks off or is damaged at line 1, column 12"),
        (b"5", "it holds no JSON object"),
        (b"{}", "it lacks 'format'"),
        (head + b"}", "it lacks 'cameras'"),
        (head + b', "cameras": [7]}', "of another kind than it should be"),
    ):
        (tmp_path / "bad.json").write_bytes(data)
        refused(lambda: CameraFile.load(tmp_path / "bad.json"), "bad.json: not a camera file", said)
    refused(lambda: Camera.load(tmp_path / "none.json"), match="camera file", error=FileNotFoundError)
    refused(lambda: Camera.load(tmp_path / "good.json"), match=MESSAGES["view.cameras_by_name"])
    refused(lambda: Camera.load(tmp_path / "good.json", "side"), match="it holds no camera 'side', only 0, 1")
    with pytest.raises(ValueError, match="^[^:]*shot.gltf: there is no camera"):
        Cage.box([0, 0, 0], [1, 1, 1]).save(tmp_path / "shot.gltf")
        Camera.load(tmp_path / "shot.gltf")
    refused(lambda: some_cameras(1)[0].save(tmp_path / "camera.txt"), match="must end in .json")
    assert not (tmp_path / "camera.txt").exists()


def test_keys_are_met_and_beyond_them_all_is_still():
    keys = [CameraKey(camera, time) for camera, time in zip(some_cameras(), (0.0, 1.0, 1.5, 4.0, 6.0), strict=True)]
    for key in keys:
        assert camera_at(keys, key.time) is key.camera
        for side in (-1e-9, 1e-9):
            assert same(camera_at(keys, key.time + side), key.camera, 1e-6)
    assert camera_at(keys, -1.0) is keys[0].camera and camera_at(keys, 9.0) is keys[-1].camera
    assert same(camera_at(keys[::-1], 2.2), camera_at(keys, 2.2))  # by their times, whatever their order


def test_between_keys_of_a_turntable_lie_its_own_cameras():
    target, up = np.array([1.0, -2.0, 0.5]), np.array([0.3, -0.5, 0.8])
    fine = turntable(target, 3.0, 25, 24, up=up, **LENS)
    keys = [CameraKey(fine[index % 24], index / 4, easing="linear") for index in range(0, 25, 4)]
    for index in range(24):
        assert same(camera_at(keys, index / 4), fine[index], 1e-9)
    smooth = [dataclasses.replace(key, easing="smooth") for key in keys]
    for time in np.linspace(0.1, 5.9, 17):
        camera = camera_at(smooth, time)
        np.testing.assert_allclose(np.linalg.norm(camera.center - target), 3.0)  # without cutting corners
        np.testing.assert_allclose(camera.project(target[None])[0], [[30, 20]], atol=1e-6)


def test_a_pan_keeps_its_eye_and_a_flight_its_way():
    eye = np.array([4.0, 5.0, 6.0])
    ahead = [axis_rotation([0, 0, 1.0], angle) @ [0.0, 1.0, -0.2] for angle in (0.0, 0.8, 1.6)]
    keys = timed_keys([CameraKey(Camera.look_at(eye, eye + each, **LENS)) for each in ahead])
    for time in np.linspace(0, 2, 9):
        np.testing.assert_allclose(camera_at(keys, time).center, eye, atol=1e-12)
    flight = [CameraKey(Camera.look_at((0, y, 1), (0, y + 1, 1), **LENS)) for y in (0.0, 1.0, 5.0)]
    places = np.array([camera.center for camera in path_cameras(flight, 21)])
    np.testing.assert_allclose(places[:, [0, 2]], [[0, 1]] * 21, atol=1e-9)
    assert (np.diff(places[:, 1]) >= -1e-12).all() and places[-1, 1] == 5.0


def test_the_way_is_smooth_and_holds_hold():
    cameras = some_cameras(4)
    keys = [CameraKey(cameras[index], time) for index, time in ((0, 0.0), (1, 1.0), (1, 2.0), (2, 3.0), (3, 3.5))]
    for time in np.linspace(1.0, 2.0, 7):
        assert same(camera_at(keys, time), cameras[1], 1e-12)
    step = 1e-4
    for time in (1.0, 2.0, 3.0):  # no jolt at a key: the velocities on both sides agree
        before, here, after = (camera_at(keys, time + side).camera_to_world for side in (-step, 0.0, step))
        np.testing.assert_allclose((here - before) / step, (after - here) / step, atol=5e-3)
    held = [dataclasses.replace(key, easing="hold") for key in keys]
    assert camera_at(held, 0.99) is not cameras[1] and same(camera_at(held, 0.99), cameras[0], 1e-12)


def test_a_curve_of_ones_own_is_the_straight_way_at_other_times(tmp_path):
    curve = {"bezier": [0.8, -0.2, 0.1, 1.2]}
    one, two = some_cameras(2)
    CameraFile([CameraKey(one, 0.0, easing=curve), CameraKey(two, 2.0)]).save(tmp_path / "path.json")
    curved = CameraFile.load(tmp_path / "path.json")
    assert curved[0].easing == curve
    straight = [dataclasses.replace(key, easing="linear") for key in curved]
    for share in (0.3, 0.55, 0.7):
        gone = eased_share(curve, share)
        assert abs(gone - share) > 0.1 and same(camera_at(curved, 2 * share), camera_at(straight, 2 * gone), 1e-9)


def test_paths_that_cannot_be():
    one, two = some_cameras(2)
    for keys, said in (
        ([], "at least one camera"),
        ([CameraKey(one, 1.0), CameraKey(two)], "1 of 2 cameras has no time"),
        ([CameraKey(one, 1.0), CameraKey(two, 1.0)], "two cameras of a path are at 1 s"),
        ([CameraKey(one, 1.0, "a"), CameraKey(two, 1.0, "b")], MESSAGES["view.path_same_time"]),
        ([CameraKey(one), CameraKey(two.resized(30, 20))], "one picture size"),
    ):
        with pytest.raises(ValueError, match=said):
            camera_at(keys, 0.5)
    refused(lambda: path_cameras([CameraKey(one)], 0), match="at least one camera")
    assert [key.time for key in timed_keys([CameraKey(one), CameraKey(two)], 8.0)] == [0.0, 8.0]
    opposite = [CameraKey(Camera.look_at((0, y, 0), (0, 0, 0), **LENS)) for y in (-2, 2)]
    middle = camera_at(timed_keys(opposite), 0.5)  # half a turn: around the target, not through it
    np.testing.assert_allclose(np.linalg.norm(middle.center), 2.0)
