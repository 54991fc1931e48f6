"""The table of barriers as markdown, as it stands in docs/barriers.md: `python -m dualbrain.safety.barriers`."""

from __future__ import annotations

import sys

from dualbrain.safety.barriers import BARRIERS
from dualbrain.safety.barriers.barrier import BarrierSpec

HEADER = """# Barriers

What the filter keeps. One file a barrier in `src/dualbrain/safety/barriers/`; a new file with a `BARRIER` in it appears
here (`python -m dualbrain.safety.barriers > docs/barriers.md`), in the tests (`tests/safety/test_barriers.py`: pushed
hard it holds, it tells its name, without the filter it would break) and in the live view and the report.

When no control can meet all rows, they are given up by rank, task first, then workspace, obstacle, body; the box of
joint velocity, acceleration and position never, nor a row about something that stands still as long as braking meets
it. The aim is then the hardest admissible braking, not the nominal control.

h is kept at or above zero by ḣ ≥ −α h, with α ≤ min(a_max/v_max) unless stated otherwise, so that the acceleration
limits can follow. For h < 0 a row asks for ḣ ≥ min(α|h|, recovery speed) and never forbids moving away. Margins beyond
h = 0: *sampling* (a step of finite length), *tracking* (ẏ ≠ u), *measurement* (obstacle margin), *age* (velocity error
× age of the observation), *rounding* (float32)."""


def render_markdown() -> str:
    """The whole page."""
    return "\n\n".join([HEADER, *map(_section, BARRIERS.values())]) + "\n"


def _section(barrier: BarrierSpec) -> str:
    rank = "never (part of the box)" if barrier.rank is None else barrier.rank.name.lower()
    facts = {
        "Keeps": barrier.description,
        "h": barrier.h,
        "Row": barrier.row,
        "Given up": rank,
        "α": barrier.alpha,
        "Margins": ", ".join(barrier.margins) or "none",
        "Source": barrier.source,
        "Where": f"`{barrier.implementation}`",
    }
    return "\n".join([f"## {barrier.name}", "", *(f"- **{key}**: {value}" for key, value in facts.items())])


if __name__ == "__main__":
    sys.stdout.write(render_markdown())
