"""Sweeps: job files of poses x cameras x coordinates, what their pictures show, and how deep it lies."""

import json
import shutil

import numpy as np
import pytest
from messages import MESSAGES
from runs import run, succeed, write_files

from warpcage import Cage, Camera, CameraFile, PoseFile, RandomPoses, VoxelField, load_scene, run_jobs, turntable
from warpcage.cage import POSE_MODES
from warpcage.studio.jobs import GivenSource, JobFile, RandomSource, RandomViews, Worker, foresee, write_sweep

SWEEP = ("sweep", "@ball.npz", "--cage", "@cage.obj", "--device", "cpu", "--quiet")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("sweeps"))
    CameraFile(turntable((0, 0, 0), 3.0, 20.0, 4, width=40, height=30)).save(folder / "cameras.json")
    rest = Cage.load(folder / "cage.obj")
    file = PoseFile(rest)
    for name in ("low", "high"):
        file[name] = rest.bend(10 if name == "low" else 30).vertices
    file.save(folder / "poses.json")
    np.save(folder / "moved.npy", np.stack([rest.vertices + 0.1 * k for k in range(3)]))
    return folder


def items_of(path):
    with JobFile(path) as job:
        return list(job.items())


@pytest.mark.parametrize("written", [False, True])
def test_every_pose_is_seen_by_every_camera_with_every_kind_of_coordinates(files, tmp_path, capsys, written):
    argv = ["--poses", "random:2", "--seeds", 4, 7, "--cameras", "@cameras.json", "--coordinates", "green", "harmonic"]
    argv += ["--write-poses"] if written else []
    succeed(files, *SWEEP, *argv, "--stretch", 0.8, 1.25, "--modes", "bend", "-o", tmp_path / "sweep.jsonl")
    assert "32 pictures of 4 poses" in capsys.readouterr().out
    items = items_of(tmp_path / "sweep.jsonl")
    assert len(items) == len({item.id for item in items}) == 4 * 4 * 2
    assert items[0].id == "pose_000000_green/camera_000" and items[-1].id == "pose_000003_harmonic/camera_003"
    assert [item.extra for item in items[8:10]] == [
        {"pose": 1, "camera": camera, "seed": 4, "number": 1} for camera in (0, 1)
    ]
    assert {(item.extra["pose"], item.extra["camera"], item.coordinates) for item in items} == {
        (pose, camera, kind) for pose in range(4) for camera in range(4) for kind in ("green", "harmonic")
    }
    assert (tmp_path / "sweep.poses.npy").exists() == written
    if written:
        poses, rest = np.load(tmp_path / "sweep.poses.npy", mmap_mode="r"), Cage.load(files / "cage.obj")
        for pose in range(4):
            source = RandomPoses(rest, seed=(4, 7)[pose // 2], stretch=(0.8, 1.25), modes=["bend"])
            assert np.array_equal(poses[pose], source.vertices(pose % 2))
    for item in items:
        drawn = {"seed": item.extra["seed"], "number": item.extra["number"]}
        drawn |= {"stretch": [0.8, 1.25], "reach": [0.3, 1.0], "modes": ["bend"]}
        assert item.edits[0].posed == (f"sweep.poses.npy#{item.extra['pose']}" if written else {"random": drawn})
        assert item.camera == f"sweep.cameras.json#{item.extra['camera']}"
    found, given = (CameraFile.load(path) for path in (tmp_path / "sweep.cameras.json", files / "cameras.json"))
    for one, two in zip(found, given, strict=True):
        assert np.array_equal(one.camera.camera_to_world, two.camera.camera_to_world)


def test_poses_come_from_files_arrays_presets_and_rest(files, tmp_path):
    argv = ["rest", "@poses.json", "@posed.obj", "@moved.npy", "twist:30", "random:1"]
    succeed(files, *SWEEP, "--poses", *argv, "--cameras", "orbit:1", "-o", tmp_path / "sweep.jsonl", "--write-poses")
    rest, poses = Cage.load(files / "cage.obj"), np.load(tmp_path / "sweep.poses.npy")
    expected = [rest, rest.bend(10), rest.bend(30), Cage.load(files / "posed.obj")]
    expected += [rest.translate([0.1 * k] * 3) for k in range(3)] + [rest.twist(30), rest.random_pose()]
    assert len(poses) == 9 and poses.dtype == np.float64
    for pose, cage in zip(poses, expected, strict=True):
        np.testing.assert_allclose(pose, cage.vertices, atol=1e-12)
    origins = [item.extra for item in items_of(tmp_path / "sweep.jsonl")]
    assert [origin.get("source", "")[-10:] for origin in origins] == [
        "rest", "poses.json", "poses.json", "/posed.obj", *3 * ["/moved.npy"], "twist:30", ""
    ]  # fmt: skip
    assert [origin.get("number") for origin in origins] == [None, 0, 1, None, 0, 1, 2, None, 0]


def test_poses_of_files_are_written_and_random_ones_between_them_are_drawn(files, tmp_path):
    argv = ["--poses", "rest", "random:2", "@poses.json", "--cameras", "@cameras.json", "--views", 1]
    succeed(files, *SWEEP, *argv, "-o", tmp_path / "sweep.jsonl")
    posed = [item.edits[0].posed for item in items_of(tmp_path / "sweep.jsonl")]
    assert [posed[0], *posed[3:]] == [f"sweep.poses.npy#{row}" for row in range(3)]
    assert [each["random"]["number"] for each in posed[1:3]] == [0, 1]
    rest = Cage.load(files / "cage.obj")
    np.testing.assert_array_equal(
        np.load(tmp_path / "sweep.poses.npy"), [pose.vertices for pose in (rest, rest.bend(10), rest.bend(30))]
    )
    lines = (tmp_path / "sweep.jsonl").read_text().splitlines()
    assert '"version": 2' in lines[0] and '"posed": {"random": {"seed": 0, "number": 1}}' in lines[3]


def made_by_a_run(files, out, *argv, **options):
    """The files of a sweep of random poses, in bytes by name, and the report of its run."""
    usual = "--cameras @cameras.json --views 2 --resolution 16 --coordinates mean_value --size 20".split()
    succeed(files, *SWEEP, *usual, *argv, "-o", out / "sweep.jsonl")
    report = run_jobs(out / "sweep.jsonl", out / "made", device="cpu", **options)
    paths = [path for path in (out / "made").rglob("*") if path.is_file() and ".warpcage" not in path.parts]
    return {path.relative_to(out / "made").as_posix(): path.read_bytes() for path in paths}, report


@pytest.mark.parametrize("up", ["z", "y"])
def test_workers_draw_the_poses_that_the_driver_would_have_drawn(files, tmp_path, up):
    """To the bit, also where the cage's file stands on another axis, with bounds of their own."""
    argv = ["--poses", "rest", "random:3", "--seeds", 5, 8, "--reach", 0.5, 0.9, "--cage-up", up]
    drawn, report = made_by_a_run(files, tmp_path / "drawn", *argv)
    written, _ = made_by_a_run(files, tmp_path / "written", *argv, "--write-poses")
    assert report.complete and report.made == 14 and drawn.keys() == written.keys()
    rows = np.load(tmp_path / "written" / "sweep.poses.npy")
    for name, data in drawn.items():
        if not name.endswith((".json", ".jsonl")):
            assert data == written[name], name
        if name.endswith(".pose.npy"):
            assert np.array_equal(np.load(tmp_path / "drawn/made" / name), rows[int(name[5:11])])
    record = json.loads(drawn["pose_000005/camera_" + min(drawn_cameras(drawn, 5)) + ".json"])
    usual = {"reach": [0.5, 0.9], "stretch": [0.5, 2.0], "modes": list(POSE_MODES)}
    assert record["edits"][0]["posed"] == {"random": {"seed": 8, "number": 1} | usual}
    frames = json.loads(drawn["transforms.json"])["frames"]
    assert [frame["posed"] for frame in frames if frame["extra"]["pose"] == 5] == 2 * [[record["edits"][0]["posed"]]]


def drawn_cameras(made, pose):
    """Cameras of a pose of which a run made pictures."""
    return [name[-7:-4] for name in made if name.startswith(f"pose_{pose:06d}/") and name.endswith(".png")
            and "alpha" not in name]  # fmt: skip


def test_a_run_makes_those_drawn_poses_again_whose_spec_or_cage_changed(files, tmp_path):
    for name in ("ball.npz", "cage.obj", "cameras.json"):
        shutil.copy(files / name, tmp_path / name)
    path = tmp_path / "job" / "sweep.jsonl"
    argv = ["--poses", "random:4", "--seeds", 1]
    made, report = made_by_a_run(tmp_path, path.parent, *argv)
    assert report.made == 8 and made_by_a_run(tmp_path, path.parent, *argv)[1].kept == 8
    text = path.read_text()
    more = '"number": 2, "stretch": [0.5, 2.0], "reach": [0.3, 1.0]}}'
    path.write_text(text.replace('"number": 2}}, "camera"', f'{more}, "camera"'))  # says the same at more length
    assert text.count('"number": 2}}, "camera"') == 2
    assert run_jobs(path, path.parent / "made", device="cpu").kept == 8
    text = text.replace('"number": 2}}, "camera"', '"number": 2, "stretch": [0.8, 1.3]}}, "camera"')
    path.write_text(text.replace('"seed": 1, "number": 3}}, "camera"', '"seed": 2, "number": 3}}, "camera"'))
    assert foresee(path, path.parent / "made", device="cpu").plan.changed == 4
    report = run_jobs(path, path.parent / "made", device="cpu")
    assert (report.kept, report.made) == (4, 4) and report.complete
    rest = Cage.load(tmp_path / "cage.obj")
    camera = min(drawn_cameras(made, 2))
    pose = np.load(path.parent / f"made/pose_000002/camera_{camera}.pose.npy")
    assert np.array_equal(pose, RandomPoses(rest, seed=1, stretch=(0.8, 1.3)).vertices(2))
    rest.with_vertices(1.1 * rest.vertices).save(tmp_path / "cage.obj")
    assert run_jobs(path, path.parent / "made", device="cpu").made == 8
    assert np.array_equal(
        np.load(path.parent / f"made/pose_000002/camera_{camera}.pose.npy"),
        RandomPoses(Cage.load(tmp_path / "cage.obj"), seed=1, stretch=(0.8, 1.3)).vertices(2),
    )


def test_a_dry_run_draws_the_poses_that_it_measures_by(files, tmp_path, capsys):
    succeed(files, *SWEEP, "--poses", "random:500", "--cameras", "@cameras.json", "--views", 1, "--size", 16,
            "--resolution", 16, "--coordinates", "mean_value", "-o", tmp_path / "sweep.jsonl")  # fmt: skip
    capsys.readouterr()
    assert run(files, "run", tmp_path / "sweep.jsonl", "-o", tmp_path / "out", "--dry-run", "--device", "cpu") == 0
    said = capsys.readouterr()
    assert "500 would be made: 500 frames" in said.out and "one frame takes" in said.out and "error" not in said.err
    assert not (tmp_path / "out").exists()


class Counted:
    """A worker under a clock of its own: five seconds to load, two for a pose, one for a picture."""

    def __init__(self, *_):
        self.now, self.pose = 0.0, None

    def __enter__(self):
        Counted.here = self
        return self

    def __exit__(self, *_):
        pass

    def run(self, item):
        self.now += 1.0 + 5.0 * (self.pose is None) + 2.0 * (item.pose != self.pose)
        self.pose = item.pose


@pytest.mark.parametrize("views, seconds, posing, total", [(4, 1.0, 2.0, 5 + 3 * 2 + 12), (1, 3.0, 0.0, 5 + 3 * 3)])
def test_a_forecast_counts_poses_once_for_all_of_their_cameras(
    files, tmp_path, monkeypatch, views, seconds, posing, total
):
    argv = ["--poses", "random:3", "--cameras", "@cameras.json", "--views", views, "-o", tmp_path / "sweep.jsonl"]
    succeed(files, *SWEEP, *argv)
    monkeypatch.setattr("warpcage.studio.jobs.worker.Worker", Counted)
    monkeypatch.setattr("warpcage.studio.jobs.run.time.perf_counter", lambda: Counted.here.now)
    found = foresee(tmp_path / "sweep.jsonl", tmp_path / "out", device="cpu")
    measured = found.measured["frame"]
    assert (measured.seconds, measured.pose_seconds, measured.load_seconds) == (seconds, posing, 5.0)
    assert found.seconds == total


def test_a_pose_is_drawn_once_for_all_of_its_cameras(files, tmp_path, monkeypatch):
    numbers, vertices = [], RandomPoses.vertices
    argv = ["--poses", "random:3", "--cameras", "@cameras.json", "--size", 16, "--resolution", 16]
    succeed(files, *SWEEP, *argv, "--coordinates", "mean_value", "-o", tmp_path / "sweep.jsonl")
    monkeypatch.setattr(RandomPoses, "vertices", lambda self, n: numbers.append(n) or vertices(self, n))
    assert run_jobs(tmp_path / "sweep.jsonl", tmp_path / "out", device="cpu").made == 12
    assert numbers == [0, 1, 2]


def test_cameras_that_are_made_see_the_random_poses_that_workers_draw(files, tmp_path):
    argv = ["--poses", "random:12", "--seeds", 3, 4, "--size", 60]
    succeed(files, *SWEEP, *argv, "--cameras", "orbit:3", "-o", tmp_path / "sweep.jsonl")
    rest, cameras = Cage.load(files / "cage.obj"), CameraFile.load(tmp_path / "sweep.cameras.json")
    poses = [RandomPoses(rest, seed=seed).vertices(number) for seed in (3, 4) for number in range(12)]
    for key in cameras:
        pixels, depth = key.camera.project(np.concatenate(poses))
        assert (depth > 0).all() and (pixels >= 0).all() and (pixels <= 60).all()


def test_of_many_random_poses_some_are_drawn_for_the_cameras(files, tmp_path, monkeypatch):
    """And one alone where the cameras are given."""
    numbers, vertices = [], RandomPoses.vertices
    monkeypatch.setattr(RandomPoses, "vertices", lambda self, n: numbers.append((self.seed, n)) or vertices(self, n))
    argv = ["--poses", "random:1000", "--seeds", 1, 2, "--views", 1, "-o", tmp_path / "sweep.jsonl"]
    monkeypatch.setattr("warpcage.studio.jobs.sweeps.FRAMED", 6)
    succeed(files, *SWEEP, *argv, "--cameras", "orbit:2")
    assert numbers == [(seed, number) for seed in (1, 2) for number in range(3)]
    numbers.clear()
    succeed(files, *SWEEP, *argv, "--cameras", "@cameras.json")
    assert numbers == [(1, 0), (2, 0)] and len(items_of(tmp_path / "sweep.jsonl")) == 2000


@pytest.mark.nightly
def test_processes_draw_the_same_poses_in_their_order(monkeypatch):
    monkeypatch.setattr("warpcage.studio.jobs.sweeps.WORTH_PROCESSES", 10)
    poses = RandomPoses(Cage.box([-1] * 3, [1] * 3), seed=6)
    found, expected = (list(RandomSource(poses, 11, True, count).rows()) for count in (2, 1))
    assert len(found) == 11 and np.array_equal(found, expected)
    with pytest.raises(ValueError, match=MESSAGES["cage.random_stretch"]):
        narrow = RandomPoses(poses.rest, stretch=(1 - 1e-12, 1 + 1e-12))
        list(RandomSource(narrow, 11, True, 2).rows())


def test_a_cage_without_random_poses_is_found_before_the_run(files, tmp_path, capsys):
    argv = ["--stretch", 1 - 1e-12, 1 + 1e-12, "--cameras", "@cameras.json", "-o", tmp_path / "sweep.jsonl"]
    assert run(files, *SWEEP, "--poses", "random:5", *argv) == 2
    assert MESSAGES["cage.random_stretch"] in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_options_of_pictures_are_those_of_all_items(files, tmp_path):
    argv = ["--poses", "rest", "--cameras", "orbit:2", "--falloff", 0.2]
    succeed(files, *SWEEP, *argv, "--records", "webdataset", "--items-per-shard", 7, "--no-depth", "--no-alpha",
            "-o", tmp_path / "sweep.jsonl")  # fmt: skip
    with JobFile(tmp_path / "sweep.jsonl") as job:
        assert job.records == {
            "kind": "webdataset", "image": "png", "depth": False, "alpha": False, "items_per_shard": 7
        }  # fmt: skip
        for item in job.items():
            assert item.edits[0].falloff == 0.2
            assert sorted(item.outputs) == ["pose", "record", "rgb"]
    succeed(files, *SWEEP, "--poses", "rest", "--image", "jpg", "-o", tmp_path / "jpg.jsonl")
    succeed(files, *SWEEP, "--poses", "rest", "--background", "own", "-o", tmp_path / "own.jsonl")
    jpg, own = (items_of(tmp_path / f"{name}.jsonl") for name in ("jpg", "own"))
    assert len(jpg) == 8 and jpg[0].background == "white" and own[0].background is None
    assert items_of(tmp_path / "jpg.jsonl")[0].outputs["rgb"] == "pose_000000/camera_000.jpg"


@pytest.mark.parametrize("wrong", ["2,0,0", "0.1,0.2"])
def test_a_wrong_background_is_named_by_its_flag(files, tmp_path, capsys, wrong):
    assert run(files, *SWEEP, "--poses", "rest", "--background", wrong, "-o", tmp_path / "sweep.jsonl") == 2
    assert "error: --background must be" in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.parametrize("cameras", ["orbit:3:35", "random:3"])
def test_cameras_that_are_made_see_all_poses_whole(files, tmp_path, cameras):
    argv = ["--poses", "stretch:2.5:x", "translate:0:0:2", "--cameras", cameras, "--size", 60, 40, "--fov", 50]
    succeed(files, *SWEEP, *argv, "-o", tmp_path / "sweep.jsonl")
    items, poses = items_of(tmp_path / "sweep.jsonl"), np.load(tmp_path / "sweep.poses.npy")
    made = [
        Camera.look_at(**item.camera)
        if isinstance(item.camera, dict)
        else CameraFile.load(tmp_path / "sweep.cameras.json").named(item.camera.split("#")[1])
        for item in items
    ]
    for item, camera in zip(items, made, strict=True):
        assert (camera.width, camera.height) == (60, 40)
        pixels, depth = camera.project(poses[item.extra["pose"]])
        assert (depth > 0).all() and (pixels >= 0).all() and (pixels <= (60, 40)).all()
    centers = {tuple(camera.center) for camera in made}
    assert len(centers) == (3 if "orbit" in cameras else 6)  # random ones are others for each pose
    again = tmp_path / "again.jsonl"
    succeed(files, *SWEEP, *argv, "-o", again)
    assert [item.camera for item in items_of(again)] == [
        item.camera if isinstance(item.camera, dict) else item.camera.replace("sweep.", "again.") for item in items
    ]


def test_cameras_of_scenes_are_those_of_their_pictures(files, tmp_path):
    for name, cameras in {"a": "@scene:test", "b": "@scene/transforms_test.json"}.items():
        succeed(files, *SWEEP, "--poses", "rest", "--cameras", cameras, "--size", 12, "-o", tmp_path / f"{name}.jsonl")
        found = CameraFile.load(tmp_path / f"{name}.cameras.json")
        for key, camera in zip(found, load_scene(files / "scene", split="test").cameras, strict=True):
            np.testing.assert_allclose(key.camera.camera_to_world, camera.camera_to_world, atol=1e-12)
            assert (key.camera.width, key.camera.height) == (12, 12) and key.camera.fx == pytest.approx(camera.fx / 2)


def test_each_pose_may_be_seen_from_some_of_the_cameras(files, tmp_path):
    argv = ["--poses", *["rest"] * 30, "--cameras", "@cameras.json", "--views", 2]
    succeed(files, *SWEEP, *argv, "-o", tmp_path / "sweep.jsonl")
    chosen = {}
    for item in items_of(tmp_path / "sweep.jsonl"):
        chosen.setdefault(item.extra["pose"], []).append(item.extra["camera"])
    assert len(chosen) == 30 and all(len(set(cameras)) == 2 for cameras in chosen.values())
    assert {tuple(cameras) for cameras in chosen.values()} == {(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)}


def test_the_depth_of_a_record_is_that_of_the_posed_surface(tmp_path):
    """A ball in a box that is stretched and moved is an ellipsoid, which rays meet where a quadratic equation says."""
    count, radius = 64, 0.6
    axis = (np.arange(count) + 0.5) * 2.0 / count - 1.0
    distance = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1), axis=-1)
    density = 300.0 * np.clip(0.5 - (distance - radius) * 0.5 * count, 0.0, 1.0)
    VoxelField.from_dense(density, np.zeros((count,) * 3 + (9, 3)), [[-1] * 3, [1] * 3]).save(tmp_path / "ball.npz")
    rest = Cage.box([-0.8] * 3, [0.8] * 3, segments=2)
    rest.save(tmp_path / "cage.obj")
    matrix, shift = np.array([[1.2, 0.3, 0.0], [0.0, 0.7, 0.1], [0.0, 0.0, 1.1]]), np.array([0.1, 0.2, -0.1])
    made = write_sweep(
        tmp_path / "sweep.jsonl",
        field=tmp_path / "ball.npz",
        cage=tmp_path / "cage.obj",
        rest=rest,
        sources=[GivenSource([rest.vertices @ matrix.T + shift], "affine")],
        cameras=lambda bounds: RandomViews(3, bounds, seed=1, width=56, height=56),
        defaults={"resolution": 32, "background": "black"},
        coordinates=["mean_value"],
    )
    assert made.items == 3 and made.cameras is None
    with JobFile(made.jobs) as job, Worker(job.folder, tmp_path / "out", "cpu") as worker:
        for item in job.items():
            worker.run(item)
            record = json.loads((tmp_path / "out" / item.outputs["record"]).read_text())
            depth = np.load(tmp_path / "out" / item.outputs["depth"])
            options = {word: record["camera"][word] for word in ("fx", "fy", "cx", "cy", "width", "height")}
            pose = np.array(record["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
            origins, directions = Camera(**options, camera_to_world=pose).rays()
            inverse = np.linalg.inv(matrix)
            o, d = (origins - shift) @ inverse.T, directions @ inverse.T
            a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - radius**2
            root = b * b - a * c
            truth = (-b - np.sqrt(np.maximum(root, 0.0))) / a
            steep = root > 0.3 * root.max()  # rays that meet the surface squarely
            assert steep.sum() > 60
            assert np.abs(depth - truth)[steep].max() < 1.5 * 2.0 / count
            assert np.median((depth - truth)[steep]) < 0.5 * 2.0 / count
            missed = root < -0.2 * root.max()
            assert missed.sum() > 80 and np.isinf(depth[missed]).all()
