"""Access: who may talk to an editor's server."""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import urllib.parse
from collections.abc import Awaitable, Callable, Iterable

from aiohttp import web

#: What a page may do: run our own modules, show pictures made of bytes, talk to us. It may be shown in a notebook.
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; object-src 'none'; frame-ancestors 'self' http://localhost:* http://127.0.0.1:*",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Access:
    """Lets those in who know the word in the address, and pages of the same origin only.
    `allowed_hosts`: names under which pages may come, beside those of this machine's loopback and `host`."""

    # The name in `Host` must be one that was told: a foreign name that is made to lead to this machine is refused, even
    # where somebody learned the token.

    def __init__(self, host: str, allowed_hosts: Iterable[str] = ()):
        self.token = secrets.token_urlsafe(24)
        self._hosts = {"localhost", "127.0.0.1", "::1", host.lower(), *map(str.lower, allowed_hosts)}
        self._everywhere = host in ("0.0.0.0", "::", "")

    def is_welcome(self, request: web.Request) -> bool:
        """Whether a request has the token, a host name that was told, and no foreign origin."""
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


def _is_address(host: str) -> bool:
    """Whether a host is given by number: a name that somebody else owns could be made to lead here."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
