"""Guard: refuses requests that a web page of someone else has made, and sets the headers of every answer."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from lightning_pose.serving.errors import RequestError, error_response

__all__ = ["Guard"]

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Guard:
    """Middleware for a server that browsers of its machine can reach.

    A page of another origin may not post images, and a name that its owner lets point at this machine is not answered
    (DNS rebinding): the Host header must be an address, `localhost`, or a name that the user has given.

    Args:
        app: what answers.
        hosts: names that the server is called by.
    """

    def __init__(self, app: ASGIApp, hosts: Iterable[str] = ()) -> None:
        self.app = app
        self.hosts = {"localhost", *(host.lower() for host in hosts)}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
            await send(message)

        error = self._find_error(Headers(scope=scope))
        app = self.app if error is None else error_response(error)
        await app(scope, receive, send_with_headers)

    def _find_error(self, headers: Headers) -> RequestError | None:
        host = headers.get("host", "")
        name = _split_host(host)
        if name not in self.hosts and not _is_address(name):
            message = f"the server is not called {name[:100]!r}; start it with --allow-host to answer to that name"
            return RequestError(403, "host", message)
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return RequestError(403, "origin", "a page of another origin asks; browsers may use the server's own page")
        return None


def _split_host(host: str) -> str:
    """The name in a Host header, without its port."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
