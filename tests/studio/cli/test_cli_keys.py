"""Films of keys at times from the command line: pose files that `pose` writes, animated glTF files, numbered files."""

import itertools
import json
import pathlib

import imageio.v3 as iio
import numpy as np
import pytest
from runs import run, succeed
from scene_writers import GltfWriter

from warpcage import Cage, Camera, CameraKey, PoseFile
from warpcage.view import eased_share, read_image

av = pytest.importorskip("av")

LOOK = ["--eye", 0, -3, 0.5, "--target", 0, 0, 0, "--size", 24, "--coordinates", "mean_value", "--resolution", 16]
FILM = ["--cage", "@cage.obj", *LOOK, "--turn", 0, "--quiet"]


def frames_of(folder):
    return [read_image(path) for path in sorted(pathlib.Path(folder).glob("*.png"))]


def test_keys_written_one_by_one_make_a_film_whose_holds_hold(files, tmp_path, capsys):
    poses = tmp_path / "poses.json"
    argv = ["pose", "@cage.obj", "-o", poses, "--key"]
    succeed(files, *argv, "start", "--at", 0, "--fps", 8)
    succeed(files, *argv, "up", "--at", 0.5, "--translate", 0, 0, 0.5)
    succeed(files, *argv, "still up", "--at", 1, "--posed", f"{poses}:up", "--easing", "linear")
    succeed(files, *argv, "end", "--at", 1.5, "--scale", 0.5, "--loop", "once")
    said = capsys.readouterr().out
    assert (
        "4 keys over 1.5 s, 8 frames a second, once: start at 0 s, up at 0.5 s, still up at 1 s, end at 1.5 s" in said
    )
    file = PoseFile.load(poses)
    assert file.easings == {"still up": "linear"} and file.timed == ("start", "up", "still up", "end")

    succeed(files, "animate", "@ball.npz", *FILM, "--posed", poses, "-o", tmp_path / "film")
    frames = frames_of(tmp_path / "film")
    assert len(frames) == 13  # 1.5 s at 8 frames a second, and the last one
    steps = [np.abs(two - one).mean() for one, two in itertools.pairwise(frames)]
    assert max(steps[4:8]) == 0 < min(steps[:4] + steps[8:])  # held to the bit, and nothing before or after it
    # no frame goes beyond the held one: the ball stands highest there
    tops = [np.flatnonzero((frame < 0.99).any(axis=(1, 2)))[0] for frame in frames]
    assert min(tops) == tops[4] and tops[0] > tops[4]


def test_the_camera_of_keyed_poses_turns_where_that_is_asked(files, tmp_path, capsys):
    poses = tmp_path / "poses.json"
    for at, name in enumerate(("start", "end")):
        succeed(files, "pose", "@cage.obj", "-o", poses, "--key", name, "--at", at, "--bend", 30 * at)
    film = ["animate", "@ball.npz", *FILM[: FILM.index("--turn")], "--fps", 2, "--posed", poses, "--quiet"]
    shown = {}
    for name, argv in {"plain": [], "still": ["--turn", 0], "turned": ["--turn", 360]}.items():
        capsys.readouterr()
        succeed(files, *film, *argv, "-o", tmp_path / name)
        shown[name] = np.stack(frames_of(tmp_path / name)), "the camera stays" in capsys.readouterr().err
    np.testing.assert_array_equal(shown["plain"][0], shown["still"][0])
    assert np.abs(shown["plain"][0] - shown["turned"][0]).max() > 0.1
    assert [printed for _, printed in shown.values()] == [True, False, False]


def test_a_key_is_replaced_moved_and_removed(files, tmp_path, capsys):
    poses = tmp_path / "poses.json"
    argv = ["pose", "@cage.obj", "-o", poses, "--key"]
    succeed(files, *argv, "a", "--at", 0, "--bend", 20)
    succeed(files, *argv, "b", "--at", 1)
    before = PoseFile.load(poses)["a"].vertices
    succeed(files, *argv, "a", "--at", 2, "--easing", "hold")  # another time alone keeps the pose
    file = PoseFile.load(poses)
    assert file.timed == ("b", "a") and file.easings == {"a": "hold"}
    np.testing.assert_array_equal(file["a"].vertices, before)
    succeed(files, *argv, "b", "--remove")
    assert PoseFile.load(poses).names == ("a",)
    capsys.readouterr()
    kept = poses.read_bytes()
    for more, message in (
        (["c"], "needs --at SECONDS: the other keys of the file have times"),
        (["a", "--remove"], "would hold no key"),
        (["z", "--remove"], "there is no key 'z'"),
        (["c", "--at", -1], "at least 0"),
        (["c", "--at", 1, "--scale", 0.5, "--posed", "@other.obj"], "does not fit its rest cage"),
    ):
        assert run(files, *argv, *more) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
        assert poses.read_bytes() == kept


@pytest.mark.parametrize(("loop", "count"), [("once", 5), ("loop", 4), ("ping-pong", 8)])
def test_rate_length_and_loop_of_a_film_follow_from_the_keys(files, tmp_path, capsys, loop, count):
    rest = Cage.load(files / "cage.obj")
    file = PoseFile(rest, {"a": rest, "b": rest.translate([0, 0, 0.4])})
    file.times, file.fps, file.loop = {"a": 0.0, "b": 0.25}, 16.0, loop
    file.save(tmp_path / "poses.json")
    succeed(files, "animate", "@ball.npz", *FILM, "--posed", tmp_path / "poses.json", "-o", tmp_path / "film.mp4")
    with av.open(str(tmp_path / "film.mp4")) as container:
        assert container.streams.video[0].average_rate == 16 and len(list(container.decode(video=0))) == count
    argv = ["animate", "@ball.npz", *FILM, "--posed", tmp_path / "poses.json", "-o", tmp_path / "film.gif"]
    succeed(files, *argv, "--fps", 8, "--loop", "once")
    assert len(iio.imread(tmp_path / "film.gif")) == 3


VIEW = Camera.look_at((0, -3, 0), (0, 0, 0), width=24, height=24)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.times.pop("a"), "keyframe 'a' has no time, 'b' has one"),
        (lambda file: file.easings.update(a="bouncy"), "keyframe 'a' has the easing 'bouncy', known are smooth, lin"),
        (lambda file: file.cameras.extend(CameraKey(VIEW, 0.5, name) for name in ("near", "far")),
         "two cameras of a path ('near' and 'far') are at 0.5 s"),
    ],
)  # fmt: skip
def test_keys_that_make_no_film_are_named_with_their_file(files, tmp_path, capsys, change, message):
    rest = Cage.load(files / "cage.obj")
    file = PoseFile(rest, {"a": rest, "b": rest.scale(0.9)})
    file.times = {"a": 0.0, "b": 1.0}
    change(file)
    file.save(tmp_path / "poses.json")
    assert run(files, "animate", "@ball.npz", *FILM, "--posed", tmp_path / "poses.json", "-o", tmp_path / "film") == 2
    assert f"{tmp_path / 'poses.json'}: {message}" in capsys.readouterr().err and not (tmp_path / "film").exists()


def write_walk(folder, cage):
    """Five frames of a way, as a glTF animation and as numbered OBJ files."""
    y_up = np.stack([cage.vertices[:, 0], cage.vertices[:, 2], -cage.vertices[:, 1]], axis=1)
    made = GltfWriter(y_up, cage.faces)
    heights = [0.0, 0.2, 0.3, 0.1, 0.4]
    made.animate((0, "translation", np.arange(5) / 12, [[0, z, 0] for z in heights], "LINEAR"))
    made.save(folder / "walk.gltf")
    for number, z in enumerate(heights, 1):
        cage.translate([0, 0, z]).save(folder / f"walk_{number:04d}.obj")
    return heights


@pytest.mark.parametrize("way", ["gltf", "pattern", "folder", "names", "imported"])
def test_motion_of_another_program_is_taken_frame_for_frame(files, tmp_path, capsys, way):
    rest = Cage.load(files / "cage.obj")
    (tmp_path / "walk").mkdir()
    heights = write_walk(tmp_path / "walk", rest)
    names = sorted((tmp_path / "walk").glob("*.obj"))
    posed = {"gltf": [tmp_path / "walk" / "walk.gltf"], "pattern": [tmp_path / "walk" / "walk_####.obj"],
             "folder": [tmp_path / "walk"], "names": names, "imported": [tmp_path / "poses.json"]}[way]  # fmt: skip
    if way == "folder":
        (tmp_path / "walk" / "walk.gltf").unlink()
    if way == "imported":
        succeed(files, "pose", "@cage.obj", "-o", posed[0], "--posed", tmp_path / "walk" / "walk.gltf")
        assert "9 keys over 0.333333 s, 24 frames a second" in capsys.readouterr().out
    argv = ["animate", "@ball.npz", *FILM, "--posed", *posed, "-o", tmp_path / "film"]
    succeed(files, *argv, *(["--fps", 12] if way in ("pattern", "folder", "names") else []))
    assert ("one cage a frame" in capsys.readouterr().err) == (way == "names")
    frames = frames_of(tmp_path / "film")
    # glTF is read at 24 frames a second, which its keys lie on; the others have a frame for each file
    step = 2 if way in ("gltf", "imported") else 1
    assert len(frames) == 4 * step + 1
    for number, z in ((0, heights[0]), (4, heights[4])):
        pose = f"translate:0:0:{z}"
        succeed(files, "render", "@ball.npz", "--cage", "@cage.obj", *LOOK, "--posed", pose, "-o", tmp_path / "one.png")
        assert np.abs(frames[step * number] - read_image(tmp_path / "one.png")).max() < 3 / 255


def test_going_from_rest_through_a_sequence_is_asked_for(files, tmp_path):
    rest = Cage.load(files / "cage.obj")
    write_walk(tmp_path, rest)
    argv = ["animate", "@ball.npz", *FILM, "--posed", tmp_path / "walk_####.obj", "-o", tmp_path / "film"]
    succeed(files, *argv, "--motion", "once", "--frames", 6, "--interpolation", "linear")
    frames = frames_of(tmp_path / "film")
    assert len(frames) == 6
    np.testing.assert_array_equal(frames[0], frames[1])  # rest, and the first pose, which is at rest


def test_a_still_of_a_file_that_moves_names_its_pose(files, tmp_path, capsys):
    rest = Cage.load(files / "cage.obj")
    write_walk(tmp_path, rest)
    y_up = np.stack([rest.vertices[:, 0], rest.vertices[:, 2], -rest.vertices[:, 1]], axis=1)
    made = GltfWriter(y_up, rest.faces)
    made.primitive["targets"] = [{"POSITION": made.add(y_up * [0, 0.5, 0])}, {"POSITION": made.add(0.0 * y_up + 0.2)}]
    made.save(tmp_path / "off.gltf", extras={"targetNames": ["tall", "aside"]})
    rest.save(tmp_path / "still.glb")
    for pose, message in (
        ("off.gltf", "holds 2 keyframes: name one, as in"),
        ("walk.gltf", "holds an animation of 9 frames: `warpcage animate` makes a film of it"),
        ("off.gltf:wide", "no animation or shape key 'wide', only tall, aside"),
        ("still.glb:wide", "no animation or shape key 'wide', and nothing else that moves"),
    ):
        render = ["render", "@ball.npz", "--cage", "@cage.obj", *LOOK, "-o", tmp_path / "x.png"]
        for argv in (render, ["check", "@cage.obj"]):
            assert run(files, *argv, "--posed", tmp_path / pose) == 2
            assert message in capsys.readouterr().err
    made.primitive["targets"].pop()
    made.save(tmp_path / "shown.gltf", extras={"targetNames": ["tall"]}, weights=[0.5])
    made.save(tmp_path / "off.gltf", extras={"targetNames": ["tall"]}, weights=[0.0])
    rest.with_vertices(rest.vertices * [1, 1, 1.25]).save(tmp_path / "shown.obj")
    rest.with_vertices(rest.vertices * [1, 1, 1.5]).save(tmp_path / "tall.obj")
    for pose, same in (("shown.gltf", "shown.obj"), ("off.gltf:tall", "tall.obj"), ("off.gltf", "tall.obj")):
        found = []
        for name in (pose, same):
            succeed(files, "check", "@cage.obj", "--posed", tmp_path / name, "--json")
            found.append(json.loads(capsys.readouterr().out)["pose"]["volume_ratio"])
        assert found[0] == pytest.approx(found[1], rel=1e-6), pose


def test_cameras_are_keyed_beside_poses(files, tmp_path, capsys):
    poses, argv = tmp_path / "poses.json", ["pose", "@cage.obj", "-o", tmp_path / "poses.json", "--key"]
    for name, eye in (("front", (0, -3, 0)), ("side", (3, 0, 0))):
        succeed(files, "render", "@ball.npz", "-o", tmp_path / f"{name}.png", "--eye", *eye, "--target", 0, 0, 0,
                "--size", 24, "--save-camera", tmp_path / f"{name}.json")  # fmt: skip
    succeed(files, *argv, "a", "--at", 0, "--fps", 4)
    succeed(files, *argv, "front", "--at", 0, "--camera", tmp_path / "front.json", "--easing", "linear")
    succeed(files, *argv, "side", "--at", 1, "--camera", tmp_path / "side.json", "--translate", 0, 0, 0.5)
    said = capsys.readouterr().out
    assert "4 keys over 1 s, 4 frames a second: a at 0 s, side at 1 s, cameras front at 0 s, side at 1 s" in said
    file = PoseFile.load(poses)
    assert [(key.name, key.time, key.easing) for key in file.cameras] == [("front", 0, "linear"), ("side", 1, "smooth")]
    # half-way it stands at the corner, as far away as before
    np.testing.assert_allclose(file.camera_at(0.5).center, 3 * np.sqrt(0.5) * np.array([1, -1, 0]), atol=1e-9)
    succeed(files, "info", poses)
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    assert lines[-5] == "film 1 s, 4 frames a second"
    assert lines[-4] == "pose 'a' at 0 s, smooth: 0 vertices moved by up to 0"
    assert lines[-3].startswith("pose 'side' at 1 s, smooth: 26 vertices")
    assert lines[-2:] == ["camera 'front' at 0 s, linear", "camera 'side' at 1 s, smooth"]

    film = ["animate", "@ball.npz", "--cage", "@cage.obj", *LOOK[-4:], "--quiet", "--posed", poses, "-o"]
    succeed(files, *film, tmp_path / "film")
    frames = frames_of(tmp_path / "film")
    assert len(frames) == 5 and frames[0].shape == (24, 24, 3)
    np.testing.assert_array_equal(frames[0], read_image(tmp_path / "front.png"))
    up = ["--cage", "@cage.obj", "--posed", f"{poses}:side", *LOOK[-4:], "-o", tmp_path / "up.png"]
    succeed(files, "render", "@ball.npz", "--camera", tmp_path / "side.json", *up)
    np.testing.assert_array_equal(frames[4], read_image(tmp_path / "up.png"))
    succeed(files, *film, tmp_path / "turned", "--view", "front", "--turn", 0, "--size", 24)  # options come first
    assert np.abs(frames_of(tmp_path / "turned")[4] - frames[4]).max() > 0.1

    succeed(files, *argv, "side", "--remove")
    file = PoseFile.load(poses)
    assert file.names == ("a",) and [key.name for key in file.cameras] == ["front"]
    capsys.readouterr()
    for more, message in (
        (["x", "--camera", tmp_path / "side.json"], "needs --at SECONDS"),
        (["x", "--at", 0, "--camera", tmp_path / "side.json"], "camera 'front' of the file is at 0 s too"),
    ):
        assert run(files, *argv, *more) == 2
        assert message in capsys.readouterr().err


def test_a_film_of_cameras_alone_shows_the_scene_at_rest(files, tmp_path):
    poses = tmp_path / "poses.json"
    for name, split in (("one", "0"), ("two", "1")):
        key = ["--key", name, "--at", split, "--camera", f"@scene:test:{split}", "--fps", 2]
        succeed(files, "pose", "@cage.obj", "-o", poses, *key)
    argv = ["animate", "@ball.npz", "--cage", "@cage.obj", "--posed", poses, "--quiet", "-o", tmp_path / "film"]
    succeed(files, *argv, *LOOK[-4:])
    frames = frames_of(tmp_path / "film")
    succeed(files, "render", "@ball.npz", "--camera", "@scene:test:1", "-o", tmp_path / "two.png")
    assert len(frames) == 3
    assert np.abs(frames[2] - read_image(tmp_path / "two.png")).mean() < 0.004


def test_two_keys_at_one_time_are_refused_or_reported(files, tmp_path, capsys):
    """`pose` refuses them; a file that holds them is played, with a line about the jump."""
    poses = tmp_path / "poses.json"
    argv = ["pose", "@cage.obj", "-o", poses, "--key"]
    succeed(files, *argv, "a", "--at", 0)
    assert "wrote" in (said := capsys.readouterr().out) and "1 key over 0 s" in said
    succeed(files, *argv, "b", "--at", 0.5, "--translate", 0, 0, 0.3)
    assert run(files, *argv, "c", "--at", 0.5, "--bend", 20) == 2
    assert "key 'b' of the file is at 0.5 s too: give another time" in capsys.readouterr().err
    succeed(files, *argv, "b", "--at", 0.5, "--translate", 0, 0, 0.4)  # itself again
    file = PoseFile.load(poses)
    file["c"], file.times["c"] = file.rest.bend(20), 0.5
    file.save(poses)
    capsys.readouterr()
    succeed(files, "animate", "@ball.npz", *FILM, "--posed", poses, "--fps", 4, "-o", tmp_path / "film")
    said = capsys.readouterr()
    line = f"{poses}: keyframes 'b' and 'c' are both at 0.5 s: the film jumps there"
    assert said.err.count(line) == 1 and "3 frames" in said.out


def test_a_film_by_a_curve_is_that_of_the_straight_way_at_other_times(files, tmp_path, capsys):
    curve, poses = {"bezier": [0.9, 0.0, 0.9, 0.3]}, tmp_path / "poses.json"
    file = PoseFile(Cage.load(files / "cage.obj"))
    for name, time, up in (("a", 0.0, 0.0), ("b", 1.0, 0.6)):
        file[name], file.times[name] = file.rest.translate([0, 0, up]), time
    file.fps, file.easings["a"] = 4.0, curve
    file.save(poses)
    succeed(files, "animate", "@ball.npz", *FILM, "--posed", poses, "-o", tmp_path / "film")
    found = frames_of(tmp_path / "film")
    for frame, share in zip(found, (0.0, 0.25, 0.5, 0.75, 1.0), strict=True):
        one = tmp_path / "one.obj"
        file.rest.translate([0, 0, 0.6 * eased_share(curve, share)]).save(one)
        argv = ["--cage", "@cage.obj", *LOOK, "--posed", one, "-o", tmp_path / "one.png"]
        succeed(files, "render", "@ball.npz", *argv)
        np.testing.assert_allclose(frame, read_image(tmp_path / "one.png"), atol=2 / 255)
    assert np.abs(found[2] - found[0]).mean() < 0.2 * np.abs(found[4] - found[0]).mean()  # the curve's late start
