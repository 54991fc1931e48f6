"""Lines of the shell without a terminal: whole lines in their order, and a wait that another thread can end."""

import os
import sys

import pytest

from dualbrain.cli.run.shell.line_reader import LineReader


@pytest.fixture
def pipe(monkeypatch):
    """The writing end of standard input."""
    read, write = os.pipe()
    with os.fdopen(read) as stream:
        monkeypatch.setattr(sys, "stdin", stream)
        yield write


def test_lines_are_returned_in_their_order_and_the_last_one_needs_no_line_end(pipe):
    reader = LineReader()
    os.write(pipe, "put the cube\ngo hömé".encode())
    os.close(pipe)
    assert [reader.prompt(), reader.wait(), reader.prompt()] == ["put the cube", "go hömé", None]
    assert reader.ended
    reader.close()


def test_a_wait_ends_by_the_signal_of_another_thread_and_a_line_is_not_lost(pipe):
    reader = LineReader()
    os.write(pipe, b"half a ")
    reader.wake()
    assert reader.wait() is None
    os.write(pipe, b"line\n")
    assert reader.wait() == "half a line"
    os.close(pipe)
    reader.close()


def test_after_the_end_of_the_input_a_wait_ends_only_by_the_signal(pipe):
    reader = LineReader()
    os.close(pipe)
    assert reader.prompt() is None
    reader.wake()
    assert reader.wait() is None
    reader.close()
