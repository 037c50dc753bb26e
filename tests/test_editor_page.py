"""The editor in a real browser, as a person uses it: from a lasso to a film, by mouse and by keys alone."""

from __future__ import annotations

import dataclasses
import http.server
import shlex
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

pytest.importorskip("aiohttp")
pytest.importorskip("simplejpeg")

from editor_browser import Window, until, tunnel  # noqa: E402, I001
from editor_pages import tiny_field  # noqa: E402
from page_probe import chromium, projected  # noqa: E402

import warpcage  # noqa: E402
from warpcage.cli import main  # noqa: E402

pytestmark = pytest.mark.xdist_group("chromium")

#: A cage of 42 vertices around the ball.
CAGE = warpcage.Cage.icosphere((0.0, 0.0, 0.0), 0.8, subdivisions=1)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium(1024, 768, ratio=0.5) as driver:  # pictures of few pixels are cheap
        yield driver


@pytest.fixture
def editor(tmp_path: Path) -> Iterator[Any]:
    """An editor of a ball, with settings that pictures are cheap with."""
    tiny_field().save(tmp_path / "ball.npz")
    with warpcage.edit(tmp_path / "ball.npz", CAGE) as opened:
        yield opened


@pytest.fixture
def window(browser: Any, editor: Any) -> Iterator[Window]:
    """A window at the editor, with what a new user's browser has kept: nothing. Its console stays empty."""
    browser.switch_to.window(browser.window_handles[0])
    browser.get(editor.url)
    browser.execute_script("localStorage.clear()")
    browser.get_log("browser")
    opened = Window(browser, editor.url)
    yield opened
    opened.front()
    assert opened.console() == []
    browser.get("about:blank")


def settle(editor: Any, count: int) -> None:
    """Wait until the server's history has so many steps."""
    until(lambda: len(editor._session.history.undo_steps) == count, f"{count} steps of undo")


def posed(editor: Any) -> np.ndarray:
    return editor.posed[0].vertices


def looks_cheap(window: Window) -> None:
    """Sets what pictures are cheap with, as a person does."""
    window.unfold("view")
    window.choose("#coordinates", "mean_value")
    window.wait('warpcage.store.sections.settings.coordinates === "mean_value"')
    window.click("#group-view-fold")


def lasso(window: Window, around: np.ndarray, reach: float) -> np.ndarray:
    """Draws a lasso about a place; gives the vertices that lie inside."""
    angles = np.linspace(0, 2 * np.pi, 17)[:-1]
    path = around + reach * np.column_stack([np.cos(angles), np.sin(angles)])
    places = window.places()
    window.drag(path)
    steps = np.roll(path, -1, axis=0) - path
    away = places[:, None] - path[None]
    sides = steps[None, :, 0] * away[..., 1] - steps[None, :, 1] * away[..., 0]
    return np.flatnonzero((sides > 0).all(axis=1))


def below(window: Window) -> tuple[np.ndarray, np.ndarray]:
    """The lowest corner of the cage in the view, and a place beside the cage for a lasso around it to begin at."""
    places = window.places()
    lowest = places[np.argmax(places[:, 1])]
    return lowest, np.array([lowest[0] + 60, lowest[1]])


# the mouse ---------------------------------------------------------------------------------------------------------


def test_a_lasso_and_a_proportional_drag_pose_the_cage(window: Window, editor: Any) -> None:
    looks_cheap(window)
    assert window.section("settings")["mode"] == "pose"
    window.click("#pick-lasso")
    lowest, _ = below(window)
    inside = lasso(window, lowest, 45.0)
    assert 0 < len(inside) < 20
    until(lambda: editor.document.selection.vertices == tuple(inside.tolist()), "the lasso's vertices are selected")

    window.click("#proportional")
    view = window.section("view")
    box = window.box
    size, radius = float(np.linalg.norm(np.ptp(CAGE.vertices, axis=0))), 0.3
    vertex = int(inside[np.argmax(window.places()[inside, 1])])
    start = window.places()[vertex]
    way = np.array([38.0, -27.0])
    before = len(editor._session.history.undo_steps)
    window.drag([start + way * share for share in np.linspace(0.0, 1.0, 12)])
    settle(editor, before + 1)

    # NumPy: the middle of the selection goes where the pointer went, in the plane of the view through it
    rest = CAGE.vertices
    middle = rest[inside].mean(axis=0)
    back = np.subtract(view["eye"], view["target"])
    back = back / np.linalg.norm(back)
    right = np.cross(view["up"], back)
    right = right / np.linalg.norm(right)
    pixel = 2 * np.tan(np.radians(view["fov"]) / 2) * ((np.array(view["eye"]) - middle) @ back) / box["height"]
    offset = pixel * (way[0] * right - way[1] * np.cross(back, right))
    there = projected(view, middle + offset, box["width"], box["height"])[:2]
    from_ = projected(view, middle, box["width"], box["height"])[:2]
    np.testing.assert_allclose(there - from_, way, atol=1e-6)  # the oracle itself
    far = np.linalg.norm(rest[:, None] - rest[None, inside], axis=2).min(axis=1) / (radius * size)
    weights = np.where(far < 1, (1 - far) ** 2 * (1 + 2 * far), 0.0)
    assert ((weights > 0) & (weights < 1)).any()
    np.testing.assert_allclose(posed(editor), rest + weights[:, None] * offset, atol=1e-9)
    np.testing.assert_allclose(window.posed(), posed(editor), atol=1e-12)


def test_the_picture_is_that_of_the_posed_cage(window: Window, editor: Any) -> None:
    looks_cheap(window)
    window.press("A", "R", "X", "6", "0", "Enter")
    turned = CAGE.rotate(60, axis="x").vertices
    until(lambda: np.allclose(posed(editor), turned, atol=1e-9), "the cage is turned")
    window.press("Alt+Shift+Z")  # without the cage
    until(lambda: not window.get("warpcage.store.tools.cage"), "the cage is not drawn")
    until(lambda: np.allclose(window.posed(), posed(editor)), "the page has the pose")
    header = window.rest()
    shown = window.canvas() / 255.0
    height, width = shown.shape[:2]
    assert (header["width"], header["height"]) == (width, height)
    view = editor.document.view
    across = 2 * np.degrees(np.arctan(np.tan(np.radians(view.fov) / 2) * width / height))
    eye = warpcage.Camera.look_at(view.eye, view.target, up=view.up, width=width, height=height, fov_degrees=across)
    deformer = warpcage.Deformer(tiny_field(), CAGE, coordinates="mean_value", resolution=64)
    moved = deformer.pose(editor.posed[0]).render(eye).rgb
    still = deformer.pose(CAGE).render(eye).rgb
    inner = slice(0, int(0.8 * height)), slice(0, int(0.8 * width))  # the compass is in a corner
    wrong = np.abs(shown[inner] - moved[inner]).mean()
    assert wrong < 0.005 and np.abs(shown[inner] - still[inner]).mean() > 5 * wrong


def test_fifty_steps_are_undone_and_redone(window: Window, editor: Any) -> None:
    looks_cheap(window)
    begun = len(editor._session.history.undo_steps)
    seen = [posed(editor)]
    lowest, _ = below(window)
    vertex = int(np.argmax(window.places()[:, 1]))
    window.drag([lowest, lowest + [6, 0], lowest + [12, 3]])
    settle(editor, begun + 2)  # the vertex is selected, and moved
    seen += [CAGE.vertices, posed(editor)]
    for number in range(48):
        place = window.places()[vertex]
        way = np.array([np.cos(number), np.sin(number)]) * 14
        window.drag([place, place + way])
        settle(editor, begun + 3 + number)
        seen.append(posed(editor))
    assert len(seen) == 51 and all((a != b).any() for a, b in zip(seen[1:], seen[2:], strict=False))
    for number in range(49, -1, -1):
        window.press("Ctrl+Z")
        settle(editor, begun + number)
        assert np.array_equal(posed(editor), seen[number])
    assert window.wait("warpcage.store.sections.history.redo === 50")
    for number in range(1, 51):
        window.press("Ctrl+Shift+Z")
        settle(editor, begun + number)
        assert np.array_equal(posed(editor), seen[number])
    np.testing.assert_array_equal(window.posed(), seen[50])
    assert window.get('document.getElementById("redo").disabled')


def test_keys_a_film_and_its_files(window: Window, editor: Any, tmp_path: Path, monkeypatch: Any) -> None:
    looks_cheap(window)
    window.unfold("film")
    for field, value in (("#film-length", "0.5"), ("#film-fps", "8")):
        window.fill(field, value + "\n")
    window.wait("warpcage.store.sections.timeline.length === 0.5 && warpcage.store.sections.timeline.fps === 8")
    window.click("#time-add")  # at rest, at 0 s
    window.wait("warpcage.store.sections.timeline.keys.length === 1")
    lowest, _ = below(window)
    window.click("#track")  # the middle of the film
    until(lambda: editor.document.time == 0.25, "the head is in the middle")
    window.press("End")
    until(lambda: editor.document.time == 0.5, "the head is at the end")
    window.drag([lowest, lowest + [8, 8], lowest + [50, 60]])
    window.drag([lowest + [-90, -200], lowest + [-50, -190], lowest + [30, -190]], keys=1)  # Alt: turns the view
    until(lambda: not np.array_equal(posed(editor), CAGE.vertices), "the cage is posed")
    window.press("K")
    window.wait("warpcage.store.sections.timeline.keys.length === 2")
    until(lambda: len(editor.document.timeline.keys) == 2, "two keys")
    first, last = editor.document.timeline.keys
    bent = posed(editor)
    assert (first.time, last.time) == (0.0, 0.5) and first.view != last.view
    assert np.array_equal(first.poses[1], CAGE.vertices) and np.array_equal(last.poses[1], bent)

    window.click("#time-first")
    until(lambda: editor.document.time == 0.0, "the head is at the start")
    until(lambda: np.array_equal(posed(editor), CAGE.vertices), "the start shows the first key")
    window.press("Space")  # plays: a click leaves the keys to the view
    until(lambda: editor.document.time > 0, "it plays")
    until(lambda: editor.document.time == 0.5, "it plays to the end")
    until(lambda: np.array_equal(posed(editor), bent), "the end shows the last key")
    window.wait("!warpcage.store.sections.playback.playing")

    window.click("#export-mp4")
    for field, value in (("#ask-width", "48"), ("#ask-height", "32")):
        window.fill(field, value)
    window.click("#dialog-confirm")
    job = window.job(1)
    assert job["state"] == "done", job
    film = iio.imread(tmp_path / "film.mp4", plugin="pyav")
    assert film.shape == (5, 32, 48, 3)  # 0, 1/8, ... 1/2 s
    assert np.abs(film[0].astype(float) - film[-1]).mean() > 0.3
    link = window.get('document.querySelector(".job a[download]").href')
    assert urllib.request.urlopen(link).read() == (tmp_path / "film.mp4").read_bytes()

    window.click("#export-cage")
    window.click("#dialog-confirm")
    assert window.job(2)["state"] == "done"
    cage = warpcage.Cage.load(tmp_path / "posed.obj")
    np.testing.assert_allclose(cage.vertices, bent, atol=1e-8)
    assert np.array_equal(cage.faces, CAGE.faces)
    window.click("#cage-load")  # and in the page, as a new edit
    window.wait('document.getElementById("ask-edit")')
    window.choose("#ask-edit", "0")
    window.click("#dialog-confirm")
    until(lambda: len(editor.document.edits) == 2, "the exported cage is an edit")
    np.testing.assert_allclose(editor.document.edits[1].rest, bent, atol=1e-8)
    window.press("Ctrl+Z")
    until(lambda: len(editor.document.edits) == 1, "the edit is gone again")

    window.click("#export-command")
    window.fill("#ask-file", "again.mp4")
    for field, value in (("#ask-width", "48"), ("#ask-height", "32")):
        window.fill(field, value)
    window.click("#dialog-confirm")
    printed = window.wait('document.querySelector("dialog textarea, dialog pre, dialog code")')
    words = shlex.split(printed.get_attribute("value") or printed.text)
    assert words[0] == "warpcage"
    window.press("Escape")
    monkeypatch.chdir(tmp_path)
    main(words[1:])
    again = iio.imread(tmp_path / "again.mp4", plugin="pyav")
    assert np.array_equal(again, film)


# more than one window, and broken lines ----------------------------------------------------------------------------


def test_a_reloaded_page_and_a_second_one_have_the_same_state(window: Window, browser: Any, editor: Any) -> None:
    looks_cheap(window)
    lowest, _ = below(window)
    window.drag([lowest, lowest + [6, 6], lowest + [40, 30]])
    window.press("K")
    window.wait("warpcage.store.sections.timeline.keys.length === 1")
    window.drag([lowest + [-150, -200], lowest + [-130, -190], lowest + [-90, -190]], keys=1)
    until(lambda: editor.document.view == warpcage_view(window), "the view is told")
    before = window.sections()
    window.reload()
    assert window.sections() == before

    browser.switch_to.new_window("window")
    metrics = {"width": 1024, "height": 768, "deviceScaleFactor": 0.5, "mobile": False}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    other = Window(browser, editor.url)
    try:
        assert other.sections() == before
        other.press("A")
        until(lambda: len(editor.document.selection.vertices) == len(CAGE.vertices), "all are selected")
        other.press("G", "X", "0", ".", "2", "5", "Enter")
        until(lambda: np.allclose(posed(editor)[0, 0], before["edits"][0]["posed"][0][0] + 0.25), "all have moved")
        after = other.sections()
        window.front()
        until(lambda: window.sections() == after, "the first window has what the second did")
        np.testing.assert_array_equal(window.posed(), posed(editor))
        window.press("Ctrl+Z")
        until(lambda: np.allclose(posed(editor), before["edits"][0]["posed"]), "either window undoes")
        other.front()
        until(lambda: np.array_equal(other.posed(), posed(editor)), "and the other one shows it")
    finally:
        other.front()
        browser.close()
        browser.switch_to.window(window.handle)


def warpcage_view(window: Window) -> Any:
    from warpcage.editor.document import checked_view

    return checked_view(window.get("warpcage.viewport.view"))


def test_a_connection_that_breaks_in_mid_drag_comes_back(window: Window, editor: Any) -> None:
    looks_cheap(window)
    with tunnel(editor.url) as (line, address):
        window.open(address)
        begun = len(editor._session.history.undo_steps)
        lowest, _ = below(window)
        window.point("mouseMoved", lowest)
        window.point("mousePressed", lowest, button="left")
        window.point("mouseMoved", lowest + [10, 5], button="left")
        until(lambda: not np.array_equal(posed(editor), CAGE.vertices), "the drag arrives")
        line.cut()
        window.wait("!warpcage.store.status.connected", "the page knows that the line is broken")
        window.point("mouseMoved", lowest + [40, 20], button="left")
        line.restore()
        window.wait("warpcage.store.status.connected", "the page is connected again")
        window.point("mouseMoved", lowest + [50, 30], button="left")
        window.point("mouseReleased", lowest + [50, 30], button="left")
        vertex = int(np.argmax(np.abs(window.posed() - CAGE.vertices).max(axis=1)))
        until(lambda: np.allclose(window.posed(), posed(editor), atol=1e-12), "the server has what the hand did")
        np.testing.assert_allclose(window.places()[vertex], lowest + [50, 30], atol=1.0)
        assert len(editor._session.history.undo_steps) > begun
        while len(editor._session.history.undo_steps) > begun:
            count = len(editor._session.history.undo_steps)
            window.press("Ctrl+Z")
            settle(editor, count - 1)
        assert np.array_equal(posed(editor), CAGE.vertices)
        # what a browser says by itself of a socket that breaks
        left = [entry for entry in window.console() if "WebSocket connection to" not in entry["message"]]
        assert left == []
        window.open(editor.url)


# the keyboard alone -------------------------------------------------------------------------------------------------


def test_the_keyboard_alone_poses_keys_and_exports(window: Window, editor: Any, tmp_path: Path) -> None:
    looks_cheap(window)
    window.reload()
    window.tab_to("view")
    window.press("]")
    until(lambda: editor.document.selection.vertices == (0,), "the first vertex is selected")
    window.press("Ctrl+Shift+ArrowDown")
    until(lambda: len(editor.document.selection.vertices) == 2, "a second vertex is selected")
    chosen = list(editor.document.selection.vertices)
    window.press("O")  # proportional, and off again
    window.press("O")
    window.press("K")
    until(lambda: len(editor.document.timeline.keys) == 1, "a key")
    window.tab_to("track")
    window.press("ArrowRight", "ArrowRight", "ArrowRight", "ArrowRight")
    until(lambda: np.isclose(editor.document.time, 4 / 24), "four pictures on")
    window.press("G", "Z", "-", "0", ".", "2", "Enter")
    expected = CAGE.vertices.copy()
    expected[chosen, 2] -= 0.2
    until(lambda: np.allclose(posed(editor), expected, atol=1e-12), "the typed move")
    window.press("Enter")  # on the timeline: a key
    until(lambda: len(editor.document.timeline.keys) == 2, "another key")
    window.press("Home", "Space")
    until(lambda: editor.document.time > 0, "it plays")
    window.press("Space")
    window.wait("!warpcage.store.sections.playback.playing")

    window.tab_to("group-film-fold")
    window.press("Enter")
    window.wait('document.getElementById("group-film").open')
    window.tab_to("film-length")
    window.type("0.25\n")
    until(lambda: editor.document.timeline.length == 0.25, "the film's length")
    window.tab_to("export-gif")
    window.press("Enter")
    window.wait('document.getElementById("dialog-confirm")')
    window.type("mine.gif")
    for value in ("40", "30"):
        window.press("Tab")
        window.type(value)
    window.press("Enter")
    assert window.job(1)["state"] == "done", window.section("jobs")
    assert iio.imread(tmp_path / "mine.gif").shape[1:3] == (30, 40)
    assert window.get("document.activeElement.id") == "export-gif"  # where the person was


# how it looks -------------------------------------------------------------------------------------------------------

#: Every control that can be seen and does not lie where it can be pressed; texts without contrast to what is behind.
LAYOUT = """
const bad = [], near = 1 / devicePixelRatio;
const name = (found) => found.id || found.className || found.tagName;
const isShown = (found) => found.checkVisibility({ visibilityProperty: true }) && !found.closest("[inert]");
const scrolled = (found) => { for (let up = found.parentElement; up; up = up.parentElement) {
  if (up.scrollHeight > up.clientHeight + 1 && /auto|scroll/.test(getComputedStyle(up).overflowY)) return up; } };
if (document.documentElement.scrollWidth > innerWidth || document.documentElement.scrollHeight > innerHeight)
  bad.push("the page scrolls");
for (const found of document.querySelectorAll("button, input, select, summary, a[href]")) {
  if (!isShown(found) || found.classList.contains("hidden-file")) continue;
  const panel = scrolled(found);
  if (panel) found.scrollIntoView({ block: "nearest" });
  const box = found.getBoundingClientRect();
  if (!box.width) continue;
  const inside = Math.min(box.left, box.top, innerWidth - box.right, innerHeight - box.bottom) >= -near;
  const top = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
  const free = top && (found.contains(top) || top.contains(found) && top.tagName === "LABEL" || found.closest("label")?.contains(top));
  if (!inside || !free) bad.push(`${name(found)} ${inside ? "is covered by " + (top ? name(top) : "nothing") : "is outside"}`);
  if (!found.title && !found.closest("[title]") && !found.getAttribute("aria-label") && !found.labels?.length && !found.textContent)
    bad.push(`${name(found)} has no name`);
}
const pen = Object.assign(document.createElement("canvas"), { width: 1, height: 1 }).getContext("2d", { willReadFrequently: true });
const shade = (colours) => {
  pen.clearRect(0, 0, 1, 1);
  for (const colour of colours) { pen.fillStyle = "#000"; pen.fillStyle = colour; pen.fillRect(0, 0, 1, 1); }
  const [r, g, b] = [...pen.getImageData(0, 0, 1, 1).data].map((v) => (v / 255 <= 0.04045 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
let texts = 0;
for (const found of document.querySelectorAll("body *")) {
  const says = [...found.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
  if (!says || !isShown(found) || found.closest("[disabled], noscript, option, svg")) continue;
  const behind = [];
  for (let up = found; up; up = up.parentElement) behind.unshift(getComputedStyle(up).backgroundColor);
  const style = getComputedStyle(found), base = shade(behind), front = shade([...behind, style.color]);
  const ratio = (Math.max(base, front) + 0.05) / (Math.min(base, front) + 0.05);
  texts += 1;
  if (ratio < 4.5) bad.push(`${name(found)} "${found.textContent.trim().slice(0, 30)}" has a contrast of ${ratio.toFixed(2)}`);
}
return { bad: [...new Set(bad)], texts, colour: getComputedStyle(document.body).backgroundColor };
"""


@pytest.mark.parametrize(("width", "height"), [(1024, 768), (1440, 900), (820, 1180)])
def test_everything_can_be_seen_in_light_and_dark(window: Window, browser: Any, width: int, height: int) -> None:
    metrics = {"width": width, "height": height, "deviceScaleFactor": 0.5, "mobile": False}
    colours = set()
    try:
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        window.wait("innerWidth === arguments[0]", "the window is resized", width)
        if window.get('document.body.classList.contains("panel-closed")'):
            window.click("#panel-toggle")
        for group in ("edits", "cage", "pose", "view", "keys", "film", "jobs"):
            window.unfold(group)
        window.click("#proportional")
        window.click("#snap")
        window.press("K")
        window.wait("warpcage.store.sections.timeline.keys.length === 1")
        for scheme in ("light", "dark"):
            features = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
            browser.execute_cdp_cmd("Emulation.setEmulatedMedia", features)
            window.wait("matchMedia(`(prefers-color-scheme: ${arguments[0]})`).matches", scheme, scheme)
            until(lambda: not window.get("document.getAnimations().length"), "nothing fades any more")
            found = browser.execute_script(LAYOUT)
            assert "\n".join(found["bad"]) == "" and found["texts"] > 40
            colours.add(found["colour"])
        assert len(colours) == 2
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
        metrics |= {"width": 1024, "height": 768}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


# a page that is up to no good ----------------------------------------------------------------------------------------

#: What a page of another origin tries; each must end with "no".
HOSTILE = """
const [base, done] = arguments;
const no = "no";
const socket = (address) => new Promise((end) => {
  const opened = new WebSocket(address.replace("http", "ws") + "socket");
  opened.onopen = () => { opened.send(JSON.stringify({ do: "pose.reset", edit: 1, vertices: null })); end("open"); };
  opened.onerror = () => end(no);
});
const element = (tag, options) => new Promise((end) => {
  const made = Object.assign(document.createElement(tag), options, { onload: () => end("loaded"), onerror: () => end(no) });
  document.head.append(made);
});
const read = (path, options) => fetch(path, options).then((answer) => answer.text()).then(() => "read", () => no);
const form = () => { const it = new FormData(); it.append("file", new Blob(["v 0 0 0"]), "evil.obj"); return it; };
const framed = (address, options = {}) => new Promise((end) => {
  const frame = Object.assign(document.createElement("iframe"), { src: address, ...options });
  frame.onload = () => { try { end(frame.contentWindow.document.body.innerHTML ? "seen" : no); } catch { end(no); } };
  document.body.append(frame);
});
const sandboxed = (address) => new Promise((end) => {
  addEventListener("message", ({ data }) => end(data), { once: true });
  const script = `const s = new WebSocket("${address.replace("http", "ws")}socket");
    s.onopen = () => parent.postMessage("open", "*"); s.onerror = () => parent.postMessage("no", "*");`;
  const frame = document.createElement("iframe");
  frame.sandbox = "allow-scripts";
  frame.srcdoc = "<script>" + script + "<" + "/script>";
  document.body.append(frame);
});
(async () => {
  const found = {};
  const root = new URL("/", base).href;
  for (const [name, address] of [["token", base], ["none", root], ["wrong", root + "A".repeat(32) + "/"]]) {
    found[name + " fetch"] = await read(address);
    found[name + " download"] = await read(address + "download/ball.npz");
    found[name + " upload"] = await read(address + "upload", { method: "POST", body: form() });
    await fetch(address + "upload", { method: "POST", body: form(), mode: "no-cors" }).catch(() => no);
    found[name + " socket"] = await socket(address);
    found[name + " image"] = await element("img", { src: address + "icons.svg" });
    found[name + " script"] = await element("script", { src: address + "vectors.js" });
    found[name + " module"] = await import(address + "vectors.js").then(() => "imported", () => no);
    found[name + " style"] = await element("link", { rel: "stylesheet", href: address + "style.css" });
    found[name + " frame"] = await framed(address);
    found[name + " null origin"] = await sandboxed(address);
  }
  done(found);
})();
"""


def test_a_page_of_another_origin_reaches_nothing(window: Window, browser: Any, editor: Any, tmp_path: Path) -> None:
    class Page(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><link rel=icon href='data:,'><body>")

        def log_message(self, format: str, *args: Any) -> None:
            pass

    lowest, _ = below(window)
    window.drag([lowest, lowest + [6, 6], lowest + [40, 30]])
    until(lambda: not np.array_equal(posed(editor), CAGE.vertices), "the cage is posed")
    assert window.console() == []
    window.driver.get("about:blank")
    until(lambda: not editor._server.clients, "the page has gone")
    document, files = editor.document, sorted(path.name for path in tmp_path.iterdir())
    numbers = editor._server._number
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Page)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        for host in ("127.0.0.1", "localhost"):
            browser.get(f"http://{host}:{server.server_address[1]}/")
            found = browser.execute_async_script(HOSTILE, editor.url)
            assert set(found.values()) == {"no"}, {name: got for name, got in found.items() if got != "no"}
            assert len(found) == 30
            browser.get("about:blank")  # the frames go
        until(lambda: not editor._server.clients, "frames have gone")
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
        window.open(editor.url)
        window.console()  # browsers say what they refused
    # A frame with the word in its address is the user's own page, as a notebook shows it; it alone was let in
    assert editor._server._number - numbers <= 3
    after = dataclasses.replace(editor.document, view=document.view)
    assert np.array_equal(posed(editor), document.edits[0].posed) and after.edits == document.edits
    names = {path.name for path in tmp_path.iterdir()} - {"ball.session.json"}
    assert names == set(files) - {"ball.session.json"}
