"""`warpcage edit`: what it prints, refuses, sets aside and leaves when it is ended."""

import asyncio
import os
import pathlib
import re
import signal
import subprocess
import sys
import webbrowser

import numpy as np
import pytest
from messages import MESSAGES

pytest.importorskip("aiohttp")

from editor_pages import BOX, WAIT, pages, tiny_field
from runs import command, run

from warpcage import Cage
from warpcage.studio.editor import Editor, read_session


@pytest.fixture
def files(tmp_path):
    tiny_field().save(tmp_path / "ball.npz")
    BOX.save(tmp_path / "cage.obj")
    Cage.box((0, 0, 0), (1, 1, 1)).save(tmp_path / "other.obj")
    Cage(BOX.vertices, BOX.faces[1:]).save(tmp_path / "open.obj")
    (tmp_path / "broken.npz").write_bytes(b"no archive")
    (tmp_path / "broken.session.json").write_text("{}")
    return tmp_path


@pytest.fixture
def opened(monkeypatch):
    """Editors that commands have opened; each is interrupted at once."""
    editors = []

    def wait(editor):
        editors.append(editor)
        raise KeyboardInterrupt

    monkeypatch.setattr(Editor, "wait", wait)
    return editors


def edit(files, *argv):
    return run(files, "edit", *argv, "--no-browser")


def error(capsys):
    out, err = capsys.readouterr()
    assert err.count("\n") == 1 and err.startswith("warpcage: error: "), err
    assert out == ""
    return err


def test_a_port_that_is_taken_is_one_line(files, capsys):
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert edit(files, "@ball.npz", "--port", taken.getsockname()[1]) == 2
    assert "already in use" in error(capsys)


@pytest.mark.parametrize("missing", ["aiohttp", "simplejpeg"])
def test_a_missing_extra_is_one_line_before_anything_is_made(files, capsys, monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.setattr("warpcage.studio.editor.demo.demo_files", lambda device: pytest.fail("the demo is made"))
    for argv in (("@ball.npz",), ("--demo",)):
        assert edit(files, *argv) == 2
        said = MESSAGES["editor.extra_missing"].format(missing=missing)
        assert re.fullmatch(f"warpcage: error: {said}\n", error(capsys))


def test_a_session_is_begun_kept_and_gone_on_with(files, opened, capsys):
    assert edit(files, "@ball.npz", "--cage", "@cage.obj", "--cage", "@other.obj") == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert opened[0].url in out and "ball.session.json" in out
    kept = files / "ball.session.json"
    first = kept.read_bytes()
    assert [len(one.rest) for one in read_session(kept).edits] == [8, 8]
    assert edit(files, "@ball.npz") == 0 and len(opened[1].document.edits) == 2
    capsys.readouterr()
    assert edit(files, "@ball.npz", "--cage", "@cage.obj") == 2
    assert "--new" in error(capsys) and kept.read_bytes() == first


def test_new_sets_the_old_session_aside(files, opened, capsys):
    edit(files, "@ball.npz", "--cage", "@cage.obj")
    kept = files / "ball.session.json"
    first = kept.read_bytes()
    for number in (1, 2):
        assert edit(files, "@ball.npz", "--new") == 0
        assert f"ball.{number}.session.json" in capsys.readouterr().out
        assert (files / "ball.1.session.json").read_bytes() == first and read_session(kept).edits == ()
    edit(files, "@ball.npz", "--new", "--cage", "@other.obj")
    np.testing.assert_allclose(opened[-1].document.edits[0].rest.min(axis=0), 0, atol=1e-9)


def test_new_leaves_the_old_session_where_the_editor_cannot_begin(files, opened, capsys):
    import socket

    edit(files, "@ball.npz", "--cage", "@cage.obj")
    first = (files / "ball.session.json").read_bytes()
    before = sorted(os.listdir(files))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert edit(files, "@ball.npz", "--new", "--port", taken.getsockname()[1]) == 2
    (files / "ball.npz").rename(files / "gone.npz")
    assert edit(files, "@ball.npz", "--new") == 2
    (files / "gone.npz").rename(files / "ball.npz")
    assert sorted(os.listdir(files)) == before and (files / "ball.session.json").read_bytes() == first


def test_the_demo_comes_from_the_cache_and_its_session_goes_into_the_current_folder(files, opened, capsys, monkeypatch):
    cache = files / "cache"
    cache.mkdir()
    (files / "ball.npz").rename(cache / "bricks.npz")
    (files / "cage.obj").rename(cache / "bricks_cage.obj")
    monkeypatch.setenv("WARPCAGE_CACHE", str(cache))
    monkeypatch.setattr("warpcage.studio.editor.demo.fit", lambda *_, **__: pytest.fail("the demo is fitted"))
    monkeypatch.chdir(files)
    for argv in (("--demo",), ("--demo",), ("--demo", "--new")):
        assert run(files, "edit", *argv, "--no-browser") == 0
        np.testing.assert_allclose(opened[-1].posed[0].vertices, BOX.vertices)
    out, err = capsys.readouterr()
    assert "kept in warpcage-demo/bricks.session.json" in out and "earlier session" not in err
    assert sorted(name for name in os.listdir(cache) if not name.startswith(".")) == ["bricks.npz", "bricks_cage.obj"]
    kept = sorted(name for name in os.listdir("warpcage-demo") if not name.startswith("."))
    assert kept == ["bricks.1.session.json", "bricks.session.json"]
    old = cache / "bricks.session.json"  # as it was kept in the cache before
    content = (files / "warpcage-demo" / "bricks.session.json").read_bytes()
    old.write_bytes(content)
    assert run(files, "edit", "--demo", "--no-browser") == 0
    assert f"--session {old}" in capsys.readouterr().err and old.read_bytes() == content
    assert run(files, "edit", "--demo", "--new", "--no-browser") == 0
    assert "earlier session" not in capsys.readouterr().err and old.read_bytes() == content


def test_a_file_where_the_demos_folder_should_be_is_refused_before_the_demo_is_made(files, opened, capsys, monkeypatch):
    monkeypatch.setattr("warpcage.studio.editor.demo.demo_files", lambda device: pytest.fail("the demo is made"))
    monkeypatch.chdir(files)
    (files / "warpcage-demo").write_text("mine")
    assert run(files, "edit", "--demo", "--no-browser") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "'warpcage-demo' is not a folder" in line and (files / "warpcage-demo").read_text() == "mine" and not opened


def test_a_browser_is_opened_or_the_reader_is_reported(files, opened, capsys, monkeypatch):
    seen = []
    monkeypatch.setattr(webbrowser, "open", lambda url: not seen.append(url))
    run(files, "edit", "@ball.npz")
    assert seen == [opened[0].url] and "no browser" not in capsys.readouterr().err
    monkeypatch.setattr(webbrowser, "open", lambda url: False)
    run(files, "edit", "@ball.npz")
    assert "open the address above" in capsys.readouterr().err


def test_an_interrupt_in_the_middle_of_a_drag_ends_it_with_the_session_saved(files):
    argv = command("edit", files / "ball.npz", "--cage", files / "cage.obj", "--no-browser", "--device", "cpu")
    process = subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    async def work():
        lines = iter(process.stdout.readline, "")
        line = await asyncio.get_running_loop().run_in_executor(None, lambda: next(x for x in lines if " at http" in x))
        async with pages(line.split()[-1]) as (page,):
            await page.do(do="drag.begin", edit=1)
            await page.move(BOX.vertices * 1.3)
            await page.do(do="seen", frame=0)
            process.send_signal(signal.SIGINT)
            await page.ended()

    try:
        asyncio.run(asyncio.wait_for(work(), 2 * WAIT))
        _, err = process.communicate(timeout=WAIT)
    finally:
        process.kill()
        process.wait(WAIT)
    assert process.returncode == 0 and err == "", err
    (one,) = read_session(pathlib.Path(files / "ball.session.json")).edits
    np.testing.assert_allclose(one.posed, BOX.vertices * 1.3)


def test_a_stage_file_is_opened_with_all_of_its_objects_and_its_film_is_made(files, opened, capsys):
    """`animate --session` renders what the editor has of it."""
    moving = files / "moving.json"
    moving.write_text('{"keys": [{"time": 0}, {"time": 1, "position": [0, 0, 1]}]}')
    render = ("render", "@ball.npz", "--add", f"@ball.npz:{moving}", "-o", "@both.png", "--size", 16, 12)
    assert run(files, *render, "--save-stage", "@both.stage.json") == 0
    assert edit(files, "@both.stage.json", "--cage", "@cage.obj") == 2
    assert "cages of their own" in capsys.readouterr().err
    assert edit(files, "@both.stage.json") == 0
    (editor,) = opened
    assert [scene_object.name for scene_object in editor.document.objects] == ["ball", "ball 2"]
    assert (files / "both.stage.session.json").is_file() and editor.session.field_path == files / "ball.npz"
    session = ("animate", "@ball.npz", "--session", "@both.stage.session.json")
    assert run(files, *session, "-o", "@film", "--size", "16", "12") == 0
    assert len(list((files / "film").iterdir())) == 25
    assert run(files, *session, "--jobs", "@film.jsonl") == 2
    assert "goes with a field in its own place" in capsys.readouterr().err
    assert edit(files, "@both.stage.json", "--new") == 0
