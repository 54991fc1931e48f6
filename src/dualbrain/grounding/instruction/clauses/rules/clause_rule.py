"""One rule of the check: a pattern of clauses that contracts cannot express."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

ClauseKind = Literal[
    "condition",
    "loop",
    "time",
    "count",
    "exclusion",
    "relative place",
    "orientation",
    "motion",
    "handing over",
    "alternative",
    "comparison",
]
Capability = Literal[
    "", "wait", "push distance", "hover", "turn", "occupancy", "hand over", "push", "speed", "force", "clearance"
]
"""What some registries can express: see `expressible.capabilities`."""


@dataclass(frozen=True, slots=True)
class ClauseRule:
    """A clause of one `kind`: its `pattern`, the sentences it does not count in, and the capability that expresses it.

    `advice` is what a person can ask for instead, beyond the skills of the robot.
    """

    kind: ClauseKind
    pattern: re.Pattern[str]
    unless: re.Pattern[str] | None = None
    capability: Capability = ""
