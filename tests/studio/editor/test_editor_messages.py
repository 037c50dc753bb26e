"""What pages may say to the editor's server: nonsense, wrong values, fuzz; and what is left of it: nothing."""

import contextlib
import json
import struct

import numpy as np
import pytest

aiohttp = pytest.importorskip("aiohttp")
pytest.importorskip("hypothesis")

from editor_pages import BOX, on_pages, packed, with_pages
from editor_pages import nothing_logged as _nothing_logged  # noqa: F401 (a fixture for all tests)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from warpcage import Cage
from warpcage.studio.editor import COMMANDS, Document, server
from warpcage.studio.editor.web import clients

REST = BOX.vertices


# -- Messages


NONSENSE = ["", "{", "null", "[]", "7", '"do"', "{}", '{"do": 1}', '{"do": null}', '{"do": ["undo"]}', "NaN",
            '{"do": "undo", "n": true}', '{"do": "undo", "n": 1.5}', '{"do": "undo", "n": "1"}',
            '{"do": "undo", "n": -1}',
            '{"do": "undo", "n": 1e999}', '{"do": "time", "time": NaN}', '{"do": "time", "time": -Infinity}',
            "[" * 100_000, '{"do": "undo", "n": ' + "9" * 5000 + "}", '{"do": "\\ud800"}']  # fmt: skip

BROKEN = [b"", b"\2", struct.pack("<4I", 2, 1, 1, 8), struct.pack("<4I", 2, 1, 1, 2**32 - 1), packed(REST, kind=7),
          packed(REST)[:-1], packed(REST) + b"\0" * 8, packed(REST, kind=10), b"\xff" * 16, bytes(1000)]  # fmt: skip


@on_pages
async def test_messages_that_make_no_sense_are_refused_and_change_nothing(host, page):
    before = host.session.document
    for text in NONSENSE:
        await page.socket.send_str(text)
    await page.until(lambda: len(page.notices) == len(NONSENSE))
    for data in BROKEN:
        await page.socket.send_bytes(data)
    await page.until(lambda: len(page.notices) == len(NONSENSE) + len(BROKEN))
    assert all("\n" not in text and len(text) < 600 for text in page.notices)
    assert await page.refused(do="undo") == "there is nothing to undo"
    assert host.session.document is before and page.replies.keys() == {1, 2}  # the first is that of `size`


@on_pages
async def test_a_page_that_makes_no_sense_for_long_is_let_go(host, page, other):
    for _ in range(clients.MAX_MISTAKES):
        await page.socket.send_bytes(b"x")
    assert await page.ended() == aiohttp.WSCloseCode.POLICY_VIOLATION
    await other.until(lambda: other.sections["session"]["pages"] == 1)
    for _ in range(2 * clients.MAX_MISTAKES):  # what a user may do in vain is no nonsense
        await other.refused(do="undo")
    await other.socket.send_bytes(b"x")
    await other.do(do="select", edit=1, mode="vertex", vertices=[1])


@on_pages
async def test_a_message_that_is_too_large_ends_its_page_alone(host, page, other):
    with contextlib.suppress(ConnectionError):
        await page.socket.send_bytes(bytes(server.MAX_MESSAGE + 1))
    await page.ended()
    await other.until(lambda: other.sections["session"]["pages"] == 1)
    await other.drag(REST * 1.1)
    np.testing.assert_array_equal(host.session.document.edits[0].posed, REST * 1.1)


ODD = [None, True, False, 0, -1, 1.5, 10**30, 2**63, 1e308, -1e308, "", "x", "\ud800", "\0", "x" * 2000, [],
       [None], [[1]],
       [1, 2, 3], [1e308] * 3, [True] * 8, {}, {"a": 1}, [[1e308] * 3] * 8, [["1", "2", "3"]] * 8,
       [[True] * 3] * 8]  # fmt: skip

GOOD = [
    {"do": "size", "width": 24, "height": 16},
    {"do": "seen", "frame": 1},
    {"do": "view", "eye": [3, 1, 1], "target": [0, 0, 0], "up": [0, 0, 1], "fov": 40, "seq": 1, "moving": False},
    {"do": "drag.begin", "edit": 1, "label": "move", "rest": False},
    {"do": "pose.set", "edit": 1, "vertices": (REST * 1.1).tolist(), "label": "move"},
    {"do": "pose.reset", "edit": 1, "vertices": [0, 1]},
    {"do": "preset.begin", "edit": 1, "vertices": [0, 1, 2]},
    {"do": "preset.set", "preset": "bend", "amount": 10, "axis": "x", "towards": "z", "limits": [0, 1]},
    {"do": "preset.end", "cancel": False},
    {"do": "select", "edit": 1, "mode": "vertex", "vertices": [0, 1]},
    {"do": "edit.add", "kind": "copy", "shape": "box", "lower": [-0.5] * 3, "upper": [0.5] * 3},
    {"do": "edit.add", "shape": "box", "segments": 1, "axes": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "lower": [-0.5] * 3,
     "upper": [0.5] * 3},
    {"do": "edit.change", "id": 1, "name": "Arm", "kind": "copy", "visible": True},
    {"do": "edit.order", "ids": [1]},
    {"do": "cage.generate", "edit": 1, "count": 8, "margin": None, "method": "auto", "symmetry": None,
     "click": {"across": 0.5, "down": 0.5, "aspect": 1.5, "plane": "ground"}},
    {"do": "cage.generate", "edit": 1, "count": 8, "click": {"places": [[0.5, 0.5]], "aspect": 1.5, "plane": "none"}},
    {"do": "cage.subdivide", "edit": 1},
    {"do": "cage.simplify", "edit": 1, "count": 8},
    {"do": "cage.box", "edit": 1, "vertices": [0, 7], "margin": 0.1},
    {"do": "cage.mirror", "edit": 1, "axis": "x", "place": 0.5},
    {"do": "cage.load", "file": "no.obj", "edit": None, "up": "z"},
    {"do": "pose.load", "file": "no.obj", "edit": 1, "up": "z"},
    {"do": "settings", "coordinates": "green", "resolution": 16, "density": "paper", "background": "#102030",
     "supersampling": 2, "show": "masks", "mode": "rest"},
    {"do": "key.add", "time": 1.0, "pose": True, "camera": True, "name": "one"},
    {"do": "key.change", "id": 2, "time": 0.5, "easing": "linear", "name": "two", "pose": True, "camera": True},
    {"do": "key.change", "id": 2, "easing": {"bezier": [0.2, -0.5, 0.9, 1.5]}},
    {"do": "camera.move", "move": "turn:90"},
    {"do": "camera.frame", "aspect": 1.5},
    {"do": "camera.outside", "aspect": 1.5},
    {"do": "key.delete", "id": 2},
    {"do": "timeline", "length": 2.0, "fps": 25.0, "loop": "loop"},
    {"do": "time", "time": 0.5},
    {"do": "play", "on": False},
    {"do": "poses.load", "file": "no.json"},
    {"do": "poses.save", "file": "no.txt"},
    {"do": "files"},
    {"do": "export", "what": "mp4", "file": "no.txt", "width": 16, "height": 16, "overlay": True, "transparent": False,
     "edit": 1, "rest": False},
    {"do": "export.command", "file": "film.mp4", "width": 16, "height": 16},
    {"do": "job.cancel", "id": 1},
    {"do": "job.clear", "id": 1},
    {"do": "object.files"},
    {"do": "object.add", "file": "no.npz", "name": "one", "beside": True, "place": {}},
    {"do": "object.copy", "id": 0, "offset": [1, 0, 0]},
    {"do": "object.change", "id": 0, "name": "Ball", "visible": True, "locked": False,
     "place": {"position": [0, 0, 1], "turn": [0, 90, 0], "scale": 2}},
    {"do": "object.pick", "across": 0.5, "down": 0.5, "aspect": 1.5},
    {"do": "place.begin", "object": 0, "label": "move"},
    {"do": "place.set", "object": 0, "matrix": np.eye(4).tolist(), "seq": 2},
    {"do": "place.end", "cancel": False},
    {"do": "object.select", "id": 0},
    {"do": "stage.save", "file": "no.json"},
    {"do": "object.remove", "id": 9},
    {"do": "undo"},
    {"do": "redo"},
    {"do": "edit.delete", "id": 7},
    {"do": "drag.end", "edit": 1, "cancel": False},
    {"do": "nothing"},
]  # fmt: skip


def test_every_command_is_tried():
    known = set(COMMANDS) | {message["do"] for message in GOOD}
    spoken = {"drag.begin", "drag.end", "preset.begin", "preset.set", "preset.end", "undo", "redo", "time", "play"}
    spoken |= {"place.begin", "place.set", "place.end", "object.pick"}
    assert known - {"nothing"} == {message["do"] for message in GOOD} - {"nothing"} >= spoken


async def whole(host, page):
    """The session can be written and read again, and its page shows what it holds."""
    document = host.session.document
    again = Document.from_json(json.loads(json.dumps(document.to_json(), allow_nan=False)))
    assert [edit.id for edit in again.edits] == [edit.id for edit in document.edits]
    own = document.edits_of(document.selection.object_id)
    await page.until(lambda: len(page.sections["edits"]) == len(own))
    await page.until(
        lambda: all(np.array_equal(page.posed(edit.id), host.session.document.edit(edit.id).posed) for edit in own)
    )


def test_every_argument_of_every_command_may_be_anything(tmp_path, monkeypatch):
    monkeypatch.setattr(clients, "MESSAGE_BURST", 1e9)
    monkeypatch.setattr(Cage, "from_field", lambda *_, **__: BOX)

    async def test(host, page):
        for good in GOOD:
            for name in [name for name in good if name != "do"]:
                variants = [{**good, name: value} for value in ODD]
                variants.append({key: value for key, value in good.items() if key != name})
                numbers = [await page.post(**variant) for variant in variants]
                await page.until(lambda: all(number in page.replies for number in numbers))  # noqa: B023
                said = [page.replies[number].get("error", "") for number in numbers]
                assert not any("this went wrong" in text or "\n" in text or len(text) > 500 for text in said), said
                while host.session.history.undo_steps and len(host.session.document.edits) != 1:
                    await page.do(do="undo")
            await page.ask(**good)
            host.session.history.redo_steps.clear()
        await whole(host, page)

    with_pages(test, tmp_path)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)
names = sorted({message["do"] for message in GOOD} - {"cage.generate", "export", "play"})
fields = sorted({name for message in GOOD for name in message} - {"do"})
commands = st.builds(
    lambda good, changes: {**good, **changes},
    st.sampled_from([message for message in GOOD if message["do"] in names]),
    st.dictionaries(st.sampled_from(fields), json_values, max_size=2),
)
messages = st.one_of(
    commands,
    commands,
    st.binary(max_size=64),
    st.builds(packed, st.just(REST * 1.2), st.integers(0, 3), st.integers(0, 4), st.integers(0, 2**32 - 1)),
    st.text(max_size=20),
)


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(messages, max_size=25))
def test_any_messages_in_any_order_leave_the_session_whole(tmp_path, sent):
    async def test(host, page):
        for message in sent:
            if isinstance(message, bytes):
                await page.socket.send_bytes(message)
            elif isinstance(message, str):
                await page.socket.send_str(message.encode(errors="replace").decode())
            else:
                await page.socket.send_str(json.dumps(message))
        await page.ask(do="drag.end", edit=1)
        await whole(host, page)
        steps = len(host.session.history.undo_steps)
        for _ in range(steps):
            await page.do(do="undo")
        assert len(host.session.history.redo_steps) >= steps

    with_pages(test, tmp_path)
