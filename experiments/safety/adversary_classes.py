"""The classes of the adversarial proof: what goes wrong, by how much, and the filter that is told so."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import msgspec

from dualbrain.robots.loader import load_body
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.obstacles import Obstacle

PERIOD, ALPHA = 1e-3, 7.5 / 2.175
PLACE_NOISE, SPEED_NOISE = 0.005, 0.02
"""Error norms of perceived things [m, m/s]."""
Q_NOISE, V_NOISE = 2e-4, 0.01
"""Error bounds of measured joints [rad, rad/s]."""
TRACKING = load_body("panda").tracking
LAG, POSITION_ERROR = TRACKING.lag, TRACKING.position_error
"""Lag [s] and leaky integral of the residual [rad] of the trials: those identified for the body's own drive."""
PUSH = ALPHA * POSITION_ERROR
"""The worst disturbance ydot − u within it, constant and against the nearest row [rad/s]."""
STATE_LONGEST = 20
"""Most joint states lost in a row [periods]; the caller adds the controls it sent since the last one."""
MOVER_SPEED, MOVER_ACCELERATION = 0.25, 1.0
FRAME, SCENE_LONGEST = 20, 80
"""Camera period and oldest scene [periods]."""


@dataclass(frozen=True, slots=True)
class Class:
    """One documented configuration: the bounds that hold in the loop, and what the filter is told of them."""

    name: str
    says: str
    loop: dict[str, Any]
    filter: dict[str, Any]
    margin: float = 0.0
    """Margin of perceived things [m]."""
    moving: bool = False
    speed_only: bool = False
    """Nothing is told of a mover's velocity but its greatest speed, in any direction at any time."""
    against: str = ""
    """Of a negative control: the class that it takes something from, and that holds."""

    def config(self) -> FilterConfig:
        """The filter's dials."""
        return FilterConfig(**self.filter)

    def trial(self, seed: int, steps: int) -> dict[str, Any]:
        """What the lab runs."""
        return {**QUIET, **self.loop, "seed": seed, "steps": steps, "hold": (150, 400, 1000)[seed % 3]}

    def perceived(self, thing: Obstacle) -> Obstacle:
        """A true thing with the bounds that the filter is told."""
        loop = {**QUIET, **self.loop}
        changed = loop["speed_noise"] + loop["mover_acceleration"] * SCENE_LONGEST * PERIOD
        error = loop["mover_speed"] if self.speed_only else changed * loop["told"]
        return msgspec.structs.replace(thing, margin=self.margin, velocity_error=0.0 if thing.static else error)


def position_error(loop: dict[str, Any]) -> float:
    """What rows must allow for [rad]: measurement, and the disturbance's leaky integral, also without new states."""
    seen = loop["q_noise"] + LAG * loop["v_noise"]
    return seen + loop["push"] * (1.0 / ALPHA + loop["state_longest"] * PERIOD)


QUIET: dict[str, Any] = {
    "toward": 0.9, "lag": 0.0, "push": 0.0, "q_noise": 0.0, "v_noise": 0.0, "place_noise": 0.0, "speed_noise": 0.0,
    "frame": FRAME, "scene_longest": SCENE_LONGEST, "state_longest": 0, "reckon": 1, "scene_drop": 0.0,
    "state_drop": 0.0, "late": 0.0, "told": 1.0, "mover_speed": MOVER_SPEED,
    "mover_acceleration": MOVER_ACCELERATION, "spare": 0.01, "evadable": 1,
}  # fmt: skip
PLANT = {"lag": LAG, "push": PUSH}
NOISE = {**PLANT, "q_noise": Q_NOISE, "v_noise": V_NOISE, "place_noise": PLACE_NOISE, "speed_noise": SPEED_NOISE}
DROPS = {"state_longest": STATE_LONGEST, "state_drop": 0.01, "scene_drop": 0.3}
ALL = {**NOISE, **DROPS}
EXACT = {"lag_compensation": False, "tracking_error": 0.0}


def _told(loop: dict[str, Any]) -> dict[str, Any]:
    return {"tracking_error": ALPHA * position_error({**QUIET, **loop})}


STATIC = (
    Class("exact", "q integrates u, everything is measured exactly", {}, EXACT),
    Class("plant", "lag and the worst tracking disturbance", PLANT, _told(PLANT)),
    Class("noise", "and joints and things measured at their error bounds", NOISE, _told(NOISE), PLACE_NOISE),
    Class("drops", "and joint states and scenes lost", ALL, _told(ALL), PLACE_NOISE),
    Class(
        "stale",
        "joint states up to 50 ms old are used as they are",
        {**ALL, "state_longest": 49, "reckon": 0},
        _told(ALL),
        PLACE_NOISE,
    ),
    Class("late", "and control periods missed", {**ALL, "late": 0.002}, _told(ALL), PLACE_NOISE),
)
FAST = {**ALL, "evadable": 0, "mover_speed": 0.8, "mover_acceleration": 4.0}
MOVING = (
    Class("evadable", "a mover that leaves an escape", ALL, _told(ALL), PLACE_NOISE, moving=True),
    Class("unevadable", "a fast mover that leaves none where it can, its velocity told", FAST, _told(ALL), PLACE_NOISE,
          moving=True),
    Class("person", "the same, told by its greatest speed alone", {**FAST, "told": 0.0}, _told(ALL), PLACE_NOISE,
          moving=True, speed_only=True),
)  # fmt: skip
CONTROLS = (
    replace(STATIC[2], name="no margin", says="noise, and a filter that is told of none", filter=EXACT, margin=0.0,
            against="noise"),
    replace(STATIC[0], name="alpha 10", says="exact, and alpha beyond the acceleration limits",
            filter={**EXACT, "alpha": 10.0}, against="exact"),
    replace(MOVING[0], name="no hdot", says="the mover's velocity is not told", loop={**ALL, "told": 0.0},
            against="evadable"),
)  # fmt: skip
CLASSES = {c.name: c for c in (*STATIC, *MOVING, *CONTROLS)}
