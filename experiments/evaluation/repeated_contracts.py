"""The contracts of suite `adaptation`, executed again in the same scenes: success depends on the skills alone.

The planners of the suite had one answer per scene, which does not depend on the skills. Therefore the recorded answers,
executed by the skills of now, give the result that the suite would have with them, except for the time that a planner
takes to answer, in which a person walks on.
"""

from __future__ import annotations

import time
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.evaluation.analysis.metrics import METRIC_BY_NAME
from dualbrain.evaluation.analysis.statistics import Clusters, compare, difference, ratio
from dualbrain.evaluation.analysis.violation_kinds import violation_kinds
from dualbrain.evaluation.episodes.case_runner import EpisodeResources, run_case
from dualbrain.evaluation.episodes.scoring import EpisodeContext, score_episode
from dualbrain.evaluation.protocol.case import make_case
from dualbrain.evaluation.protocol.method import find_method
from dualbrain.evaluation.protocol.suite import Task
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.results.parquet import read_results, without_trace
from dualbrain.planner.scripted import RecordedAnswers
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_share_by_scene, markdown_table

RESULTS = Path("docs/results/planners/adaptation/results.parquet")
METHODS = ("B3", "P", "PE", "V", "PE-fixed")
"""Methods of the suite, those first whose difference is of interest."""
EXECUTED_AS = "B3"
"""The method of the repetition: full gate and filter, no memory, no second answer."""
PAIRS = (("P", "B3"), ("P", "PE"), ("P", "V"), ("P", "PE-fixed"))
MUCH = -1e-3
"""A barrier value h [m] below which no episode may fall."""
FREQUENCY = METRIC_BY_NAME["intervention frequency, on task"]


class RepeatedContracts:
    """The planners of suite `adaptation` with the skills of now."""

    name = "repeated_contracts"
    intervals = "over scenes (bootstrap; Korn and Graubard for rare events), 95 %"
    claim = (
        "With the skills of now the adapted planner (P) succeeds in at least 10 points more scenes than its base (B3) "
        "and than the best prompt (PE), and at least 85% of the episodes of B3 succeed."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Scene by scene in a fixed random order; in each the answer of every method."""
        del options
        pairs = sorted({pair for _, pair in _suite_rows()})
        order = np.random.default_rng(0).permutation(len(pairs))
        return [
            WorkUnit(f"{method} {pairs[index]}", {"method": method, "scene": pairs[index]})
            for methods in (METHODS[:3], METHODS[3:])
            for index in order
            for method in methods
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One recorded answer, executed again."""
        before = _suite_rows()[parameters["method"], parameters["scene"]]
        task = msgspec.convert({"family": before.family, "level": before.level}, Task)
        case = make_case(task, before.seed, before.robot, before.repetition)
        planner = RecordedAnswers([(text, reason) for text, reason in before.answers])
        method = find_method(EXECUTED_AS)
        run = run_case(case, method, EpisodeResources(id=before.planner, planner=planner, clock=time.perf_counter))
        context = EpisodeContext(key=before.key, suite=self.name, cluster=before.cluster, order=0, asked=False)
        return {**parameters, "episode": msgspec.to_builtins(without_trace(score_episode(case, method, run, context)))}

    def summarize_row(self, row: Row) -> str:
        """Success in the suite and now."""
        now, before = _episode(row), _suite_rows()[row["method"], row["scene"]]
        kinds = ", ".join(sorted(violation_kinds(now.violations)))
        return f"success {before.success} → {now.success}, {now.outcome}: {now.reason}; {kinds or 'no violation'}"

    def report(self, rows: list[Row]) -> list[str]:
        """Success by method in the suite and now, by family, differences of the methods, margins, and failures."""
        tables = (_method_table, _family_table, _comparison_table, _margin_table, _failure_table)
        return [line for table in tables for line in table(rows)]


@cache
def _suite_rows() -> dict[tuple[str, str], EpisodeRow]:
    """The episodes of the suite by method and scene."""
    rows, _ = read_results(RESULTS)
    return {(row.method, row.pair): row for row in rows}


def _episode(row: Row) -> EpisodeRow:
    return msgspec.convert(row["episode"], EpisodeRow)


def _by_method(rows: list[Row]) -> dict[str, list[tuple[EpisodeRow, EpisodeRow]]]:
    """The episodes (in the suite, now) of every method that has some."""
    found: dict[str, list[tuple[EpisodeRow, EpisodeRow]]] = {}
    for method in METHODS:
        for row in rows:
            if row["method"] == method:
                found.setdefault(method, []).append((_suite_rows()[method, row["scene"]], _episode(row)))
    return found


def _method_table(rows: list[Row]) -> list[str]:
    cells = []
    for method, pairs in _by_method(rows).items():
        before = format_share_by_scene([(old.pair, old.success) for old, _ in pairs])
        now = format_share_by_scene([(old.pair, new.success) for old, new in pairs])
        gained = sum(new.success and not old.success for old, new in pairs)
        lost = sum(old.success and not new.success for old, new in pairs)
        violations = format_share_by_scene([(old.pair, bool(new.violations)) for old, new in pairs])
        declined = sum(new.outcome in ("declined", "rejected") for _, new in pairs)
        cells.append((method, len(pairs), before, now, gained, lost, declined, violations))
    head = (
        "method", "scenes", "success in the suite", "success now", "gained", "lost", "declined or refused",
        "any violation now",
    )  # fmt: skip
    return markdown_table(head, cells)


def _family_table(rows: list[Row]) -> list[str]:
    cells = [
        (
            method,
            *(
                format_share_by_scene([(old.pair, new.success) for old, new in pairs if old.family == family])
                for family in _families(rows)
            ),
        )
        for method, pairs in _by_method(rows).items()
    ]
    return ["Success now, by family:", "", *markdown_table(("method", *_families(rows)), cells)]


def _families(rows: list[Row]) -> list[str]:
    return sorted({_episode(row).family for row in rows})


def _comparison_table(rows: list[Row]) -> list[str]:
    """Differences of success, and ratios of the intervention frequency on task, in the scenes that both have."""
    methods, cells = _by_method(rows), []
    for a, b in PAIRS:
        if a not in methods or b not in methods:
            continue
        gain = compare(_successes(methods[a]), _successes(methods[b]), difference)
        share = compare(_frequencies(methods[a]), _frequencies(methods[b]), ratio)
        cells.append(
            (
                f"{a} against {b}",
                f"{gain.effect * 100:+.1f} points [{gain.low * 100:+.1f}, {gain.high * 100:+.1f}]",
                f"{share.effect:.2f} [{share.low:.2f}, {share.high:.2f}]",
            )
        )
    return markdown_table(("now", "difference of success", "ratio of intervention frequency, on task"), cells)


def _successes(pairs: list[tuple[EpisodeRow, EpisodeRow]]) -> Clusters:
    """Success now by scene."""
    return {old.pair: [float(new.success)] for old, new in pairs}


def _frequencies(pairs: list[tuple[EpisodeRow, EpisodeRow]]) -> Clusters:
    """Intervention frequency on task now, by scene."""
    return {old.pair: FREQUENCY.values([new]) for old, new in pairs}


def _margin_table(rows: list[Row]) -> list[str]:
    """Episodes with motion in which h fell below 0, in the suite and now."""
    pairs = [pair for found in _by_method(rows).values() for pair in found]
    cells = []
    for when, episodes in (("in the suite", [old for old, _ in pairs]), ("now", [new for _, new in pairs])):
        moved = [(one.pair, one.h_min, one.margin_causes) for one in episodes if one.h_min is not None]
        causes = Counter(cause for _, h, found in moved if h < 0.0 for cause in dict.fromkeys(found))
        cells.append(
            (
                when,
                format_share_by_scene([(scene, h < 0.0) for scene, h, _ in moved]),
                sum(h < MUCH for _, h, _ in moved),
                f"{min((h for _, h, _ in moved), default=float('nan')) * 1e3:.2f}",
                ", ".join(f"{cause} ({count})" for cause, count in causes.most_common()) or "–",
            )
        )
    return markdown_table(("", "h below 0", "h below -1 mm", "least h [mm]", "causes"), cells)


def _failure_table(rows: list[Row]) -> list[str]:
    failures = [(method, new) for method, pairs in _by_method(rows).items() for _, new in pairs if not new.success]
    cells = [
        (
            method,
            f"{one.task} {one.seed}",
            one.outcome,
            one.reason.replace("|", "/"),
            ", ".join(sorted(violation_kinds(one.violations))) or "–",
        )
        for method, one in failures
    ]
    return ["Failures now:", "", *markdown_table(("method", "scene", "outcome", "reason", "violations"), cells)]
