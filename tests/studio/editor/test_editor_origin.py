"""A page of another origin in a real browser: it reaches nothing of the editor."""

from __future__ import annotations

import dataclasses
import http.server
import threading
from pathlib import Path
from typing import Any

import numpy as np
from editor_browser import CAGE, Window, below, editor, posed, until, window

__all__ = ["editor", "window"]  # fixtures

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
  const ends = { onload: () => end("loaded"), onerror: () => end(no) };
  const made = Object.assign(document.createElement(tag), options, ends);
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
"""

#: All of it, with the address's token, without it, and with another one.
TRY_ALL = """
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
    found[name + " script"] = await element("script", { src: address + "geometry/vectors.js" });
    found[name + " module"] = await import(address + "geometry/vectors.js").then(() => "imported", () => no);
    found[name + " style"] = await element("link", { rel: "stylesheet", href: address + "style/base.css" });
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
    own = HOSTILE + "Promise.all([read(base), socket(base), element('img', { src: base + 'icons.svg' })]).then(done);"
    own = own.replace("pose.reset", "none such")
    assert browser.execute_async_script(own, editor.url) == ["read", "open", "loaded"]  # the page itself may
    window.driver.get("about:blank")
    until(lambda: not editor.server.clients, "the page has gone")
    document, files = editor.document, sorted(path.name for path in tmp_path.iterdir())
    numbers = editor.server.page_total
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Page)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        for host in ("127.0.0.1", "localhost"):
            browser.get(f"http://{host}:{server.server_address[1]}/")
            found = browser.execute_async_script(HOSTILE + TRY_ALL, editor.url)
            assert set(found.values()) == {"no"}, {name: got for name, got in found.items() if got != "no"}
            assert len(found) == 30
            browser.get("about:blank")  # the frames go
        until(lambda: not editor.server.clients, "frames have gone")
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
        window.open(editor.url)
        window.console()  # browsers say what they refused
    # A frame with the token in its address is the user's own page, as a notebook shows it; it alone was let in
    assert editor.server.page_total - numbers <= 3
    after = dataclasses.replace(editor.document, view=document.view)
    assert np.array_equal(posed(editor), document.edits[0].posed) and after.edits == document.edits
    names = {path.name for path in tmp_path.iterdir()} - {"ball.session.json"}
    assert names == set(files) - {"ball.session.json"}
