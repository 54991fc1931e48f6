"""Fuzz at the real socket: strangers and onlookers who come again and again, and say what no one should.

    fuzz_door.py SOCKET SECONDS SEED        (counts as one JSON object on standard output)

A client knows what the gatekeeper must make of its bytes, because it runs them through the same decoder: it goes on
until the first that ends a connection, and then waits to be hung up on. Only what was sent until then is counted.
"""

from __future__ import annotations

import json
import select
import socket
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from dualbrain.control.gatekeeper.protocol.frames import BrokenStream, FrameDecoder, encode
from dualbrain.control.gatekeeper.protocol.messages import Hello, decode_message, encode_body, kind_code
from experiments.gatekeeper.fuzzer import Fuzzer

MAX_FRAMES = 200
"""At most so many on one connection, fewer than a flood is."""
DISCONNECT_TIMEOUT_S = 5.0
"""How long the gatekeeper may take to hang up [s]."""


def main(path: str, seconds: str, seed: str) -> None:
    """Come again until the time is up."""
    fuzzer, until = Fuzzer(int(seed)), time.monotonic() + float(seconds)
    counts = {"connections": 0, "frames": 0, "bytes": 0, "refused": 0, "left": 0, "not hung up": 0}
    while time.monotonic() < until:
        run_connection(path, fuzzer, counts)
    json.dump(counts, sys.stdout)


def run_connection(path: str, fuzzer: Fuzzer, counts: dict[str, int]) -> None:
    """One connection."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        link.settimeout(DISCONNECT_TIMEOUT_S)
        link.connect(path)
        counts["connections"] += 1
        known, decoder, sent = fuzzer.rng.random() < 0.7, FrameDecoder(), 0
        if known:
            hello = Hello(principal="", proof=b"")
            sent += 1
            data = encode(kind_code(hello), 1, encode_body(hello))
            if not _send(link, data, counts) or not _stays_connected(decoder, data):
                return
        for _ in range(MAX_FRAMES):
            sent += 1
            data = fuzzer.frame(fuzzer.message(), sent) or b"\0"
            gone = not _send(link, data, counts)
            if gone or not _stays_connected(decoder, data):
                break
            if not known:  # a stranger that was understood: whether it may stay depends on what it said
                counts["left"] += 1
                return
        else:
            counts["left"] += 1
            return
        _await_disconnect(link, decoder, counts)


def _stays_connected(decoder: FrameDecoder, data: bytes) -> bool:
    """Whether the connection can go on after `data`."""
    decoder.feed(data)
    frame = decoder.next_frame()
    return (
        frame is not None
        and not isinstance(frame, BrokenStream)
        and not isinstance(decode_message(frame, from_client=True), str)
    )


def _send(link: socket.socket, data: bytes, counts: dict[str, int]) -> bool:
    """Send, and throw away what has come; False if nobody is there any more."""
    try:
        link.sendall(data)
        while select.select((link,), (), (), 0.0)[0]:
            if not link.recv(1 << 16):
                return False
    except OSError:
        return False
    counts["frames"] += 1
    counts["bytes"] += len(data)
    return True


def _await_disconnect(link: socket.socket, decoder: FrameDecoder, counts: dict[str, int]) -> None:
    """A stream that was broken ends; one that waits for the rest of a frame is left."""
    if decoder.failure is None and decoder.n_buffered:
        counts["left"] += 1
        return
    until = time.monotonic() + DISCONNECT_TIMEOUT_S
    try:
        while (left := until - time.monotonic()) > 0.0:
            link.settimeout(left)
            if not link.recv(1 << 16):
                counts["refused"] += 1
                return
    except TimeoutError:
        pass
    except OSError:
        counts["refused"] += 1
        return
    counts["not hung up"] += 1


if __name__ == "__main__":
    main(*sys.argv[1:])
