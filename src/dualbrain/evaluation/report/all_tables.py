"""All tables of a report, in their order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dualbrain.evaluation.analysis.hypotheses import evaluate_hypotheses, secondary_claims
from dualbrain.evaluation.planners.answer_cache import CachedAnswer
from dualbrain.evaluation.report.adaptation_cost import cost_table
from dualbrain.evaluation.report.decision_latency import decision_latency_table
from dualbrain.evaluation.report.margins_table import margins_table
from dualbrain.evaluation.report.method_contrasts import contrasts_table
from dualbrain.evaluation.report.tables import (
    Table,
    failures_table,
    families_table,
    hypotheses_table,
    overview_table,
    secondary_claims_table,
    throughput_table,
    violations_table,
)
from dualbrain.evaluation.results.episode_row import EpisodeRow


def all_tables(
    rows: Sequence[EpisodeRow], config: dict[str, Any], cached_answers: Sequence[CachedAnswer] = ()
) -> tuple[Table, ...]:
    """Tables that have rows, the verdicts first.

    The adaptation cost appears only if a method used an adapter, the decision latencies only with `cached_answers`.
    """
    found = (
        hypotheses_table(evaluate_hypotheses(rows)),
        secondary_claims_table(secondary_claims(rows)),
        overview_table(rows),
        violations_table(rows),
        margins_table(rows),
        families_table(rows),
        failures_table(rows),
        contrasts_table(rows),
        cost_table(rows, config),
        decision_latency_table(cached_answers),
        throughput_table(rows),
    )
    return tuple(table for table in found if table.rows)
