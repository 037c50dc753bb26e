"""Workers of jobs: their pictures are those of `warpcage render`, and what items share is loaded once."""

import json

import numpy as np
import pytest
from cli_runs import run, write_files

from warpcage.batch.items import Item
from warpcage.batch.worker import PARTS, Worker
from warpcage.cage.cage import Cage
from warpcage.deform.deformer import Deformer
from warpcage.field.voxel_field import VoxelField
from warpcage.view.camera import Camera
from warpcage.view.camera_file import CameraFile
from warpcage.view.pictures import read_image

CAMERAS = [Camera.look_at((2.5, 1.2 * side, 1.0), (0, 0, 0), width=40, height=32) for side in (-1, 1)]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("batch"))
    CameraFile(CAMERAS).save(folder / "cameras.json")
    rest = Cage.load(folder / "cage.obj")
    np.save(folder / "poses.npy", np.stack([rest.bend(angle, axis="x", towards="z").vertices for angle in (0, 20, 40)]))
    return folder


def frame(name="frame_0001", **words):
    entry = {"id": name, "field": "ball.npz", "cage": "cage.obj", "posed": "poses.npy#1", "camera": "cameras.json#0"}
    return Item.from_json(entry | {"coordinates": "mean_value", "resolution": 24} | words)


def test_a_frame_is_that_of_warpcage_render_to_the_byte(files, tmp_path):
    outputs = {part: f"{part}.png" for part in ("rgb", "alpha", "depth", "disparity", "masks")}
    with Worker(files, tmp_path / "out", "cpu") as worker:
        sizes = worker.run(frame(posed="posed.obj", outputs=outputs))
    words = ["render", "@ball.npz", "--cage", "@cage.obj", "--posed", "@posed.obj", "--camera", "@cameras.json:0"]
    words += ["--coordinates", "mean_value", "--resolution", 24, "--device", "cpu", "-o", tmp_path / "rgb.png"]
    words += [word for part in list(outputs)[1:] for word in (f"--{part}", tmp_path / f"{part}.png")]
    assert run(files, *words) == 0
    for part, path in outputs.items():
        made = (tmp_path / "out" / path).read_bytes()
        assert made == (tmp_path / f"{part}.png").read_bytes() and sizes[path] == len(made)


def test_a_frame_is_that_of_a_deformer_to_the_bit(files, tmp_path, device):
    field = VoxelField.load(files / "ball.npz", device=device)
    rest = Cage.load(files / "cage.obj")
    deformer = Deformer(field, rest, coordinates="mean_value", resolution=24)
    poses = np.load(files / "poses.npy")
    with Worker(files, tmp_path, device) as worker:
        for row in (2, 1):
            worker.run(frame(posed=f"poses.npy#{row}", outputs={"rgb": "rgb.npy", "depth": "depth.npy"}))
            expected = deformer.pose(rest.with_vertices(poses[row])).render(CAMERAS[0])
            np.testing.assert_array_equal(np.load(tmp_path / "rgb.npy"), expected.rgb)
            np.testing.assert_array_equal(np.load(tmp_path / "depth.npy"), expected.depth)


def test_fields_cages_and_maps_are_kept(files, tmp_path):
    with Worker(files, tmp_path, "cpu") as worker:
        for number, (pose, camera) in enumerate([(1, 0), (1, 1), (2, 1), (2, 0), (1, 0)]):
            worker.run(frame(f"f{number}", posed=f"poses.npy#{pose}", camera=f"cameras.json#{camera}"))
        counts = worker.frames.counts
        assert (worker.fields.read_count, counts.deformers, counts.poses, counts.frames) == (1, 1, 3, 5)
        assert worker.frames.held_bytes > 0 and worker.fields.held_bytes > 0
    assert worker.held_bytes == 0
    np.testing.assert_array_equal(read_image(tmp_path / "f0.png"), read_image(tmp_path / "f4.png"))


def test_outputs_come_all_or_none(files, tmp_path, monkeypatch):
    def fail(path, array):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("warpcage.batch.frames.write_array", fail)
    with Worker(files, tmp_path, "cpu") as worker:
        with pytest.raises(OSError, match="No space left"):
            worker.run(frame(outputs={"rgb": "a/rgb.png", "depth": "a/depth.npy"}))
        assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
        assert list((tmp_path / PARTS).iterdir()) == []
        assert list(worker.run(frame())) == ["frame_0001.png"]


def test_an_inline_camera_and_cage_are_those_of_files(files, tmp_path):
    rest = Cage.load(files / "cage.obj")
    camera = json.loads((files / "cameras.json").read_text())["cameras"][0]
    np.save(files / "rest.npy", rest.vertices)
    inline = {
        "cage": {"vertices": "rest.npy", "faces": rest.faces.tolist()},
        "posed": np.load(files / "poses.npy")[1].tolist(),
        "camera": camera,
    }
    with Worker(files, tmp_path, "cpu") as worker:
        worker.run(frame("a"))
        worker.run(frame("b", **inline))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
