"""What was measured while a body was made; written beside it as JSON and read by inspect and the docs."""

from __future__ import annotations

import msgspec


class LinkReport(msgspec.Struct, frozen=True, kw_only=True):
    """The cover of one link: spheres, convex parts, `coverage` (share of the surface), excess in metres."""

    link: str
    group: str
    spheres: int
    parts: int
    coverage: float
    mean: float
    p95: float
    worst: float


class ImportReport(msgspec.Struct, frozen=True):
    """Cover of every link with shapes, what a person should know, and the effort ("quick" or "full")."""

    links: tuple[LinkReport, ...]
    notes: tuple[str, ...]
    effort: str

    @property
    def coverage(self) -> float:
        """The least share of any link's surface."""
        return min((link.coverage for link in self.links), default=1.0)
