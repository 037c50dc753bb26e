"""The editor in a real browser, as a person uses it: from a lasso to a film, by mouse and by keys alone."""

from __future__ import annotations

import contextlib
import shlex
import urllib.request
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from editor_browser import CAGE, CELLS, Window, below, editor, looks_cheap, posed, settle, tunnel, until, window
from editor_pages import layered_field, tiny_field
from page_probe import looked, projected

import warpcage
from warpcage.field import harmonics_on_host
from warpcage.studio.editor import View, checked_view

__all__ = ["editor", "window"]  # fixtures


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
    before = len(editor.session.history.undo_steps)
    window.drag([start + way * share for share in np.linspace(0.0, 1.0, 12)])
    settle(editor, before + 1)

    # NumPy: the middle of the selection goes where the pointer went, in the plane of the view through it
    rest = CAGE.vertices
    middle = rest[inside].mean(axis=0)
    right, up, back = looked(view)
    pixel = 2 * np.tan(np.radians(view["fov"]) / 2) * ((np.array(view["eye"]) - middle) @ back) / box["height"]
    offset = pixel * (way[0] * right - way[1] * up)
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
    deformer = warpcage.Deformer(tiny_field(), CAGE, coordinates="mean_value", resolution=CELLS)
    moved = deformer.pose(editor.posed[0]).render(eye).rgb
    still = deformer.pose(CAGE).render(eye).rgb
    inner = slice(0, int(0.8 * height)), slice(0, int(0.8 * width))  # the compass is in a corner
    wrong = np.abs(shown[inner] - moved[inner]).mean()
    assert wrong < 0.005 and np.abs(shown[inner] - still[inner]).mean() > 5 * wrong


def test_keys_a_film_and_its_files(window: Window, editor: Any, tmp_path: Path) -> None:
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

    window.rest()
    window.click("#time-export")
    for field, value in (("#ask-width", "48"), ("#ask-height", "32")):
        window.fill(field, value)
    note = window.wait('document.getElementById("dialog-note")?.textContent')
    size = "5 frames (the first and the last moment are both shown) of 48 x 32 pixels"
    assert note.startswith(f"{size}, into {tmp_path}/film.mp4. Takes ") and "MB" in note
    window.confirm()
    job = window.job(1)
    assert job["state"] == "done", job
    film = iio.imread(tmp_path / "film.mp4", plugin="pyav")
    assert film.shape == (5, 32, 48, 3)  # 0, 1/8, ... 1/2 s
    assert np.abs(film[0].astype(float) - film[-1]).mean() > 0.3
    # over the view, wherever the panel is scrolled to
    link = window.wait('document.querySelector("#work .job a[download]:not([hidden])")?.href')
    assert urllib.request.urlopen(link).read() == (tmp_path / "film.mp4").read_bytes()

    window.click("#export-cage")
    window.confirm()
    assert window.job(2)["state"] == "done"
    names = "[...document.querySelectorAll(arguments[0])].map((it) => it.textContent)"
    newest_first = ["Write posed.obj", "Write film.mp4"]
    window.wait(f"String({names}) === arguments[1]", "", "#work .row-name", ",".join(newest_first))
    assert window.get(names, "#job-list .row-name") == newest_first
    for _ in newest_first:
        window.click("#work .job .button.flat:not([hidden])")
    window.wait("!document.querySelector('#work .job')")
    assert len(window.section("jobs")) == 2
    cage = warpcage.Cage.load(tmp_path / "posed.obj")
    np.testing.assert_allclose(cage.vertices, bent, atol=1e-8)
    assert np.array_equal(cage.faces, CAGE.faces)

    window.click("#export-command")
    window.fill("#ask-file", "again.mp4")
    for field, value in (("#ask-width", "48"), ("#ask-height", "32")):
        window.fill(field, value)
    window.click("#dialog-confirm")
    printed = window.wait('document.querySelector("dialog textarea, dialog pre, dialog code")')
    arguments = shlex.split(printed.get_attribute("value") or printed.text)
    assert arguments[0] == "warpcage" and arguments[-5:] == ["-o", "again.mp4", "--size", "48", "32"]
    assert not editor.session.unsaved  # the file that the command reads
    window.press("Escape")


# a page that comes again ----------------------------------------------------------------------------


def test_a_reloaded_page_has_the_same_state(window: Window, editor: Any) -> None:
    looks_cheap(window)
    lowest, _ = below(window)
    window.drag([lowest, lowest + [6, 6], lowest + [40, 30]])
    window.press("K")
    window.wait("warpcage.store.sections.timeline.keys.length === 1")
    window.drag([lowest + [-150, -200], lowest + [-130, -190], lowest + [-90, -190]], keys=1)
    until(lambda: editor.document.view == view_of(window), "the server has the view")
    before = window.sections()
    window.reload()
    assert window.sections() == before


def view_of(window: Window) -> View:
    """Where a window looks from, whether the server knows or not."""
    return checked_view(window.get("warpcage.viewport.view"))


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
    window.tab_to("export-film")
    window.press("Enter")
    window.wait('document.getElementById("dialog-confirm")')
    window.type("mine.gif")
    for value in ("G", "40", "30"):  # GIF in the list of formats
        window.press("Tab")
        window.type(value)
    window.press("Enter")
    assert window.job(1)["state"] == "done", window.section("jobs")
    assert iio.imread(tmp_path / "mine.gif").shape[1:3] == (30, 40)
    assert window.get("document.activeElement.id") == "export-film"  # where the person was


def lying_field() -> warpcage.VoxelField:
    """The ball in a world whose y axis points down, as in captures of splats."""
    ball = tiny_field()
    sh = harmonics_on_host(ball.grid.sh)
    return warpcage.VoxelField(ball.bounds, ball.grid.links, ball.grid.density, sh, up=(0, -1, 0))


@pytest.mark.parametrize("editor", [lying_field], indirect=True)
def test_sliders_pose_what_is_selected_upwards_and_keep_their_value(window: Window, editor: Any) -> None:
    rest, upper = CAGE.vertices, CAGE.vertices[:, 1] < 0

    def amount() -> float:
        return float(window.get('document.getElementById("preset-twist-amount").value'))

    def twist(degrees: int, count: int) -> None:
        window.fill("#preset-twist-amount", f"{degrees}\n")
        settle(editor, count)
        until(lambda: amount() == degrees, "the slider keeps its value")

    window.fill("#preset-from", "50\n")  # the upper half
    twist(40, 1)
    np.testing.assert_allclose(posed(editor), CAGE.twist(40, axis="-y", limits=(0.5, 1)).vertices, atol=1e-9)
    assert not np.allclose(posed(editor)[upper], rest[upper]) and np.allclose(posed(editor)[~upper], rest[~upper])
    place = window.get('document.getElementById("preset-twist").getBoundingClientRect().toJSON()')
    start = np.array([place["left"] + place["width"] * (0.5 + 40 / 720), place["top"] + place["height"] / 2])
    window.drag([start, start + [20, 0], start + [35, 0]])  # goes on from there
    settle(editor, 2)
    until(lambda: amount() > 45, "the field shows where the slider is")
    reached = window.wait("warpcage.store.sections.edits[0].sliders?.amounts.twist")
    assert amount() == reached
    wanted = CAGE.twist(reached, axis="-y", limits=(0.5, 1)).vertices
    np.testing.assert_allclose(posed(editor), wanted, atol=1e-9)
    window.press("Ctrl+Z")
    until(lambda: amount() == 40, "the slider goes back with the pose")

    bent = posed(editor)
    window.fill("#preset-from", "0\n")
    until(lambda: amount() == 0, "other limits begin anew")
    box, middle = window.box, np.median(window.places()[:, 0])
    window.drag([(box["right"] - 5, box["bottom"] - 5), (middle + 40, box["top"] + 100), (middle, box["top"] + 60)])
    chosen = np.array(until(lambda: editor.document.selection.vertices, "some are selected"))
    assert 5 < len(chosen) < 40
    window.wait('document.getElementById("preset-on").textContent.includes(arguments[0])', "", f"({len(chosen)})")
    twist(25, 3)  # the undone step is gone, the selection is one
    others = np.setdiff1d(np.arange(len(rest)), chosen)
    np.testing.assert_array_equal(posed(editor)[others], bent[others])
    assert not np.allclose(posed(editor)[chosen], bent[chosen])
    window.press("Ctrl+I")
    until(lambda: amount() == 0, "of something else sliders say nothing")


def test_a_cage_on_the_other_side(window: Window, editor: Any) -> None:
    window.click("#cage-mirror")
    window.fill("#ask-place", "2")
    window.confirm()
    until(lambda: len(editor.document.edits) == 2, "there is a mirrored edit")
    np.testing.assert_allclose(editor.document.edits[1].rest, CAGE.vertices * [-1, 1, 1] + [4, 0, 0], atol=1e-12)


def test_walls_and_fragments_are_set_on_the_page(window: Window, editor: Any) -> None:
    looks_cheap(window)
    assert not window.get('document.querySelector("#edit-falloff").checkVisibility()')  # a beginner does not meet them
    window.unfold("advanced")
    assert window.get('document.querySelector("#edit-held").closest(".field").hidden')  # nothing is held yet
    window.fill("#edit-falloff", "0.25\n")
    until(lambda: editor.document.edits[0].falloff == 0.25, "the width of the band is kept")
    until(lambda: window.get('!document.querySelector("#edit-held").closest(".field").hidden'), "walls are offered")
    window.choose("#edit-held", "still")
    until(lambda: editor.document.edits[0].held == "still", "the walls are kept")
    window.fill("#edit-fragments", "0.4\n")
    until(lambda: editor.document.edits[0].fragments == 0.4, "the size of fragments is kept")
    window.press("Ctrl+Z")
    until(lambda: window.get("document.querySelector('#edit-fragments').valueAsNumber") == 0, "undo shows in the field")
    window.choose("#edit-kind", "remove")
    until(lambda: window.get('document.querySelector("#edit-falloff").closest(".field").hidden'), "nothing to fade")
    assert editor.document.edits[0].cage_edit.falloff == 0.0
    window.unfold("view")
    assert window.get('document.querySelector("#fill").closest("label").hidden')  # this field has no layers


@pytest.mark.parametrize("editor", [layered_field], indirect=True)
def test_filling_is_set_on_the_page_of_a_field_with_layers(window: Window, editor: Any) -> None:
    looks_cheap(window)
    window.unfold("view")
    until(lambda: window.get('!document.querySelector("#fill").closest("label").hidden'), "filling is offered")
    window.click("#fill")
    until(lambda: editor.document.settings.fill, "filling is kept")
    window.click("#show-masks")
    until(lambda: window.get('!document.querySelector(".swatch.filled").closest("li").hidden'), "the legend says so")


def test_a_pose_that_no_key_holds_is_marked_and_gone_back_to(window: Window, editor: Any) -> None:
    window.click("#time-add")
    window.wait("warpcage.store.sections.timeline.keys.length === 1")
    window.click("#track")  # the middle of the film
    until(lambda: editor.document.time > 0, "the head is in the middle")
    window.rest()
    assert not window.get("document.querySelector('#time-unkeyed').checkVisibility()")
    lowest, _ = below(window)
    window.drag([lowest, lowest + [8, 8], lowest + [50, 60]])
    window.wait("document.querySelector('#time-unkeyed').checkVisibility()")
    bent, middle = posed(editor), editor.document.time
    window.click("#time-first")
    window.wait("document.querySelector('.mark.left').checkVisibility()")
    assert f"left at {middle:.2f} s" in window.get("document.querySelector('#toasts').textContent")
    window.click(".mark.left")
    until(lambda: np.array_equal(posed(editor), bent) and editor.document.time == middle, "pose and time are back")
    window.wait("!document.querySelector('.mark.left').checkVisibility()")


def test_a_page_goes_on_with_the_next_editor_or_says_that_it_cannot(browser: Any, tmp_path: Path) -> None:
    tiny_field().save(tmp_path / "ball.npz")
    with contextlib.ExitStack() as stack:
        with warpcage.edit(tmp_path / "ball.npz", CAGE) as first:
            line, address = stack.enter_context(tunnel(first.url))  # as an editor that takes its port again
            browser.get(address)
            window = Window(browser, address)
            window.wait("warpcage.store.status.connected")
        line.cut()
        window.wait("!warpcage.store.status.connected")
        with warpcage.edit(tmp_path / "ball.npz") as second:
            line.target = second.server.port
            line.restore()
            window.wait("warpcage.store.status.connected")
        line.cut()
        (tmp_path / ".ball.session.secret").unlink()
        with warpcage.edit(tmp_path / "ball.npz") as third:
            line.target = third.server.port
            line.restore()
            window.wait("document.querySelector('#connection').title.includes('open the address it printed')")
    browser.get("about:blank")
    browser.get_log("browser")  # that nothing answered is logged there


@pytest.mark.nightly
def test_each_setting_of_the_schema_has_a_field_that_sets_it(window: Window, editor: Any) -> None:
    described = window.section("session")["settings"]
    assert described.keys() == editor.session.document.settings.to_json().keys()
    for group in ("edits", "advanced", "view"):
        window.unfold(group)
    for name, schema in described.items():
        values = {value for value, *_ in schema.get("labels", ())} - {schema.get("default")}
        if name in ("background", "show", "mode") or schema.get("type") == "boolean":
            continue  # fields of their own: colours, rows of choices, the bar's, and what only layers show
        for value in sorted(values, key=str)[:3]:
            window.choose(f"#{name}", str(value))
            until(lambda: getattr(editor.session.document.settings, name) == value, f"{name} is {value}")  # noqa: B023
    window.click("#show-alpha + span")
    until(lambda: editor.session.document.settings.show == "alpha", "the opacity is shown")
    window.choose("#background", "black")
    until(lambda: editor.session.document.settings.background == "black", "what is behind is black")
