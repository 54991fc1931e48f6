"""Decision times by planner, over all requests that reached a planner, each counted once (paper 7.3, metric 6).

The plan pass sends most requests before any episode runs, often in batches. The mean time of a batched request is a
cost, not a latency.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dualbrain.evaluation.planners.answer_cache import CachedAnswer
from dualbrain.evaluation.report.tables import DASH, Table, format_number

DECISION_LATENCY_TITLE, DECISION_LATENCY_NOTE = "Decision times", "each request once, on the machine that sent it"
DECISION_LATENCY_HEADER = (
    "planner",
    "single requests",
    "median [s]",
    "95th percentile [s]",
    "batched requests",
    "mean per request [s]",
)


def unbatched_latencies(answers: Sequence[CachedAnswer]) -> list[float]:
    """Time of each request that was sent on its own [s]."""
    return [one.proposal.timings.get("total", 0.0) for one in answers if _batch_size(one) == 1.0]


def decision_latency_table(answers: Sequence[CachedAnswer]) -> Table:
    """One row per planner: quantiles of single requests, mean time per batched request."""
    lines: list[tuple[str, ...]] = []
    for planner in sorted({one.planner for one in answers}):
        own = [one for one in answers if one.planner == planner]
        single, batched = unbatched_latencies(own), [_seconds_per_request(one) for one in own if _batch_size(one) > 1.0]
        quantiles = [format_number(float(np.percentile(single, q))) if single else DASH for q in (50, 95)]
        mean = format_number(float(np.mean(batched))) if batched else DASH
        lines.append((planner, str(len(single)), *quantiles, str(len(batched)), mean))
    return Table(DECISION_LATENCY_TITLE, DECISION_LATENCY_HEADER, tuple(lines), DECISION_LATENCY_NOTE)


def _batch_size(answer: CachedAnswer) -> float:
    """Number of requests in the batch of `answer`."""
    return answer.proposal.timings.get("at_once", 1.0)


def _seconds_per_request(answer: CachedAnswer) -> float:
    return answer.proposal.timings.get("total", 0.0) / _batch_size(answer)
