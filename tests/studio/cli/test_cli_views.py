"""Where the camera of a picture or a film stands: framing, sides, camera files."""

import json

import numpy as np
import pytest
from runs import DEFORMED, SMALL, run, succeed

from warpcage import Cage, Camera, CameraFile, CameraKey, PoseFile, VoxelField, camera_at, load_scene, turntable
from warpcage.view import mean_picture, read_image, write_png
from warpcage.view.camera_path import RefinedCameras

LENS = {"fov_degrees": 50, "width": 40, "height": 40}


def cameras_of(files, tmp_path, *argv):
    """The camera that a command takes."""
    path = tmp_path / "camera.json"
    succeed(files, *argv, "--save-camera", path)
    return CameraFile.load(path)


def is_same(one, two):
    return np.allclose(one.camera_to_world, two.camera_to_world, atol=1e-12) and np.allclose(one.fx, two.fx)


def test_the_object_stays_where_it_is_whatever_the_pose(files, tmp_path, capsys):
    plain = ["render", "@ball.npz", "-o", tmp_path / "x.png", *SMALL]
    at_rest = cameras_of(files, tmp_path, *plain)[0].camera
    moved = ["--cage", "@cage.obj", "--posed", "translate:0:0:1.5"]
    for argv in (DEFORMED, moved):
        capsys.readouterr()
        assert is_same(cameras_of(files, tmp_path, *plain, *argv)[0].camera, at_rest)
        said = capsys.readouterr().err
        assert ("reaches out of the picture" in said) == (argv is moved)
    film = ["animate", "@ball.npz", "-o", tmp_path / "x.gif", *SMALL, "--frames", 3, "--quiet", *moved]
    assert is_same(cameras_of(files, tmp_path, *film)[0].camera, at_rest)
    capsys.readouterr()
    posed = cameras_of(files, tmp_path, *plain, *moved, "--frame", "posed")[0].camera
    assert "reaches out" not in capsys.readouterr().err
    corners = np.array([[x, y, z] for x in (-0.7, 0.7) for y in (-0.7, 0.7) for z in (-0.7, 2.2)])
    pixels = posed.project(corners)[0]
    assert (pixels > 0).all() and (pixels < 40).all()


def test_posed_pictures_hold_what_no_cage_holds(files, tmp_path):
    """A cage around the upper half, which goes up: the lower half of the ball stays in the picture."""
    argv = ["render", "@ball.npz", "-o", tmp_path / "x.png", *SMALL, "--view", "front", "--frame", "posed"]
    Cage.box((-0.6, -0.6, 0.05), (0.6, 0.6, 0.6)).save(tmp_path / "half.obj")
    part = ["--edit", f"{tmp_path / 'half.obj'}:translate:0:0:0.8"]
    seen = cameras_of(files, tmp_path, *argv, *part)[0].camera
    pixels, _ = seen.project([[0.0, -0.3, -0.5], [0.0, 0.0, 1.4], [0.0, 0.0, -0.54]])
    assert ((pixels > 0) & (pixels < 40)).all()
    picture = read_image(tmp_path / "x.png")
    assert (picture[[0, -1]] > 0.9).all() and (picture[:, [0, -1]] > 0.9).all()  # nothing touches the edge


@pytest.mark.parametrize(
    "view, ahead, up",
    [
        ("front", (0, 1, 0), (0, 0, 1)),
        ("back", (0, -1, 0), (0, 0, 1)),
        ("right", (-1, 0, 0), (0, 0, 1)),
        ("left", (1, 0, 0), (0, 0, 1)),
        ("top", (0, 0, -1), (0, 1, 0)),
        ("bottom", (0, 0, 1), (0, -1, 0)),
    ],
)
def test_sides(files, tmp_path, view, ahead, up):
    argv = ["render", "@ball.npz", "-o", tmp_path / "x.png", *SMALL, "--view", view]
    rotation = cameras_of(files, tmp_path, *argv)[0].camera.rotation
    np.testing.assert_allclose(rotation[:, 2], ahead, atol=1e-3)
    np.testing.assert_allclose(-rotation[:, 1], up, atol=1e-3)


def test_a_saved_camera_gives_the_same_picture(files, tmp_path):
    argv = ["render", "@ball.npz", "-o", tmp_path / "one.png", *SMALL, *DEFORMED]
    succeed(files, *argv, "--view", "left", "--save-camera", tmp_path / "left.json")
    argv[3] = tmp_path / "two.png"
    succeed(files, *argv[:4], *SMALL[2:], *DEFORMED, "--camera", tmp_path / "left.json")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    camera = Camera.load(tmp_path / "left.json")
    succeed(files, *argv, "--camera", tmp_path / "left.json", "--save-camera", tmp_path / "again.json")
    assert (tmp_path / "left.json").read_text() == (tmp_path / "again.json").read_text()
    assert camera.width == 40


def test_films_go_along_the_keys_of_a_file(files, tmp_path):
    ring = turntable((0, 0, 0), 4.0, 20, 4, **LENS)
    times = (0.0, 1.0, 2.0, 6.0)
    CameraFile([CameraKey(camera, time) for camera, time in zip(ring, times, strict=True)]).save(tmp_path / "path.json")
    film = ["animate", "@ball.npz", "-o", tmp_path / "film", *SMALL, "--quiet", "--cameras", tmp_path / "path.json"]
    found = cameras_of(files, tmp_path, *film, "--frames", 7)
    assert all(is_same(found[index].camera, ring[index]) for index in range(3)) and is_same(found[6].camera, ring[3])
    assert [key.time for key in found] == [index / 24 for index in range(7)] and found.fps == 24
    for key in found:
        np.testing.assert_allclose(np.linalg.norm(key.camera.center), 4.0)

    view = ["render", "@ball.npz", *SMALL]
    succeed(files, *view, "-o", tmp_path / "given", "--cameras", "given", "--scene", tmp_path / "path.json")
    assert len(list((tmp_path / "given").iterdir())) == 4
    way = ["--cameras", "interpolate", "--scene", tmp_path / "path.json", "--frames", 7]
    succeed(files, *view, "-o", tmp_path / "way", *way)
    for name in ("view_0000.png", "view_0004.png", "view_0006.png"):
        along = read_image(tmp_path / "way" / name)
        frame = read_image(tmp_path / "film" / f"frame{name[4:]}")
        np.testing.assert_array_equal(along, frame)
    one = ["--camera", f"{tmp_path / 'path.json'}:1", "-o", tmp_path / "one.png"]
    succeed(files, *view, *one)
    np.testing.assert_array_equal(read_image(tmp_path / "one.png"), read_image(tmp_path / "given" / "view_0001.png"))


def test_another_shape_is_cut_from_the_picture_or_widens_it(files, tmp_path, capsys):
    """Where pictures of both shapes overlap they are the same one, and the shape fits in or around."""
    Camera.look_at((0.4, -4.0, 1.0), (0, 0, 0), fov_degrees=12, width=40, height=40).save(tmp_path / "square.json")

    def picture(*size):
        path = tmp_path / "x.png"
        succeed(files, "render", "@ball.npz", "-o", path, "--camera", tmp_path / "square.json", "--size", *size)
        return 255.0 * read_image(path)

    square, fine = picture(40), picture(80)
    capsys.readouterr()
    for argv, expected in {
        ("40x20",): square[10:30],
        ("40", "20"): square[10:30],
        ("2:1",): square[10:30],
        ("40", "2:1"): square[10:30],
        ("20x40",): square[:, 10:30],
        ("4:5",): square[:, 4:36],
        ("1:1",): square,
        ("80", "5:4"): fine[8:72],
    }.items():
        found = picture(*argv)
        assert found.shape == expected.shape and np.abs(found - expected).max() <= 2, argv
        said = capsys.readouterr().err
        assert ("cuts the camera's 40x40 picture" in said) == (argv != ("1:1",)) and said.count("\n") <= 1
    for argv, middle in ((("80x40", "widen"), np.s_[:, 20:60]), (("1:2", "widen"), np.s_[20:60])):
        wide = picture(*argv)
        assert max(wide.shape) == 80 and np.abs(wide[middle] - square).max() <= 2
        assert "cuts" not in capsys.readouterr().err
    assert (square[:, 0] < 250).any()  # the square picture cuts the ball, so that a wider one shows more of it


def test_cameras_and_poses_with_times_go_together(files, tmp_path):
    """The film is as long as the keys of the poses say; its cameras are those of the same seconds."""
    rest = Cage.load(files / "cage.obj")
    poses = PoseFile(rest, {"rest": rest, "bent": rest.bend(30)})
    poses.times, poses.fps = {"rest": 0.0, "bent": 1.0}, 4.0
    poses.save(tmp_path / "poses.json")
    ring = turntable((0, 0, 0), 4.0, 20, 4, **LENS)
    keys = [CameraKey(camera, time, easing="linear") for camera, time in zip(ring[:2], (0.0, 2.0), strict=True)]
    CameraFile(keys).save(tmp_path / "path.json")
    film = ["animate", "@ball.npz", "-o", tmp_path / "film", *SMALL, "--quiet", "--cage", "@cage.obj"]
    argv = ["--posed", tmp_path / "poses.json", "--cameras", tmp_path / "path.json"]
    found = cameras_of(files, tmp_path, *film, *argv)
    assert len(found) == 5
    for key in found:
        assert is_same(key.camera, camera_at(keys, key.time))
    assert not is_same(found[-1].camera, ring[1])  # half of the way after one second of two


def test_info_of_cameras_and_of_foreign_json(files, tmp_path, capsys):
    keys = turntable((0, 0, 0), 3.0, 10, 2, **LENS)
    CameraFile([CameraKey(keys[0], 0.0, name="near"), CameraKey(keys[1], 1.5)]).save(tmp_path / "two.json")
    succeed(files, "info", tmp_path / "two.json")
    printed = capsys.readouterr().out
    said = ("cameras", f"{LENS['width']}x{LENS['height']} from ", "'near'", "at 0 s", "at 1.5 s")
    assert all(word in printed for word in said)
    (tmp_path / "other.json").write_text('{"figures": 3}')
    assert run(files, "info", tmp_path / "other.json") == 2
    error = capsys.readouterr().err
    assert (
        "its format must be one of warpcage poses, warpcage cameras, warpcage edits" in error and error.count("\n") == 1
    )


#: Cameras around the ball from 200 to 300 degrees, ever nearer to it.
SEEN = [
    Camera.look_at(
        (distance * np.cos(angle), distance * np.sin(angle), 0.5), (0, 0, 0), fov_degrees=40, width=16, height=16
    )
    for angle, distance in zip(np.radians(np.linspace(200, 300, 11)), np.linspace(4.0, 3.0, 11), strict=True)
]


@pytest.fixture(scope="module")
def seen(files):
    """A scene of those cameras, and a field that knows them."""
    folder = files / "walk"
    folder.mkdir()
    frames = []
    for index, camera in enumerate(SEEN):
        write_png(folder / f"{index:02d}.png", np.full((16, 16, 3), 0.5))
        pose = camera.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"{index:02d}.png", "transform_matrix": pose.tolist()})
    lens = {"fl_x": SEEN[0].fx, "fl_y": SEEN[0].fy, "cx": 8, "cy": 8, "w": 16, "h": 16}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    field = VoxelField.load(files / "ball.npz", device="cpu")
    names, gains = [frame["file_path"] for frame in frames], np.ones((len(SEEN), 3))
    field.refined_cameras = RefinedCameras(names, SEEN, gains, 0.0 * gains)
    field.save(files / "known.npz")


def angles_of(keys):
    """Degrees around the ball, from 0 to 360, and distances on the ground."""
    places = np.array([key.camera.center for key in keys])
    return np.degrees(np.arctan2(places[:, 1], places[:, 0])) % 360, np.hypot(places[:, 0], places[:, 1])


@pytest.mark.parametrize("argv", [("@ball.npz", "--camera", "@walk:3"), ("@known.npz",)], ids=["scene", "field"])
def test_films_stay_within_what_was_seen(files, seen, tmp_path, capsys, argv):
    film = ["animate", *argv, "--frames", 40, "--size", 16, "--quiet", "-o", tmp_path / "film.gif"]
    found = cameras_of(files, tmp_path, *film)
    said = capsys.readouterr().err
    taken = load_scene(files / "walk").cameras if "--camera" in argv else SEEN  # some pictures are held out
    ends = angles_of([CameraKey(camera) for camera in taken])[0]
    assert "--full-turn" in said and f"no picture shows {360 - np.ptp(ends):.0f} of 360" in said
    angles, distances = angles_of(found)
    assert angles.min() >= ends.min() - 1e-6 and angles.max() <= ends.max() + 1e-6
    assert np.ptp(angles) > np.ptp(ends) - 2.0
    steps = np.diff(angles, append=angles[0])
    assert np.abs(steps).max() < 20.0 and abs(steps.sum()) < 1e-6  # it loops
    turns = np.flatnonzero(np.sign(steps) != np.sign(np.roll(steps, 1)))
    assert len(turns) == 2  # there and back
    if "--camera" in argv:
        assert is_same(found[0].camera, taken[3])
        stood = np.interp(angles, ends, [np.hypot(*camera.center[:2]) for camera in taken])
        assert (distances < stood + 0.15).all()  # where pictures were taken from nearer it comes nearer
    for turn, degrees in ((["--full-turn"], 360.0), (["--turn", 90], 90.0)):
        around = angles_of(cameras_of(files, tmp_path, *film, *turn))[0]
        assert "--full-turn" not in capsys.readouterr().err
        expected = degrees * np.arange(40) / (40 if degrees == 360.0 else 39)
        np.testing.assert_allclose((around - around[0]) % 360, expected, atol=1e-6)


def test_a_side_that_was_chosen_is_kept_and_cranes_end_where_pictures_do(files, seen, tmp_path, capsys):
    film = ["animate", "@known.npz", "--frames", 20, "--size", 16, "--quiet", "-o", tmp_path / "film.gif"]
    angles, _ = angles_of(cameras_of(files, tmp_path, *film, "--view", "right"))
    assert angles[0] == pytest.approx(0.0, abs=1e-6)  # from there it goes through what was seen
    assert min((angles - 1e-6) % 360) >= 200.0 - 1e-3
    capsys.readouterr()
    eye = ["--eye", 0, -3.5, 0.1, "--target", 0, 0, 0]
    found = cameras_of(files, tmp_path, *film, *eye, "--cameras", "crane")
    assert "the crane rises by 8 degrees, to the highest picture: crane:25 goes on" in capsys.readouterr().err
    highest = max(np.arctan2(camera.center[2], np.hypot(*camera.center[:2])) for camera in SEEN)
    place = found[-1].camera.center
    assert np.arctan2(place[2], np.hypot(*place[:2])) == pytest.approx(highest)


def test_all_round_stays_all_round(files, tmp_path, capsys):
    """Nothing is unseen: the film is as without a scene."""
    film = ["animate", "@ball.npz", "--frames", 6, "--size", 16, "--quiet", "-o", tmp_path / "film.gif"]
    around = angles_of(cameras_of(files, tmp_path, *film))[0]
    assert "--full-turn" not in capsys.readouterr().err
    np.testing.assert_allclose((around - around[0]) % 360, 60 * np.arange(6), atol=1e-6)


def test_a_film_follows_a_part(files, tmp_path):
    """A cage, an edit by its number and a cage's file: where they go is the middle of the pictures."""
    argv = ["animate", "@ball.npz", "--frames", 5, "--size", 40, "--quiet", "-o", tmp_path / "film.gif"]
    argv += ["--motion", "once", "--eye", 0, -5, 1, "--target", 0, 0, 0, "--resolution", 16]
    argv += ["--edit", "@cage.obj:translate:1:0:0.5"]
    for part in ("follow", "follow:1", "follow:@cage.obj"):
        found = cameras_of(files, tmp_path, *argv, "--cameras", part)
        for place, share in zip(found, (0.0, None, 0.5, None, 1.0), strict=True):
            if share is not None:
                np.testing.assert_allclose(place.camera.project([[share, 0, share / 2]])[0], [[20, 20]], atol=0.01)
    assert run(files, *argv, "--cameras", "follow:2") == 2


def test_a_shutter_blurs_what_moves(files, tmp_path, capsys):
    """A frame is the mean of the light of what a film of as many more frames shows around it."""
    argv = ["animate", "@ball.npz", "--size", 40, "--quiet", "--eye", 0, -4, 1, "--target", 0, 0, 0]
    argv += ["--cage", "@cage.obj", "--posed", "translate:0.6:0:0", "--resolution", 16, "--interpolation", "linear"]
    argv += ["--turn", 0, "--motion", "once"]
    succeed(files, *argv, "-o", tmp_path / "blurred", "--frames", 3, "--shutter", "360:2")
    succeed(files, *argv, "-o", tmp_path / "sharp", "--frames", 9)
    folders = [sorted((tmp_path / name).glob("*.png")) for name in ("blurred", "sharp")]
    blurred, sharp = ([read_image(file) for file in files] for files in folders)
    light = [((image + 0.055) / 1.055) ** 2.4 for image in (sharp[3], sharp[5])]  # a quarter before and after
    expected = 1.055 * np.mean(light, axis=0) ** (1 / 2.4) - 0.055
    assert np.abs(blurred[1] - expected).max() <= 2 / 255 and np.abs(blurred[1] - sharp[4]).max() > 0.1
    succeed(files, *argv, "-o", tmp_path / "still", "--frames", 3, "--shutter", "180", "--motion", "hold")
    still = [(tmp_path / "still" / f"frame_000{index}.png").read_bytes() for index in range(3)]
    succeed(files, *argv, "-o", tmp_path / "plain", "--frames", 1, "--motion", "hold")
    assert still == [(tmp_path / "plain" / "frame_0000.png").read_bytes()] * 3  # what stands still is as without
    capsys.readouterr()
    for more in (["--show", "masks", "--workers", 2], ["--show", "depth"]):
        assert run(files, *argv, "-o", tmp_path / "none", "--shutter", 180, *more) == 2
        assert "--shutter" in capsys.readouterr().err


@pytest.mark.parametrize("opacity", [False, True])
def test_means_of_pictures_are_of_light(opacity):
    white, black = np.ones((2, 3, 3), np.float32), np.zeros((2, 3, 3), np.float32)
    if opacity:  # half of the time there is white, half of the time nothing: white, half clear
        white, black = (np.concatenate([image, image[..., :1]], axis=-1) for image in (white, black))
        np.testing.assert_allclose(mean_picture([white, black]), np.full((2, 3, 4), [1, 1, 1, 0.5]), atol=1e-6)
    else:
        np.testing.assert_allclose(mean_picture([white, black]), 0.735357, atol=1e-5)  # of half the light, sRGB
    some = np.random.default_rng(0).random(white.shape, np.float32)
    assert np.array_equal(mean_picture([some, some]), some)
