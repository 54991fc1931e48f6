"""Requests to the live view as a foreign page or program would send them, byte by byte."""

import socket
from importlib.metadata import version


def upgrade_lines(host: str | None, origin: str | None, *more: str) -> list[str]:
    """Header lines of an upgrade to a WebSocket; None leaves the field out."""
    fields = [f"Host: {host}"] * (host is not None) + [f"Origin: {origin}"] * (origin is not None)
    return [
        *fields,
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
        f"Sec-WebSocket-Protocol: viser-v{version('viser')}",
        *more,
    ]


def exchange(port: int, lines: list[str], path: str = "/") -> tuple[int, dict[str, str], bytes]:
    """Status, header fields and the first bytes that follow, b"" if the server closes the connection."""
    with socket.create_connection(("127.0.0.1", port), timeout=20.0) as client:
        client.sendall(("\r\n".join([f"GET {path} HTTP/1.1", *lines]) + "\r\n\r\n").encode())
        reply = client.makefile("rb")
        status = int((reply.readline().split() or [b"", b"0"])[1])
        fields: dict[str, str] = {}
        while (line := reply.readline().decode().strip()) != "":
            name, _, value = line.partition(":")
            fields[name.lower()] = value.strip()
        return status, fields, reply.read(1)
