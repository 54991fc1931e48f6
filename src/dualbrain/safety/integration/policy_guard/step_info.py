"""Entries of the `info` of an environment's step, for the reports of the guard during that step."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan, nan
from typing import Any

from dualbrain.safety.integration.policy_guard.guard import GuardReport


def step_info(reports: Sequence[GuardReport]) -> dict[str, Any]:
    """`cost`, `cost_rows`, `h_min` [m], `status` and `safety` (a sentence) of one action, from one report or more."""
    problems = [report.problem for report in reports if report.problem]
    return {
        "cost": sum(report.delta for report in reports) / len(reports),
        "cost_rows": sum(report.delta_rows for report in reports) / len(reports),
        "h_min": min((report.h_min for report in reports if not isnan(report.h_min)), default=nan),
        "status": max(report.status for report in reports).name,
        "safety": problems[0] if problems else max(reports, key=lambda report: report.delta).explanation,
    }
