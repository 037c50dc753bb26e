"""Camera paths of nerfstudio and SuperSplat, as their own files describe them."""

import json

import numpy as np
import pytest
from refusals import refused
from runs import succeed, write_files
from scipy.spatial.transform import Rotation
from splat_scenes import splats_in_box

from warpcage import Camera, CameraFile, VoxelField
from warpcage.view import read_image

POINTS = np.random.default_rng(5).uniform(-0.4, 0.4, (20, 3))


def nerfstudio_path(count=6, **options):
    """As its viewer writes them: cameras look along -z, y up; 16 numbers in rows; the height's field of view."""
    frames = []
    for index in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("zx", [20.0 * index, 60.0], degrees=True).as_matrix()
        pose[:3, 3] = pose[:3, :3] @ [0.0, 0.0, 3.0]
        frames.append({"camera_to_world": pose.ravel().tolist(), "fov": 40.0 + index, "aspect": 1.6})
    keys = [{"matrix": frames[0]["camera_to_world"], "fov": 40.0, "aspect": 1.6, "override_transition_enabled": False}]
    content = {"keyframes": keys, "camera_type": "perspective", "render_width": 64, "render_height": 40}
    return content | {"fps": 12, "seconds": count / 12, "is_cycle": True, "camera_path": frames} | options


def seen(right, up, ahead, focal, size):
    """Pixels of points of which these are the coordinates in a camera's frame."""
    return np.stack([size[0] / 2 + focal * right / ahead, size[1] / 2 - focal * up / ahead], axis=1)


def test_nerfstudio_frames_are_where_its_renderer_has_them(tmp_path):
    content = nerfstudio_path()
    (tmp_path / "camera_path.json").write_text(json.dumps(content))
    file = CameraFile.load(tmp_path / "camera_path.json")
    assert (file.fps, file.loop, len(file)) == (12.0, "loop", 6)
    for index, (key, frame) in enumerate(zip(file, content["camera_path"], strict=True)):
        pose = np.reshape(frame["camera_to_world"], (4, 4))
        right, up, back = ((POINTS - pose[:3, 3]) @ pose[:3, :3]).T
        focal = 20.0 / np.tan(np.radians(0.5 * frame["fov"]))
        np.testing.assert_allclose(key.camera.project(POINTS)[0], seen(right, up, -back, focal, (64, 40)), atol=1e-9)
        assert key.time == pytest.approx(index / 12) and key.easing == "linear"
    assert Camera.load(tmp_path / "camera_path.json", "4").fy == pytest.approx(20.0 / np.tan(np.radians(22.0)))


#: Where SuperSplat shows points of a .ply: half a turn about z, with y up.
SHOWN = POINTS * [-1.0, -1.0, 1.0]
EYES, TARGETS, FOVS = [[2.0, 1.0, 0.5], [0.3, 1.5, -2.0]], [[0.0, 0.1, 0.0], [0.1, 0.0, 0.2]], [50.0, 70.0]


def settings(frames, **keys):
    """settings.json of its viewer; frames: times of the two keys."""
    values = {"position": np.ravel(EYES).tolist(), "target": np.ravel(TARGETS).tolist(), "fov": FOVS}
    track = {"name": "fly", "duration": 3, "frameRate": 20, "loopMode": "pingpong", "interpolation": "spline"}
    track |= {"smoothness": 1} | keys
    return {"version": 2, "cameras": [], "animTracks": [track | {"keyframes": {"times": frames, "values": values}}]}


def project(frames):
    """document.json of its editor."""
    rows = zip(frames, EYES, TARGETS, FOVS, strict=True)
    poses = [{"name": f"camera_{f}", "frame": f, "position": p, "target": t, "fov": v} for f, p, t, v in rows]
    timeline = {"frames": 180, "frameRate": 20, "frame": 0, "smoothness": 1}
    return {"version": 0, "camera": {"fov": 65}, "poseSets": [{"name": "set0", "poses": poses}], "timeline": timeline}


@pytest.mark.parametrize("content, loop", [(settings([0, 30]), "ping-pong"), (project([0, 30]), None)])
@pytest.mark.parametrize("size", [None, (60, 80)])
def test_supersplat_keys_are_where_it_shows_them(tmp_path, content, loop, size):
    (tmp_path / "path.json").write_text(json.dumps(content))
    file = CameraFile.load(tmp_path / "path.json", size=size)
    assert (file.fps, file.loop, [key.time for key in file]) == (20.0, loop, [0.0, 1.5])
    width, height = size or (400, 225)
    for key, eye, target, fov in zip(file, EYES, TARGETS, FOVS, strict=True):
        back = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
        right = np.cross([0.0, 1.0, 0.0], back) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], back))
        x, y, z = ((SHOWN - eye) @ np.stack([right, np.cross(back, right), back], axis=1)).T
        focal = 0.5 * max(width, height) / np.tan(np.radians(0.5 * fov))
        np.testing.assert_allclose(key.camera.project(POINTS)[0], seen(x, y, -z, focal, (width, height)), atol=1e-9)
        np.testing.assert_allclose(key.target, np.multiply(target, [-1, -1, 1]))


def test_older_files_say_less(tmp_path):
    """The viewer takes 85 degrees, times in seconds and no smoothness where they are not said (its migration of v1)."""
    older = settings([0, 1.5], interpolation="step")
    track = older["animTracks"][0]
    del older["cameras"], older["version"], track["keyframes"]["values"]["fov"], track["frameRate"], track["smoothness"]
    for camera, easing, fov in (({"fov": 80}, "hold", 80), ({}, "linear", 85)):
        (tmp_path / "path.json").write_text(json.dumps(older | {"camera": camera}))
        keys = CameraFile.load(tmp_path / "path.json")
        assert [(key.time, key.easing) for key in keys] == [(0.0, easing), (1.5, easing)] and keys.fps == 30.0
        assert keys[1].camera.fx == pytest.approx(200 / np.tan(np.radians(fov / 2)))
        track["interpolation"] = "spline"


def test_a_viewer_without_a_track_has_one_camera(tmp_path):
    still = {"position": EYES[0], "target": TARGETS[0], "fov": 50.0}
    for content in ({"camera": still}, {"version": 2, "cameras": [{"initial": still}]}):
        (tmp_path / "settings.json").write_text(json.dumps(content | {"animTracks": []}))
        camera = Camera.load(tmp_path / "settings.json")
        np.testing.assert_allclose(camera.center, np.multiply(EYES[0], [-1, -1, 1]))
        assert camera.fx == pytest.approx(200 / np.tan(np.radians(25)))


WRONG = {
    "its camera_type 'fisheye' is not read": nerfstudio_path(camera_type="fisheye"),
    "its camera_path must be a list": nerfstudio_path(1, camera_path=[]),
    "fov of frame 0 must lie between 0": nerfstudio_path(1)
    | {"camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 180}]},
    "frame 0 must be 16 finite numbers": nerfstudio_path(1) | {"camera_path": [{"camera_to_world": [1]}]},
    "it lacks 'render_width'": {"camera_path": [{}], "render_height": 3},
    "its animTracks must be a list": {"animTracks": []},
    "a camera stands where it looks": {"poseSets": [{"poses": [{"position": [1, 2, 3], "target": [1, 2, 3]}]}]},
    "its cameras must be a list": [],
    "rotation of a camera must be 9": [{"width": 2, "height": 2, "rotation": [[1]]}],
}


@pytest.mark.parametrize("said", WRONG)
def test_what_cannot_be_read_is_said(tmp_path, said):
    (tmp_path / "path.json").write_text(json.dumps(WRONG[said]))
    refused(lambda: CameraFile.load(tmp_path / "path.json"), "path.json", match=said)


def test_commands_take_paths_of_nerfstudio(tmp_path, capsys):
    """Each frame of the film is what its own camera sees."""
    write_files(tmp_path)
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(nerfstudio_path(3)))
    field = VoxelField.load(tmp_path / "ball.npz", device="cpu")
    succeed(tmp_path, "animate", "@ball.npz", "--cameras", "@camera_path.json", "-o", "@film", "--frames", "3")
    succeed(tmp_path, "render", "@ball.npz", "--camera", "@camera_path.json:2", "-o", "@one.png")
    wanted = field.render(Camera.load(path, "2")).rgb
    for name in ("one.png", "film/frame_0002.png"):
        np.testing.assert_allclose(read_image(tmp_path / name)[..., :3], np.asarray(wanted), atol=1.1 / 255)
    succeed(tmp_path, "info", "@camera_path.json")
    said = capsys.readouterr().out
    assert "cameras of nerfstudio" in said and "64x40 from" in said


def test_nerfstudio_paths_go_along_with_splats_out_of_its_frame(tmp_path):
    """Splats and path in its frame, and both taken out of it, give the same picture."""
    splats_in_box("cpu", count=200, scales=(-3.0, -2.5), degree=1).save(tmp_path / "splats.ply")
    turn = Rotation.from_euler("xyz", [0.4, -0.3, 1.0]).as_matrix()
    rows = np.column_stack([turn, [0.5, -0.2, 0.1]]).tolist()
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": rows, "scale": 0.25}))
    (tmp_path / "camera_path.json").write_text(json.dumps(nerfstudio_path()))
    for name, arguments in (("inside", ()), ("out", ("--frame", "@dataparser_transforms.json"))):
        succeed(tmp_path, "render", "@splats.ply", "--camera", "@camera_path.json:2", "-o", f"@{name}.png", *arguments)
    pictures = [read_image(tmp_path / f"{name}.png") for name in ("inside", "out")]
    assert pictures[0].std() > 0.05
    np.testing.assert_allclose(*pictures, atol=1.1 / 255)
