"""Options of the commands that serve HTTP."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from dualbrain.core.paths import dualbrain_home

if TYPE_CHECKING:
    from dualbrain.agent_server.http_server import HttpConfig

TOKEN_FILE = "http.token"
"""File of the data folder with the token of the HTTP server."""


@Parameter(name="*")
@dataclass(frozen=True, slots=True, kw_only=True)
class HttpOptions:
    """Address and access of an HTTP server."""

    host: str = "127.0.0.1"
    """Address on which the server listens; another one than loopback needs TLS."""

    token_file: Path | None = None
    """File with the bearer token, created if necessary; DUALBRAIN_TOKEN has precedence. Default: http.token in the
    data folder."""

    tls_cert: Path | None = None
    """TLS certificate (PEM)."""

    tls_key: Path | None = None
    """Private key of the certificate (PEM)."""

    @property
    def token_path(self) -> Path:
        """The file with the token."""
        return self.token_file or dualbrain_home() / TOKEN_FILE

    @property
    def token_place(self) -> str:
        """Where a person finds the token."""
        from dualbrain.agent_server.token import TOKEN_VARIABLE

        return TOKEN_VARIABLE if os.environ.get(TOKEN_VARIABLE) else str(self.token_path)


DEFAULT_HTTP = HttpOptions()


def http_config(options: HttpOptions, port: int) -> HttpConfig:
    """The configuration of a server at `port`; raises `ConfigurationError`."""
    from dualbrain.agent_server.http_server import HttpConfig
    from dualbrain.agent_server.token import load_token

    return HttpConfig(
        port=port,
        token=load_token(options.token_path, os.environ),
        host=options.host,
        certificate=options.tls_cert,
        private_key=options.tls_key,
    )
