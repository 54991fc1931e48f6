"""How long decisions took, by planner: of all questions that were really asked, each once (paper 7.3, metric 6).

Most are asked in a pass of their own, before anything is flown, and often side by side: these say what a decision
costs, and are no latency.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dualbrain.evaluation.planners.answer_cache import CachedAnswer
from dualbrain.evaluation.report.tables import DASH, Table, format_number


def unbatched_latencies(kept: Sequence[CachedAnswer]) -> list[float]:
    """The seconds of each decision that was asked by itself."""
    return [one.proposal.timings.get("total", 0.0) for one in kept if _batch_size(one) == 1.0]


def decision_latency_table(kept: Sequence[CachedAnswer]) -> Table:
    """Each planner: its questions, how long one asked by itself took, and its share of those asked side by side."""
    lines: list[tuple[str, ...]] = []
    for planner in sorted({one.planner for one in kept}):
        mine = [one for one in kept if one.planner == planner]
        alone, shared = unbatched_latencies(mine), [_seconds_per_request(one) for one in mine if _batch_size(one) > 1.0]
        told = [*(format_number(float(np.percentile(alone, share))) for share in (50, 95))] if alone else [DASH, DASH]
        each = format_number(float(np.mean(shared))) if shared else DASH
        lines.append((planner, str(len(alone)), *told, str(len(shared)), each))
    head = ("planner", "asked alone", "median [s]", "95 % below [s]", "asked side by side", "mean of one [s]")
    return Table("Decisions", head, tuple(lines), "each question once, on the machine that asked")


def _batch_size(one: CachedAnswer) -> float:
    """How many questions were asked side by side with it, itself included."""
    return one.proposal.timings.get("at_once", 1.0)


def _seconds_per_request(one: CachedAnswer) -> float:
    return one.proposal.timings.get("total", 0.0) / _batch_size(one)
