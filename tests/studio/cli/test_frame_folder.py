"""Folders of frames: what a run that failed leaves, and what stands in the way of another film."""

import json

import pytest
from runs import SMALL, run, succeed

from warpcage.studio.films.render import Look

FILM = ("--frames", 3, "--quiet", "--turn", 0, *SMALL)
CAGES = ("--cage", "@cage.obj", "--posed")


def listing(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize("wrong", [[*CAGES, "@text.txt"], ["--background", "2,2,2"], ["--show", "masks"]])
def test_a_run_that_made_no_frame_leaves_nothing(files, tmp_path, capsys, wrong):
    folder = tmp_path / "new" / "frames"
    argv = ["animate", "@ball.npz", "-o", folder, *FILM]
    assert run(files, *argv, *wrong) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert listing(tmp_path) == []
    succeed(files, *argv)
    assert len(list(folder.glob("*.png"))) == 3


def test_a_film_that_fails_at_its_first_frame_leaves_the_folder_as_it_was(files, tmp_path, capsys, monkeypatch):
    folder = tmp_path / "frames"
    folder.mkdir()
    (folder / "mine.txt").write_text("mine")

    def fail(self, *_, **__):
        raise MemoryError("too little of it")

    argv = ["animate", "@ball.npz", "-o", folder, *FILM, *CAGES, "@posed.obj"]
    with monkeypatch.context() as patch:
        patch.setattr(Look, "render", fail)
        assert run(files, *argv) == 2
    assert listing(folder) == ["mine.txt"]
    monkeypatch.setattr("warpcage.studio.films.render.write_picture", fail)  # rendered, but not written
    assert run(files, *argv) == 2
    assert listing(folder) == ["mine.txt"]


def test_a_note_without_frames_does_not_bind(files, tmp_path):
    folder = tmp_path / "frames"
    argv = ["animate", "@ball.npz", "-o", folder, *FILM]
    succeed(files, *argv)
    for frame in folder.glob("*.png"):
        frame.unlink()
    succeed(files, *argv, "--background", "black")  # another film
    assert json.loads((folder / "animation.json").read_text())["background"] == "black"


def test_frames_of_another_film_are_named_and_replaced_when_asked(files, tmp_path, capsys):
    folder = tmp_path / "frames"
    argv = ["animate", "@ball.npz", "-o", folder, *FILM]
    succeed(files, *argv)
    (folder / "mine.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    other = [*argv, "--frames", 2, "--background", "black"]
    assert run(files, *other) == 2
    said = capsys.readouterr().err
    assert "frames: 3 there, 2 now" in said and "background: default there, black now" in said
    assert "give another folder, or --overwrite" in said and said.count("\n") == 1
    assert run(files, *other, "--overwrite", *CAGES, "@text.txt") == 2  # nothing is lost where the new film fails
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before

    succeed(files, *other, "--overwrite")
    assert listing(folder) == ["animation.json", "frame_0000.png", "frame_0001.png", "mine.txt"]
    assert (folder / "frame_0000.png").read_bytes() != before["frame_0000.png"]
    stamps = [path.stat().st_mtime_ns for path in sorted(folder.glob("*.png"))]
    succeed(files, *other, "--overwrite")  # the same film: what is there stays
    assert [path.stat().st_mtime_ns for path in sorted(folder.glob("*.png"))] == stamps


@pytest.mark.parametrize("content", ["no JSON", "[1]", '{"frames": 3}', json.dumps({"name": "a film of mine"})])
def test_a_file_of_the_notes_name_that_is_none_is_kept(files, tmp_path, capsys, content):
    (tmp_path / "animation.json").write_text(content)
    assert run(files, "animate", "@ball.npz", "-o", tmp_path, *FILM, "--overwrite") == 2
    assert "not a list of frames that warpcage wrote" in capsys.readouterr().err
    assert listing(tmp_path) == ["animation.json"] and (tmp_path / "animation.json").read_text() == content
