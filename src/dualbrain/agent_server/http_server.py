"""MCP over Streamable HTTP, with further routes such as the console, on loopback or with TLS."""

from __future__ import annotations

import contextlib
import signal
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from types import FrameType
from typing import Any

import uvicorn
from mcp.server.lowlevel import Server
from mcp.server.transport_security import TransportSecuritySettings
from starlette.routing import BaseRoute

from dualbrain.agent_server.access_control import LOOPBACK_HOSTS, MCP_PATH, AccessControl, AccessPolicy
from dualbrain.agent_server.contract_text import MAX_MESSAGE_BYTES
from dualbrain.agent_server.listener import check_tls_files, open_listener
from dualbrain.core.untrusted.loopback import is_loopback, is_wildcard
from dualbrain.errors import ConfigurationError

STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


@dataclass(frozen=True, slots=True, kw_only=True)
class HttpConfig:
    """Address, `token` and TLS files of the server; without TLS, the host must be this machine."""

    port: int
    token: str
    host: str = "127.0.0.1"
    certificate: Path | None = None
    private_key: Path | None = None

    @property
    def url(self) -> str:
        """Address of the server."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.certificate else 'http'}://{host}:{self.port}"

    def open_listener(self) -> socket.socket:
        """The listening socket of the server; raises `ConfigurationError` if it or the TLS files cannot be used."""
        if self.certificate is not None and self.private_key is not None:
            check_tls_files(self.certificate, self.private_key)
        return open_listener(self.host, self.port)

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for a host that cannot be served safely, and for half a pair of TLS files.

        A host beyond this machine needs TLS. A wildcard address is refused: the server answers only requests that are
        addressed to its host, so that no other web page reaches it (DNS rebinding), and no request names a wildcard.
        """
        if (self.certificate is None) != (self.private_key is None):
            raise ConfigurationError.stating(
                "TLS needs both a certificate and a private key.", fix="Name both --tls-cert and --tls-key."
            )
        if is_wildcard(self.host):
            raise ConfigurationError.stating(
                f"The server would listen on every address ({self.host or 'empty host'}) and answer no request, "
                "because it answers only requests that name its host.",
                fix="Name the host name or address by which the clients reach this machine.",
            )
        if self.certificate is None and not is_loopback(self.host):
            raise ConfigurationError.stating(
                f"The server would listen on {self.host} without TLS, where others can read the token.",
                fix="Use 127.0.0.1, or name --tls-cert and --tls-key.",
            )


def serve_http(
    server: Server[Any],
    config: HttpConfig,
    listener: socket.socket,
    routes: Sequence[BaseRoute] = (),
    *,
    is_public: Callable[[str], bool] = lambda path: False,
    overview: str = "",
    on_ready: Callable[[], None] = lambda: None,
    on_stop: Callable[[], None] = lambda: None,
) -> None:
    """Serve MCP at `/mcp` and the further `routes` on `listener` until SIGTERM, SIGINT or SIGHUP.

    Paths that `is_public` accepts need no token; `overview` is a sentence in the refusal of / without one. At a signal,
    `on_stop` is called at once in a thread of its own, while open connections end. uvicorn's own handler of signals
    raises them again at its end, which would skip the clean-up of the caller; so the signals are handled here.
    """
    hosts = (*LOOPBACK_HOSTS, config.host) if is_loopback(config.host) else (config.host,)
    policy = AccessPolicy(
        token=config.token,
        hosts=tuple(dict.fromkeys(hosts)),
        port=config.port,
        scheme="https" if config.certificate else "http",
        is_public=is_public,
        overview=overview,
    )
    app = server.streamable_http_app(
        streamable_http_path=MCP_PATH,
        host=config.host,
        max_request_body_size=MAX_MESSAGE_BYTES + 1,
        transport_security=TransportSecuritySettings(enable_dns_rebinding_protection=False),  # `AccessControl` does it
        custom_starlette_routes=list(routes),  # pyright: ignore[reportArgumentType]
    )
    running = _Server(
        uvicorn.Config(
            AccessControl(app, policy),
            host=config.host,
            port=config.port,
            log_level="warning",
            access_log=False,
            server_header=False,
            ssl_certfile=config.certificate,
            ssl_keyfile=config.private_key,
            timeout_graceful_shutdown=1,
        ),
        on_ready,
        on_stop,
    )
    running.run(sockets=[listener])


class _Server(uvicorn.Server):
    """A server that calls `on_ready` when it listens, and `on_stop` at a signal, which ends it."""

    def __init__(self, config: uvicorn.Config, on_ready: Callable[[], None], on_stop: Callable[[], None]) -> None:
        super().__init__(config)
        self._on_ready, self._on_stop = on_ready, on_stop

    @contextlib.contextmanager
    def capture_signals(self) -> Any:
        """Handle the signals without raising them again."""

        def stop(number: int, frame: FrameType | None) -> None:
            del number, frame
            if not self.should_exit:
                self.should_exit = True
                Thread(target=self._on_stop, name="stop").start()

        before = {number: signal.signal(number, stop) for number in STOP_SIGNALS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    async def startup(self, sockets: Any = None) -> None:
        """Listen, then report that the server is ready."""
        await super().startup(sockets)
        if self.started:
            self._on_ready()
