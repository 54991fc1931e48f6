"""Fuzzing client: connects to the socket of a gatekeeper again and again, and sends fuzzed frames.

    fuzz_client.py SOCKET SECONDS SEED        (prints its counts as one JSON object)

The client decodes its own bytes with the decoder of the gatekeeper, so it knows which frame must end the connection.
It sends frames up to the first such frame, then waits until the gatekeeper closes the connection. Only frames sent
until then are counted.
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
from experiments.interfaces.fuzzer import Fuzzer

MAX_FRAMES = 200
"""Frames per connection; fewer than the limit of the gatekeeper for a flood."""
DISCONNECT_TIMEOUT_S = 5.0
"""Time within which the gatekeeper must close the connection [s]."""


def main(path: str, seconds: str, seed: str) -> None:
    """Open connections until the time is up, and print the counts."""
    fuzzer, until = Fuzzer(int(seed)), time.monotonic() + float(seconds)
    counts = {"connections": 0, "frames": 0, "bytes": 0, "refused": 0, "left": 0, "not hung up": 0}
    while time.monotonic() < until:
        run_connection(path, fuzzer, counts)
    json.dump(counts, sys.stdout)


def run_connection(path: str, fuzzer: Fuzzer, counts: dict[str, int]) -> None:
    """Open one connection and add its outcome to `counts`; 7 of 10 begin with a valid greeting."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        link.settimeout(DISCONNECT_TIMEOUT_S)
        link.connect(path)
        counts["connections"] += 1
        greets, decoder, sent = fuzzer.rng.random() < 0.7, FrameDecoder(), 0
        if greets:
            hello = Hello(principal="", proof=b"")
            sent += 1
            data = encode(kind_code(hello), 1, encode_body(hello))
            if not _send(link, data, counts) or not _stays_connected(decoder, data):
                return
        for _ in range(MAX_FRAMES):
            sent += 1
            data = fuzzer.frame(fuzzer.message(), sent) or b"\0"
            closed = not _send(link, data, counts)
            if closed or not _stays_connected(decoder, data):
                break
            if not greets:  # a valid first frame: whether the connection stays open depends on its kind
                counts["left"] += 1
                return
        else:
            counts["left"] += 1
            return
        _await_disconnect(link, decoder, counts)


def _stays_connected(decoder: FrameDecoder, data: bytes) -> bool:
    """Return whether the gatekeeper must keep the connection after `data`."""
    decoder.feed(data)
    frame = decoder.next_frame()
    return (
        frame is not None
        and not isinstance(frame, BrokenStream)
        and not isinstance(decode_message(frame, from_client=True), str)
    )


def _send(link: socket.socket, data: bytes, counts: dict[str, int]) -> bool:
    """Send `data` and discard received bytes; False if the connection is closed."""
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
    """Wait until the gatekeeper closes a malformed stream; leave one that ends within a frame."""
    if decoder.failure is None and decoder.n_buffered:
        counts["left"] += 1
        return
    until = time.monotonic() + DISCONNECT_TIMEOUT_S
    try:
        while (remaining := until - time.monotonic()) > 0.0:
            link.settimeout(remaining)
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
