"""Several objects at the editor's page, in a real browser: added, placed by the mouse and by keys, keyed, exported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from editor_browser import CAGE, Window, editor, looks_cheap, on_page, tunnel, until, window
from editor_pages import green_field
from page_probe import projected

import warpcage
from warpcage.core import EASINGS
from warpcage.studio.editor import MAIN
from warpcage.studio.editor.work.uploads import loadable

__all__ = ["editor", "window"]  # fixtures


@pytest.fixture
def green(editor: Any, tmp_path: Path) -> str:
    """The file of a second field in the session's folder."""
    green_field().save(tmp_path / "green.npz")
    return "green.npz"


def add(window: Window, name: str) -> int:
    """Adds a field of the folder by the mouse, and gives its number."""
    window.unfold("objects")
    window.click("#object-add")
    window.wait('document.getElementById("ask-file")')
    names = window.get('[...document.getElementById("ask-file").options].map((one) => one.textContent)')
    window.choose("#ask-file", str(names.index(name)))
    window.confirm()
    window.wait("warpcage.store.sections.objects.length === 2", "two objects")
    return window.section("objects")[1]["id"]


def test_an_object_is_added_dragged_and_keyed(window: Window, editor: Any, green: str, tmp_path: Path) -> None:
    looks_cheap(window)
    number = add(window, green)
    beside = editor.document.scene_object(number).place
    assert beside.position[0] > 2.0 and beside.scale == 1.0  # upright, beside the ball
    assert window.section("edits") == []
    window.click("#mode label:has([value=place])")
    window.wait('warpcage.store.sections.settings.mode === "place"', "places are edited")
    window.press("Home")
    window.rest()
    window.press("K")
    until(lambda: len(editor.document.timeline.keys) == 1, "a key")

    # the handle of x moves it along x alone
    steps = len(editor.session.history.undo_steps)
    line = window.get('warpcage.viewport.handles().find(({name}) => name === "x").line')
    box = window.box
    begin = np.array(line[1]) + [box["left"], box["top"]]
    way = np.array(line[1]) - line[0]
    window.drag([begin + way * share for share in np.linspace(0.0, 1.0, 10)])
    until(lambda: len(editor.session.history.undo_steps) == steps + 1, "one step")
    moved = editor.document.scene_object(number).place
    assert moved.position[0] > beside.position[0] + 0.1
    np.testing.assert_allclose(moved.position[1:], beside.position[1:], atol=1e-9)
    shown = "Math.abs(warpcage.store.sections.objects[1].place.position[0] - arguments[0]) < 1e-9"
    window.wait(shown, "the page knows", moved.position[0])

    # keys turn and scale it about its middle, numbers are typed in the panel
    window.press("R", "Z", "9", "0", "Enter", "S", "0", ".", "5", "Enter")
    until(lambda: editor.document.scene_object(number).place.scale < 0.6, "it is scaled")
    place = editor.document.scene_object(number).place
    np.testing.assert_allclose([*place.turn, place.scale], [0, 0, 90, 0.5], atol=1e-6)
    np.testing.assert_allclose(place.position, moved.position, atol=1e-6)  # the middle of its box is its origin
    window.fill("#object-position-z", "1.25\n")
    until(lambda: editor.document.scene_object(number).place.position[2] == 1.25, "the typed number")
    window.press("Ctrl+Z")
    until(lambda: editor.document.scene_object(number).place == place, "undone")
    window.press("Ctrl+Shift+Z")
    until(lambda: editor.document.scene_object(number).place.position[2] == 1.25, "done again")

    # a click picks the ball, then the green one
    window.rest()
    ball = on_page(window, (0, 0, 0))
    window.drag([ball])
    window.wait("warpcage.store.sections.selection.object === arguments[0]", "the ball is picked", MAIN)
    assert [edit["id"] for edit in window.section("edits")] == [1]
    window.drag([on_page(window, editor.document.scene_object(number).place.position)])
    window.wait("warpcage.store.sections.selection.object === arguments[0]", "the green one is picked", number)

    window.press("T")  # where cages are posed a click beside them picks too
    window.wait('warpcage.store.sections.settings.mode === "pose"')
    window.drag([ball])
    window.wait("warpcage.store.sections.selection.object === arguments[0]", "the ball is picked", MAIN)
    window.drag([on_page(window, editor.document.scene_object(number).place.position)])
    window.wait("warpcage.store.sections.selection.object === arguments[0]", "the green one is picked", number)
    window.press("T")
    window.wait('warpcage.store.sections.settings.mode === "place"')

    # a second key, and the places between both
    window.fill("#time", "1\n")
    until(lambda: editor.document.time == 1.0, "one second")
    assert editor.document.scene_object(number).place == beside  # that of the only key
    window.press("G", "Z", "1", "Enter")
    until(lambda: editor.document.scene_object(number).place.position[2] > 0.9, "it is lifted")
    window.press("K")
    until(lambda: len(editor.document.timeline.keys) == 2, "two keys")

    # the stage that is saved is one of the library
    window.click("#stage-save")
    window.confirm()
    until((tmp_path / "scene.stage.json").exists, "the stage is written")
    stage = warpcage.Stage.load(tmp_path / "scene.stage.json")
    assert list(stage.items) == ["ball", "green"] and stage.length == 1.0

    # copied, locked, hidden and removed by the panel
    window.click("#object-copy")
    window.wait("document.querySelectorAll('#object-list li').length === 3")
    window.click("#object-list li:last-child .lock")
    window.wait("warpcage.store.sections.objects[2].locked && document.getElementById('object-remove').disabled")
    assert window.get("warpcage.viewport.handles().length") == 0
    window.click("#object-list li:last-child .lock")
    window.click("#object-list li:last-child .eye:not(.lock)")
    window.wait("!warpcage.store.sections.objects[2].visible && !document.getElementById('object-remove').disabled")
    window.click("#object-remove")
    window.confirm()
    window.wait("warpcage.store.sections.objects.length === 2")


def test_a_finger_drags_an_object(window: Window, editor: Any, green: str) -> None:
    looks_cheap(window)
    number = add(window, green)
    window.press("T")
    window.wait('warpcage.store.sections.settings.mode === "place"')
    eye = window.section("view")["eye"]
    window.press("Home")
    window.wait("String(warpcage.store.sections.view.eye) !== String(arguments[0])", "all is framed", eye)
    window.rest()
    before = editor.document.scene_object(number).place
    begin = on_page(window, before.moved([[0.3, 0, -0.4]])[0])

    def touch(kind: str, *places: Any) -> None:
        points = [{"x": float(x), "y": float(y), "id": 0} for x, y in places]
        window.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", begin)
    for step in range(1, 9):
        touch("touchMove", begin + np.array([5.0, -8.0]) * step)
    touch("touchEnd")
    until(lambda: editor.document.scene_object(number).place != before and not editor.session.moving, "it is moved")
    moved = editor.document.scene_object(number).place
    way = on_page(window, moved.position) - on_page(window, before.position)
    np.testing.assert_allclose(way, [40.0, -64.0], atol=1.0)


def test_cages_of_a_placed_object_are_posed_in_its_own_coordinates(window: Window, editor: Any) -> None:
    looks_cheap(window)
    turned = warpcage.Place((0.5, 0.0, 0.0), (0.0, 0.0, 90.0), 0.5)
    window.driver.execute_script(
        """return import("/" + arguments[0] + "/core/connection.js").then(({request}) => request(
        {do: "object.change", id: 0, place: {position: [0.5, 0, 0], turn: [0, 0, 90], scale: 0.5}}))""",
        window.address.split("/")[3],
    )
    until(lambda: editor.document.objects[0].place == turned, "it is placed")
    window.wait("warpcage.store.sections.objects[0].place.scale === 0.5")
    shown, box = window.places(), window.box
    there = turned.moved(CAGE.vertices)
    expected = [projected(window.section("view"), place, box["width"], box["height"])[:2] for place in there]
    np.testing.assert_allclose(shown, np.array(expected) + [box["left"], box["top"]], atol=1e-6)
    window.press("A", "G", "X", "0", ".", "4", "Enter")
    until(lambda: np.allclose(editor.posed[0].vertices, CAGE.vertices + [0.4, 0, 0], atol=1e-9), "along its own x")


def test_a_new_object_outside_the_view_is_reported_and_brought_in(window: Window, editor: Any, green: str) -> None:
    looks_cheap(window)
    window.press("K")
    window.wait("warpcage.store.sections.timeline.keys.length === 1")
    before = editor.document.timeline.keys[0].view
    add(window, green)
    window.wait("!document.getElementById('outside').hidden && !document.getElementById('outside-keys').hidden")
    assert window.get("document.getElementById('outside-text').textContent") == (
        '"green" is not fully in the view nor in 1 camera key.'
    )
    window.click("#outside-all")
    window.wait("document.getElementById('outside-all').hidden", "the view sees it")
    assert editor.document.timeline.keys[0].view == before
    window.click("#outside-keys")
    window.wait("document.getElementById('outside').hidden", "the camera of the key sees it")
    until(lambda: editor.document.timeline.keys[0].view != before, "the key is moved")
    window.press("Ctrl+Z")
    until(lambda: editor.document.timeline.keys[0].view == before, "undone")


@pytest.mark.parametrize("again", [True, False], ids=["the line comes back", "the line stays away"])
def test_a_connection_that_breaks_while_an_object_is_moved(window: Window, editor: Any, again: bool) -> None:
    looks_cheap(window)
    with tunnel(editor.url) as (line, address):
        window.open(address)
        window.press("T")
        window.wait('warpcage.store.sections.settings.mode === "place"')
        begin, box = on_page(window, (0.3, 0.0, -0.4)), window.box
        speed = 'document.getElementById("speed").textContent'
        window.wait(speed, "the header shows the speed of pictures")

        def moved_by() -> np.ndarray:
            """How far the object was moved, CSS pixels."""
            return on_page(window, editor.document.objects[0].place.position) - on_page(window, (0.0, 0.0, 0.0))

        window.point("mouseMoved", begin)
        window.point("mousePressed", begin, button="left")
        window.point("mouseMoved", begin + [10, 0], button="left")
        until(lambda: editor.document.objects[0].place != warpcage.Place(), "the move arrives")
        line.cut()
        window.wait(f"!warpcage.store.status.connected && !{speed}", "the page knows that the line is broken")
        assert window.box == box  # the view has not moved from under the pointer
        window.point("mouseMoved", begin + [30, 0], button="left")
        if again:
            line.restore()
            window.wait("warpcage.store.status.connected", "the page is connected again")
        window.point("mouseReleased", begin + [30, 0], button="left")
        if again:
            until(lambda: np.allclose(moved_by(), [30.0, 0.0], atol=1.0), "the server has the drag")
        else:
            window.wait("document.getElementById('toasts').textContent.includes('left out')", "it is said")
            np.testing.assert_allclose(moved_by(), [10.0, 0.0], atol=1.0)
        window.open(editor.url)
        window.console()  # what a browser says by itself of a socket that breaks


#: Holds back what goes to the editor and the pictures that come, until `go()`: each wait is as long as the test likes.
HOLD = """
const kept = [], speed = document.getElementById("speed");
const isHeld = (text) => window.held && String(text).includes(window.held);
window.hold = (text) => (window.held = text);
window.go = () => ((window.held = null), kept.splice(0).forEach((one) => one()));
const { fetch, createImageBitmap: decode } = window, { send } = WebSocket.prototype;
const unheld = (text) => isHeld(text) && new Promise((on) => kept.push(on));
window.fetch = async (...given) => (await unheld(given[0]), fetch(...given));
window.createImageBitmap = async (...given) => (await unheld("picture"), decode(...given));
WebSocket.prototype.send = function (text) {
  if (isHeld(text)) kept.push(() => send.call(this, text));
  else send.call(this, text);
};
"""


def test_the_page_offers_all_files_and_easings_that_the_server_knows(window: Window) -> None:
    window.unfold("objects")
    window.wait('document.getElementById("time-easing").options.length > 1', "easings")
    assert window.get('[...document.getElementById("time-easing").options].map(({value}) => value)') == [
        *EASINGS,
        "bezier",
    ]
    for kind, endings in loadable().items():
        clicked = "(input) => (input.onclick = () => false, input.click(), input.accept)"
        assert window.get(f'({clicked})(document.getElementById("{kind}-upload-file"))') == ",".join(endings)


@pytest.mark.parametrize(
    "held, said", [("upload", "Uploading green.npz"), ("object.add", "Reading green.npz"), ("picture", "First picture")]
)
def test_the_page_says_what_a_new_object_waits_for(window: Window, editor: Any, green: str, tmp_path: Path, held, said):
    looks_cheap(window)
    window.unfold("objects")
    window.rest()
    window.driver.execute_script(HOLD)
    (tmp_path / "mine").mkdir()
    (tmp_path / green).rename(tmp_path / "mine" / green)  # on the user's computer
    window.get("hold(arguments[0])", held)
    window.driver.find_element("id", "object-upload-file").send_keys(str(tmp_path / "mine" / green))
    window.wait("document.getElementById('speed').textContent.startsWith(arguments[0])", said, said)
    window.get("go()")
    window.wait("warpcage.store.sections.objects.length === 2", "it is in the scene")
    window.rest()
    window.wait("document.getElementById('speed').textContent.startsWith('at rest')", "nothing is waited for")


def shown(folder: Path) -> list[str]:
    """Names of the files in a folder that people see, and of the uploads that wait."""
    return sorted(one.name for one in folder.iterdir() if not one.name.endswith((".secret", "-lock", ".session.json")))


def test_an_upload_that_is_refused_or_cancelled_is_gone(window: Window, tmp_path: Path) -> None:
    sent = tmp_path / "sent"
    sent.mkdir()
    CAGE.save(sent / "cage.obj")
    (sent / "bad.obj").write_text("v 0 0 0\n")
    (sent / "bad.npz").write_bytes(b"no field")

    def upload(field: str, name: str) -> None:
        window.driver.find_element("css selector", field).send_keys(str(sent / name))

    def left(*names: str) -> None:
        until(lambda: shown(tmp_path) == ["ball.npz", *names, "sent"], f"{names} are left")

    upload("#object-upload-file", "bad.npz")
    window.wait("document.querySelector('.toast.error')?.textContent.includes('bad.npz is not a')")
    left()
    upload("#cage-upload-file", "cage.obj")  # asked for which edit
    window.wait("document.getElementById('ask-edit')")
    assert [name.endswith("-cage.obj") for name in shown(tmp_path)].count(True) == 1
    window.press("Escape")
    left()
    upload("#cage-upload-file", "bad.obj")
    window.wait("document.getElementById('ask-edit')")
    window.click("#dialog-confirm")
    window.wait("document.getElementById('dialog-error').textContent.includes('/bad.obj: no faces')")
    window.click("#dialog-cancel")
    left()
    upload("#cage-upload-file", "cage.obj")
    window.wait("document.getElementById('ask-edit')")
    window.confirm()
    window.wait("warpcage.store.sections.edits.length === 2")
    left("cage.obj")


NAMED = [
    ("film", "#time-export"),
    ("film", "#export-film"),
    ("film", "#export-cage"),
    ("film", "#export-poses"),
    ("film", "#export-bake"),
    ("objects", "#stage-save"),
]


def test_a_bad_name_keeps_its_dialog_and_messages_leave_download_free(window: Window, tmp_path: Path) -> None:
    metrics = {"width": 800, "height": 600, "deviceScaleFactor": 0.5, "mobile": False}
    window.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    try:
        window.unfold("jobs")
        said = window.get('document.getElementById("session-folder").title')
        assert f"go into {tmp_path}:" in said
        assert window.get('document.getElementById("session-folder").textContent') == f"Folder: {tmp_path.name}"
        for group, opener in NAMED:
            window.unfold(group)
            window.click(opener)
            window.wait("document.getElementById('ask-file')")
            window.fill("#ask-file", "a/b")
            window.click("#dialog-confirm")
            window.wait("document.getElementById('dialog-error')?.textContent.includes('without folders')")
            assert window.get("document.getElementById('ask-file').value") == "a/b"
            window.press("Escape")
            window.wait("!document.querySelector('dialog')")
        assert window.section("jobs") == []
        window.click("#export-cage")
        window.confirm()
        link = "document.querySelector('#work .job a[download]:not([hidden])')"
        window.wait(link)
        window.press("P")  # the panel, which lies over the view in a small window
        toast = "/core/dialogs.js').then(({ toast }) => toast(arguments[1] + ' and so on'.repeat(12), 'error'))"
        for number in range(4):
            window.driver.execute_script(
                f"return import('/' + arguments[0] + '{toast}", window.address.split("/")[3], number
            )
        box = window.get(f"{link}.getBoundingClientRect().toJSON()")
        middle = box["left"] + box["width"] / 2, box["top"] + box["height"] / 2
        assert window.get("document.elementFromPoint(arguments[0], arguments[1]).closest('a')?.download", *middle) == ""
    finally:
        window.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_a_coarse_picture_is_not_called_at_rest(window: Window) -> None:
    looks_cheap(window)
    window.rest()
    status = "warpcage.store.setStatus({fps: 0, frame: {...warpcage.store.status.frame, sharp: arguments[1]}})"
    text = "document.getElementById('speed').textContent.startsWith(arguments[0])"
    for sharp, said in ((False, "preview"), (True, "at rest")):
        # set at each look: one more picture may come, and is the one that is shown then
        window.wait(f"({status}, {text})", said, said, sharp)


def test_add_object_in_an_empty_folder_names_the_ways_there_are(window: Window, editor: Any, tmp_path: Path) -> None:
    (tmp_path / "ball.npz").unlink()
    window.unfold("objects")
    window.click("#object-add")
    said = window.wait("document.querySelector('#toasts > *')?.textContent")
    for button in ("upload", "copy"):
        assert window.get("document.getElementById(arguments[0]).textContent", f"object-{button}").rstrip("…") in said
