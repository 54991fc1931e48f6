"""Bounded files: regular files up to the limit are read, everything else is refused without waiting."""

import os
import socket
from io import BytesIO
from pathlib import Path

import pytest

from dualbrain.core.untrusted.bounded_file import (
    FileRefusal,
    byte_size,
    read_bounded_file,
    read_bounded_stream,
    read_regular_file,
)
from dualbrain.errors import ConfigurationError


@pytest.mark.parametrize("size", [0, 1, 100])
def test_a_regular_file_up_to_the_limit_is_read(tmp_path, size):
    (tmp_path / "a").write_bytes(bytes(size))
    assert read_regular_file(tmp_path / "a", 100) == bytes(size)
    (tmp_path / "link").symlink_to(tmp_path / "a")
    assert read_bounded_file(tmp_path / "link", 100) == bytes(size)


def special_file(folder: Path, kind: str) -> Path:  # noqa: C901
    path = folder / "x"
    match kind:
        case "large":
            path.write_bytes(bytes(101))
        case "sparse":
            with path.open("wb") as file:
                file.truncate(1 << 40)
        case "fifo":
            os.mkfifo(path)
        case "link to a fifo":
            os.mkfifo(folder / "fifo")
            path.symlink_to(folder / "fifo")
        case "folder":
            path.mkdir()
        case "socket":
            with socket.socket(socket.AF_UNIX) as one:
                one.bind(str(path))
        case "loop":
            path.symlink_to(path)
        case "zero":
            path.symlink_to("/dev/zero")
        case "endless":
            return Path("/proc/kallsyms")
        case "below a file":
            path.write_bytes(b"")
            return path / "y"
        case "nul":
            return folder / "a\0b"
    return path


@pytest.mark.parametrize(
    ("kind", "refusal", "words"),
    [
        ("missing", "missing", "There is no file"),
        ("below a file", "missing", "There is no file"),
        ("large", "too large", "larger than 100 bytes"),
        ("sparse", "too large", "larger than 100 bytes"),
        ("endless", "too large", "larger than 100 bytes"),
        ("fifo", "not regular", "a named pipe"),
        ("link to a fifo", "not regular", "a named pipe"),
        ("folder", "not regular", "a folder"),
        ("socket", "not regular", "a socket"),
        ("zero", "not regular", "a device"),
        ("loop", "unreadable", "cannot be read"),
        ("nul", "unreadable", "cannot be read"),
    ],
)
def test_every_other_file_is_refused_at_once(tmp_path, kind, refusal, words):
    path = special_file(tmp_path, kind)
    found = read_regular_file(path, 100)
    assert isinstance(found, FileRefusal)
    assert (found.kind, words in found.sentence) == (refusal, True)
    with pytest.raises(ConfigurationError, match="Do this instead"):
        read_bounded_file(path, 100, fix="Do this instead.")


def test_a_link_is_refused_where_links_are_not_followed(tmp_path):
    (tmp_path / "a").write_bytes(b"x")
    (tmp_path / "link").symlink_to(tmp_path / "a")
    assert read_regular_file(tmp_path / "a", 100, follow_links=False) == b"x"
    found = read_regular_file(tmp_path / "link", 100, follow_links=False)
    assert isinstance(found, FileRefusal)
    assert "a symbolic link" in found.sentence


def test_a_stream_is_read_up_to_its_limit():
    assert read_bounded_stream(BytesIO(b"x" * 100), 100, "input") == b"x" * 100
    with pytest.raises(ConfigurationError, match="larger than 100 bytes"):
        read_bounded_stream(BytesIO(b"x" * 101), 100, "input")
    with Path("/dev/zero").open("rb") as endless, pytest.raises(ConfigurationError, match="larger than 1 MB"):
        read_bounded_stream(endless, 1 << 20, "input")


def test_sizes_are_stated_in_whole_units():
    assert [byte_size(count) for count in (100, 2048, 512 << 20, 1500)] == ["100 bytes", "2 kB", "512 MB", "1500 bytes"]
