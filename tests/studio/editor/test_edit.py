"""`warpcage.edit`: the editor for callers and notebooks, from its opening to its end."""

import asyncio
import errno
import os
import pathlib
import signal
import sys
import threading

import numpy as np
import pytest
from messages import MESSAGES

aiohttp = pytest.importorskip("aiohttp")

from editor_browser import until
from editor_pages import BOX, new_session, pages, served, tiny_field

from warpcage import Cage, edit
from warpcage.studio.editor import Document, Session, new_document, read_session
from warpcage.studio.editor import edit as edit_module

REST = BOX.vertices


def notebook_cell(editor):
    """What a notebook shows of an editor."""
    return editor._repr_html_()  # the name by which notebooks ask for it


def full_disk(path, *_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def test_an_editor_keeps_a_field_from_memory_nowhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with edit(tiny_field(), BOX) as editor:
        assert editor.session_path is None and editor.url in repr(editor) and editor.url.startswith("http://127.0.0.1:")
        np.testing.assert_array_equal(editor.posed[0].vertices, REST)
        assert isinstance(editor.document, Document)
        html = notebook_cell(editor)
        assert html.startswith("<iframe") and editor.url.replace("127.0.0.1", "localhost") in html
    editor.close()
    assert "closed" in repr(editor) and "closed" in notebook_cell(editor) and os.listdir(tmp_path) == []
    editor.wait()


def test_an_editor_saves_when_it_is_closed_and_goes_on_later(tmp_path):
    tiny_field().save(tmp_path / "ball.npz")

    async def move(editor):
        async with pages(editor.url) as (page,):
            await page.drag(REST * 1.25)

    with edit(tmp_path / "ball.npz", [BOX, Cage.box((0, 0, 0), (1, 1, 1))]) as editor:
        asyncio.run(move(editor))
    before = (tmp_path / "ball.session.json").read_bytes()
    with pytest.raises(ValueError, match="holds a session"):
        edit(tmp_path / "ball.npz", BOX)
    with edit(str(tmp_path / "ball.npz")) as again:
        np.testing.assert_allclose(again.posed[0].vertices, REST * 1.25)
        assert len(again.posed) == 2 and again.session_path == tmp_path / "ball.session.json"
    assert (tmp_path / "ball.session.json").read_bytes() == before  # a look changes nothing


def test_an_address_stays_while_no_other_user_can_read_it(tmp_path):
    tiny_field().save(tmp_path / "ball.npz")

    def token(**options):
        with edit(tmp_path / "ball.npz", **options) as editor:
            return editor.url.split("/")[3]

    first, secret = token(), tmp_path / ".ball.session.secret"
    assert token() == first == secret.read_text()
    others = token(session=tmp_path / "other.session.json")
    assert others != first
    assert token(host="0.0.0.0") != first and token() == first  # where other machines may ask it is new each time
    if os.name == "posix":
        secret.chmod(0o644)
        second = token()
        assert second != first and token() == second and secret.stat().st_mode & 0o777 == 0o600
        secret.rename(tmp_path / "elsewhere")
        secret.symlink_to(tmp_path / "elsewhere")
        assert token() != second and not secret.is_symlink()
    secret.write_text("short")
    assert len(token()) == 32


def test_an_editor_that_could_not_save_says_so(tmp_path, monkeypatch):
    tiny_field().save(tmp_path / "ball.npz")
    editor = edit(tmp_path / "ball.npz", BOX)
    monkeypatch.setattr(pathlib.Path, "write_text", full_disk)
    with pytest.warns(UserWarning, match="could not be saved: no space left"):
        editor.close()
    assert sorted(os.listdir(tmp_path)) == [".ball.session.secret", "ball.npz"]


def test_an_editor_says_where_it_saved_when_another_program_wrote_its_file(tmp_path):
    tiny_field().save(tmp_path / "ball.npz")
    editor = edit(tmp_path / "ball.npz", BOX)
    (tmp_path / "ball.session.json").write_text("theirs")
    with pytest.warns(UserWarning, match=MESSAGES["editor.session_kept"]):
        editor.close()
    assert (tmp_path / "ball.session.json").read_text() == "theirs"
    assert len(read_session(tmp_path / "ball.1.session.json").edits) == 1


def test_what_an_editor_cannot_open_is_one_line_and_leaves_no_thread(tmp_path):
    before = threading.active_count()
    with edit(tiny_field()) as editor:
        port = int(editor.url.split(":")[2].split("/")[0])
        with pytest.raises(OSError, match="address already in use|in use"):
            edit(tiny_field(), port=port)
    wrong = [
        ({"port": -1}, "port"),
        ({"port": 70000}, "port"),
        ({"port": "80"}, "port"),
        ({"port": True}, "port"),
        ({"host": 5}, "host"),
        ({"allowed_hosts": "proxy"}, "allowed_hosts"),
        ({"cage": "cage.obj"}, "Cage"),
        ({"cage": Cage(BOX.vertices, BOX.faces[1:])}, "cage 1"),
        ({"field": 7}, "VoxelField"),
        ({"field": tmp_path}, "not there|is no|npz|is a folder"),
    ]
    for options, message in wrong:
        with pytest.raises((ValueError, OSError), match=message):
            edit(**{"field": tiny_field(), **options})
    names = [thread.name for thread in threading.enumerate() if thread.name.startswith(("warpcage-", "warpcage "))]
    assert names == [] and threading.active_count() <= before + 2


def test_without_the_extra_it_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "simplejpeg", None)
    with pytest.raises(ImportError, match=MESSAGES["editor.extra_missing"].format(missing="simplejpeg") + "$"):
        edit(tiny_field())
    assert edit_module.RESOLUTION_CPU < edit_module.RESOLUTION_CUDA


def test_many_editors_one_after_another_leave_nothing(tmp_path):
    async def test():
        async with served(tmp_path) as host, pages(host) as (page,):
            await page.until(lambda: page.frames)

    asyncio.run(test())
    files, threads = len(os.listdir("/proc/self/fd")), threading.active_count()
    for _ in range(3):
        asyncio.run(test())
    assert threading.active_count() <= threads and len(os.listdir("/proc/self/fd")) <= files + 1
    assert Session is type(new_session()) and new_document(tiny_field()).edits == ()


@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="no SIGUSR1 to send")
def test_an_interrupt_inside_a_destructor_ends_the_waiting():
    """What is raised in a destructor is lost."""

    class Freed:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def interrupt(number, frame):
        item = Freed()
        del item

    def is_default():
        return signal.getsignal(signal.SIGINT) is signal.default_int_handler

    def interrupt_the_waiting():
        try:
            until(lambda: not is_default(), "the editor waits")
            os.kill(os.getpid(), signal.SIGUSR1)
            until(is_default, "the waiting has ended")
        finally:
            editor.close()

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGUSR1)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGUSR1, interrupt)
    thread = threading.Thread(target=interrupt_the_waiting)
    try:
        with edit(tiny_field(), BOX) as editor:
            thread.start()
            with pytest.raises(KeyboardInterrupt):
                editor.wait()
            assert is_default()
    finally:
        thread.join()
        for number, handler in before.items():
            signal.signal(number, handler)
