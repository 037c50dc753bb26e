"""Pages for tests of the editor's server: a real server on a free port, a tiny field, and WebSockets in Python."""

import asyncio
import contextlib
import functools
import inspect
import json
import logging
import struct

import aiohttp
import numpy as np
import pytest

from warpcage import Cage, VoxelField
from warpcage.field import LayeredBackground, harmonics_on_host
from warpcage.studio.editor import Server, Session, new_document

WAIT = 30.0
BOX = Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7))


@functools.cache
def tiny_field():
    """A ball of 16^3 voxels, red above and blue below."""
    x, y, z = np.meshgrid(*[(np.arange(16) + 0.5) / 8 - 1] * 3, indexing="ij")
    sh = np.zeros((16, 16, 16, 9, 3))
    sh[..., 0, :] = np.where(z[..., None] > 0, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])
    return VoxelField.from_dense(np.where(x**2 + y**2 + z**2 < 0.3, 40.0, 0.0), sh, [[-1, -1, -1], [1, 1, 1]])


def green_field():
    """The ball, green all over."""
    ball = tiny_field()
    colors = np.zeros_like(harmonics_on_host(ball.grid.sh))
    colors[:, 0] = (-1.5, 1.5, -1.5)
    return VoxelField(ball.bounds, ball.grid.links, ball.grid.density, colors)


def layered_field():
    """The ball before a background of one colour, in layers."""
    ball, side = tiny_field(), 8
    values = np.full((2, 6 * side**2 + 2, 4), 0.5)
    layers = LayeredBackground((0, 0, 0), 2.0, side, values)
    return VoxelField(
        ball.bounds, ball.grid.links, ball.grid.density, harmonics_on_host(ball.grid.sh), background_model=layers
    )


def new_session(path=None, cages=(BOX,), **options):
    return Session(tiny_field(), new_document(tiny_field(), cages, 16), path, **options)


@contextlib.asynccontextmanager
async def served(folder, session=None, **options):
    """A running server of a session, on a free port."""
    server = Server(session or new_session(), folder, **options)
    await server.start()
    try:
        yield server
    finally:
        await asyncio.wait_for(server.stop(), WAIT)


class Page:
    """A connected page: it keeps the newest sections and vertices, says what it has seen, and collects the rest."""

    def __init__(self, socket, sees=True):
        self.socket, self.sees = socket, sees
        self.sections, self.vertices, self.replies, self.notices, self.frames = {}, {}, {}, [], []
        self.number, self.sequence, self.client, self.news = 0, 0, None, asyncio.Event()
        self.reader = asyncio.create_task(self.read())

    async def read(self):
        async for message in self.socket:
            if message.type == aiohttp.WSMsgType.TEXT:
                self.hear(strict_json(message.data))
            elif message.type == aiohttp.WSMsgType.BINARY:
                await self.look(message.data)
            self.news.set()
        self.news.set()

    def hear(self, message):
        if message["type"] == "hello":
            self.client, self.sections = message["client"], message["sections"]
        elif message["type"] == "state":
            self.sections |= message["sections"]
            if "edits" in message["sections"]:
                self.vertices.clear()
        elif message["type"] == "reply":
            assert message["n"] not in self.replies, "two replies"
            self.replies[message["n"]] = message
        else:
            self.notices.append(message["text"])

    async def look(self, data):
        kind, first, second, third = struct.unpack_from("<4I", data)
        if kind == 10:
            header = strict_json(data[16 : 16 + first])
            assert len(data) == 16 + sum(-(-size // 8) * 8 for size in (first, second)) + third
            self.frames.append(header)
            if self.sees:
                await self.send(do="seen", frame=header["frame"])
        else:
            self.vertices[kind, second] = np.frombuffer(data, "<f8", offset=16).reshape(third, 3)

    async def send(self, **message):
        with contextlib.suppress(ConnectionError):
            await self.socket.send_str(json.dumps(message))

    async def post(self, **message):
        """Send a command that wants a reply, and return its number."""
        self.number += 1
        await self.send(n=self.number, **message)
        return self.number

    async def ask(self, **message):
        """The whole reply to a command."""
        number = await self.post(**message)
        await self.until(lambda: number in self.replies)
        return self.replies[number]

    async def do(self, **message):
        """The result of a command that must work."""
        reply = await self.ask(**message)
        assert "error" not in reply, reply
        return reply["result"]

    async def refused(self, **message):
        """The error of a command that must not work."""
        reply = await self.ask(**message)
        assert "error" in reply, (message, reply)
        assert "\n" not in reply["error"] and 0 < len(reply["error"]) <= 500
        return reply["error"]

    async def move(self, vertices, edit=1, kind=2):
        self.sequence += 1
        await self.socket.send_bytes(packed(vertices, edit, kind, self.sequence))

    async def drag(self, *places, edit=1, kind=2):
        await self.send(do="drag.begin", edit=edit, label="move", rest=kind == 3)
        for vertices in places:
            await self.move(vertices, edit, kind)
        await self.do(do="drag.end", edit=edit)

    async def until(self, condition):
        """Wait until a condition holds. Ends at once where the connection has."""
        while not condition():
            assert not self.socket.closed, "the connection has ended"
            self.news.clear()
            await asyncio.wait_for(self.news.wait(), WAIT)

    async def ended(self):
        await asyncio.wait_for(self.reader, WAIT)
        return self.socket.close_code

    def posed(self, number=1):
        """Posed vertices of an edit, as this page shows them."""
        return self.places("posed", 2, number)

    def rest(self, number=1):
        return self.places("rest", 3, number)

    def places(self, name, kind, number):
        (edit,) = (edit for edit in self.sections["edits"] if edit["id"] == number)
        return self.vertices.get((kind, number), np.array(edit[name]))


def packed(vertices, edit=1, kind=2, sequence=1):
    vertices = np.asarray(vertices, "<f8")
    return struct.pack("<4I", kind, sequence, edit, len(vertices)) + vertices.tobytes()


def strict_json(text):
    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=refuse)


@contextlib.asynccontextmanager
async def pages(server, count=1, size=(24, 16), **options):
    """Pages that are connected to a server, or to an address."""
    address = getattr(server, "address", server)
    async with aiohttp.ClientSession() as http:
        opened = []
        for _ in range(count):
            socket = await http.ws_connect(address + "socket", max_msg_size=0)
            opened.append(Page(socket, **options))
            await opened[-1].until(lambda: opened[-1].client is not None)
            if size is not None:
                await opened[-1].do(do="size", width=size[0], height=size[1])
        try:
            yield opened
        finally:
            for page in opened:
                await page.socket.close()
                page.reader.cancel()
                await asyncio.gather(page.reader, return_exceptions=True)


def with_pages(test, folder, count=1, session=None, size=(24, 16), **options):
    """Run an asynchronous test(server, *pages) against a server of its own. Nothing may reach asyncio's handler."""
    wrong = []

    async def run():
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: wrong.append(context))
        async with served(folder, session, **options) as server, pages(server, count, size) as opened:
            await test(server, *opened)

    asyncio.run(run())
    assert not wrong, [str(context) for context in wrong]


@pytest.fixture(autouse=True)
def nothing_logged(caplog):
    """No test of a module that takes this may make the editor, aiohttp or asyncio complain."""
    caplog.set_level(logging.WARNING)
    yield
    loud = [record for record in caplog.records if record.levelno >= logging.ERROR]
    assert not loud, [record.getMessage() for record in loud]


def run(test, folder, **options):
    """Run an asynchronous test(server, http session) against a server."""

    async def all_of_it():
        async with served(folder, **options) as host, aiohttp.ClientSession() as http:
            await asyncio.wait_for(test(host, http), 2 * WAIT)

    asyncio.run(all_of_it())


def on_pages(test):
    """A coroutine test(host, pages or http, fixtures) as pytest runs it: against a server of its own in `tmp_path`, of
    the session of the fixture `session` where it takes that."""
    names = list(inspect.signature(test).parameters)
    own = [name for name in names if name in ("host", "server", "page", "other", "third", "http")]

    def run_it(**given):
        async def called(*opened):
            fixtures = {name: given[name] for name in names if name in given}
            await test(**dict(zip(own, opened, strict=True)), **fixtures)

        if "http" in own:
            run(called, given["tmp_path"])
        else:
            with_pages(called, given["tmp_path"], len(own) - 1, given.get("session"))

    fixtures = dict.fromkeys([*names, "tmp_path"]).keys() - set(own)
    parameters = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY) for name in sorted(fixtures)]
    run_it.__name__, run_it.__doc__, run_it.__module__ = test.__name__, test.__doc__, test.__module__
    run_it.__signature__ = inspect.Signature(parameters)
    return run_it


async def status(http, address, **options):
    async with http.request(options.pop("method", "GET"), address, **options) as answer:
        return answer.status
