"""Films as job files: the frames of their items are those of `warpcage animate`, to the bit."""

import json

import numpy as np
import pytest
from runs import DEFORMED, SMALL, run, succeed, write_files

from warpcage import Cage, PoseFile
from warpcage.deform import exact
from warpcage.studio.jobs import JobFile, Worker

FILM = ("--frames", 5, "--quiet", *SMALL)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("films"))
    rest = Cage.load(folder / "cage.obj")
    keys = PoseFile(rest, {"a": rest, "b": rest.bend(30, axis="x", towards="z"), "c": rest})
    keys.times, keys.fps = {"a": 0.0, "b": 0.3, "c": 0.5}, 10.0
    keys.save(folder / "keys.json")
    Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, -0.2)).save(folder / "low.obj")
    Cage.box((-0.7, -0.7, 0.1), (0.7, 0.7, 0.7), segments=2).save(folder / "high.obj")
    return folder


def frames_of(path, out):
    """Make all items of a job file. Returns their number."""
    with JobFile(path) as job, Worker(job.folder, out, "cpu") as worker:
        for item in job:
            worker.run(item)
        return len(job)


def same_frames(folder, out, kind="png"):
    there, made = ({path.name: path.read_bytes() for path in each.glob(f"*.{kind}")} for each in (folder, out))
    assert there == made and there
    return len(there)


FILMS = {
    "turn": [*FILM, "--background", "black"],
    "swing": [*FILM, *DEFORMED],
    "smooth": [*FILM, "--cage", "@cage.obj", "--posed", "@posed.obj", "twist:30:z", "--motion", "once"],
    "clear": [*FILM, *DEFORMED, "--transparent", "--overlay", "--turn", 0],
    "depth": [*FILM, *DEFORMED, "--show", "depth"],
    "masks": [*FILM, *DEFORMED, "--show", "masks"],
    "keys": ["--quiet", *SMALL, "--cage", "@cage.obj", "--posed", "@keys.json", "--background", "0.2,0.3,0.4"],
    "edits": [
        *FILM,
        *("--edit", "@high.obj:bend:30:x:y:falloff=0.1:keep"),
        *("--edit", "@low.obj:remove", "--overlay", "--density", "paper"),
    ],
    "shutter": [*FILM, *DEFORMED, "--shutter", "180:4", "--cameras", "follow", "--overlay"],
    "clear shutter": [*FILM, "--edit", "@high.obj:bend:30:x:y", "--edit", "@low.obj:remove", "--shutter", "360:3"]
    + ["--transparent"],
    "a camera's shutter": [*FILM, "--shutter", "90:2"],
    "light": [*FILM, *DEFORMED, "--format", "exr", "--transparent", "--shutter", "180:2"],
    "precise": ["--frames", 2, "--quiet", "--size", 12, *DEFORMED, "--coordinates", "green", "--resolution", "precise"],
}


@pytest.mark.parametrize("name", FILMS)
def test_frames_of_a_job_file_are_those_of_animate(files, tmp_path, capsys, monkeypatch, name):
    monkeypatch.setattr(exact, "GUIDE_RESOLUTION", 32)  # a finer guide takes most of the time
    argv = FILMS[name]
    assert run(files, "animate", "@ball.npz", *argv, "-o", tmp_path / "frames") == 0, capsys.readouterr().err
    succeed(files, "animate", "@ball.npz", *argv, "--jobs", tmp_path / "film.jsonl")
    said = capsys.readouterr().out.splitlines()[-1]
    count = frames_of(tmp_path / "film.jsonl", tmp_path / "out")
    assert said.startswith(f"wrote {tmp_path}/film.jsonl: {count} frames of ")
    assert said.endswith(f", made by: warpcage run {tmp_path}/film.jsonl -o frames")
    assert same_frames(tmp_path / "frames", tmp_path / "out", "exr" if "exr" in argv else "png") == count


def test_a_job_file_moves_with_what_lies_beside_it_and_writes_a_pose_once(files, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "ball.npz").write_bytes((files / "ball.npz").read_bytes())
    argv = ["animate", tmp_path / "a" / "ball.npz", *FILM, *DEFORMED, "--motion", "hold"]
    succeed(files, *argv, "--jobs", tmp_path / "a" / "film.jsonl")
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == [
        "ball.npz",
        "film.faces.npy",
        "film.jsonl",
        "film.poses.npy",
        "film.rest.npy",
    ]
    header, *items = map(json.loads, (tmp_path / "a" / "film.jsonl").read_text().splitlines())
    assert header["defaults"]["field"] == "ball.npz" and header["extra"] == {"film": {"frames": 5, "fps": "24"}}
    poses = np.load(tmp_path / "a" / "film.poses.npy")
    assert poses.shape == (1, *Cage.load(files / "cage.obj").vertices.shape)
    assert [item["posed"] for item in items] == ["film.poses.npy#0"] * 5
    (tmp_path / "a").rename(tmp_path / "b")
    assert frames_of(tmp_path / "b" / "film.jsonl", tmp_path / "out") == 5


def test_a_pose_that_cannot_be_leaves_the_job_file_of_before(files, tmp_path, capsys, monkeypatch):
    from warpcage.studio.films import MovingScene

    argv = ["animate", "@ball.npz", *FILM, *DEFORMED, "--jobs", tmp_path / "film.jsonl"]
    succeed(files, *argv)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    cages = MovingScene.cages

    def fails(self, index):
        if index == 3:
            raise ValueError("frame 3, between the poses: it is flat")
        return cages(self, index)

    monkeypatch.setattr(MovingScene, "cages", fails)
    assert run(files, *argv, "--frames", 7) == 2
    assert "frame 3, between the poses" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
