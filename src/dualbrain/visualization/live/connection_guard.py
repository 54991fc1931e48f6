"""Refusal of foreign web pages by the live page, before a connection is open.

Every web page that is open on this machine can send requests to a port of the loopback address, and a page whose name
an attacker's name server points to 127.0.0.1 (DNS rebinding) can even read the answers. The rules, for every HTTP
request and every upgrade to a WebSocket:

- `Host` is there once and names this machine, 127.0.0.1 or localhost, with the port of the live view. No name server
  can point such a name elsewhere.
- `Origin` is the page of the live view itself. `null` (a sandboxed page, a local file) is foreign. A request without
  `Origin` is allowed: browsers send it with every upgrade, so the sender is a program on this machine, which the rule
  of the operator buttons covers, or a browser that loads the page; such a `Host` may lack the port.
- `Sec-Fetch-Site`, which browsers add, is not another site, unless the user opens the page itself by a link.

The page may not be shown in a frame, where a foreign page could lead the user's click to a button, and it may connect
to its own server only: viser accepts the address of another server in the query of its own.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from http import HTTPStatus
from threading import Lock
from typing import TYPE_CHECKING, Any, Protocol

from dualbrain.visualization.live.web.own_pages import (
    ESTOP_PATH,
    INSTRUCTION_PATH,
    PAGE_FIELD,
    TEXT_FIELD,
    OwnPages,
    PageResponse,
)

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

HOST = "127.0.0.1"
LOOPBACK_NAMES = (HOST, "localhost")
OWN_SITES = ("same-origin", "none")
"""Values of `Sec-Fetch-Site` of requests by the page itself and by the user."""
FOREIGN_ORIGIN = "http://foreign.invalid"
"""Origin of the request that tests the guard; no page can have this name."""
PROBE_TIMEOUT_S = 10.0

RequestHandler = Callable[["ServerConnection", "Request"], "Response | None"]

_patch_lock = Lock()


class HeaderFields(Protocol):
    """Header fields of a request; names are compared without case."""

    def get_all(self, key: str, /) -> Sequence[str]:
        """All values of a field."""
        ...


def refuse_request(headers: HeaderFields, port: int) -> str:
    """The reason to refuse a request to the live view on `port`, "" for a request of its own page."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    own_hosts = [f"{name}:{port}" for name in LOOPBACK_NAMES]
    if not origins or port == 80:
        own_hosts += LOOPBACK_NAMES
    if len(hosts) != 1 or hosts[0].lower() not in own_hosts:
        return "the request is for another host"
    if len(origins) > 1 or (origins and origins[0].lower() != f"http://{hosts[0].lower()}"):
        return "the request is from a foreign page"
    opens_page = headers.get_all("Sec-Fetch-Mode") == ["navigate"] and headers.get_all("Sec-Fetch-Dest") == ["document"]
    if not opens_page and any(site.lower() not in OWN_SITES for site in headers.get_all("Sec-Fetch-Site")):
        return "the request is from a foreign page"
    return ""


def security_headers(port: int) -> dict[str, str]:
    """Header fields of every response: no frames, no other servers, and nothing for other sites."""
    own_servers = " ".join(f"ws://{name}:{port}" for name in LOOPBACK_NAMES)
    policy = (
        "default-src 'self' data: blob:",
        "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:",  # the client is one page of compressed scripts
        "style-src 'self' 'unsafe-inline'",
        f"connect-src 'self' {own_servers} data: blob:",
        "frame-src 'none'",
        "frame-ancestors 'none'",
        "object-src 'none'",
        "base-uri 'none'",
        "form-action 'none'",
    )
    return {
        "Content-Security-Policy": "; ".join(policy),
        "X-Frame-Options": "DENY",
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cache-Control": "no-store",
    }


@contextmanager
def guard_new_servers(pages: OwnPages | None = None) -> Generator[None]:
    """While the body runs, a WebSocket server that viser starts gets the guard, which stays with the server.

    The guarded server answers requests for `pages` itself.

    viser 1.1 has no setting for it. `guard_is_active` tests the result, because another version may start its server in
    another way.
    """
    from websockets.asyncio import server as websocket_server  # noqa: PLC0415  (comes with viser, heavy)

    module: Any = websocket_server
    with _patch_lock:
        original: Callable[..., Any] = module.serve

        def serve(handler: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
            if (getattr(handler, "__module__", None) or "").partition(".")[0] == "viser":
                options["process_request"] = _guarded(options.get("process_request"), pages)
            return original(handler, *arguments, **options)

        module.serve = serve
        try:
            yield
        finally:
            module.serve = original


def guard_is_active(port: int) -> bool:
    """Whether the server on `port` refuses an upgrade for a foreign page."""
    request = (
        f"GET / HTTP/1.1\r\nHost: {HOST}:{port}\r\nOrigin: {FOREIGN_ORIGIN}\r\nUpgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )
    try:
        with socket.create_connection((HOST, port), timeout=PROBE_TIMEOUT_S) as probe:
            probe.sendall(request.encode())
            return probe.makefile("rb").readline().split()[1:2] == [b"403"]
    except OSError:
        return False


def _guarded(process_request: RequestHandler | None, pages: OwnPages | None) -> RequestHandler:
    """`process_request` after the guard and the own pages, with the security headers in its response."""

    def process(connection: ServerConnection, request: Request) -> Response | None:
        port = connection.local_address[1]
        if reason := refuse_request(request.headers, port) or _refuse_action(request):
            response = connection.respond(403, f"Refused: {reason}.\n")
        elif own := _own_page(request, pages):
            response = _as_response(connection, own)
        else:
            response = process_request(connection, request) if process_request is not None else None
        if response is not None:
            for name, value in security_headers(port).items():
                if name in response.headers:
                    del response.headers[name]
                response.headers[name] = value
        return response

    return process


def _refuse_action(request: Request) -> str:
    """The reason to refuse an emergency stop or an instruction: a link of another site leads to it; else ""."""
    acts = _path(request) in (ESTOP_PATH, INSTRUCTION_PATH)
    foreign = any(site.lower() not in OWN_SITES for site in request.headers.get_all("Sec-Fetch-Site"))
    return "the request is from a foreign page" if acts and foreign else ""


def _path(request: Request) -> str:
    return request.path.partition("?")[0]


def _own_page(request: Request, pages: OwnPages | None) -> PageResponse | None:
    if pages is None or request.headers.get("Upgrade", "").lower() == "websocket":
        return None
    if _path(request) == INSTRUCTION_PATH:
        headers = request.headers
        return pages.receive_instruction(headers.get_all(TEXT_FIELD), headers.get_all(PAGE_FIELD))
    return pages.respond(request.path, accepts_gzip="gzip" in request.headers.get("Accept-Encoding", ""))


def _as_response(connection: ServerConnection, page: PageResponse) -> Response:
    """`page` as a response of the server of `connection`."""
    response = connection.respond(HTTPStatus(page.status), "")
    response.body = page.body
    for name, value in {"Content-Type": page.media_type, "Content-Length": str(len(page.body)), **page.headers}.items():
        if name in response.headers:
            del response.headers[name]
        response.headers[name] = value
    return response
