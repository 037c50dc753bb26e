"""A headless Chromium for tests of the editor's page."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull

import warpcage


@contextmanager
def chromium(width: int = 1280, height: int = 800, *, ratio: float = 1.0, webgl: bool = False) -> Iterator[Any]:
    """A selenium driver of Debian's Chromium; skips, visibly, where one of the two is missing.

    Args:
        width: Of the page, CSS pixels.
        height: Of the page, CSS pixels.
        ratio: Device pixels of a CSS pixel.
        webgl: Whether pages have WebGL, drawn by the processor.

    Yields:
        The driver; `get_log("browser")` gives what the console got.
    """
    webdriver = pytest.importorskip("selenium.webdriver")
    browser, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if browser is None or driver is None:
        pytest.skip("needs Debian's chromium and chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    arguments = ["--headless=new", "--no-sandbox", "--hide-scrollbars", "--disable-dev-shm-usage"]
    arguments += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"] if webgl else ["--disable-gpu"]
    arguments += [f"--force-device-scale-factor={ratio:g}", "--no-first-run", "--disable-extensions"]
    for argument in arguments:
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driven = webdriver.Chrome(options=options, service=webdriver.ChromeService(executable_path=driver))
    try:
        driven.set_script_timeout(30)
        metrics = {"width": width, "height": height, "deviceScaleFactor": ratio, "mobile": False}
        driven.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        yield driven
    finally:
        driven.quit()


def pointer(driver: Any, kind: str, x: float, y: float, *, button: str = "none", keys: int = 0, **more: Any) -> None:
    """One mouse event at a place of the page.

    Args:
        driver: Of `chromium`.
        kind: mousePressed, mouseMoved, mouseReleased or mouseWheel.
        x: CSS pixels.
        y: CSS pixels.
        button: none, left, middle or right.
        keys: 1 Alt, 2 Ctrl, 4 Meta, 8 Shift, added.
        **more: Further parts of Chromium's Input.dispatchMouseEvent.
    """
    held = {"none": 0, "left": 1, "right": 2, "middle": 4}[button]
    event = {"type": kind, "x": x, "y": y, "button": button, "buttons": held, "modifiers": keys, "clickCount": 1}
    driver.execute_cdp_cmd("Input.dispatchMouseEvent", event | more)


def drag(driver: Any, path: list[tuple[float, float]], *, button: str = "left", keys: int = 0) -> None:
    """A drag along places of the page, pressed at the first and released at the last; see `pointer`."""
    pointer(driver, "mouseMoved", *path[0], keys=keys)
    pointer(driver, "mousePressed", *path[0], button=button, keys=keys)
    for place in path[1:]:
        pointer(driver, "mouseMoved", *place, button=button, keys=keys)
    pointer(driver, "mouseReleased", *path[-1], button=button, keys=keys)


#: Numbers of keys that are held with another one, and of keys with a name, and the text that these write.
HELD = {"Alt": 1, "Ctrl": 2, "Shift": 8}
KEYS = {"Tab": (9, ""), "Enter": (13, "\r"), "Escape": (27, ""), "Space": (32, " "), "End": (35, ""), "Home": (36, "")}
KEYS |= {"ArrowLeft": (37, ""), "ArrowUp": (38, ""), "ArrowRight": (39, ""), "ArrowDown": (40, ""), "Delete": (46, "")}
KEYS |= {".": (190, "."), "-": (189, "-"), "]": (221, "]"), "[": (219, "[")}


def press(driver: Any, *strokes: str) -> None:
    """Press keys, each "G", "Ctrl+Z", "Enter", "ArrowLeft", "Tab" and the like, at what has the focus."""
    for stroke in strokes:
        *names, key = stroke.split("+")
        held = sum(HELD[name] for name in names)
        number, text = KEYS.get(key, (ord(key[0].upper()), key.upper() if held & 8 else key.lower()))
        code = f"Key{key.upper()}" if len(key) == 1 and key.isalpha() else f"Digit{key}" if key.isdigit() else key
        event: dict[str, Any] = {"key": text if len(key) == 1 else " " if key == "Space" else key, "code": code}
        event |= {"modifiers": held, "windowsVirtualKeyCode": number}
        said = {"text": text} if text and not held & 7 else {}
        driver.execute_cdp_cmd("Input.dispatchKeyEvent", {"type": "keyDown", **event, **said})
        driver.execute_cdp_cmd("Input.dispatchKeyEvent", {"type": "keyUp", **event})


#: Turns arguments into typed arrays and sets, results into lists.
CALL = """
const [module, name, args, done] = arguments;
const read = (x) => {
  if (Array.isArray(x)) return x.map(read);
  if (x && typeof x === "object") {
    if ("float64" in x) return Float64Array.from(x.float64);
    if ("uint16" in x) return Uint16Array.from(x.uint16);
    if ("int32" in x) return Int32Array.from(x.int32);
    if ("set" in x) return new Set(x.set);
    return Object.fromEntries(Object.entries(x).map(([key, value]) => [key, read(value)]));
  }
  return x;
};
const write = (x) => {
  if (ArrayBuffer.isView(x) || x instanceof Set) return [...x];
  if (Array.isArray(x)) return x.map(write);
  if (!x || typeof x !== "object") return x;
  return Object.fromEntries(Object.entries(x).map(([key, value]) => [key, write(value)]));
};
import("/" + module + ".js").then((found) => {
  const what = name.split(".").reduce((at, part) => at[part], found);
  done({ result: write(typeof what === "function" ? what(...read(args)) : what) });
}).catch((error) => done({ error: String(error.stack ?? error) }));
"""


def flat(points: Any) -> dict[str, list[float]]:
    """Points as the page has them: one Float64Array."""
    return {"float64": [float(value) for value in np.asarray(points).ravel()]}


def whole(numbers: Any) -> dict[str, list[int]]:
    """Numbers as an Int32Array."""
    return {"int32": [int(value) for value in np.asarray(numbers).ravel()]}


class Modules:
    """The page's modules in a browser, without the page.

    Args:
        driver: Of `chromium`, at an address of `page_files`.
    """

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def call(self, module: str, name: str, *args: Any) -> Any:
        """What a function of a module gives; arrays and sets as lists."""
        answer = self.driver.execute_async_script(CALL, module, name, list(args))
        assert "error" not in answer, answer["error"]
        return answer["result"]


@contextmanager
def page_files() -> Iterator[str]:
    """Serves the page's files, and an empty page at `/`; gives the address."""
    folder = Path(warpcage.__file__).parent / "studio" / "editor" / "page"

    class Handler(SimpleHTTPRequestHandler):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args, directory=str(folder))

        def do_GET(self) -> None:
            if self.path != "/":
                return super().do_GET()
            head = b"<!doctype html><html><head><link rel=icon href='data:,'></head>"
            body = (
                head + b"<body><canvas id=view tabindex=0></canvas><div id=toasts popover=manual></div></body></html>"
            )
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
            return None

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


VIEW = {"eye": [2.0, -4.0, 1.5], "target": [0.1, 0.2, -0.1], "up": [0.0, 0.1, 1.0], "fov": 37.0}
WIDTH, HEIGHT = 640.0, 400.0


def looked(view: dict[str, Any]) -> np.ndarray:
    """Rows right, up, back of a view."""
    back = np.subtract(view["eye"], view["target"])
    back = back / np.linalg.norm(back)
    right = np.cross(view["up"], back)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def projected(view: dict[str, Any], points: np.ndarray, width: float = WIDTH, height: float = HEIGHT) -> np.ndarray:
    """Pixels and distances along the axis, by matrices."""
    local = (np.asarray(points) - view["eye"]) @ looked(view).T
    half = np.tan(np.radians(view["fov"]) / 2)
    x, y = local[..., 0] / -local[..., 2] / (half * width / height), local[..., 1] / -local[..., 2] / half
    return np.stack([(1 + x) / 2 * width, (1 - y) / 2 * height, -local[..., 2]], axis=-1)


def camera(page: Modules, view: dict[str, Any] = VIEW, width: float = WIDTH, height: float = HEIGHT) -> Any:
    return page.call("geometry/camera", "makeCamera", view, width, height)


def hull(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    return points, ConvexHull(points).simplices.astype(int)
