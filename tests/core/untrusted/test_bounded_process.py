"""Bounded processes: a result for an honest argument, a failure as a value for every way to misbehave."""

import os
import socket
import time

import pytest

from dualbrain.core.untrusted.bounded_process import ProcessFailure, ProcessLimits, run_bounded, stream_bounded
from dualbrain.errors import ConfigurationError, MissingDependencyError
from tests.support.process_state import process_state

PARSERS = "tests.core.untrusted.hostile_parsers"
SMALL = ProcessLimits(memory_bytes=64 << 20, seconds=1.0, output_bytes=1 << 20)


def run(name, argument=b"", limits=SMALL):
    return run_bounded(f"{PARSERS}:{name}", argument, limits)


@pytest.mark.parametrize("argument", [b"", b"a", b"\0\xff" * 400_000])
def test_an_honest_function_returns_its_bytes(argument):
    assert run("echo", argument) == argument


@pytest.mark.parametrize(
    ("name", "argument", "kind", "reason"),
    [
        ("allocate", b"100000000", "memory", "needs more than 64 MB of memory"),
        ("sleep", b"60", "time", "took longer than 1 s"),
        ("compute", b"", "time", "took longer than 1 s"),
        ("flood", b"1048577", "output", "contains more than 1 MB"),
        ("nest", b"", "nesting", "is nested too deeply"),
        ("crash", b"", "signal", "cannot be read: its reader ended with signal 11"),
        ("kill_itself", b"", "signal", "cannot be read: its reader ended with signal 15"),
        ("leave", b"", "exception", "cannot be read: its reader ended with code 7"),
        ("raise_value_error", b"", "exception", "cannot be read: ValueError: three lines of text"),
        ("panic", b"", "exception", "cannot be read: PanicError: a panic of an extension"),
    ],
)
def test_every_misbehaviour_is_a_failure_with_a_reason(name, argument, kind, reason):
    start = time.monotonic()
    assert run(name, argument) == ProcessFailure(kind, reason)
    assert time.monotonic() - start < 30.0


def test_a_function_that_does_not_exist_is_a_failure():
    for found in (run("no_such_function"), stream("no_such_function", b"")[0]):
        assert found.kind == "exception"
        assert "no_such_function" in found.reason


def test_an_allocation_within_the_limit_is_no_failure():
    assert isinstance(run("allocate", b"30000000"), bytes)


def test_processor_time_ends_a_process_whose_parent_waits_longer():
    from dualbrain.core.untrusted import bounded_process  # noqa: PLC0415

    limits = ProcessLimits(memory_bytes=64 << 20, seconds=0.1)
    call = bounded_process._begin(f"{PARSERS}:compute", b"", limits, streams=False)
    try:
        assert bounded_process._await_reply(call, ProcessLimits(seconds=60.0)).kind == "time"
    finally:
        call.end()


def test_refusals_of_the_function_are_raised_with_the_same_message():
    with pytest.raises(ConfigurationError) as refused:
        run("refuse")
    assert str(refused.value) == str(
        ConfigurationError("size of a.stl", got="9 bytes", allowed="8 bytes", fix="Use a smaller one.")
    )
    with pytest.raises(MissingDependencyError, match=r"The package x is missing\. Install it\."):
        run("lack_package")


def stream(name, argument, limits=SMALL):
    return list(stream_bounded(f"{PARSERS}:{name}", argument, limits))


def test_a_stream_has_its_results_and_then_its_failure():
    assert stream("repeat", b"50") == [b"50" * 1000] * 50
    assert stream("repeat", b"0") == []
    assert stream("repeat", b"9999")[-1] == ProcessFailure("output", "contains more than 1 MB")
    assert stream("yield_then_compute", b"x") == [b"x", ProcessFailure("time", "took longer than 1 s")]
    assert stream("nest", b"") == [ProcessFailure("nesting", "is nested too deeply")]
    assert stream("kill_itself", b"")[-1].kind == "signal"
    with pytest.raises(ConfigurationError, match="record 2"):
        stream("yield_then_refuse", b"x")


def test_the_time_of_the_caller_is_not_counted():
    results = stream_bounded(f"{PARSERS}:repeat", b"400", ProcessLimits(seconds=1.0))
    next(results)
    time.sleep(1.5)
    assert all(isinstance(one, bytes) for one in results)


def test_the_process_gets_no_open_file_and_no_secret(tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET_KEY", "k")
    secret = tmp_path / "secret"
    secret.write_text("x")
    with secret.open() as file:
        os.set_inheritable(file.fileno(), True)
        assert b"secret" not in run("open_files")
    assert b"SECRET_KEY" not in run("environment").split()


def test_the_process_cannot_write_files_and_its_prints_are_not_its_result(tmp_path):
    assert run("write_file", os.fsencode(tmp_path / "x")).kind == "exception"
    assert run("print_much") == b"result"


def test_no_process_remains():
    number = int(run("process_id"))
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)


def test_the_process_ends_with_the_process_that_started_it(tmp_path):
    channel = tmp_path / "channel"
    os.mkfifo(channel)
    parent = os.fork()
    if parent == 0:
        run("announce_and_sleep", os.fsencode(channel), ProcessLimits(seconds=60.0))
        os._exit(0)
    with channel.open("rb") as announced:
        child = int(announced.read())
    os.kill(parent, 9)
    os.waitpid(parent, 0)
    deadline = time.monotonic() + 10.0
    while process_state(child):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_calls_share_the_imports_but_no_process():
    own, starters = zip(*(run("process_ids").split() for _ in range(3)), strict=True)
    assert len(set(own)) == 3
    assert len(set(starters)) == 1


def test_interleaved_streams_have_their_own_results():
    first, second = (stream_bounded(f"{PARSERS}:repeat", argument, SMALL) for argument in (b"3", b"4"))
    assert [next(first), next(second), *first, *second] == [
        b"3" * 1000,
        b"4" * 1000,
        *[b"3" * 1000] * 2,
        *[b"4" * 1000] * 3,
    ]


def test_a_prepared_process_that_has_ended_is_replaced():
    starter = int(run("process_ids").split()[1])
    os.kill(starter, 9)
    os.waitpid(starter, 0)
    assert int(run("process_ids").split()[1]) != starter


def test_a_call_whose_prepared_process_is_killed_is_a_failure():
    assert run("kill_its_starter").kind in ("start", "signal")
    assert run("echo", b"x") == b"x"


def test_another_environment_has_another_prepared_process(monkeypatch):
    starter = run("process_ids").split()[1]
    monkeypatch.setenv("TMPDIR", "/")
    assert run("process_ids").split()[1] != starter


def test_a_fork_of_the_caller_has_prepared_processes_of_its_own():
    starter = run("process_ids").split()[1]
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(writer, run("process_ids").split()[1])
        os._exit(0)
    os.waitpid(child, 0)
    assert os.read(reader, 20) != starter
    assert run("process_ids").split()[1] == starter
    os.close(reader)
    os.close(writer)


def test_an_idle_prepared_process_ends_and_loses_no_call(monkeypatch):
    from dualbrain.core.untrusted import bounded_process_child as child  # noqa: PLC0415

    own, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    monkeypatch.setattr(child, "IDLE_SECONDS", 0.05)
    with own, other, open(os.devnull, "rb") as file:
        assert child._next_call(other) is None
        with pytest.raises(OSError, match="Broken pipe"):
            socket.send_fds(own, [b"call"], [file.fileno(), file.fileno()])
