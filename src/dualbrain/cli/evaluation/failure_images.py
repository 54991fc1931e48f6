"""Images of failures: runs an episode again and renders its worst violation or its end."""

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
    """Image of the start of the worst violation, or else of the end of the episode; runs the episode again."""
    worst = max(row.violations, key=lambda one: one.peak, default=None)
    start = worst.start if worst else float("inf")
    images: list[NDArray[np.uint8]] = []
    plants: list[Any] = []

    def on_tick(tick: TickSnapshot) -> None:
        if tick.state.stamp >= start and not images:
            images.append(_render(plants[0]))

    run = rerun_episode(row, suite, clock, RerunHooks(plants.append, on_tick, visuals=True))
    rgb = images[0] if images else _render(run.plant)
    return FailureImage(row, caption(row, worst if images else None), rgb)


def _render(plant: Any) -> NDArray[np.uint8]:
    with Camera(plant, width=640, height=480) as camera:
        return camera.capture().copy()
