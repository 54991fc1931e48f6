"""The listening socket of the HTTP server, opened before the robot: an address in use is reported at once."""

from __future__ import annotations

import socket
import ssl
from pathlib import Path

from dualbrain.errors import ConfigurationError


def open_listener(host: str, port: int) -> socket.socket:
    """A socket that listens at `host` and `port`; the caller closes it.

    Raises `ConfigurationError` for a port that is not 1 to 65535, and for an address that cannot be used.
    """
    if not 1 <= port <= 65535:
        raise ConfigurationError("port", got=port, allowed="1 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise ConfigurationError.stating(
            f"The server cannot listen on {host}, port {port}: {error.strerror or error}.",
            fix="Name another port, or end the program that uses it.",
        ) from error


def check_tls_files(certificate: Path, private_key: Path) -> None:
    """Raise `ConfigurationError` unless both files can be read and belong together."""
    for path in (certificate, private_key):
        if not path.is_file():
            raise ConfigurationError.stating(f"There is no TLS file at {path}.", fix="Name an existing PEM file.")
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, private_key)
    except (OSError, ValueError) as error:  # an error of TLS is an OSError
        raise ConfigurationError.stating(
            f"The TLS files {certificate} and {private_key} cannot be used: {error}.",
            fix="Name a certificate in PEM and its own private key without a password.",
        ) from error
