"""Replay: the same inputs give the same controls, bit for bit, and one changed bit is detected."""

import struct

import msgspec
import numpy as np
import pytest

from dualbrain.control.recording import replay as replay_module
from dualbrain.control.recording.channels import FilterCall, Ticks, read_recording
from dualbrain.control.recording.replay import replay
from dualbrain.errors import ConfigurationError
from tests.stories.story_session import contract_text, run_config, run_session
from tests.support.run_once import run_once


def _run_unfiltered(folder):
    move = {"target": "blue_bowl", "speed": 0.3, "clearance": 0.12, "route": "direct", "wait": "none"}
    story = run_session(
        run_config(folder, guard=False, scene="tabletop:1", instruction="look at the bowl"),
        contract_text(("move_to", move)),
    )
    return (story.episode.outcome.kind,)


@pytest.fixture(scope="module")
def recordings(completed_run, tmp_path_factory):
    folder, kind = run_once(tmp_path_factory, "unfiltered", _run_unfiltered)
    assert kind in ("succeeded", "failed", "taken_over")
    return {"on": completed_run[0] / "run" / "episode.mcap", "off": folder / "run" / "episode.mcap"}


@pytest.mark.parametrize("guard", ["on", "off"])
def test_a_recorded_run_is_recomputed_bit_for_bit(recordings, guard):
    result = replay(recordings[guard])
    assert result.identical
    assert result.complete
    assert result.ticks > 1000
    assert result.worst == {}


def flip_bit(value, bit):
    (bits,) = struct.unpack("<Q", struct.pack("<d", value))
    (other,) = struct.unpack("<d", struct.pack("<Q", bits ^ (1 << bit)))
    return other


def first_messages(path, ticks=2000):
    """The messages of the first `ticks` ticks."""
    messages, count = [], 0
    for message in read_recording(path):
        messages.append(message)
        count += len(message.columns["t"]) if isinstance(message, Ticks) else 0
        if count >= ticks:
            break
    return messages


def replay_messages(monkeypatch, path, messages):
    monkeypatch.setattr(replay_module, "read_recording", lambda _: iter(messages))
    return replay(path)


@pytest.mark.parametrize(("column", "bit"), [("u_nom", 29), ("u_nom", 51), ("q", 35)])
def test_one_flipped_bit_of_an_input_is_detected(recordings, monkeypatch, column, bit):
    """Bit 29 is the lowest that a float32 keeps of a float64."""
    messages = first_messages(recordings["on"])
    where, batch = next((i, m) for i, m in enumerate(messages) if isinstance(m, Ticks) and m.columns["t"][0] > 0.5)
    values = [list(value) if isinstance(value, list) else value for value in batch.columns[column]]
    elbow = values[7][3]  # it decides the nearest pair: the hand approaches the arm's own links
    values[7] = [*values[7][:3], flip_bit(elbow, bit), *values[7][4:]]
    messages[where] = msgspec.structs.replace(batch, columns={**batch.columns, column: values})
    result = replay_messages(monkeypatch, recordings["on"], messages)
    assert not result.identical
    before = sum(len(m.columns["t"]) for m in messages[:where] if isinstance(m, Ticks))
    assert result.first == before + 7
    assert result.worst


def test_a_changed_scene_is_detected(recordings, monkeypatch):
    messages = first_messages(recordings["on"])
    for index, message in enumerate(messages):
        if isinstance(message, FilterCall) and message.name == "observe":
            obstacles = msgspec.to_builtins(message.arguments["obstacles"])
            for obstacle in obstacles:
                obstacle["margin"] += 0.1
            messages[index] = FilterCall(message.t, "observe", {**message.arguments, "obstacles": obstacles})
    assert not replay_messages(monkeypatch, recordings["on"], messages).identical


def test_a_changed_byte_of_the_file_is_refused_or_detected(recordings, tmp_path):
    data = recordings["off"].read_bytes()
    path = tmp_path / "changed.mcap"
    refused = 0
    for place in np.random.default_rng(3).integers(8, len(data), 25):
        path.write_bytes(data[:place] + bytes([data[place] ^ 4]) + data[place + 1 :])
        try:
            messages = sum(1 for _ in read_recording(path))
            assert messages > 0
        except ConfigurationError as error:
            refused += 1
            assert str(path) in str(error)  # noqa: PT017
    assert refused > 15


def test_a_truncated_file_is_replayed_to_its_end(recordings, tmp_path):
    data = recordings["off"].read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: len(data) // 2])
    result = replay(path)
    assert result.identical
    assert not result.complete
