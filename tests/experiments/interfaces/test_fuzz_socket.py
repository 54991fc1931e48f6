"""Fuzzing: frames reach every stage, each is counted, and exceptions are counted or end the unit."""

from collections import Counter

import pytest

from dualbrain.contracts.gate.gate import Gate
from experiments.engine.experiment import Options
from experiments.interfaces import fuzz_socket
from experiments.interfaces.fuzz_socket import GATE_RAISED, N_FRAMES, FuzzSocket
from experiments.interfaces.fuzzer import Fuzzer


@pytest.fixture(scope="module")
def found():
    return FuzzSocket().run({"seed": 3, "frames": 4000})


def test_units_hold_ten_million_frames_and_seeds_are_reproducible(tmp_path):
    units = FuzzSocket().units(Options(tmp_path, "some-planner"))
    assert sum(unit.parameters.get("frames", 0) for unit in units) == N_FRAMES == 10_000_000
    one, same, other = Fuzzer(1), Fuzzer(1), Fuzzer(2)
    frames = [one.frame(one.message(), k) for k in range(50)]
    assert frames == [same.frame(same.message(), k) for k in range(50)]
    assert frames != [other.frame(other.message(), k) for k in range(50)]


def test_frames_and_contracts_reach_every_stage_and_all_are_counted(found):
    counts = found["counts"]
    assert sum(counts.values()) == found["frames"]
    stages = {f"contracts refused: {stage}" for stage in ("syntax", "authorization", "envelope")}
    expected = {*stages, "contracts accepted", "messages", "messages refused", "seals refused", "streams broken"}
    assert expected <= set(counts)
    assert GATE_RAISED not in counts
    assert "Exceptions: **0**" in "\n".join(FuzzSocket().report([found]))


def test_a_gate_that_raises_is_counted(monkeypatch):
    def broken(self, *args, **options):
        raise KeyError("missing")

    monkeypatch.setattr(Gate, "check", broken)
    counts = Counter(FuzzSocket().run({"seed": 3, "frames": 200})["counts"])
    assert counts[GATE_RAISED] > 10
    assert not [kind for kind in counts if kind.startswith("contracts")]


def test_an_exception_of_the_decoder_ends_the_unit(monkeypatch):
    def broken(frame, *, from_client):
        raise UnicodeDecodeError("utf-8", b"", 0, 1, "bad")

    monkeypatch.setattr(fuzz_socket, "decode_message", broken)
    with pytest.raises(UnicodeDecodeError):
        FuzzSocket().run({"seed": 3, "frames": 200})


@pytest.mark.slow
def test_the_socket_of_a_running_gatekeeper():
    row = FuzzSocket().run({"door": 1, "seconds": 12.0})
    assert row["said"]["frames"] > 100
    assert row["said"]["not hung up"] == 0
    assert row["said"]["refused"] > 10
    assert {kind.partition(":")[0] for kind in row["verdicts"]} >= {"refused"}
    assert row["rss_kib"][1] < 1.5 * row["rss_kib"][0]
    assert row["calm"]["ticks"] > 5000
    assert "| with fuzzing |" in "\n".join(FuzzSocket().report([row]))
