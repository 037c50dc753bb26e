"""Scenes as programs of phones write them come back: raw data of Polycam, captures of Record3D."""

import json

import numpy as np
import pytest
from messages import MESSAGES
from scene_writers import OPENGL, brick_pictures, write_image
from test_scene_formats import load, require_equal


@pytest.fixture(scope="module")
def bricks():
    return brick_pictures(10)


def write_json(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


#: What takes z up, as scenes of phones are read, to ARKit's world with y up.
TO_ARKIT = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize("corrected", [False, True])
def test_polycam(tmp_path, bricks, corrected):
    """The raw data of Polycam: a JSON file a picture; optimised ones are taken where they are there."""
    kinds = ("", "corrected_") if corrected else ("",)
    for kind in kinds:
        for name, rgba, camera in zip(bricks.names, bricks.rgba, bricks.cameras, strict=True):
            pose = TO_ARKIT @ camera.camera_to_world @ OPENGL
            pose[:3, 3] += 5.0 * (corrected and kind == "")  # the first guess of the phone
            content = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
            content |= {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "blur_score": 90.0}
            content |= {"width": camera.width, "height": camera.height, "neighbors": [], "timestamp": 1}
            write_json(tmp_path / f"keyframes/{kind}cameras/{name}.json", content)
            write_image(tmp_path / f"keyframes/{kind}images/{name}.png", rgba)
    require_equal(load(tmp_path, split="all"), bricks)
    np.testing.assert_allclose(load(tmp_path).to_source @ [0, 0, 1, 1], [0, 1, 0, 1], atol=1e-12)
    (tmp_path / f"keyframes/{kinds[-1]}cameras/{bricks.names[2]}.json").write_text('{"fx": 3}')
    with pytest.raises(ValueError, match=MESSAGES["scene.pose_number"]):
        load(tmp_path)


@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize("file, images", [("metadata", "rgbd"), ("metadata.json", "rgb")])
def test_record3d(tmp_path, bricks, file, images, each):
    from scipy.spatial.transform import Rotation

    first, poses = bricks.cameras[0], []
    for number, (rgba, camera) in enumerate(zip(bricks.rgba, bricks.cameras, strict=True)):
        pose = TO_ARKIT @ camera.camera_to_world @ OPENGL
        poses.append([*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]])
        write_image(tmp_path / images / f"{number}.png", rgba)
    content = {"w": first.width, "h": first.height, "fps": 60, "poses": poses}
    content["K"] = [first.fx, 0, 0, 0, first.fy, 0, first.cx, first.cy, 1]
    if each:
        content["perFrameIntrinsicCoeffs"] = [[c.fx, c.fy, c.cx, c.cy] for c in bricks.cameras]
        content["K"] = [1.0] * 9
    write_json(tmp_path / file, content)
    found = load(tmp_path, split="all", format="record3d")
    require_equal(found, bricks)
    content["poses"][1] = [0.0] * 6
    write_json(tmp_path / file, content)
    with pytest.raises(ValueError, match=r"poses\[1\] must hold 7 numbers"):
        load(tmp_path)
