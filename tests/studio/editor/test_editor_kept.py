"""What was keyed is never lost without a message: all commands of the page, and undo after the editor has ended."""

import asyncio
import base64
import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

aiohttp = pytest.importorskip("aiohttp")

from editor_browser import editor, until, window
from editor_commands import BALL, CAGE, EVERY, KEEPING, KEYS, LOSING, OF_EDIT, REST, ROUGH, key_all
from editor_pages import new_session, on_pages, pages, tiny_field

import warpcage
from warpcage import Cage, PoseFile, VoxelField, deform_points, edit
from warpcage.studio.editor import COMMANDS, History, frozen_vertices, losses, read_history, replace_cage
from warpcage.studio.editor import tasks as tasks_module
from warpcage.studio.editor.steps import history
from warpcage.studio.films.session import session_file

__all__ = ["editor", "window"]  # fixtures

BACK = "Undo brings that back."


@pytest.fixture
def session():
    return new_session(cages=(CAGE,))


def film(session):
    return json.dumps(session.document.to_json()["timeline"])


def spoken():
    """The names of commands in the scripts of the page."""
    scripts = (Path(warpcage.__file__).parent / "studio" / "editor" / "page").rglob("*.js")
    return {name for script in scripts for name in re.findall(r'\bdo: "([a-z.]+)"', script.read_text())}


@on_pages
async def test_no_command_of_the_page_loses_what_was_keyed_without_a_word(host, page, session, tmp_path, monkeypatch):
    monkeypatch.setattr(Cage, "from_field", lambda *_, **__: BALL)
    tiny_field().save(tmp_path / "arm.npz")
    CAGE.translate((0.1, 0.0, 0.0)).save(tmp_path / "same.obj")
    BALL.save(tmp_path / "ball.obj")
    poses = PoseFile(CAGE)
    poses["a"], poses["b"] = CAGE, CAGE.twist(30)
    poses.times.update({"a": 0.25, "b": 0.75})
    poses.save(tmp_path / "poses.json")
    assert {each["do"] for each in EVERY} == {"undo", "redo"} | set(COMMANDS) | set(host.tasks.commands) | spoken()
    await key_all(page)
    assert tuple(key.id for key in session.document.timeline.keys) == KEYS
    page.notices.clear()
    for messages, line in [*(([message], line) for message, line in LOSING), *((each, None) for each in KEEPING)]:
        before, whole, steps = session.document, film(session), len(session.history.undo_steps)
        for message in messages:
            await page.do(**message)
            if message["do"] == "drag.begin":
                await page.move(REST * 2)
        await page.until(lambda: all(job["state"] == "done" for job in host.jobs.section()))
        await page.do(do="seen", frame=0)  # what was sent before is here
        shown = [text for text in page.notices if text.endswith(BACK)]
        lost = losses(before, session.document)
        assert shown == ([] if line is None else [lost]), messages
        assert lost is None if line is None else lost.startswith(line), (messages, lost)
        for _ in range(len(session.history.undo_steps) - steps):
            await page.do(do="undo")
        assert film(session) == whole, messages
        page.notices.clear()
    await page.refused(do="timeline", length=0.5)  # a film does not end before its last key
    assert film(session) == whole


@pytest.mark.parametrize(
    ("cage", "warning"),
    [
        (CAGE.with_vertices(CAGE.vertices + 0.25), None),  # the same mesh elsewhere: poses keep their distance
        (Cage(CAGE.vertices[::-1], 25 - CAGE.faces), None),  # in another order
        (CAGE.subdivide(), None),
        (Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7), segments=6), None),  # finer
        (BALL, ROUGH.replace("poses of 2 keys", "pose of 1 key")),
    ],
)
def test_a_cage_in_place_of_another_keeps_poses_exactly_where_that_can_be(cage, warning):
    session, said = new_session(cages=(CAGE,)), []
    session.notify = said.append
    session.change(lambda document: ("pose", document.with_edit(posed_edit(document, CAGE.twist(40).vertices))))
    session.run({"do": "key.add", "time": 1.0, "pose": True})
    old = session.document.edits[0]
    session.change(lambda document: replace_cage(document, 1, cage, "load"))
    assert said == [] if warning is None else said[0].startswith(warning)
    new, pose = session.document.edits[0], session.document.timeline.keys[0].poses[1]
    np.testing.assert_array_equal(new.posed, pose)
    if warning is None:
        inside = 0.5 * old.rest
        offset = new.rest.mean(axis=0) - old.rest.mean(axis=0)
        moved = [
            deform_points(points, one.rest_cage, one.posed_cage, device="cpu")
            for points, one in ((inside, old), (inside + offset, new))
        ]
        np.testing.assert_allclose(moved[1] - offset, moved[0], atol=1e-5)
    session.undo()
    np.testing.assert_array_equal(session.document.timeline.keys[0].poses[1], old.posed)


def posed_edit(document, vertices):
    return dataclasses.replace(document.edits[0], posed=frozen_vertices(vertices))


ASKED = "document.querySelector('dialog').textContent"


#: Groups of the panel, buttons in them, and what their dialogs say before anything is lost, and pages after that.
DIALOGS = [
    ("cage", "#cage-simplify", "Its pose and those of 2 keys are carried over, roughly.", ROUGH),
    ("edits", "#edit-delete", '"Move 1" goes, and 2 keys lose their poses of it; undo brings them back.', OF_EDIT),
    ("keys", "#camera-move", "It replaces the cameras of 2 keys; undo brings them back.", "2 keys lose their cameras."),
    ("film", "#poses-load", "Poses of the file replace those that 2 keys hold", OF_EDIT),
    (
        "objects",
        "#object-remove",
        "its cages and its part of 2 keys go; undo brings them back.",
        "2 keys lose their poses",
    ),
]


def test_dialogs_say_what_keys_would_lose_and_undo_brings_it_back(window, editor):
    key, cage = {"do": "key.add", "pose": True, "camera": True}, editor.document.edits[0].rest_cage
    pose = {"do": "pose.set", "edit": 1, "vertices": cage.twist(50).vertices.tolist()}
    said(editor, {**key, "time": 0.0}, {"do": "time", "time": 1.0}, pose, {**key, "time": 1.0})
    poses, folder = PoseFile(cage), editor.session.path.parent
    poses["a"], poses.times["a"] = cage, 0.5
    poses.save(folder / "poses.json")
    BALL.save(folder / "ball.obj")
    window.wait("warpcage.store.sections.timeline.keys.length === 2")
    window.unfold("cage")
    for opener in ("#cage-generate", "#cage-load"):  # a keyed cage is not replaced unasked
        window.click(opener)
        window.wait("document.querySelector('#ask-edit')")
        assert window.get("document.querySelector('#ask-edit').selectedOptions[0].textContent") == "A new edit"
        assert "its pose and those of 2 keys are carried over" in window.get(ASKED)
        window.click("#dialog-cancel")
        window.wait("!document.querySelector('dialog')")
    for fold, opener, question, warning in DIALOGS:
        if fold == "objects":
            said(editor, {"do": "object.copy", "id": 0, "offset": [3, 0, 0]})
            window.wait("warpcage.store.sections.objects.length === 2")
        kept = film(editor.session)
        window.unfold(fold)
        window.click(opener)
        window.wait("document.querySelector('dialog')")
        assert question in window.get(ASKED)
        window.confirm()
        until(lambda: film(editor.session) != kept, "it is done")  # noqa: B023
        window.wait("document.querySelector('#toasts').textContent.includes(arguments[0])", "", warning)
        window.wait("warpcage.store.sections.history.undo_label !== 'add key 2'")
        window.press("Ctrl+Z")
        until(lambda: film(editor.session) == kept, "the keys are back")  # noqa: B023
        window.wait("warpcage.store.sections.history.redo === 1")


# -- Steps in the session's file


def said(editor, *messages):
    """What an editor answers to commands of a page, and what it sends this page."""

    async def talk():
        async with pages(editor.url, size=None) as (page,):
            return [await page.do(**message) for message in messages], page.notices

    return asyncio.run(talk())


def sized(size):
    return {"do": "pose.set", "edit": 1, "vertices": (REST * size).tolist(), "label": f"x{size}"}


UNDO = {"do": "undo"}


def worked(path):
    """A session of a field's file with work in it: two poses and a key, which is undone."""
    with edit(path, CAGE) as editor:
        said(editor, sized(1.1), sized(1.2), {"do": "key.add", "time": 1.0, "pose": True, "camera": True}, UNDO)
        return film(editor.session), editor.session.history


def ball(folder):
    tiny_field().save(folder / "ball.npz")
    return folder / "ball.npz"


def documents(steps):
    return [(label, json.dumps(document.to_json())) for label, document in steps]


def test_undo_goes_on_after_the_editor_has_ended(tmp_path):
    path = ball(tmp_path)
    _, steps = worked(path)
    with edit(path) as editor:
        session = editor.session
        assert session.lost is None and session.history.summary() == steps.summary()
        assert documents(session.history.undo_steps) == documents(steps.undo_steps)
        assert documents(session.history.redo_steps) == documents(steps.redo_steps)
        first, second = (document.edits[0] for _, document in session.history.undo_steps)
        assert first.rest is second.rest and first.faces is second.faces  # what steps share is there once
        assert said(editor, {"do": "redo"}) == (["add key 1"], []) and len(session.document.timeline.keys) == 1
        assert said(editor, UNDO, UNDO, UNDO) == (["add key 1", "x1.2", "x1.1"], [])
        np.testing.assert_array_equal(session.document.edits[0].posed, REST)
    with edit(path) as editor:
        assert (editor.session.history.summary()["undo"], editor.session.history.summary()["redo"]) == (0, 3)
    assert {one.name for one in tmp_path.iterdir()} <= {"ball.npz", "ball.session.json", ".ball.session.secret"}


def test_the_steps_that_a_file_keeps_are_bounded(tmp_path, monkeypatch):
    session = new_session(tmp_path / "ball.session.json", cages=(CAGE,))
    for number in range(80):  # the first half are keys, which take more room than there is, and are in the file anyway
        session.run({**sized(number + 2), "label": f"step {number}"})
        if number < 40:
            session.run({"do": "key.add", "time": number / 10, "pose": True})

    def saved():
        session.look(dataclasses.replace(session.document.view, fov=session.document.view.fov + 1))
        session.save()
        return json.loads(session.path.read_text())

    whole = len(json.dumps(saved()["history"]))
    monkeypatch.setattr(history, "MAX_BYTES", 20_000)
    content = saved()["history"]
    beside = json.dumps(History().to_json(session.document, session.fields))
    assert 30_000 < len(json.dumps(content)) < 80_000 < whole and json.loads(beside)["parts"] == []
    kept, lost = read_history(content, session.fields, None)
    assert 5 < len(kept.undo_steps) < 40 and lost is None
    assert documents(kept.undo_steps) == documents(session.history.undo_steps[-len(kept.undo_steps) :])  # the nearest
    assert len(session.history.undo_steps) == 120  # while the editor runs


#: Damaged steps, and those of a session of before steps were kept.
DAMAGES = {
    "none": None,
    "a text": lambda steps: "steps",
    "no fields": lambda steps: {**steps, "fields": None},
    "no parts": lambda steps: {name: value for name, value in steps.items() if name != "parts"},
    "too few parts": lambda steps: {**steps, "parts": steps["parts"][:3]},
    "a part of itself": lambda steps: {**steps, "undo": [["x", steps["undo"][0][1] | {"edits": [[]]}]]},
    "no base64": lambda steps: {**steps, "parts": [part if isinstance(part, dict) else "?" for part in steps["parts"]]},
    "not finite": lambda steps: {
        **steps,
        "parts": [
            part if isinstance(part, dict) else base64.b64encode(b"\xff" * len(base64.b64decode(part))).decode()
            for part in steps["parts"]
        ],
    },
    "a name that is none": lambda steps: {**steps, "undo": [[1, steps["undo"][0][1]]]},
    "a step without its document": lambda steps: {**steps, "undo": [["x"]]},
    "too many": lambda steps: {**steps, "undo": 501 * steps["undo"]},
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_session_with_damaged_steps_opens_and_says_so_once(tmp_path, damage):
    path = ball(tmp_path)
    kept, _ = worked(path)
    file = tmp_path / "ball.session.json"
    content = json.loads(file.read_text())
    steps, make = content.pop("history"), DAMAGES[damage]
    file.write_text(json.dumps(content | ({"history": make(steps)} if make else {})))
    with edit(path) as editor:
        assert film(editor.session) == kept and editor.session.history.summary()["undo"] == 0
        said = "The undo steps in the session's file are damaged and left out."
        assert editor.session.lost == (said if make else None)
    with edit(path) as editor:
        assert editor.session.lost is None


def dense_ball(side, path):
    VoxelField.from_dense(np.full((side,) * 3, 40.0), np.zeros((side,) * 3 + (9, 3)), [[-1] * 3, [1] * 3]).save(path)


@pytest.mark.parametrize("change", ["gone", "another"])
def test_steps_to_an_object_whose_file_is_another_by_now_are_left_out(tmp_path, change):
    path, arm = ball(tmp_path), tmp_path / "arm.npz"
    dense_ball(4, arm)
    kept = added_and_removed(path)
    arm.unlink()
    if change == "another":
        dense_ball(6, arm)
    with edit(path) as editor:
        session = editor.session
        shown = "3 undo steps are left out: arm.npz is gone or changed."
        assert said(editor, UNDO) == (["x2"], [shown]) and session.history.undo_steps == []
        assert said(editor) == ([], [])  # once
        assert film(session) == kept and [scene_object.file for scene_object in session.document.objects] == [None]


def added_and_removed(path):
    """The film of a session in which an object was added, and removed again, and a pose set after that."""
    with edit(path, CAGE) as editor:
        added = {"do": "object.add", "file": "arm.npz"}
        said(editor, sized(1.5), added, {"do": "object.remove", "id": 2}, sized(2))
        return film(editor.session)


@pytest.mark.parametrize(
    "act",
    [
        [{"do": "time", "time": 0.5}],
        [{"do": "play", "on": True}, {"do": "play", "on": False}],
        [{"do": "edit.add", "lower": [-0.5] * 3, "upper": [0.5] * 3},
         {"do": "select", "edit": 1, "mode": "face", "vertices": []}],
        [{"do": "export", "what": "cage", "file": "posed.obj"}],
        [{"do": "timeline", "length": 1.5}],
        [{"do": "object.copy", "id": 0}],
    ],
)  # fmt: skip
@on_pages
async def test_a_pose_that_no_key_holds_has_a_way_back_to_its_time_and_view(host, page, session, act):
    there = {"eye": [3, 3, 3], "target": [0, 0, 0], "up": [0, 0, 1], "fov": 50.0}
    await page.do(do="key.add", time=0.0, pose=True, camera=True)
    await page.do(do="time", time=1.0)
    await page.do(do="view", **there)
    await page.drag(REST * 2)
    steps = len(session.history.undo_steps)
    for message in act:
        await page.do(**message)
        if message.get("on"):
            await page.until(lambda: page.sections["playback"]["left"] == 1.0)
    if act[0]["do"] in ("time", "play"):
        (shown,) = page.notices
        assert shown == "No key holds the pose that was left at 1.00 s. Undo goes back to it."
    for _ in range(len(session.history.undo_steps) - steps):
        await page.do(do="undo")
    document = session.document
    np.testing.assert_array_equal(document.edits[0].posed, REST * 2)
    assert (document.time, list(document.view.eye), document.view.fov) == (1.0, there["eye"], 50.0)
    assert session.unkeyed


def test_a_look_around_keeps_what_was_undone():
    session = new_session(cages=(CAGE,))
    session.run({"do": "key.add", "time": 0.0, "pose": True})
    for size in (2.0, 3.0):
        session.run({"do": "pose.set", "edit": 1, "vertices": (REST * size).tolist()})
    session.undo()
    said = []
    session.notify = said.append
    session.scrub(1.0)  # leaves a pose that no key holds
    assert len(said) == 1 and session.redo() == "move"
    np.testing.assert_array_equal(session.document.edits[0].posed, REST * 3)
    assert [session.undo(), session.undo()] == ["move", "scrub"]
    np.testing.assert_array_equal(session.document.edits[0].posed, REST * 2)


# -- Files that a session wrote, after the editor has ended


async def finished(page):
    """Wait until no job runs; names, addresses and lines of all, the oldest first."""
    await page.until(lambda: all(job["state"] != "running" for job in page.sections["jobs"]))
    return [(job["name"], job["download"], job["result"]) for job in page.sections["jobs"]]


WRITTEN = [
    {"do": "export", "what": "cage", "file": "posed cage.obj", "edit": 1},
    {"do": "export", "what": "mp4", "file": "film.mp4", "width": 16, "height": 16},
    {"do": "export", "what": "png", "file": "frames", "width": 16, "height": 16},
    {"do": "poses.save", "file": "poses.json", "edit": 1},
    {"do": "stage.save", "file": "all.stage.json"},
]


def test_jobs_lists_what_a_session_wrote_after_the_editor_has_ended(tmp_path, monkeypatch):
    for module in (session_file, tasks_module):
        monkeypatch.setattr(module, "MAX_EXPORTS", 4)
    path = ball(tmp_path)

    async def write(page):
        await page.do(do="timeline", length=0.1)
        await page.do(do="key.add", time=0.0, pose=True)
        for message in (WRITTEN[1], *WRITTEN):
            await page.do(**message)
            shown = await finished(page)
        return shown

    def opened(work):
        with edit(path, None if path.with_name("ball.session.json").exists() else CAGE) as editor:

            async def talk():
                async with pages(editor.url, size=None) as (page,):
                    shown = await work(page)
                    got = {}
                    async with aiohttp.ClientSession() as http:
                        for name, download, _ in shown:
                            if download is not None:
                                async with http.get(editor.url + download) as answer:
                                    got[name] = answer.status, await answer.read()
                    return shown, got

            return asyncio.run(talk())

    before, _ = opened(write)
    session = tmp_path / "ball.session.json"
    shown, got = opened(finished)
    assert shown == before[-4:] and len(before) == 6  # one of each name, the newest four
    assert [name for name, download, _ in shown if download is None] == ["Write frames"]
    assert str(tmp_path / "frames") in {name: line for name, _, line in shown}["Write frames"]
    for name, answer in got.items():
        assert answer == (200, (tmp_path / name.removeprefix("Write ")).read_bytes())
    content = session.read_bytes()
    assert opened(finished)[0] == shown and session.read_bytes() == content  # a look changes nothing
    (tmp_path / "film.mp4").write_bytes(b"mine")  # another file by now
    (tmp_path / "poses.json").unlink()
    (tmp_path / "poses.json").symlink_to(path.parent.parent)
    assert [name for name, _, _ in opened(finished)[0]] == ["Write frames", "Write all.stage.json"]

    async def clear(page):
        (number,) = (job["id"] for job in page.sections["jobs"] if job["name"] == "Write frames")
        await page.do(do="job.clear", id=number)
        assert "is there already" in await page.refused(**WRITTEN[-1])  # of an earlier run: it is not replaced
        return []

    opened(clear)
    assert [name for name, _, _ in opened(finished)[0]] == ["Write all.stage.json"]
    (tmp_path / "all.stage.json").unlink()
    assert opened(finished)[0] == []


EXPORTS = [5, None, "no", [5], [{}], [{"name": 5, "text": "a", "size": 1, "time": 1}],
           [{"name": "../ball.npz", "text": "a", "size": None, "time": None}],
           [{"name": "ball.npz", "text": "a", "size": [], "time": {}}]]  # fmt: skip


@pytest.mark.parametrize("exports", EXPORTS)
def test_exports_of_a_file_that_make_no_sense_are_left_out(tmp_path, exports):
    path = ball(tmp_path)
    worked(path)
    session = tmp_path / "ball.session.json"
    content = json.loads(session.read_text())
    assert "exports" not in content  # nothing was exported
    session.write_text(json.dumps(content | {"exports": exports}))
    with edit(path) as editor:

        async def talk():
            async with pages(editor.url, size=None) as (page,):
                return page.sections["jobs"]

        assert asyncio.run(talk()) == []
