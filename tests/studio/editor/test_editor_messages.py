"""What pages may say to the editor's server: nonsense, wrong values, fuzz; and what is left of it: nothing."""

import contextlib
import json
import struct

import numpy as np
import pytest

aiohttp = pytest.importorskip("aiohttp")
pytest.importorskip("hypothesis")

from editor_commands import CAGE, EVERY, KEYS, key_all
from editor_pages import BOX, new_session, on_pages, packed, with_pages
from editor_pages import nothing_logged as _nothing_logged  # noqa: F401 (a fixture for all tests)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from warpcage import Cage
from warpcage.studio.editor import Document, server
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

#: All commands, some with other arguments, and none.
GOOD = [
    *EVERY,
    {"do": "edit.add", "shape": "box", "segments": 1, "axes": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], "lower": [-0.5] * 3,
     "upper": [0.5] * 3},
    {"do": "cage.generate", "edit": 1, "count": 8,
     "click": {"across": 0.5, "down": 0.5, "aspect": 1.5, "plane": "ground"}},
    {"do": "cage.generate", "edit": 1, "count": 8, "click": {"places": [[0.5, 0.5]], "aspect": 1.5, "plane": "none"}},
    {"do": "key.add", "time": 1.0, "pose": True, "camera": True, "name": "one"},
    {"do": "key.change", "id": KEYS[0], "time": 0.5, "easing": "linear", "name": "two", "pose": True, "camera": True},
    {"do": "key.change", "id": KEYS[0], "easing": {"bezier": [0.2, -0.5, 0.9, 1.5]}},
    {"do": "export", "what": "mp4", "file": "no.txt", "width": 16, "height": 16, "overlay": True, "transparent": False},
    {"do": "nothing"},
]  # fmt: skip


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
        await key_all(page)
        steps = len(host.session.history.undo_steps)
        for good in GOOD:
            for name in [name for name in good if name != "do"]:
                variants = [{**good, name: value} for value in ODD]
                variants.append({key: value for key, value in good.items() if key != name})
                numbers = [await page.post(**variant) for variant in variants]
                await page.until(lambda: all(number in page.replies for number in numbers))  # noqa: B023
                said = [page.replies[number].get("error", "") for number in numbers]
                assert not any("this went wrong" in text or "\n" in text or len(text) > 500 for text in said), said
                while len(host.session.history.undo_steps) > steps:
                    await page.do(do="undo")
            await page.ask(**good)
            host.session.history.redo_steps.clear()
        await whole(host, page)

    with_pages(test, tmp_path, session=new_session(cages=(CAGE,)))


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
    st.builds(packed, st.just(CAGE.vertices * 1.2), st.integers(0, 3), st.integers(0, 4), st.integers(0, 2**32 - 1)),
    st.text(max_size=20),
)


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(messages, max_size=25))
def test_any_messages_in_any_order_leave_the_session_whole(tmp_path, sent):
    async def test(host, page):
        await key_all(page)
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

    with_pages(test, tmp_path, session=new_session(cages=(CAGE,)))
