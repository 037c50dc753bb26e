"""Drags and keys on the editor's page, in a headless Chromium: what is sent, and broken connections."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import pytest
from page_probe import VIEW, Modules, drag, hull, pointer, press, projected
from scipy.spatial.transform import Rotation

# the wire ----------------------------------------------------------------------------------------------------------


def test_frames_are_taken_apart(page: Modules) -> None:
    header = json.dumps({"frame": 7, "width": 3}).encode()
    whole_header = header + b" " * (-len(header) % 8)
    jpeg, depth = bytes(range(13)), np.arange(6, dtype="<u2") * 9000
    sizes = (10, len(whole_header), len(jpeg), depth.nbytes)
    message = struct.pack("<4I", *sizes) + whole_header + jpeg + b"\0" * 3 + depth.tobytes()
    script = """
    const [bytes, done] = arguments;
    import("/core/connection.js").then(({ parseFrame }) => {
      const { header, jpeg, depth } = parseFrame(Uint8Array.from(bytes).buffer);
      done([header, [...jpeg], [...depth]]);
    });
    """
    found = page.driver.execute_async_script(script, list(message))
    assert found[0] == {"frame": 7, "width": 3} and found[1] == list(jpeg) and found[2] == depth.tolist()


@pytest.mark.parametrize(
    ("event", "name"),
    [
        ({"key": "g", "code": "KeyG"}, "G"),
        ({"key": "Z", "code": "KeyZ", "ctrlKey": True, "shiftKey": True}, "Ctrl+Shift+Z"),
        ({"key": "z", "code": "KeyZ", "metaKey": True}, "Ctrl+Z"),
        ({"key": "!", "code": "Digit1", "shiftKey": True}, "Shift+1"),
        ({"key": "?", "code": "Slash", "shiftKey": True}, "?"),
        ({"key": "+", "code": "Equal", "ctrlKey": True, "shiftKey": True}, "Ctrl++"),
        ({"key": "å", "code": "KeyA", "altKey": True}, "Alt+A"),
        ({"key": " ", "code": "Space"}, "Space"),
        ({"key": "ArrowUp", "code": "ArrowUp", "ctrlKey": True}, "Ctrl+ArrowUp"),
    ],
)
def test_keys_have_the_names_of_actions(page: Modules, event: dict[str, Any], name: str) -> None:
    assert page.call("panels/actions", "keyName", event) == name


def test_no_key_has_two_actions(page: Modules) -> None:
    script = """
    const [done] = arguments;
    const tools = ["box", "brush", "landmark", "ruler"].map((name) => `tools/${name}`);
    const names = ["core/store", "panels/actions", "view/selecting", ...tools];
    Promise.all(names.map((name) => import(`/${name}.js`))).then(([{ actions }]) =>
      done([...actions].map(([name, { label, keys, group }]) => ({ name, label, keys, group }))));
    """
    found = page.driver.execute_async_script(script)
    keys = [key for action in found for key in action["keys"]]
    assert len(keys) == len(set(keys)) > 40
    assert all(action["label"] and action["group"] for action in found)
    wanted = {"G": "transform.move", "Ctrl+I": "select.invert", "Ctrl++": "select.grow", "O": "proportional"}
    assert {key: action["name"] for action in found for key in action["keys"] if key in wanted} == wanted


# gestures ----------------------------------------------------------------------------------------------------------

#: The viewport on a canvas of 640 x 400, with a socket of the test's own that answers every command.
STAGE = """
const [edit, view, done] = arguments;
localStorage.clear();
window.sent = [];
class Socket {
  constructor() { this.bufferedAmount = 0; window.socket = this; }
  send(data) {
    if (typeof data !== "string") {
      const [kind, seq, edit] = new Uint32Array(data, 0, 4);
      window.sent.push({ do: "drag", kind, seq, edit, vertices: [...new Float64Array(data, 16)] });
      return;
    }
    const command = JSON.parse(data);
    window.sent.push(command);
    if ("n" in command) setTimeout(() => this.receive({ type: "reply", n: command.n, result: null }));
  }
  receive(message) { this.onmessage({ data: JSON.stringify(message) }); }
}
window.WebSocket = Socket;
const canvas = document.getElementById("view");
Object.assign(canvas.style, { position: "fixed", left: "0", top: "0", width: "640px", height: "400px" });
(async () => {
  const names = ["panels/actions", "view/selecting", "view/viewport", "view/pointer", "core/connection", "core/store"];
  const modules = await Promise.all(names.map((n) => import(`/${n}.js`)));
  const [actions, , viewport, pointer, connection, { store, run }] = modules;
  document.body.append(Object.assign(document.createElement("div"), { id: "notes" }));
  viewport.start(canvas);
  pointer.start(canvas);
  actions.listenToKeys();
  connection.connect();
  window.hello = (posed, vertices) => socket.receive({ type: "hello", client: 9, session: {}, sections: {
    edits: [{ ...edit, posed }], view, settings: { mode: "pose" }, session: { field: { up: [0, 0, 1] } },
    selection: { edit: 1, mode: "vertex", vertices } } });
  hello(edit.rest, []);
  window.warpcage = { store, viewport: viewport.viewport, run };
  canvas.focus();
  requestAnimationFrame(() => requestAnimationFrame(() => done(true)));
})().catch((error) => done(String(error.stack)));
"""


class Stage:
    """A viewport with a cage of 20 vertices; the picture covers 640 x 400 CSS pixels."""

    def __init__(self, page: Modules) -> None:
        self.driver = page.driver
        self.driver.refresh()
        self.points, self.faces = hull(20, 8)
        edit = {"id": 1, "name": "a", "kind": "move", "visible": True, "faces": self.faces.tolist()}
        started = self.driver.execute_async_script(STAGE, {**edit, "rest": self.points.tolist()}, VIEW)
        assert started is True, started
        self.size = float(np.linalg.norm(np.ptp(self.points, axis=0)))
        self.pixels = projected(VIEW, self.points)[:, :2]
        # A vertex that no other one is near to, and the next such
        apart = np.linalg.norm(self.pixels[:, None] - self.pixels[None], axis=2) + 1e3 * np.eye(20)
        self.clear = [int(i) for i in np.argsort(-apart.min(axis=1))]

    def do(self, script: str) -> Any:
        return self.driver.execute_script(script)

    def settle(self) -> None:
        """Waits until what was done was drawn, sent and answered."""
        script = (
            "const [done] = arguments; requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done, 20)))"
        )
        self.driver.execute_async_script(script)

    def set(self, name: str, value: Any) -> None:
        self.driver.execute_script("warpcage.store.setTool(arguments[0], arguments[1])", name, value)

    def sent(self, *kinds: str) -> list[dict[str, Any]]:
        self.settle()
        return [it for it in self.do("return sent") if it["do"] in kinds]

    def selected(self) -> list[int]:
        self.settle()
        chosen = self.do("return warpcage.store.sections.selection.vertices")
        sent = [it["vertices"] for it in self.do("return sent") if it["do"] == "select"]
        assert not sent or sent[-1] == chosen  # the server knows
        return chosen

    def click(self, place: Any, keys: int = 0) -> None:
        drag(self.driver, [(float(place[0]), float(place[1]))] * 2, keys=keys)

    def posed(self) -> np.ndarray:
        """The newest vertices that were sent."""
        return np.reshape(self.sent("drag")[-1]["vertices"], (-1, 3))


@pytest.fixture
def stage(page: Modules) -> Stage:
    return Stage(page)


def test_clicks_select_add_and_remove(stage: Stage) -> None:
    first, second = stage.clear[:2]
    stage.click(stage.pixels[first])
    assert stage.selected() == [first]
    stage.click(stage.pixels[second], keys=8)
    assert stage.selected() == sorted([first, second])
    stage.click(stage.pixels[first], keys=2)
    assert stage.selected() == [second]
    stage.click((5, 395))
    assert stage.selected() == []


def test_a_drag_of_a_vertex_selects_and_moves_it_in_the_view_plane(stage: Stage) -> None:
    vertex = stage.clear[0]
    start = stage.pixels[vertex]
    drag(stage.driver, [tuple(start), tuple(start + [10, 5]), tuple(start + [50, 20])])
    assert stage.selected() == [vertex]
    posed = stage.posed()
    pixels = projected(VIEW, posed[vertex])
    np.testing.assert_allclose(pixels[:2], start + [50, 20], atol=0.6)
    assert np.isclose(pixels[2], projected(VIEW, stage.points[vertex])[2])
    assert np.array_equal(np.delete(posed, vertex, 0), np.delete(stage.points, vertex, 0))
    steps = stage.sent("drag.begin", "drag.end")
    assert [it["do"] for it in steps] == ["drag.begin", "drag.end"] and steps[1]["cancel"] is False
    assert steps[0]["label"] == "Move a vertex"


def test_escape_takes_a_drag_back(stage: Stage) -> None:
    x, y = map(float, stage.pixels[stage.clear[0]])
    pointer(stage.driver, "mousePressed", x, y, button="left")
    pointer(stage.driver, "mouseMoved", x + 40, y, button="left")
    stage.settle()
    press(stage.driver, "Escape")
    pointer(stage.driver, "mouseReleased", x + 40, y, button="left")
    assert stage.sent("drag.end")[-1]["cancel"] is True
    assert np.array_equal(stage.posed(), stage.points)


def test_the_keyboard_alone_selects_and_moves_by_numbers(stage: Stage) -> None:
    press(stage.driver, "Ctrl+ArrowRight")
    (first,) = stage.selected()
    press(stage.driver, "Ctrl+ArrowRight", "Ctrl+ArrowRight", "Ctrl+ArrowRight", "Ctrl+ArrowRight", "Ctrl+ArrowRight")
    (last,) = stage.selected()
    assert stage.pixels[last, 0] > stage.pixels[first, 0]
    press(stage.driver, "Ctrl+Shift+ArrowLeft")
    chosen = stage.selected()
    assert len(chosen) == 2
    press(stage.driver, "G", "X", "0", ".", "2", "5", "Enter")
    expected = stage.points.copy()
    expected[chosen, 0] += 0.25
    np.testing.assert_allclose(stage.posed(), expected, atol=1e-15)
    press(stage.driver, "R", "Z", "9", "0", "Enter")
    pivot = expected[chosen].mean(axis=0)
    expected[chosen] = pivot + Rotation.from_euler("z", 90, degrees=True).apply(expected[chosen] - pivot)
    np.testing.assert_allclose(stage.posed(), expected, atol=1e-12)
    press(stage.driver, "S", "Shift+Z", "2", "Enter")  # in the plane across Z
    pivot = expected[chosen].mean(axis=0)
    expected[chosen] = pivot + (expected[chosen] - pivot) * [2, 2, 1]
    np.testing.assert_allclose(stage.posed(), expected, atol=1e-12)


@pytest.mark.parametrize("late", [False, True], ids=["ended while broken", "ends afterwards"])
@pytest.mark.parametrize("there", ["as it began", "as it was sent", "changed elsewhere"])
def test_a_drag_survives_a_broken_connection(stage: Stage, there: str, late: bool) -> None:
    vertex = stage.clear[0]
    x, y = map(float, stage.pixels[vertex])
    for kind, across in (("mousePressed", 0.0), ("mouseMoved", 40.0)):
        pointer(stage.driver, kind, x + across, y, button="left")
    theirs = {"as it began": stage.points, "as it was sent": stage.posed()}.get(there, stage.points + 0.1)
    stage.do("window.broken = socket; sent.length = 0; socket.onclose()")
    pointer(stage.driver, "mouseMoved", x + 80, y, button="left")
    stage.settle()
    if not late:
        pointer(stage.driver, "mouseReleased", x + 80, y, button="left")
    while stage.do("return socket === broken"):
        stage.settle()
    stage.driver.execute_script("hello(...arguments)", theirs.tolist(), [vertex])
    if late:
        pointer(stage.driver, "mouseReleased", x + 80, y, button="left")
    sent = stage.sent("drag.begin", "drag", "drag.end", "pose.set")
    kept = np.reshape(stage.do('return import("/view/cages.js").then(({ cages }) => [...cages.get(1).posed])'), (-1, 3))
    if there == "changed elsewhere":
        assert sent == [] and "changed elsewhere" in stage.do("return document.getElementById('toasts').textContent")
        np.testing.assert_array_equal(kept, theirs)
        return
    assert [it["do"] for it in sent] == (["drag.begin", "drag", "drag.end"] if late else ["pose.set"])
    assert sent[0]["label"] == "Move a vertex"
    np.testing.assert_array_equal(np.ravel(sent[late]["vertices"]), kept.ravel())
    np.testing.assert_allclose(projected(VIEW, kept[vertex])[:2], [x + 80, y], atol=0.6)


def test_a_handle_of_the_gizmo_moves_along_its_axis(stage: Stage) -> None:
    vertex = stage.clear[0]
    stage.click(stage.pixels[vertex])
    press(stage.driver, "Shift+G")
    handles = {it["name"]: it for it in stage.do("return warpcage.viewport.handles()")}
    start, end = np.array(handles["z"]["line"])
    assert 50 < np.linalg.norm(end - start) < 90  # the same on the screen at any distance
    way = (end - start) / np.linalg.norm(end - start)
    drag(stage.driver, [tuple(end - 5 * way), tuple(end + 20 * way)])
    step = stage.posed()[vertex] - stage.points[vertex]
    assert step[2] > 0 and np.allclose(step[:2], 0)


def test_one_pose_is_sent_a_frame_and_the_newest_only_where_the_socket_is_full(stage: Stage) -> None:
    vertex = stage.clear[0]
    x, y = map(float, stage.pixels[vertex])
    moves = """
    const [x, y] = arguments;
    const event = (name, dx) => document.getElementById("view").dispatchEvent(new PointerEvent(name, { bubbles: true,
      clientX: x + dx, clientY: y, button: name === "pointermove" ? -1 : 0, buttons: 1, pointerId: 1 }));
    if (arguments[2]) event("pointerdown", 0);
    for (let i = 0; i <= 100; i += 1) event("pointermove", i);
    """
    stage.driver.execute_script(moves, x, y, True)
    assert 1 <= len(stage.sent("drag")) <= 2
    stage.do("socket.bufferedAmount = 1e9; sent.length = 0")
    stage.driver.execute_script(moves, x, y, False)
    assert stage.sent("drag") == []
    stage.do("socket.bufferedAmount = 0")
    assert len(stage.sent("drag")) == 1
    np.testing.assert_allclose(projected(VIEW, stage.posed()[vertex])[:2], [x + 100, y], atol=0.1)
    press(stage.driver, "Escape")


def frame(number: int, applied: int, depth: float, **more: Any) -> list[int]:
    """The bytes of a grey picture whose matter is everywhere at a depth."""
    simplejpeg = pytest.importorskip("simplejpeg")
    jpeg = simplejpeg.encode_jpeg(np.full((10, 16, 3), 128, np.uint8), quality=50)
    near, far = 0.1, 100.0
    value = round(1 + 65534 * np.log(depth / near) / np.log(far / near))
    depths = np.full((10, 16), value, "<u2").tobytes()
    map_ = {"width": 16, "height": 10, "near": near, "far": far}
    content = {"frame": number, "applied": {"9": applied}, "width": 16, "height": 10, "view": VIEW, "depth": map_}
    content |= more
    header = json.dumps(content).encode()
    header += b" " * (-len(header) % 8)
    sizes = struct.pack("<4I", 10, len(header), len(jpeg), len(depths))
    return list(sizes + header + jpeg + b"\0" * (-len(jpeg) % 8) + depths)


HEAR = "for (const bytes of arguments[0]) socket.onmessage({ data: Uint8Array.from(bytes).buffer })"


def test_pictures_are_shown_newest_only_and_answered_for(stage: Stage) -> None:
    x, y = map(float, stage.pixels[stage.clear[0]])
    pointer(stage.driver, "mousePressed", x, y, button="left")
    pointer(stage.driver, "mouseMoved", x + 30, y, button="left")
    seq = stage.sent("drag")[-1]["seq"]
    stage.driver.execute_script(HEAR, [frame(n, seq if n == 5 else 0, 5.0) for n in range(1, 6)])
    for _ in range(20):
        seen = [it["frame"] for it in stage.sent("seen")]
        if seen and seen[-1] == 5:
            break
    assert seen[-1] == 5 and len(seen) < 5 and seen == sorted(seen)
    latencies = stage.do("return warpcage.viewport.latencies")
    assert len(latencies) >= 1 and min(latencies) > 0
    assert stage.do("return warpcage.store.status.frame.frame") == 5
    pointer(stage.driver, "mouseReleased", x + 30, y, button="left")


def test_what_is_hidden_is_picked_only_through(stage: Stage) -> None:
    depth = 4.5  # the middle of the cage
    stage.driver.execute_script(HEAR, [frame(1, 0, depth)])
    while not stage.sent("seen"):
        pass
    distance = np.linalg.norm(stage.points - VIEW["eye"], axis=1)
    hidden = distance > depth + 0.015 * stage.size
    sure = np.abs(distance - depth - 0.015 * stage.size) > 1e-2
    assert 3 < hidden.sum() < 17
    assert np.array_equal(np.array(stage.do("return warpcage.viewport.hidden(1)"), bool)[sure], hidden[sure])
    for through in (True, False):
        stage.set("through", through)
        drag(stage.driver, [(2, 2), (300, 200), (638, 398)])
        chosen = np.isin(np.arange(20), stage.selected())
        assert np.array_equal(chosen[sure], (~hidden | through)[sure])


def test_fingers_turn_zoom_and_pan(stage: Stage) -> None:
    def touch(kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places)]
        stage.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    before = stage.do("return warpcage.viewport.view")
    touch("touchStart", (20, 380))
    for x in (40, 60, 80):
        touch("touchMove", (x, 380))
    touch("touchEnd")
    stage.settle()
    after = stage.do("return warpcage.viewport.view")
    assert after["target"] == before["target"] and not np.allclose(after["eye"], before["eye"])
    away = [np.linalg.norm(np.subtract(it["eye"], it["target"])) for it in (before, after)]
    assert np.isclose(*away)
    touch("touchStart", (300, 200))
    touch("touchStart", (300, 200), (340, 200))
    touch("touchMove", (290, 200), (350, 200))
    touch("touchMove", (280, 200), (360, 200))
    touch("touchEnd")
    stage.settle()
    nearer = stage.do("return warpcage.viewport.view")
    assert np.isclose(np.linalg.norm(np.subtract(nearer["eye"], nearer["target"])), away[0] / 2, rtol=0.02)
    assert next(it["moving"] for it in stage.sent("view")) is True


def test_a_switch_says_whether_a_finger_orbits_or_selects(stage: Stage) -> None:
    def swipe(*path: tuple[float, float]) -> list[int]:
        for kind, places in (("touchStart", path[:1]), *(("touchMove", [at]) for at in path[1:]), ("touchEnd", ())):
            points = [{"x": x, "y": y} for x, y in places]
            stage.driver.execute_cdp_cmd("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        return stage.selected()

    def says() -> str:
        return stage.do('return document.getElementById("finger-hint").textContent')

    assert stage.do('return document.getElementById("finger-mode").hidden')  # with a mouse
    around = [(2.0, 2.0), (300.0, 200.0), (638.0, 398.0)]
    assert swipe(*around) == [] and says().startswith("A drag orbits")
    eye = stage.do("return warpcage.viewport.view.eye")
    assert not np.allclose(eye, VIEW["eye"])
    assert not stage.do('return document.getElementById("finger-mode").hidden')
    stage.do('document.getElementById("finger-select").click()')
    assert says().startswith("A drag selects")
    assert swipe(*around) == list(range(20)) and stage.do("return warpcage.viewport.view.eye") == eye
    stage.set("tool", "move")
    assert swipe((2.0, 2.0), (3.0, 20.0), (4.0, 30.0)) == []
    stage.do('document.getElementById("finger-orbit").click()')
    assert swipe(*around) == [] and stage.do("return warpcage.viewport.view.eye") != eye


def test_the_dialog_of_a_film_says_what_it_takes(stage: Stage) -> None:
    def note() -> str:
        stage.settle()
        return stage.do('return document.getElementById("dialog-note").textContent')

    def fill(name: str, value: str) -> None:
        script = """
        const field = document.getElementById(`ask-${arguments[0]}`);
        field.value = arguments[1];
        field.dispatchEvent(new Event("input", { bubbles: true }));
        """
        stage.driver.execute_script(script, name, value)

    stage.do('warpcage.store.set("timeline", { keys: [], frames: 100, length: 4, fps: 25, loop: "once" })')
    stage.do('warpcage.store.set("session", { folder: "/films", field: { up: [0, 0, 1] } })')
    stage.driver.execute_async_script(
        'const [done] = arguments; import("/panels/exports.js").then((it) => (it.exportFilm(), done()))'
    )
    fill("width", "640")
    fill("height", "400")
    assert note() == (
        "100 frames (the first and the last moment are both shown) of 640 x 400 pixels, into /films/film.mp4. "
        "Time and file size: unknown until a first frame was rendered."
    )
    for number, render in enumerate((5000.0, 0.0625, 0.0625)):  # the first one waited for its kernels
        times = {"pose": 300.0, "render": render}
        stage.driver.execute_script(HEAR, [frame(number + 1, 0, 5.0, sharp=True, ms=times)])
        stage.settle()
    stage.do("warpcage.store.setStatus({})")
    assert "Takes about 40 s and " in note()
    fill("width", "1280")
    fill("height", "800")
    assert "Takes about 70 s and " in note()
    before = note()
    shown = 'return !document.getElementById("ask-transparent").closest("label").hidden'
    assert not stage.do(shown)
    fill("what", "4")  # PNG pictures
    assert note() != before and stage.do(shown)
    stage.do('warpcage.store.set("timeline", { ...warpcage.store.sections.timeline, frames: 10000 })')
    fill("file", "mine")
    assert "Takes about 2 h" in note()
    stage.do('warpcage.store.set("settings", { ...warpcage.store.sections.settings, supersampling: 3 })')
    stage.do("warpcage.store.setStatus({})")
    assert "unknown until" in note()
    stage.do("document.getElementById('dialog-confirm').click()")
    (sent,) = stage.sent("export")
    assert (sent["what"], sent["file"], sent["transparent"], sent["width"]) == ("png", "mine", True, 1280)


def test_wheel_other_buttons_and_keys_move_the_view(stage: Stage) -> None:
    eyes = []
    for do in (
        lambda: pointer(stage.driver, "mouseWheel", 300, 200, deltaX=0, deltaY=120),
        lambda: drag(stage.driver, [(300, 200), (340, 220)], button="middle"),
        lambda: drag(stage.driver, [(300, 200), (340, 220)], button="middle", keys=8),
        lambda: drag(stage.driver, [(300, 200), (340, 220)], button="right"),
        lambda: drag(stage.driver, [(5, 200), (45, 220)], keys=1),
        lambda: press(stage.driver, "Shift+1"),
        lambda: press(stage.driver, "Home"),
    ):
        do()
        stage.settle()
        eyes.append(stage.do("return warpcage.viewport.view.eye"))
        assert not any(np.allclose(eyes[-1], other) for other in [VIEW["eye"], *eyes[:-1]])
    assert stage.sent("select") == [] and stage.sent("drag.begin") == []
    assert np.allclose(np.array(eyes[-1])[:1], stage.do("return warpcage.viewport.view.target")[0])  # from the front
