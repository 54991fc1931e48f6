"""Recordings that are damaged or hostile: every one is a configuration error in one sentence, within bounds."""

import json
import os
import time

import msgspec
import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from dualbrain.cli.run.replay import replay as replay_command
from dualbrain.control.recording.channels import FORMAT, read_recording
from dualbrain.control.recording.replay import replay
from dualbrain.control.recording.trace import columns
from dualbrain.core.untrusted.bounded_process import ProcessLimits
from dualbrain.errors import ConfigurationError, DualbrainError, UnknownNameError
from dualbrain.robots.loader import load_builtin_robot

EPISODE = {"t": 0.0, "data": {"robot": "panda", "guard": True}}
PANDA = load_builtin_robot("panda")


def ticks(n=PANDA.n, count=3, **changes):
    widths = {name: place.stop - place.start for name, place in columns(n).items()}
    values = {name: np.zeros((count, width)).tolist() for name, width in widths.items()}
    message = {"t": 0.0, "n": n, "phases": [], "columns": values | changes.pop("columns", {})}
    return message | changes


def write(path, *messages, compression=CompressionType.ZSTD, metadata=None):
    """A recording of (topic, JSON or bytes)."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression)
        writer.start(FORMAT)
        schema = writer.register_schema("any", "jsonschema", b"{}")
        channels = {topic: writer.register_channel(topic, "json", schema) for topic in {one for one, _ in messages}}
        for topic, content in messages:
            data = content if isinstance(content, bytes) else msgspec.json.encode(content)
            writer.add_message(channels[topic], 0, data, 0)
        if metadata is not None:
            writer.add_metadata("dualbrain", metadata)
        writer.finish()
    return path


DAMAGED = {
    "junk": [("/episode", b"junk")],
    "not UTF-8": [("/episode", b'{"t":\xff}')],
    "deep": [("/episode", b'{"t":0,"data":' + b"[" * 50_000)],
    "deep and not finite": [("/episode", b'{"t":{"float":"nan"},"data":' + b"[" * 50_000)],
    "wrong type": [("/episode", [])],
    "without robot": [("/episode", {"t": 0.0, "data": {"guard": True}})],
    "without guard": [("/episode", {"t": 0.0, "data": {"robot": "panda"}})],
    "robot of another type": [("/episode", {"t": 0.0, "data": {"robot": {"a": 1}, "guard": True}})],
    "wrong body": [("/episode", {"t": 0.0, "data": {"body": 3, "guard": True}})],
    "wrong standing": [("/episode", {"t": 0.0, "data": {"robot": "panda", "guard": True, "standing": [1]}})],
    "no episode": [("/tick", ticks())],
    "empty": [],
    "huge width": [("/episode", EPISODE), ("/tick", ticks(width=10**9))],
    "integer beyond doubles": [
        ("/episode", EPISODE),
        ("/tick", json.dumps(ticks(columns={"t": [10**400] * 3})).encode()),
    ],
    "huge n": [("/episode", EPISODE), ("/tick", ticks() | {"n": 10**9})],
    "negative n": [("/episode", EPISODE), ("/tick", ticks() | {"n": -1})],
    "n of another robot": [("/episode", EPISODE), ("/tick", ticks(n=3))],
    "missing columns": [("/episode", EPISODE), ("/tick", ticks() | {"columns": {}})],
    "unequal columns": [("/episode", EPISODE), ("/tick", ticks(columns={"stamp": [0.0]}))],
    "wide column": [("/episode", EPISODE), ("/tick", ticks(columns={"stamp": [[0.0, 1.0]] * 3}))],
    "ragged column": [("/episode", EPISODE), ("/tick", ticks(columns={"q": [[0.0], [1.0, 2.0], 3.0]}))],
    "texts in a column": [("/episode", EPISODE), ("/tick", ticks(columns={"stamp": ["a", "b", "c"]}))],
    "infinite sequence": [("/episode", EPISODE), ("/tick", ticks(columns={"sequence": [{"float": "inf"}] * 3}))],
    "unknown call": [("/episode", EPISODE), ("/filter_call", {"t": 0.0, "name": "exec", "arguments": {}})],
    "call without arguments": [("/episode", EPISODE), ("/filter_call", {"t": 0.0, "name": "observe", "arguments": {}})],
    "wrong obstacles": [
        ("/episode", EPISODE),
        ("/filter_call", {"t": 0.0, "name": "observe", "arguments": {"obstacles": [3], "stamp": 0.0}}),
    ],
    "wrong spheres": [
        ("/episode", EPISODE),
        ("/filter_call", {"t": 0.0, "name": "attach", "arguments": {"spheres": "a", "error": []}}),
    ],
    "wrong rows": [("/episode", EPISODE), ("/filter_call", {"t": 0.0, "name": "constrain", "arguments": {"rows": 1}})],
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_recording_is_one_sentence(tmp_path, kind):
    path = write(tmp_path / "a.mcap", *DAMAGED[kind])
    with pytest.raises(DualbrainError) as refused:
        replay_command(path)
    assert isinstance(refused.value, ConfigurationError | UnknownNameError)
    assert len(str(refused.value)) < 600


@pytest.mark.parametrize("kind", ["wrong state", "no state"])
def test_wrong_metadata_is_one_sentence(tmp_path, kind):
    metadata = {"state": "[" * 5000} if kind == "wrong state" else {"other": ""}
    path = write(tmp_path / "a.mcap", ("/episode", EPISODE), ("/tick", ticks()), metadata=metadata)
    with pytest.raises(ConfigurationError, match="is damaged"):
        replay(path)


@pytest.mark.parametrize("name", ["../../../etc/passwd", "/etc/passwd", "./robot", "robot.json", "a/b", "", "x" * 5000])
def test_the_name_of_a_robot_never_opens_a_file(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    for file in ("robot.json", "robot/body.json"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_bytes(msgspec.json.encode(PANDA))
    path = write(tmp_path / "a.mcap", ("/episode", {"t": 0.0, "data": {"robot": name, "guard": True}}))
    with pytest.raises(UnknownNameError, match="packaged robot"):
        replay(path)


def test_a_recording_that_unpacks_to_too_much_is_refused_quickly(tmp_path):
    path = write(tmp_path / "a.mcap", ("/event", b" " * 300_000_000))
    assert path.stat().st_size < 100_000
    start = time.monotonic()
    with pytest.raises(ConfigurationError, match=r"contains more than|needs more than 64 MB"):
        list(read_recording(path, ProcessLimits(memory_bytes=64 << 20, output_bytes=1 << 20)))
    assert time.monotonic() - start < 15.0


@pytest.mark.parametrize("kind", ["fifo", "device", "folder", "missing", "text"])
def test_a_file_that_is_no_recording_is_refused_at_once(tmp_path, kind):
    path = tmp_path / "a.mcap"
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case "folder":
            path.mkdir()
        case "text":
            path.write_text("no recording")
        case _:
            pass
    with pytest.raises(ConfigurationError, match=r"a\.mcap"):
        replay_command(path)
    with pytest.raises(ConfigurationError, match=r"a\.mcap"):
        replay(path)


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.NONE])
def test_an_honest_recording_of_the_same_kind_is_replayed(tmp_path, compression):
    state = {"state": msgspec.json.encode({"complete": True, "dropped": 0, "problem": ""}).decode()}
    path = write(
        tmp_path / "a.mcap",
        ("/episode", EPISODE),
        ("/tick", ticks(columns={"touched": np.full((3, 1), 1.0).tolist()})),
        compression=compression,
        metadata=state,
    )
    result = replay(path)
    assert (result.ticks, result.complete) == (3, True)
