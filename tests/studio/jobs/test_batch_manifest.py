"""The manifest: each item once, whatever was killed when, and also after a disk was full."""

import json
import subprocess
import sys

import numpy as np
import pytest

from warpcage.studio.jobs import Manifest, id_key, merge_notes, notes_of_chunk


def record(name, state="done", **options):
    return {"id": name, "state": state} | options


def write(path, *records, torn=""):
    path.write_text("".join(json.dumps(each) + "\n" for each in records) + torn, encoding="utf-8")


def read(path):
    return {each["id"]: each for each in Manifest(path)} if path.exists() else {}


def test_notes_replace_what_the_manifest_said(tmp_path):
    manifest = tmp_path / "manifest.jsonl"
    write(manifest, record("a", inputs="old"), record("b", inputs="old"), record("c", inputs="old"), record("ü/d"))
    one = [record("a", "started", lot=1), record("a", inputs="new"), record("c", "started", lot=1)]
    two = [
        record("b", "started", lot=2),
        record("b", "error"),
        record("e", "started"),
        record("e", "failed", error="x"),
    ]
    write(tmp_path / "one.jsonl", *one, torn='{"id": "c", "state": "do')
    write(tmp_path / "two.jsonl", *two, torn=json.dumps(record("f", seconds=1)))  # 1, or the start of 17.5
    merge_notes(manifest, [tmp_path / "one.jsonl", tmp_path / "two.jsonl"])
    found = read(manifest)
    # b may be tried again and c was being made: what their files hold is unknown
    assert {name: each["state"] for name, each in found.items()} == {"ü/d": "done", "a": "done", "e": "failed"}
    assert found["a"]["inputs"] == "new" and len(manifest.read_text(encoding="utf-8").splitlines()) == 3
    assert not list(tmp_path.glob("*o*.jsonl")) or [each.name for each in tmp_path.iterdir()] == ["manifest.jsonl"]


def test_the_best_of_several_notes_counts(tmp_path):
    """A node that was thought dead may have made an item that another made too; errors end in one or the other."""
    states = ["error", "started", "done", "started", "failed", "error"]
    for number, state in enumerate(states):
        write(tmp_path / f"{number}.jsonl", record("a", "started"), record("a", state, worker=number))
    merge_notes(tmp_path / "manifest.jsonl", tmp_path.glob("?.jsonl"))
    assert [each["worker"] for each in Manifest(tmp_path / "manifest.jsonl")] == [2]


def test_merged_twice_it_is_the_same(tmp_path):
    """A kill between the new manifest and the end of the notes."""
    notes, manifest = tmp_path / "one.jsonl", tmp_path / "manifest.jsonl"
    write(manifest, record("a"), record("b"))
    write(notes, record("b", "started"), record("b", seconds=2), record("c", "started"), record("c"))
    kept = notes.read_bytes()
    merge_notes(manifest, [notes])
    once = manifest.read_bytes()
    notes.write_bytes(kept)
    merge_notes(manifest, [notes])
    assert sorted(manifest.read_bytes().splitlines()) == sorted(once.splitlines()) and not notes.exists()


def test_a_manifest_that_cannot_be_written_loses_no_notes(tmp_path):
    resource = pytest.importorskip("resource")
    assert resource
    manifest, notes = tmp_path / "manifest.jsonl", tmp_path / "one.jsonl"
    write(manifest, *(record(f"a{number}") for number in range(50)))
    write(notes, *(record(f"b{number}") for number in range(100)))
    before = manifest.read_bytes(), notes.read_bytes()
    program = (
        "import resource, signal, sys\n"
        "from warpcage.studio.jobs.manifest import merge_notes\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({len(before[0]) + 500},) * 2)\n"
        "try: merge_notes(sys.argv[1], [sys.argv[2]])\n"
        "except OSError as error: sys.exit(7)\n"
    )
    done = subprocess.run([sys.executable, "-c", program, str(manifest), str(notes)])
    assert done.returncode == 7 and (manifest.read_bytes(), notes.read_bytes()) == before
    assert len(list(tmp_path.iterdir())) == 2
    merge_notes(manifest, [notes])
    assert len(read(manifest)) == 150


def test_damaged_lines_are_left_out(tmp_path):
    manifest = tmp_path / "manifest.jsonl"
    good = json.dumps(record("a"))
    lines = [
        b"\0" * 20,
        b"\xff\xfe",
        b"[1]",
        b'{"id": 3, "state": "done"}',
        b'{"id": "b"}',
        b'{"id": "c", "state": "x"}',
    ]
    manifest.write_bytes(b"\n".join([*lines, good.encode(), good[:-3].encode()]))
    assert [each["id"] for each in Manifest(manifest)] == ["a"]


def test_a_record_is_found_by_its_id(tmp_path):
    names = [f"frame_{number:05d}" for number in range(1000)] + ["ä/ß", "a" * 200]
    write(tmp_path / "manifest.jsonl", *(record(name, place=place) for place, name in enumerate(names)))
    manifest = Manifest(tmp_path / "manifest.jsonl")
    assert [manifest.find(name)["place"] for name in names] == list(range(len(names)))
    assert manifest.find("frame_1") is None and len(manifest) == len(names)
    assert (np.diff(manifest.keys) > 0).all() and manifest.keys[0] >= 0
    manifest.close()
    assert len(Manifest(tmp_path / "none.jsonl")) == 0 and Manifest(tmp_path / "none.jsonl").find("a") is None


def test_two_ids_with_one_key_are_distinguished(tmp_path, monkeypatch):
    monkeypatch.setattr("warpcage.studio.jobs.manifest.id_key", lambda name: 5)
    write(tmp_path / "manifest.jsonl", record("a"), record("b", seconds=3))
    assert Manifest(tmp_path / "manifest.jsonl").find("b")["seconds"] == 3
    assert id_key("a") != id_key("b")


def test_what_a_dead_worker_left_of_a_chunk(tmp_path):
    path = tmp_path / "notes.jsonl"
    chunks = [record("a", "started", lot=1), record("a"), record("b", "started", lot=2), record("c", "started", lot=2)]
    write(path, *chunks, record("b", "error"), record("d", "started", lot=2), torn='{"id":"c","st')
    settled, begun = notes_of_chunk(path, 2)
    assert [(each["id"], each["state"]) for each in settled] == [("b", "error")] and begun == ["c", "d"]
    assert notes_of_chunk(path, 3) == ([], []) and notes_of_chunk(tmp_path / "none", 1) == ([], [])


def test_a_line_that_does_not_fit_is_taken_away_again(tmp_path):
    program = (
        "import resource, signal, sys\n"
        "from warpcage.studio.jobs.manifest import Notes\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "notes = Notes(sys.argv[1])\n"
        "notes.append({'id': 'a', 'state': 'done'})\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (60,) * 2)\n"
        "try: notes.append({'id': 'b', 'state': 'done', 'long': 'x' * 100})\n"
        "except OSError as error: print(error)\n"
        "notes.append({'id': 'c', 'state': 'done'})\n"
    )
    pytest.importorskip("resource")
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path / "a")], capture_output=True, text=True)
    assert done.returncode == 0 and "No space left" in done.stdout, done.stderr
    assert [json.loads(line)["id"] for line in (tmp_path / "a").read_text().splitlines()] == ["a", "c"]
