"""The recording pauses while no commander is connected, continues when one connects, and its replay stays exact."""

import numpy as np
import pytest

from dualbrain.control.recording.channels import read_recording, read_trace
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.recording_pause import UNATTENDED_TIME, RecordingPause
from dualbrain.control.recording.replay import replay
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.evaluation.fault_injection.faults import Fault, FaultInjector
from dualbrain.evaluation.fault_injection.faulty_client import FaultyCommander
from dualbrain.robots.loader import load_robot
from experiments.gatekeeper.commander_messages import PICK_AND_PLACE, contract_bytes
from tests.control.gatekeeper.lockstep_cell import make_cell

PAUSE_AFTER = 0.4
IDLE_TIME = 1.2
"""Robot time [s] before a commander connects with a contract; it disconnects after the outcome."""
CONTRACTS = (PICK_AND_PLACE[:1], (("hold", {"duration": 0.5}),))


def test_the_recording_pauses_a_minute_after_the_last_activity():
    pause = RecordingPause()
    assert UNATTENDED_TIME == 60.0
    assert [pause.update(t, active=False) for t in (5.0, 64.9, 65.0)] == [False, False, True]
    assert not pause.update(66.0, active=True)
    assert [pause.update(t, active=False) for t in (67.0, 125.9, 126.0)] == [False, False, True]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Recording, trace of all ticks in memory, and outcomes of a gatekeeper with pauses before two contracts."""
    folder, robot_model = tmp_path_factory.mktemp("pause"), load_robot("panda")
    trace, outcomes = Trace(robot_model.n, robot_model.nq), []
    path, rows, commanders, idle_since = folder / "ticks.mcap", [], [], [0.0]
    no_fault = FaultInjector(Fault("state", "off", "closing"), lambda: 0.0)

    def on_period(now):
        if len(trace):
            rows.append(trace._block[trace._used - 1].copy())
        if len(outcomes) < len(commanders):
            commanders[-1].step(now)
            idle_since[0] = now
        elif commanders:
            commanders[-1].close()
        if len(outcomes) == len(commanders) and now > idle_since[0] + IDLE_TIME:
            if len(outcomes) == len(CONTRACTS):
                cell.gatekeeper.shut_down()
                return
            text = contract_bytes(*CONTRACTS[len(outcomes)])
            commanders.append(FaultyCommander(cell.socket, cell.keys, "planner", no_fault, text, text))

    with Recorder(path, trace, when_full="wait") as recorder:
        recorder.episode(0.0, {"robot": "panda", "guard": True})
        cell = make_cell(
            folder,
            "forearm:1",
            on_period=on_period,
            robot_time=True,
            recorder=recorder,
            trace=trace,
            on_outcome=outcomes.append,
        )
        cell.gatekeeper._recording_pause = RecordingPause(PAUSE_AFTER)
        cell.gatekeeper.run()
    cell.server.close()
    return path, np.array(rows), outcomes


def test_a_replay_is_exact_across_pauses(recorded):
    path, rows, outcomes = recorded
    assert len(outcomes) == len(CONTRACTS)
    result = replay(path)
    assert result.identical
    assert result.complete
    assert 1000 < result.ticks < len(rows) - 800


def test_contracts_are_recorded_whole_and_pauses_are_marked(recorded):
    path, rows, _ = recorded
    trace = read_trace(path)
    stamps = trace["stamp"]
    gaps = np.flatnonzero(np.diff(stamps) > 0.5)
    events = [one for one in read_recording(path) if isinstance(one, Event) and one.kind == "recorder"]
    assert [("pauses" in one.text, "continues" in one.text) for one in events[:4]] == [(True, False), (False, True)] * 2
    assert len(gaps) == len(CONTRACTS)
    where = rows[:, trace.columns["action"].start] >= 0
    recorded_where = trace["action"] >= 0
    assert np.array_equal(trace.rows[recorded_where], rows[where], equal_nan=True)
