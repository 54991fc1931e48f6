"""Access to the HTTP server: the only place that decides which requests reach MCP and the console.

A request needs an allowed Host (against DNS rebinding), an allowed Origin if it has one (against other web pages), a
bounded body, and the bearer token, except for the static files of the console, which contain nothing about the robot.
"""

from __future__ import annotations

import hmac
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import ip_address

from starlette.datastructures import Headers
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from dualbrain.agent_server.contract_text import MAX_MESSAGE_BYTES, contract_as_text, is_utf8_text

MCP_PATH = "/mcp"
"""Path of the Model Context Protocol: in its messages, contracts become text."""
DEFAULT_PORTS = {"http": 80, "https": 443}
"""Ports that browsers leave out of Host and Origin, by the scheme."""
LOOPBACK_HOSTS = ("127.0.0.1", "localhost", "[::1]")


@dataclass(frozen=True, slots=True, kw_only=True)
class AccessPolicy:
    """The `token` of clients, the allowed `hosts` without a port, and the `port` of the server.

    `scheme` is http or https. `is_public` decides by the path which files need no token. `overview` is the sentence
    about the server in the refusal of the path /.
    """

    token: str
    hosts: tuple[str, ...]
    port: int
    scheme: str = "http"
    is_public: Callable[[str], bool] = lambda path: False
    overview: str = ""

    @property
    def authorities(self) -> frozenset[str]:
        """The names of the server in a Host, and after the scheme in an Origin: without the default port, too.

        They are in lower case, because host names are case-insensitive (RFC 9110, 4.2.3) and browsers send them so.
        """
        names = {name for host in self.hosts for name in _names(host)}
        with_port = {f"{name}:{self.port}" for name in names}
        return frozenset(with_port | names if self.port == DEFAULT_PORTS[self.scheme] else with_port)

    def refusal(self, method: str, path: str, headers: Headers) -> Response | None:
        """The response to a request that has no access; None for one that has."""
        allowed = self.authorities
        if headers.get("host", "").lower() not in allowed:
            return _refused(421, "This server does not answer for this host.")
        origin = headers.get("origin", "").lower()
        if origin and origin not in {f"{self.scheme}://{one}" for one in allowed}:
            return _refused(403, "Requests from other web pages are refused.")
        if self.is_public(path) and method in ("GET", "HEAD"):
            return None
        scheme, _, given = headers.get("authorization", "").partition(" ")
        is_token = hmac.compare_digest(given.encode(), self.token.encode())
        if not is_token or scheme.lower() != "bearer":  # RFC 9110, 11.1: a scheme is case-insensitive
            reason = "Send the header `Authorization: Bearer TOKEN` with the token of this server."
            reply = _refused(401, reason + (f" {self.overview}" if path == "/" and self.overview else ""))
            reply.headers["WWW-Authenticate"] = 'Bearer realm="dualbrain"'
            return reply
        return None


class AccessControl:
    """ASGI middleware that applies an `AccessPolicy`, and passes the contracts of MCP on as text."""

    def __init__(self, app: ASGIApp, policy: AccessPolicy) -> None:
        """Protect `app`."""
        self._app, self._policy = app, policy

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request that has no access, and pass all others on."""
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return  # no websockets
        headers = Headers(scope=scope)
        reply = self._policy.refusal(scope["method"], scope["path"], headers)
        if reply is None and int(headers.get("content-length", "0") or 0) > MAX_MESSAGE_BYTES:
            reply = _refused(413, f"A request has at most {MAX_MESSAGE_BYTES} bytes.")
        body = b"" if reply else await _read_body(receive)
        if reply is None and body is None:
            reply = _refused(413, f"A request has at most {MAX_MESSAGE_BYTES} bytes.")
        if reply is None and scope["path"] == MCP_PATH and not is_utf8_text(body or b""):
            reply = _refused(400, "Send the message as JSON in UTF-8, without a byte order mark and null bytes.")
        if reply is not None:
            await reply(scope, receive, send)
            return
        content = contract_as_text(body or b"") if scope["path"] == MCP_PATH else body or b""
        await self._app(_with_length(scope, len(content)), _replay(content, receive), send)


def _names(host: str) -> set[str]:
    """The name or address `host` in a Host: an IPv6 address in brackets, as it is written and in its short form."""
    plain = host.lower().removeprefix("[").removesuffix("]")
    with suppress(ValueError):
        return {f"[{one}]" if ":" in one else one for one in (plain, str(ip_address(plain)))}
    return {plain}


def _refused(status: int, reason: str) -> Response:
    return JSONResponse({"error": reason}, status_code=status)


async def _read_body(receive: Receive) -> bytes | None:
    """The body of a request; None if it is too long."""
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] != "http.request":
            return bytes(body)
        body += message.get("body", b"")
        if len(body) > MAX_MESSAGE_BYTES:
            return None
        if not message.get("more_body", False):
            return bytes(body)


def _with_length(scope: Scope, length: int) -> Scope:
    """The scope with the length of the new body."""
    kept = [(name, value) for name, value in scope["headers"] if name.lower() != b"content-length"]
    given = [(b"content-length", str(length).encode())] if len(kept) < len(scope["headers"]) else []
    return {**scope, "headers": [*kept, *given]}


def _replay(body: bytes, receive: Receive) -> Receive:
    """A `receive` that gives `body` first, and then the messages of the connection, such as its end."""
    first: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replayed() -> Message:
        return first.pop() if first else await receive()

    return replayed
