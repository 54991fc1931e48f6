"""All rules that one pattern decides; the others are in `clause_search.py`."""

from __future__ import annotations

from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseRule
from dualbrain.grounding.instruction.clauses.rules.comparisons import COMPARISONS
from dualbrain.grounding.instruction.clauses.rules.counts import COUNTS
from dualbrain.grounding.instruction.clauses.rules.exclusions import EXCLUSIONS
from dualbrain.grounding.instruction.clauses.rules.handovers import HANDOVERS
from dualbrain.grounding.instruction.clauses.rules.loops import LOOPS
from dualbrain.grounding.instruction.clauses.rules.orientations import ORIENTATIONS
from dualbrain.grounding.instruction.clauses.rules.relative_places import RELATIVE_PLACES
from dualbrain.grounding.instruction.clauses.rules.times import TIMES

RULES: tuple[ClauseRule, ...] = (
    *LOOPS,
    *TIMES,
    *COUNTS,
    *RELATIVE_PLACES,
    *ORIENTATIONS,
    *HANDOVERS,
    *COMPARISONS,
    *EXCLUSIONS,
)
