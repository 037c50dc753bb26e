"""Who may ask the editor's server, and the files that it serves: the page, uploads and downloads."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import os
import pathlib
import re
import secrets
import stat
import urllib.parse
from collections.abc import Awaitable, Callable, Iterable

from aiohttp import BodyPartReader, web
from aiohttp.http import HttpProcessingError

from ....core.names import error_line
from ....errors import InputError
from ...films.checks import MAX_LINE
from ..tasks import Tasks
from ..work.uploads import shown

#: What a page may do: run our own modules, show pictures made of bytes, talk to us. It may be shown in a notebook.
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; object-src 'none'; frame-ancestors 'self' http://localhost:* http://127.0.0.1:*",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


#: Random bytes of the token in the address.
TOKEN_BYTES = 24

#: What a token looks like.
TOKEN = re.compile(r"[\w-]{32}", re.ASCII)

#: How a file is opened that may be a link or a pipe by then: not through the one, without waiting for the other.
_AS_IT_IS = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


class Access:
    """Lets in who knows the token in the address, and pages of the same origin only.
    `allowed_hosts`: names under which pages may come, beside those of this machine's loopback and `host`."""

    # `Host` must be an allowed name: a foreign one that leads here is refused, even with the token.

    def __init__(self, host: str, allowed_hosts: Iterable[str] = (), session: pathlib.Path | None = None):
        # Where other machines may ask, an address that was handed out once ends with the editor.
        stays = session is not None and host in ("localhost", "127.0.0.1", "::1")
        self.token = _kept_token(session) if session is not None and stays else secrets.token_urlsafe(TOKEN_BYTES)
        self._hosts = {"localhost", "127.0.0.1", "::1", host.lower(), *map(str.lower, allowed_hosts)}
        self._everywhere = host in ("0.0.0.0", "::", "")

    def is_welcome(self, request: web.Request) -> bool:
        """Whether a request has the token, an allowed host name, and no foreign origin."""
        given = request.match_info.get("token", "").encode("utf-8", "surrogateescape")
        if not hmac.compare_digest(given, self.token.encode()):
            return False
        named = request.headers.get("Host", "")
        try:
            host = urllib.parse.urlsplit(f"//{named}").hostname or ""
            origins = [urllib.parse.urlsplit(origin).netloc for origin in request.headers.getall("Origin", [])]
        except ValueError:  # brackets that do not close
            return False
        if host not in self._hosts and not (self._everywhere and _is_address(host)):
            return False
        return all(origin == named for origin in origins)

    @property
    def guard(self) -> Callable[..., Awaitable[web.StreamResponse]]:
        """The middleware that refuses all others, and says in each answer what a page may do."""

        @web.middleware
        async def guard(
            request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
        ) -> web.StreamResponse:
            if not self.is_welcome(request):
                raise web.HTTPForbidden(
                    text="This needs the whole address that warpcage edit printed.", headers=HEADERS
                )
            try:
                response = await handler(request)
            except web.HTTPException as error:
                error.headers.update(HEADERS)
                raise
            if not response.prepared:
                response.headers.update(HEADERS)
            return response

        return guard


def _kept_token(session: pathlib.Path) -> str:
    """The token of a session's editor, kept beside the session's file for pages that are open, in a file that only its
    owner may read."""
    path = session.with_name(f".{session.name.removesuffix('.json')}.secret")
    with contextlib.suppress(OSError, UnicodeDecodeError), open(os.open(path, _AS_IT_IS), encoding="ascii") as file:
        status = os.fstat(file.fileno())
        private = not hasattr(os, "getuid") or (status.st_uid == os.getuid() and not status.st_mode & 0o077)
        if stat.S_ISREG(status.st_mode) and private and TOKEN.fullmatch(token := file.read(TOKEN_BYTES * 2)):
            return token
    token = secrets.token_urlsafe(TOKEN_BYTES)
    with contextlib.suppress(OSError):  # a folder that cannot be written to: pages are opened anew
        path.unlink(missing_ok=True)
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="ascii") as file:
            file.write(token)
    return token


def _is_address(host: str) -> bool:
    """Whether a host is given by number: the owner of a name could make it lead here."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


PAGE = pathlib.Path(__file__).parents[1] / "page"

KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}

#: Uploads that are taken at once: each is held in memory.
UPLOADS = 2

#: What a form that is not as it should be may cause: aiohttp asserts some of it.
BROKEN = (ValueError, OSError, LookupError, AssertionError, MemoryError, HttpProcessingError)


class Files:
    """Handlers for files; who may ask at all is decided before, by `Access`. `largest`: bytes of an upload."""

    def __init__(self, tasks: Tasks, largest: int):
        self._tasks, self._largest = tasks, largest
        self._uploads = asyncio.Semaphore(UPLOADS)

    def add_to(self, app: web.Application) -> None:
        """Serve the files at their addresses; nothing else of this form may be added later."""
        app.router.add_get("/{token}", self._to_page)
        app.router.add_get("/{token}/", self._page)
        app.router.add_get("/{token}/download/{name}", self._download)
        app.router.add_post("/{token}/upload", self._upload)
        app.router.add_get("/{token}/{name:.+}", self._page)

    async def _to_page(self, request: web.Request) -> web.StreamResponse:
        raise web.HTTPFound(f"/{request.match_info['token']}/")

    async def _page(self, request: web.Request) -> web.StreamResponse:
        """A file of the page. Only names that are there are looked up: no path is made of what is asked for."""
        name = request.match_info.get("name", "index.html")
        path = {file.relative_to(PAGE).as_posix(): file for file in PAGE.rglob("*.*") if file.suffix in KINDS}.get(name)
        if path is None:
            raise web.HTTPNotFound
        return web.Response(body=path.read_bytes(), content_type=KINDS[path.suffix], charset="utf-8")

    async def _download(self, request: web.Request) -> web.StreamResponse:
        path = self._tasks.download(request.match_info["name"])
        if path is None:
            raise web.HTTPNotFound(text="There is no such file; it may have been moved.")
        name = urllib.parse.quote(path.name)
        return web.FileResponse(path, headers={"Content-Disposition": f"attachment; filename*=UTF-8''{name}"})

    async def _upload(self, request: web.Request) -> web.StreamResponse:
        if request.content_type != "multipart/form-data":
            raise web.HTTPBadRequest(text="an upload needs one file, as a form sends it")
        try:
            async with self._uploads:
                name, content = await self._received(request)
                keep, page = self._tasks.uploads.keep, request.query.get("page", "")
                owner = int(page) if page.isdecimal() else None
                kept = await asyncio.get_running_loop().run_in_executor(None, keep, name, content, owner)
        except BROKEN as error:
            raise web.HTTPBadRequest(text=shown(error_line(error, MAX_LINE, folders=False))) from None
        return web.json_response({"file": kept})

    async def _received(self, request: web.Request) -> tuple[str, bytes]:
        """Name and content of the file in a form."""
        form = await request.multipart()
        part = await form.next()
        if not isinstance(part, BodyPartReader):
            raise InputError("an upload needs one file")
        content = bytearray()
        while chunk := await part.read_chunk(1 << 16):
            content += chunk
            if len(content) > self._largest:
                raise web.HTTPRequestEntityTooLarge(self._largest, len(content))
        if await form.next() is not None:  # which also raises where the form does not end
            raise InputError("an upload needs one file, and no more")
        return str(part.filename or ""), bytes(content)
