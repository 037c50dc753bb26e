"""How the editor's page looks: everything in its place and legible, on a laptop and a tablet, light and dark."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from editor_browser import Window, editor, until, window

from warpcage.studio.editor import Outcome

__all__ = ["editor", "window"]  # fixtures

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
  const free = found.contains(top) || found.closest("label")?.contains(top);
  if (!inside) bad.push(`${name(found)} is outside`);
  else if (!free) bad.push(`${name(found)} is covered by ${top ? name(top) : "nothing"}`);
  const isNamed = found.closest("[title], [aria-label]") || found.labels?.length || found.textContent;
  if (!isNamed) bad.push(`${name(found)} has no name`);
}
const paper = Object.assign(document.createElement("canvas"), { width: 1, height: 1 });
const pen = paper.getContext("2d", { willReadFrequently: true });
const shade = (colors) => {
  pen.clearRect(0, 0, 1, 1);
  for (const color of colors) { pen.fillStyle = "#000"; pen.fillStyle = color; pen.fillRect(0, 0, 1, 1); }
  const linear = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  const [r, g, b] = [...pen.getImageData(0, 0, 1, 1).data].map((v) => linear(v / 255));
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
  const text = found.textContent.trim().slice(0, 30);
  if (ratio < 4.5) bad.push(`${name(found)} "${text}" has a contrast of ${ratio.toFixed(2)}`);
}
return { bad: [...new Set(bad)], texts, color: getComputedStyle(document.body).backgroundColor };
"""


@pytest.mark.parametrize(("width", "height"), [(1024, 768), (1440, 900), (820, 1180)])
def test_everything_can_be_seen_in_light_and_dark(window: Window, browser: Any, width: int, height: int) -> None:
    metrics = {"width": width, "height": height, "deviceScaleFactor": 0.5, "mobile": False}
    colors = set()
    try:
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        window.wait("innerWidth === arguments[0]", "the window is resized", width)
        if window.get('document.body.classList.contains("panel-closed")'):
            window.click("#panel-toggle")
        for group in ("edits", "advanced", "cage", "pose", "keys", "film", "jobs", "view"):
            window.unfold(group)
        window.click("#proportional")
        window.click("#snap")
        window.press("K")
        window.wait("warpcage.store.sections.timeline.keys.length === 1")
        script = "const label = document.getElementById('time-unkeyed'); label.hidden = false;"
        assert browser.execute_script(f"{script} return label.scrollWidth <= label.clientWidth"), "Pose not kept is cut"
        for name in ("light", "dark"):
            scheme(browser, window, name)
            until(lambda: not window.get("document.getAnimations().length"), "nothing fades any more")
            found = browser.execute_script(LAYOUT)
            assert "\n".join(found["bad"]) == "" and found["texts"] > 40
            colors.add(found["color"])
        assert len(colors) == 2
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
        metrics |= {"width": 1024, "height": 768}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


@pytest.mark.parametrize(
    ("width", "height", "touch"),
    [
        (800, 600, False),
        (820, 1180, True),
        *(
            pytest.param(*each, marks=pytest.mark.nightly)
            for each in ((800, 600, True), (820, 1180, False), (1440, 900, False), (1440, 900, True))
        ),
    ],
)
def test_tools_that_draw_have_room(window: Window, browser: Any, width: int, height: int, touch: bool) -> None:
    metrics = {"width": width, "height": height, "deviceScaleFactor": 0.5, "mobile": touch}
    browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": touch})
    try:
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        window.wait("innerWidth === arguments[0]", "the window is resized", width)
        assert window.get('matchMedia("(pointer: coarse)").matches') is touch
        if not window.get('document.body.classList.contains("panel-closed")'):
            window.click("#panel-toggle")
        window.press("K", "A", "G", "X", "1", "Enter")
        window.wait("warpcage.store.sections.timeline.keys.length === 1")
        window.fill("#time", "3\n")
        window.click("#time-add")
        window.wait("warpcage.store.sections.timeline.keys.length === 2")
        window.click("#time-first")
        window.choose("#time-easing", "bezier")
        window.wait('!document.getElementById("curve-handle-2").hidden')
        window.wait('!document.getElementById("toasts").children.length')
        for tool in ("tool-box", "tool-landmark", "tool-ruler", "tool-select", "pick-brush"):
            window.click(f"#{tool}")
            until(lambda: not window.get("document.getAnimations().length"), "nothing fades any more")
            assert "\n".join(browser.execute_script(LAYOUT)["bad"]) == "", tool
            boxes = {
                name: window.get(f'document.querySelector("{name}").getBoundingClientRect().toJSON()')
                for name in ("#view", "#tools", "#tool-options .chip:not([hidden])", "#tool-options")
                if window.get(f'Boolean(document.querySelector("{name}"))')
            }
            view, tools, options = boxes["#view"], boxes["#tools"], boxes["#tool-options"]
            assert tools["bottom"] <= view["bottom"] and tools["right"] < options["left"], (tool, boxes)
            chip = boxes.get("#tool-options .chip:not([hidden])")
            assert (chip is None) == (tool == "tool-select"), tool
            assert chip is None or (chip["right"] < view["right"] - 88 and chip["bottom"] < view["bottom"]), boxes
        for number in (1, 2):  # handles of the curve can be taken
            script = """
            const box = document.getElementById(arguments[0]).getBoundingClientRect();
            return document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2).id;
            """
            assert browser.execute_script(script, f"curve-handle-{number}") == f"curve-handle-{number}"
    finally:
        browser.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})
        metrics |= {"width": 1024, "height": 768, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def scheme(browser: Any, window: Window, name: str) -> None:
    browser.execute_cdp_cmd(
        "Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": name}]}
    )
    window.wait("matchMedia(`(prefers-color-scheme: ${arguments[0]})`).matches", name, name)


def test_the_view_is_dark_in_the_dark_theme_unless_a_background_is_chosen(window: Window, browser: Any) -> None:
    def corner(color: tuple[int, int, int]) -> None:
        until(lambda: np.abs(window.canvas()[-4, 4].astype(int) - color).max() <= 4, f"the view's corner is {color}")

    try:
        corner((255, 255, 255))  # the field's own
        scheme(browser, window, "dark")
        ground = window.get("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")
        assert max(ground) < 60
        corner(tuple(ground))
        window.unfold("view")
        window.choose("#background", "white")
        corner((255, 255, 255))
    finally:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_the_ground_is_drawn_as_a_grid_that_matter_hides(window: Window) -> None:
    def is_below(toggle: Callable[[str], None], what: str) -> bool:
        """Whether the grid lies below; both pictures are taken anew, as a sharper one may come at any time."""
        window.rest()
        bare = window.canvas()
        toggle(what)
        drawn = window.canvas()
        toggle(what)
        above, below = (half.sum() for half in np.array_split((drawn != bare).any(axis=2), 2))
        return below > 5 * above

    until(lambda: is_below(window.press, "Shift+D"), "there is a grid below the ball")
    window.unfold("view")
    until(lambda: is_below(window.click, "#grid"), "the box of the panel draws the grid")


def test_the_help_scrolls_in_one_place(window: Window) -> None:
    window.press("?")
    scrolled = """
    [document.querySelector("dialog"), ...document.querySelectorAll("dialog *")].filter((it) =>
      it.scrollHeight > it.clientHeight + 1 && /auto|scroll/.test(getComputedStyle(it).overflowY)).length
    """
    assert window.wait('document.querySelector("dialog[open]")') and window.get(scrolled.strip()) == 1
    dialog = window.get('document.querySelector("dialog").getBoundingClientRect().toJSON()')
    close = window.get('document.getElementById("dialog-close").getBoundingClientRect().toJSON()')
    assert close["bottom"] < dialog["bottom"] <= window.get("innerHeight")
    window.press("Escape")


@pytest.mark.parametrize("way", ["turned", "closed"])
def test_new_users_see_once_how_the_view_turns(window: Window, way: str) -> None:
    shown = 'document.getElementById("turn-hint")?.textContent'
    assert "right button" in window.get(shown)
    before, box = window.section("view"), window.box
    place = np.array([box["left"] + 100, box["bottom"] - 60])
    if way == "turned":
        for kind, x in (("mousePressed", 0), ("mouseMoved", 40), ("mouseReleased", 40)):
            window.point(kind, place + [x, 0], button="right")
        window.wait("JSON.stringify(warpcage.store.sections.view) !== arguments[0]", "", json.dumps(before))
    else:
        window.click("#turn-hint-close")
    window.wait(f"!({shown})")
    window.reload()
    assert window.get(shown) is None


def test_notes_of_much_work_with_long_names_stay_in_the_view(window: Window, editor: Any) -> None:
    for number in range(9):
        name = f"Write {number}{'x' * 150}.mp4"
        editor.server.jobs.start(name, "file", lambda progress: Outcome("y" * 150, "download/x"))
    window.wait("document.querySelectorAll('#work li').length === 9", "all are shown")
    box = window.box
    inside = """[...document.querySelectorAll('#work button')].filter((one) => one.offsetWidth).every((one) => {
        one.scrollIntoView({block: "nearest"});
        const { left, right, top, bottom } = one.getBoundingClientRect(), view = arguments[0];
        const room = Math.min(left - view.left, view.right - right, top - view.top, view.bottom - bottom);
        return room >= -1 / devicePixelRatio;
    })"""
    assert window.get(inside, box)
    window.click("#turn-hint-close")  # what is above them can be reached
    window.wait("!document.getElementById('turn-hint')")
