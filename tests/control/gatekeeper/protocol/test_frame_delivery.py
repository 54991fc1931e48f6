"""Frames of every length arrive in any fragmentation, and an emergency stop behind them arrives, too."""

import random
import socket
from contextlib import suppress

import pytest

from dualbrain.control.gatekeeper.protocol.frames import HEADER, MAX_BODY_BYTES, encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Heartbeat,
    OperatorCommand,
    Propose,
    encode_body,
    kind_code,
)
from dualbrain.control.gatekeeper.protocol.server import BYTES_PER_TICK, DISCONNECTED, SocketServer

EMPTY_BODY = len(encode_body(Propose(contract=b"", issued=0.0, expires=0.0, scene_version=1, mac=b"m" * 32)))
MSGPACK_OVERHEAD = 8
"""Largest growth of the length field of a byte string [bytes]."""
LENGTHS = [
    *range(1, 8),
    *(BYTES_PER_TICK + k for k in range(-HEADER.size - EMPTY_BODY - 4, 5)),
    *(k * BYTES_PER_TICK - HEADER.size - EMPTY_BODY + j for k in (2, 3, 16) for j in (-1, 0, 1)),
    64 * 1024,
    MAX_BODY_BYTES - EMPTY_BODY - MSGPACK_OVERHEAD,
]
STOP = OperatorCommand(act="estop")


@pytest.fixture
def server(tmp_path):
    server = SocketServer(tmp_path / "s")
    yield server
    server.close()


def deliver(server, pieces, *, max_ticks=4000):
    """Send `pieces` one by one, with a tick of the server after each; the messages until the emergency stop."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(str(server.path))
        client.setblocking(False)
        received, unsent = [], b""
        for tick in range(max_ticks):
            if not unsent and pieces:
                unsent = pieces.pop(0)
            if unsent:
                with suppress(BlockingIOError):
                    unsent = unsent[client.send(unsent) :]
            received += [message for _, _, message in server.receive(float(tick))]
            assert not any(connection.fault for connection in server.connections)
            if received and received[-1] == STOP:
                break
    return received


def stream(length):
    """A proposal with a contract of `length` bytes, then an emergency stop."""
    proposal = Propose(contract=b"x" * length, issued=0.0, expires=1.0, scene_version=1, mac=b"m" * 32)
    frames = [
        encode(kind_code(message), number, encode_body(message)) for number, message in enumerate((proposal, STOP), 1)
    ]
    return proposal, b"".join(frames)


@pytest.mark.parametrize("length", LENGTHS)
def test_a_frame_of_any_length_is_delivered_and_the_stop_behind_it(server, length):
    proposal, data = stream(length)
    assert deliver(server, [data]) == [proposal, STOP]


@pytest.mark.parametrize("seed", range(12))
def test_a_frame_is_delivered_in_any_fragmentation(server, seed):
    rng = random.Random(seed)
    proposal, data = stream(rng.choice((rng.randint(1, 6000), rng.randint(1, 64 * 1024))))
    cuts = sorted(rng.sample(range(1, len(data)), min(len(data) - 1, rng.randint(1, 200))))
    pieces = [data[start:end] for start, end in zip([0, *cuts], [*cuts, len(data)], strict=True)]
    assert deliver(server, pieces) == [proposal, STOP]


@pytest.mark.parametrize("seed", range(4))
def test_many_frames_of_random_lengths_are_all_delivered_in_order(server, seed):
    rng = random.Random(seed)
    messages = [
        Propose(contract=b"y" * rng.randint(1, 9000), issued=0.0, expires=1.0, scene_version=k, mac=b"")
        if rng.random() < 0.6
        else Heartbeat()
        for k in range(40)
    ]
    data = b"".join(
        encode(kind_code(message), number, encode_body(message)) for number, message in enumerate((*messages, STOP), 1)
    )
    assert deliver(server, [data]) == [*messages, STOP]


def test_one_frame_is_kept_at_most(server):
    """A client that sends without end costs bounded memory: nothing is read while a complete frame is unprocessed."""
    _, data = stream(MAX_BODY_BYTES - EMPTY_BODY - MSGPACK_OVERHEAD)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(str(server.path))
        client.setblocking(False)
        largest = 0
        for tick in range(200):
            with suppress(BlockingIOError):
                client.send(data)
            list(server.receive(float(tick)))
            largest = max(largest, *(one._decoder.n_buffered for one in server.connections))
    assert largest <= HEADER.size + MAX_BODY_BYTES + BYTES_PER_TICK


def test_a_client_that_leaves_within_a_frame_is_disconnected_at_once(server):
    _, data = stream(9000)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(str(server.path))
        client.sendall(data[:5000])
        for tick in range(5):
            list(server.receive(float(tick)))
    for tick in range(5):
        list(server.receive(float(5 + tick)))
    assert [one.fault.startswith(DISCONNECTED) for one in server.connections] == [True]
