"""`warpcage.render_film`: to the bit what a loop of `Deformer.render` shows, in files and folders that go on."""

import math

import imageio.v3 as iio
import numpy as np
import pytest
from fields import BOX, shiny_field, view
from refusals import refused
from runs import require_same_film

import warpcage
from warpcage import CameraFile, CameraKey, Cancelled, Deformer, Place, PlaceFile, PoseFile, Stage
from warpcage.studio.films import Look
from warpcage.studio.films.video import deep_pixels, read_film_frame, write_film
from warpcage.view import read_image, rgba_picture

BENDS = [BOX.bend(15.0 * number, axis="x", towards="z") for number in range(3)]
CAMERA = view(eye=(2.5, 0.4, 0.6), size=32)


@pytest.fixture(scope="module")
def field():
    return shiny_field("cpu", resolution=12)


@pytest.fixture
def deformer(field):
    return Deformer(field, BOX, coordinates="mean_value", resolution=12)


def frames_of(field, poses, cameras, **options):
    """The frames of a loop, by a Deformer of its own."""
    own = Deformer(field, BOX, coordinates="mean_value", resolution=12)
    return [own.pose(pose).render(camera, **options) for pose, camera in zip(poses, cameras, strict=True)]


def held(paths):
    """The 16 bits a channel of frames that were written."""
    return np.stack([read_film_frame(path) for path in paths])


def bits(frames):
    return np.stack([deep_pixels(frame.rgb) for frame in frames])


def test_frames_are_those_of_a_loop(deformer, field, tmp_path):
    expected = frames_of(field, BENDS, [CAMERA] * 3)
    paths = warpcage.render_film(deformer, tmp_path / "deep", poses=BENDS, camera=CAMERA, format="npz")
    assert [path.name for path in paths] == [f"frame_{number:04d}.npz" for number in range(3)]
    np.testing.assert_array_equal(held(paths), bits(expected))
    paths = warpcage.render_film(deformer, tmp_path / "plain", poses=[each.vertices for each in BENDS], camera=CAMERA)
    for path, frame in zip(paths, expected, strict=True):
        np.testing.assert_array_equal(read_image(path), frame.rgb_bytes / np.float32(255.0))
    assert not np.array_equal(expected[0].rgb, expected[2].rgb)


@pytest.mark.parametrize(("name", "color"), [("a.mp4", None), ("a.gif", "white"), ("a.mov", "transparent")])
def test_a_film_is_that_of_a_loop(deformer, field, tmp_path, name, color):
    options = {} if color is None else {"background": color}
    given = dict(poses=BENDS, camera=CAMERA, fps=12, **options)
    assert warpcage.render_film(deformer, tmp_path / name, **given) == [tmp_path / name]
    frames = frames_of(field, BENDS, [CAMERA] * 3, **options)
    shown = [rgba_picture(frame) if color == "transparent" else frame.rgb for frame in frames]
    (tmp_path / "loop").mkdir()
    write_film(tmp_path / "loop" / name, shown, 12, loop=False)
    require_same_film(tmp_path / name, tmp_path / "loop" / name)


def test_keys_at_times_make_a_film_of_their_length(deformer, field, tmp_path):
    file = PoseFile(BOX, {"rest": BOX, "bent": BENDS[2]})
    file.times, file.fps, file.loop = {"rest": 0.0, "bent": 0.5}, 8.0, "ping-pong"
    file.save(tmp_path / "poses.json")
    times = [0.0, 0.125, 0.25, 0.375, 0.5, 0.375, 0.25, 0.125]  # there and back, each moment once
    expected = bits(frames_of(field, [file.at_time(time) for time in times], [CAMERA] * 8))
    for number, poses in enumerate((file, tmp_path / "poses.json")):
        paths = warpcage.render_film(deformer, tmp_path / f"{number}", poses=poses, camera=CAMERA, format="npz")
        np.testing.assert_array_equal(held(paths), expected)
    file.times = {}
    paths = warpcage.render_film(deformer, tmp_path / "each", poses=file, camera=CAMERA, format="npz")
    np.testing.assert_array_equal(held(paths), expected[[0, 4]])


def test_cameras_come_one_a_frame_or_as_keys(field, tmp_path):
    other = view(eye=(0.3, -2.4, 1.0), size=32)
    keys = CameraFile([CameraKey(CAMERA, 0.0), CameraKey(other, 0.5)], fps=4.0)
    keys.save(tmp_path / "path.json")
    on_path = [warpcage.camera_at(keys, time) for time in (0.0, 0.25, 0.5)]
    for name, camera, cameras in (
        ("each", [other, CAMERA, other], [other, CAMERA, other]),
        ("keys", keys, on_path),
        ("list", list(keys), [warpcage.camera_at(keys, number / 24.0) for number in range(13)]),
        ("file", tmp_path / "path.json", on_path),
    ):
        paths = warpcage.render_film(field, tmp_path / name, camera=camera, format="npz")
        np.testing.assert_array_equal(held(paths), bits([field.render(each) for each in cameras]))


def test_a_camera_turns_around_what_is_seen(field, tmp_path):
    paths = warpcage.render_film(field, tmp_path / "film", camera=CAMERA, move="turn:90", frames=3, format="npz")
    middle, turned = field.bounds.mean(axis=0), []
    for degrees in (0.0, 45.0, 90.0):
        cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = turn, middle - turn @ middle
        turned.append(field.render(CAMERA.moved(motion)))
    np.testing.assert_allclose(held(paths) / 65535.0, np.clip([each.rgb for each in turned], 0.0, 1.0), atol=1e-3)
    (still,) = warpcage.render_film(field, tmp_path / "framed", size=(32, 24), format="npz")
    assert read_film_frame(still).shape == (24, 32, 3)


def test_objects_of_a_stage_are_where_their_places_are(field, tmp_path):
    stage = Stage().add("ball", field, place=PlaceFile({0.0: Place(), 0.25: Place((0.5, 0.0, 0.0))}))
    stage.time = 0.1
    paths = warpcage.render_film(stage, tmp_path / "film", camera=CAMERA, fps=8, format="npz")
    assert stage.time == 0.1 and len(paths) == 3
    expected = []
    for stage.time in (0.0, 0.125, 0.25):
        expected.append(stage.render(CAMERA))
    np.testing.assert_array_equal(held(paths), bits(expected))


def test_what_shows_what_was_shown_last_is_not_rendered_again(field, deformer, tmp_path, monkeypatch):
    times = {0.0: Place(), 0.25: Place((0.5, 0.0, 0.0)), 0.5: Place((0.5, 0.0, 0.0)), 0.625: Place()}
    stage = Stage().add("box", deformer.pose(BENDS[1])).add("ball", field, place=PlaceFile(times))
    rendered, render = [], Look.render
    monkeypatch.setattr(Look, "render", lambda *args, **options: rendered.append(1) or render(*args, **options))
    warpcage.render_film(stage, tmp_path / "whole.mp4", camera=CAMERA, fps=8)
    assert len(rendered) == 4  # of 6 frames, which are written as a folder of pictures has them
    pictures = map(read_image, warpcage.render_film(stage, tmp_path / "each", camera=CAMERA, fps=8))
    assert len(rendered) == 10
    write_film(tmp_path / "again.mp4", pictures, 8, loop=False)
    require_same_film(tmp_path / "whole.mp4", tmp_path / "again.mp4")
    assert len(iio.imread(tmp_path / "whole.mp4", plugin="pyav")) == 6
    stage.hide("ball")
    warpcage.render_film(stage, tmp_path / "hidden.mp4", camera=CAMERA, fps=8)
    assert len(rendered) == 11


def test_the_pose_of_the_deformer_stays(deformer, tmp_path):
    before = deformer.pose(BENDS[1]).render(CAMERA).rgb
    warpcage.render_film(deformer, tmp_path / "film", poses=BENDS, camera=CAMERA)
    assert deformer.deformed[0] is not None
    np.testing.assert_array_equal(deformer.deformed[0].vertices, BENDS[1].vertices)
    np.testing.assert_array_equal(deformer.render(CAMERA).rgb, before)
    (now,) = warpcage.render_film(deformer, tmp_path / "now", camera=CAMERA, format="npz")
    np.testing.assert_array_equal(read_film_frame(now), deep_pixels(before))


def test_a_folder_goes_on_after_an_interrupt(deformer, field, tmp_path):
    reports = []

    def ends(done, total, message):
        reports.append((done, total, message))
        return done < 2

    film = {"poses": BENDS, "camera": CAMERA, "format": "npz"}
    with pytest.raises(Cancelled, match="2 of 3"):
        warpcage.render_film(deformer, tmp_path / "film", progress=ends, **film)
    assert reports == [(1, 3, "film"), (2, 3, "film")]
    stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "film").glob("*.npz")}
    assert 1 <= len(stamps) <= 2  # what is not being written yet when it ends is left out
    reports.clear()
    paths = warpcage.render_film(deformer, tmp_path / "film", progress=lambda *message: reports.append(message), **film)
    assert reports == [(number, 3, "film") for number in range(len(stamps) + 1, 4)]
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps
    np.testing.assert_array_equal(held(paths), bits(frames_of(field, BENDS, [CAMERA] * 3)))
    for other in ({"poses": BENDS[::-1]}, {"camera": view(size=24)}, {"overlay": True}):
        with pytest.raises(ValueError, match="frames of another film"):
            warpcage.render_film(deformer, tmp_path / "film", **(film | other))
    brighter = Deformer(shiny_field("cpu", resolution=10), BOX, coordinates="mean_value", resolution=12)
    refused(lambda: warpcage.render_film(brighter, tmp_path / "film", **film), match="other field")
    again = warpcage.render_film(deformer, tmp_path / "film", overwrite=True, **(film | {"poses": BENDS[::-1]}))
    np.testing.assert_array_equal(held(again), bits(frames_of(field, BENDS[::-1], [CAMERA] * 3)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"camera": 3}, "the camera of a film must be"),
        ({"camera": []}, "the camera of a film must be"),
        ({"move": "fly"}, "not a camera move"),
        ({"camera": [CAMERA, CAMERA], "move": "turn"}, "move is for one camera"),
        ({"frames": 0}, "frames must be a whole number"),
        ({"fps": 0}, "fps must be positive"),
        ({"size": "large"}, "a side of a picture"),
        ({"size": (8, 8, 3)}, "size must be a width"),
        ({"format": "jpg"}, "format must be one of png, exr, npz"),
        ({"poses": []}, "at least one pose"),
        ({"poses": BOX}, "poses must be one a frame"),
        ({"poses": [[BOX, BOX]]}, "pose 0 has 2 cages, the Deformer 1"),
        ({"poses": [BOX], "frames": 2}, "1 poses, 2 frames"),
        ({"background": "purple"}, "purple"),
    ],
)
def test_what_cannot_be_is_refused_and_leaves_nothing(deformer, tmp_path, options, message):
    refused(lambda: warpcage.render_film(deformer, tmp_path / "film", **options), match=message, error=warpcage.Error)
    assert list(tmp_path.iterdir()) == []


def test_other_objects_than_scenes_and_films_are_refused(deformer, field, tmp_path):
    refused(lambda: warpcage.render_film(field, tmp_path / "film", poses=BENDS), match="a Deformer, got a VoxelField")
    refused(lambda: warpcage.render_film(BOX, tmp_path / "film"), match="Deformer or a Stage, got Cage")
    refused(lambda: warpcage.render_film(deformer, tmp_path / "film.avi"), match="must end in .mp4")
    with pytest.raises(ValueError, match="has no opacity"):
        warpcage.render_film(deformer, tmp_path / "film.mp4", background="transparent")
    with pytest.raises(FileNotFoundError):
        warpcage.render_film(deformer, tmp_path / "film", poses=tmp_path / "none.json")
    assert list(tmp_path.iterdir()) == []
