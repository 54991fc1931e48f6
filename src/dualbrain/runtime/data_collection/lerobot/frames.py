"""Frames of an episode: the ticks of a recording, sub-sampled to the frame rate of a dataset.

Frame k is at t_0 + k / fps. Its tick is the one nearest to that time, the earlier of two. Its interval is every tick
from its own up to that of the next frame, for the last frame up to the end: every tick from the first on belongs to
exactly one frame. State, control and u_nom are those of the tick; δ is the maximum over the interval, h_min the
minimum, the status the most severe. A frame is an intervention if δ exceeds the dead band in its interval.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dualbrain.control.recording.channels import damaged_recording
from dualbrain.control.recording.trace import DEAD_BAND, FULL_INTERVENTION, Trace
from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.result import FilterStatus

Array = NDArray[np.float64]
ActionKind = Literal["velocity", "position"]

MAX_DISTANCE = 10.0
"""Largest barrier value of the kernel [m], `DBK_MAX_DISTANCE`; a frame in which none was computed has its negative."""
LARGEST_GAP = 1.5
"""Largest time between two ticks, in units of the frame period: a longer one leaves frames without a tick."""
FINITE_COLUMNS = ("t", "q", "v", "u_nom", "u", "status")


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """The frames of one episode, K of them.

    `q` (K, nq) [rad], `action` (K, n) [rad/s, for positions rad], `u_nom` (K, n) [rad/s], `delta` (K,), `h_min` (K,)
    [m] and `opening` (K,) [m, NaN where unknown] in single precision; `status` (K,) as values of `FilterStatus`, and
    `intervention` (K,).
    """

    q: NDArray[np.float32]
    action: NDArray[np.float32]
    u_nom: NDArray[np.float32]
    delta: NDArray[np.float32]
    h_min: NDArray[np.float32]
    status: NDArray[np.int64]
    intervention: NDArray[np.bool_]
    opening: NDArray[np.float32]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.q)


def sample_frames(trace: Trace, fps: int, *, action: ActionKind, period: float, path: Path) -> Frames:
    """The frames of the recorded ticks `trace`, at `fps` frames per second; `period` [s] is that of the robot.

    With the action "velocity" the action is the executed control u of the tick. With "position" it is
    q + Σ u Δt over the interval: where the executed control takes the joints until the next frame.

    Raises `ConfigurationError` if the recording at `path` has a value that is not finite, times that do not increase,
    or a gap of more than a frame, or if `fps` is higher than the rate of the ticks.
    """
    t = trace["t"]
    _require_sound(trace, t, fps, path)
    chosen = nearest_ticks(t, fps)
    delta = np.nan_to_num(trace["delta"], nan=FULL_INTERVENTION, posinf=FULL_INTERVENTION)
    h = np.nan_to_num(trace["h_min"], nan=-MAX_DISTANCE, posinf=MAX_DISTANCE, neginf=-MAX_DISTANCE)
    largest = np.maximum.reduceat(delta, chosen)
    q, u = _matrix(trace["q"]), _matrix(trace["u"])
    if action == "position":
        steps = np.append(np.diff(t), period)[:, None]
        executed = q[chosen] + np.add.reduceat(u * steps, chosen)
    else:
        executed = u[chosen]
    return Frames(
        q=q[chosen].astype(np.float32),
        action=executed.astype(np.float32),
        u_nom=_matrix(trace["u_nom"])[chosen].astype(np.float32),
        delta=largest.astype(np.float32),
        h_min=np.minimum.reduceat(h, chosen).astype(np.float32),
        status=np.maximum.reduceat(trace["status"], chosen).astype(np.int64),
        intervention=largest > DEAD_BAND,
        opening=trace["opening"][chosen].astype(np.float32),
    )


def nearest_ticks(t: Array, fps: int) -> NDArray[np.int64]:
    """Indices (K,) of the ticks nearest to the frame times t_0 + k / fps up to the last of the times `t` (ticks,).

    Of two equally near ticks, within a nanosecond, the earlier one is taken.
    """
    elapsed = t - t[0]
    count = int(np.floor(elapsed[-1] * fps + 1e-6)) + 1
    times = np.arange(count) / fps
    after = np.clip(np.searchsorted(elapsed, times), 1, max(1, len(t) - 1))
    if len(t) == 1:
        return np.zeros(1, np.int64)
    before = after - 1
    is_later = elapsed[after] - times < times - elapsed[before] - 1e-9
    return np.where(is_later, after, before).astype(np.int64)


def _require_sound(trace: Trace, t: Array, fps: int, path: Path) -> None:
    for name in FINITE_COLUMNS:
        bad = ~np.isfinite(_matrix(trace[name])).all(axis=1)
        if bad.any():
            first = int(np.argmax(bad))
            sentence = f"The recording {path} has a value of {name} that is not finite, at tick {first}."
            raise ConfigurationError.stating(sentence, fix="Leave this run out.")
    status = trace["status"]
    if not np.isin(status, [float(code) for code in FilterStatus]).all():
        raise damaged_recording(path, f"a status that is not 0 to {max(FilterStatus):d}")
    steps = np.diff(t)
    if not len(steps):
        return
    if steps.min() <= 0.0:
        raise damaged_recording(path, f"the time does not increase after tick {int(np.argmin(steps > 0.0))}")
    if fps * float(np.median(steps)) > 1.0 + 1e-6:
        rate = f"1 to {int(1.0 / float(np.median(steps)) + 1e-6)}, the rate of the ticks in {path}"
        raise ConfigurationError("--fps", got=fps, allowed=rate)
    if fps * float(steps.max()) > LARGEST_GAP:
        first = int(np.argmax(steps))
        sentence = f"The recording {path} has a gap from {t[first]:.3f} s to {t[first + 1]:.3f} s."
        raise ConfigurationError.stating(sentence, fix="Leave this run out, or choose a lower --fps.")


def _matrix(values: Array) -> Array:
    """A column of the trace as (ticks, k), also where k is 1."""
    return values if values.ndim == 2 else values[:, None]
