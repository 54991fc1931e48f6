"""Detection of frozen sensors: measurements that repeat bit for bit.

A noisy sensor never measures the same values twice. An object that is reported again with a later stamp and identical
values was copied, not measured. A few repetitions are accepted, because coarse values may repeat by chance.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SensorReading:
    """One object of an observation: its `name`, the `stamp` [s] at which it was measured, and the measured `values`.

    Readings that are `noise_free` (known, surveyed or computed) may repeat indefinitely.
    """

    name: str
    stamp: float
    values: Hashable
    noise_free: bool


class FrozenSensorDetector:
    """Counts, for each object, consecutive observations with a later stamp and identical values."""

    def __init__(self) -> None:
        """Start without observations."""
        self._last: dict[str, tuple[SensorReading, int]] = {}

    def update(self, readings: Iterable[SensorReading]) -> int:
        """Add an observation; returns the largest number of repetitions. Readings with an old stamp do not count."""
        self._last = {reading.name: (reading, self._repeat_count(reading)) for reading in readings}
        return max((count for _, count in self._last.values()), default=0)

    def _repeat_count(self, reading: SensorReading) -> int:
        last, count = self._last.get(reading.name, (None, 0))
        if last is None or reading.noise_free or reading.values != last.values:
            return 0
        return count + (reading.stamp > last.stamp)
