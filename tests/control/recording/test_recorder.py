"""The recorder: order, exactness, no blocking, and the readable part of a recording after a kill."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from threading import Event as Signal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.contracts.verdict import Rejected
from dualbrain.control.recording import recorder as recorder_module
from dualbrain.control.recording.channels import (
    AttemptMade,
    EpisodeInfo,
    FilterCall,
    SceneSeen,
    Ticks,
    decode,
    encode,
    read_recording,
    read_trace,
    recording_state,
)
from dualbrain.control.recording.recorder import BATCH_TICKS, Recorder
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.core.geometry.shapes import HalfSpace, Pose
from dualbrain.errors import ConfigurationError
from dualbrain.records import Attempt, Proposal, Scene, SceneObject
from tests.control.recording.sample_ticks import append_ticks

SCENE = Scene(
    robot="panda",
    stamp=0.5,
    version=1,
    objects=(SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0))),),
)
ATTEMPT = Attempt(
    Proposal(text="{}", finish_reason="stop", planner="test", constrained_by="none", timings={"total": 0.1}),
    Rejected(stage="syntax", pointer="/id", got=None, allowed="string", hint="give an id"),
    1e-5,
)


@given(st.lists(st.floats(width=64), min_size=1, max_size=8), st.floats(width=32))
def test_every_float_round_trips(values: list[float], u: float) -> None:
    call = FilterCall(0.0, "attach", {"spheres": np.array([values]), "error": np.float32(u)})
    back = decode("/filter_call", encode(call))
    assert isinstance(back, FilterCall)
    assert np.array_equal(np.array(back.arguments["spheres"]), np.array([values]), equal_nan=True)
    assert np.array_equal(np.float32(back.arguments["error"]), np.float32(u), equal_nan=True)


def test_ticks_without_nan_are_encoded_without_a_null() -> None:
    """A null would start the search for NaN, which takes five times as long and holds the interpreter."""
    trace = Trace(7)
    rows = np.nan_to_num(np.stack(append_ticks(trace, 3)))
    table = {name: rows[:, where].tolist() for name, where in trace.columns.items()}
    ticks = Ticks(t=0.0, n=7, phases=("x",), columns=table, width=trace.width)
    assert b"null" not in encode(ticks)
    assert decode("/tick", encode(ticks)) == ticks


def test_messages_come_back_typed_and_in_order(tmp_path: Path) -> None:
    trace = Trace(7)
    path = tmp_path / "episode.mcap"
    with Recorder(path, trace) as recorder:
        recorder.episode(0.0, {"instruction": "put the red cube in the bowl", "seed": 3})
        recorder.attempt(0.0, ATTEMPT)
        recorder.scene(SCENE)
        recorder.call(0.0, "observe", obstacles=SCENE.objects, stamp=0.0)
        for row in append_ticks(trace, BATCH_TICKS + 7):
            recorder.tick(row)
        recorder.call(0.06, "detach")
        for row in append_ticks(trace, 3, start=0.06):
            recorder.tick(row)
        event = trace.note(0.063, "takeover", "no progress", seconds=1.5)
        recorder.event(event)
    kinds = [type(message) for message in read_recording(path)]
    assert kinds == [EpisodeInfo, AttemptMade, SceneSeen, FilterCall, Ticks, Ticks, FilterCall, Ticks, Event]
    messages = list(read_recording(path))
    assert messages[1] == AttemptMade(0.0, ATTEMPT)
    assert messages[2] == SceneSeen(0.5, SCENE)
    assert messages[-1] == event
    assert recording_state(path).complete


def test_rows_come_back_bit_for_bit(tmp_path: Path) -> None:
    trace = Trace(7)
    with Recorder(tmp_path / "a.mcap", trace) as recorder:
        for row in append_ticks(trace, 230, special_values=True):
            recorder.tick(row)
    back = read_trace(tmp_path / "a.mcap")
    assert back is not None
    assert np.array_equal(back.rows, trace.rows, equal_nan=True)
    numbers = ~np.isnan(trace.rows)
    assert np.array_equal(np.signbit(back.rows[numbers]), np.signbit(trace.rows[numbers]))
    assert back.phases == trace.phases
    assert math.isinf(back["h_min"][1])


def test_arguments_are_copied_when_the_call_is_recorded(tmp_path: Path) -> None:
    spheres = np.ones((1, 4))
    with Recorder(tmp_path / "a.mcap", Trace(7)) as recorder:
        recorder.call(0.0, "attach", spheres=spheres, error=0.001)
        spheres[:] = 5.0
    (call,) = read_recording(tmp_path / "a.mcap")
    assert isinstance(call, FilterCall)
    assert call.arguments == {"spheres": [[1.0] * 4], "error": 0.001}


class _SlowDisk:
    """Blocks the writer's thread until `release` is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.release = Signal()
        monkeypatch.setattr(recorder_module, "encode", lambda message: self.release.wait(10) and encode(message))


@pytest.mark.realtime
def test_a_slow_disk_never_blocks_and_the_gap_is_marked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = _SlowDisk(monkeypatch)
    recorder = Recorder(tmp_path / "a.mcap", Trace(7), capacity=4)
    started = time.perf_counter()
    for k in range(20):
        recorder.call(k * 0.01, "reset")
    assert time.perf_counter() - started < 1.0
    disk.release.set()
    while not recorder._queue.empty():
        time.sleep(0.001)
    recorder.call(1.0, "reset")
    state = recorder.close()
    assert not state.complete
    assert state.dropped == recorder.dropped >= 14
    assert recording_state(tmp_path / "a.mcap") == state
    *_, mark, last = read_recording(tmp_path / "a.mcap")
    assert isinstance(mark, Event)
    assert mark.data == {"lost": state.dropped}
    assert last == FilterCall(1.0, "reset", {})


def test_a_lockstep_recorder_waits_and_loses_nothing(tmp_path: Path) -> None:
    trace = Trace(7)
    with Recorder(tmp_path / "a.mcap", trace, capacity=1, when_full="wait") as recorder:
        for row in append_ticks(trace, 500):
            recorder.tick(row)
    back = read_trace(tmp_path / "a.mcap")
    assert back is not None
    assert len(back) == 500
    assert recorder.close().complete


def test_a_full_disk_is_reported_and_does_not_raise(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def raise_disk_full(_: object) -> bytes:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(recorder_module, "encode", raise_disk_full)
    with Recorder(tmp_path / "a.mcap", Trace(7)) as recorder:
        recorder.call(0.0, "reset")
        recorder.call(0.1, "reset")
    assert "No space left" in recorder.close().problem
    assert not recording_state(tmp_path / "a.mcap").complete


def test_an_exception_still_closes_the_file(tmp_path: Path) -> None:
    trace = Trace(7)

    def run() -> None:
        with Recorder(tmp_path / "a.mcap", trace) as recorder:
            for row in append_ticks(trace, 3):
                recorder.tick(row)
            raise RuntimeError("plant")

    with pytest.raises(RuntimeError, match="plant"):
        run()
    back = read_trace(tmp_path / "a.mcap")
    assert back is not None
    assert len(back) == 3


WRITER = """
import sys, time
from pathlib import Path
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import Trace
from tests.control.recording.sample_ticks import append_ticks
trace = Trace(7)
recorder = Recorder(Path(sys.argv[1]), trace, when_full="wait")
for row in append_ticks(trace, 4000):
    recorder.tick(row)
while not recorder._queue.empty():
    time.sleep(0.01)
print("written", flush=True)
time.sleep(60)
"""


def test_a_killed_process_leaves_a_readable_file(tmp_path: Path) -> None:
    path, root = tmp_path / "a.mcap", Path(__file__).parents[3]
    import_path = os.pathsep.join((str(root), str(root / "src"), *sys.path))
    child = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": import_path}
    )
    with child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"written\n"
        child.send_signal(signal.SIGKILL)
    back = read_trace(path)
    assert back is not None
    assert len(back) >= 3400
    expected = Trace(7)
    append_ticks(expected, len(back))
    assert np.array_equal(back.rows, expected.rows)
    assert not recording_state(path).complete
    complete = path.read_bytes()
    for cut in (len(complete) - 1, len(complete) - 5000, len(complete) // 2, 60):
        path.write_bytes(complete[:cut])
        rest = read_trace(path)
        assert rest is None or np.array_equal(rest.rows, expected.rows[: len(rest)])


def test_another_kind_of_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"not a recording at all")
    with pytest.raises(ConfigurationError, match="is not an MCAP file"):
        list(read_recording(tmp_path / "a.mcap"))


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    trace = Trace(7)
    with Recorder(tmp_path / "a.mcap", trace) as recorder:
        for row in append_ticks(trace, 2000):
            recorder.tick(row)
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    at = data.find(b"zstd") + 4 + 8 + 4000
    data[at] ^= 0x55
    (tmp_path / "a.mcap").write_bytes(data)
    with pytest.raises(ConfigurationError, match="is damaged"):
        list(read_recording(tmp_path / "a.mcap"))
