"""Every table of a report, in its order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dualbrain.evaluation.analysis.hypotheses import answers, beside
from dualbrain.evaluation.planners.answer_cache import Kept
from dualbrain.evaluation.report.adaptation_cost import cost_grid
from dualbrain.evaluation.report.decision_latency import decision_grid
from dualbrain.evaluation.report.method_contrasts import contrasts
from dualbrain.evaluation.report.tables import (
    Grid,
    beside_verdicts,
    failures,
    families,
    overview,
    throughput,
    verdicts,
    violations,
)
from dualbrain.evaluation.results.episode_row import Row


def all_grids(rows: Sequence[Row], config: dict[str, Any], kept: Sequence[Kept] = ()) -> tuple[Grid, ...]:
    """The verdicts first; the adapters' cost only where an adapter was asked, decisions where answers were `kept`."""
    found = (
        verdicts(answers(rows)), beside_verdicts(beside(rows)), overview(rows), violations(rows), families(rows),
        failures(rows), contrasts(rows), cost_grid(rows, config), decision_grid(kept), throughput(rows),
    )  # fmt: skip
    return tuple(grid for grid in found if grid.rows)
