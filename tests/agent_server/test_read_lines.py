"""Lines of standard input, also in pieces and without a limit."""

import os
from threading import Thread

import pytest

from dualbrain.agent_server.contract_text import MALFORMED, MAX_MESSAGE_BYTES
from dualbrain.agent_server.stdio_server import read_lines


def lines_of(*parts: bytes) -> list[bytes]:
    reading, writing = os.pipe()

    def write():
        with os.fdopen(writing, "wb") as pipe:
            for part in parts:
                pipe.write(part)
                pipe.flush()

    writer = Thread(target=write)
    writer.start()
    try:
        return list(read_lines(reading))
    finally:
        writer.join()
        os.close(reading)


@pytest.mark.parametrize("parts", [(b"one\ntwo\n",), (b"on", b"e\n", b"two", b"\n"), (b"one\ntwo\nwithout an end",)])
def test_whole_lines_are_read(parts):
    assert lines_of(*parts) == [b"one", b"two"]


def test_a_line_that_is_too_long_is_malformed_and_the_next_one_is_read():
    long = b"x" * (2 * MAX_MESSAGE_BYTES)
    assert lines_of(b"one\n", long, b"\n", b"two\n") == [b"one", MALFORMED, b"two"]


def test_no_input_has_no_lines():
    assert lines_of() == []
