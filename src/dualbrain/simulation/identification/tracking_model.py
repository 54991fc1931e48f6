"""How well a plant follows a joint velocity: the body's tracking model, identified from excitation.

The filter's rows are evaluated at y = q + lag v. With the residual r = ẏ − u a barrier obeys ḣ ≥ −α h + n'J r, so

    h(t) ≥ h_model(t) − Σ_k |n'J_k| e_k(t),    e_k(t) = |∫ exp(−α (t − s)) r_k(s) ds|

(comparison lemma; the residual matters only through its leaky integral). A bound e of e_k therefore inflates a barrier
by e Σ_k |n'J_k|, which is what the row term `tracking` = α e [rad/s] does. e_k depends on the lag affinely, through
y = q + lag v, so that max_k,t e_k is convex in the lag and the best lag is found by ternary search.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import ceil

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
"""On the largest e of all seeds, or on their mean plus two standard deviations, whichever is more."""
MAX_LAG, MIN_DURATION = 0.05, 0.5
"""Largest lag that is searched, shortest run that is of use [s]."""


class TrackingModel(msgspec.Struct, frozen=True, kw_only=True):
    """An identified tracking model and where it comes from.

    `lag` [s]; `position_error` e [rad], the bound of the leaky integral over joints and time, with its safety factor;
    `rate` α [1/s] of the leak; `largest` e_k of each joint as measured [rad]; `by_seed` the largest e of each run;
    `velocity_error` the largest |r| as measured [rad/s].
    """

    lag: float
    position_error: float
    rate: float
    largest: tuple[float, ...]
    by_seed: tuple[float, ...]
    velocity_error: float
    provenance: str

    @property
    def tracking_error(self) -> float:
        """What the rows carry: α e [rad/s], `FilterConfig.tracking_error`."""
        return self.rate * self.position_error

    def to_error_model(self, drive: str, provenance: str) -> TrackingErrorModel:
        """What the body carries of it: lag to a microsecond, error rounded up to one of its own unit's millionths."""
        return TrackingErrorModel(
            lag=round(self.lag, 6),
            position_error=ceil(self.position_error * 1e6) / 1e6,
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
    """The tracking model of the simulated `body` with empty hand and with `load` [kg] at the tool: it covers both.

    Raises `InvalidSetup` for runs that are too short to say anything, no seeds, or a negative load.
    """
    if not seeds or seconds < MIN_DURATION or load < 0.0:
        raise ConfigurationError(
            "identification",
            got=f"{len(seeds)} seeds, {seconds:g} s, {load:g} kg",
            allowed=f"at least one seed, at least {MIN_DURATION:g} s, a load of zero or more",
        )
    spec = SceneSpec(robot=robot_model.name, family="identify", seed=0, objects=(), places=())

    def make(kg: float) -> Callable[[], IdentifiablePlant]:
        return lambda: SteppedPlant(Plant(spec, robot_model, drive=drive, load=kg), contacts=False)

    loads = (0.0, load) if load > 0.0 else (0.0,)
    said = f"{robot_model.name}, {drive} drive, loads {', '.join(f'{kg:g}' for kg in loads)} kg"
    return identify_tracking(
        [make(kg) for kg in loads], robot_model, seeds=seeds, seconds=seconds, source=said, progress=progress
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
    """One tracking model for all `plants`, each made afresh, at rest, for every run.

    Each seed runs every excitation for `seconds`: sums of sines, bang-bang and full speed down the nearest barrier row,
    all through the filter, so that velocity, acceleration and joint limits are those of operation. `lag` [s] fixes the
    lag instead of choosing it. `progress` is told the share done and a word.
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
    """The model that explains `logs`, grouped by seed: the lag with the least bound, and that bound."""
    if not logs or min(len(log.q) for runs in logs for log in runs) < 2:
        raise ConfigurationError("logs of a plant", got=len(logs), allowed="at least one, of at least two periods")
    parts = [[_affine_parts(log, rate, period) for log in runs] for runs in logs]
    every = [pair for runs in parts for pair in runs]
    best = _best_lag(every) if lag is None else lag
    largest = np.max([np.abs(a + best * b).max(axis=0) for a, b in every], axis=0)
    by_seed = [max(float(np.abs(a + best * b).max()) for a, b in runs) for runs in parts]
    spread = float(np.std(by_seed, ddof=1)) if len(by_seed) > 1 else 0.0
    error = SAFETY_FACTOR * max(*by_seed, float(np.mean(by_seed)) + 2.0 * spread)
    fastest = max(float(np.abs(_residual(log, best, period)).max()) for runs in logs for log in runs)
    words = f"{source}; largest leaky integral at {rate:.2f}/s of one lag, times {SAFETY_FACTOR:g}"
    return TrackingModel(
        lag=best,
        position_error=error,
        rate=rate,
        largest=tuple(largest.tolist()),
        by_seed=tuple(by_seed),
        velocity_error=fastest,
        provenance=words,
    )


def leaky_error(log: ExcitationLog, lag: float, rate: float, period: float) -> Array:
    """∫ exp(−α (t − s)) r(s) ds at the end of each period (t − 1, n) [rad], signed, for the residual of this lag."""
    a, b = _affine_parts(log, rate, period)
    return a + lag * b


def _residual(log: ExcitationLog, lag: float, period: float) -> Array:
    """The residual r (t − 1, n) [rad/s]: what y moved in a period beyond u."""
    return np.diff(log.q + lag * log.v, axis=0) / period - log.u[:-1]


def _affine_parts(log: ExcitationLog, rate: float, period: float) -> tuple[Array, Array]:
    """A and B (t − 1, n) with leaky integral A + lag B."""
    fade = float(np.exp(-rate * period))
    return _leaky_sum(np.diff(log.q, axis=0) - period * log.u[:-1], fade), _leaky_sum(np.diff(log.v, axis=0), fade)


def _leaky_sum(steps: Array, fade: float) -> Array:
    out, total = np.empty_like(steps), np.zeros(steps.shape[1])
    for t, step in enumerate(steps):
        total = fade * total + step
        out[t] = total
    return out


def _best_lag(parts: Iterable[tuple[Array, Array]]) -> float:
    """The minimiser of a convex function, to a microsecond."""
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
