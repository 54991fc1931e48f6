"""Pictures of a run, taken at the moments that tell its story."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape

from dualbrain.errors import MissingDependencyError
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.simulation.plant.plant import Plant
from dualbrain.visualization.html.run_report import Snapshot

PHASE_CAPTIONS = {
    "planning": "the planner thinks",
    "descend": "coming down",
    "close": "the fingers close",
    "carry": "carrying",
    "lower": "lowering",
    "retreat": "letting go",
    "drive": "setting off",
    "turn": "turning",
    "wait": "waiting for a person",
}


class PhaseCamera:
    """Takes one picture at the first of each telling phase; without a GL library it stays empty and says why."""

    def __init__(self, plant: Plant, console: Console, no_graphics: str = "") -> None:
        """Open the camera; `no_graphics` is why no GL library is in use, if that is so."""
        self._plant, self._console = plant, console
        self._seen: set[str] = set()
        self.snapshots: list[Snapshot] = []
        self._camera: Camera | None = None
        try:
            self._camera = Camera(plant)
        except MissingDependencyError as why:
            console.print(f"[yellow]no pictures:[/] {escape(no_graphics or str(why))}")

    def on_phase(self, phase: str) -> None:
        """A phase begins."""
        if phase in PHASE_CAPTIONS and phase not in self._seen:
            self._seen.add(phase)
            self.take_snapshot(PHASE_CAPTIONS[phase])

    def take_snapshot(self, caption: str) -> None:
        """Take a picture now; a camera that fails is not asked again: no picture is worth a run."""
        if self._camera:
            try:
                self.snapshots.append(Snapshot(self._plant.now, caption, self._camera.capture().copy()))
            except Exception as why:
                self._camera = None
                self._console.print(f"[yellow]no more pictures:[/] {escape(str(why))}")

    def close(self) -> None:
        """Release the camera."""
        if self._camera:
            self._camera.close()
