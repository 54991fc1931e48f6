"""Tracking model of a plant: how well it follows a joint velocity command, identified from excitation.

The filter's rows are evaluated at y = q + lag v. With the residual r = ẏ − u a barrier obeys ḣ ≥ −α h + n'J r, so

    h(t) ≥ h_model(t) − Σ_k |n'J_k| e_k(t),    e_k(t) = |∫ exp(−α (t − s)) r_k(s) ds|

(comparison lemma; only the leaky integral of the residual matters). Bounds e_k of all times therefore inflate a barrier
by Σ_k |n'J_k| e_k; the row terms `tracking` = α e_k [rad/s] implement it. e_k depends affinely on the lag, through
y = q + lag v, so that max_k,t e_k is convex in the lag and ternary search finds the best lag.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import ceil, inf

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel, TrackingErrorModel
from dualbrain.simulation.identification.excitation import EXCITATION_KINDS, ExcitationLog, IdentifiablePlant, excite
from dualbrain.simulation.plant.joint_drive import DriveKind
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.stepped_plant import SteppedPlant
from dualbrain.simulation.scenes.scene_spec import SceneSpec

Array = NDArray[np.float64]
ProgressCallback = Callable[[float, str], None]

SAFETY_FACTOR = 1.25
"""Factor on the largest e_k of all seeds, or on their mean plus two standard deviations if that is larger."""
MAX_LAG, MIN_DURATION = 0.05, 0.5
"""Upper end of the search for the lag, and shortest permitted run [s]."""


class TrackingModel(msgspec.Struct, frozen=True, kw_only=True):
    """An identified tracking model and its provenance.

    `lag` [s]; `position_errors` e_k [rad], the bound of the leaky integral of each joint over time, including the
    safety factor; `rate` α [1/s] of the leak; `largest` the measured maximum of e_k for each joint [rad]; `by_seed` the
    measured maximum over the joints for each seed [rad]; `velocity_error` the measured maximum of |r| [rad/s].
    """

    lag: float
    position_errors: tuple[float, ...]
    rate: float
    largest: tuple[float, ...]
    by_seed: tuple[float, ...]
    velocity_error: float
    provenance: str

    @property
    def position_error(self) -> float:
        """The largest bound e of all joints [rad]."""
        return max(self.position_errors)

    @property
    def tracking_error(self) -> tuple[float, ...]:
        """The row terms α e_k [rad/s], `FilterConfig.tracking_error`."""
        return tuple(self.rate * error for error in self.position_errors)

    def to_error_model(self, drive: str, provenance: str) -> TrackingErrorModel:
        """The entry of the robot model: lag rounded to 1 µs, errors rounded up to 1e-6 rad (or m)."""
        return TrackingErrorModel(
            lag=round(self.lag, 6),
            position_error=tuple(ceil(error * 1e6) / 1e6 for error in self.position_errors),
            rate=self.rate,
            provenance=provenance,
            drive=drive,
        )


def identify_plant(
    robot_model: RobotModel,
    drive: DriveKind = "computed_torque",
    *,
    load: float = 0.5,
    seeds: Sequence[int] = (0, 1, 2, 3),
    seconds: float = 10.0,
    progress: ProgressCallback | None = None,
) -> TrackingModel:
    """Identify the simulated robot with an empty hand and with `load` [kg] at the tool; the model covers both.

    `seconds` is the duration of each run; `progress` receives the finished share and a description. Raises
    `ConfigurationError` for runs that are too short, for an empty list of seeds, and for a negative load.
    """
    if not seeds or not MIN_DURATION <= seconds < inf or not 0.0 <= load < inf:
        raise ConfigurationError(
            "identification",
            got=f"{len(seeds)} seeds, {seconds:g} s, {load:g} kg",
            allowed=f"at least one seed, at least {MIN_DURATION:g} s, a load of 0 kg or more",
        )
    spec = SceneSpec(robot=robot_model.name, family="identify", seed=0, objects=(), places=())

    def make(kg: float) -> Callable[[], IdentifiablePlant]:
        return lambda: SteppedPlant(Plant(spec, robot_model, drive=drive, load=kg), contacts=False)

    loads = (0.0, load) if load > 0.0 else (0.0,)
    source = f"{robot_model.name}, {drive} drive, loads {', '.join(f'{kg:g}' for kg in loads)} kg"
    return identify_tracking(
        [make(kg) for kg in loads], robot_model, seeds=seeds, seconds=seconds, source=source, progress=progress
    )


def identify_tracking(
    plants: Sequence[Callable[[], IdentifiablePlant]],
    robot_model: RobotModel,
    *,
    seeds: Sequence[int] = (0, 1, 2, 3),
    seconds: float = 10.0,
    lag: float | None = None,
    source: str = "plant",
    progress: ProgressCallback | None = None,
) -> TrackingModel:
    """Identify one tracking model for all `plants`; each factory returns a new plant at rest for every run.

    Each seed runs every excitation for `seconds`: sums of sines, bang-bang and full speed towards the nearest barrier,
    all through the filter, so that velocity, acceleration and joint limits are those of operation. `lag` [s] fixes the
    lag instead of fitting it. `progress` receives the finished share and a description.
    """
    steps, each = round(seconds / robot_model.period), [(make, kind) for make in plants for kind in EXCITATION_KINDS]
    logs: list[list[ExcitationLog]] = []
    for seed in seeds:
        runs: list[ExcitationLog] = []
        for make, kind in each:
            if progress is not None:
                progress((len(logs) * len(each) + len(runs)) / (len(seeds) * len(each)), f"seed {seed}, {kind}")
            runs.append(excite(make(), robot_model, kind, steps, np.random.default_rng(seed)))
        logs.append(runs)
    source = f"{source}: {len(seeds)} seeds x {', '.join(EXCITATION_KINDS)} x {seconds:g} s at full speed"
    return fit_tracking_model(logs, robot_model.alpha, robot_model.period, lag=lag, source=source)


def fit_tracking_model(
    logs: Sequence[Sequence[ExcitationLog]], rate: float, period: float, *, lag: float | None = None, source: str = ""
) -> TrackingModel:
    """Fit the lag with the smallest error bound to `logs`, which are grouped by seed.

    Raises `ConfigurationError` if there is no log, or one with fewer than two control periods.
    """
    if not logs or min(len(log.q) for runs in logs for log in runs) < 2:
        raise ConfigurationError(
            "logs of a plant", got=len(logs), allowed="at least one, each with two periods or more"
        )
    parts = [[_affine_parts(log, rate, period) for log in runs] for runs in logs]
    every = [pair for runs in parts for pair in runs]
    best = _best_lag(every) if lag is None else lag
    by_seed = np.array([np.max([np.abs(a + best * b).max(axis=0) for a, b in runs], axis=0) for runs in parts])
    largest, spread = by_seed.max(axis=0), by_seed.std(axis=0, ddof=1) if len(by_seed) > 1 else 0.0
    errors = SAFETY_FACTOR * np.maximum(largest, by_seed.mean(axis=0) + 2.0 * spread)
    fastest = max(float(np.abs(_residual(log, best, period)).max()) for runs in logs for log in runs)
    provenance = f"{source}; largest leaky integral at {rate:.2f}/s of one lag, times {SAFETY_FACTOR:g}"
    return TrackingModel(
        lag=best,
        position_errors=tuple(errors.tolist()),
        rate=rate,
        largest=tuple(largest.tolist()),
        by_seed=tuple(by_seed.max(axis=1).tolist()),
        velocity_error=fastest,
        provenance=provenance,
    )


def leaky_error(log: ExcitationLog, lag: float, rate: float, period: float) -> Array:
    """∫ exp(−α (t − s)) r(s) ds at the end of each period, signed, shape (n_periods − 1, n) [rad], for this `lag`."""
    a, b = _affine_parts(log, rate, period)
    return a + lag * b


def _residual(log: ExcitationLog, lag: float, period: float) -> Array:
    """The residual r = ẏ − u, shape (n_periods − 1, n) [rad/s]."""
    return np.diff(log.q + lag * log.v, axis=0) / period - log.u[:-1]


def _affine_parts(log: ExcitationLog, rate: float, period: float) -> tuple[Array, Array]:
    """A and B, shape (n_periods − 1, n), such that the leaky integral is A + lag B."""
    fade = float(np.exp(-rate * period))
    return _leaky_sum(np.diff(log.q, axis=0) - period * log.u[:-1], fade), _leaky_sum(np.diff(log.v, axis=0), fade)


def _leaky_sum(steps: Array, fade: float) -> Array:
    out, total = np.empty_like(steps), np.zeros(steps.shape[1])
    for t, step in enumerate(steps):
        total = fade * total + step
        out[t] = total
    return out


def _best_lag(parts: Iterable[tuple[Array, Array]]) -> float:
    """The lag that minimises the largest error, to 1 µs, by ternary search."""
    every = list(parts)
    low, high = 0.0, MAX_LAG
    while high - low > 1e-6:
        left, right = low + (high - low) / 3.0, high - (high - low) / 3.0
        if _max_error(every, left) <= _max_error(every, right):
            high = right
        else:
            low = left
    return 0.5 * (low + high)


def _max_error(parts: Iterable[tuple[Array, Array]], lag: float) -> float:
    return max(float(np.abs(a + lag * b).max()) for a, b in parts)
