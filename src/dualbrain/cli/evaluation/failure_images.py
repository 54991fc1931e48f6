"""The photographer of failures: flies an episode again and keeps the picture of the moment that matters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.control.control_loop import TickSnapshot
from dualbrain.evaluation.episodes.rerun import RerunHooks, rerun_episode
from dualbrain.evaluation.protocol.suite import Suite
from dualbrain.evaluation.report.captions import caption
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.visualization.evaluation.html_report import FailureImage


def capture_failure_image(row: EpisodeRow, suite: Suite, clock: Callable[[], float]) -> FailureImage:
    """The worst violation as it begins, or else the end of the episode."""
    worst = max(row.violations, key=lambda one: one.peak, default=None)
    at = worst.start if worst else float("inf")
    taken: list[NDArray[np.uint8]] = []
    plants: list[Any] = []

    def moment(now: TickSnapshot) -> None:
        if now.state.stamp >= at and not taken:
            taken.append(_render(plants[0]))

    flight = rerun_episode(row, suite, clock, RerunHooks(plants.append, moment, visuals=True))
    picture = taken[0] if taken else _render(flight.plant)
    return FailureImage(row, caption(row, worst if taken else None), picture)


def _render(plant: Any) -> NDArray[np.uint8]:
    with Camera(plant, width=640, height=480) as camera:
        return camera.capture().copy()
