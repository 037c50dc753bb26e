"""Files: what the editor's server gives and takes over plain HTTP: the page, exports and uploads."""

from __future__ import annotations

import asyncio
import pathlib
import urllib.parse

from aiohttp import BodyPartReader, web
from aiohttp.http import HttpProcessingError

from .checked import error_line
from .tasks import Tasks

PAGE = pathlib.Path(__file__).with_name("page")
KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}

#: Uploads that are taken at once: each is held in memory.
UPLOADS = 2

#: What a form that is not as it should be may cause: aiohttp asserts some of it.
BROKEN = (ValueError, OSError, LookupError, AssertionError, MemoryError, HttpProcessingError)


class Files:
    """Handlers for files; who may ask at all is decided before, see `access`. `largest`: bytes of an upload."""

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
                keep = self._tasks.keep_upload
                kept = await asyncio.get_running_loop().run_in_executor(None, keep, name, content)
        except BROKEN as error:
            raise web.HTTPBadRequest(text=error_line(error)) from None
        return web.json_response({"file": kept})

    async def _received(self, request: web.Request) -> tuple[str, bytes]:
        """Name and content of the file in a form."""
        form = await request.multipart()
        part = await form.next()
        if not isinstance(part, BodyPartReader):
            raise ValueError("an upload needs one file")
        content = bytearray()
        while chunk := await part.read_chunk(1 << 16):
            content += chunk
            if len(content) > self._largest:
                raise web.HTTPRequestEntityTooLarge(self._largest, len(content))
        if await form.next() is not None:  # which also raises where the form does not end
            raise ValueError("an upload needs one file, and no more")
        return str(part.filename or ""), bytes(content)
