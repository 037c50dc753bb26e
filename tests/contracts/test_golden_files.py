"""Files of every format and version that version 0.1.0 read or wrote: they are read alike, and written alike."""

import json
import re
import shutil

import golden_cases
import numpy as np
import pytest
from golden_cases import CASES, SAID, WRITTEN

import warpcage
from warpcage.studio.jobs.webdataset import read_shard, shard_path, shard_stage

EXPECTED = golden_cases.expected()

#: Numbers that come of logarithms, square roots and resampled pictures differ in their last bits between processors.
NEAR = {"rtol": 1e-5, "atol": 1e-6}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return golden_cases.laid_out(tmp_path_factory.mktemp("golden"))


@pytest.fixture
def copy(files, tmp_path):
    """All files in a folder that a test may change."""
    return shutil.copytree(files, tmp_path / "files")


def require_library(name):
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR")


#: Versions of formats whose edits have "fragments" where version 1 has "crumbs".
RENAMED = {"session": 3, "jobs": 4, "edits": 2}


def as_now(text):
    """What is read and written since keys have other names: the same otherwise."""
    now = text.replace('"crumbs"', '"fragments"')
    for name, version in RENAMED.items():
        if now != text:
            now = re.sub(rf'("format": "warpcage {name}",\s*"version": )1\b', rf"\g<1>{version}", now)
    return now


def unordered(text):
    """A text that is JSON with its keys in one order, which objects do not have; any other as it is."""
    try:
        return json.dumps(json.loads(text), sort_keys=True)
    except ValueError:
        return text


def require_alike(found, expected):
    """Words that are JSON are compared as such, their numbers as arrays are."""
    if isinstance(expected, dict):
        assert list(found) == list(expected)
        for key in expected:
            require_alike(found[key], expected[key])
    elif isinstance(expected, list):
        assert len(found) == len(expected)
        for one, two in zip(found, expected, strict=True):
            require_alike(one, two)
    elif isinstance(expected, float) and not isinstance(found, bool):
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)
    else:
        assert found == expected and type(found) is type(expected)


@pytest.mark.parametrize("name", CASES)
def test_files_are_read_as_they_were(name, files):
    require_library(name)
    found, expected = CASES[name].read(files / name), EXPECTED[name]
    assert set(found) == set(expected)
    for part, value in expected.items():
        if isinstance(value, str):
            assert unordered(found[part]) == unordered(as_now(value)), part
        else:
            np.testing.assert_allclose(np.asarray(found[part], np.float64), value, err_msg=part, **NEAR)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.write is not None])
def test_files_are_written_as_they_were(name, files, tmp_path):
    target = tmp_path / name
    CASES[name].write(files / name, target)
    found, expected = golden_cases.payload(target), golden_cases.payload(files / name)
    if name.endswith(("json", "jsonl")):  # what was given as lines is written with the keys that it has
        found, expected = as_now(found.decode()), as_now(expected.decode())
    assert found == expected


@pytest.mark.parametrize("words", SAID)
def test_the_command_line_says_the_same_of_them(words, files):
    require_library(words)
    found, expected = ([" ".join(line.split()) for line in text.splitlines()]
                       for text in (golden_cases.said(files, SAID[words]), EXPECTED["said"][words]))  # fmt: skip
    lines = iter(found)
    assert [line for line in expected if line not in lines] == []  # others may be between


@pytest.mark.parametrize("name", WRITTEN)
def test_the_command_line_writes_the_same(name, copy):
    """Edits are the same to the byte; numbers of cameras and poses to their last digits."""
    taken = {word for word in WRITTEN[name].split() if not word.startswith("@")}
    before = {}
    for path in sorted(copy.glob(f"{name.partition('.')[0]}.*")):
        if path.name not in taken and path.name not in CASES:
            before[path.name] = np.load(path) if path.suffix == ".npy" else as_now(path.read_text(encoding="utf-8"))
            path.unlink()
    assert name in before
    golden_cases.said(copy, WRITTEN[name], copy)
    for file, expected in before.items():
        if file.endswith(".npy"):
            np.testing.assert_allclose(np.load(copy / file), expected, rtol=1e-12, atol=1e-12)
            continue
        found = (copy / file).read_text(encoding="utf-8")
        if file.endswith(".edits.json"):
            assert found == expected
        elif file.endswith(".jsonl"):
            require_alike([*map(json.loads, found.splitlines())], [*map(json.loads, expected.splitlines())])
        else:
            require_alike(json.loads(found), json.loads(expected))


RUNS = {"jobs_v1": 9, "records": 4, "shards": 4}


def contents(folder):
    """The files of a folder that are the user's."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and ".warpcage" not in path.parts
    }


@pytest.mark.parametrize("name", RUNS)
def test_what_runs_have_made_is_kept(name, copy):
    """So the hashes of all items and inputs are those of then, and so is the manifest."""
    out = copy / f"run_{name}"
    before = contents(out)
    report = warpcage.run_jobs(copy / f"{name}.jsonl", out, device="cpu")
    assert (report.total, report.kept, report.made) == (RUNS[name], RUNS[name], 0) and report.complete
    assert contents(out) == before and "manifest.jsonl" in before


def test_an_item_whose_input_changed_is_made_again(copy):
    """The test above would pass too where nothing is ever compared."""
    path = copy / "rows.npy"
    rows = np.load(path)
    rows[1, 0] += 0.125
    np.save(path, rows)
    assert warpcage.run_jobs(copy / "records.jsonl", copy / "run_records", device="cpu").made == 2


def test_notes_of_a_run_that_was_killed_are_merged(copy):
    out = copy / "run_records"
    lines = (out / "manifest.jsonl").read_bytes().splitlines(keepends=True)
    (out / "manifest.jsonl").write_bytes(lines[0])
    notes = out / ".warpcage" / "notes"
    notes.mkdir(parents=True)
    begun = b'{"id":"%s","state":"started","lot":1}\n'
    text = b"".join(begun % json.loads(line)["id"].encode() + line for line in lines[1:])
    (notes / "worker-0.jsonl").write_bytes(text + b'{"id":"pose_1/cam')
    report = warpcage.run_jobs(copy / "records.jsonl", out, device="cpu")
    assert report.kept == 4 and sorted((out / "manifest.jsonl").read_bytes().splitlines(keepends=True)) == sorted(lines)


def test_shards_are_read_and_packed_as_they_were(copy):
    """What is loose and settled is packed to the same bytes."""
    out = copy / "run_shards"
    shards = [shard_path(out, number) for number in (0, 1)]
    records = [record for shard in shards for record in read_shard(shard)]
    assert [record["__key__"] for record in records] == [
        f"pose_{pose}/camera_{camera}" for pose in (0, 1) for camera in (0, 1)
    ]
    assert all(set(record) == {"__key__", "jpg", "depth.npy", "pose.npy", "json"} for record in records)
    packed = shards[0].read_bytes()
    shards[0].unlink()
    stage = shard_stage(out, 0)
    for record in records[:3]:
        for ending, data in record.items():
            if ending != "__key__":
                path = stage / f"{record['__key__']}.{ending}"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
    assert warpcage.run_jobs(copy / "shards.jsonl", out, device="cpu").kept == 4
    assert shards[0].read_bytes() == packed


def test_frames_of_a_film_are_kept(copy):
    """The note beside the frames says the same of the same options, and binds those with others."""
    folder = copy / "film_frames"
    before = contents(folder)
    said = golden_cases.said(copy, f"{golden_cases.FILM_WORDS} -o film_frames")
    assert "0 frames, 3 were there already" in said and contents(folder) == before
    with pytest.raises(AssertionError, match="holds frames of another film"):
        golden_cases.said(copy, f"{golden_cases.FILM_WORDS} -o film_frames --overlay")


def test_refined_cameras_go_to_their_pictures(copy):
    scene = warpcage.load_scene(copy / "scenes" / "blender")
    path = copy / "ours.cameras.json"
    cameras = [camera.moved(np.diag([1.0, 1, 1, 1]) + np.eye(4, k=3) * 0.5) for camera in scene.cameras]
    keys = [warpcage.CameraKey(camera, name=name) for camera, name in zip(cameras, scene.names, strict=True)]
    warpcage.CameraFile(keys[::-1]).save(path)
    found = warpcage.load_scene(copy / "scenes" / "blender", cameras=path)
    for camera, expected in zip(found.cameras, cameras, strict=True):
        np.testing.assert_allclose(camera.camera_to_world, expected.camera_to_world)


VERSIONED = "field_v1.npz poses.json cameras.json jobs_v1.jsonl session.session.json several.edits.json chosen.json"


@pytest.mark.parametrize("name", VERSIONED.split())
def test_files_of_later_versions_are_refused(name, copy):
    path = copy / name
    if name.endswith(".npz"):
        np.savez(path, **golden_cases.npz_arrays(path) | {"version": np.array(99)})
    else:
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace('"version": 1', '"version": 99', 1), encoding="utf-8")
    read = CASES[name].read if name in CASES else lambda path: golden_cases.said(path.parent, f"edits {name}")
    with pytest.raises((ValueError, AssertionError), match="version (is )?'?99"):
        read(path)


def test_an_early_session_has_the_usual_where_it_says_nothing(files):
    edit = json.loads(as_now(EXPECTED["session_early.session.json"]["document"]))["edits"][0]
    assert (edit["falloff"], edit["held"], edit["fragments"]) == (0.0, "cut", 0.0)
    assert files.joinpath("session_early.session.json").read_text(encoding="utf-8").count("falloff") == 0


def test_golden_files_are_small():
    sizes = {
        path: path.stat().st_size
        for path in golden_cases.DATA.rglob("*")
        if path.is_file() and "blender" not in str(path)
    }
    assert max(sizes.values()) < 100_000 and sum(sizes.values()) < 300_000
