"""Input that no cameras can be found of ends in one line and leaves nothing; an interrupt leaves what is done."""

import signal
import threading

import numpy as np
import pytest
from scenes import found_poses, render_table, save_pictures
from test_capture_video import moving_pictures, write_video

import warpcage
from warpcage import Camera
from warpcage.studio.captures import Solver, expected_seconds, time_line
from warpcage.studio.cli import main

pycolmap = pytest.importorskip("pycolmap", minversion="4.2")


@pytest.fixture(scope="module")
def small_shots(shots):
    """Pictures of a short walk."""
    return shots[0][:6]


BLACK = np.zeros((20, 30, 3), np.uint8)


def broken_pictures(folder):
    folder.mkdir()
    for k in range(3):
        (folder / f"{k}.jpg").write_bytes(b"\xff\xd8\xff broken")


def heic_alone(folder):
    folder.mkdir()
    (folder / "IMG_1.HEIC").write_bytes(b"x")


def still_video(source):
    write_video(source.with_suffix(".mp4"), moving_pictures([0] * 8)).rename(source)


def views_that_are_only_turned(folder):
    """They hold no depth."""
    goals = [[x, 0.3 * x, 0.0] for x in np.linspace(-1.2, 1.2, 6)]
    cameras = [Camera.look_at([0, -4, 1.5], goal, fov_degrees=62, width=200, height=150) for goal in goals]
    save_pictures(folder, render_table(cameras))


def refused(source, folder, message, error=ValueError):
    """One line is said; the folder is as it was."""
    before = sorted(folder.rglob("*"))
    with pytest.raises(error, match=message) as caught:
        warpcage.capture(source, folder / "new" / "scene", progress=False)
    assert sorted(folder.rglob("*")) == before
    line = str(caught.value)
    assert "\n" not in line and len(line) < 500


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda source: None, "is not there"),
        (lambda source: source.mkdir(), r"holds no pictures \(.jpg"),
        (heic_alone, "as .heic alone"),
        (lambda source: save_pictures(source / "images", [BLACK]), "give one of its folders images"),
    ],
)
def test_no_pictures(tmp_path, make, message):
    make(tmp_path / "in")
    refused(tmp_path / "in", tmp_path, message, FileNotFoundError)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda source: save_pictures(source, [BLACK]), "holds 1 picture: cameras are found of at least 3"),
        (lambda source: save_pictures(source, [BLACK] * 2), "holds 2 pictures: cameras are found of at least 3"),
        (broken_pictures, "none of the 3 pictures"),
        (lambda source: source.write_bytes(b"text"), "cannot be read as a video, this looks like another kind of"),
        (still_video, "shows 1 different view: cameras are found where the view moves"),
        (
            lambda source: save_pictures(source, [np.full((150, 200, 3), 90 + 10 * k, np.uint8) for k in range(5)]),
            "too little detail to match, 0 features each",
        ),
        (  # what a mirror shows is another object from each place
            lambda source: save_pictures(source, [moving_pictures([0], (150, 200), k)[0] for k in range(4)]),
            "no two pictures",
        ),
        (views_that_are_only_turned, "(from about one place|which is too few to go by).*walk around the object"),
    ],
)
def test_what_has_no_cameras(tmp_path, make, message):
    make(tmp_path / "in")
    refused(tmp_path / "in", tmp_path, message)


def test_pictures_of_two_scenes(tmp_path, small_shots):
    """The same walk in a mirrored world is another scene."""
    save_pictures(tmp_path / "in", [*small_shots[:4], *small_shots[:4, :, ::-1]])
    refused(tmp_path / "in", tmp_path, r"groups that share nothing \(4 with p000 and p003; 4 with p004 and p007\)")


def test_a_few_pictures_of_something_else_are_left_out(tmp_path, small_shots):
    save_pictures(tmp_path / "in", small_shots)
    save_pictures(tmp_path / "in", moving_pictures([0, 50], (150, 200)), first=6)
    (tmp_path / "in" / "p008.png").write_bytes((tmp_path / "in" / "p000.png").read_bytes()[:5000])
    with pytest.warns(UserWarning) as said:
        report = warpcage.capture(tmp_path / "in", tmp_path / "out", progress=False)
    lines = [str(each.message) for each in said]
    assert any("1 of 9 pictures" in line and "cannot be read" in line and "p008.png" in line for line in lines)
    assert any("2 of 8 pictures have no camera and are left out (p006, p007)" in line for line in lines)
    assert report.left_out == ["p006", "p007"] and len(found_poses(tmp_path / "out")[0]) == 6
    assert "overlap too little" in (tmp_path / "out/capture.md").read_text()


def test_pictures_that_are_named_are_used(tmp_path, small_shots, capsys):
    """By a list with or without endings, or by a text file as Windows writes it; the rest is not looked at. How long it
    takes is said before the matches."""
    folder = save_pictures(tmp_path / "in", small_shots)
    (tmp_path / "names.txt").write_bytes("\ufeffp000.png\r\n\r\np002.png\r\np001\r\np003.png\r\n".encode())
    report = warpcage.capture(folder, tmp_path / "out", pictures=tmp_path / "names.txt", progress=True)
    assert report.pictures == ["p000", "p001", "p002", "p003"] and report.registered_count == 4
    assert report.facts["share_of_matches_that_agree"] > 0.9
    said = capsys.readouterr().err
    assert said.index("features:") < said.index("4 pictures, 6 pairs to match: about 1 minute") < said.index("matches:")
    with pytest.raises(ValueError, match="holds 2 pictures"):
        warpcage.capture(folder, tmp_path / "b", pictures=["p001", "p004.png"], progress=False)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pictures": ["p000.png", "p009.png"]}, "holds no picture named p009.png: "),
        ({"pictures": b"names"}, "pictures must be a text file or a"),
        ({"pictures": [1, 2, 3]}, "pictures must be a text file or a"),
        ({"pictures": "none.txt"}, "list of pictures"),
        ({"pictures": "in/p000.png"}, "is not text"),
        ({"path": "walk.mp4", "pictures": ["p000"]}, "is a video"),
        ({"path": "in/p000.png"}, "is one picture: give a folder"),
        ({"output": "full"}, "there and not empty"),
        ({"output": "full/kept.txt"}, "is a file"),
        ({"output": "full/kept.txt/x"}, "not a folder"),
        ({"frames": 2}, "^frames must be a whole number"),
        ({"frames": 10.5}, "^frames must be a whole number"),
        ({"feature_size": 10}, "^feature_size must be a whole number"),
        ({"seed": -1}, "^seed must be a whole number"),
        ({"progress": 5}, "progress must be True, False"),
    ],
)
def test_options_that_are_refused(tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    save_pictures(tmp_path / "in", [BLACK] * 3)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "kept.txt").write_text("kept")
    (tmp_path / "walk.mp4").write_bytes(b"")
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        warpcage.capture(**({"path": "in", "output": "out", "progress": False} | options))
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["full", "in", "walk.mp4"]
    assert (tmp_path / "full" / "kept.txt").read_text() == "kept"


def test_an_interrupted_capture_continues(tmp_path, small_shots, monkeypatch, capsys):
    """After an interrupt in the mapping the features are not looked for again, and the cameras are those of a capture
    that went through, to the bit. The output may be there, empty, and beside it what is left of other pictures."""
    folder, output = save_pictures(tmp_path / "in", small_shots), tmp_path / "out"
    output.mkdir()
    called = []
    with monkeypatch.context() as interrupted:
        interrupted.setattr(Solver, "map_globally", lambda self, folder: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            warpcage.capture(folder, output, progress=False)
    assert (tmp_path / ".out.capture" / "database.db").is_file() and not any(output.iterdir())
    extract = pycolmap.extract_features

    def counted(*arguments, **options):
        called.extend(options["image_names"])
        return extract(*arguments, **options)

    monkeypatch.setattr(pycolmap, "extract_features", counted)
    report = warpcage.capture(folder, output, progress=False)
    assert report.registered_count == 6 and called == [] and not (tmp_path / ".out.capture").exists()

    work = tmp_path / ".fresh.capture"
    (work / "scene").mkdir(parents=True)
    (work / "job.json").write_text("{}")
    (work / "database.db").write_bytes(b"of something else")
    command = ["capture", str(folder), "-o", str(tmp_path / "fresh"), "--quiet"]
    assert main(command) == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"wrote {tmp_path / 'fresh'}: cameras of 6 of 6 pictures") and said.err == ""
    assert len(called) == 6
    for name in ("transforms.json", "points.ply"):
        assert (output / name).read_bytes() == (tmp_path / "fresh" / name).read_bytes()
    assert main(command) == 2 and capsys.readouterr().err.startswith("warpcage: error: output folder")


def test_an_interrupt_ends_what_colmap_does(tmp_path, small_shots, monkeypatch):
    """A signal is handled while COLMAP works, in its own thread."""
    folder, ended = save_pictures(tmp_path / "in", [np.kron(p, np.ones((2, 2, 1), np.uint8)) for p in small_shots]), []
    extract = pycolmap.extract_features

    def interrupted(*arguments, **options):
        signal.raise_signal(signal.SIGINT)
        try:
            extract(*arguments, **options)
        finally:
            ended.append(options["cancellation_token"].is_cancelled)

    monkeypatch.setattr(pycolmap, "extract_features", interrupted)
    with pytest.raises(KeyboardInterrupt):
        warpcage.capture(folder, tmp_path / "out", progress=False, feature_size=400)
    assert ended == [True] and not (tmp_path / "out").exists()
    assert not any(thread.name == "colmap" for thread in threading.enumerate())


def test_an_interrupt_waits_for_what_cannot_be_cancelled():
    """What still ran when the process ended took it down with a stack of C++."""
    cancelled, left, early = threading.Event(), threading.Event(), []
    solver = object.__new__(Solver)

    def work():
        signal.raise_signal(signal.SIGINT)
        cancelled.wait(60)
        early.append(left.wait(0.3))

    with pytest.raises(KeyboardInterrupt):
        solver.run_in_thread(work, cancel=cancelled.set)
    left.set()
    assert cancelled.is_set() and early == [False]
    with pytest.raises(ZeroDivisionError):
        solver.run_in_thread(lambda: 1 / 0)
    assert solver.run_in_thread(lambda: 3) == 3


def test_how_long_a_capture_takes():
    """Every feature of a pair is compared with every one of the other: twice as many take up to four times as long."""
    pairs = [(0, 1), (1, 2)] * 1000
    once, twice, large = (expected_seconds(np.full(3, count), pairs, 2) for count in (0, 3000, 6000))
    assert 2 * (twice - once) < large - once < 4 * (twice - once)
    assert expected_seconds(np.full(3, 0), pairs, 4) == pytest.approx(once / 2) and expected_seconds([], [], 2) == 0
    assert time_line(292, 4500, 1000, 2).startswith("292 pictures, 4500 pairs to match: about 17 minutes on 2 cores; q")
    assert time_line(3, 3, 5, 1) == "3 pictures, 3 pairs to match: about 1 minute on 1 core"


def test_a_capture_tells_how_far_it_is_and_ends_when_it_is_asked_to(tmp_path, small_shots, capfd):
    """The same call goes on from there."""
    folder, output, reports, step = save_pictures(tmp_path / "in", small_shots[:4]), tmp_path / "out", [], ""

    def progress(done, total, message):
        reports.append((done, total, message))
        assert done >= 0 and (done <= total or total == 0)
        return message != step

    steps = ["shrink", "features", "matches", "cameras", "undistort"]
    for step in ["shrink", "matches", "cameras", "undistort"]:
        reports.clear()
        with pytest.raises(warpcage.Cancelled, match=f"{step} was cancelled"):
            warpcage.capture(folder, output, progress=progress)
        assert list(dict.fromkeys(message for *_, message in reports)) == steps[: steps.index(step) + 1]
        assert reports[-1][2] == step and not output.exists() and (tmp_path / ".out.capture").is_dir()
    step = ""
    report = warpcage.capture(folder, output, progress=progress)
    assert report.registered_count == 4 and reports[-1] == (4, 4, "undistort") and capfd.readouterr() == ("", "")
