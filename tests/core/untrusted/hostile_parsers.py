"""Functions that behave as a parser does that met a hostile file; run in a bounded process by the tests."""

import ctypes
import os
import signal
import time
from collections.abc import Iterator

from dualbrain.errors import ConfigurationError, MissingDependencyError


def echo(argument: bytes) -> bytes:
    return argument


def repeat(argument: bytes) -> Iterator[bytes]:
    for _ in range(int(argument)):
        yield argument * 1000


def yield_then_compute(argument: bytes) -> Iterator[bytes]:
    yield argument
    while True:
        pass


def yield_then_refuse(argument: bytes) -> Iterator[bytes]:
    yield argument
    raise ConfigurationError("record 2", got="junk", allowed="a record")


def open_files(_: bytes) -> bytes:
    names = [f"/proc/self/fd/{number}" for number in range(3, 64)]
    return " ".join(os.readlink(name) for name in names if os.path.lexists(name)).encode()


def environment(_: bytes) -> bytes:
    return " ".join(os.environ).encode()


def process_id(_: bytes) -> bytes:
    return str(os.getpid()).encode()


def process_ids(_: bytes) -> bytes:
    return f"{os.getpid()} {os.getppid()}".encode()


def kill_its_starter(_: bytes) -> bytes:
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(60.0)
    return b""


def allocate(argument: bytes) -> bytes:
    return bytes(len(bytearray(int(argument))) % 256)


def sleep(argument: bytes) -> bytes:
    time.sleep(float(argument))
    return b""


def announce_and_sleep(argument: bytes) -> bytes:
    handle = os.open(argument, os.O_WRONLY)  # a pipe: files cannot be written
    os.write(handle, str(os.getpid()).encode())
    os.close(handle)
    while True:
        time.sleep(1.0)


def compute(_: bytes) -> bytes:
    while True:
        pass


def flood(argument: bytes) -> bytes:
    return bytes(int(argument))


def nest(_: bytes) -> bytes:
    return nest(_)


def crash(_: bytes) -> bytes:
    ctypes.string_at(0)
    return b""


def kill_itself(_: bytes) -> bytes:
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(5)
    return b""


def leave(_: bytes) -> bytes:
    os._exit(7)


def raise_value_error(_: bytes) -> bytes:
    raise ValueError("three\nlines\nof text")


def panic(_: bytes) -> bytes:
    raise PanicError("a panic of an extension")


class PanicError(BaseException):
    """As the exceptions of Rust extensions: not an `Exception`."""


def refuse(_: bytes) -> bytes:
    raise ConfigurationError("size of a.stl", got="9 bytes", allowed="8 bytes", fix="Use a smaller one.")


def lack_package(_: bytes) -> bytes:
    raise MissingDependencyError("The package x", fix="Install it.")


def write_file(argument: bytes) -> bytes:
    with open(argument, "wb") as file:
        file.write(b"x")
    return b"written"


def print_much(_: bytes) -> bytes:
    print("x" * 100_000)  # noqa: T201
    os.system("echo noise")
    return b"result"
