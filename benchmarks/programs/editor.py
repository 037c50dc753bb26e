"""The editor: from a drag to its picture, pictures per second while dragging, and pictures of its page."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import io
import json
import pathlib
import shutil
import signal
import statistics
import struct
import subprocess
import sys
import tempfile
import time

import numpy as np
from common import JSON, UsageError, command, option, quiet_device, write_results

#: Poses per second that a drag sends.
RATE = 60.0

#: Seconds that the editor may take to end: a second, if its disk answers.
END_SECONDS = 120.0

#: Seconds that are not measured: kernels are loaded, graphs captured, and the server learns what pictures cost.
WARM = 3.0

#: Single poses that are let go of, after the drag.
RESTS = 10

#: Bytes of a picture of the page.
MAX_BYTES = 200_000


# Drags


@command(
    option("--field", help="field file (default: the demo)"),
    option("--cage", help="cage at rest of that field"),
    option("--device", help="Warp device"),
    option("--size", type=int, nargs=2, default=(800, 800), metavar=("W", "H"), help="of the picture"),
    option("--coordinates", default="harmonic"),
    option("--resolution", type=int, help="cells of the lattice (default: the session's)"),
    option("--seconds", type=float, default=10.0, help="of dragging (default: %(default)s)"),
    option("--objects", type=int, default=1, help="fields in the scene, each read from a file (default: %(default)s)"),
    option("--places", action="store_true", help="drag an object as a whole instead of a cage, without --browser"),
    option("--browser", action="store_true", help="drag with a mouse in headless Chromium"),
    option("--screenshot", help="where a picture of the page goes (.png), with --browser"),
    JSON,
)
def drags(args) -> None:
    """The editor: from a drag to its picture, and pictures per second while dragging.

        python benchmarks editor drags --field lego.npz --cage cage.obj --device cuda:0 --json editor.json
        python benchmarks editor drags --browser --json editor.json             (Chromium, the demo, by a real pointer)

    Without --browser a WebSocket client moves the cage at the rate of a display and decodes each JPEG, in a process of
    its own. A pose's latency is the time from sending it until the picture of that very pose is decoded; "arrival" is
    until its bytes are there, and "or newer" counts the poses too that a newer one overtook, until the picture of that
    one. "sharp" is from a single pose that is let go of at once to its sharp picture. With --browser the pointer is a
    mouse in headless Chromium, and the page measures: from the pointer's event until the picture is drawn. Settings are
    those of a new session but for --coordinates and --resolution. The memory of a GPU is what all programs on it take
    more than before, so nothing else should run there.
    """
    if (args.field is None) != (args.cage is None):
        raise UsageError("--field and --cage go together")
    free = free_bytes(args.device)
    with editor(args) as (url, process):
        found = by_browser(url, args) if args.browser else asyncio.run(by_socket(url, args))
        status = pathlib.Path(f"/proc/{process}/status").read_text()
        found |= {"objects": args.objects, "memory_peak_mb": int(status.split("VmHWM:")[1].split()[0]) // 1024}
        if free is not None:  # of what Warp keeps for later too, which does not shrink
            found["device_memory_mb"] = (free - (free_bytes(args.device) or 0)) >> 20
    for name, value in found.items():
        print(f"{name:22} {value}")
    write_results(args.json, args.device, **found)


def free_bytes(name: str | None) -> int | None:
    """Free memory of a GPU; None of the CPU."""
    device = quiet_device(name)
    return device.free_memory if device.is_cuda else None


@contextlib.contextmanager
def editor(args: argparse.Namespace):
    """The address and the number of a process in which an editor runs."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        arguments = [sys.executable, "-X", "faulthandler", "-m", "warpcage", "edit", "--no-browser", "--port", "0"]
        arguments += ["--device", args.device] if args.device else []
        if args.field is None:
            from warpcage.core import resolve_device
            from warpcage.studio.editor import demo_files

            field = demo_files(resolve_device(args.device))[0]
            arguments += ["--demo", "--session", str(folder / "demo.session.json")]
        else:
            field = pathlib.Path(args.field)
            shutil.copy(field, folder / "field.npz")
            arguments += [str(folder / "field.npz"), "--cage", args.cage]
        for number in range(2, args.objects + 1):
            shutil.copy(field, folder / f"object{number}.npz")
        server = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            address = ""
            while "http" not in address:
                address = server.stdout.readline()
                if not address and server.poll() is not None:
                    raise SystemExit("the editor did not start")
            url = next(word for word in address.split() if word.startswith("http"))
            asyncio.run(add_objects(url, args.objects))
            yield url, server.pid
        finally:
            server.terminate()  # a shell's background jobs, and what they start, do not get Ctrl-C
            require_end(server)


def require_end(server: subprocess.Popen) -> None:
    """Wait until the editor has ended. Raises SystemExit where it does not, and its threads say where they are."""
    try:
        server.wait(END_SECONDS)
    except subprocess.TimeoutExpired:
        server.send_signal(signal.SIGABRT)  # faulthandler writes the stacks to stderr
        server.wait()
        raise SystemExit(f"the editor did not end within {END_SECONDS:g} s") from None


async def add_objects(url: str, count: int) -> None:
    """Add the other fields beside the first one, which stays the active object."""
    import aiohttp

    async with aiohttp.ClientSession() as http, http.ws_connect(url + "socket", max_msg_size=0) as socket:
        added = [{"do": "object.add", "file": f"object{number}.npz", "beside": True} for number in range(2, count + 1)]
        for number, message in enumerate([*added, {"do": "object.select", "id": 0}]):
            await socket.send_str(json.dumps({**message, "n": number}))
            while True:
                received = await socket.receive()
                reply = json.loads(received.data) if received.type == aiohttp.WSMsgType.TEXT else {}
                if reply.get("n") == number:
                    break
            if "error" in reply:
                raise SystemExit(reply["error"])


class DragMotion:
    """Poses of a cage that a drag could make: each vertex swings smoothly, and all of them differently.

    Args:
        rest: (v, 3) the cage at rest.
    """

    def __init__(self, rest: np.ndarray):
        rng = np.random.default_rng(0)
        self.rest, size = rest, float(np.ptp(rest, axis=0).max())
        modes, low = 6, rest.min(axis=0)
        waves = rng.normal(0.0, 1.0, (modes, 3)) * 2.0 / size
        self.shapes = np.sin((rest - low) @ waves.T + rng.uniform(0.0, 6.28, modes))  # (v, modes)
        self.ways = rng.normal(0.0, 0.012 * size, (modes, 3))
        self.speeds, self.phases = rng.uniform(1.0, 3.0, modes), rng.uniform(0.0, 6.28, modes)

    def at(self, seconds: float) -> np.ndarray:
        """(v, 3) the pose at a time."""
        return self.rest + (self.shapes * np.sin(self.speeds * seconds + self.phases)) @ self.ways


async def by_socket(url: str, args: argparse.Namespace) -> dict:
    """Drag as a page does and decode what comes."""
    import aiohttp
    import simplejpeg

    sent: dict[int, float] = {}
    shown: list[tuple[float, float, int, dict]] = []  # when it was there and when decoded, its pose, its header
    async with aiohttp.ClientSession() as http, http.ws_connect(url + "socket", max_msg_size=0) as socket:
        hello = json.loads((await socket.receive()).data)
        edit, me = hello["sections"]["edits"][0], str(hello["client"])

        async def say(**message) -> None:
            await socket.send_str(json.dumps(message))

        async def receive_pictures() -> None:
            async for message in socket:
                if message.type != aiohttp.WSMsgType.BINARY:
                    continue
                arrived = time.perf_counter()
                kind, header_bytes, jpeg, _ = struct.unpack_from("<4I", message.data)
                if kind != 10:
                    continue
                header = json.loads(message.data[16 : 16 + header_bytes])
                if header["error"]:
                    raise RuntimeError(header["error"])
                begin = 16 + header_bytes + (-header_bytes) % 8
                simplejpeg.decode_jpeg(message.data[begin : begin + jpeg])
                shown.append((arrived, time.perf_counter(), header["applied"].get(me, 0), header))
                await say(do="seen", frame=header["frame"])

        settings = {"coordinates": args.coordinates}
        settings |= {} if args.resolution is None else {"resolution": args.resolution}
        await say(do="settings", **settings)
        motion, vertices = DragMotion(np.array(edit["rest"])), len(edit["rest"])
        listening = asyncio.create_task(receive_pictures())
        await say(do="size", width=args.size[0], height=args.size[1])
        while not shown:
            await asyncio.sleep(0.01)
            if listening.done():
                listening.result()
        kind, number = ("place", 0) if args.places else ("drag", edit["id"])
        begin = {"do": f"{kind}.begin", "object" if args.places else "edit": number, "label": "drag"}
        finish = {name: value for name, value in begin.items() if name != "label"} | {"do": f"{kind}.end"}

        async def pose(count: int) -> float:
            posed, when = motion.at(count / RATE), time.perf_counter()
            if args.places:
                place = np.eye(4)
                place[:3, 3] = (posed - motion.rest).mean(axis=0)
                await say(do="place.set", object=0, matrix=place.tolist(), seq=count)
            else:
                header = struct.pack("<4I", 2, count, edit["id"], vertices)
                await socket.send_bytes(header + posed.astype("<f8").tobytes())
            return when

        async def seen(count: int, sharp: bool) -> float:
            end = time.perf_counter() + 120.0
            while shown[-1][2] < count or (sharp and not shown[-1][3]["sharp"]):
                if time.perf_counter() > end:
                    raise SystemExit("no picture of a pose came")
                await asyncio.sleep(0.001)
            return shown[-1][1]

        await say(**begin)
        start = time.perf_counter()
        last = int((WARM + args.seconds) * RATE)
        for count in range(1, last + 1):
            await asyncio.sleep(max(0.0, start + count / RATE - time.perf_counter()))
            sent[count] = await pose(count)
        end = time.perf_counter()
        await seen(last, False)
        await say(**finish, cancel=True)
        rests = []
        for count in range(last + 1, last + 1 + RESTS):
            await seen(count - 1, True)
            await say(**begin)
            when = await pose(count)
            await say(**finish)
            rests.append(1e3 * (await seen(count, True) - when))
        listening.cancel()
    times = [when for _, when, _, _ in shown]
    numbers = [number for _, _, number, _ in shown]
    own, newer, arrival = [], [], []
    for number, when in sent.items():
        if when < start + WARM or when > end - 0.5:
            continue
        index = next(k for k, seen in enumerate(numbers) if seen >= number)
        newer.append(1e3 * (times[index] - when))
        if numbers[index] == number:
            own.append(newer[-1])
            arrival.append(1e3 * (shown[index][0] - when))
    steady = [(when, header) for _, when, _, header in shown if start + WARM <= when <= end]
    return {
        "picture": "x".join(map(str, args.size)),
        "coordinates": args.coordinates,
        "vertices": vertices,
        "frames_per_second": round((len(steady) - 1) / (steady[-1][0] - steady[0][0]), 1),
        "latency_ms": summary(own),
        "latency_or_newer_ms": summary(newer),
        "arrival_ms": summary(arrival),
        "sharp_ms": summary(rests),
        "sent_size": f"{steady[-1][1]['width']}x{steady[-1][1]['height']}",
        "cells": steady[-1][1]["cells"],
        "server_ms": {
            name: round(statistics.median(header["ms"][name] for _, header in steady), 2)
            for name in ("pose", "render", "all")
        },
    }


def by_browser(url: str, args: argparse.Namespace) -> dict:
    """Drag a vertex with the mouse in Chromium."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1280,800"):
        options.add_argument(word)
    driver = webdriver.Chrome(options=options)
    try:
        driver.get(url)
        wait_for(
            driver, "return !!(window.warpcage && warpcage.store.status.frame && warpcage.store.status.frame.sharp)"
        )
        x, y = driver.execute_script(
            "const {viewport, store} = warpcage, edit = store.sections.edits[0];"
            "const box = document.getElementById('view').getBoundingClientRect();"
            "let best = null;"
            "for (let k = 0; k < edit.posed.length; k += 1) { const p = viewport.project(edit.id, k);"
            "  const x = p.x ?? p[0], y = p.y ?? p[1]; if (!best || y < best[1]) best = [x, y]; }"
            "return [best[0] + box.left, best[1] + box.top]"
        )

        def mouse(kind: str, px: float, py: float, **more) -> None:
            event = {"type": kind, "x": px, "y": py, "button": "left", "buttons": 1, **more}
            driver.execute_cdp_cmd("Input.dispatchMouseEvent", event)

        mouse("mousePressed", x, y, clickCount=1)
        mouse("mouseReleased", x, y, clickCount=1, buttons=0)
        mouse("mousePressed", x, y, clickCount=1)
        start = time.perf_counter()
        warm_frames, warm_own, warm_overtaken = 0, 0, 0
        count = 0
        while (passed := time.perf_counter() - start) < WARM + args.seconds:
            count += 1
            mouse("mouseMoved", x + 60 * np.sin(2 * passed), y + 40 * np.sin(3 * passed))
            if passed < WARM:
                warm_frames, warm_own, warm_overtaken = driver.execute_script(
                    "const {viewport, store} = warpcage;"
                    "return [store.status.frame.frame, viewport.latencies.length, viewport.latenciesOrNewer.length]"
                )
                warm_end = time.perf_counter()
            time.sleep(max(0.0, count / RATE - (time.perf_counter() - start)))
        frames, own, overtaken, header = driver.execute_script(
            "const {viewport, store} = warpcage, {frame} = store.status;"
            "return [frame.frame, [...viewport.latencies], [...viewport.latenciesOrNewer], frame]"
        )
        seconds = time.perf_counter() - warm_end
        if args.screenshot:
            driver.save_screenshot(args.screenshot)
        mouse("mouseReleased", x, y, clickCount=1, buttons=0)
        said = [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"]
        if said:
            raise SystemExit(f"the page complained: {said[0]['message']}")
    finally:
        driver.quit()
    return {
        "browser": "headless Chromium, window 1280x800",
        "frames_per_second": round((frames - warm_frames) / seconds, 1),
        "latency_ms": summary([float(value) for value in own[warm_own:]]),
        "latency_or_newer_ms": summary([float(value) for value in own[warm_own:] + overtaken[warm_overtaken:]]),
        "sent_size": f"{header['width']}x{header['height']}",
        "cells": header["cells"],
        "server_ms": {name: round(value, 1) for name, value in header["ms"].items()},
    }


def wait_for(driver, condition: str, seconds: float = 300.0) -> None:
    """Wait until a script in the page returns something true."""
    end = time.perf_counter() + seconds
    while not driver.execute_script(condition):
        if time.perf_counter() > end:
            raise SystemExit("the page showed no sharp picture")
        time.sleep(0.1)


def summary(values: list[float]) -> dict[str, float]:
    """Median, 95th percentile and number."""
    return {
        "median": round(float(np.median(values)), 1),
        "p95": round(float(np.percentile(values, 95)), 1),
        "count": len(values),
    }


# Pictures of the page


@command(
    option("--field", help="field file (default: the demo)"),
    option("--cage", help="cage at rest of that field"),
    option("--out", default="docs/pictures", help="folder (default: %(default)s)"),
)
def pictures(args) -> None:
    """Pictures of the editor's page for README and docs, taken in headless Chromium.

        python benchmarks editor pictures --out docs/pictures                            (the demo)
        python benchmarks editor pictures --field lego.npz --cage cage.obj --out pictures

    A scripted mouse poses the excavator's arm as a person would. Each picture has 256 colors and less than 200 kB.
    """
    from editor_browser import Window
    from page_probe import chromium

    import warpcage
    from warpcage.core import resolve_device
    from warpcage.studio.editor import demo_files

    field, cage = (args.field, args.cage) if args.field else demo_files(resolve_device(None))
    out = pathlib.Path(args.out)
    with tempfile.TemporaryDirectory() as temporary:
        session = pathlib.Path(temporary) / "excavator.session.json"
        shutil.copy(field, session.with_name("small.npz"))
        with warpcage.edit(field, warpcage.Cage.load(cage), session=session) as opened, chromium(1280, 800) as driver:
            photograph(Window(driver, opened.url), out)


def photograph(window, out: pathlib.Path) -> None:
    """Poses, sets keys and takes the pictures."""
    from editor_browser import until

    window.rest()
    window.click("#turn-hint-close")
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
    window.press("Shift+D")
    window.click("#tool-rotate")
    keep(window, out / "editor_dark.png")
    window.click("#panel-toggle")
    resize(window, 820, 1180)
    keep(window, out / "editor_tablet.png")

    light = {"features": [{"name": "prefers-color-scheme", "value": "light"}]}
    window.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", light)
    resize(window, 1280, 800)
    window.click("#panel-toggle")
    window.press("Shift+D")
    make_parts(window)
    keep(window, out / "editor_parts.png")

    window.unfold("objects")
    window.click("#object-add")
    window.wait("document.getElementById('ask-file')")
    window.click("#dialog-confirm")
    window.wait("warpcage.store.sections.objects.length === 2 && !document.querySelector('dialog')")
    window.click("#mode label:has([value=place])")
    window.click("#tool-move")
    for field, number in (("turn-z", "150"), ("scale", "0.5"), ("position-y", "-0.6")):
        window.fill(f"#object-{field}", f"{number}\n")
    window.wait("warpcage.store.sections.objects[1].place.position[1] === -0.6", "the last number has come")
    window.click("#outside-all")
    window.click("#outside-keys")
    window.wait("document.getElementById('outside').hidden", "all cameras see it")
    keep(window, out / "editor_objects.png")


def make_parts(window) -> None:
    """Draws a box around the excavator's arm, drags its upper face, and bends the way from the first key."""
    window.click("#time-first")
    window.choose("#time-easing", "bezier")
    window.wait('!document.getElementById("curve-handle-2").hidden')
    handle = window.get('document.getElementById("curve-handle-2").getBoundingClientRect().toJSON()')
    place = np.array([handle["left"] + handle["width"] / 2, handle["top"] + handle["height"] / 2])
    window.drag([place + np.array([-90.0, -14.0]) * share for share in np.linspace(0, 1, 8)])
    window.click("#tool-box")
    window.wait('warpcage.store.sections.settings.mode === "rest"')
    window.rest()
    count, box = len(window.section("edits")), window.box
    shares = np.array([[0.52, 0.2], [0.74, 0.52]])
    begin, end = shares * [box["width"], box["height"]] + [box["left"], box["top"]]
    window.drag([begin + (end - begin) * share for share in np.linspace(0, 1, 8)])
    window.wait("warpcage.store.sections.edits.length === arguments[0]", "", count + 1)
    edit = window.section("edits")[-1]
    rest, places = np.array(edit["rest"]), window.places(edit["id"])
    upper = rest[:, 2] > rest[:, 2].mean()
    way = (places[upper].mean(axis=0) - places[~upper].mean(axis=0)) * 0.2
    window.drag([places[upper].mean(axis=0) + way * share for share in np.linspace(0, 1, 8)])
    window.wait(
        "warpcage.store.sections.edits.at(-1).rest.some(([, , z]) => z > arguments[0])", "", rest[:, 2].max() + 1e-3
    )


def select_right(window) -> int:
    """Selects the upper right of the cage with a rectangle; gives its highest vertex."""
    places, box = window.places(), window.box
    begin = np.array([min(places[:, 0].max() + 25, box["right"] - 8), max(places[:, 1].min() - 25, box["top"] + 140)])
    end = places.mean(axis=0) + [0.12 * np.ptp(places[:, 0]), 0]
    window.drag([begin + (end - begin) * share for share in np.linspace(0, 1, 8)])
    chosen = window.wait(
        "warpcage.store.sections.selection.vertices.length && warpcage.store.sections.selection.vertices"
    )
    return int(chosen[int(np.argmin(places[chosen, 1]))])


def goes(window, seconds: float) -> None:
    """Puts the timeline's head somewhere, by a typed time."""
    window.fill("#time", f"{seconds:g}\n")
    window.wait("Math.abs(warpcage.store.sections.playback.time - arguments[0]) < 0.02", "", seconds)


def bend(window, vertex: int, way: list[float]) -> None:
    """Drags a selected vertex."""
    place = window.places()[vertex]
    window.drag([place + np.array(way) * share for share in np.linspace(0, 1, 10)])


def resize(window, width: int, height: int) -> None:
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    window.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    window.wait("innerWidth === arguments[0]", "the window is resized", width)


def still(window) -> bool:
    """Whether no newer picture comes for a while: that of the newest pose is there."""
    before = window.get("warpcage.viewport.picture.frame")
    time.sleep(2.0)
    return before == window.get("warpcage.viewport.picture.frame")


def keep(window, path: pathlib.Path) -> None:
    """Takes a picture of the page at rest."""
    window.rest()
    box = window.box
    window.wait(
        "warpcage.viewport.picture.height === Math.round(arguments[0])", "a picture of this size", box["height"]
    )
    window.wait("!warpcage.store.sections.check?.pending", "the cage is checked")
    window.rest()
    window.point("mouseMoved", [box["left"] + 5, box["bottom"] - 5])
    shot(window, path)


def shot(window, path: pathlib.Path) -> None:
    """Writes what the window shows, in few colors."""
    from editor_browser import until
    from PIL import Image

    until(lambda: not window.get('document.getElementById("toasts").children.length'), "messages have gone")
    picture = Image.open(io.BytesIO(window.driver.get_screenshot_as_png())).convert("RGB")
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.quantize(256, kmeans=8, dither=Image.Dither.NONE).save(path, optimize=True)
    size = path.stat().st_size
    print(f"{path}: {picture.width}x{picture.height}, {size} bytes")
    if size >= MAX_BYTES:
        raise SystemExit(f"{path} has {size} bytes, {MAX_BYTES} are allowed")
