"""How well a plant follows a joint velocity: the body's tracking model, identified from excitation.

The filter's rows are evaluated at y = q + lag v. With the residual r = ẏ − u a barrier obeys ḣ ≥ −α h + n'J r, so

    h(t) ≥ h_model(t) − Σ_k |n'J_k| e_k(t),    e_k(t) = |∫ exp(−α (t − s)) r_k(s) ds|

(comparison lemma; the residual matters only through its leaky integral). A bound e of e_k therefore inflates a barrier
by e Σ_k |n'J_k|, which is what the row term `tracking` = α e [rad/s] does. e_k depends on the lag affinely, through
y = q + lag v, so that max_k,t e_k is convex in the lag and the best lag is found by ternary search.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.embodiment.body import Body
from dualbrain.errors import InvalidSetup
from dualbrain.records import HalfSpace, Pose
from dualbrain.safety.filter import FilterConfig, Obstacle, SafetyFilter

Array = NDArray[np.float64]
Progress = Callable[[float, str], None]

SAFETY_FACTOR = 1.25
"""On the largest e of all seeds, or on their mean plus two standard deviations, whichever is more."""
LONGEST_LAG = 0.05
EXCITATIONS = ("sines", "bang_bang", "rows")


class Drivable(Protocol):
    """What can be identified: `sense()` refreshes `q` and `v` (n,), `act(u)` drives for one control period."""

    q: Array
    v: Array

    def sense(self) -> None:
        """Measure."""
        ...

    def act(self, u: Array) -> None:
        """Drive at u (n,) [rad/s]."""
        ...


class Log(msgspec.Struct, frozen=True, eq=False):
    """Joint positions and velocities before each control period and the control sent in it, each (t, n)."""

    q: Array
    v: Array
    u: Array


class TrackingModel(msgspec.Struct, frozen=True):
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
    def tracking(self) -> float:
        """What the rows carry: α e [rad/s], `FilterConfig.tracking_error`."""
        return self.rate * self.position_error


def identify(
    make: Callable[[], Drivable],
    body: Body,
    *,
    seeds: Sequence[int] = (0, 1, 2, 3),
    seconds: float = 10.0,
    lag: float | None = None,
    said: str = "plant",
    progress: Progress | None = None,
) -> TrackingModel:
    """The tracking model of the plant that `make` makes afresh, at rest, for every run.

    Each seed runs every excitation for `seconds`: sums of sines, bang-bang and full speed down the nearest barrier row,
    all through the filter, so that velocity, acceleration and joint limits are those of operation. `lag` [s] fixes the
    lag instead of choosing it. `progress` is told the share done and a word.
    """
    logs: list[list[Log]] = []
    total = len(seeds) * len(EXCITATIONS)
    for seed in seeds:
        runs: list[Log] = []
        for kind in EXCITATIONS:
            if progress is not None:
                progress((len(logs) * len(EXCITATIONS) + len(runs)) / total, f"seed {seed}, {kind}")
            runs.append(excite(make(), body, kind, round(seconds / body.period), np.random.default_rng(seed)))
        logs.append(runs)
    said = f"{said}: {len(seeds)} seeds x {', '.join(EXCITATIONS)} x {seconds:g} s at full speed"
    return fit(logs, body.alpha, body.period, lag=lag, said=said)


def fit(
    logs: Sequence[Sequence[Log]], rate: float, period: float, *, lag: float | None = None, said: str = ""
) -> TrackingModel:
    """The model that explains `logs`, grouped by seed: the lag with the least bound, and that bound."""
    if not logs or min(len(log.q) for runs in logs for log in runs) < 2:
        raise InvalidSetup("logs of a plant", got=len(logs), allowed="at least one, of at least two periods")
    parts = [[_affine(log, rate, period) for log in runs] for runs in logs]
    every = [pair for runs in parts for pair in runs]
    best = _best_lag(every) if lag is None else lag
    largest = np.max([np.abs(a + best * b).max(axis=0) for a, b in every], axis=0)
    by_seed = [max(float(np.abs(a + best * b).max()) for a, b in runs) for runs in parts]
    spread = float(np.std(by_seed, ddof=1)) if len(by_seed) > 1 else 0.0
    error = SAFETY_FACTOR * max(*by_seed, float(np.mean(by_seed)) + 2.0 * spread)
    fastest = max(float(np.abs(_residual(log, best, period)).max()) for runs in logs for log in runs)
    words = f"{said}; largest leaky integral at {rate:.2f}/s of one lag, times {SAFETY_FACTOR:g}"
    return TrackingModel(best, error, rate, tuple(largest.tolist()), tuple(by_seed), fastest, words)


def leaky_error(log: Log, lag: float, rate: float, period: float) -> Array:
    """∫ exp(−α (t − s)) r(s) ds at the end of each period (t − 1, n) [rad], signed, for the residual of this lag."""
    a, b = _affine(log, rate, period)
    return a + lag * b


def excite(plant: Drivable, body: Body, kind: str, steps: int, rng: np.random.Generator) -> Log:
    """Drive `plant` for `steps` periods by one kind of excitation, through the filter; what it did."""
    safety = SafetyFilter(body, FilterConfig())
    safety.observe([Obstacle("floor", HalfSpace(), Pose((0.0, 0.0, 0.0)))], 0.0)
    wish = _WISHES[kind](body, rng)
    q, v, u = (np.empty((steps, body.n)) for _ in range(3))
    for t in range(steps):
        plant.sense()
        q[t], v[t] = plant.q, plant.v
        u[t] = safety(q[t], v[t], wish(t, safety)).u
        plant.act(u[t])
    return Log(q, v, u)


def _residual(log: Log, lag: float, period: float) -> Array:
    """The residual r (t − 1, n) [rad/s]: what y moved in a period beyond u."""
    return np.diff(log.q + lag * log.v, axis=0) / period - log.u[:-1]


def _affine(log: Log, rate: float, period: float) -> tuple[Array, Array]:
    """A and B (t − 1, n) with leaky integral A + lag B."""
    fade = float(np.exp(-rate * period))
    return _leak(np.diff(log.q, axis=0) - period * log.u[:-1], fade), _leak(np.diff(log.v, axis=0), fade)


def _leak(steps: Array, fade: float) -> Array:
    out, total = np.empty_like(steps), np.zeros(steps.shape[1])
    for t, step in enumerate(steps):
        total = fade * total + step
        out[t] = total
    return out


def _best_lag(parts: Iterable[tuple[Array, Array]]) -> float:
    """The minimiser of a convex function, to a microsecond."""
    every = list(parts)
    low, high = 0.0, LONGEST_LAG
    while high - low > 1e-6:
        left, right = low + (high - low) / 3.0, high - (high - low) / 3.0
        if _worst(every, left) <= _worst(every, right):
            high = right
        else:
            low = left
    return 0.5 * (low + high)


def _worst(parts: Iterable[tuple[Array, Array]], lag: float) -> float:
    return max(float(np.abs(a + lag * b).max()) for a, b in parts)


# --- excitations: a wish (n,) for period t ------------------------------------------------------------------------

Wish = Callable[[int, SafetyFilter], Array]


def _sines(body: Body, rng: np.random.Generator) -> Wish:
    """Three sines a joint between 0.1 and 3 Hz, together at most the velocity limit."""
    v_max = np.array([joint.velocity.value for joint in body.joints])
    pace = 2.0 * np.pi * np.exp(rng.uniform(np.log(0.1), np.log(3.0), (3, body.n)))
    phase, share = rng.uniform(0.0, 2.0 * np.pi, (3, body.n)), rng.dirichlet(np.ones(3), body.n).T
    return lambda t, _: v_max * np.sum(share * np.sin(pace * (t * body.period) + phase), axis=0)


def _bang_bang(body: Body, rng: np.random.Generator) -> Wish:
    """Full speed of every joint either way, changed after 0.15 to 1 s."""
    return _held(body, rng, lambda _: None)


def _rows(body: Body, rng: np.random.Generator) -> Wish:
    """Full speed down the row with the smallest h."""
    return _held(body, rng, _nearest)


def _held(body: Body, rng: np.random.Generator, aim: Callable[[SafetyFilter], Array | None]) -> Wish:
    v_max = np.array([joint.velocity.value for joint in body.joints])
    until, now = 0, np.zeros(body.n)

    def wish(t: int, safety: SafetyFilter) -> Array:
        nonlocal until, now
        if t >= until:
            coins, row = np.where(rng.random(body.n) < 0.5, -1.0, 1.0), aim(safety)
            signs = coins if row is None or rng.random() < 0.1 else np.where(row > 0.0, -1.0, 1.0)
            until, now = t + int(rng.integers(150, 1000)), signs * v_max
        return now

    return wish


def _nearest(safety: SafetyFilter) -> Array | None:
    rows: list[Any] = safety._kernel.rows()  # pyright: ignore[reportPrivateUsage]
    return np.array(min(rows, key=lambda row: row[3])[6]) if rows else None


_WISHES: dict[str, Callable[[Body, np.random.Generator], Wish]] = {
    "sines": _sines,
    "bang_bang": _bang_bang,
    "rows": _rows,
}
