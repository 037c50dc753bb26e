"""A person at the editor's page in a real browser: windows that are looked at, pointed at and typed into."""

from __future__ import annotations

import base64
import contextlib
import io
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

pytest.importorskip("aiohttp")
pytest.importorskip("simplejpeg")

from editor_pages import tiny_field
from page_probe import drag, pointer, press, projected

import warpcage

#: Seconds that anything may take before it counts as not happening. Nothing waits longer than it must.
PATIENCE = 120.0

#: What is on the page and takes the pointer; whether its middle keeps its place for two frames with nothing over it.
PLACE = """
const found = document.querySelector(arguments[0]);
if (!found) return null;
const inView = () => { const b = found.getBoundingClientRect(); return [b.left + b.width / 2, b.top + b.height / 2]; };
found.scrollIntoView({ block: "nearest", inline: "nearest" });
const [x, y] = inView();
return new Promise((done) => {
  setTimeout(done, 200);  // a page that is behind another has no frames
  requestAnimationFrame(() => requestAnimationFrame(done));
}).then(() => {
  const top = document.elementFromPoint(x, y), still = String(inView()) === String([x, y]);
  const free = found === top || found.contains(top) || Boolean(top?.closest("label")?.contains(found));
  return { x, y, free: free && still };
});
"""

#: From here on a press beside an element does nothing: the page moved between the look at it and the press.
AIM = """
const kinds = ["pointerdown", "mousedown", "pointerup", "mouseup", "click"], selector = arguments[0];
const guard = (event) => {
  if (event.type === "pointerdown") {
    const found = document.querySelector(selector), hit = event.target;
    aim.missed = !(found && (found.contains(hit) || hit.closest("label")?.contains(found)));
  }
  if (aim.missed) {
    event.stopImmediatePropagation();
    event.preventDefault();
  }
};
const aim = { missed: false, end: () => kinds.forEach((kind) => removeEventListener(kind, guard, true)) };
kinds.forEach((kind) => addEventListener(kind, guard, true));
window.clickAim = aim;
"""

#: Whether that press missed.
MISSED = "const aim = window.clickAim; delete window.clickAim; aim?.end(); return Boolean(aim?.missed);"


def until(condition: Callable[[], Any], what: str, seconds: float = PATIENCE) -> Any:
    """Wait until a condition gives something true, and return it; fails with `what` where it never does."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, f"this did not happen in {seconds:g} s: {what}"
        time.sleep(0.03)
    return found


class Window:
    """One window of a browser at the editor's page.

    Args:
        driver: Of `page_probe.chromium`, at the window.
        address: Of the editor.
    """

    def __init__(self, driver: Any, address: str) -> None:
        self.driver, self.address, self.handle = driver, address, driver.current_window_handle
        self.open()

    def open(self, address: str | None = None) -> None:
        """Open the page, or another address of it, and wait until it is connected and shows a picture."""
        self.address = address or self.address
        self.front()
        self.driver.get(self.address)
        self.wait("warpcage.store.status.connected && warpcage.store.status.frame", "the page is connected")

    def reload(self) -> None:
        self.front()
        self.driver.refresh()
        self.wait("window.warpcage?.store.status.connected && warpcage.store.status.frame", "the page is back")

    def front(self) -> None:
        """What is done from now on is done in this window."""
        self.driver.switch_to.window(self.handle)

    # -- Looking

    def get(self, expression: str, *given: Any) -> Any:
        """What an expression of the page is; `arguments` are those given."""
        return self.driver.execute_script(f"return {expression}", *given)

    def wait(self, expression: str, what: str = "", *given: Any) -> Any:
        """Wait until an expression of the page is true, and return it."""
        said = what or expression

        def look() -> Any:
            return self.driver.execute_script(f"return window.warpcage ? ({expression}) : null", *given)

        return until(look, said)

    def section(self, name: str) -> Any:
        """A section of the state, as this page has it."""
        return self.get("warpcage.store.sections[arguments[0]]", name)

    def sections(self) -> dict[str, Any]:
        """All that pages of one session share."""
        names = ("edits", "selection", "settings", "view", "timeline", "playback", "history")
        return {name: self.section(name) for name in names}

    def posed(self, number: int = 1) -> np.ndarray:
        """(v, 3) what this page draws as the posed cage of an edit."""
        script = """
        return import("/" + arguments[1] + "/view/cages.js").then(({cages}) => [...cages.get(arguments[0]).posed]);
        """
        token = self.address.split("/")[3]
        return np.reshape(self.driver.execute_script(script, number, token), (-1, 3))

    @property
    def box(self) -> dict[str, float]:
        """The rectangle of the view."""
        return self.get('document.getElementById("view").getBoundingClientRect().toJSON()')

    def places(self, number: int = 1) -> np.ndarray:
        """(v, 2) where the vertices of an edit are on the page, CSS pixels."""
        box = self.box
        script = (
            "warpcage.store.sections.edits.find(({id}) => id === arguments[0])"
            ".rest.map((_, i) => warpcage.viewport.project(arguments[0], i))"
        )
        return np.array(self.get(script, number)) + [box["left"], box["top"]]

    def rest(self) -> dict[str, Any]:
        """Wait until the picture is sharp and shows what the hand did last; return its header."""
        self.wait(
            "warpcage.viewport.picture?.sharp && !warpcage.viewport.operation && warpcage.viewport.picture"
            " && (warpcage.store.status.frame === warpcage.viewport.picture)",
            "a sharp picture",
        )
        return self.get("warpcage.viewport.picture")

    def canvas(self) -> np.ndarray:
        """(h, w, 3) what the view shows, as bytes."""
        script = """
        const [done] = arguments;
        requestAnimationFrame(() => requestAnimationFrame(() =>
          done(document.getElementById("view").toDataURL("image/png"))));
        """
        data = self.driver.execute_async_script(script)
        return np.asarray(iio.imread(io.BytesIO(base64.b64decode(data.partition(",")[2])), extension=".png"))[..., :3]

    def console(self) -> list[dict[str, Any]]:
        """What the console got since it was asked last, of all windows."""
        return self.driver.get_log("browser")

    # -- Pointing

    def click(self, selector: str) -> None:
        """Click an element with the mouse; it must be there and nothing may lie over it."""

        def look() -> Any:
            place = self.driver.execute_script(PLACE, selector)
            if not (place and place["free"]):
                return False
            self.driver.execute_script(AIM, selector)
            self.drag([(place["x"], place["y"])])
            return not self.driver.execute_script(MISSED)

        until(look, f"{selector} can be clicked", 20.0)

    def confirm(self) -> None:
        """Confirm the dialog and wait until it is gone, which is when the server has answered."""
        self.click("#dialog-confirm")
        self.wait("!document.querySelector('dialog')")

    def drag(self, path: Any, keys: int = 0) -> None:
        """Drag along places of the page."""
        drag(self.driver, [(float(x), float(y)) for x, y in path], keys=keys)

    def point(self, kind: str, place: Any, **more: Any) -> None:
        """One event of the mouse; see `page_probe.pointer`."""
        pointer(self.driver, kind, float(place[0]), float(place[1]), **more)

    def choose(self, selector: str, value: str) -> None:
        """Choose from a list."""
        from selenium.webdriver.common.by import By
        from selenium.webdriver.support.ui import Select

        Select(self.driver.find_element(By.CSS_SELECTOR, selector)).select_by_value(value)

    def unfold(self, group: str) -> None:
        """Unfold a group of the side panel."""
        if not self.get(f'document.getElementById("group-{group}").open'):
            self.click(f"#group-{group}-fold")
            self.wait("document.getElementById(`group-${arguments[0]}`).open", f"{group} is unfolded", group)

    # -- Typing

    def press(self, *strokes: str) -> None:
        """Press keys at what has the focus; see `page_probe.press`."""
        press(self.driver, *strokes)

    def type(self, text: str) -> None:
        """Type a text at what has the focus; a line's end is Enter."""
        self.press(*("Enter" if letter == "\n" else letter for letter in text))

    def fill(self, selector: str, text: str) -> None:
        """Write into a field in place of what is in it, with the mouse and the keyboard."""
        self.click(selector)
        self.driver.execute_script("document.querySelector(arguments[0]).select()", selector)
        self.type(text)

    def tab_to(self, wanted: str, most: int = 150) -> None:
        """Press Tab until an element has the focus: that with this id."""
        for _ in range(most):
            if self.get("document.activeElement.id") == wanted:
                return
            self.press("Tab")
        raise AssertionError(f"{most} times Tab do not lead to {wanted}")

    # -- Jobs

    def job(self, count: int) -> dict[str, Any]:
        """Wait until so many jobs were begun and have ended; return the last one."""
        self.wait(
            "(warpcage.store.sections.jobs ?? []).length === arguments[0]"
            ' && warpcage.store.sections.jobs.every(({state}) => state !== "running")',
            f"{count} jobs have ended",
            count,
        )
        return self.section("jobs")[-1]


class Tunnel:
    """A forwarded port, as ssh has it, that can break.

    Args:
        port: Where it leads, on this machine.

    Attributes:
        port: Where it begins.
    """

    def __init__(self, port: int) -> None:
        self.target, self.port = port, 0
        self.ends: list[socket.socket] = []
        self.lock = threading.Lock()
        self.restore()

    def restore(self) -> None:
        """Take connections, on the same port as before."""
        self.listener = socket.create_server(("127.0.0.1", self.port))
        self.port = self.listener.getsockname()[1]
        threading.Thread(target=self.accept, args=(self.listener,), daemon=True).start()

    def cut(self) -> None:
        """Break all connections at once, and refuse new ones."""
        with contextlib.suppress(OSError):
            self.listener.shutdown(socket.SHUT_RDWR)
        self.listener.close()
        with self.lock:
            ends, self.ends = self.ends, []
        for end in ends:
            with contextlib.suppress(OSError):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def accept(self, listener: socket.socket) -> None:
        while True:
            try:
                near, _ = listener.accept()
                far = socket.create_connection(("127.0.0.1", self.target))
            except OSError:
                return
            with self.lock:
                self.ends += [near, far]
            for one, other in ((near, far), (far, near)):
                threading.Thread(target=self.carry, args=(one, other), daemon=True).start()

    @staticmethod
    def carry(one: socket.socket, other: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := one.recv(65536):
                other.sendall(data)
        with contextlib.suppress(OSError):
            other.shutdown(socket.SHUT_WR)


@contextlib.contextmanager
def tunnel(address: str) -> Iterator[tuple[Tunnel, str]]:
    """A tunnel to an editor, and the editor's address through it."""
    scheme, _, host, token, _ = address.split("/")
    opened = Tunnel(int(host.rpartition(":")[2]))
    try:
        yield opened, f"{scheme}//127.0.0.1:{opened.port}/{token}/"
    finally:
        opened.cut()


# what tests begin with ---------------------------------------------------------------------------------------------

#: A cage of 42 vertices around the ball.
CAGE = warpcage.Cage.icosphere((0.0, 0.0, 0.0), 0.8, subdivisions=1)

#: Cells of the lattices that pictures of `looks_cheap` are made with.
CELLS = 24


@pytest.fixture
def editor(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    """An editor of a ball, or of the field that the parameter makes."""
    getattr(request, "param", tiny_field)().save(tmp_path / "ball.npz")
    with warpcage.edit(tmp_path / "ball.npz", CAGE) as opened:
        yield opened


@pytest.fixture
def window(browser: Any, editor: Any) -> Iterator[Window]:
    """A window at the editor, with what a new user's browser has kept: nothing. Its console stays empty."""
    browser.switch_to.window(browser.window_handles[0])
    pointer(browser, "mouseMoved", 1, 1)  # what it was over before would be drawn as pointed at
    origin = "/".join(editor.url.split("/")[:3])
    browser.execute_cdp_cmd("Storage.clearDataForOrigin", {"origin": origin, "storageTypes": "local_storage"})
    browser.get_log("browser")
    opened = Window(browser, editor.url)
    yield opened
    opened.front()
    assert opened.console() == []
    browser.get("about:blank")


def settle(editor: Any, count: int) -> None:
    """Wait until the server's history has so many steps."""
    until(lambda: len(editor.session.history.undo_steps) == count, f"{count} steps of undo")


def posed(editor: Any) -> np.ndarray:
    return editor.posed[0].vertices


def looks_cheap(window: Window) -> None:
    """Sets what pictures are cheap with, as a person does."""
    window.unfold("advanced")
    window.choose("#resolution", str(CELLS))
    window.wait("warpcage.store.sections.settings.resolution === arguments[0]", "", CELLS)
    window.choose("#coordinates", "mean_value")
    window.wait('warpcage.store.sections.settings.coordinates === "mean_value"')
    window.click("#group-advanced-fold")


def below(window: Window) -> tuple[np.ndarray, np.ndarray]:
    """The lowest corner of the cage in the view, and a place beside the cage for a lasso around it to begin at."""
    places = window.places()
    lowest = places[np.argmax(places[:, 1])]
    return lowest, np.array([lowest[0] + 60, lowest[1]])


def on_page(window: Window, point: Any) -> np.ndarray:
    """Where a point of the world is on the page, CSS pixels."""
    box = window.box
    x, y, _ = projected(window.section("view"), np.asarray(point, float), box["width"], box["height"])
    return np.array([x + box["left"], y + box["top"]])
