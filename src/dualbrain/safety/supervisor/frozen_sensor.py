"""Pictures that come again, equal to the bit: what measures cannot do that, and a camera that hangs does nothing else.

What is seen with noise is never seen twice alike. A thing whose picture is told anew (a later stamp) with the very same
numbers was copied, not seen; a few in a row are believed, as coarse numbers may repeat by chance.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SensorReading:
    """One thing of a picture: its `name`, when it was seen [s], and the `numbers` that were measured.

    What has no noise (`exact`: known, surveyed, computed) may be the same for ever.
    """

    name: str
    stamp: float
    values: Hashable
    noise_free: bool


class FrozenSensorDetector:
    """Counts, for each thing, the pictures in a row that told it anew and alike."""

    def __init__(self) -> None:
        """Nothing seen yet."""
        self._last: dict[str, tuple[SensorReading, int]] = {}

    def update(self, readings: Iterable[SensorReading]) -> int:
        """Take in the next picture; how often its most repeated thing has come again. An old stamp counts nothing."""
        self._last = {one.name: (one, self._repeat_count(one)) for one in readings}
        return max((count for _, count in self._last.values()), default=0)

    def _repeat_count(self, reading: SensorReading) -> int:
        last, count = self._last.get(reading.name, (None, 0))
        if last is None or reading.noise_free or reading.values != last.values:
            return 0
        return count + (reading.stamp > last.stamp)
