"""The editor's session: gestures, undo and redo, and its file, whatever happens to it."""

import asyncio
import dataclasses
import errno
import json
import os
import pathlib
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

aiohttp = pytest.importorskip("aiohttp")

from editor_pages import BOX, WAIT, new_session, on_pages, pages, tiny_field
from runs import SUPPORT

from warpcage import VoxelField, edit
from warpcage.cage import poses
from warpcage.studio.editor import file_stamp, free_session_path, read_session, session_path, write_session
from warpcage.studio.editor import session as session_module

REST = BOX.vertices
ME, YOU = object(), object()


def labels(session):
    return [label for label, _ in session.history.undo_steps]


def posed(session, number=1):
    return session.document.edit(number).posed


def drag(session, *places, owner=ME, rest=False):
    session.begin_gesture(owner, 1, "move")
    for vertices in places:
        assert session.move(owner, 1, vertices, rest)
    session.end_gesture(owner)


def read(path):
    return read_session(path, tiny_field())


# -- Gestures and steps


def test_a_drag_is_one_step_and_one_that_moves_nothing_is_none():
    session = new_session()
    drag(session, REST * 1.1, REST * 1.2, REST * 1.3)
    drag(session, REST * 1.4, REST * 1.3)
    drag(session)
    assert labels(session) == ["move"] and session.undo() == "move"
    np.testing.assert_array_equal(posed(session), REST)


def test_a_cancelled_gesture_leaves_nothing_but_the_view():
    session = new_session()
    session.begin_gesture(ME, 1, "move")
    session.move(ME, 1, REST * 1.5)
    view = dataclasses.replace(session.document.view, fov=60.0)
    session.look(view)
    session.end_gesture(ME, cancel=True)
    np.testing.assert_array_equal(posed(session), REST)
    assert labels(session) == [] and session.document.view == view and not session.moving


def test_only_the_owner_goes_on_with_a_gesture_and_anything_else_ends_it():
    for other in (
        lambda one: one.run({"do": "select", "edit": 1, "mode": "face", "vertices": [1]}),
        lambda one: one.begin_gesture(YOU, 1, "mine"),
        lambda one: one.scrub(1.0),
        lambda one: one.change(lambda document: ("nothing", document)),
    ):
        session = new_session()
        session.begin_gesture(ME, 1, "move")
        assert session.move(ME, 1, REST * 1.1) and not session.move(YOU, 1, REST * 9)
        session.end_gesture(YOU)
        assert session.is_moved_by(ME)
        other(session)
        assert not session.move(ME, 1, REST * 2) and not session.move_preset(ME, {})
        np.testing.assert_array_equal(posed(session), REST * 1.1)
        assert labels(session)[0] == "move"


def test_sliders_keep_their_amounts_and_go_on_from_them():
    session = new_session()

    def slide(preset, amount, **way):
        session.begin_gesture(ME, 1, "preset", way.pop("chosen", None))
        session.move_preset(ME, {"preset": preset, "amount": 1, "axis": "z", "limits": [0, 1], **way})
        session.move_preset(ME, {"preset": preset, "amount": amount, "axis": "z", "limits": [0, 1], **way})
        session.end_gesture(ME)
        return session.section("edits")[0]["sliders"]

    def expected(*steps):
        vertices = REST
        for preset, amount, *axis in steps:
            vertices = getattr(poses, preset)(vertices, amount, axis=axis[0] if axis else "z")
        np.testing.assert_allclose(posed(session), vertices, atol=1e-12)

    slide("twist", 40.0)
    assert slide("stretch", 2.0)["amounts"] == {"twist": 40.0, "stretch": 2.0}
    expected(("twist", 40.0), ("stretch", 2.0))
    slide("twist", 60.0)  # the sum is 60, not 100, and what came after it still does
    expected(("twist", 60.0), ("stretch", 2.0))
    session.undo()
    assert session.section("edits")[0]["sliders"]["amounts"]["twist"] == 40.0
    assert slide("twist", 0.0)["amounts"] == {"twist": 0.0, "stretch": 2.0}
    expected(("stretch", 2.0))
    assert slide("twist", 30.0, axis=[0.0, 0.0, -1.0])["amounts"] == {
        "twist": 30.0
    }  # another way: from the pose as it is
    expected(("stretch", 2.0), ("twist", 30.0, "-z"))
    assert slide("stretch", 3.0, chosen=(0, 1, 6, 7))["vertices"] == (0, 1, 6, 7)
    session.begin_gesture(ME, 1, "move")
    session.move(ME, 1, REST * 1.5)
    session.end_gesture(ME)
    assert session.section("edits")[0]["sliders"] is None
    slide("twist", 90.0)
    np.testing.assert_allclose(posed(session), poses.twist(REST * 1.5, 90.0, axis="z"), atol=1e-12)


def test_undo_in_the_middle_of_a_drag_undoes_the_drag():
    session = new_session()
    session.begin_gesture(ME, 1, "move")
    session.move(ME, 1, REST * 1.1)
    assert session.undo() == "move" and not session.moving
    np.testing.assert_array_equal(posed(session), REST)
    assert session.redo() == "move"
    np.testing.assert_array_equal(posed(session), REST * 1.1)


def test_a_command_that_fails_changes_nothing():
    session = new_session()
    before = session.document
    calls = []
    session.listeners.append(calls.append)
    for message in ({"do": "edit.delete", "id": 5}, {"do": "pose.set", "edit": 1}, {"do": "timeline", "fps": 0}):
        with pytest.raises(ValueError):
            session.run(message)
    assert session.document is before and labels(session) == [] and calls == []


def test_what_changes_nothing_is_no_step_and_keeps_what_was_undone():
    session = new_session()
    drag(session, REST * 1.1)
    session.undo()
    for message in (
        {"do": "timeline", "fps": 24.0, "loop": "once"},
        {"do": "edit.change", "id": 1, "visible": True},
        {"do": "settings", "show": "rgb"},
        {"do": "pose.set", "edit": 1, "vertices": REST.tolist()},
        {"do": "edit.order", "ids": [1]},
        {"do": "select", "edit": 1, "mode": "vertex", "vertices": []},
    ):
        session.run(message)
    assert labels(session) == [] and session.redo() == "move"


def test_three_hundred_steps_go_back_and_forth():
    session, seen = new_session(), []
    rng = np.random.default_rng(0)
    for number in range(300):
        seen.append(session.document)
        kind = number % 6
        if kind < 3:
            drag(session, REST * rng.uniform(0.5, 1.5), rest=kind == 2)
        elif kind == 3:
            session.run({"do": "select", "edit": 1, "mode": "vertex", "vertices": [number % 8, (number // 6) % 8]})
        elif kind == 4:
            session.run({"do": "key.add", "time": number / 10, "pose": True, "camera": number % 4 == 0})
        else:
            session.run({"do": "settings", "resolution": 17 + number // 6})
    last = session.document
    assert len(session.history.undo_steps) == 300
    for document in reversed(seen):
        session.undo()
        assert session.document.next_id == last.next_id  # numbers are given once
        assert all(getattr(session.document, part) is getattr(document, part) for part in ("edits", "timeline"))
        assert session.document.selection == document.selection and session.document.settings == document.settings
    with pytest.raises(ValueError, match="nothing to undo"):
        session.undo()
    for _ in seen:
        session.redo()
    assert session.document.edits is last.edits and session.document.timeline is last.timeline
    with pytest.raises(ValueError, match="nothing to redo"):
        session.redo()


def test_scrubbing_loses_no_pose():
    session = new_session()
    session.run({"do": "key.add", "time": 0.0, "pose": True})
    session.scrub(2.0)
    drag(session, REST * 2)
    session.run({"do": "key.add", "time": 2.0, "pose": True})
    session.scrub(1.0)
    np.testing.assert_allclose(posed(session), REST * 1.5)
    steps = len(labels(session))
    for time in (0.5, 1.5, 2.0, 1.0):
        session.scrub(time)
    assert len(labels(session)) == steps
    assert not session.unkeyed and session.left_time is None
    drag(session, REST * 5)  # held by no key
    assert session.unkeyed and session.scrub(0.0)
    np.testing.assert_array_equal(posed(session), REST)
    assert not session.scrub(0.5)  # nothing more is left
    assert not session.unkeyed and session.left_time == 1.0
    assert session.undo() == "scrub"
    np.testing.assert_array_equal(posed(session), REST * 5)
    assert session.document.time == 1.0 and session.unkeyed and session.left_time is None
    session.redo()
    assert session.document.time == 0.5


def test_a_step_is_undone_at_the_time_that_it_was_made_at():
    session = new_session()
    session.run({"do": "key.add", "time": 0.0, "pose": True, "camera": True})
    session.scrub(2.0)
    drag(session, REST * 2)
    there = session.document.view
    session.run({"do": "key.add", "time": 2.0, "pose": True})
    session.scrub(3.0)
    session.look(dataclasses.replace(there, fov=20.0))
    session.undo()  # the key: a new one goes where the pose is from
    assert (session.document.time, session.document.view) == (2.0, there) and session.unkeyed
    session.look(dataclasses.replace(there, fov=20.0))
    session.undo()  # the drag: made at the same time, so looks around stay
    assert session.document.time == 2.0 and session.document.view.fov == 20.0


#: What makes a film of keys at 0, 1 and 4 s shorter, and its new end; the last key's number is that of "id".
SHORTER = [
    ({"do": "timeline", "length": 4.5}, 4.5),
    ({"do": "key.change", "time": 2.0}, 2.0),
    ({"do": "key.delete"}, 1.0),
]


@pytest.mark.parametrize(("command", "end"), SHORTER, ids=[command["do"] for command, _ in SHORTER])
def test_a_film_that_ends_before_the_head_takes_it_to_its_end(command, end):
    session = new_session()
    for time in (0.0, 1.0, 4.0):
        session.run({"do": "key.add", "time": time, "pose": True})
    if "length" in command:
        session.run({"do": "timeline", "length": 6.0})
    session.scrub(session.document.timeline.length)
    there = session.document.time
    session.run({"id": session.document.timeline.keys[-1].id, **command})
    assert session.document.time == session.document.timeline.length == end
    session.run({"do": "key.add", "time": session.document.time, "pose": True})
    assert session.document.timeline.length == end
    session.undo()
    session.undo()
    assert session.document.time == session.document.timeline.length == there


def test_a_length_that_is_typed_as_it_is_stays_where_keys_move():
    session = new_session()
    for time in (0.0, 2.0):
        session.run({"do": "key.add", "time": time, "pose": True})
    session.run({"do": "timeline", "length": 2.0})
    session.run({"do": "key.change", "id": session.document.timeline.keys[-1].id, "time": 1.0})
    assert session.document.timeline.length == 2.0


def test_keys_follow_a_cage_at_rest_when_its_drag_ends_by_another_command():
    session = new_session()
    session.run({"do": "key.add", "time": 0.0, "pose": True})
    session.begin_gesture(ME, 1, "move")
    session.move(ME, 1, REST + 0.25, rest=True)
    session.change(lambda document: ("nothing", document))
    np.testing.assert_allclose(session.document.timeline.keys[0].poses[1], REST + 0.25)


def test_a_document_from_another_thread_is_taken_only_where_nothing_changed_meanwhile():
    session = new_session()
    before = session.settled
    made = dataclasses.replace(before, edits=(dataclasses.replace(before.edits[0], name="Arm"),))
    session.begin_gesture(ME, 1, "move")
    session.move(ME, 1, REST * 1.1)
    assert session.settled is before and not session.adopt(before, "name", made)
    session.end_gesture()
    assert not session.adopt(before, "name", made) and labels(session) == ["move"]
    session.undo()
    session.look(dataclasses.replace(session.document.view, fov=70.0))
    assert session.adopt(before, "name", made)
    assert labels(session) == ["name"] and session.document.view.fov == 70.0


# -- The file


def test_a_session_comes_back_with_every_bit(tmp_path):
    path = tmp_path / "ball.session.json"
    session = new_session(path)
    assert session.unsaved
    drag(session, REST * 1.1)
    session.run({"do": "key.add", "time": 1.0, "pose": True, "camera": True})
    session.save()
    assert not session.unsaved and not session.unsaved_steps and session.saved and session.save_error is None
    assert json.dumps(read(path).to_json()) == json.dumps(session.document.to_json())
    drag(session, REST * 1.2)
    assert session.unsaved and session.unsaved_steps
    session.undo()
    assert not session.unsaved  # it is what the file holds
    assert sorted(os.listdir(tmp_path)) == [path.name]


def test_a_gesture_under_way_is_not_saved_and_what_was_before_it_is(tmp_path):
    path = tmp_path / "ball.session.json"
    session = new_session(path)
    drag(session, REST * 1.1)
    session.begin_gesture(ME, 1, "move")
    session.move(ME, 1, REST * 7, rest=True)
    assert session.unsaved
    session.save()
    np.testing.assert_array_equal(read(path).edits[0].posed, REST * 1.1)
    assert not session.unsaved
    session.end_gesture()
    assert session.unsaved


def full_disk(path, *_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def test_a_full_disk_while_saving_loses_nothing_and_is_reported(tmp_path, monkeypatch):
    path = tmp_path / "ball.session.json"
    session = new_session(path)
    session.save()
    good = path.read_bytes()
    drag(session, REST * 1.1)
    with monkeypatch.context() as patch:
        patch.setattr(pathlib.Path, "write_text", full_disk)
        session.save()
        assert session.save_error.startswith("no space left on device") and str(tmp_path) not in session.save_error
        assert path.read_bytes() == good and os.listdir(tmp_path) == [path.name] and session.unsaved
    session.save()
    assert session.save_error is None and not session.unsaved
    np.testing.assert_array_equal(read(path).edits[0].posed, REST * 1.1)


@pytest.fixture
def session(tmp_path, monkeypatch):
    """A session of a server that saves it at once."""
    monkeypatch.setattr("warpcage.studio.editor.server.SAVE_SECONDS", 0.01)
    return new_session(tmp_path / "ball.session.json")


@on_pages
async def test_pages_show_that_the_disk_is_full_and_that_it_is_not(host, page, session, monkeypatch):
    await page.until(lambda: page.sections["session"]["saved"])
    with monkeypatch.context() as patch:
        patch.setattr(pathlib.Path, "write_text", full_disk)
        await page.drag(REST * 1.1)
        await page.until(lambda: "no space left" in (page.sections["session"]["save_error"] or ""))
        await page.drag(REST * 1.2)
    await page.until(lambda: page.sections["session"]["save_error"] is None)
    np.testing.assert_array_equal(read(session.path).edits[0].posed, REST * 1.2)


def test_a_file_that_another_program_wrote_is_never_saved_over(tmp_path):
    path = tmp_path / "ball.session.json"
    session = new_session(path)
    session.save()
    path.write_text("theirs")
    drag(session, REST * 1.1)
    session.save()
    assert path.read_text() == "theirs" and session.save_error is None
    assert session.path == tmp_path / "ball.1.session.json"
    np.testing.assert_array_equal(read(session.path).edits[0].posed, REST * 1.1)
    drag(session, REST * 1.2)
    session.save()
    assert sorted(os.listdir(tmp_path)) == ["ball.1.session.json", "ball.session.json"]


def test_a_file_that_comes_before_the_first_save_is_not_replaced(tmp_path):
    path = tmp_path / "ball.session.json"
    session = new_session(path)
    path.write_text("theirs")
    session.save()
    assert path.read_text() == "theirs" and session.path.name == "ball.1.session.json"


def test_a_file_that_was_deleted_is_written_again(tmp_path):
    path = tmp_path / "kept" / "ball.session.json"
    session = new_session(path)
    session.save()
    path.unlink()
    path.parent.rmdir()
    drag(session, REST * 1.1)
    session.save()
    assert session.path == path and session.save_error is None
    np.testing.assert_array_equal(read(session.path).edits[0].posed, REST * 1.1)


@on_pages
async def test_pages_show_when_another_program_wrote_the_file(host, page, session):
    await page.until(lambda: page.sections["session"]["saved"])
    session.path.write_text("theirs")
    await page.drag(REST * 1.1)
    await page.until(lambda: page.sections["session"]["name"] == "ball.1.session.json")
    await page.until(lambda: page.notices)
    assert "ball.1.session.json" in page.notices[0] and len(page.notices) == 1


def test_several_threads_that_save_do_not_take_each_other_for_another_program(tmp_path, monkeypatch):
    path = tmp_path / "ball.session.json"
    session = new_session(path)
    write, inside = session_module.write_session, []

    def slow(*arguments):
        inside.append(1)
        assert len(inside) == 1
        write(*arguments)
        inside.pop()

    monkeypatch.setattr(session_module, "write_session", slow)
    threads = [threading.Thread(target=lambda: [session.save() for _ in range(10)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for number in range(50):
        drag(session, REST * (1 + number / 50))
    for thread in threads:
        thread.join(WAIT)
    session.save()
    assert os.listdir(tmp_path) == [path.name] and session.save_error is None
    np.testing.assert_array_equal(read(session.path).edits[0].posed, posed(session))


@on_pages
async def test_a_session_is_saved_while_its_film_plays(host, page, session):
    await page.do(do="key.add", time=0.0, pose=True)
    await page.do(do="key.add", time=1.0, camera=True)
    await page.do(do="timeline", loop="loop")
    await page.do(do="play", on=True)
    await page.do(do="settings", background="white")
    while not session.path.exists() or read(session.path).settings.background != "white":
        await asyncio.sleep(0.01)
    assert host.player.playing


DAMAGES = {
    "empty": lambda text: "",
    "cut": lambda text: text[: len(text) // 2],
    "no JSON": lambda text: "session",
    "a list": lambda text: "[]",
    "nested": lambda text: "[" * 100_000,
    "no text": lambda text: "\udcff\udcfe",
    "another format": lambda text: text.replace("warpcage session", "warpcage poses"),
    "a later version": lambda text: text.replace('"version": 3', '"version": 99'),
    "no version": lambda text: text.replace('"version": 3', '"version": true'),
    "another field": lambda text: text.replace('"bounds": [[-1', '"bounds": [[-2'),
    "no document": lambda text: text.replace('"document"', '"paper"'),
    "NaN": lambda text: text.replace('"fov": 40.0', '"fov": NaN'),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_or_foreign_session_is_one_line_with_its_name_and_stays(tmp_path, damage):
    path = tmp_path / "ball.session.json"
    write_session(path, new_session().document, tiny_field(), "ball.npz")
    broken = DAMAGES[damage](path.read_text()).encode(errors="surrogateescape")
    assert broken != path.read_bytes()
    path.write_bytes(broken)
    with pytest.raises(ValueError) as raised:
        edit(tiny_field(), session=path)
    assert str(path) in str(raised.value) and "\n" not in str(raised.value)
    assert path.read_bytes() == broken and os.listdir(tmp_path) == [path.name]


def test_names_of_sessions(tmp_path):
    assert session_path("a/lego.v2.npz") == pathlib.Path("a/lego.v2.session.json")
    path = tmp_path / "lego.v2.session.json"
    (tmp_path / "lego.v2.1.session.json").symlink_to("nowhere")
    assert free_session_path(path).name == "lego.v2.2.session.json"
    assert free_session_path(tmp_path / "kept.json").name == "kept.1.session.json"
    assert file_stamp(path) is None


# -- Killed


PROGRAM = """
import sys
sys.path.insert(0, sys.argv[1])
import warp
import warpcage
import editor_pages
import warpcage.studio.editor.server
warpcage.studio.editor.server.SAVE_SECONDS = 0.05
editor_pages.tiny_field().save(sys.argv[2] + "/ball.npz")
editor = warpcage.edit(sys.argv[2] + "/ball.npz", editor_pages.BOX)
print(editor.url, flush=True)
editor.wait()
"""


def test_a_killed_server_leaves_a_whole_session_that_goes_on(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, SUPPORT, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    path = tmp_path / "ball.session.json"

    async def work():
        lines = iter(process.stdout.readline, "")
        address = await asyncio.get_running_loop().run_in_executor(None, lambda: next(x for x in lines if "http" in x))
        async with pages(address.strip()) as (page,):
            for number in range(1, 6):
                await page.drag(REST * (1 + number / 10))
                await page.do(do="key.add", time=float(number), pose=True)
            while not path.exists() or len(read_session(path).timeline.keys) < 5:
                await asyncio.sleep(0.01)
            await page.do(do="drag.begin", edit=1)
            for number in range(200):
                await page.move(REST * (1 + number / 100))
            os.kill(process.pid, signal.SIGKILL)
            await page.ended()

    try:
        asyncio.run(asyncio.wait_for(work(), 2 * WAIT))
    finally:
        process.kill()
        process.wait(WAIT)
        process.stdout.close()
    field = VoxelField.load(tmp_path / "ball.npz")
    document = read_session(path, field)
    np.testing.assert_array_equal(document.edits[0].posed, REST * 1.5)
    assert len(document.timeline.keys) == 5
    with edit(tmp_path / "ball.npz") as editor:
        assert json.dumps(editor.document.to_json()) == json.dumps(document.to_json())
