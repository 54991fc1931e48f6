"""Report of an import: measurements of the sphere cover, written to the robot folder as JSON."""

from __future__ import annotations

import msgspec


class LinkReport(msgspec.Struct, frozen=True, kw_only=True):
    """The cover of one link: number of spheres and convex parts, `coverage` (share of the surface), excess [m]."""

    link: str
    group: str
    spheres: int
    parts: int
    coverage: float
    mean: float
    p95: float
    worst: float


class ImportReport(msgspec.Struct, frozen=True):
    """Cover of every link with shapes, notes for the user, and the effort of the fit ("quick" or "full")."""

    links: tuple[LinkReport, ...]
    notes: tuple[str, ...]
    effort: str

    @property
    def coverage(self) -> float:
        """The smallest coverage of all links."""
        return min((link.coverage for link in self.links), default=1.0)
