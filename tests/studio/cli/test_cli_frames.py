"""Pictures, films and baked fields of deformed scenes from the command line."""

import json
from fractions import Fraction

import imageio.v3 as iio
import numpy as np
import pytest
from runs import DEFORMED, SMALL, run, succeed, write_files

from warpcage import (
    Cage,
    Camera,
    CameraFile,
    CameraKey,
    Deformer,
    Place,
    PoseFile,
    SplatField,
    Stage,
    SurfaceMesh,
    VoxelField,
    load_scene,
)
from warpcage.mesh import write_shown_mesh
from warpcage.view import read_image, write_png

#: Around the half of the ball that the camera looks at: where it moves away, the other half is seen from within.
FRONT = "@front.obj"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("cli"))
    Cage.box((-0.7, -0.7, -0.7), (0.7, 0.0, 0.7)).save(folder / "front.obj")
    return folder


def test_camera_of_a_scene_has_its_size(files, tmp_path, device):
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "view.png", "--camera", "@scene:3", "--device", device)
    assert read_image(tmp_path / "view.png").shape == (24, 24, 3)


def test_animate_goes_through_the_cameras_of_a_scene(files, tmp_path):
    common = ["--cage", "@cage.obj", "--posed", "rest", *SMALL, "--overlay"]
    film = ["--frames", 3, "--cameras", "@scene:test", "--motion", "once", "--quiet", "-o", tmp_path / "film"]
    succeed(files, "animate", "@ball.npz", *common, *film)
    succeed(files, "render", "@ball.npz", *common, "--camera", "@scene:test:0", "-o", tmp_path / "one.png")
    np.testing.assert_array_equal(read_image(tmp_path / "film/frame_0000.png"), read_image(tmp_path / "one.png"))


def test_animate_keeps_rates_that_are_not_whole(files, tmp_path):
    import av

    path = tmp_path / "film.mp4"
    for fps, rate in (("12.5", Fraction(25, 2)), ("30000/1001", Fraction(30000, 1001))):
        succeed(files, "animate", "@ball.npz", "-o", path, "--size", 16, "--frames", 3, "--fps", fps, "--quiet")
        with av.open(str(path)) as container:
            assert container.streams.video[0].average_rate == rate


def test_animate_renders_frames_that_are_cut_again(files, tmp_path, capsys):
    folder = tmp_path / "frames"
    argv = ["animate", "@ball.npz", "-o", folder, "--size", 40, "--frames", 7, "--quiet"]
    succeed(files, *argv)
    paths = sorted(folder.glob("*.png"))
    assert [path.name for path in paths] == [f"frame_000{number}.png" for number in range(7)]
    whole = [path.read_bytes() for path in paths]
    stamps = [path.stat().st_mtime_ns for path in paths]
    paths[0].write_bytes(b"")
    paths[1].write_bytes(whole[1][:50])
    paths[2].write_bytes(whole[2][:-20])  # nearly whole
    paths[3].write_bytes(bytes(len(whole[3])))
    write_png(paths[4], np.zeros((20, 20, 3)))  # a picture of another size
    paths[5].unlink()
    capsys.readouterr()
    succeed(files, *argv)
    assert capsys.readouterr().out.endswith("6 frames, 1 were there already\n")
    assert [path.read_bytes() for path in paths] == whole
    assert paths[6].stat().st_mtime_ns == stamps[6]
    (folder / "animation.json").unlink()
    assert run(files, *argv) == 2


@pytest.mark.parametrize("kind", ["alpha", "depth", "disparity", "masks"])
def test_animate_shows_other_outputs(files, tmp_path, capsys, kind):
    folder = tmp_path / kind
    argv = [
        *f"animate @ball.npz -o {folder} --cage {FRONT} --posed translate:0:0:1.5".split(),
        *SMALL,
        *f"--frames 4 --quiet --turn 0 --show {kind}".split(),
    ]
    succeed(files, *argv)
    said = capsys.readouterr().err
    assert ("uncovered" in said and "% of the film" in said) == (kind == "masks")
    whole = [(folder / f"frame_000{index}.png").read_bytes() for index in range(4)]
    assert read_image(folder / "frame_0001.png").std() > 0.05
    (folder / "frame_0001.png").unlink()
    succeed(files, *argv)  # with the same scale of colours
    assert [(folder / f"frame_000{index}.png").read_bytes() for index in range(4)] == whole


def test_render_writes_masks_when_asked_and_warns(files, tmp_path, capsys):
    view = ["render", "@ball.npz", "-o", tmp_path / "a.png", *SMALL, "--cage", FRONT, "--posed", "translate:0:0:1"]
    succeed(files, *view)
    assert "warning" not in capsys.readouterr().err
    extra = [word for kind in ("masks", "depth", "alpha") for word in (f"--{kind}", tmp_path / f"{kind}.png")]
    succeed(files, *view, *extra)
    warning = capsys.readouterr().err
    assert "warpcage: warning: " in warning and "uncovered" in warning
    masks, alpha = read_image(tmp_path / "masks.png"), read_image(tmp_path / "alpha.png")
    blue = masks[..., 2] - masks[..., 0] > 0.3
    assert 0.02 < blue.mean() < 0.6
    assert float(warning.split("warning: ")[1].split()[0]) == pytest.approx(100 * blue.mean(), abs=3.0)
    assert alpha.max() > 0.95 and alpha.min() == 0 and read_image(tmp_path / "depth.png").max() > 0.5


#: Two edits: the ball bent, and its front removed.
EDITS = ("--edit", "@cage.obj:@posed.obj", "--edit", f"{FRONT}:remove")


@pytest.mark.parametrize(("format", "deformed"), [("warpcage", DEFORMED), ("svox2", EDITS)])
def test_bake_then_render(files, tmp_path, format, deformed):
    view = ["--eye", 0, -3, 0.5, "--target", 0, 0, 0, *SMALL]
    succeed(files, "bake", "@ball.npz", "-o", tmp_path / "bent.npz", *deformed, "--format", format, "--voxels", 60)
    succeed(files, "render", tmp_path / "bent.npz", "-o", tmp_path / "baked.png", *view)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "live.png", *deformed, *view)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "rest.png", *view)
    baked, live, rest = (read_image(tmp_path / f"{name}.png") for name in ("baked", "live", "rest"))
    assert np.mean((baked - live) ** 2) < 10**-2.5 < np.mean((rest - live) ** 2)


def test_poses_come_from_pose_files(files, tmp_path, capsys):
    rest = Cage.load(files / "cage.obj")
    path = tmp_path / "pösen.json"
    PoseFile(rest, {"bent": Cage.load(files / "posed.obj"), "small one": rest.scale(0.8)}).save(path)
    film = [*SMALL, "--frames", 3, "--motion", "once", "--quiet", "--cage", "@cage.obj", "--posed"]
    for folder, poses in (("whole", [path]), ("single", [f"{path}:bent", f"{path}:small one"])):
        succeed(files, "animate", "@ball.npz", "-o", tmp_path / folder, *film, *poses)
    for k in range(3):
        one, two = ((tmp_path / folder / f"frame_000{k}.png").read_bytes() for folder in ("whole", "single"))
        assert one == two
    for pose in (f"{path}:bent", "bend:40:x:z"):
        succeed(files, "check", "@cage.obj", "--posed", pose)
        assert "pose: usable" in capsys.readouterr().out


def test_a_width_alone_keeps_the_shape_of_a_cameras_picture(files, tmp_path):
    wide = ["--eye", 0, -3, 0, "--target", 0, 0, 0, "--size", 24, 16, "--save-camera", tmp_path / "wide.json"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "one.png", *wide)
    for argv in (["--camera", tmp_path / "wide.json"], ["--cameras", tmp_path / "wide.json", "--frames", 1]):
        film = "--cameras" in argv
        out = tmp_path / ("film" if film else "two.png")
        command = ["animate", "@ball.npz", "--quiet"] if film else ["render", "@ball.npz"]
        succeed(files, *command, "-o", out, *argv, "--size", 36)
        assert read_image(out / "frame_0000.png" if film else out).shape == (24, 36, 3)


@pytest.mark.parametrize(("count", "said"), [(3, True), (9, False), (8, False)])
def test_a_film_that_shows_cameras_in_another_time_says_so(files, tmp_path, capsys, count, said):
    camera = Camera.look_at((0, -3, 0), (0, 0, 0), width=16, height=16)
    CameraFile([CameraKey(camera, 0.0), CameraKey(camera, 1.0)]).save(tmp_path / "path.json")
    argv = ["--cameras", tmp_path / "path.json", "--fps", 8, "--frames", count, "--quiet"]
    succeed(files, "animate", "@ball.npz", "-o", tmp_path / "film", *argv)
    line = "path.json take 1 s, and are shown in 0.375 s: --frames 9 keeps their times"
    assert (line in capsys.readouterr().err) == said


def test_films_in_which_nothing_moves_say_so(files, tmp_path, capsys):
    argv = ["animate", "@ball.npz", "--size", 16, "--frames", 5, "--quiet", "-o", tmp_path / "film.gif"]
    pose = [*DEFORMED, "--resolution", 12]
    for more, still in (
        (["--turn", 0], True),
        ([], False),
        (["--turn", 0, *pose], False),
        (["--turn", 0, *pose, "--motion", "hold"], True),
        (["--turn", 0, "--cameras", "hand-held"], None),
    ):
        assert run(files, *argv, *more) == (2 if still is None else 0)
        assert ("nothing moves in this film: its 5 frames are equal" in capsys.readouterr().err) == bool(still)


def test_films_say_the_size_that_they_have(files, tmp_path, capsys):
    argv = ["animate", "@ball.npz", "--size", 17, 13, "--frames", 2, "--quiet", "-o"]
    succeed(files, *argv, tmp_path / "film.mp4")
    assert "2 frames of 16x12 (cut from 17x13: an MP4 has even sides)" in capsys.readouterr().out
    assert iio.improps(tmp_path / "film.mp4", plugin="pyav").shape == (2, 12, 16, 3)
    succeed(files, *argv, tmp_path / "film.gif")
    assert "2 frames of 17x13," in capsys.readouterr().out and iio.imread(tmp_path / "film.gif").shape[1:3] == (13, 17)


def test_several_poses_make_a_picture_each(files, tmp_path, capsys):
    """As one picture after another, but the field is read once."""
    argv = ["render", "@ball.npz", *SMALL, "--cage", "@cage.obj", "-o"]
    succeed(files, *argv, tmp_path / "poses", "--posed", "bend:20:x:z", "@posed.obj", "rest")
    assert "3 pictures of 40x40" in capsys.readouterr().out
    for number, pose in enumerate(("bend:20:x:z", "@posed.obj", "rest"), 1):
        succeed(files, *argv, tmp_path / "one.png", "--posed", pose)
        one, many = (read_image(tmp_path / name) for name in ("one.png", f"poses/pose_000{number}.png"))
        assert np.abs(one - many).mean() < 0.004
    assert len(list((tmp_path / "poses").iterdir())) == 3


@pytest.mark.parametrize(("size", "more", "cells"), [(8, [], 64), (403, [], 96), (900, [], 128), (8, ["40"], 40)])
def test_the_lattice_follows_the_size_of_the_picture(size, more, cells):
    from warpcage import Camera
    from warpcage.studio.cli.program import build_parser
    from warpcage.studio.cli.shared import set_lattice, shot_of

    given = ["--resolution", *more] if more else []
    args = build_parser().parse_args(["render", "f.npz", "-o", "x.png", *given])
    set_lattice(args, Camera.look_at([1, 0, 0], [0, 0, 0], width=size, height=4))
    assert args.resolution == cells
    baked = shot_of(build_parser().parse_args(["bake", "f.npz", "-o", "x.npz", "--scene-scale", "2/3"]))
    assert baked.deformer_options(128)["resolution"] == 128 and baked.scene_scale == 2 / 3


#: What an artist has no reason to know.
JARGON = ("rest cage", "the map ", "canonical", "det J", "face terms", "residual", "samples", "genus", "manifold")


def test_what_commands_say_of_a_pose_is_plain(files, tmp_path, capsys):
    """A pose pulled far and turned inside out: warnings and the report say what happens and what to do."""
    argv = ["render", "@ball.npz", *SMALL, "--cage", "@cage.obj", "-o", tmp_path / "a.png", "--masks"]
    for pose in ("stretch:3", "twist:300", "scale:0.3"):
        succeed(files, *argv, tmp_path / "m.png", "--posed", pose)
        said = capsys.readouterr().err
        assert not any(word in said for word in JARGON), said
    turned = Cage.load(files / "cage.obj")
    vertices = turned.vertices.copy()
    top = vertices[:, 2] > 0.5
    vertices[top, 2] -= 2.0  # the lid below the floor
    turned.with_vertices(vertices).save(tmp_path / "through.obj")
    assert run(files, *argv, tmp_path / "m.png", "--posed", tmp_path / "through.obj") in (0, 2)
    run(files, "check", "@cage.obj", "--object", "@ball.npz", "--posed", tmp_path / "through.obj")
    said = capsys.readouterr().out
    assert "pose: turned inside out" in said and "pose: has nothing to show" in said and "memory of a pose" in said
    assert not any(word in said for word in JARGON), said


# Several objects in one scene

PLACE = {"position": [0.6, 0.2, 0.1], "turn": [0, 90, 20], "scale": 0.5}
CUBE = Cage.box((-0.4,) * 3, (0.4,) * 3, segments=3)
COLORS = np.random.default_rng(0).random((len(CUBE.vertices), 3))


@pytest.fixture
def objects(files, tmp_path):
    """The --add of a ball or of a cube with colours of vertices, posed by edits of its own or not; and what it adds."""
    (tmp_path / "place.json").write_text(json.dumps(PLACE))
    write_shown_mesh(tmp_path / "cube.glb", CUBE.vertices, CUBE.faces, colors=COLORS)
    succeed(files, "edits", "-o", tmp_path / "it.edits.json", "--edit", f"{files}/cage.obj:{files}/posed.obj")

    def added(name, posed, place="place.json"):
        made = VoxelField.load(files / name) if name == "ball.npz" else None
        made = made or SurfaceMesh(CUBE.vertices, CUBE.faces, colors=COLORS)
        if posed:
            cage = Cage.load(files / "cage.obj")
            made = Deformer(made, cage, coordinates="mean_value", resolution=24)
            made.pose(cage.match(Cage.load(files / "posed.obj")))
        folder = files if name == "ball.npz" else tmp_path
        return ["--add", f"{folder}/{name}:{tmp_path}/{place}" + posed * f":{tmp_path}/it.edits.json"], made

    return added


@pytest.mark.parametrize("posed", [False, True])
@pytest.mark.parametrize("name", ["ball.npz", "cube.glb"])
def test_render_of_several_objects(files, objects, tmp_path, capsys, name, posed):
    view, scene = [*SMALL, "--camera", "@scene:test:1", "--background", "black"], tmp_path / "both.stage.json"
    (add, other), deformer = objects(name, posed), objects("ball.npz", True)[1]
    succeed(files, "render", "@ball.npz", *DEFORMED, *add, *view, "-o", tmp_path / "both.png", "--save-stage", scene)
    camera = load_scene(files / "scene", split="test").cameras[1].resized(40, 40)
    stage = Stage().add("one", deformer).add("other", other, place=Place(**PLACE))
    expected = stage.render(camera, background="black").rgb
    np.testing.assert_allclose(read_image(tmp_path / "both.png"), expected, atol=0.01)
    assert np.abs(expected - deformer.render(camera, background="black").rgb).max() > 0.3
    succeed(files, "render", scene, *view, "-o", tmp_path / "again.png")
    np.testing.assert_array_equal(read_image(tmp_path / "again.png"), read_image(tmp_path / "both.png"))
    succeed(files, "render", scene, "-o", tmp_path / "all.png", "--size", 40)  # the picture holds all of them
    image = read_image(tmp_path / "all.png")
    assert (image[[0, -1]] == 1).all() and (image[:, [0, -1]] == 1).all()
    capsys.readouterr()
    if name == "ball.npz":
        succeed(files, "info", scene)
        row = next(line for line in capsys.readouterr().out.splitlines() if "object 'ball 2'" in line)
        assert "at [0.6, 0.2, 0.1], turned by [0.0, 90.0, 20.0] degrees" in row and ("1 edit, " in row) == posed
    else:
        assert run(files, "bake", scene, "-o", tmp_path / "both.npz") == 2
        assert "cube: meshes are not merged with fields" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["ball.npz", "cube.glb"])
def test_film_of_objects_that_move_by_keys_of_their_places(files, objects, tmp_path, name):
    keys = [{"time": 0, **PLACE, "easing": "linear"}, {"time": 1, "position": [-0.6, 0.2, 0.1], "scale": 0.5}]
    (tmp_path / "around.json").write_text(json.dumps({"keys": keys}))
    add, other = objects(name, False, "around.json")
    argv = ["@ball.npz", *SMALL, *add, "--eye", 0, -4, 0, "--target", 0, 0, 0, "--turn", 0, "--background", "black"]
    folder = tmp_path / "frames"
    succeed(files, "animate", *argv, "--fps", 4, "-o", folder)
    assert len(list(folder.glob("*.png"))) == 5  # as long as the keys
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=40, height=40)
    stage = Stage().add("one", VoxelField.load(files / "ball.npz")).add("other", other, place=tmp_path / "around.json")
    for index in (1, 4):
        stage.time = index / 4
        expected = stage.render(camera, background="black").rgb
        np.testing.assert_allclose(read_image(folder / f"frame_{index:04d}.png"), expected, atol=0.01)
    (tmp_path / "around.json").write_text(json.dumps({"keys": keys[::-1]}))
    assert run(files, "animate", *argv, "--fps", 4, "-o", folder) == 2
    posed = ["animate", "@ball.npz", *SMALL, *DEFORMED, *objects(name, True)[0], "--frames", 3, "--turn", 0]
    succeed(files, *posed, "-o", tmp_path / "posed")  # poses without times keep to the number of frames
    assert len(list((tmp_path / "posed").glob("*.png"))) == 3


def test_bake_of_a_stage_file(files, objects, tmp_path):
    scene = tmp_path / "both.stage.json"
    added, _ = objects("ball.npz", True)
    succeed(files, "render", "@ball.npz", *SMALL, *DEFORMED, *added, "-o", tmp_path / "a.png", "--save-stage", scene)
    succeed(files, "bake", scene, "-o", tmp_path / "both.npz", "--voxels", 80)
    succeed(files, "bake", scene, "-o", tmp_path / "both.ply")
    stage, camera = Stage.load(scene), Camera.look_at((2, 3, 1), (0, 0, 0), width=40, height=40)
    merged, splats = VoxelField.load(tmp_path / "both.npz"), SplatField.load(tmp_path / "both.ply")
    seen = [one.render(camera, background="black").rgb for one in (stage, merged, splats)]
    errors = [np.mean((one - seen[0]) ** 2) for one in seen[1:]]
    assert max(merged.resolution) <= 81 and errors[0] < 1e-2 and errors[1] < 2e-2
