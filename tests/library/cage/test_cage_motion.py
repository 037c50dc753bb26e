"""Motion from other programs. tests/data/blender_motion was written by Blender 5.0.1 through
`python benchmarks blender motion`: .glb files, and where Blender has the vertices at each frame."""

import pathlib

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused
from scene_writers import GltfWriter

from warpcage import Cage, PoseFile
from warpcage.cage import are_numbered, gltf_poses, gltf_shown, numbered_files, sequence_poses
from warpcage.mesh import read_gltf_motion, write_shown_mesh
from warpcage.render.surface_file import read_surface

FIXTURES = pathlib.Path(__file__).parents[2] / "data" / "blender_motion"
BOX = Cage.box([-1, -1, -1], [1, 1, 1])
Y_UP = np.stack([BOX.vertices[:, 0], BOX.vertices[:, 2], -BOX.vertices[:, 1]], axis=1)


def from_y_up(vertices):
    return np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)


@pytest.mark.parametrize("ending", ["glb", "usdc"])
@pytest.mark.parametrize("name", ["shape_keys", "shape_keys_at_30", "moved_object", "armature"])
def test_motion_from_blender_comes_back_frame_for_frame(name, ending):
    """Shapes, skins and moved objects of either format."""
    if ending == "usdc":
        pytest.importorskip("pxr")
    expected = np.load(FIXTURES / f"{name}.npz")["vertices"].astype(float)
    rest = Cage.load(FIXTURES / f"{name}.{ending}")
    file = gltf_poses(FIXTURES / f"{name}.{ending}", rest)
    rate = 30.0 if name.endswith("30") else 24.0
    assert len(file) == len(expected) and file.fps == rate
    np.testing.assert_allclose([file.times[key] for key in file.names], np.arange(len(expected)) / rate, atol=1e-9)
    assert set(file.easings.values()) == {"linear"}
    # Blender's numbers of the vertices, from the first frame alone: then all frames must agree
    first = file[file.names[0]].vertices
    order = np.linalg.norm(expected[0][:, None] - first[None], axis=-1).argmin(axis=1)
    assert sorted(order) == list(range(len(first)))
    for key, places in zip(file.names, expected, strict=True):
        np.testing.assert_allclose(file[key].vertices[order], places, atol=2e-6)
    assert np.abs(expected[-1] - expected[0]).max() > 0.2


def test_a_cage_in_another_order_moves_along():
    own = Cage.load(FIXTURES / "moved_object.glb")
    shuffle = np.random.default_rng(0).permutation(len(own.vertices))
    rest = Cage(own.vertices[shuffle], np.argsort(shuffle)[own.faces])
    one, two = (gltf_poses(FIXTURES / "moved_object.glb", cage) for cage in (own, rest))
    for key in one.names:
        np.testing.assert_array_equal(two[key].vertices, one[key].vertices[shuffle])


@pytest.mark.parametrize("ending", ["glb", "usdc", "obj"])
@pytest.mark.parametrize("ordered", [True, False])
def test_a_film_may_begin_flat(tmp_path, ending, ordered):
    """Vertices are distinguished by their numbers, also where the first frame has several at one place."""
    if ending == "usdc":
        pytest.importorskip("pxr")
    own = Cage.box([-1, -1.2, -1.5], [1, 1, 1.1], segments=2)
    frames = own.vertices[None] * np.linspace([1, 1, 0], [1, 1, 1], 5)[:, None]
    if ending == "obj":
        for index, frame in enumerate(frames):
            own.with_vertices(frame).save(tmp_path / f"grow_{index}.obj")
        path = tmp_path / "grow_#.obj"
    else:
        path = tmp_path / f"grow.{ending}"
        write_shown_mesh(path, frames[0], own.faces, frames=frames, fps=24.0)
    shuffle = np.arange(len(own.vertices))
    if not ordered:
        shuffle = np.random.default_rng(1).permutation(len(own.vertices))
    rest = Cage(own.vertices[shuffle], np.argsort(shuffle)[own.faces])
    file = PoseFile.load(path, rest, up="y" if ending == "glb" else "z")
    for name, frame in zip(file.timed, frames, strict=True):
        np.testing.assert_allclose(file[name].vertices, frame[shuffle], atol=1e-6)


def test_interpolation_of_keys_by_hand(tmp_path):
    made = GltfWriter(Y_UP, BOX.faces)
    half = np.sqrt(0.5)
    made.animate(
        (0, "rotation", [0.0, 1.0], [[0, 0, 0, 1], [0, half, 0, half]], "LINEAR"),  # a quarter about y
        (0, "translation", [0.0, 0.5], [[0, 0, 0], [0, 2, 0]], "STEP"),
        (0, "scale", [0.0, 1.0], [[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 0, 0], [2, 1, 1], [0, 0, 0]], "CUBICSPLINE"),
        name="spin",
    )
    motion = read_gltf_motion(made.save(tmp_path / "spin.gltf"), "spin")
    assert len(motion.times) == 25 and motion.fps == 24.0
    for time, points in zip(motion.times, motion.vertices, strict=True):
        angle, wide = time * np.pi / 2, 1 + 3 * time**2 - 2 * time**3 + (time**3 - 2 * time**2 + time)
        scaled = Y_UP * [wide, 1, 1]
        x, y, z = scaled.T
        turned = np.stack([np.cos(angle) * x + np.sin(angle) * z, y, -np.sin(angle) * x + np.cos(angle) * z], axis=1)
        np.testing.assert_allclose(points, turned + [0, 2.0 * (time >= 0.5), 0], atol=1e-6)


@pytest.mark.parametrize("fps", [48.0, 60000 / 1001, 100.0, 30.03])
def test_rates_that_are_not_usual_are_kept(tmp_path, fps):
    """30.03 is what Blender 5 writes in glTF for 29.97: it divides by the base of its rate."""
    made = GltfWriter(Y_UP, BOX.faces)
    times = np.arange(25) / fps
    made.animate((0, "translation", times, np.outer(times, [1, 0, 0]), "LINEAR"))
    motion = read_gltf_motion(made.save(tmp_path / "a.gltf"))
    assert len(motion.times) == 25 and motion.fps == pytest.approx(fps, abs=1e-4)
    np.testing.assert_allclose(motion.times, times, atol=1e-6)


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0])
def test_what_jumps_does_so_in_its_frame(tmp_path, fps):
    """Times of keys are float32, half of them a little later than those of frames."""
    made = GltfWriter(Y_UP, BOX.faces)
    steps = np.arange(40.0)
    made.animate((0, "translation", steps / fps, np.outer(steps, [1, 0, 0]), "STEP"))
    motion = read_gltf_motion(made.save(tmp_path / "a.gltf"))
    np.testing.assert_allclose([frame[0, 0] - Y_UP[0, 0] for frame in motion.vertices], steps, atol=1e-5)


def test_keys_between_frames_and_the_frames_between_them(tmp_path):
    """A half turn between two keys is no straight line."""
    made = GltfWriter(Y_UP, BOX.faces)
    made.animate((0, "rotation", [0.0, 0.531, 1.0], [[0, 0, 0, 1], [0, 1, 0, 0], [0, 1, 0, 0]], "LINEAR"))
    motion = read_gltf_motion(made.save(tmp_path / "a.gltf"))
    assert len(motion.times) == 26 and motion.fps == 24.0 and (np.diff(motion.times) > 0).all()
    for time, points in zip(motion.times, motion.vertices, strict=True):
        angle = np.pi * min(time / 0.531, 1.0)
        x, y, z = Y_UP.T
        expected = [np.cos(angle) * x + np.sin(angle) * z, y, -np.sin(angle) * x + np.cos(angle) * z]
        np.testing.assert_allclose(points, np.stack(expected, axis=1), atol=1e-5)


def test_shapes_and_their_names(tmp_path):
    made = GltfWriter(Y_UP, BOX.faces)
    tall = Y_UP * [0, 0.5, 0]
    rows = np.array([1, 4])
    made.primitive["targets"] = [
        {"POSITION": made.add(tall)},
        {"POSITION": made.add_sparse(8, rows, np.ones((2, 3)))},
        {"POSITION": made.add_sparse(8, rows[:0], np.zeros((0, 3)))},
    ]
    path = made.save(tmp_path / "shapes.gltf", extras={"targetNames": ["tall", "corner"]}, weights=[0.5, 0, 0])
    file = gltf_poses(path, BOX)
    assert file.names == ("tall", "corner", "shape 3") and not file.times and file.fps is None
    np.testing.assert_allclose(file["tall"].vertices, BOX.vertices * [1, 1, 1.5], atol=1e-6)
    moved = np.zeros((8, 3))
    moved[rows] = [1, -1, 1]
    np.testing.assert_allclose(file["corner"].vertices, BOX.vertices + moved, atol=1e-6)
    np.testing.assert_allclose(file["shape 3"].vertices, BOX.vertices, atol=1e-6)
    np.testing.assert_allclose(gltf_shown(path, BOX).vertices, BOX.vertices * [1, 1, 1.25], atol=1e-6)
    assert gltf_poses(path, BOX, name="corner").names == ("corner",)


def test_skins_by_hand(tmp_path):
    made = GltfWriter(Y_UP, BOX.faces)
    share = (Y_UP[:, 1] + 1) / 2  # the upper half follows joint 2
    made.primitive["attributes"] |= {
        "JOINTS_0": made.add(np.tile([0, 1, 0, 0], (8, 1)), "B"),
        "WEIGHTS_0": made.add(np.stack([1 - share, share, 0 * share, 0 * share], axis=1)),
    }
    binds = np.tile(np.eye(4), (2, 1, 1))
    binds[1, 1, 3] = -1.0
    made.nodes = [{"mesh": 0, "skin": 0, "translation": [9, 9, 9]}, {"children": [2]}, {"translation": [0, 1, 0]}]
    made.more["skins"] = [{"joints": [1, 2], "inverseBindMatrices": made.add(binds.transpose(0, 2, 1).reshape(2, 16))}]
    made.animate((2, "translation", [0.0, 1 / 24], [[0, 1, 0], [3, 1, 0]], "LINEAR"))
    motion = read_gltf_motion(made.save(tmp_path / "skin.gltf"))
    np.testing.assert_allclose(motion.vertices[0], Y_UP, atol=1e-6)
    np.testing.assert_allclose(motion.vertices[1], Y_UP + share[:, None] * [3, 0, 0], atol=1e-6)
    # at rest too a skin is where its bones stand, as programs show it: its node's place does not count
    np.testing.assert_allclose(Cage.load(tmp_path / "skin.gltf").vertices, BOX.vertices, atol=1e-6)
    made.nodes[1] |= {"translation": [5, 0, 0], "scale": [-1, 1, 1]}
    mirrored = Cage.load(made.save(tmp_path / "moved.gltf"))
    np.testing.assert_allclose(mirrored.vertices, BOX.vertices * [-1, 1, 1] + [5, 0, 0], atol=1e-6)
    mirrored.require_usable()
    np.testing.assert_allclose(read_surface(tmp_path / "moved.gltf").vertices, mirrored.vertices, atol=1e-6)


def test_places_as_whole_numbers_and_sparse_ones(tmp_path):
    """KHR_mesh_quantization: numbers as they are, or shares of the largest; what sparse places leave out is zero."""
    corners, moves = np.where(Y_UP > 0, 255, 0), np.where(Y_UP > 0, 51, 0) * [0, 1, 0]
    for shares in (False, True):
        made = GltfWriter(corners, BOX.faces)
        attributes = made.primitive["attributes"]
        attributes["POSITION"] = made.add(corners, "B", **({"normalized": True} if shares else {}))
        made.primitive["targets"] = [{"POSITION": made.add(moves, "B", **({"normalized": True} if shares else {}))}]
        path, one = made.save(tmp_path / "a.gltf"), 1.0 if shares else 255.0
        rest, unit = Cage.load(path), from_y_up(np.where(Y_UP > 0, 1.0, 0.0))
        np.testing.assert_allclose(rest.vertices, one * unit, atol=1e-12)
        shape = gltf_poses(path, rest)["shape 1"]
        np.testing.assert_allclose(shape.vertices, one * unit * [1, 1, 1.2], atol=1e-12)
    rows = np.arange(1, 8)
    made = GltfWriter(Y_UP, BOX.faces)
    made.primitive["attributes"]["POSITION"] = made.add_sparse(8, rows, (Y_UP - Y_UP[0])[rows])
    np.testing.assert_allclose(Cage.load(made.save(tmp_path / "b.gltf")).vertices, BOX.vertices - BOX.vertices[0])


def test_what_is_packed_or_placed_by_extensions_is_said(tmp_path):
    made = GltfWriter(Y_UP, BOX.faces)
    made.nodes[0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {}}}
    with pytest.warns(UserWarning, match="read once, not at its instances"):
        Cage.load(made.save(tmp_path / "many.gltf"))
    made.nodes[0], made.views[0]["extensions"] = {"mesh": 0}, {"EXT_meshopt_compression": {}}
    refused(lambda: Cage.load(made.save(tmp_path / "packed.gltf")), match="export it without compression")


def test_what_does_not_move_and_what_cannot_be_read(tmp_path):
    BOX.save(tmp_path / "still.glb")
    assert gltf_poses(tmp_path / "still.glb", BOX) is None
    made = GltfWriter(Y_UP, BOX.faces)
    for name in ("walk", "run"):
        made.animate((0, "translation", [0.0], [[0, 0, 0]], "LINEAR"), name=name)
    path = made.save(tmp_path / "two.gltf")
    refused(lambda: gltf_poses(path, BOX), match=MESSAGES["cage.animations_by_name"])
    assert len(gltf_poses(path, BOX, name="run")) == 1
    refused(lambda: gltf_poses(path, BOX, name="fly"), match=MESSAGES["cage.no_animation"])
    refused(lambda: gltf_poses(path, Cage.icosphere([0, 0, 0], 1.0), name="run"), match="does not fit its rest cage")


@pytest.mark.parametrize(
    ("channel", "message"),
    [
        ((0, "translation", [0.0, 1.0], [[0, 0, 0]], "LINEAR"), "has 3 values at 2 times"),
        ((0, "translation", [1.0, 0.0], [[0, 0, 0]] * 2, "LINEAR"), "at 2 times"),
        ((0, "translation", [0.0], [[0, 0, np.nan]], "LINEAR"), "not finite"),
        ((0, "translation", [0.0, 1e6], [[0, 0, 0]] * 2, "LINEAR"), "frames, at most 20000"),
        ((0, "weights", [0.0], [1.0], "LINEAR"), "has 1 values"),
    ],
)
def test_broken_animations_are_refused_in_one_line(tmp_path, channel, message):
    made = GltfWriter(Y_UP, BOX.faces)
    made.animate(channel)
    refused(lambda: gltf_poses(made.save(tmp_path / "a.gltf"), BOX), "a.gltf", match=message)


# -- One file a frame


def test_numbered_files_are_frames(tmp_path):
    for number in (10, 2, 1):
        BOX.translate([number, 0, 0]).save(tmp_path / f"walk_{number}.obj")
    (tmp_path / "readme.txt").write_text("text")
    for text in (tmp_path, tmp_path / "walk_##.obj", tmp_path / "walk_#.obj"):
        files = numbered_files(text)
        assert [file.name for file in files] == ["walk_1.obj", "walk_2.obj", "walk_10.obj"]
    assert are_numbered(files) and not are_numbered(files[::-1]) and not are_numbered(files[:1])
    assert numbered_files(tmp_path / "walk_1.obj") is None
    file = sequence_poses(files, BOX, fps=10)
    assert file.names == ("walk_1", "walk_2", "walk_10") and file.fps == 10.0
    assert [file.times[name] for name in file.names] == pytest.approx([0.0, 0.1, 0.9])
    for time in (0.0, 0.1, 0.5, 0.9):  # frames that are missing lie between
        np.testing.assert_allclose(file.at_time(time).vertices, BOX.vertices + [1 + 10 * time, 0, 0], atol=1e-6)


def test_sequences_that_cannot_be(tmp_path):
    BOX.save(tmp_path / "a_1.obj")
    Cage.box([-1, -1, -1], [1, 1, 1], segments=2).save(tmp_path / "a_2.obj")
    with pytest.raises(ValueError, match="other faces than .*a_1.obj"):
        sequence_poses([tmp_path / "a_1.obj", tmp_path / "a_2.obj"], BOX)
    refused(lambda: sequence_poses([tmp_path / "a.obj"], BOX), match="needs a number at the end")
    (tmp_path / "empty").mkdir()
    refused(lambda: numbered_files(tmp_path / "empty"), match="no cage file with a number")
