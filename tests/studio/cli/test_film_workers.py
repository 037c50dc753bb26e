"""`warpcage animate --workers`: films and folders of one process, to the bit, and runs that go on where they ended."""

import pathlib
import re
import threading

import numpy as np
import pytest
from messages import MESSAGES
from runs import DEFORMED, SMALL, require_same_film, run, succeed

import warpcage.studio.jobs.films as films
from warpcage.studio.films.render import Look
from warpcage.studio.films.video import deep_pixels, read_film_frame, write_film_frame
from warpcage.view import write_png

FILM = ("animate", "@ball.npz", *DEFORMED, *SMALL, "--size", 64, "--frames", 6, "--quiet", "--device", "cpu")


@pytest.fixture
def rendered(monkeypatch):
    """Counts frames."""
    render, count = Look.render, []

    def counted(self, *argv, **options):
        count.append(1)
        return render(self, *argv, **options)

    monkeypatch.setattr(Look, "render", counted)
    return count


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("name", "argv"),
    [
        ("a.mp4", ["--overlay"]),
        ("a.gif", ["--show", "depth"]),
        ("a.mov", ["--transparent", "--overlay"]),
        ("a.webm", ["--shutter", "180:2"]),
        ("b.mp4", ["--show", "alpha"]),
    ],
)
def test_films_of_workers_are_those_of_one_process(files, tmp_path, capsys, name, argv):
    for folder, more in (("one", []), ("workers", ["--workers", 1])):
        (tmp_path / folder).mkdir()
        succeed(files, *FILM, "-o", tmp_path / folder / name, *argv, *more)
    assert names(tmp_path / "workers") == [name]
    paths = [tmp_path / folder / name for folder in ("one", "workers")]
    if name.endswith("webm"):
        one, two = (np.fromfile(path, np.uint8) for path in paths)
        assert one.shape == two.shape and (one != two).sum() <= 16  # its track has a random number, twice
    else:
        require_same_film(*paths)
    said = capsys.readouterr().out.replace("workers", "one").splitlines()
    assert said[0] == said[1]


def test_two_workers_make_the_film_of_one_process(files, tmp_path, capsys):
    succeed(files, *FILM, "-o", tmp_path / "one.mp4")
    assert "workers" not in capsys.readouterr().err
    succeed(files, *FILM, "-o", tmp_path / "two.mp4", "--workers", 2)
    assert capsys.readouterr().err.count(": fewer workers ") == 1  # it is short
    require_same_film(tmp_path / "one.mp4", tmp_path / "two.mp4")
    assert names(tmp_path) == ["one.mp4", "two.mp4"]


@pytest.mark.parametrize("kind", ["png", "exr"])
def test_a_folder_goes_on_with_workers_and_without(files, tmp_path, rendered, kind):
    if kind == "exr":
        pytest.importorskip("OpenEXR")
    argv = [*FILM, "--format", kind, "-o"]
    succeed(files, *argv, tmp_path / "one")
    succeed(files, *argv, tmp_path / "mixed")
    paths = sorted((tmp_path / "mixed").glob(f"*.{kind}"))
    stamps = {path: path.stat().st_mtime_ns for path in paths[:3]}
    paths[3].write_bytes(b"cut")
    paths[4].unlink()
    paths[5].write_bytes(bytes(paths[5].stat().st_size))
    rendered.clear()
    succeed(files, *argv, tmp_path / "mixed", "--workers", 1)
    assert len(rendered) == 3 and {path: path.stat().st_mtime_ns for path in stamps} == stamps
    assert names(tmp_path / "one") == names(tmp_path / "mixed")
    if kind == "png":
        for path in (tmp_path / "one").iterdir():
            assert path.read_bytes() == (tmp_path / "mixed" / path.name).read_bytes()
    paths[0].unlink()
    rendered.clear()
    succeed(files, *argv, tmp_path / "mixed")  # and back
    assert len(rendered) == 1
    assert run(files, *argv, tmp_path / "mixed", "--workers", 1, "--turn", 90) == 2  # another film
    succeed(files, *argv, tmp_path / "mixed", "--workers", 1, "--turn", 90, "--overwrite")


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt(), 130), (RuntimeError("the device is lost"), 2)])
def test_a_film_goes_on_after_its_end(files, tmp_path, capsys, monkeypatch, rendered, error, status):
    run_jobs = films.run_jobs

    def ends(*argv, progress, **options):
        def show(state):
            progress(state)
            if state.done:  # the first lot is one frame, the next may be all others
                raise error

        return run_jobs(*argv, progress=show, **options)

    with monkeypatch.context() as patch:
        patch.setattr(films, "run_jobs", ends)
        assert run(files, *FILM, "-o", tmp_path / "film.mp4", "--workers", 1) == status
    said = capsys.readouterr().err
    made = len(list((tmp_path / ".film.mp4.frames").glob("frame_*.png")))
    kept = f"{made} frame{'s' * (made > 1)} kept in {tmp_path}/.film.mp4.frames"
    assert 1 <= made < 6 and f"warpcage: {kept}: run it again to go on" in said
    assert names(tmp_path) == [".film.mp4.frames"]
    rendered.clear()
    succeed(files, *FILM, "-o", tmp_path / "film.mp4", "--workers", 1)
    assert len(rendered) == 6 - made
    succeed(files, *FILM, "-o", tmp_path / "one.mp4")
    require_same_film(tmp_path / "film.mp4", tmp_path / "one.mp4")
    assert names(tmp_path) == ["film.mp4", "one.mp4"]


def test_a_frame_that_comes_while_it_is_looked_for_is_read(tmp_path, monkeypatch):
    late, place = tmp_path / "late.png", tmp_path / "frame_0000.png"
    write_png(late, np.zeros((4, 4, 3)))
    read = films.read_film_frame

    def comes_afterwards(path):
        """As if another process had put the frame there just after it was looked for."""
        try:
            return read(path)
        finally:
            if late.exists():
                late.rename(place)

    monkeypatch.setattr(films, "read_film_frame", comes_afterwards)
    monkeypatch.setattr(films, "LOOK_SECONDS", 0.01)
    exists = pathlib.Path.exists

    def seen(path):
        found = exists(path)
        if path == place and exists(late):
            late.rename(place)
        return found

    monkeypatch.setattr(pathlib.Path, "exists", seen)
    assert films.coming_frame([place], threading.Event()).shape[:2] == (4, 4)


def test_frames_of_another_film_are_not_taken(files, tmp_path, rendered):
    frames = tmp_path / ".film.mp4.frames"
    succeed(files, *FILM, "-o", tmp_path / "frames", "--turn", 90)
    (tmp_path / "frames").rename(frames)
    rendered.clear()
    succeed(files, *FILM, "-o", tmp_path / "film.mp4", "--workers", 1)
    assert len(rendered) == 6 and not frames.exists()


def test_a_frame_that_cannot_be_made_is_named_and_the_others_are_kept(files, tmp_path, capsys, monkeypatch):
    render, count = Look.render, []

    def fails(self, *argv, **options):
        count.append(1)
        if len(count) == 4:
            raise ValueError("its camera stands in a wall")
        return render(self, *argv, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Look, "render", fails)
        assert run(files, *FILM, "-o", tmp_path / "film.mp4", "--workers", 1) == 2
    said = capsys.readouterr().err.splitlines()
    assert said[-2].startswith("warpcage: 5 frames kept in ")
    assert said[-1].startswith("warpcage: error: frame_000") and said[-1].endswith(": its camera stands in a wall")
    succeed(files, *FILM, "-o", tmp_path / "film.mp4", "--workers", 1)


def test_a_film_that_cannot_be_written_ends_the_workers(files, tmp_path, capsys, monkeypatch, rendered):
    def full(frame):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("warpcage.studio.films.video.even_frame", full)
    assert run(files, *FILM, "-o", tmp_path / "film.mp4", "--workers", 1) == 2
    assert re.fullmatch(MESSAGES["core.no_space"], capsys.readouterr().err.splitlines()[-1])
    assert names(tmp_path) == [".film.mp4.frames"]  # what was made is kept


def test_frames_of_16_bits_come_back(tmp_path):
    picture = np.random.default_rng(1).random((5, 7, 4), np.float32)
    picture[:, :3, 3] = 0.0
    write_film_frame(tmp_path / "a.npz", picture)
    back = read_film_frame(tmp_path / "a.npz")
    np.testing.assert_array_equal(back, deep_pixels(picture))
    assert deep_pixels(back) is back
    np.savez(tmp_path / "b.npz", pixels=np.zeros((2, 2, 3)))
    with pytest.raises(ValueError, match="uint16"):
        read_film_frame(tmp_path / "b.npz")
