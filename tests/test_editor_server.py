"""The editor's server against hostile pages: who gets in, what messages may do, and that nothing is left behind."""

import asyncio
import contextlib
import gc
import json
import logging
import os
import struct
import threading

import numpy as np
import pytest

aiohttp = pytest.importorskip("aiohttp")
pytest.importorskip("hypothesis")

from editor_pages import BOX, WAIT, Page, new_session, packed, pages, served, with_pages  # noqa: E402
from hypothesis import HealthCheck, given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402

from warpcage.cage.cage import Cage  # noqa: E402
from warpcage.editor import checker, clients, server, tasks  # noqa: E402
from warpcage.editor.commands import COMMANDS  # noqa: E402
from warpcage.editor.document import Document  # noqa: E402
from warpcage.editor.session_file import read_session  # noqa: E402

REST = BOX.vertices


@pytest.fixture(autouse=True)
def nothing_logged(caplog):
    """No test may make the editor, aiohttp or asyncio complain."""
    caplog.set_level(logging.WARNING)
    yield
    loud = [record for record in caplog.records if record.levelno >= logging.ERROR]
    assert not loud, [record.getMessage() for record in loud]


def run(test, folder, **options):
    """Run an asynchronous test(server, http session) against a server."""

    async def all_of_it():
        async with served(folder, **options) as host, aiohttp.ClientSession() as http:
            await asyncio.wait_for(test(host, http), 2 * WAIT)

    asyncio.run(all_of_it())


async def status(http, address, **options):
    async with http.request(options.pop("method", "GET"), address, **options) as answer:
        return answer.status


# -- Who gets in


def test_only_the_token_opens_pages_sockets_and_files(tmp_path):
    async def test(host, http):
        root = f"http://127.0.0.1:{host.port}"
        other = "x" * len(host.token)
        for path in ("", "index.html", "socket", "download/film.mp4", "main.js"):
            assert await status(http, host.address + path) in ((404, 400) if "load" in path or "socket" in path else (200,))
            for token in (other, host.token[:-1], host.token + "x", host.token.swapcase(), "", "%FF", "%00", "."):
                assert await status(http, f"{root}/{token}/{path}") in (403, 404), (token, path)
        assert await status(http, f"{root}/{other}/upload", method="POST", data=b"x") == 403
        assert await status(http, root) == 403
        for method in ("POST", "PUT", "DELETE", "OPTIONS", "TRACE"):
            assert await status(http, host.address, method=method) in (403, 405)
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await http.ws_connect(f"{root}/{other}/socket")
        assert refused.value.status == 403
        async with http.get(f"{root}/{host.token}", allow_redirects=False) as answer:
            assert (answer.status, answer.headers["Location"]) == (302, f"/{host.token}/")

    run(test, tmp_path)


HOSTS = [
    ("127.0.0.1", True),
    ("localhost", True),
    ("LOCALHOST", True),
    ("[::1]", True),
    ("evil.example", False),
    ("127.0.0.1.evil.example", False),
    ("192.168.1.5", False),
    ("[::1", False),
    ("", False),
]


@pytest.mark.parametrize(("name", "welcome"), HOSTS)
def test_a_foreign_host_name_is_refused(tmp_path, name, welcome):
    async def test(host, http):
        for named in (name, f"{name}:{host.port}"):
            assert (await status(http, host.address, headers={"Host": named}) == 200) == welcome

    run(test, tmp_path)


ORIGINS = ["http://evil.example", "null", "http://127.0.0.1:1", "http://[", "http://localhost.evil.example", "file://"]


@pytest.mark.parametrize("origin", ORIGINS)
def test_a_page_of_another_origin_can_do_nothing_even_with_the_token(tmp_path, origin):
    async def test(host, http):
        headers = {"Origin": origin}
        assert await status(http, host.address, headers=headers) == 403
        sent = form("cage.obj")
        sent["headers"] |= headers
        assert await status(http, host.address + "upload", method="POST", **sent) == 403
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await http.ws_connect(host.address + "socket", headers=headers)
        assert refused.value.status == 403
        own = {"Origin": f"http://127.0.0.1:{host.port}"}
        await (await http.ws_connect(host.address + "socket", headers=own)).close()

    run(test, tmp_path)


def test_names_and_addresses_that_were_told_are_welcome(tmp_path):
    async def test(host, http):
        answers = {name: await status(http, host.address, headers={"Host": name}) for name, _ in told}
        assert answers == {name: 200 if welcome else 403 for name, welcome in told}

    told = [("proxy.example", True), ("10.1.2.3:80", False), ("evil.example", False)]
    run(test, tmp_path, allowed_hosts=("Proxy.example",))
    told = [("proxy.example", False), ("10.1.2.3:80", True), ("[fe80::1]", True), ("127.0.0.1", True)]
    run(test, tmp_path, host="0.0.0.0")


def test_every_answer_says_what_a_page_may_do(tmp_path):
    async def test(host, http):
        for path in ("", "main.js", "no.js", "socket", "../", "/"):
            async with http.get(host.address + path) as answer:
                policy = answer.headers["Content-Security-Policy"]
                assert "default-src 'self'" in policy and "unsafe" not in policy and "frame-ancestors" in policy
                assert answer.headers["X-Content-Type-Options"] == "nosniff"
                assert answer.headers["Referrer-Policy"] == "no-referrer"

    run(test, tmp_path)


def test_bytes_that_are_no_http_end_in_no_500(tmp_path):
    async def test(host, http):
        for request in (
            b"GET /\xff\xfe/ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
            b"GET / HTTP/1.0\r\n\r\n",
            b"GET http://evil/ HTTP/1.1\r\nHost: [\r\n\r\n",
            f"GET /{host.token}/ HTTP/1.0\r\n\r\n".encode(),
            f"GET /{host.token}/ HTTP/1.1\r\nHost: [::1\r\nOrigin: http://[\r\n\r\n".encode(),
            f"GET /{host.token}/%ed%a0%80 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode(),
            f"GET /{host.token}/socket HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n\r\n".encode(),
            b"\x16\x03\x01\x02\x00",
        ):
            reader, writer = await asyncio.open_connection("127.0.0.1", host.port)
            writer.write(request)
            writer.write_eof()
            answer = await asyncio.wait_for(reader.read(), WAIT)
            writer.close()
            assert b"200 OK" not in answer[:20] and b" 500 " not in answer[:20], answer[:100]

    run(test, tmp_path)


# -- Files


PATHS = ["..%2f..%2fserver.py", "%2e%2e/server.py", "server.py", "page", "", "icons.svg%00", "..", "%2fetc%2fpasswd", "a/b"]


@pytest.mark.parametrize("path", PATHS)
def test_no_address_leads_out_of_the_pages_folder(tmp_path, path):
    (tmp_path / "secret.txt").write_text("secret")

    async def test(host, http):
        from yarl import URL

        for address in (host.address + path, host.address + "download/" + path):
            async with http.get(URL(address, encoded=True)) as answer:
                text = await answer.text()
                assert answer.status in (200, 403, 404) and "secret" not in text and "def " not in text
                assert answer.status != 200 or "<html" in text

    run(test, tmp_path)


NAMES = ["../cage.obj", "/etc/passwd", "a/b.obj", "..", ".", "", ".hidden.obj", "a\\b.obj", "a\0b.obj", "out.obj",
         "outer/cage.obj", "\ud800.obj", "a\nb.obj", None, 1, True, ["cage.obj"], {"a": 1}, 1e308, "x" * 5000]  # fmt: skip


def test_names_of_files_never_lead_out_of_the_folder(tmp_path):
    folder, outer = tmp_path / "in", tmp_path / "outer"
    folder.mkdir(), outer.mkdir()
    BOX.save(outer / "cage.obj")
    (folder / "out.obj").symlink_to(outer / "cage.obj")
    (folder / "out.json").symlink_to(outer / "new.json")
    (folder / "out.mp4").symlink_to(outer / "new.mp4")
    (folder / "outer").symlink_to(outer)
    before = sorted(os.listdir(outer))

    async def test(host, page):
        for name in NAMES:
            for command in ("cage.load", "pose.load", "poses.load", "poses.save"):
                await page.refused(do=command, file=name, edit=1)
            for what in ("mp4", "gif", "png", "cage", "poses", "bake"):
                await page.refused(do="export", what=what, file=name)
        for what, name in (("poses", "out.json"), ("mp4", "out.mp4"), ("png", "outer")):
            await page.refused(do="export", what=what, file=name)
        files = (await page.do(do="files"))["files"]
        assert all("/" not in file["name"] for file in files)

    with_pages(test, folder)
    assert sorted(os.listdir(outer)) == before and not (folder / "new.json").exists()


def test_no_file_that_is_there_is_replaced(tmp_path):
    kept = {"cage.obj": b"mine", "poses.json": b"mine", "film.mp4": b"mine", "field.npz": b"mine"}
    for name, content in kept.items():
        (tmp_path / name).write_bytes(content)

    async def test(host, page):
        await page.do(do="key.add", time=0.0, pose=True)
        for what, name in (("cage", "cage.obj"), ("poses", "poses.json"), ("mp4", "film.mp4"), ("bake", "field.npz")):
            assert "is there already" in await page.refused(do="export", what=what, file=name)
        for name in ("poses.json", "lego.session.json", "NEW.SESSION.JSON", "kept.session.json"):
            assert await page.refused(do="poses.save", file=name)
        await page.refused(do="export", what="poses", file="kept.session.json")
        assert await page.do(do="poses.save", file="new.json") == {"download": "download/new.json"}
        await page.do(do="poses.save", file="new.json")  # our own
        (tmp_path / "new.json").write_bytes(b"mine, too")
        assert "is there already" in await page.refused(do="poses.save", file="new.json")

    with_pages(test, tmp_path, session=new_session(tmp_path / "kept.session.json"))
    assert {name: (tmp_path / name).read_bytes() for name in kept} == kept
    assert (tmp_path / "new.json").read_bytes() == b"mine, too"


def test_an_export_comes_back_as_a_download_and_a_link_put_in_its_place_does_not(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    (tmp_path / "secret").write_text("secret")

    async def test(host, page):
        number = await page.do(do="export", what="cage", file="posed cage.obj", edit=1)
        await page.until(lambda: [j for j in page.sections["jobs"] if j["id"] == number and j["state"] == "done"])
        (job,) = page.sections["jobs"]
        async with aiohttp.ClientSession() as http:
            async with http.get(host.address + job["download"]) as answer:
                assert answer.status == 200 and (await answer.text()).count("\nv ") + 1 >= 8
                assert answer.headers["Content-Disposition"].startswith("attachment")
            (folder / "posed cage.obj").unlink()
            assert await status(http, host.address + job["download"]) == 404
            (folder / "posed cage.obj").symlink_to(tmp_path / "secret")
            assert await status(http, host.address + job["download"]) == 404

    with_pages(test, folder)


def form(name, content=b"v 0 0 0\n"):
    """What a browser sends for a file of a form; it writes names as they are."""
    head = f'--x\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n\r\n'
    data = head.encode() + content + b"\r\n--x--\r\n"
    return {"data": data, "headers": {"Content-Type": "multipart/form-data; boundary=x"}}


UPLOADS = {
    "cage.obj": "cage.obj",
    "../../up.obj": "up.obj",
    "C:\\\\temp\\\\win.ply": "win.ply",
    ".hidden.json": "hidden.json",
    "a b<c>.obj": "a b_c_.obj",
    "x" * 300 + ".obj": "x" * 120 + ".obj",
    "ä" * 200 + ".json": "ä" * 60 + ".json",
    "script.html": None,
    "field.npz": None,
    "cage": None,
    "": None,
    ".obj": None,
    "..": None,
    "mine.session.json": None,
}


def test_uploads_stay_in_the_folder_under_names_of_their_own(tmp_path):
    async def test(host, http):
        for name, kept in UPLOADS.items():
            async with http.post(host.address + "upload", **form(name)) as answer:
                assert answer.status == (400 if kept is None else 200), (name, await answer.text())
                assert kept is None or (await answer.json()) == {"file": kept}
        names = {kept for kept in UPLOADS.values() if kept}
        assert set(os.listdir(tmp_path)) == names
        posts = [http.post(host.address + "upload", **form("cage.obj", b"%d" % k)) for k in range(6)]
        answers = await asyncio.gather(*posts)
        later = {(await answer.json())["file"] for answer in answers}
        assert later == {f"cage-{number}.obj" for number in range(2, 8)}
        assert {(tmp_path / name).read_bytes() for name in later} == {b"%d" % k for k in range(6)}
        assert (tmp_path / "cage.obj").read_bytes() == b"v 0 0 0\n"

    run(test, tmp_path)


def test_broken_uploads_are_refused_and_leave_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(server, "MAX_UPLOAD", 1000)

    async def test(host, http):
        address = host.address + "upload"
        kind = {"Content-Type": "multipart/form-data; boundary=x"}
        bodies = [
            (b"", {}),
            (b"text", {"Content-Type": "text/plain"}),
            (b"text", {"Content-Type": "multipart/form-data"}),
            (b"", kind),
            (b"text", kind),
            (b"--x\r\n", kind),
            (b"--x\r\n\r\n", kind),
            (b"--x--\r\n", kind),
            (b"--x\r\nContent-Type: multipart/mixed; boundary=y\r\n\r\n--y--\r\n--x--", kind),
            (b"--x\r\nContent-Length: -5\r\n\r\n", kind),
            (b"--x\r\nContent-Length: five\r\n\r\ntext\r\n--x--\r\n", kind),
            (b'--x\r\nContent-Disposition: form-data; name="f"; filename="a.obj"\r\n\r\nno end', kind),
            (b'--x\r\nContent-Disposition: form-data; filename="a.obj"\r\n\r\ntext\r\n--x\r\n\r\nmore\r\n--x--\r\n', kind),
            (b"--x\r\n" + b"A: b\r\n" * 1000 + b"\r\n", kind),
        ]
        for body, headers in bodies:
            async with http.post(address, data=body, headers=headers) as answer:
                assert answer.status in (400, 413), (body, headers, answer.status)
        async with http.post(address, **form("large.obj", b"x" * 2000)) as answer:
            assert answer.status == 413
        assert os.listdir(tmp_path) == []

    run(test, tmp_path)


def test_a_full_disk_while_uploading_leaves_nothing(tmp_path, monkeypatch):
    def full(path, content):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)

    async def test(host, http):
        async with http.post(host.address + "upload", **form("cage.obj")) as answer:
            text = await answer.text()
            assert answer.status == 400 and "No space left" in text and str(tmp_path) not in text
        assert os.listdir(tmp_path) == []

    run(test, tmp_path)


# -- Messages


NONSENSE = ["", "{", "null", "[]", "7", '"do"', "{}", '{"do": 1}', '{"do": null}', '{"do": ["undo"]}', "NaN",
            '{"do": "undo", "n": true}', '{"do": "undo", "n": 1.5}', '{"do": "undo", "n": "1"}', '{"do": "undo", "n": -1}',
            '{"do": "undo", "n": 1e999}', '{"do": "time", "time": NaN}', '{"do": "time", "time": -Infinity}',
            "[" * 100_000, '{"do": "undo", "n": ' + "9" * 5000 + "}", '{"do": "\\ud800"}']  # fmt: skip

BROKEN = [b"", b"\2", struct.pack("<4I", 2, 1, 1, 8), struct.pack("<4I", 2, 1, 1, 2**32 - 1), packed(REST, kind=7),
          packed(REST)[:-1], packed(REST) + b"\0" * 8, packed(REST, kind=10), b"\xff" * 16, bytes(1000)]  # fmt: skip


def test_messages_that_make_no_sense_are_told_so_and_change_nothing(tmp_path):
    async def test(host, page):
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

    with_pages(test, tmp_path)


def test_a_page_that_makes_no_sense_for_long_is_let_go(tmp_path):
    async def test(host, page, other):
        for _ in range(clients.MAX_MISTAKES):
            await page.socket.send_bytes(b"x")
        assert await page.ended() == aiohttp.WSCloseCode.POLICY_VIOLATION
        await other.until(lambda: other.sections["session"]["pages"] == 1)
        for _ in range(2 * clients.MAX_MISTAKES):  # what a hand may do in vain is no nonsense
            await other.refused(do="undo")
        await other.socket.send_bytes(b"x")
        await other.do(do="select", edit=1, mode="vertex", vertices=[1])

    with_pages(test, tmp_path, 2)


def test_a_message_that_is_too_large_ends_its_page_alone(tmp_path):
    async def test(host, page, other):
        with contextlib.suppress(ConnectionError):
            await page.socket.send_bytes(bytes(server.MAX_MESSAGE + 1))
        await page.ended()
        await other.until(lambda: other.sections["session"]["pages"] == 1)
        await other.drag(REST * 1.1)
        np.testing.assert_array_equal(host.session.document.edits[0].posed, REST * 1.1)

    with_pages(test, tmp_path, 2)


ODD = [None, True, False, 0, -1, 1.5, 10**30, 2**63, 1e308, -1e308, "", "x", "\ud800", "\0", "x" * 2000, [], [None], [[1]],
       [1, 2, 3], [1e308] * 3, [True] * 8, {}, {"a": 1}, [[1e308] * 3] * 8, [["1", "2", "3"]] * 8, [[True] * 3] * 8]  # fmt: skip

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
    {"do": "edit.change", "id": 1, "name": "Arm", "kind": "copy", "visible": True},
    {"do": "edit.order", "ids": [1]},
    {"do": "cage.generate", "edit": 1, "count": 8, "margin": None, "method": "auto", "symmetry": None},
    {"do": "cage.subdivide", "edit": 1},
    {"do": "cage.simplify", "edit": 1, "count": 6},
    {"do": "cage.box", "edit": 1, "vertices": [0, 7], "margin": 0.1},
    {"do": "cage.load", "file": "no.obj", "edit": None, "up": "z"},
    {"do": "pose.load", "file": "no.obj", "edit": 1, "up": "z"},
    {"do": "settings", "coordinates": "green", "resolution": 16, "density": "paper", "background": "#102030",
     "supersampling": 2, "show": "masks", "mode": "rest"},
    {"do": "key.add", "time": 1.0, "pose": True, "camera": True, "name": "one"},
    {"do": "key.change", "id": 2, "time": 0.5, "easing": "linear", "name": "two", "pose": True, "camera": True},
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
    {"do": "undo"},
    {"do": "redo"},
    {"do": "edit.delete", "id": 7},
    {"do": "drag.end", "edit": 1, "cancel": False},
    {"do": "nothing"},
]  # fmt: skip


def test_every_command_is_tried():
    known = set(COMMANDS) | {message["do"] for message in GOOD}
    spoken = {"drag.begin", "drag.end", "preset.begin", "preset.set", "preset.end", "undo", "redo", "time", "play"}
    assert known - {"nothing"} == {message["do"] for message in GOOD} - {"nothing"} >= spoken


async def whole(host, page):
    """The session can be written and read again, and its page shows what it holds."""
    document = host.session.document
    again = Document.from_json(json.loads(json.dumps(document.to_json(), allow_nan=False)))
    assert [edit.id for edit in again.edits] == [edit.id for edit in document.edits]
    await page.until(lambda: len(page.sections["edits"]) == len(document.edits))
    await page.until(
        lambda: all(np.array_equal(page.posed(edit.id), edit.posed) for edit in host.session.document.edits)
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
words = sorted({message["do"] for message in GOOD} - {"cage.generate", "export", "play"})
fields = sorted({name for message in GOOD for name in message} - {"do"})
commands = st.builds(
    lambda good, changes: {**good, **changes},
    st.sampled_from([message for message in GOOD if message["do"] in words]),
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


# -- Several pages


def test_pages_see_the_same_and_a_drag_of_one_moves_in_the_other(tmp_path):
    async def test(host, page, other, third):
        await page.send(do="drag.begin", edit=1, label="pull")
        await page.move(REST * 1.1)
        await other.until(lambda: np.array_equal(other.posed(), REST * 1.1))  # before it ends
        assert other.sections["history"]["undo"] == 0 and (2, 1) not in page.vertices
        await page.move(REST * 1.2)
        await page.do(do="drag.end", edit=1)
        await other.do(do="edit.change", id=1, name="Trunk")
        await third.drag(REST * 1.3, kind=3)
        await page.do(do="settings", background="black")
        for one in (page, other, third):
            await one.until(lambda: one.sections["settings"]["background"] == "black")  # noqa: B023
            np.testing.assert_array_equal(one.rest(), REST * 1.3)
            np.testing.assert_allclose(one.posed(), REST * 1.5)
        kept = [dict(one.sections) for one in (page, other, third)]
        assert kept[0] == kept[1] == kept[2] and kept[0]["edits"][0]["name"] == "Trunk"
        assert kept[0]["history"]["undo_label"] == "change background"

    with_pages(test, tmp_path, 3)


def test_a_page_that_comes_later_sees_a_drag_under_way(tmp_path):
    async def test(host, page):
        await page.send(do="drag.begin", edit=1)
        await page.move(REST * 1.1)
        await page.until(lambda: page.frames and page.frames[-1]["applied"]["1"] == 1)
        async with pages(host) as (late,):
            np.testing.assert_array_equal(late.posed(), REST * 1.1)
            await late.until(lambda: late.frames)
            await page.move(REST * 1.2)
            await late.until(lambda: np.array_equal(late.posed(), REST * 1.2))

    with_pages(test, tmp_path)


def test_a_drag_that_another_page_ends_is_kept_and_said_once(tmp_path):
    async def test(host, page, other):
        await page.send(do="drag.begin", edit=1, label="pull")
        await page.move(REST * 1.1)
        await page.until(lambda: page.frames and page.frames[-1]["applied"]["1"] == 1)
        await other.do(do="select", edit=1, mode="face", vertices=[2])
        for factor in np.linspace(1.2, 2.0, 2 * clients.MAX_MISTAKES):
            await page.move(REST * factor)
        assert await page.refused(do="drag.end", edit=1) == server.STRAYED
        assert page.notices == [server.STRAYED] and other.notices == []
        labels = [label for label, _ in host.session.history.undo_steps]
        assert labels == ["pull", "select"]
        await page.until(lambda: np.array_equal(page.posed(), REST * 1.1))
        await page.drag(REST * 1.4)  # the next one works
        assert await page.do(do="undo") == "move"

    with_pages(test, tmp_path, 2)


def test_gestures_out_of_order_are_refused_or_ignored(tmp_path):
    async def test(host, page, other):
        await page.move(REST * 3)
        assert await page.refused(do="drag.end", edit=1) == server.STRAYED
        assert await page.refused(do="drag.begin", edit=7)
        await page.do(do="drag.begin", edit=1)
        await other.move(REST * 4)  # not the one that began
        assert await other.refused(do="drag.end", edit=1) == server.STRAYED
        await page.move(REST * 5, edit=2)
        await page.move(REST[:-1])
        await page.move(REST * np.nan)
        await page.move(REST * 1e300)
        await page.until(lambda: len(page.notices) == 5)
        await page.do(do="drag.begin", edit=1)  # again, without an end
        await page.move(REST * 1.5)
        await page.do(do="drag.end", cancel=True)
        await page.do(do="preset.begin", edit=1, vertices=None)
        await page.refused(do="preset.set", preset="bend", amount=1e308)
        await page.do(do="preset.set", preset="stretch", amount=2, axis="z")
        await page.do(do="preset.end", cancel=False)
        assert [label for label, _ in host.session.history.undo_steps] == ["stretch"]
        await page.until(lambda: np.isclose(np.ptp(page.posed()[:, 2]), 2 * np.ptp(REST[:, 2])))

    with_pages(test, tmp_path, 2)


def test_pages_that_vanish_leave_nothing_and_lose_nothing(tmp_path):
    async def test(host, page):
        for number in range(10):
            await asyncio.sleep(0)
            socket = await page_socket(host)
            lost = Page(socket)
            await lost.until(lambda: lost.client is not None)  # noqa: B023
            await lost.send(do="size", width=30, height=20)
            await lost.send(do="view", eye=[3, number, 1], target=[0, 0, 0], up=[0, 0, 1], fov=40, moving=True)
            if number % 2:
                await lost.send(do="drag.begin", edit=1, label=f"pull {number}")
                await lost.move(REST * (1 + number / 10))
                await page.until(lambda: np.array_equal(page.posed(), REST * (1 + number / 10)))  # noqa: B023
            lost.reader.cancel()
            connection = socket._response.connection
            connection.transport.abort()  # as a browser that is killed
            await page.until(lambda: page.sections["session"]["pages"] == 1)
            connection.close()
            await page.until(lambda: np.array_equal(page.sections["edits"][0]["posed"], host.session.document.edits[0].posed))
        assert list(host.clients.values())[0].number == page.client and len(host.clients) == 1
        assert not host.session.moving and not host._lookers and host._connected == 1
        assert [label for label, _ in host.session.history.undo_steps] == [f"pull {k}" for k in (1, 3, 5, 7, 9)]
        await page.until(lambda: page.frames and page.frames[-1]["width"] == 24 and page.frames[-1]["sharp"])

    async def page_socket(host):
        http = aiohttp.ClientSession()
        opened.append(http)
        return await http.ws_connect(host.address + "socket")

    async def test_and_close(host, page):
        await test(host, page)
        await asyncio.gather(*(http.close() for http in opened))

    opened = []
    with_pages(test_and_close, tmp_path)


def test_connections_that_end_before_the_first_word_leave_nothing(tmp_path):
    async def test(host, page):
        for _ in range(20):
            reader, writer = await asyncio.open_connection("127.0.0.1", host.port)
            key = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: " + "A" * 22
            writer.write(f"GET /{host.token}/socket HTTP/1.1\r\nHost: localhost\r\n{key}==\r\n\r\n".encode())
            writer.transport.abort()
        await page.refused(do="nothing")
        await page.until(lambda: len(host.clients) == host._connected == page.sections["session"]["pages"] == 1)

    with_pages(test, tmp_path)


def test_no_more_pages_than_there_is_room_for(tmp_path, monkeypatch):
    monkeypatch.setattr(server, "MAX_PAGES", 3)

    async def test(host, *_):
        async with aiohttp.ClientSession() as http:
            connects = [http.ws_connect(host.address + "socket") for _ in range(5)]
            answers = await asyncio.gather(*connects, return_exceptions=True)
            sockets = [answer for answer in answers if isinstance(answer, aiohttp.ClientWebSocketResponse)]
            assert len(sockets) == 1 and all(a.status == 503 for a in answers if a not in sockets)
            await sockets[0].close()

    with_pages(test, tmp_path, 2)


def test_a_page_that_reads_nothing_is_not_listened_to_before_it_does(tmp_path, monkeypatch):
    monkeypatch.setattr(clients, "MESSAGE_BURST", 1e9)

    async def test(host, page, other):
        (deaf,) = [client for client in host.clients.values() if client.number == page.client]
        gate = asyncio.Event()
        write = deaf._write_all

        async def blocked():
            await gate.wait()  # as a socket whose buffer is full
            await write()

        deaf._write_all = blocked
        count = 5 * clients.MAX_WAITING
        for _ in range(count):
            await page.post(do="time", time=0.5)
        for factor in np.linspace(1, 2, 50):
            await other.drag(REST * factor)
            await other.do(do="edit.add", kind="move", shape="box", lower=[0] * 3, upper=[1] * 3)
            await other.do(do="undo")
        assert len(deaf._texts) <= clients.MAX_WAITING + 1
        assert len(deaf._vertices) <= 4 and deaf._frame is None or len(deaf._frame) == 2
        gate.set()
        await page.until(lambda: len(page.replies) == count + 1)
        await page.until(lambda: np.array_equal(page.posed(), host.session.document.edits[0].posed))

    with_pages(test, tmp_path, 2)


def test_a_page_that_never_says_what_it_has_seen_gets_no_more_than_two_frames_at_once(tmp_path):
    async def test(host, page):
        page.sees = False
        (client,) = host.clients.values()
        await page.do(do="drag.begin", edit=1)
        for factor in np.linspace(1, 1.5, 20):
            count = host.renderer.frames
            await page.move(REST * factor)
            await page.do(do="seen", frame=0)
            while host.renderer.frames == count:
                await asyncio.sleep(0.005)
            assert len(client._sent_frames) <= clients.FRAMES_UNDER_WAY
        await page.do(do="drag.end")
        page.sees = True
        last = page.frames[-1]["frame"]
        await page.do(do="seen", frame=last)
        await page.until(lambda: page.frames[-1]["applied"]["1"] == 20 and page.frames[-1]["sharp"])

    with_pages(test, tmp_path)


def test_the_latest_pose_wins(tmp_path):
    async def test(host, page):
        await page.until(lambda: page.frames and page.frames[-1]["sharp"])
        gate, show, shown = threading.Event(), host.renderer._show, []

        def slow(request, sharp):
            shown.append(request.applied[1])
            assert gate.wait(WAIT)
            show(request, sharp)

        host.renderer._show = slow
        await page.do(do="drag.begin", edit=1)
        await page.move(REST * 1.01)
        while not shown:
            await asyncio.sleep(0.005)
        for factor in np.linspace(1.02, 1.5, 49):
            await page.move(REST * factor)
        await page.do(do="seen", frame=1)  # all have been heard
        gate.set()
        await page.until(lambda: page.frames[-1]["applied"]["1"] == 50)
        assert shown[:2] == [1, 50], shown
        await page.do(do="drag.end")

    with_pages(test, tmp_path)


def test_a_film_plays_stops_for_a_hand_and_ends_with_the_last_page(tmp_path):
    async def test(host, page, other):
        await page.do(do="key.add", time=0.0, pose=True)
        await page.do(do="time", time=1.0)
        await page.do(do="pose.set", edit=1, vertices=(REST * 1.5).tolist())
        await page.do(do="key.add", time=1.0, pose=True)
        await page.do(do="timeline", length=1.0, loop="ping-pong")
        steps = len(host.session.history.undo_steps)
        await other.do(do="play", on=True)
        await page.until(lambda: page.sections["playback"]["playing"])
        await page.until(lambda: 1.01 < page.posed()[7, 0] / REST[7, 0] < 1.49)
        await page.do(do="settings", background="white")  # which does not stop it
        assert host.player.playing
        await page.do(do="drag.begin", edit=1)
        await other.until(lambda: not other.sections["playback"]["playing"])
        await page.do(do="drag.end")
        assert len(host.session.history.undo_steps) == steps + 1
        await page.refused(do="play", on=1)
        await page.do(do="play", on=True)
        for one in (page, other):
            await one.socket.close()
        while host.clients:
            await asyncio.sleep(0.005)
        assert not host.player.playing

    with_pages(test, tmp_path, 2)


def test_a_film_that_cannot_go_on_stops(tmp_path, monkeypatch):
    async def test(host, page):
        def scrub(time):
            raise ValueError("no such pose")

        monkeypatch.setattr(host.session, "scrub", scrub)
        await page.do(do="play", on=True)
        await page.until(lambda: not page.sections["playback"]["playing"])
        assert not host.player.playing and host.player._task is None

    with_pages(test, tmp_path)


# -- Checks, jobs and what takes long


def test_the_check_follows_the_active_cage_and_says_why_it_cannot(tmp_path, monkeypatch):
    async def test(host, page):
        await page.until(lambda: page.sections["check"] and not page.sections["check"]["pending"])  # without a touch
        assert page.sections["check"]["edit"] == 1 and page.sections["check"]["problem"] == ""
        await page.drag(REST * [-1, 1, 1])
        await page.until(lambda: "posed cage" in page.sections["check"]["problem"])
        await page.do(do="settings", mode="rest")
        await page.until(lambda: page.sections["check"]["problem"] == "" and not page.sections["check"]["pending"])
        await page.do(do="edit.delete", id=1)
        await page.until(lambda: page.sections["check"] is None)
        await page.do(do="undo")
        await page.until(lambda: page.sections["check"] and not page.sections["check"]["pending"])

        def fail(*_):
            raise MemoryError

        monkeypatch.setattr(checker, "inspect", fail)
        await page.drag(REST * 1.1)
        await page.until(lambda: "not enough memory" in page.sections["check"]["problem"])
        assert page.sections["check"]["pending"] is False

    with_pages(test, tmp_path)


def test_a_job_waits_for_the_hand_and_takes_in_what_was_done_meanwhile(tmp_path, monkeypatch):
    started, go = threading.Event(), threading.Event()

    def generate(*_, **__):
        started.set()
        assert go.wait(WAIT)
        return Cage.box((-0.8, -0.8, -0.8), (0.8, 0.8, 0.8), segments=2)

    monkeypatch.setattr(Cage, "from_field", generate)

    async def test(host, page):
        number = await page.do(do="cage.generate", edit=None, count=26, margin=1.5, method="auto", symmetry=None)
        await asyncio.get_running_loop().run_in_executor(None, started.wait, WAIT)
        await page.do(do="drag.begin", edit=1)
        await page.move(REST * 1.1)
        go.set()
        await page.until(lambda: page.sections["jobs"][0]["share"] == 0.95)
        await page.move(REST * 1.2)
        await page.do(do="view", eye=[3, 2, 1], target=[0, 0, 0], up=[0, 0, 1], fov=50)
        await page.do(do="drag.end", edit=1)
        await page.until(lambda: page.sections["jobs"][0]["state"] == "done")
        assert number == 1
        first, second = host.session.document.edits
        np.testing.assert_array_equal(first.posed, REST * 1.2)
        assert len(second.rest) == 26 and host.session.document.view.fov == 50
        assert [label for label, _ in host.session.history.undo_steps] == ["move", "add Move 2"]
        for margin in (-1, 1e308, True, "1", [1], 65):
            await page.refused(do="cage.generate", count=20, margin=margin)

    with_pages(test, tmp_path)


def test_closing_waits_for_no_hand_and_saves_what_it_moved(tmp_path):
    path = tmp_path / "ball.session.json"

    async def test():
        host = server.Server(new_session(path), tmp_path)
        await host.start()
        async with pages(host) as (page,):
            await page.do(do="cage.subdivide", edit=1)
            await page.do(do="drag.begin", edit=1)
            await page.do(do="cage.simplify", edit=1, count=10)
            await page.until(lambda: page.sections["jobs"][0]["share"] == 0.9)
            await page.move(host.session.document.edits[0].posed * 1.1)
            await page.do(do="seen", frame=0)
            await asyncio.wait_for(host.stop(), WAIT)
            assert await page.ended() == aiohttp.WSCloseCode.GOING_AWAY
        return host

    host = asyncio.run(test())
    assert host.jobs.section()[0]["state"] == "cancelled"
    assert not [thread for thread in threading.enumerate() if thread.name.startswith(("warpcage-", "warpcage "))]
    (edit,) = read_session(path).edits
    np.testing.assert_array_equal(edit.posed, edit.rest * 1.1)
    assert len(edit.rest) == 26


def test_a_page_is_heard_while_its_file_is_read(tmp_path, monkeypatch):
    BOX.save(tmp_path / "cage.obj")
    started, go = threading.Event(), threading.Event()

    def load(path, up=None):
        started.set()
        assert go.wait(WAIT)
        return BOX

    monkeypatch.setattr(tasks.Cage, "load", load)

    async def test(host, page):
        number = await page.post(do="cage.load", file="cage.obj", edit=None)
        await page.do(do="select", edit=1, mode="vertex", vertices=[3])
        assert number not in page.replies
        go.set()
        await page.until(lambda: number in page.replies)
        assert "error" not in page.replies[number] and len(host.session.document.edits) == 2

    with_pages(test, tmp_path)


# -- A thousand drags


def held():
    gc.collect()
    with open("/proc/self/statm") as file:
        memory = int(file.read().split()[1]) * os.sysconf("SC_PAGESIZE")
    kinds = (Document, Page, asyncio.Task, clients.Client, np.ndarray)
    objects = gc.get_objects()
    counts = {kind.__name__: sum(type(thing) is kind for thing in objects) for kind in kinds}
    return threading.active_count(), len(os.listdir("/proc/self/fd")), memory, counts


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="counts files in /proc")
def test_a_thousand_drags_leave_threads_files_and_memory_flat(tmp_path, monkeypatch):
    monkeypatch.setattr(clients, "MESSAGE_BURST", 1e9)
    monkeypatch.setattr("warpcage.editor.history.DEPTH", 200)

    async def test(host, page, other):
        for count in range(1000):
            if count == 300:
                before = held()
            await page.drag(REST * (1.1 + count % 7 / 20), REST * (1.2 + count % 5 / 20))
        assert len(host.session.history.undo_steps) == 200
        await other.until(lambda: np.array_equal(other.posed(), host.session.document.edits[0].posed))
        page.frames.clear(), other.frames.clear()
        after = held()
        assert after[0] <= before[0] + 3 and after[1] <= before[1] + 2, (before, after)
        assert after[2] - before[2] < 40e6, (before, after)
        for kind, number in after[3].items():
            assert number <= before[3][kind] + 60, (before, after)

    with_pages(test, tmp_path, 2)
