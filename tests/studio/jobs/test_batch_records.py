"""Records of frames: folders that load as scenes, shards that others read, whole or not at all."""

import errno
import io
import json
import tarfile

import numpy as np
import pytest
from messages import MESSAGES
from refusals import refused
from runs import write_files

from warpcage import Cage, CameraFile, RandomPoses, load_scene, run_jobs, turntable
from warpcage.studio.jobs import (
    Item,
    JobFile,
    Worker,
    finish_folder,
    pack_shard,
    read_shard,
    record_outputs,
    shard_holds,
    shard_path,
    shard_stage,
    split_key,
    staged_shards,
    write_jobs,
)
from warpcage.view import read_image

COMMON = {"field": "ball.npz", "cage": "cage.obj", "coordinates": "mean_value", "resolution": 24}
CAMERAS = turntable((0, 0, 0), 3.0, 20.0, 3, width=32, height=24)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = write_files(tmp_path_factory.mktemp("records"))
    CameraFile(CAMERAS).save(folder / "cameras.json")
    source = RandomPoses(Cage.load(folder / "cage.obj"), seed=1)
    np.save(folder / "poses.npy", np.stack([source.vertices(k) for k in range(2)]))
    return folder


def write_job(files, name, records, **defaults):
    items = [
        {"id": f"pose_{p}/camera_{c}", "posed": f"poses.npy#{p}", "camera": f"cameras.json#{c}", "extra": {"pose": p}}
        for p in range(2)
        for c in range(3)
    ]
    write_jobs(files / name, items, defaults=COMMON | defaults, records=records)
    return JobFile(files / name)


class Done:
    """A manifest of what a worker made."""

    def __init__(self):
        self.records = {}

    def find(self, item_id):
        return self.records.get(item_id)


def make(job, out, shard=None, wanted=lambda item: True):
    """Make a job in this process; returns its manifest."""
    manifest = Done()
    with Worker(job.folder, out, "cpu") as worker:
        for item in filter(wanted, job.items()):
            sizes = worker.run(item, None if shard is None else shard_stage(out, shard))
            manifest.records[item.id] = {"id": item.id, "state": "done", "outputs": sizes}
    return manifest


@pytest.fixture(scope="module")
def made(files, tmp_path_factory):
    """A job with records in a folder, its folder, and its manifest."""
    out = tmp_path_factory.mktemp("folder")
    with write_job(files, "folder.jsonl", {"kind": "folder"}, background="transparent") as job:
        manifest = make(job, out)
        finish_folder(out, job, manifest)
        yield job, out, manifest


def test_a_folder_of_records_loads_as_a_scene(files, made):
    _, out, _ = made
    scene = load_scene(out, split="all")
    assert len(scene.cameras) == 6 and scene.alphas is not None
    for number, camera in enumerate(scene.cameras):
        expected = CAMERAS[number % 3]
        np.testing.assert_allclose(camera.camera_to_world, expected.camera_to_world, atol=1e-12)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(
            (expected.fx, expected.fy, expected.cx, expected.cy)
        )
    picture = read_image(out / "pose_0/camera_1.png")
    white = picture[..., :3] * picture[..., 3:] + 1 - picture[..., 3:]
    np.testing.assert_allclose(scene.images[1], white, atol=1e-6)
    np.testing.assert_allclose(scene.alphas[1], read_image(out / "pose_0/camera_1.alpha.png")[..., 0], atol=1 / 255)


def test_the_pictures_of_each_pose_are_a_scene_of_their_own(made):
    _, out, _ = made
    for pose in range(2):
        folder = out / f"pose_{pose}"
        scene = load_scene(folder, split="all")
        assert len(scene.cameras) == 3
        frames = json.loads((folder / "transforms.json").read_text())["frames"]
        assert [frame["extra"] for frame in frames] == [{"pose": pose}] * 3
        assert [frame["posed"] for frame in frames] == [[f"poses.npy#{pose}"]] * 3
        for frame in frames:
            for word in ("file_path", "depth_path", "alpha_path", "pose_path", "record_path"):
                assert (folder / frame[word]).is_file()


def test_a_record_holds_depth_alpha_pose_and_camera(files, made):
    _, out, _ = made
    stem = out / "pose_1/camera_2"
    record = json.loads(stem.with_suffix(".json").read_text())
    poses, rest = np.load(files / "poses.npy"), Cage.load(files / "cage.obj")
    assert np.array_equal(np.load(f"{stem}.pose.npy"), poses[1])
    assert record["id"] == "pose_1/camera_2" and record["extra"] == {"pose": 1}
    assert record["edits"] == [{"cage": "cage.obj", "posed": "poses.npy#1", "pose_vertices": len(rest.vertices)}]
    assert record["camera"]["camera_to_world"] == CAMERAS[2].camera_to_world.tolist()
    np.testing.assert_array_equal(
        np.array(record["transform_matrix"]) @ np.diag([1, -1, -1, 1]), CAMERAS[2].camera_to_world
    )
    depth, alpha = np.load(f"{stem}.depth.npy"), read_image(f"{stem}.alpha.png")[..., 0]
    assert depth.dtype == np.float32 and depth.shape == alpha.shape == (24, 32)
    assert np.isinf(depth[0, 0]) and alpha[0, 0] == 0.0
    assert alpha[12, 16] > 0.99 and 2.0 < depth[12, 16] < 3.0


def test_items_that_are_not_done_are_left_out_and_none_leave_no_file(files, made, tmp_path):
    job, out, manifest = made
    some = Done()
    some.records = {name: record for name, record in manifest.records.items() if name.endswith("camera_0")}
    some.records["pose_1/camera_0"] = {"state": "failed"}
    try:
        assert finish_folder(out, job, some) == [out / "transforms.json", out / "pose_0/transforms.json"]
        frames = json.loads((out / "transforms.json").read_text())["frames"]
        assert [frame["id"] for frame in frames] == ["pose_0/camera_0"]
        assert finish_folder(tmp_path, job, Done()) == [] and list(tmp_path.iterdir()) == []
    finally:
        finish_folder(out, job, manifest)


# -- shards


@pytest.fixture
def shard(files, tmp_path):
    """A packed shard of JPEGs: its job, folder and manifest."""
    with write_job(files, f"{tmp_path.name}.jsonl", {"kind": "webdataset", "image": "jpg"}, background="white") as job:
        manifest = make(job, tmp_path, shard=0)
        assert staged_shards(tmp_path) == [0]
        assert pack_shard(tmp_path, 0, list(manifest.records.values())) == tmp_path / "shard-000000.tar"
        yield job, tmp_path, manifest


def test_a_shard_holds_what_the_folder_holds(made, shard):
    _, folder, _ = made
    _, out, manifest = shard
    assert staged_shards(out) == [] and sorted(path.name for path in out.iterdir()) == [".warpcage", "shard-000000.tar"]
    with tarfile.open(shard_path(out, 0)) as tar:
        names = tar.getnames()
        assert len(names) == 30 and names[:5] == [
            f"pose_0/camera_0{ending}" for ending in (".jpg", ".alpha.png", ".depth.npy", ".json", ".pose.npy")
        ]
        assert all(member.isreg() and member.mtime == 0 and member.uid == 0 for member in tar)
        for name in names:
            assert manifest.records[split_key(name)[0]]["outputs"][name] == tar.getmember(name).size
            if name.endswith((".npy", ".alpha.png")):
                assert tar.extractfile(name).read() == (folder / name).read_bytes()
    records = list(read_shard(shard_path(out, 0)))
    assert [record["__key__"] for record in records] == list(manifest.records)
    assert json.loads(records[4]["json"])["camera"]["width"] == 32
    assert np.load(io.BytesIO(records[4]["pose.npy"])).shape == (26, 3)


def test_the_webdataset_package_reads_a_shard(files, shard):
    webdataset = pytest.importorskip("webdataset")
    _, out, manifest = shard
    data = webdataset.WebDataset(str(shard_path(out, 0)), shardshuffle=False, empty_check=False)
    samples = list(data.decode("rgb").to_tuple("__key__", "jpg", "depth.npy", "alpha.png", "pose.npy", "json"))
    assert [sample[0] for sample in samples] == list(manifest.records)
    poses = np.load(files / "poses.npy")
    for key, picture, depth, alpha, pose, record in samples:
        assert picture.shape == (24, 32, 3) and depth.shape == (24, 32) and alpha.shape[:2] == (24, 32)
        assert np.array_equal(pose, poses[record["extra"]["pose"]])
        assert record["id"] == key
        assert picture[0, 0].min() > 0.95  # white, but for the JPEG's rounding


def test_shards_warn_that_they_go(files, tmp_path):
    with pytest.warns(UserWarning, match="records go with warpcage 0.4: pack"):
        write_job(files, f"{tmp_path.name}.jsonl", {"kind": "webdataset"}).close()
    with pytest.warns(UserWarning, match="WebDataset records go"):
        run_jobs(files / f"{tmp_path.name}.jsonl", tmp_path, device="cpu")


def test_packing_again_changes_no_byte_and_adds_what_failed_before(files, shard):
    job, out, manifest = shard
    whole = shard_path(out, 0).read_bytes()
    failed = "pose_0/camera_2"
    without = [record for name, record in manifest.records.items() if name != failed]
    pack_shard(out, 0, without)
    assert failed not in [record["__key__"] for record in read_shard(shard_path(out, 0))]
    assert not shard_holds(out, 0, manifest.records[failed]["outputs"])
    assert all(shard_holds(out, 0, record["outputs"]) for record in without)
    again = make(job, out, shard=0, wanted=lambda item: item.id == failed)
    assert shard_holds(out, 0, again.records[failed]["outputs"])  # loose
    pack_shard(out, 0, list((manifest.records | again.records).values()))
    assert shard_path(out, 0).read_bytes() == whole


def test_what_is_made_anew_replaces_what_was_packed(files, shard):
    _job, out, manifest = shard
    name = "pose_1/camera_0"
    loose = shard_stage(out, 0) / f"{name}.jpg"
    loose.parent.mkdir(parents=True)
    loose.write_bytes(b"another picture")
    record = manifest.records[name]
    changed = record | {"outputs": record["outputs"] | {f"{name}.jpg": len(b"another picture")}}
    assert shard_holds(out, 0, changed["outputs"]) and not shard_holds(out, 0, record["outputs"])
    pack_shard(out, 0, list((manifest.records | {name: changed}).values()))
    found = {record["__key__"]: record for record in read_shard(shard_path(out, 0))}
    assert found[name]["jpg"] == b"another picture" and len(found) == 6 and "depth.npy" in found[name]


def test_a_shard_that_cannot_be_written_stays_as_it_was(shard, monkeypatch):
    _job, out, manifest = shard
    whole, records = shard_path(out, 0).read_bytes(), list(manifest.records.values())
    loose = shard_stage(out, 0) / "pose_0/camera_0.jpg"
    loose.parent.mkdir(parents=True)
    loose.write_bytes(b"new")
    missing = {"id": "x", "outputs": {"x.jpg": 3}}
    refused(lambda: pack_shard(out, 0, [*records, missing]), match=r"'x.jpg' is not there", error=FileNotFoundError)
    written = 0

    def full(self, info, file=None):
        nonlocal written
        written += info.size
        if written > 4000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(self, info, file)

    real = tarfile.TarFile.addfile
    monkeypatch.setattr(tarfile.TarFile, "addfile", full)
    refused(lambda: pack_shard(out, 0, records), match="No space left", error=OSError)
    assert shard_path(out, 0).read_bytes() == whole and loose.read_bytes() == b"new" and staged_shards(out) == [0]
    assert sorted(path.name for path in out.iterdir()) == [".warpcage", "shard-000000.tar"]


def test_a_shard_of_nothing_is_no_file(tmp_path):
    assert pack_shard(tmp_path, 7, []) is None and not shard_path(tmp_path, 7).exists()
    assert not shard_holds(tmp_path, 7, {"a.png": 3}) and not shard_holds(tmp_path, 7, {})


# -- headers


def test_outputs_follow_from_the_header():
    assert record_outputs({"kind": "folder", "image": "jpg", "depth": False, "alpha": False}) == {
        "rgb": "{id}.jpg",
        "pose": "{id}.pose.npy",
        "record": "{id}.json",
    }


@pytest.mark.parametrize(
    "line, records, message",
    [
        ({"outputs": {"rgb": "a.png"}}, {"kind": "folder"}, "leave 'outputs' out"),
        ({"kind": "fit", "scene": "scene", "output": "a.npz"}, {"kind": "folder"}, "'records' are of frames"),
        ({"id": "a/transforms"}, {"kind": "folder"}, "has a transforms.json of its own"),
        ({"id": "a.b"}, {"kind": "webdataset"}, MESSAGES["batch.dots_in_names"]),
        ({}, {"kind": "webdataset", "image": "jpg"}, "a JPEG has no opacity"),
    ],
)
def test_items_that_are_no_records_are_refused(files, tmp_path, line, records, message):
    usual = {"field": "ball.npz", "camera": "cameras.json#0", "background": "transparent"}
    entry = {"id": "frame"} | line
    defaults = {} if entry.get("kind") else usual
    refused(lambda: write_jobs(tmp_path / "job.jsonl", [entry], defaults=defaults, records=records), match=message)
    lines = [{"format": "warpcage jobs", "version": 1, "defaults": defaults, "records": records}, entry]
    (tmp_path / "job.jsonl").write_text("".join(json.dumps(each) + "\n" for each in lines))
    with JobFile(tmp_path / "job.jsonl") as job, pytest.raises(ValueError, match=f"line 2.*{message}"):
        job.item(0)


def test_a_header_with_records_and_outputs_is_refused(tmp_path):
    header = {"format": "warpcage jobs", "version": 1, "defaults": {"outputs": {"rgb": "{id}.png"}}}
    (tmp_path / "job.jsonl").write_text(json.dumps(header | {"records": {"kind": "folder"}}) + "\n")
    refused(lambda: JobFile(tmp_path / "job.jsonl"), match="line 1: 'records' say what is written")


def test_items_of_a_job_with_records_can_be_written_into_another(files, made, tmp_path):
    job, _, _ = made
    items = list(job.items())
    assert write_jobs(tmp_path / "again.jsonl", items, records={"kind": "folder"}) == 6
    with JobFile(tmp_path / "again.jsonl") as again:
        assert [item.to_json() for item in again.items()] == [item.to_json() for item in items]
    assert isinstance(items[0], Item)
