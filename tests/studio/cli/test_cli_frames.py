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
from warpcage.field import harmonics_on_host
from warpcage.mesh import write_shown_mesh
from warpcage.view import read_image, write_png

#: Around the half of the ball that the camera looks at: where it moves away, the other half is seen from within.
FRONT = "@front.obj"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("cli"))
    Cage.box((-0.7, -0.7, -0.7), (0.7, 0.0, 0.7)).save(folder / "front.obj")
    return folder


def test_render_of_a_plain_field(files, tmp_path):
    succeed(
        files,
        *f"render @ball.npz -o {tmp_path}/ball.png --disparity {tmp_path}/disparity.png".split(),
        *SMALL,
        *"--eye 0 -3 0 --target 0 0 0 --fov 50 --background black".split(),
    )
    image = read_image(tmp_path / "ball.png")
    assert image.shape == (40, 40, 3)
    assert (image[0] == 0).all() and image[15, 20].argmax() == 0 and image[25, 20].argmax() == 2
    disparity = read_image(tmp_path / "disparity.png")
    assert (disparity[0] == 0).all() and disparity[20, 20].sum() > disparity[20, 11].sum() > 0


def test_render_at_rest_is_the_plain_render_and_a_pose_shows(files, tmp_path):
    view = [*SMALL, "--camera", "@scene:test:1"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "plain.png", *view)
    resting = ["--cage", "@cage.obj", "--posed", "@cage.obj"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "rest.png", *view, *resting)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "posed.png", *view, *DEFORMED)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "over.png", *view, *DEFORMED, "--overlay")
    plain, rest, posed, over = (read_image(tmp_path / f"{name}.png") for name in ("plain", "rest", "posed", "over"))
    assert np.abs(plain - rest).mean() < 0.004
    assert np.abs(plain - posed).mean() > 0.02
    assert 0.02 < (np.abs(over - posed).max(axis=-1) > 0.1).mean() < 0.7


def test_camera_of_a_scene_has_its_size(files, tmp_path, device):
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "view.png", "--camera", "@scene:3", "--device", device)
    assert read_image(tmp_path / "view.png").shape == (24, 24, 3)


def test_animate_goes_through_keyframes_and_cameras(files, tmp_path):
    path = tmp_path / "film.gif"
    argv = ["animate", "@ball.npz", "-o", path, "--cage", "@cage.obj", *SMALL, "--quiet", "--motion", "once"]
    succeed(files, *argv, "--posed", "@posed.obj", "rest", "--frames", 3, "--turn", 0, "--interpolation", "linear")
    frames = iio.imread(path).astype(float)
    assert len(frames) == 3 and np.abs(frames[0] - frames[2]).mean() < 2.0 < np.abs(frames[0] - frames[1]).mean()
    (path.parent / "cams").mkdir()
    folder = tmp_path / "cams" / "frames"
    argv[3] = folder
    succeed(files, *argv, "--posed", "rest", "--frames", 3, "--cameras", "@scene:test", "--overlay")
    first = read_image(folder / "frame_0000.png")
    succeed(
        files,
        *f"render @ball.npz -o {tmp_path}/one.png --cage @cage.obj --posed rest --camera @scene:test:0".split(),
        *SMALL,
        "--overlay",
    )
    assert np.abs(first - read_image(tmp_path / "one.png")).mean() < 0.01


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
    assert run(files, *argv, "--turn", 90) == 2
    assert "another film (other turn" in capsys.readouterr().err
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


@pytest.mark.parametrize("format", ["warpcage", "svox2"])
def test_bake_then_render(files, tmp_path, format):
    view = ["--eye", 0, -3, 0.5, "--target", 0, 0, 0, *SMALL]
    succeed(files, "bake", "@ball.npz", "-o", tmp_path / "bent.npz", *DEFORMED, "--format", format, "--voxels", 60)
    succeed(files, "render", tmp_path / "bent.npz", "-o", tmp_path / "baked.png", *view)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "live.png", *DEFORMED, *view)
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "rest.png", *view)
    baked, live, rest = (read_image(tmp_path / f"{name}.png") for name in ("baked", "live", "rest"))
    assert np.mean((baked - live) ** 2) < 10**-2.5 < np.mean((rest - live) ** 2)


def test_fields_of_scaled_scenes_come_back_to_scale(files, tmp_path, capsys):
    ball = VoxelField.load(files / "ball.npz")
    small = VoxelField(
        ball.bounds * 2 / 3, ball.grid.links.numpy(), ball.grid.density.numpy() * 1.5, harmonics_on_host(ball.grid.sh)
    )
    small.save(tmp_path / "small.npz", format="svox2")
    view = [*SMALL, "--camera", "@scene:test:1"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "ball.png", *view)
    succeed(files, "render", tmp_path / "small.npz", "-o", tmp_path / "scaled.png", *view, "--scene-scale", "2/3")
    succeed(files, "render", tmp_path / "small.npz", "-o", tmp_path / "small.png", *view)
    ball, scaled, small = (read_image(tmp_path / f"{name}.png") for name in ("ball", "scaled", "small"))
    assert np.abs(scaled - ball).mean() < 2e-3 < 2e-2 < np.abs(small - ball).mean()
    for argv in (["check", "@cage.obj"], ["cage", "@cage.obj", "-o", tmp_path / "c.obj"], ["info", "@scene"]):
        assert run(files, *argv, "--scene-scale", "0.5") == 2
        assert "--scene-scale is for fields (.npz), got " in capsys.readouterr().err


def test_poses_come_from_pose_files(files, tmp_path, capsys):
    rest = Cage.load(files / "cage.obj")
    path = tmp_path / "pösen.json"
    PoseFile(rest, {"bent": Cage.load(files / "posed.obj"), "small one": rest.scale(0.8)}).save(path)
    view = [*SMALL, "--camera", "@scene:test:1"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "file.png", *view, *DEFORMED)
    argv = ["--cage", "@cage.obj", "--posed"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "named.png", *view, *argv, f"{path}:bent")
    assert (tmp_path / "file.png").read_bytes() == (tmp_path / "named.png").read_bytes()

    film = [*view, "--frames", 3, "--motion", "once", "--quiet", *argv]
    for folder, poses in (("whole", [path]), ("single", [f"{path}:bent", f"{path}:small one"])):
        succeed(files, "animate", "@ball.npz", "-o", tmp_path / folder, *film, *poses)
    for k in range(3):
        one, two = ((tmp_path / folder / f"frame_000{k}.png").read_bytes() for folder in ("whole", "single"))
        assert one == two
    assert run(files, "animate", "@ball.npz", "-o", tmp_path / "single", *film, f"{path}:bent") == 2  # another film
    assert "other posed" in capsys.readouterr().err

    for pose in (f"{path}:bent", "bend:40:x:z"):
        succeed(files, "check", "@cage.obj", "--posed", pose)
        assert "pose: usable" in capsys.readouterr().out


def test_cages_with_y_up_are_turned(files, tmp_path, capsys):
    rest, posed = (Cage.load(files / f"{name}.obj") for name in ("cage", "posed"))
    for name, cage in (("rest", rest), ("posed", posed)):
        cage.save(tmp_path / f"{name}.obj", up="y")
    view = ["--eye", 0, -3, 0.5, "--target", 0, 0, 0, *SMALL]
    turned = ["--cage", tmp_path / "rest.obj", "--posed", tmp_path / "posed.obj", "--cage-up", "y"]
    for deformation, name in ((DEFORMED, "z"), (turned, "y")):
        succeed(files, "render", "@ball.npz", "-o", tmp_path / f"{name}.png", *view, *deformation)
        succeed(files, "bake", "@ball.npz", "-o", tmp_path / f"{name}.npz", *deformation, "--voxels", 16)
    assert "warning" not in capsys.readouterr().err
    assert np.abs(read_image(tmp_path / "y.png") - read_image(tmp_path / "z.png")).max() < 0.02
    one, two = (VoxelField.load(tmp_path / f"{name}.npz") for name in "yz")
    np.testing.assert_allclose(one.bounds, two.bounds, atol=1e-6)
    mixed = ["--cage", "@cage.obj", "--posed", tmp_path / "posed.obj"]
    succeed(files, "render", "@ball.npz", "-o", tmp_path / "mixed.png", *view, *mixed)
    assert "posed.obj' has y up, and is turned to its rest cage" in capsys.readouterr().err
    assert np.abs(read_image(tmp_path / "mixed.png") - read_image(tmp_path / "z.png")).max() < 0.02


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
    baked = shot_of(build_parser().parse_args(["bake", "f.npz", "-o", "x.npz"]))
    assert baked.deformer_options(128)["resolution"] == 128


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


@pytest.fixture
def objects(files, tmp_path):
    """Words of a scene of two: the ball posed, and another, small and posed by edits of its own, beside it."""
    (tmp_path / "place.json").write_text(json.dumps(PLACE))
    edit = f"{files}/cage.obj:{files}/posed.obj"
    succeed(files, "edits", "-o", tmp_path / "it.edits.json", "--edit", edit)
    return [*SMALL, *DEFORMED, "--add", f"@ball.npz:{tmp_path}/place.json:{tmp_path}/it.edits.json"]


def test_render_of_several_objects(files, objects, tmp_path, capsys):
    view = ["--camera", "@scene:test:1", "--background", "black"]
    scene = tmp_path / "both.stage.json"
    succeed(files, "render", "@ball.npz", *objects, *view, "-o", tmp_path / "both.png", "--save-stage", scene)
    camera = load_scene(files / "scene", split="test").cameras[1].resized(40, 40)
    field, cage = VoxelField.load(files / "ball.npz"), Cage.load(files / "cage.obj")
    options = {"coordinates": "mean_value", "resolution": 24}
    deformer = Deformer(field, cage, **options).pose(cage.match(Cage.load(files / "posed.obj")))
    stage = Stage().add("one", deformer).add("other", deformer, place=Place(**PLACE))
    expected = stage.render(camera, background="black").rgb
    np.testing.assert_allclose(read_image(tmp_path / "both.png"), expected, atol=0.01)
    assert np.abs(expected - deformer.render(camera, background="black").rgb).max() > 0.3
    succeed(files, "render", scene, *SMALL, *view, "-o", tmp_path / "again.png")
    np.testing.assert_array_equal(read_image(tmp_path / "again.png"), read_image(tmp_path / "both.png"))
    capsys.readouterr()
    succeed(files, "info", scene)
    said = capsys.readouterr().out
    assert "object 'ball 2'" in said and "1 edit, at [0.6, 0.2, 0.1], turned by [0.0, 90.0, 20.0] degrees" in said
    succeed(files, "render", scene, "-o", tmp_path / "all.png", "--size", 40)  # the picture holds all of them
    image = read_image(tmp_path / "all.png")
    assert (image[[0, -1]] == 1).all() and (image[:, [0, -1]] == 1).all()


def test_film_of_objects_that_move_by_keys_of_their_places(files, objects, tmp_path):
    keys = [{"time": 0, **PLACE, "easing": "linear"}, {"time": 1, "position": [-0.6, 0.2, 0.1], "scale": 0.5}]
    (tmp_path / "around.json").write_text(json.dumps({"keys": keys}))
    argv = ["@ball.npz", *SMALL, "--add", f"@ball.npz:{tmp_path}/around.json", "--eye", 0, -4, 0, "--target", 0, 0, 0]
    folder = tmp_path / "frames"
    succeed(files, "animate", *argv, "--turn", 0, "--fps", 4, "--background", "black", "-o", folder)
    assert len(list(folder.glob("*.png"))) == 5  # as long as the keys
    field = VoxelField.load(files / "ball.npz")
    camera = Camera.look_at((0, -4, 0), (0, 0, 0), width=40, height=40)
    stage = Stage().add("one", field).add("other", field, place=tmp_path / "around.json")
    for index in (1, 4):
        stage.time = index / 4
        expected = stage.render(camera, background="black").rgb
        np.testing.assert_allclose(read_image(folder / f"frame_{index:04d}.png"), expected, atol=0.01)
    (tmp_path / "around.json").write_text(json.dumps({"keys": keys[::-1][:1] + keys[:1]}))
    assert run(files, "animate", *argv, "--turn", 0, "--fps", 4, "--background", "black", "-o", folder) == 2
    posed = ["animate", "@ball.npz", *objects, "--frames", 3, "--turn", 0, "-o", tmp_path / "posed"]
    succeed(files, *posed)  # poses without times keep to the number of frames
    assert len(list((tmp_path / "posed").glob("*.png"))) == 3


def test_a_mesh_beside_a_field_posed_and_in_a_film(files, tmp_path, capsys):
    """A cube with colours of vertices, in a place, posed by the cage of the ball, and moved by keys."""
    cube = Cage.box((-0.4,) * 3, (0.4,) * 3, segments=3)
    colors = np.random.default_rng(0).random((len(cube.vertices), 3))
    write_shown_mesh(tmp_path / "cube.glb", cube.vertices, cube.faces, colors=colors)
    (tmp_path / "place.json").write_text(json.dumps(PLACE))
    succeed(files, "edits", "-o", tmp_path / "it.edits.json", "--edit", f"{files}/cage.obj:{files}/posed.obj")
    view = ["--camera", "@scene:test:1", "--background", "black", "--size", 40, 40]
    argv = ["--add", f"{tmp_path}/cube.glb:{tmp_path}/place.json", "--coordinates", "mean_value"]
    posed = ["--add", f"{tmp_path}/cube.glb:{tmp_path}/place.json:{tmp_path}/it.edits.json", *argv[2:]]
    camera = load_scene(files / "scene", split="test").cameras[1].resized(40, 40)
    field, cage = VoxelField.load(files / "ball.npz"), Cage.load(files / "cage.obj")
    mesh = SurfaceMesh(cube.vertices, cube.faces, colors=colors)
    moved = Deformer(mesh, cage, coordinates="mean_value").pose(cage.match(Cage.load(files / "posed.obj")))
    pictures = []
    for name, given, scene_object in (("plain", argv, mesh), ("posed", posed, moved)):
        scene = tmp_path / f"{name}.stage.json"
        succeed(files, "render", "@ball.npz", *given, *view, "-o", tmp_path / f"{name}.png", "--save-stage", scene)
        stage = Stage().add("ball", field).add("cube", scene_object, place=Place(**PLACE))
        pictures.append(read_image(tmp_path / f"{name}.png"))
        np.testing.assert_allclose(pictures[-1], stage.render(camera, background="black").rgb, atol=0.01)
        succeed(files, "render", scene, *view, "-o", tmp_path / "again.png")
        np.testing.assert_array_equal(read_image(tmp_path / "again.png"), pictures[-1])
    assert np.abs(pictures[0] - pictures[1]).max() > 0.2
    keys = [{"time": 0, **PLACE, "easing": "linear"}, {"time": 1, "position": [-0.6, 0.2, 0.1], "scale": 0.5}]
    (tmp_path / "around.json").write_text(json.dumps({"keys": keys}))
    film = ["@ball.npz", "--add", f"{tmp_path}/cube.glb:{tmp_path}/around.json", *view, "--turn", 0, "--fps", 2]
    succeed(files, "animate", *film, "-o", tmp_path / "film")
    stage = Stage().add("ball", field).add("cube", mesh, place=tmp_path / "around.json")
    stage.time = 0.5
    expected = stage.render(camera, background="black").rgb
    np.testing.assert_allclose(read_image(tmp_path / "film" / "frame_0001.png"), expected, atol=0.01)
    capsys.readouterr()
    assert run(files, "bake", tmp_path / "plain.stage.json", "-o", tmp_path / "plain.npz") == 2
    assert "cube: meshes are not merged with fields" in capsys.readouterr().err


def test_bake_of_a_stage_file(files, objects, tmp_path):
    scene = tmp_path / "both.stage.json"
    succeed(files, "render", "@ball.npz", *objects, "-o", tmp_path / "both.png", "--save-stage", scene)
    succeed(files, "bake", scene, "-o", tmp_path / "both.npz", "--voxels", 80)
    succeed(files, "bake", scene, "-o", tmp_path / "both.ply")
    stage, camera = Stage.load(scene), Camera.look_at((2, 3, 1), (0, 0, 0), width=40, height=40)
    merged, splats = VoxelField.load(tmp_path / "both.npz"), SplatField.load(tmp_path / "both.ply")
    seen = [one.render(camera, background="black").rgb for one in (stage, merged, splats)]
    errors = [np.mean((one - seen[0]) ** 2) for one in seen[1:]]
    assert max(merged.resolution) <= 81 and errors[0] < 1e-2 and errors[1] < 2e-2
