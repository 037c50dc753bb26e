"""Pictures of the editor's page for README and docs, taken in headless Chromium.

    python benchmarks/editor_pictures.py --out docs/pictures                            (the demo)
    python benchmarks/editor_pictures.py --field lego.npz --cage cage.obj --out pictures

A scripted mouse poses the excavator's arm as a person would. Each picture has 256 colours and less than 200 kB.
"""

from __future__ import annotations

import argparse
import io
import pathlib
import sys
import tempfile
import time

import numpy as np
from PIL import Image

import warpcage
from warpcage.core.devices import resolve_device
from warpcage.editor.demo import demo_files

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "tests"))
from editor_browser import Window, until  # noqa: E402
from page_probe import chromium  # noqa: E402

#: Bytes of a picture.
MOST_BYTES = 200_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--field", help="field file (default: the demo)")
    parser.add_argument("--cage", help="cage at rest of that field")
    parser.add_argument("--out", default="docs/pictures", help="folder (default: %(default)s)")
    args = parser.parse_args()
    field, cage = (args.field, args.cage) if args.field else demo_files(resolve_device(None))
    out = pathlib.Path(args.out)
    with tempfile.TemporaryDirectory() as temporary:
        session = pathlib.Path(temporary) / "excavator.session.json"
        with warpcage.edit(field, warpcage.Cage.load(cage), session=session) as editor, chromium(1280, 800) as driver:
            photograph(Window(driver, editor.url), out)


def photograph(window: Window, out: pathlib.Path) -> None:
    """Poses, sets keys and takes the pictures."""
    window.rest()
    window.click("#time-add")
    window.wait("warpcage.store.sections.timeline.keys.length === 1")
    arm = select_right(window)
    goes(window, 2.0)
    window.click("#proportional")
    bend(window, arm, [-10, -55])
    window.click("#proportional")
    window.click("#time-add")
    window.wait("warpcage.store.sections.timeline.keys.length === 2")
    keep(window, out / "editor_light.png")

    window.click("#proportional")
    place = window.places()[arm]
    path = [place + np.array([45.0, 60.0]) * share for share in np.linspace(0, 1, 10)]
    window.point("mouseMoved", path[0])
    window.point("mousePressed", path[0], button="left")
    for step in path[1:]:
        window.point("mouseMoved", step, button="left")
    until(lambda: window.get("warpcage.viewport.operation !== null"), "a drag is under way")
    until(lambda: still(window), "the picture follows")
    shot(window, out / "editor_drag.png")
    window.point("mouseReleased", path[-1], button="left")
    window.click("#proportional")

    window.unfold("view")
    for group in ("edits", "pose"):
        window.click(f"#group-{group}-fold")
    window.click("#show label:has([value=masks])")
    window.wait('warpcage.store.sections.settings.show === "masks"')
    resize(window, 1024, 768)
    keep(window, out / "editor_laptop.png")
    window.click("#show label:has([value=rgb])")
    window.wait('warpcage.store.sections.settings.show === "rgb"')

    features = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    window.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", features)
    resize(window, 1280, 800)
    window.choose("#background", "black")
    window.wait('warpcage.store.sections.settings.background === "black"')
    window.click("#tool-rotate")
    keep(window, out / "editor_dark.png")
    window.click("#panel-toggle")
    resize(window, 820, 1180)
    keep(window, out / "editor_tablet.png")


def select_right(window: Window) -> int:
    """Selects the upper right of the cage with a rectangle; gives its highest vertex."""
    places, box = window.places(), window.box
    begin = np.array([min(places[:, 0].max() + 25, box["right"] - 8), max(places[:, 1].min() - 25, box["top"] + 140)])
    end = places.mean(axis=0) + [0.12 * np.ptp(places[:, 0]), 0]
    window.drag([begin + (end - begin) * share for share in np.linspace(0, 1, 8)])
    chosen = window.wait(
        "warpcage.store.sections.selection.vertices.length && warpcage.store.sections.selection.vertices"
    )
    return int(chosen[int(np.argmin(places[chosen, 1]))])


def goes(window: Window, seconds: float) -> None:
    """Puts the timeline's head somewhere, by a typed time."""
    window.fill("#time", f"{seconds:g}\n")
    window.wait("Math.abs(warpcage.store.sections.playback.time - arguments[0]) < 0.02", "", seconds)


def bend(window: Window, vertex: int, way: list[float]) -> None:
    """Drags a selected vertex."""
    place = window.places()[vertex]
    window.drag([place + np.array(way) * share for share in np.linspace(0, 1, 10)])


def resize(window: Window, width: int, height: int) -> None:
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    window.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    window.wait("innerWidth === arguments[0]", "the window is resized", width)


def still(window: Window) -> bool:
    """Whether no newer picture comes for a while: that of the newest pose is there."""
    before = window.get("warpcage.viewport.picture.frame")
    time.sleep(2.0)
    return before == window.get("warpcage.viewport.picture.frame")


def keep(window: Window, path: pathlib.Path) -> None:
    """Takes a picture of the page at rest."""
    window.rest()
    box = window.box
    window.wait(
        "warpcage.viewport.picture.height === Math.round(arguments[0])", "a picture of this size", box["height"]
    )
    window.wait("!warpcage.store.sections.check.pending", "the cage is checked")
    window.rest()
    window.point("mouseMoved", [box["left"] + 5, box["bottom"] - 5])
    shot(window, path)


def shot(window: Window, path: pathlib.Path) -> None:
    """Writes what the window shows, in few colours."""
    until(lambda: not window.get('document.getElementById("toasts").children.length'), "messages have gone")
    picture = Image.open(io.BytesIO(window.driver.get_screenshot_as_png())).convert("RGB")
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.quantize(256, kmeans=8, dither=Image.Dither.NONE).save(path, optimize=True)
    size = path.stat().st_size
    print(f"{path}: {picture.width}x{picture.height}, {size} bytes")
    if size >= MOST_BYTES:
        raise SystemExit(f"{path} has {size} bytes, {MOST_BYTES} are allowed")


if __name__ == "__main__":
    main()
