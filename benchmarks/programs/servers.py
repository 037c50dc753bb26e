"""Round trips of servers that the editor could stand on. The standard library and the server alone are imported."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import pathlib
import socket
import statistics
import subprocess
import sys
import time

from common import HERE, UsageError, command, option

#: Candidate -> what pip installs for it.
CANDIDATES = {
    "aiohttp": ["aiohttp"],
    "starlette": ["starlette", "uvicorn", "websockets"],
    "nicegui": ["nicegui"],
    "viser": ["viser"],
}

#: Those whose round trip is measured: viser has messages of its own alone.
MEASURED = ("aiohttp", "starlette", "nicegui")

UP, DOWN, TRIPS, WARM, ROUNDS = bytes(16 + 100 * 24), os.urandom(40_000), 500, 50, 8


@command(
    option("--folder", type=pathlib.Path, help="where environments are made"),
    option("--port", type=int, help=argparse.SUPPRESS),
    option("--serve", help=argparse.SUPPRESS),
    option("--ask", action="store_true", help=argparse.SUPPRESS),
)
def main(args) -> None:
    """Round trips of servers that the editor could stand on: a pose goes up, a picture comes down.

        python benchmarks servers --folder servers

    Each candidate gets a virtual environment of its own in the folder, by pip. A small binary message (a cage of 100
    vertices) is answered by a binary frame of 40 kB, over loopback, without compression. The client is aiohttp's for
    all of them, in a process of its own. Candidates take turns, and the quietest of their rounds counts. Outcomes are
    in NOTES-editor.md.
    """
    if args.serve:
        serve(args.serve, args.port)
    elif args.ask:
        asyncio.run(ask(args.port))
    elif args.folder is None:
        raise UsageError("give --folder")
    else:
        measure(args.folder)


def serve(name, port):
    if name == "aiohttp":
        from aiohttp import WSMsgType, web

        async def handle(request):
            socket = web.WebSocketResponse(compress=False)
            await socket.prepare(request)
            async for message in socket:
                if message.type == WSMsgType.BINARY:
                    await socket.send_bytes(DOWN)
            return socket

        application = web.Application()
        application.router.add_get("/socket", handle)
        web.run_app(application, host="127.0.0.1", port=port, print=None)
        return

    async def answer(websocket):
        await websocket.accept()
        try:
            while True:
                await websocket.receive_bytes()
                await websocket.send_bytes(DOWN)
        except Exception:
            pass  # the client has gone

    if name == "starlette":
        import uvicorn
        from starlette.applications import Starlette
        from starlette.routing import WebSocketRoute

        application = Starlette(routes=[WebSocketRoute("/socket", answer)])
        options = {"ws_per_message_deflate": False, "log_level": "error"}
        uvicorn.run(application, host="127.0.0.1", port=port, **options)
    else:
        from fastapi import WebSocket
        from nicegui import app, ui

        async def route(websocket: WebSocket):
            await answer(websocket)

        app.add_api_websocket_route("/socket", route)

        @ui.page("/")
        def page():
            ui.label("editor")

        ui.run(
            host="127.0.0.1",
            port=port,
            show=False,
            reload=False,
            ws_per_message_deflate=False,
            show_welcome_message=False,
        )


async def ask(port):
    import aiohttp

    async with aiohttp.ClientSession() as session:
        for _ in range(300):  # until the server is up
            try:
                socket = await session.ws_connect(f"http://127.0.0.1:{port}/socket", compress=0, max_msg_size=0)
                break
            except aiohttp.ClientError:
                await asyncio.sleep(0.1)
        times = []
        for _ in range(WARM + TRIPS):
            begin = time.perf_counter()
            await socket.send_bytes(UP)
            message = await socket.receive()
            times.append(1000 * (time.perf_counter() - begin))
            assert len(message.data) == len(DOWN)
        await socket.close()
    times = sorted(times[WARM:])
    print(json.dumps({"median_ms": statistics.median(times), "p95_ms": times[int(0.95 * len(times))]}))


def installed(folder, name):
    """The Python of a candidate's environment, which is made where it is not there, and what is in it."""
    environment = folder / name
    python = environment / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
        pip = [sys.executable, "-m", "pip", "--python", python, "-q", "install", *CANDIDATES[name]]
        subprocess.run(pip, check=True)
    libraries = next(environment.glob("lib/python3*/site-packages"))
    size = sum(path.lstat().st_size for path in libraries.rglob("*") if path.is_file() and path.suffix != ".pyc")
    packages = dict(path.stem.split("-", 1) for path in libraries.glob("*.dist-info"))
    version = packages[CANDIDATES[name][0]]
    return python, {"version": version, "megabytes": round(size / 1e6, 1), "packages": len(packages)}


def measure(folder):
    folder.mkdir(parents=True, exist_ok=True)
    client, _ = installed(folder, "aiohttp")
    servers, found = {}, {name: [] for name in MEASURED}
    try:
        for name in MEASURED:
            with socket.socket() as free:
                free.bind(("127.0.0.1", 0))
                port = str(free.getsockname()[1])
            python, _ = installed(folder, name)
            servers[port] = name, subprocess.Popen([python, str(HERE), "servers", "--port", port, "--serve", name])
        for _ in range(ROUNDS):
            for port, (name, _) in servers.items():
                ask = [client, str(HERE), "servers", "--port", port, "--ask"]
                found[name].append(json.loads(subprocess.run(ask, check=True, capture_output=True).stdout))
    finally:
        for _, server in servers.values():
            server.terminate()
            server.wait(30)
    for name in CANDIDATES:
        facts = installed(folder, name)[1]
        for key in ("median_ms", "p95_ms") if name in MEASURED else ():
            facts[key] = round(min(one[key] for one in found[name]), 2)
        print(name, json.dumps(facts), flush=True)
