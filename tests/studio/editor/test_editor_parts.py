"""Parts made interactively on the editor's page, in a real browser: boxes, a ruler, a brush, and curves of keys."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from editor_browser import CAGE, Window, editor, looks_cheap, on_page, settle, until, window
from editor_pages import tiny_field
from polygon_cages import quad_box
from scenes import LAMP, TableScene

import warpcage
from warpcage.cage import mirror_axes
from warpcage.studio.editor import view_camera
from warpcage.view import eased_share

__all__ = ["editor", "window"]  # fixtures

#: Radius of the ball of `tiny_field`.
RADIUS = np.sqrt(0.3)


def line(begin: Any, end: Any, steps: int = 8) -> np.ndarray:
    return np.linspace(begin, end, steps)


def draw_box(window: Window, editor: Any) -> Any:
    """Draws a box around the ball with the mouse; gives the edit."""
    looks_cheap(window)
    count = len(editor.document.edits)
    window.press("D")
    window.wait('warpcage.store.sections.settings.mode === "rest" && warpcage.store.tools.tool === "box"')
    window.rest()
    middle = on_page(window, (0, 0, 0))
    side = np.cross((0, 0, 1), editor.document.view.eye)
    reach = 1.15 * np.linalg.norm(on_page(window, RADIUS * side / np.linalg.norm(side)) - middle)
    window.drag(line(middle - reach, middle + reach))
    until(lambda: len(editor.document.edits) == count + 1, "there is a box")
    window.wait("warpcage.store.sections.edits.length === arguments[0]", "", count + 1)
    return editor.document.edits[-1]


def handle(window: Window, edit: Any, normal: Any) -> tuple[np.ndarray, np.ndarray]:
    """The middle of a face of a box on the page, and where it would be a tenth of a unit farther out."""
    on = [i for i in range(8) if (edit.rest[i] - edit.rest.mean(axis=0)) @ normal > 0]
    middle = edit.rest[on].mean(axis=0)
    return on_page(window, middle), on_page(window, middle + 0.1 * np.asarray(normal))


# boxes -------------------------------------------------------------------------------------------------------------


def test_a_box_is_drawn_around_what_is_seen(window: Window, editor: Any) -> None:
    edit = draw_box(window, editor)
    assert (len(edit.rest), len(edit.faces), edit.kind) == (8, 12, "move")
    assert editor.document.selection.edit == edit.id
    np.testing.assert_array_equal(edit.rest, edit.posed)
    low, high = edit.rest.min(axis=0), edit.rest.max(axis=0)
    assert all(np.isin(edit.rest[:, k], (low[k], high[k])).all() for k in range(3))  # along the world's axes
    # the ball is in it, but for the sliver that the eye does not see, and little else
    np.testing.assert_allclose(high - low, 2 * RADIUS, rtol=0.35)
    axes = np.vstack([np.eye(3), -np.eye(3)]) * RADIUS
    eye = np.array(editor.document.view.eye)
    seen = axes[axes @ eye > RADIUS**2]
    assert len(seen) >= 2 and edit.rest_cage.contains(0.9 * seen).all()
    edit.rest_cage.require_usable("it")


def test_faces_of_a_box_are_dragged_at_rest_and_undone(window: Window, editor: Any) -> None:
    edit = draw_box(window, editor)
    steps = len(editor.session.history.undo_steps)
    eye = np.array(editor.document.view.eye)
    normal = np.eye(3)[int(np.argmax(np.abs(eye[:2])))] * np.sign(eye[int(np.argmax(np.abs(eye[:2])))])
    at, out = handle(window, edit, normal)
    window.drag(line(at, at + 2 * (out - at), 12))
    settle(editor, steps + 1)
    moved = editor.document.edits[-1]
    face = (edit.rest - edit.rest.mean(axis=0)) @ normal > 0
    offset = moved.rest - edit.rest
    assert np.array_equal(offset[~face], np.zeros((4, 3)))
    np.testing.assert_allclose(offset[face], np.tile(offset[face][0], (4, 1)), atol=1e-12)
    np.testing.assert_allclose(offset[face][0], 0.2 * normal, atol=0.03)  # as the pointer went, along the normal alone
    np.testing.assert_allclose(np.cross(offset[face][0], normal), 0.0, atol=1e-12)
    np.testing.assert_array_equal(moved.posed - moved.rest, edit.posed - edit.rest)  # the pose has not changed
    assert "Move a face" in str(editor.session.history.summary()["undo_label"])

    # inwards it stops before the face across from it
    at, out = handle(window, moved, normal)
    window.drag(line(at, at - 40 * (out - at), 16))
    settle(editor, steps + 2)
    thin = editor.document.edits[-1]
    assert 0 < np.ptp(thin.rest @ normal) < 0.1 * np.ptp(moved.rest @ normal)
    thin.rest_cage.require_usable("it")
    assert window.get('document.getElementById("redo").disabled')
    window.press("Ctrl+Z", "Ctrl+Z")
    until(lambda: np.array_equal(editor.document.edits[-1].rest, edit.rest), "both drags are undone")
    window.press("Ctrl+Shift+Z")
    until(lambda: np.array_equal(editor.document.edits[-1].rest, moved.rest), "one is done again")

    # Escape in mid-drag takes it back; Cage makes it a cage to pose
    at, out = handle(window, moved, normal)
    window.point("mouseMoved", at)
    window.point("mousePressed", at, button="left")
    window.point("mouseMoved", out, button="left")
    until(lambda: not np.array_equal(editor.document.edits[-1].rest, moved.rest), "the face follows")
    window.press("Escape")
    until(lambda: np.array_equal(editor.document.edits[-1].rest, moved.rest), "Escape takes it back")
    window.point("mouseReleased", out, button="left")
    window.click("#box-cage")
    until(lambda: len(editor.document.edits[-1].rest) == 26, "the box is a cage")
    window.wait('warpcage.store.sections.settings.mode === "pose" && warpcage.store.tools.tool === "select"')


def test_where_nothing_is_seen_a_box_stands_on_the_ground(window: Window, editor: Any) -> None:
    looks_cheap(window)
    window.press("D")
    window.wait('warpcage.store.sections.settings.mode === "rest"')
    window.rest()
    low, high = np.array([0.95, -0.95, -1.0]), np.array([1.6, -0.5, -1.0])
    corners = np.array([on_page(window, (x, y, -1)) for x in (low[0], high[0]) for y in (low[1], high[1])])
    begin, end = corners.min(axis=0), corners.max(axis=0)
    window.drag(line(begin, end))
    until(lambda: len(editor.document.edits) == 2, "there is a box")
    rest = editor.document.edits[-1].rest
    assert rest[:, 2].min() == -1.0  # the ground is the plane beneath the field
    seen = view_camera(editor.document.view, *(round(window.box[name]) for name in ("width", "height")))
    pixels, _ = seen.project(rest[rest[:, 2] == -1.0])
    inside = np.array([begin, end]) - [window.box["left"], window.box["top"]]
    assert (pixels.min(axis=0) <= inside[0] + 1).all() and (pixels.max(axis=0) >= inside[1] - 1).all()
    sides = np.ptp(rest, axis=0)
    assert sides[2] == pytest.approx(sides[:2].min())


def test_a_finger_draws_a_box_and_a_second_one_leaves_it(window: Window, editor: Any) -> None:
    def touch(kind: str, *places: Any) -> None:
        points = [{"x": float(x), "y": float(y), "id": i} for i, (x, y) in enumerate(places)]
        window.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    looks_cheap(window)
    window.click("#tool-box")
    window.wait('warpcage.store.sections.settings.mode === "rest"')
    window.rest()
    middle = on_page(window, (0, 0, 0))
    touch("touchStart", middle - 80)
    touch("touchMove", middle)
    touch("touchStart", middle, middle + 60)
    touch("touchMove", middle, middle + 90)
    touch("touchEnd")
    window.rest()
    assert len(editor.document.edits) == 1  # a pinch is no box
    middle = on_page(window, (0, 0, 0))
    touch("touchStart", middle - 80)
    for share in (0.3, 0.6, 1.0):
        touch("touchMove", middle - 80 + 160 * share)
    touch("touchEnd")
    until(lambda: len(editor.document.edits) == 2, "there is a box")
    assert len(editor.document.edits[-1].rest) == 8


# the ruler ---------------------------------------------------------------------------------------------------------


def test_the_ruler_measures_between_two_places_of_the_surface(window: Window, editor: Any) -> None:
    looks_cheap(window)
    window.click("#tool-ruler")
    window.rest()
    eye = np.array(editor.document.view.eye)
    toward = eye / np.linalg.norm(eye)
    side = np.cross((0, 0, 1.0), toward)
    side /= np.linalg.norm(side)
    places = [RADIUS * (np.cos(a) * toward + np.sin(a) * side) for a in (-0.5, 0.5)]
    for place in places:
        at = on_page(window, place)
        window.drag([at, at])
    said = window.wait('document.getElementById("ruler-value").textContent.includes("units") && '
                       'document.getElementById("ruler-value").textContent')  # fmt: skip
    long, parts = said.split(" units: ")
    found = np.array([float(part.split(" ")[1]) for part in parts.split(", ")])
    # voxels of an eighth: their surface is not to the digit where the ball's is
    np.testing.assert_allclose(found, places[1] - places[0], atol=0.06)
    assert float(long) == pytest.approx(np.linalg.norm(found), rel=2e-3)
    before = window.canvas()
    window.press("Escape")
    window.wait('warpcage.store.tools.tool === "select"')
    assert window.get('document.getElementById("ruler-options").hidden')
    gone = np.abs(window.canvas().astype(int) - before).max(axis=2) > 60
    assert gone.sum() > 400  # the line and its plate are no longer drawn
    assert len(editor.document.edits) == 1 and editor.document.selection.vertices == ()


def test_the_ruler_says_where_nothing_is_seen_and_measures_on_the_grid(window: Window, editor: Any) -> None:
    window.click("#tool-ruler")
    window.rest()
    place = on_page(window, (1.4, 0.0, -1.0))
    window.drag([place, place])
    window.wait('document.getElementById("toasts").textContent.includes("Nothing is seen there")')
    window.press("Shift+D")
    for point in ((1.4, 0.0, -1.0), (1.4, 0.5, -1.0)):
        place = on_page(window, point)
        window.drag([place, place])
    said = window.get('document.getElementById("ruler-value").textContent')
    assert float(said.split(" units")[0]) == pytest.approx(0.5, abs=0.02) and "z 0" in said


# the brush ---------------------------------------------------------------------------------------------------------


def test_a_brush_paints_and_takes_away_the_selection(window: Window, editor: Any) -> None:
    looks_cheap(window)
    window.press("V")
    window.wait('warpcage.store.tools.pick === "brush"')
    sizes = [window.get("warpcage.store.tools.brush")]
    window.press("]", "]", "]", "[")
    sizes.append(window.wait("warpcage.store.tools.brush"))
    assert sizes[1] > sizes[0] and editor.document.selection.vertices == ()  # no step from vertex to vertex
    radius, places = sizes[1], window.places()
    box = window.box
    begin = np.array([box["left"], box["top"]]) + [0.3 * box["width"], 0.35 * box["height"]]
    end = begin + [0.35 * box["width"], 0.25 * box["height"]]

    def within(one: np.ndarray, two: np.ndarray, slack: float) -> set[int]:
        way = two - one
        share = np.clip((places - one) @ way / max(way @ way, 1e-9), 0, 1)
        return set(
            np.flatnonzero(np.linalg.norm(places - one - share[:, None] * way, axis=1) <= radius + slack).tolist()
        )

    window.drag(line(begin, end, 20))
    chosen = until(lambda: set(editor.document.selection.vertices), "the stroke selects")
    assert within(begin, end, -4) <= chosen <= within(begin, end, 4) and 2 < len(chosen) < 30
    first = next(iter(within(begin, end, -4)))
    window.drag([places[first], places[first]], keys=1)  # Alt: a dab that takes away
    until(lambda: first not in editor.document.selection.vertices, "Alt takes away")
    left = set(editor.document.selection.vertices)
    assert left <= chosen and chosen - left <= within(places[first], places[first], 4)
    other = next(i for i in range(len(places)) if i not in chosen)
    window.drag([places[other], places[other]])
    until(lambda: {other, *left} <= set(editor.document.selection.vertices), "another dab adds")
    assert np.array_equal(editor.posed[0].vertices, CAGE.vertices)  # nothing was moved by painting
    window.click("#pick-rectangle")


@functools.cache
def table() -> TableScene:
    return TableScene(degrees=8.0, floor=False, fragments=False)


@pytest.mark.parametrize(("pick", "heights"), [("rectangle", (0.4, 0.4)), ("brush", (0.42, 0.36))])
@pytest.mark.parametrize("editor", [lambda: table().field], indirect=True, ids=["table"])
def test_a_click_or_a_stroke_on_an_object_makes_a_cage_around_it(
    window: Window, editor: Any, pick: str, heights: tuple[float, float]
) -> None:
    window.click(f"#pick-{pick}")
    window.rest()
    lamp = [on_page(window, table().world((-0.05, 0.0, height))) for height in heights]
    window.click("#cage-click")
    window.drag(line(*lamp, 6))
    job = window.job(1)
    assert job["state"] == "done", job
    until(lambda: len(editor.document.edits) == 2, "there is a cage around the lamp")
    inside = editor.document.edits[1].rest_cage.contains(table().cells)
    assert inside[(table().labels == LAMP) & (table().heights() > 0.09)].all()
    assert not inside[(table().labels != LAMP) & (table().labels > 0)].any()
    assert editor.document.selection.vertices == ()


# curves of keys ----------------------------------------------------------------------------------------------------


def test_handles_of_a_curve_are_dragged_in_the_graph(window: Window, editor: Any) -> None:
    looks_cheap(window)
    window.click("#time-add")
    until(lambda: len(editor.document.timeline.keys) == 1, "there is a key")
    window.fill("#time", "4\n")
    until(lambda: editor.document.time == 4.0, "four seconds")
    window.rest()
    window.press("A", "G", "X", "0", ".", "4", "Enter")
    until(lambda: np.allclose(editor.posed[0].vertices[:, 0], CAGE.vertices[:, 0] + 0.4), "the cage is moved")
    window.click("#time-add")
    until(lambda: len(editor.document.timeline.keys) == 2, "there are two keys")
    window.click("#time-first")
    assert window.get('document.getElementById("curve-handle-1").hidden')
    window.choose("#time-easing", "bezier")
    until(lambda: isinstance(editor.document.timeline.keys[0].easing, dict), "the key has a curve")
    window.wait('!document.getElementById("curve-handle-1").hidden')
    numbers = editor.document.timeline.keys[0].easing["bezier"]
    np.testing.assert_allclose(numbers, [1 / 3, 0, 2 / 3, 1], atol=0.01)  # as it was: smooth between two keys

    lane = window.get('document.querySelector(".lane.tall").getBoundingClientRect().toJSON()')
    steps = len(editor.session.history.undo_steps)
    for number, (x, y) in ((1, (0.8, 0.1)), (2, (0.9, 1.25))):
        box = window.get(f'document.getElementById("curve-handle-{number}").getBoundingClientRect().toJSON()')
        at = np.array([box["left"] + box["width"] / 2, box["top"] + box["height"] / 2])
        across = x / 1.25  # the timeline shows a quarter more than the film
        to = np.array([lane["left"] + across * lane["width"], lane["top"] + (0.75 - 0.5 * y) * lane["height"]])
        window.drag(line(at, to, 10))
        settle(editor, steps + number)
    numbers = editor.document.timeline.keys[0].easing["bezier"]
    np.testing.assert_allclose(numbers, [0.8, 0.1, 0.9, 1.25], atol=0.03)
    assert window.get('document.getElementById("time").value') == "0"  # the head has not moved

    # the film goes by it
    window.fill("#time", "3\n")
    there = CAGE.vertices[:, 0] + 0.4 * eased_share({"bezier": numbers}, 0.75)
    until(lambda: np.allclose(editor.posed[0].vertices[:, 0], there, atol=1e-9), "the cage goes by the curve")

    # numbers in the panel, and what cannot be
    window.click("#time-first")
    window.unfold("keys")
    window.fill("#key-curve", "0.2, -0.3, 0.4, 1\n")
    until(lambda: editor.document.timeline.keys[0].easing == {"bezier": [0.2, -0.3, 0.4, 1.0]}, "numbers are taken")
    window.fill("#key-curve", "2, 0, 0, 1\n")
    window.wait('document.getElementById("toasts").textContent.includes("x1 of easing must be")')
    window.choose("#key-easing", "linear")
    until(lambda: editor.document.timeline.keys[0].easing == "linear", "a name again")
    window.wait('document.getElementById("curve-handle-1").hidden')


def test_keys_of_cameras_alone_have_curves_and_escape_leaves_a_drag(window: Window, editor: Any) -> None:
    looks_cheap(window)
    window.unfold("keys")
    window.click("#key-add-camera")
    until(lambda: len(editor.document.timeline.keys) == 1, "there is a key")
    window.fill("#time", "2\n")
    window.click("#view")
    window.press("Shift+1")
    window.wait("warpcage.viewport.picture?.sharp")
    until(lambda: abs(editor.document.view.eye[0] - editor.document.view.target[0]) < 1e-6, "it looks from the front")
    window.click("#key-add-camera")
    until(lambda: len(editor.document.timeline.keys) == 2, "there are two keys")
    window.click("#time-first")
    window.choose("#time-easing", "bezier")
    window.wait('!document.getElementById("curve-handle-1").hidden')
    before = editor.document.timeline.keys[0].easing
    box = window.get('document.getElementById("curve-handle-1").getBoundingClientRect().toJSON()')
    at = np.array([box["left"] + box["width"] / 2, box["top"] + box["height"] / 2])
    window.point("mouseMoved", at)
    window.point("mousePressed", at, button="left")
    window.point("mouseMoved", at + [60, -20], button="left")
    moved = 'document.getElementById("curve-handle-1").getBoundingClientRect().left'
    window.wait(f"{moved} > arguments[0] + 40", "the handle follows", box["left"])
    window.press("Escape")
    window.wait(f"Math.abs({moved} - arguments[0]) < 1", "it is back", box["left"])
    window.point("mouseReleased", at + [60, -20], button="left")
    assert editor.document.timeline.keys[0].easing == before
    window.drag(line(at, at + [60, -20]))
    until(lambda: editor.document.timeline.keys[0].easing != before, "a whole drag is kept")


def test_a_move_of_the_camera_becomes_keys(window: Window, editor: Any) -> None:
    looks_cheap(window)
    window.unfold("keys")
    window.click("#camera-move")
    window.wait("document.getElementById('ask-move')")
    window.choose("#ask-move", "2")
    window.confirm()
    until(lambda: len(editor.document.timeline.keys) == 3, "a quarter is two parts")
    keys = editor.document.timeline.keys
    assert [key.time for key in keys] == [0.0, 2.0, 4.0] and all(key.view and key.poses is None for key in keys)
    window.click("#camera-move")
    window.fill("#ask-typed", "spin:3")
    window.click("#dialog-confirm")
    window.wait('document.getElementById("dialog-error").textContent.includes("is not a move")')
    assert window.get('document.getElementById("ask-typed").value') == "spin:3"  # what was typed stays
    window.press("Escape")
    assert editor.document.timeline.keys == keys


def test_quads_have_no_diagonals_and_are_picked_whole(browser: Any, tmp_path: Path) -> None:
    tiny_field().save(tmp_path / "ball.npz")
    cage = quad_box(2).scale(0.7)
    with warpcage.edit(tmp_path / "ball.npz", cage) as editor:
        browser.switch_to.window(browser.window_handles[0])
        browser.get(editor.url)
        window = Window(browser, editor.url)
        window.press("3")
        window.wait('warpcage.store.sections.selection.mode === "face"')
        assert [list(face) for face in cage.polygons] == window.section("edits")[0]["faces"]
        places = window.places()
        for face in cage.polygons:  # one of those that look at the eye lies under each middle
            middle = places[list(face)].mean(axis=0)
            window.point("mousePressed", middle, button="left", clickCount=1)
            window.point("mouseReleased", middle, button="left", clickCount=1)
            window.wait("warpcage.store.sections.selection.vertices.length === 4")
            assert tuple(window.section("selection")["vertices"]) in {tuple(sorted(each)) for each in cage.polygons}
        assert window.console() == []
        browser.get("about:blank")


def test_a_generated_cage_takes_quads_symmetry_and_a_focus(
    window: Window, editor: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, make = [], warpcage.Cage.from_field
    monkeypatch.setattr(warpcage.Cage, "from_field", lambda *a, **o: asked.append(o) or make(*a, **o))
    looks_cheap(window)
    window.press("1")
    upper = np.flatnonzero(CAGE.vertices[:, 2] > 0.3)
    places = window.places()[upper]
    window.drag([places.min(axis=0) - 12, places.mean(axis=0), places.max(axis=0) + 3])
    until(lambda: set(upper) & set(editor.document.selection.vertices), "vertices are selected")
    selected = editor.document.selection.vertices
    assert CAGE.vertices[list(selected), 2].min() > -0.1
    window.wait("warpcage.store.sections.selection.vertices.length === arguments[0]", "", len(selected))
    window.unfold("cage")
    window.click("#cage-generate")
    window.wait("document.querySelector('#ask-focus')")
    assert window.get("document.querySelector('#ask-finer').closest('[hidden]') !== null")
    chosen = {"edit": "A new edit", "symmetry": "Where the object nearly is", "detail": "Limbs and gaps",
              "faces": "Quads, where they hold", "focus": f"About the {len(selected)} selected vertices"}  # fmt: skip
    for name, label in chosen.items():
        labels = window.get(f"[...document.querySelector('#ask-{name}').options].map((each) => each.textContent)")
        window.choose(f"#ask-{name}", str(labels.index(label)))
    assert window.get("document.querySelector('#ask-finer').closest('[hidden]') === null")
    window.fill("#ask-count", "40")
    window.fill("#ask-finer", "4")
    window.confirm()
    assert window.job(1)["state"] == "done"
    cage = editor.document.edits[-1].rest_cage
    assert len(editor.document.edits) == 2 and sum(len(face) == 4 for face in cage.polygons) > 0.7 * cage.face_count
    assert "x" in mirror_axes(cage.vertices)
    (options,) = asked
    assert (options["detail"], options["finer"]) == ("parts", 4.0)
    assert len(options["focus"]) >= len(selected) and options["focus"][:, 2].min() > -0.1
    window.press("Ctrl+Z")
    until(lambda: len(editor.document.edits) == 1, "it is taken back")
