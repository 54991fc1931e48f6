"""Run folders with short recordings, written by the recorder itself."""

import numpy as np

from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import Trace
from dualbrain.records import Place, Scene
from dualbrain.robots.loader import load_builtin_robot

PERIOD = 1e-3
INSTRUCTION = "put the red cube in the bowl"


def sample_rows(robot="panda", ticks=200, seed=0, **changes):
    """Rows of a trace with random values, in the precision of the kernel; `changes` replace columns."""
    model = load_builtin_robot(robot)
    rng = np.random.default_rng(seed)
    trace = Trace(model.n, model.nq)
    rows = np.zeros((ticks, trace.columns["phase"].stop))
    columns = {
        "t": PERIOD * np.arange(ticks),
        "q": rng.uniform(-1.0, 1.0, (ticks, model.nq)),
        "v": rng.uniform(-1.0, 1.0, (ticks, model.n)),
        "u_nom": rng.uniform(-1.0, 1.0, (ticks, model.n)),
        "u": rng.uniform(-1.0, 1.0, (ticks, model.n)).astype(np.float32),
        "delta": rng.uniform(0.0, 1.0, ticks) * (rng.uniform(size=ticks) < 0.02),
        "h_min": rng.uniform(0.0, 0.3, ticks),
        "status": rng.integers(0, 5, ticks),
        "opening": rng.uniform(0.0, 0.04, ticks),
    }
    for name, values in (columns | changes).items():
        rows[:, trace.columns[name]] = np.asarray(values, float).reshape(ticks, -1)
    return rows


def sample_trace(rows, robot="panda"):
    """The trace of `rows`."""
    model = load_builtin_robot(robot)
    trace = Trace(model.n, model.nq)
    trace.extend(rows)
    return trace


def write_run(folder, rows, *, robot="panda", instruction=INSTRUCTION, about=None, places=("tray",)):
    """A run folder with the recording of `rows`; returns the folder."""
    folder.mkdir(parents=True)
    trace = sample_trace(rows, robot)
    with Recorder(folder / "episode.mcap", trace, when_full="wait") as recorder:
        recorder.episode(0.0, {"robot": robot, "guard": True, "instruction": instruction} | (about or {}))
        marked = tuple(Place(name, (0.4, 0.0, 0.0)) for name in places)
        recorder.scene(Scene(robot=robot, stamp=0.0, version=1, objects=(), places=marked))
        for row in trace.rows:
            recorder.tick(row)
    (folder / "episode.json").write_text('{"id": "a", "outcome": {"kind": "succeeded", "reason": ""}}')
    return folder
