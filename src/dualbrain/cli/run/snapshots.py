"""Images of a run, taken at the first tick of selected phases."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape

from dualbrain.control.control_loop import TickSnapshot
from dualbrain.errors import MissingDependencyError
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.simulation.plant.plant import Plant
from dualbrain.visualization.html.run_report import Snapshot

PHASE_CAPTIONS = {
    "planning": "planning",
    "descend": "descending",
    "close": "closing the fingers",
    "carry": "carrying",
    "lower": "lowering",
    "retreat": "releasing",
    "drive": "driving",
    "turn": "turning",
    "wait": "waiting for a person",
}

INTERVENTION_CAPTION = "strongest intervention of the filter"
MIN_SHOWN_DELTA, INTERVENTION_GROWTH, MAX_INTERVENTION_IMAGES = 0.005, 1.5, 8
"""Least δ of which an image is taken, its least growth until the next image, and the largest number of images."""


class PhaseCamera:
    """Takes one image at the first tick of each captioned phase; without a GL library it takes none and reports why."""

    def __init__(self, plant: Plant, console: Console, no_graphics: str = "") -> None:
        """Open the camera; `no_graphics` is the reason why no GL library is used, "" if one is."""
        self._plant, self._console = plant, console
        self._seen: set[str] = set()
        self._strongest, self._interventions = 0.0, 0
        self.snapshots: list[Snapshot] = []
        self._camera: Camera | None = None
        try:
            self._camera = Camera(plant)
        except MissingDependencyError as error:
            console.print(f"[yellow]no images:[/] {escape(no_graphics or str(error))}")

    def on_phase(self, phase: str) -> None:
        """Take an image if `phase` is captioned and new."""
        if phase in PHASE_CAPTIONS and phase not in self._seen:
            self._seen.add(phase)
            self.take_snapshot(PHASE_CAPTIONS[phase])

    def on_tick(self, moment: TickSnapshot) -> None:
        """Take an image of the strongest intervention so far; it replaces the one before."""
        if moment.action < 0 or self._interventions == MAX_INTERVENTION_IMAGES:
            return
        if moment.result.delta > max(MIN_SHOWN_DELTA, INTERVENTION_GROWTH * self._strongest):
            self._strongest, self._interventions = moment.result.delta, self._interventions + 1
            pair = moment.result.explain(remedy=False)
            self.snapshots = [one for one in self.snapshots if not one.caption.startswith(INTERVENTION_CAPTION)]
            self.take_snapshot(f"{INTERVENTION_CAPTION}: {pair}")

    def take_snapshot(self, caption: str) -> None:
        """Take an image now; after an error the camera is not used again, and the run continues."""
        if self._camera:
            try:
                self.snapshots.append(Snapshot(self._plant.now, caption, self._camera.capture().copy()))
            except Exception as error:
                self._camera = None
                self._console.print(f"[yellow]no more images:[/] {escape(str(error))}")

    def close(self) -> None:
        """Release the camera."""
        if self._camera:
            self._camera.close()
