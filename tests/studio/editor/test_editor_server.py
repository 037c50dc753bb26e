"""Who gets into the editor's server, and which files it gives, takes and writes."""

import asyncio
import os
import pathlib
import subprocess
import sys
import tempfile

import pytest

aiohttp = pytest.importorskip("aiohttp")
pytest.importorskip("hypothesis")

from editor_pages import BOX, WAIT, new_session, on_pages, run, status, tiny_field, with_pages
from editor_pages import nothing_logged as _nothing_logged  # noqa: F401 (a fixture for all tests)

from warpcage import PoseFile
from warpcage.studio.editor import server

REST = BOX.vertices


# -- Who gets in


@on_pages
async def test_only_the_token_opens_pages_sockets_and_files(host, http):
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


WELCOME = ("127.0.0.1", "localhost", "LOCALHOST", "[::1]")
FOREIGN = ("evil.example", "127.0.0.1.evil.example", "192.168.1.5", "[::1", "")


@on_pages
async def test_a_foreign_host_name_is_refused(host, http):
    for name in (*WELCOME, *FOREIGN):
        for named in (name, f"{name}:{host.port}"):
            welcome = await status(http, host.address, headers={"Host": named}) == 200
            assert welcome == (name in WELCOME), named


ORIGINS = ("http://evil.example", "null", "http://127.0.0.1:1", "http://[", "http://localhost.evil.example", "file://")


@on_pages
async def test_a_page_of_another_origin_can_do_nothing_even_with_the_token(host, http):
    for origin in ORIGINS:
        headers, sent = {"Origin": origin}, form("cage.obj")
        sent["headers"] |= headers
        assert await status(http, host.address, headers=headers) == 403, origin
        assert await status(http, host.address + "upload", method="POST", **sent) == 403, origin
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await http.ws_connect(host.address + "socket", headers=headers)
        assert refused.value.status == 403, origin
    own = {"Origin": f"http://127.0.0.1:{host.port}"}
    await (await http.ws_connect(host.address + "socket", headers=own)).close()


def test_names_and_addresses_that_are_allowed_are_welcome(tmp_path):
    async def test(host, http):
        answers = {name: await status(http, host.address, headers={"Host": name}) for name, _ in allowed}
        assert answers == {name: 200 if welcome else 403 for name, welcome in allowed}

    allowed = [("proxy.example", True), ("10.1.2.3:80", False), ("evil.example", False)]
    run(test, tmp_path, allowed_hosts=("Proxy.example",))
    allowed = [("proxy.example", False), ("10.1.2.3:80", True), ("[fe80::1]", True), ("127.0.0.1", True)]
    run(test, tmp_path, host="0.0.0.0")


@on_pages
async def test_every_answer_says_what_a_page_may_do(host, http):
    for path in ("", "main.js", "no.js", "socket", "../", "/"):
        async with http.get(host.address + path) as answer:
            policy = answer.headers["Content-Security-Policy"]
            assert "default-src 'self'" in policy and "unsafe" not in policy and "frame-ancestors" in policy
            assert answer.headers["X-Content-Type-Options"] == "nosniff"
            assert answer.headers["Referrer-Policy"] == "no-referrer"


@on_pages
async def test_bytes_that_are_no_http_end_in_no_500(host, http):
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


# -- Files


PATHS = "..%2f..%2fserver.py %2e%2e/server.py server.py page icons.svg%00 .. %2fetc%2fpasswd a/b".split()


@on_pages
async def test_no_address_leads_out_of_the_pages_folder(host, http, tmp_path):
    from yarl import URL

    (tmp_path / "secret.txt").write_text("secret")
    for path in ("", *PATHS):
        for address in (host.address + path, host.address + "download/" + path):
            async with http.get(URL(address, encoded=True)) as answer:
                text = await answer.text()
                assert answer.status in (200, 403, 404) and "secret" not in text and "def " not in text, address
                assert answer.status != 200 or "<html" in text, address


NAMES = ["../cage.obj", "/etc/passwd", "a/b.obj", "..", ".", "", ".hidden.obj", "a\\b.obj", "a\0b.obj",
         "out.obj", "outer/cage.obj", "\ud800.obj", "a\nb.obj", None, 1, True, ["cage.obj"], {"a": 1}, 1e308,
         "x" * 5000]  # fmt: skip


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
        await page.do(do="edit.delete", id=1)
        for what, name in (("cage", "none.obj"), ("poses", "none.json")):
            assert "no edit is selected" in await page.refused(do="export", what=what, file=name)

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
    "field.npz": "field.npz",
    "splats.sog": "splats.sog",
    "cage": None,
    "": None,
    ".obj": None,
    "..": None,
    "mine.session.json": None,
}


def shown(folder):
    """Names and contents of the files in a folder that people see."""
    return {name: (folder / name).read_bytes() for name in os.listdir(folder) if not name.startswith(".")}


def hidden(folder):
    """Contents of the uploads in a folder that wait, in their order."""
    files = [path for path in folder.iterdir() if path.name.startswith(".warpcage-upload-")]
    return sorted(path.read_bytes() for path in files if not path.name.endswith("-lock"))


async def sent(host, name, content, page=None):
    """Upload a file, as a page does; its name."""
    async with aiohttp.ClientSession() as http:
        of = "" if page is None else f"?page={page.client}"
        async with http.post(f"{host.address}upload{of}", **form(name, content)) as answer:
            return (await answer.json())["file"]


def test_uploads_get_names_of_their_own_and_go_with_the_editor(tmp_path):
    async def test(host, http):
        for name, kept in UPLOADS.items():
            async with http.post(host.address + "upload", **form(name)) as answer:
                assert answer.status == (400 if kept is None else 200), (name, await answer.text())
                assert kept is None or (await answer.json()) == {"file": kept}
        assert len(hidden(tmp_path)) == len([kept for kept in UPLOADS.values() if kept])
        posts = [http.post(host.address + "upload", **form("cage.obj", b"%d" % k)) for k in range(6)]
        answers = await asyncio.gather(*posts)
        later = {(await answer.json())["file"] for answer in answers}
        assert later == {f"cage-{number}.obj" for number in range(2, 8)}
        assert set(hidden(tmp_path)) == {b"v 0 0 0\n", *(b"%d" % k for k in range(6))}
        assert shown(tmp_path) == {}

    run(test, tmp_path)
    assert os.listdir(tmp_path) == []


def saved(save, name):
    """What a file holds that something saves."""
    with tempfile.TemporaryDirectory() as folder:
        save(pathlib.Path(folder) / name)
        return (pathlib.Path(folder) / name).read_bytes()


def pose_file():
    poses = PoseFile(BOX)
    poses["up"] = BOX.translate((0, 0, 0.5))
    return poses


LOADED = [
    ("cage.obj", lambda: saved(BOX.save, "cage.obj"), {"do": "cage.load"}),
    ("pose.obj", lambda: saved(BOX.translate((0, 0, 1)).save, "pose.obj"), {"do": "pose.load", "edit": 1}),
    ("ball.npz", lambda: saved(tiny_field().save, "ball.npz"), {"do": "object.add"}),
    ("poses.json", lambda: saved(pose_file().save, "poses.json"), {"do": "poses.load", "edit": 1}),
]


@pytest.mark.parametrize(("name", "made", "command"), LOADED)
def test_an_upload_gets_into_the_folder_once_it_was_read_and_taken(tmp_path, name, made, command):
    mine, good = b"mine", made()
    (tmp_path / name).write_bytes(mine)
    stem, ending = name.split(".")

    async def test(host, page):
        for content in (b"no", good[: len(good) // 2]):
            kept = await sent(host, name, content, page)
            assert kept == f"{stem}-2.{ending}"
            error = await page.refused(**command, file=kept)
            assert kept in error and "upload-" not in error
            assert (shown(tmp_path), hidden(tmp_path)) == ({name: mine}, [content])
            for asked in ("files", "object.files"):
                assert kept not in str(await page.do(do=asked))
            await page.do(do="upload.drop", file=kept)
            assert hidden(tmp_path) == []
        assert "not there" in await page.refused(**command, file=kept)
        kept = await sent(host, name, good, page)
        await page.do(**command, file=kept)
        await page.do(do="upload.drop", file=kept)  # which is another one's by now
        assert (shown(tmp_path), hidden(tmp_path)) == ({name: mine, f"{stem}-2.{ending}": good}, [])
        assert host.session.history.undo_steps

    with_pages(test, tmp_path)


def test_an_upload_that_fits_no_more_waits_again_and_a_name_that_is_taken_meanwhile_stays(tmp_path, monkeypatch):
    monkeypatch.setattr("warpcage.studio.editor.objects.MAX_OBJECTS", 1)
    field = saved(tiny_field().save, "ball.npz")

    async def test(host, page):
        kept = await sent(host, "ball.npz", field, page)
        assert "at most 1" in await page.refused(do="object.add", file=kept)
        assert (shown(tmp_path), hidden(tmp_path)) == ({}, [field])
        monkeypatch.setattr("warpcage.studio.editor.objects.MAX_OBJECTS", 2)
        (tmp_path / "ball.npz").write_bytes(b"mine")
        await page.do(do="object.add", file=kept)
        assert host.session.document.objects[1].file == "ball-2.npz"
        assert shown(tmp_path) == {"ball.npz": b"mine", "ball-2.npz": field}

    with_pages(test, tmp_path)


def test_the_uploads_of_a_page_go_with_it_and_those_of_others_stay(tmp_path):
    async def test(host, page, other):
        await sent(host, "one.obj", b"one", page)
        await sent(host, "two.obj", b"two", other)
        await page.socket.close()
        await other.until(lambda: other.sections["session"]["pages"] == 1)
        await other.do(do="files")
        assert hidden(tmp_path) == [b"two"]
        _, writer = await asyncio.open_connection("127.0.0.1", host.port)
        head = f"POST /{host.token}/upload HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9999\r\n"
        writer.write(f"{head}Content-Type: multipart/form-data; boundary=x\r\n\r\n".encode() + form("cut.obj")["data"])
        await writer.drain()
        writer.transport.abort()
        await other.do(do="files")
        assert hidden(tmp_path) == [b"two"]

    with_pages(test, tmp_path, count=2)
    assert os.listdir(tmp_path) == []


KILLED = """
import pathlib, sys
from warpcage.core.files import atomic_path
from warpcage.studio.editor.work.uploads import Uploads

folder = pathlib.Path(sys.argv[1])
uploads = Uploads(folder, lambda name: folder / name)
uploads.keep(sys.argv[2], b"no field")
with uploads.unfinished(folder / "film.mp4") as film, atomic_path(film) as written:
    written.write_bytes(b"half a film")
    print("kept", flush=True)
    sys.stdin.read()
"""


USERS = [".warpcage-upload-notes.obj", ".warpcage-upload-lock", "warpcage-upload-0123456789abcdef-lock", "a.npz",
         ".warpcage-upload-0123456789abcdef-mine.obj"]  # fmt: skip


def test_what_a_killed_editor_leaves_is_removed_and_nothing_else(tmp_path):
    for name in USERS:
        (tmp_path / name).write_bytes(b"mine")
    (tmp_path / ".warpcage-upload-fedcba9876543210-lock").mkdir()
    started = [subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path), name], stdin=subprocess.PIPE,
                                stdout=subprocess.PIPE) for name in ("killed.npz", "runs.npz")]  # fmt: skip
    killed, _ = started
    try:
        for one in started:
            assert one.stdout.readline() == b"kept\n"
        killed.kill()
        killed.wait()
        assert len(list(tmp_path.glob(".warpcage-upload-*-killed.npz"))) == 1
        assert len(list(tmp_path.glob(".warpcage-upload-*-export-*/.film-*.mp4"))) == 2

        async def test(host, page):
            assert await page.do(do="object.files") == {"files": ["a.npz"]}
            assert not list(tmp_path.glob(".warpcage-upload-*-killed.npz"))
            assert len(list(tmp_path.glob(".warpcage-upload-*-runs.npz"))) == 1  # its editor has not ended
            assert len(list(tmp_path.glob(".warpcage-upload-*-export-*"))) == 1
            assert len(list(tmp_path.glob(".warpcage-upload-*-export-*/.film-*.mp4"))) == 1
            assert len(list(tmp_path.glob(".warpcage-upload-*-lock"))) == 2

        with_pages(test, tmp_path)
    finally:
        for one in started:
            one.kill()
            one.communicate()
    assert [(tmp_path / name).read_bytes() for name in USERS] == [b"mine"] * len(USERS)


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
            (
                b'--x\r\nContent-Disposition: form-data; filename="a.obj"\r\n\r\ntext\r\n--x\r\n\r\nmore\r\n--x--\r\n',
                kind,
            ),
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
            assert answer.status == 400 and "no space left" in text and str(tmp_path) not in text
            assert "upload-" not in text
        assert shown(tmp_path) == {} and hidden(tmp_path) == []

    run(test, tmp_path)
    assert os.listdir(tmp_path) == []
