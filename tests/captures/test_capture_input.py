"""Input that no cameras can be found of ends in one line and leaves nothing; an interrupt leaves what is done."""

import re

import numpy as np
import pytest
from scenes import found_poses, render_table, save_pictures, table_pictures
from test_capture_video import moving_pictures, write_video

import warpcage
from warpcage import Camera
from warpcage.captures import expected_seconds, time_line

pycolmap = pytest.importorskip("pycolmap", minversion="4.2")


@pytest.fixture(scope="module")
def glances():
    """Sharp pictures of a short walk, and their cameras."""
    return table_pictures(np.linspace(0.0, 0.22, 6))


def refused(source, folder, error=ValueError):
    """The one line that a capture ends in; its folder is as it was."""
    before = sorted(folder.rglob("*"))
    with pytest.raises(error) as caught:
        warpcage.capture(source, folder / "new" / "scene", progress=False)
    assert sorted(folder.rglob("*")) == before
    line = str(caught.value)
    assert "\n" not in line and len(line) < 500
    return line


def test_nothing_there(tmp_path):
    assert "is not there" in refused(tmp_path / "none", tmp_path, FileNotFoundError)


def test_no_pictures(tmp_path):
    empty = tmp_path / "in"
    empty.mkdir()
    assert "holds no pictures (.jpg" in refused(empty, tmp_path, FileNotFoundError)
    (empty / "IMG_1.HEIC").write_bytes(b"x")
    assert "as .heic alone" in refused(empty, tmp_path, FileNotFoundError)


def test_pictures_one_folder_further_down(tmp_path, glances):
    save_pictures(tmp_path / "in" / "images", glances[0][:1])
    assert "give one of its folders images" in refused(tmp_path / "in", tmp_path, FileNotFoundError)


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_pictures(tmp_path, glances, count):
    line = refused(save_pictures(tmp_path / "in", glances[0][:count]), tmp_path)
    assert re.search(f"holds {count} pictures?: cameras are found of at least 3", line)


def test_a_video_that_does_not_move(tmp_path):
    video = write_video(tmp_path / "still.mp4", moving_pictures([0] * 8))
    assert "shows 1 different view: cameras are found where the view moves" in refused(video, tmp_path)


def test_pictures_without_texture(tmp_path):
    pictures = [np.full((150, 200, 3), 90 + 10 * k, np.uint8) for k in range(5)]
    assert "too little to hold on to, 0 features each" in refused(save_pictures(tmp_path / "in", pictures), tmp_path)


def test_pictures_that_share_nothing(tmp_path):
    """What a mirror shows is another thing from each place."""
    pictures = [moving_pictures([0], (150, 200), seed)[0] for seed in range(5)]
    assert "no two pictures" in refused(save_pictures(tmp_path / "in", pictures), tmp_path)


def test_pictures_from_one_place(tmp_path):
    """Views that are only turned hold no depth."""
    goals = [[x, 0.3 * x, 0.0] for x in np.linspace(-1.2, 1.2, 6)]
    cameras = [Camera.look_at([0, -4, 1.5], goal, fov_degrees=62, width=200, height=150) for goal in goals]
    line = refused(save_pictures(tmp_path / "in", render_table(cameras)), tmp_path)
    assert "from about one place" in line or "which is too few to go by" in line
    assert "walk around the object" in line


def test_pictures_of_two_scenes(tmp_path, glances):
    """The same walk in a mirrored world is another scene."""
    save_pictures(tmp_path / "in", glances[0])
    save_pictures(tmp_path / "in", [picture[:, ::-1] for picture in glances[0]], first=6)
    line = refused(tmp_path / "in", tmp_path)
    assert "groups that share nothing (6 with p000 and p005; 6 with p006 and p011)" in line


def test_a_few_pictures_of_something_else_are_left_out(tmp_path, glances):
    save_pictures(tmp_path / "in", glances[0])
    save_pictures(tmp_path / "in", moving_pictures([0, 50], (150, 200)), first=6)
    (tmp_path / "in" / "p008.png").write_bytes((tmp_path / "in" / "p000.png").read_bytes()[:5000])
    with pytest.warns(UserWarning) as said:
        report = warpcage.capture(tmp_path / "in", tmp_path / "out", progress=False)
    lines = [str(each.message) for each in said]
    assert any("1 of 9 pictures" in line and "cannot be read" in line and "p008.png" in line for line in lines)
    assert any("2 of 8 pictures have no camera and are left out (p006, p007)" in line for line in lines)
    assert report.left_out == ["p006", "p007"] and len(found_poses(tmp_path / "out")[0]) == 6
    assert "overlap too little" in (tmp_path / "out/capture.md").read_text()


def test_pictures_that_are_named_are_used(tmp_path, glances):
    """By a list with or without endings, or by a text file as Windows writes it; the rest is not looked at."""
    folder = save_pictures(tmp_path / "in", glances[0])
    (tmp_path / "names.txt").write_bytes("\ufeffp000.png\r\n\r\np002.png\r\np001\r\np003.png\r\n".encode())
    report = warpcage.capture(folder, tmp_path / "out", pictures=tmp_path / "names.txt", progress=False)
    assert report.pictures == ["p000", "p001", "p002", "p003"] and report.registered_count == 4
    assert report.facts["share_of_matches_that_agree"] > 0.9
    with pytest.raises(ValueError, match="holds 2 pictures"):
        warpcage.capture(folder, tmp_path / "b", pictures=["p001", "p004.png"], progress=False)


@pytest.mark.parametrize(
    ("pictures", "words"),
    [
        (["p000.png", "p009.png"], "holds no picture named p009.png: "),
        (b"names", "pictures must be a text file or a"),
        ([1, 2, 3], "pictures must be a text file or a"),
    ],
)
def test_names_of_pictures_that_are_not_there(tmp_path, pictures, words):
    folder = save_pictures(tmp_path / "in", [np.zeros((20, 30, 3), np.uint8)] * 3)
    with pytest.raises(ValueError, match=words):
        warpcage.capture(folder, tmp_path / "out", pictures=pictures, progress=False)
    assert [entry.name for entry in tmp_path.iterdir()] == ["in"]


def test_lists_of_pictures_that_cannot_be_read(tmp_path):
    folder = save_pictures(tmp_path / "in", [np.zeros((20, 30, 3), np.uint8)] * 3)
    with pytest.raises(FileNotFoundError, match="list of pictures"):
        warpcage.capture(folder, tmp_path / "out", pictures=tmp_path / "none.txt", progress=False)
    with pytest.raises(ValueError, match="is not text"):
        warpcage.capture(folder, tmp_path / "out", pictures=folder / "p000.png", progress=False)
    (tmp_path / "walk.mp4").write_bytes(b"")
    with pytest.raises(ValueError, match="is a video"):
        warpcage.capture(tmp_path / "walk.mp4", tmp_path / "out", pictures=["p000"], progress=False)


def test_no_picture_can_be_read(tmp_path):
    (tmp_path / "in").mkdir()
    for k in range(3):
        (tmp_path / "in" / f"{k}.jpg").write_bytes(b"\xff\xd8\xff broken")
    assert "none of the 3 pictures" in refused(tmp_path / "in", tmp_path)


def test_no_video(tmp_path):
    (tmp_path / "v.mp4").write_bytes(b"words")
    assert "cannot be read as a video" in refused(tmp_path / "v.mp4", tmp_path)


def test_output_that_is_there(tmp_path, glances):
    folder = save_pictures(tmp_path / "in", glances[0][:4])
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "dear.txt").write_text("kept")
    for output, word in (
        ("full", "there and not empty"),
        ("full/dear.txt", "is a file"),
        ("full/dear.txt/x", "not a folder"),
    ):
        with pytest.raises(ValueError, match=word):
            warpcage.capture(folder, tmp_path / output, progress=False)
    assert (tmp_path / "full" / "dear.txt").read_text() == "kept"


@pytest.mark.parametrize("options", [{"frames": 2}, {"feature_size": 10}, {"seed": -1}, {"frames": 10.5}])
def test_options_out_of_range(tmp_path, options):
    with pytest.raises(ValueError, match=f"^{next(iter(options))} must be a whole number"):
        warpcage.capture(tmp_path, tmp_path / "out", progress=False, **options)


def test_an_interrupted_capture_continues(tmp_path, glances, monkeypatch):
    """After an interrupt in the mapping the features are not looked for again. The output may be there, empty."""
    folder, output = save_pictures(tmp_path / "in", glances[0]), tmp_path / "out"
    output.mkdir()
    called = []
    from warpcage.captures import Solver

    find, mapped = Solver.find_features, Solver.map_globally
    monkeypatch.setattr(Solver, "map_globally", lambda self, folder: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        warpcage.capture(folder, output, progress=False)
    assert (tmp_path / ".out.capture" / "database.db").is_file() and not any(output.iterdir())
    monkeypatch.setattr(Solver, "map_globally", mapped)
    extract = pycolmap.extract_features
    monkeypatch.setattr(
        pycolmap, "extract_features", lambda *a, **o: (called.append(o["image_names"]), extract(*a, **o))
    )
    report = warpcage.capture(folder, output, progress=False)
    assert report.registered_count == 6 and called == [] and not (tmp_path / ".out.capture").exists()
    assert Solver.find_features is find
    warpcage.capture(folder, tmp_path / "fresh", progress=False)
    assert sum(map(len, called)) == 6
    assert (output / "transforms.json").read_bytes() == (tmp_path / "fresh/transforms.json").read_bytes()


def test_an_interrupt_ends_what_colmap_does(tmp_path, glances):
    """A signal is heard while COLMAP works, in its own thread."""
    import signal
    import threading

    folder = save_pictures(
        tmp_path / "in", [np.kron(p, np.ones((4, 4, 1), np.uint8)) for p in np.repeat(glances[0], 4, 0)]
    )
    timer = threading.Timer(0.8, signal.raise_signal, [signal.SIGINT])
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        warpcage.capture(folder, tmp_path / "out", progress=False, feature_size=800)
    timer.join()
    assert not (tmp_path / "out").exists()
    assert not any(thread.name == "colmap" for thread in threading.enumerate())


def test_an_interrupt_waits_for_what_cannot_be_cancelled():
    """What still ran when the process ended took it down with a stack of C++."""
    import signal
    import threading
    import time

    from warpcage.captures import Solver

    ended = []

    def work():
        time.sleep(0.6)
        ended.append(time.monotonic())

    timer = threading.Timer(0.25, signal.raise_signal, [signal.SIGINT])
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        Solver.run_in_thread(object.__new__(Solver), work)
    assert ended and ended[0] <= time.monotonic()
    timer.join()
    with pytest.raises(ZeroDivisionError):
        Solver.run_in_thread(object.__new__(Solver), lambda: 1 / 0)
    assert Solver.run_in_thread(object.__new__(Solver), lambda: 3) == 3


def test_other_pictures_begin_anew(tmp_path, glances):
    folder, work = save_pictures(tmp_path / "in", glances[0][:5]), tmp_path / ".out.capture"
    work.mkdir()
    (work / "job.json").write_text("{}")
    (work / "scene").mkdir()
    (work / "database.db").write_bytes(b"of something else")
    assert warpcage.capture(folder, tmp_path / "out", progress=False).registered_count == 5


def test_the_command(tmp_path, glances, capsys):
    from warpcage.cli import main

    folder = save_pictures(tmp_path / "in", glances[0])
    assert main(["capture", str(folder), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"wrote {tmp_path / 'out'}: cameras of 6 of 6 pictures") and said.err == ""
    assert main(["capture", str(folder), "-o", str(tmp_path / "out"), "--quiet"]) == 2
    assert capsys.readouterr().err.startswith("warpcage: error: output folder")


def test_the_time_is_said_before_the_matches(tmp_path, glances, capsys):
    folder = save_pictures(tmp_path / "in", glances[0][:4])
    warpcage.capture(folder, tmp_path / "out", progress=True)
    said = capsys.readouterr().err
    assert said.index("features:") < said.index("4 pictures, 6 pairs to match: about 1 minute") < said.index("matches:")


def test_how_long_a_capture_takes():
    """Every feature of a pair is compared with every one of the other: twice as many take up to four times as long."""
    pairs = [(0, 1), (1, 2)] * 1000
    once, twice, large = (expected_seconds(np.full(3, count), pairs, 2) for count in (0, 3000, 6000))
    assert 2 * (twice - once) < large - once < 4 * (twice - once)
    assert expected_seconds(np.full(3, 0), pairs, 4) == pytest.approx(once / 2) and expected_seconds([], [], 2) == 0
    assert time_line(292, 4500, 1000, 2).startswith("292 pictures, 4500 pairs to match: about 17 minutes on 2 cores; q")
    assert time_line(3, 3, 5, 1) == "3 pictures, 3 pairs to match: about 1 minute on 1 core"


@pytest.mark.parametrize("step", ["shrink", "matches", "cameras", "undistort"])
def test_a_capture_tells_how_far_it_is_and_ends_when_it_is_asked_to(tmp_path, glances, step, capfd):
    folder, output, told = save_pictures(tmp_path / "in", glances[0]), tmp_path / "out", []

    def progress(done, total, words):
        told.append(words)
        assert done >= 0 and (done <= total or total == 0)
        return words != step

    with pytest.raises(warpcage.Cancelled, match=f"{step} was cancelled"):
        warpcage.capture(folder, output, progress=progress)
    assert told[-1] == step and not output.exists() and (tmp_path / ".out.capture").is_dir()
    assert capfd.readouterr() == ("", "")
    steps = ["shrink", "features", "matches", "cameras", "undistort"]
    assert list(dict.fromkeys(told)) == steps[: steps.index(step) + 1]
    if step == "undistort":  # the same call goes on from there
        told.clear()
        report = warpcage.capture(folder, output, progress=lambda *values: told.append(values))
        assert report.registered_count == 6 and told[-1] == (6, 6, "undistort")


def test_what_is_no_progress_of_a_capture(tmp_path, glances):
    with pytest.raises(ValueError, match="progress must be True, False"):
        warpcage.capture(save_pictures(tmp_path / "in", glances[0]), tmp_path / "out", progress=5)
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
