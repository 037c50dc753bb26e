"""Workers of jobs: their pictures are those of `warpcage render`, and what items share is loaded once."""

import errno
import gc
import itertools
import json
import os
import pathlib
import shutil
import threading
import weakref

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused
from runs import run, write_files
from splat_scenes import splats_in_box

from warpcage import Cage, CageEdit, Camera, CameraFile, Deformer, Frame, PoseFile, VoxelField, load_scene
from warpcage.cage.pose_file import MOVING_ENDINGS
from warpcage.mesh.io.vertex_cache import CACHE_ENDINGS
from warpcage.studio.films import SPARE
from warpcage.studio.films.render import Look
from warpcage.studio.jobs import MAX_DEFORMERS, PARTS, Fingerprints, Item, JobFile, Missing, Worker, write_array
from warpcage.view import linear_light, read_image, write_picture

CAMERAS = [Camera.look_at((2.5, 1.2 * side, 1.0), (0, 0, 0), width=40, height=32) for side in (-1, 1)]
SKEW = {"fx": 40, "fy": 40, "cx": 20, "cy": 16, "width": 40, "height": 32, "camera_to_world": [[2, 0, 0, 0]] * 4}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("batch"))
    CameraFile(CAMERAS).save(folder / "cameras.json")
    rest = Cage.load(folder / "cage.obj")
    np.save(folder / "poses.npy", np.stack([rest.bend(angle, axis="x", towards="z").vertices for angle in (0, 20, 40)]))
    return folder


def frame(name="frame_0001", **options):
    entry = {"id": name, "field": "ball.npz", "cage": "cage.obj", "posed": "poses.npy#1", "camera": "cameras.json#0"}
    return Item.from_json(entry | {"coordinates": "mean_value", "resolution": 24} | options)


def test_a_frame_is_that_of_warpcage_render_to_the_byte(files, tmp_path):
    outputs = {part: f"{part}.png" for part in ("rgb", "alpha", "depth", "disparity", "masks")}
    with Worker(files, tmp_path / "out", "cpu") as worker:
        sizes = worker.run(frame(posed="posed.obj", outputs=outputs))
    argv = ["render", "@ball.npz", "--cage", "@cage.obj", "--posed", "@posed.obj", "--camera", "@cameras.json:0"]
    argv += ["--coordinates", "mean_value", "--resolution", 24, "--device", "cpu", "-o", tmp_path / "rgb.png"]
    argv += [word for part in list(outputs)[1:] for word in (f"--{part}", tmp_path / f"{part}.png")]
    assert run(files, *argv) == 0
    for part, path in outputs.items():
        made = (tmp_path / "out" / path).read_bytes()
        assert made == (tmp_path / f"{part}.png").read_bytes() and sizes[path] == len(made)


def test_a_frame_is_that_of_a_deformer_to_the_bit(files, tmp_path, device):
    field = VoxelField.load(files / "ball.npz", device=device)
    rest = Cage.load(files / "cage.obj")
    deformer = Deformer(field, rest, coordinates="mean_value", resolution=24)
    poses = np.load(files / "poses.npy")
    with Worker(files, tmp_path, device) as worker:
        for row in (2, 1):
            worker.run(frame(posed=f"poses.npy#{row}", outputs={"rgb": "rgb.npy", "depth": "depth.npy"}))
            expected = deformer.pose(rest.with_vertices(poses[row])).render(CAMERAS[0])
            np.testing.assert_array_equal(np.load(tmp_path / "rgb.npy"), expected.rgb)
            np.testing.assert_array_equal(np.load(tmp_path / "depth.npy"), expected.depth)


def test_the_picture_of_moments_is_their_mean(files, tmp_path):
    moments = [{"posed": ["poses.npy#0"]}, {"camera": "cameras.json#1"}, {"camera": "cameras.json#1"}]
    with Worker(files, tmp_path, "cpu") as worker:
        worker.run(frame("a", posed="poses.npy#0"))
        worker.run(frame("b", camera="cameras.json#1"))
        worker.run(frame("mean", moments=moments))
        worker.run(frame("one", moments=[{}]))
        worker.run(frame("plain"))
    a, b, mean = (linear_light(read_image(tmp_path / f"{name}.png")) for name in ("a", "b", "mean"))
    np.testing.assert_allclose(mean, (a + 2 * b) / 3, atol=0.01)
    assert np.abs(a - b).max() > 0.3
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "plain.png").read_bytes()


def test_fields_cages_and_maps_are_kept(files, tmp_path):
    with Worker(files, tmp_path, "cpu") as worker:
        for number, (pose, camera) in enumerate([(1, 0), (1, 1), (2, 1), (2, 0), (1, 0)]):
            worker.run(frame(f"f{number}", posed=f"poses.npy#{pose}", camera=f"cameras.json#{camera}"))
        counts = worker.frames.counts
        assert (worker.fields.read_count, counts.deformers, counts.poses, counts.frames) == (1, 1, 3, 5)
        assert worker.frames.kept.held_bytes > 0 and worker.fields.kept.held_bytes > 0
    assert worker.held_bytes == 0
    np.testing.assert_array_equal(read_image(tmp_path / "f0.png"), read_image(tmp_path / "f4.png"))


def test_outputs_come_all_or_none(files, tmp_path, monkeypatch):
    def fail(path, array):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("warpcage.studio.jobs.worker.write_array", fail)
    with Worker(files, tmp_path, "cpu") as worker:
        with pytest.raises(OSError, match="No space left"):
            worker.run(frame(outputs={"rgb": "a/rgb.png", "depth": "a/depth.npy"}))
        assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
        assert list((tmp_path / PARTS).iterdir()) == []
        assert list(worker.run(frame())) == ["frame_0001.png"]


def test_an_output_whose_place_is_taken_leaves_none_of_the_others(files, tmp_path):
    (tmp_path / "b.npy").mkdir()
    with Worker(files, tmp_path, "cpu") as worker, pytest.raises(OSError, match="b.npy"):
        worker.run(frame(outputs={"rgb": "a.png", "depth": "b.npy"}))
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == []


def test_outputs_go_to_other_disks_too(files, tmp_path, monkeypatch):
    ordinary = os.replace

    def replace(source, target):
        if PARTS in str(source) and PARTS not in str(target):
            raise OSError(errno.EXDEV, "Invalid cross-device link")
        ordinary(source, target)

    with Worker(files, tmp_path, "cpu") as worker:
        worker.run(frame("a"))
        monkeypatch.setattr(os, "replace", replace)
        worker.run(frame("b"))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} == {"a.png", "b.png"}


def test_an_inline_camera_and_cage_are_those_of_files(files, tmp_path):
    rest = Cage.load(files / "cage.obj")
    camera = json.loads((files / "cameras.json").read_text())["cameras"][0]
    np.save(files / "rest.npy", rest.vertices)
    inline = {
        "cage": {"vertices": "rest.npy", "faces": rest.faces.tolist()},
        "posed": np.load(files / "poses.npy")[1].tolist(),
        "camera": camera,
    }
    with Worker(files, tmp_path, "cpu") as worker:
        worker.run(frame("a"))
        worker.run(frame("b", **inline))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


# -- the same as commands make


@pytest.mark.parametrize(
    ("keys", "argv"),
    [
        ({"posed": "twist:30:up"}, "--posed twist:30:up --resolution 24"),
        ({"posed": "posed.obj", "size": 20}, "--posed @posed.obj --size 20 --resolution 24"),
        ({"posed": "posed.obj", "size": [20, 30]}, "--posed @posed.obj --size 20x30 --resolution 24"),
        ({"posed": "posed.obj", "resolution": None}, "--posed @posed.obj"),  # the lattice follows the picture's size
    ],
)
def test_poses_sizes_and_lattices_of_a_line_are_those_of_render(files, tmp_path, keys, argv):
    with Worker(files, tmp_path, "cpu") as worker:
        worker.run(frame(**keys))
    given = "--cage @cage.obj --camera @cameras.json:0 --coordinates mean_value --device cpu"
    assert run(files, "render", "@ball.npz", "-o", tmp_path / "x.png", *given.split(), *argv.split()) == 0
    assert (tmp_path / "x.png").read_bytes() == (tmp_path / "frame_0001.png").read_bytes()


@pytest.mark.parametrize("ending", [".json", *MOVING_ENDINGS])
def test_a_pose_is_a_keyframe_of_any_file_that_has_some(files, tmp_path, ending):
    rest = Cage.load(files / "cage.obj")
    poses = PoseFile(rest, {"frame 0": rest, "frame 1": rest.bend(30, axis="x", towards="z")})
    poses.times = {"frame 0": 0.0, "frame 1": 1 / 24}
    poses.save(files / f"walk{ending}")
    keys = ("frame 1", "1") if ending in (".json", *CACHE_ENDINGS) else ("1",)
    items = [frame(posed=f"walk{ending}#{key}", outputs={"pose": "1.npy"}) for key in keys]
    with Worker(files, tmp_path, "cpu") as worker:
        for item in items:
            assert Missing(files).of(item) is None
            assert not any(line.startswith("cannot be read") for line in Fingerprints(files).of_inputs(item))
            worker.run(item)
            np.testing.assert_allclose(np.load(tmp_path / "1.npy"), poses["frame 1"].vertices, atol=1e-6)
        refused(lambda: worker.run(frame(posed=f"walk{ending}")), match="holds 2 keyframes: name one, as in walk")
        refused(lambda: worker.run(frame(posed=f"walk{ending}#no")), match="there is no keyframe 'no'")


def test_several_edits_and_a_field_as_it_is(files, tmp_path):
    rest = Cage.load(files / "cage.obj")
    front = Cage.box((-0.7, -0.7, -0.7), (0.7, 0.0, 0.7))
    front.save(files / "front.obj")
    edits = [{"cage": "cage.obj", "posed": "posed.obj"}, {"cage": "front.obj", "remove": True}]
    plain = {"id": "plain", "field": "ball.npz", "camera": "cameras.json#1", "outputs": {"rgb": "plain.npy"}}
    outputs = {"rgb": "two.npy", "masks": "two.png", "reveal": "reveal.png"}
    with Worker(files, tmp_path, "cpu") as worker:
        worker.run(Item.from_json(plain))
        worker.run(frame(cage=None, posed=None, edits=edits, outputs=outputs))
    field = VoxelField.load(files / "ball.npz", device="cpu")
    np.testing.assert_array_equal(np.load(tmp_path / "plain.npy"), field.render(CAMERAS[1]).rgb)
    deformer = Deformer(field, [rest, CageEdit(front, remove=True)], coordinates="mean_value", resolution=24)
    expected = deformer.pose([Cage.load(files / "posed.obj"), None]).render(CAMERAS[0])
    np.testing.assert_array_equal(np.load(tmp_path / "two.npy"), expected.rgb)


def test_what_splats_lack_is_refused(files, tmp_path):
    splats_in_box("cpu").save(files / "splats.ply")
    with Worker(files, tmp_path, "cpu") as worker:
        with pytest.raises(ValueError, match="'masks' is for fields of voxels"):
            worker.run(frame(field="splats.ply", outputs={"masks": "masks.png"}))
        refused(lambda: worker.run(frame(field="splats.ply", scene_scale=0.5)), match="splats")


def test_cameras_of_scenes_are_in_the_world_of_the_field(files, tmp_path):
    turn = np.eye(4)
    turn[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    field = VoxelField.load(files / "ball.npz", device="cpu")
    field.straightening = turn
    field.save(files / "turned.npz")
    scene = load_scene(files / "scene", split="test")
    outputs = {"rgb": "rgb.npy"}
    with Worker(files, tmp_path, "cpu") as worker:
        for camera in ("scene/transforms_test.json#1", f"scene/transforms_test.json#{scene.names[1]}"):
            worker.run(frame(field="turned.npz", camera=camera, cage=None, posed=None, outputs=outputs))
            expected = field.render(scene.cameras[1].moved(turn)).rgb
            np.testing.assert_array_equal(np.load(tmp_path / "rgb.npy"), expected)
        refused(lambda: worker.run(frame(camera="scene/transforms_test.json#7")), match="has no frame '7', only 0 to 1")


# -- what stays loaded


def test_what_was_loaded_is_bounded_by_bytes_and_by_number(files, tmp_path):
    for name in "abc":
        (files / f"{name}.npz").write_bytes((files / "ball.npz").read_bytes())
    with Worker(files, tmp_path, "cpu", memory=1) as worker:
        for name in "abcab":
            worker.run(frame(field=f"{name}.npz"))
            assert len(worker.fields.kept) == 1 and len(worker.frames.kept) == 1
        assert worker.fields.read_count == 5
        gone = weakref.ref(worker.fields.kept.items()[0][1])
        worker.run(frame(field="c.npz"))
        gc.collect()
        assert gone() is None
    with Worker(files, tmp_path, "cpu") as worker:
        for resolution in (8, 9, 10, 11, 12, 13, 8):
            worker.run(frame(resolution=resolution))
        assert worker.frames.counts.deformers == 7 and len(worker.frames.kept) == MAX_DEFORMERS
        for name in "abcab":
            worker.run(frame(field=f"{name}.npz", resolution=8))
        assert worker.fields.read_count == 4


def test_files_that_change_are_read_again(files, tmp_path):
    (files / "x.npz").write_bytes((files / "ball.npz").read_bytes())
    cage, pose = Cage.load(files / "cage.obj"), np.load(files / "poses.npy")
    cage.save(files / "x.obj")
    np.save(files / "x.npy", pose)
    options = {"field": "x.npz", "cage": "x.obj", "posed": "x.npy#1", "outputs": {"rgb": "rgb.npy"}}
    pictures = []
    with Worker(files, tmp_path, "cpu") as worker:
        for change in (
            lambda: None,
            lambda: np.save(files / "x.npy", np.stack([pose[2]] * 4)),
            lambda: Cage(1.05 * cage.vertices, cage.faces).save(files / "x.obj"),
            lambda: VoxelField.load(files / "x.npz", device="cpu").save(files / "x.npz"),
        ):
            change()
            worker.run(frame(**options))
            pictures.append(np.load(tmp_path / "rgb.npy"))
        assert worker.fields.read_count == 2
    assert not any(np.array_equal(one, two) for one, two in itertools.pairwise(pictures[:3]))


def test_where_memory_is_short_all_else_is_let_go(files, tmp_path, monkeypatch):
    with Worker(files, tmp_path, "cpu") as worker:
        worker.run(frame("a"))
        ordinary, tries = Look.render, []

        def short(look, *args, **options):
            tries.append(worker.fields.read_count)
            if len(tries) == 1:
                raise RuntimeError("Failed to allocate 1073741824 bytes on device 'cuda:0'")
            return ordinary(look, *args, **options)

        monkeypatch.setattr(Look, "render", short)
        worker.run(frame("b"))
        assert tries == [1, 2] and (tmp_path / "b.png").exists()
        monkeypatch.setattr(Look, "render", lambda *args, **options: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            worker.run(frame("c"))
        assert worker.fields.read_count == 2


def test_pictures_are_encoded_beside_rendering(files, tmp_path, monkeypatch):
    """The next frames are rendered while the first is written, and no more than a few wait."""
    go = threading.Event()
    monkeypatch.setattr(
        "warpcage.studio.jobs.worker.write_picture",
        lambda path, image, depth, cuts: go.wait(60) and write_picture(path, image, cuts=cuts),
    )
    with Worker(files, tmp_path, "cpu", encoders=1) as worker:
        waiting = [worker.submit(frame(f"f{index}")) for index in range(1 + SPARE)]
        assert worker.frames.counts.frames == 1 + SPARE and not any(each.done() for each in waiting)
        blocked = threading.Thread(target=lambda: waiting.append(worker.submit(frame("last"))))
        blocked.start()
        blocked.join(0.2)
        assert len(waiting) == 1 + SPARE
        go.set()
        blocked.join(60)
        assert [list(each.result()) for each in waiting] == [["f0.png"], ["f1.png"], ["f2.png"], ["last.png"]]


@pytest.mark.parametrize(
    ("options", "arrays"),
    [
        ({"outputs": {"rgb": "a.png"}}, {"rgb_bytes"}),
        ({"outputs": {"rgb": "a.png"}, "overlay": True}, {"rgb"}),
        ({"outputs": {"rgb": "a.npy"}}, {"rgb"}),
        ({"outputs": {"rgb": "a.png"}, "background": "transparent"}, {"rgb", "alpha"}),
        ({"outputs": {"depth": "a.npy"}}, {"alpha", "depth"}),
        ({"outputs": {"fold": "a.npy", "pose": "p.npy"}}, {"fold"}),
        ({"outputs": {"masks": "a.png"}}, {"rgb", "alpha", "depth", "reveal", "fold", "outside"}),
    ],
)
def test_what_outputs_are_made_of_is_copied_and_nothing_else(files, tmp_path, monkeypatch, options, arrays):
    begun, asked = set(), set()

    def watched(name):
        ordinary = getattr(Frame, name).fget
        return property(lambda frame: asked.add(name) or ordinary(frame))

    monkeypatch.setattr(Frame, "begin_copies", lambda self, *names: begun.update(names))
    for name in ("rgb", "alpha", "depth", "reveal", "fold", "outside"):
        monkeypatch.setattr(Frame, name, watched(name))
    with Worker(files, tmp_path, "cpu") as worker:
        made = worker.frames.make(frame("a", **options))
        assert begun == arrays and not asked
        begun.clear()
        for path, write in made.writers.items():
            write(tmp_path / path)
        assert asked <= {name.removesuffix("_bytes") for name in arrays} and begun <= {"rgb_bytes"}


@pytest.mark.parametrize("shape", [(5, 7), (3, 4, 3), (0, 3)])
def test_arrays_are_files_of_numpy(tmp_path, shape):
    for array in (np.ones(shape, np.float32), np.arange(24).reshape(4, 6)[:, ::2], np.asfortranarray(np.eye(3, 4))):
        write_array(tmp_path / "a.npy", array)
        np.save(tmp_path / "b.npy", np.ascontiguousarray(array))
        assert (tmp_path / "a.npy").read_bytes() == (tmp_path / "b.npy").read_bytes()


# -- what is wrong with an item


@pytest.mark.parametrize(
    ("options", "message"),
    {
        "no field": ({"field": "no.npz"}, "field file '.*no.npz' is not there"),
        "a broken field": ({"field": "broken.npz"}, "broken.npz is not an .npz field file"),
        "no cage": ({"cage": "no.obj"}, "cage file '.*no.obj' is not there"),
        "a broken cage": ({"cage": "broken.obj"}, "broken.obj"),
        "an open cage": ({"cage": "open.obj"}, "cage 'open.obj'.*edge"),
        "no pose": ({"posed": "no.npy#1"}, "array file '.*no.npy' is not there"),
        "no row": ({"posed": "poses.npy#99"}, "poses.npy has rows 0 to 2, got 99"),
        "all rows": ({"posed": "poses.npy"}, MESSAGES["batch.poses_by_number"]),
        "a word for a row": ({"posed": "poses.npy#x"}, "names no row: write poses.npy#17"),
        "a pose of another cage": ({"posed": "other.obj"}, MESSAGES["batch.cage_does_not_fit"]),
        "few vertices": ({"posed": [[0, 0, 0]]}, MESSAGES["batch.posed_shape"]),
        "ragged vertices": ({"posed": [[0, 0, 0], [1]]}, MESSAGES["batch.posed_lists"]),
        "no preset": ({"posed": "bend:far"}, "pose 'bend:far' is not a preset"),
        "an inverted pose": ({"posed": "inward.obj"}, "deformed cage|does not fit"),
        "no cameras": ({"camera": "no.json#1"}, "camera file '.*no.json' is not there"),
        "no such camera": ({"camera": "cameras.json#9"}, "cameras.json: it holds no camera '9'"),
        "several cameras": ({"camera": "cameras.json"}, "it holds 2 cameras: name one"),
        "no file of cameras": ({"camera": "text.json#1"}, "text.json"),
        "a skew camera": ({"camera": SKEW}, "rigid|rotation"),
        "moments of two sizes": (
            {"moments": [{}, {"camera": {"eye": [2, 0, 0], "target": [0, 0, 0], "width": 8, "height": 8}}]},
            "'moments' has a picture of another size",
        ),
        "nothing to fill": ({"fill": True}, MESSAGES["batch.fill_one_color"]),
    }.values(),
)
def test_what_is_wrong_takes_one_line_and_leaves_nothing(files, tmp_path, options, message):
    (files / "text.json").write_text("text")
    with Worker(files, tmp_path, "cpu") as worker:
        refused(lambda: worker.run(frame(**options)), match=message, error=(ValueError, FileNotFoundError))
        assert not any(path.is_file() for path in tmp_path.rglob("*"))
        worker.run(frame())  # the next item is made


# -- fingerprints


def test_a_fingerprint_changes_with_what_an_item_reads_and_with_nothing_else(files, tmp_path):
    for name in ("ball.npz", "cage.obj", "cameras.json", "poses.npy"):
        (tmp_path / name).write_bytes((files / name).read_bytes())
    poses = np.load(tmp_path / "poses.npy")

    def found(**options):
        return Fingerprints(tmp_path).of(frame(**options))

    before, kept = found(), Fingerprints(tmp_path)
    assert before == found() == kept.of(frame()) and found(coordinates="green") != before
    poses[2] += 0.01  # another row than the one that is read
    np.save(tmp_path / "poses.npy", poses)
    assert found() == before
    poses[1] += 0.01
    np.save(tmp_path / "poses.npy", poses)
    assert found() != before and kept.of(frame()) == found()
    blurred = {"moments": [{"posed": ["poses.npy#0"]}, {"camera": "cameras.json#1"}]}
    before = found(**blurred)
    poses[0] += 0.01  # of a moment alone
    np.save(tmp_path / "poses.npy", poses)
    assert found(**blurred) not in (before, found())
    for name in ("ball.npz", "cage.obj", "cameras.json"):
        before = found()
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data + b"\n")
        assert found() != before and kept.of(frame()) == found()
        (tmp_path / name).unlink()
        assert found() not in (before, "") and kept.of(frame()) == found()
        (tmp_path / name).write_bytes(data)
        assert found() == before == kept.of(frame())


def test_what_is_missing_is_found_before_anything_is_made(files):
    missing = Missing(files)
    for options in ({}, {"posed": "bend:30"}, {"posed": "posed.obj"}, {"cage": None, "posed": None}):
        assert missing.of(frame(**options)) is None
    assert missing.of(Item.from_json({"id": "f", "kind": "fit", "scene": "scene"})) is None
    for options, line in (
        ({"field": "no.npz"}, "no.npz' is not there"),
        ({"posed": "poses.npy#3"}, "poses.npy has rows 0 to 2, got 3"),
        ({"moments": [{"posed": ["poses.npy#3"]}]}, "poses.npy has rows 0 to 2, got 3"),
        ({"moments": [{}, {"camera": "no.json#3"}]}, "no.json' is not there"),
        ({"posed": "no.npy#3"}, "no.npy' is not there"),
        ({"cage": {"vertices": "no.npy", "faces": [[0, 1, 2]]}}, "no.npy' is not there"),
        ({"camera": "no.json#3"}, "no.json' is not there"),
    ):
        for _ in range(2):
            assert line in (missing.of(frame(**options)) or "")


def test_the_fingerprint_of_a_scene_is_of_all_of_its_files(files, tmp_path):
    shutil.copytree(files / "scene", tmp_path / "scene")
    item = Item.from_json({"id": "f", "kind": "fit", "scene": "scene"})
    base = Fingerprints(tmp_path).of(item)
    (tmp_path / "scene" / ".hidden").write_text("x")
    assert Fingerprints(tmp_path).of(item) == base
    (tmp_path / "scene" / "loop").symlink_to(tmp_path / "scene")
    (tmp_path / "scene" / "out").mkdir()
    (tmp_path / "scene" / "out" / "f.npz").write_text("made by the run")
    assert Fingerprints(tmp_path, tmp_path / "scene" / "out").of(item) == base != Fingerprints(tmp_path).of(item)
    shutil.rmtree(tmp_path / "scene" / "out")
    picture = next((tmp_path / "scene").rglob("*.png"))
    picture.rename(picture.with_name("other.png"))
    assert Fingerprints(tmp_path).of(item) != base


@pytest.mark.nightly
def test_the_example_of_the_docs_is_made(files, tmp_path):
    text = (pathlib.Path(__file__).parents[3] / "docs" / "batch.md").read_text("utf-8")
    (files / "example.jsonl").write_text(text.partition("```json\n")[2].partition("```")[0], "utf-8")
    with JobFile(files / "example.jsonl") as job, Worker(job.folder, tmp_path, "cpu") as worker:
        job.check()
        items = sorted(job, key=lambda item: item.order)
        sizes = [size for item in items for size in worker.run(item).items()]
        counts = worker.frames.counts
    assert all((tmp_path / path).stat().st_size == size > 0 for path, size in sizes)
    assert len(items) == 8 and len(sizes) == 10 and counts.frames == 6
    assert worker.fields.read_count == 2  # the fit lets go of the first
    bent, plain = (read_image(tmp_path / f"{name}.png") for name in ("bent", "plain"))
    assert bent.shape == (60, 80, 3) and plain.shape == (60, 80, 4)
    assert np.load(tmp_path / "depth/bent.npy").shape == (60, 80)
