"""Print the page on barriers: python -m dualbrain.safety.barriers > docs/reference/safety/barriers.md."""

from __future__ import annotations

import sys

from dualbrain.safety.barriers import BARRIERS
from dualbrain.safety.barriers.barrier import BarrierSpec

HEADER = """# Barriers

This page lists the constraints that the safety filter enforces. Each barrier is one module in
`src/dualbrain/safety/barriers/`. A new module that defines `BARRIER` appears on this page
(`python -m dualbrain.safety.barriers > docs/reference/safety/barriers.md`), in the tests, in the live view and in the
report. The tests (`tests/safety/test_barriers.py`) push the robot against each barrier and check that h stays at or
above zero, that the result names the barrier, and that h falls below zero without the filter.

If no control satisfies all rows, the filter relaxes rows by rank: task first, then workspace, obstacle and body. It
never relaxes the box of joint velocity, acceleration and position, and never a row of the robot's
own parts or of an obstacle at rest (rank body or obstacle) that braking satisfies; planes and boxes of a site have
rank workspace. The target control is then the hardest admissible braking, not the nominal control.

The filter keeps h ≥ 0 by ḣ ≥ −α h, with α ≤ min(a_max/v_max) unless stated otherwise, so that the acceleration limits
can follow. The rows of bodies also keep h ≥ 0 at the end of a stop along the arc of the present motion: a body may
approach at

    s(h) = min(α h, max(0, 2g h − C/(4g))),   g = min(a_max/v_max),   C = max(0, −ḧ),

with ḧ at the centre of the control bounds: the second derivative of the distance for two links, and its lower bound n'a
for an obstacle, with the acceleration a of the centre of the sphere (of a mobile base with the turn of its drive
axis). Nearer than h = C/(8g²) a stop needs more than h, and no row asks for a retreat. Below h = 0 a row asks for
ḣ ≥ min(−α h, recovery speed), for joint limits 4 × recovery speed [rad/s], and never forbids motion away from the
obstacle.
Margins beyond h = 0: *sampling* (a step of finite length), *tracking* (ẏ ≠ u), *measurement* (obstacle margin), *age*
(velocity error × age of the observation), *rounding* (float32)."""


def render_markdown() -> str:
    """Markdown text of the whole page."""
    return "\n\n".join([HEADER, *map(_section, BARRIERS.values())]) + "\n"


def _section(barrier: BarrierSpec) -> str:
    rank = "none (part of the box, never relaxed)" if barrier.rank is None else barrier.rank.name.lower()
    facts = {
        "Constraint": barrier.description,
        "h": barrier.h,
        "Row": barrier.row,
        "Rank": rank,
        "α": barrier.alpha,
        "Margins": ", ".join(barrier.margins) or "none",
        "Source": barrier.source,
        "Where": f"`{barrier.implementation}`",
    }
    return "\n".join([f"## {barrier.name}", "", *(f"- **{key}**: {value}" for key, value in facts.items())])


if __name__ == "__main__":
    sys.stdout.write(render_markdown())
