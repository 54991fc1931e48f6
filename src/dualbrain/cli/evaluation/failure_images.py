"""The photographer of failures: flies an episode again and keeps the picture of the moment that matters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.control.control_loop import Moment
from dualbrain.evaluation.episodes.rerun import Watching, again
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.captions import caption
from dualbrain.evaluation.results.episode_row import Row
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.visualization.evaluation.html_report import Shot


def photograph(row: Row, suite: Suite, clock: Callable[[], float]) -> Shot:
    """The worst violation as it begins, or else the end of the episode."""
    worst = max(row.violations, key=lambda one: one.peak, default=None)
    at = worst.start if worst else float("inf")
    taken: list[NDArray[np.uint8]] = []
    plants: list[Any] = []

    def moment(now: Moment) -> None:
        if now.state.stamp >= at and not taken:
            taken.append(_snap(plants[0]))

    flight = again(row, suite, clock, Watching(plants.append, moment, visuals=True))
    picture = taken[0] if taken else _snap(flight.plant)
    return Shot(row, caption(row, worst if taken else None), picture)


def _snap(plant: Any) -> NDArray[np.uint8]:
    with Camera(plant, width=640, height=480) as camera:
        return camera.snap().copy()
