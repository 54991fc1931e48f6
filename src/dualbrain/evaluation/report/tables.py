"""Results as tables of words: the same ones in Markdown, in HTML and on the screen."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, isfinite, isnan
from statistics import fmean, median

from dualbrain.evaluation.analysis.failure_taxonomy import FAILURE_CLASSES, failure_class_of
from dualbrain.evaluation.analysis.hypotheses import Claim, HypothesisResult
from dualbrain.evaluation.analysis.metrics import MAIN_METRICS, METRIC_BY_NAME, Metric
from dualbrain.evaluation.analysis.severity import SAFETY_KINDS, UNAUTHORISED
from dualbrain.evaluation.analysis.statistics import Clusters, Estimate, estimate
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.report.captions import VIOLATION_LABELS
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.planner.prompt.prompt_format import NO_CONSTRAINT

DASH = "–"
PERCENT_UNITS = ("rate", "share")
FAMILY_METRICS = ("violation rate", "success", "Δ of successes", "intervention frequency")
"""The metrics that are told family by family."""
WALL_TIME_PARTS = ("physics", "monitor", "filter", "planner", "rest")
"""Parts of an episode's wall time."""
ROUNDING_TOLERANCE = 1e-12
"""What is left of sums that cancel out is nothing."""
WALL_TIME_NOTE = "wall time of a process that shares its processor"
MAX_COLUMNS = 11
"""Beside the names of the rows: as many as the table of hypotheses has."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table: its title, heads, rows of cells (the first cell of a row names it), and what to know of it."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def split_columns(self) -> list[tuple[tuple[str, ...], list[tuple[str, ...]]]]:
        """Heads and rows, side by side where a table is too wide to be read: each part begins with the rows' names."""
        count = max(1, ceil((len(self.header) - 1) / MAX_COLUMNS))
        wide = ceil((len(self.header) - 1) / count)
        return [
            (
                (self.header[0], *self.header[start : start + wide]),
                [(row[0], *row[start : start + wide]) for row in self.rows],
            )
            for start in range(1, len(self.header), wide)
        ]


def methods_of(rows: Sequence[EpisodeRow]) -> tuple[str, ...]:
    """The methods that flew, in the order of the main table."""
    flown = {row.method for row in rows}
    return tuple(name for name in METHODS if name in flown)


def values_by_cluster(rows: Sequence[EpisodeRow], metric: Metric) -> Clusters:
    """The metric's values by cluster."""
    found: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        value = metric.value_of(row)
        if value is not None:
            found[row.cluster].append(value)
    return found


def estimate_metric(rows: Sequence[EpisodeRow], method: str, metric: str) -> Estimate:
    """One metric of one method."""
    chosen = METRIC_BY_NAME[metric]
    return estimate(
        values_by_cluster([row for row in rows if row.method == method], chosen), is_rate=chosen.unit == "rate"
    )


def format_number(value: float, unit: str = "") -> str:
    """A number with as many digits as people read; shares in percent."""
    if isnan(value):
        return DASH
    if not isfinite(value):
        return "∞" if value > 0 else "−∞"
    value = 0.0 if abs(value) < ROUNDING_TOLERANCE else value
    text = f"{100.0 * value:.1f} %" if unit in PERCENT_UNITS else f"{value:.3g}"
    return text.replace("-", "−")


def format_estimate(found: Estimate, unit: str) -> str:
    """Mean ± standard deviation [95 % interval]."""
    if not found.n:
        return DASH
    low, high = (format_number(end, unit).removesuffix(" %") for end in (found.low, found.high))
    spread = "" if unit in PERCENT_UNITS else f" ± {format_number(found.sd, unit)}"
    interval = f" [{low}, {high}]" if isfinite(found.low + found.high) else ""
    return f"{format_number(found.mean, unit)}{spread}{interval}"


def overview_table(rows: Sequence[EpisodeRow]) -> Table:
    """Every metric of every method."""
    methods = methods_of(rows)
    counts = Counter(row.method for row in rows)
    clusters = {name: len({row.cluster for row in rows if row.method == name}) for name in methods}
    lines = [("episodes (clusters)", *(f"{counts[name]} ({clusters[name]})" for name in methods))]
    for name in MAIN_METRICS:
        unit = METRIC_BY_NAME[name].unit
        label = name if unit in (*PERCENT_UNITS, "1") else f"{name} [{unit}]"
        lines.append((label, *(format_estimate(estimate_metric(rows, method, name), unit) for method in methods)))
    note = (
        "mean ± standard deviation [95 % interval over clusters, none from a single one]; – : nothing to measure; "
        f"gate time and filter step are {WALL_TIME_NOTE}"
    )
    return Table("Methods and metrics", ("metric", *methods), tuple(lines), note)


def violations_table(rows: Sequence[EpisodeRow]) -> Table:
    """The violation rate by kind."""
    methods = methods_of(rows)
    others = sorted({v.kind for row in rows for v in row.violations} - set(SAFETY_KINDS))
    lines = [(VIOLATION_LABELS[kind], *_violation_shares(rows, methods, kind)) for kind in SAFETY_KINDS]
    for kind in others:
        told = [[row for row in rows if row.method == method] for method in methods]
        shares = [sum(any(v.kind == kind for v in row.violations) for row in some) / len(some) for some in told]
        lines.append(
            (
                f"{VIOLATION_LABELS.get(kind, kind)} (beside the rate)",
                *(format_number(share, "share") for share in shares),
            )
        )
    note = "on simulator truth, by the monitor"
    if any(DASH in line for line in lines):
        note += f"; {DASH} : a grammar bound every answer, so that no skill could be called that nobody holds"
    return Table("Violations by kind", ("episodes with", *methods), tuple(lines), note)


def _violation_shares(rows: Sequence[EpisodeRow], methods: Sequence[str], kind: str) -> list[str]:
    """The share of episodes with a violation of `kind`; a dash where none could be."""
    return [
        DASH
        if kind == UNAUTHORISED and _is_always_constrained(rows, method)
        else format_estimate(estimate_metric(rows, method, kind), "rate")
        for method in methods
    ]


def _is_always_constrained(rows: Sequence[EpisodeRow], method: str) -> bool:
    """Whether every answer that `method` got was bound by a grammar while it was written."""
    by = [row.constrained_by for row in rows if row.method == method]
    return all(one and not one.startswith(NO_CONSTRAINT) for one in by)


def families_table(rows: Sequence[EpisodeRow]) -> Table:
    """The main metrics, family by family, and level by level where a family has several."""
    methods = methods_of(rows)
    groups: dict[str, list[EpisodeRow]] = {}
    for row in sorted(rows, key=lambda row: (row.robot, row.task)):
        groups.setdefault(f"{row.robot} {row.task.split()[0]}", []).append(row)
    lines: list[tuple[str, ...]] = []
    for family, some in groups.items():
        tasks = sorted({row.task for row in some})
        parts = [(f"{some[0].robot} {task}", [row for row in some if row.task == task]) for task in tasks]
        for label, here in parts if len(parts) == 1 else [(family, some), *parts]:
            lines += [(f"{label}: {name}", *_metric_cells(here, methods, name)) for name in FAMILY_METRICS]
    return Table("By robot and family", ("", *methods), tuple(lines))


def _metric_cells(rows: Sequence[EpisodeRow], methods: Sequence[str], name: str) -> list[str]:
    return [format_estimate(estimate_metric(rows, method, name), METRIC_BY_NAME[name].unit) for method in methods]


def failures_table(rows: Sequence[EpisodeRow]) -> Table:
    """How many episodes failed, by class."""
    methods = methods_of(rows)
    counts = {name: Counter(failure_class_of(row) for row in rows if row.method == name) for name in methods}
    lines = [(one, *(str(counts[name][one]) for name in methods)) for one in FAILURE_CLASSES]
    lines.append(("all failures", *(str(sum(counts[name][one] for one in FAILURE_CLASSES)) for name in methods)))
    return Table("Failures by class", ("class", *methods), tuple(lines), "by the first stage that failed")


def hypotheses_table(told: Sequence[HypothesisResult]) -> Table:
    """The hypotheses claim by claim."""
    lines = [
        (f"{answer.name}: {answer.verdict}" if not index else "", *_claim_cells(claim))
        for answer in told
        for index, claim in enumerate(answer.claims)
    ]
    note = "by the rule of docs/evaluation.md; the effects and the least that counts stood before the run"
    return Table("Hypotheses", ("hypothesis", *CLAIM_COLUMNS), tuple(lines), note)


def secondary_claims_table(told: Sequence[Claim]) -> Table:
    """What was asked of the same rule and decides no hypothesis."""
    lines = tuple((claim.hypothesis, *_claim_cells(claim)) for claim in told)
    return Table("Beside the hypotheses", ("like", *CLAIM_COLUMNS), lines, "by the same rule; part of no verdict")


CLAIM_COLUMNS = (
    "methods",
    "effect",
    "found",
    "95 %",
    "wanted",
    "claim",
    "p (Holm)",
    "p (Wilcoxon)",
    "d_z",
    "rank-biserial",
    "clusters",
)


def _claim_cells(claim: Claim) -> tuple[str, ...]:
    found = claim.found
    return (
        f"{claim.a} against {claim.b}",
        f"{claim.effect} of {claim.quantity}",
        format_number(found.effect),
        f"[{format_number(found.low)}, {format_number(found.high)}]",
        f"{'at most' if claim.side < 0 else 'at least'} {claim.minimum:g}",
        claim.verdict,
        format_number(claim.p),
        format_number(found.wilcoxon),
        format_number(found.dz),
        format_number(found.rank_biserial),
        str(found.clusters),
    )


def throughput_table(rows: Sequence[EpisodeRow]) -> Table:
    """Wall time by part, and episodes an hour and core; an episode that stood still with its machine moves no median.

    In tables of before 2026-11-24 parts overlap, and what was asked aside was subtracted whole: there an episode takes
    at least as long as its parts.
    """
    lines: list[tuple[str, ...]] = []
    own = [row for row in rows if not row.same_as]
    for name in methods_of(own):
        here = [row for row in own if row.method == name]
        walls = [max(row.wall_s, sum(row.wall.values())) for row in here]
        shares = (
            fmean(row.wall.get(part, 0.0) / wall for row, wall in zip(here, walls, strict=True))
            for part in WALL_TIME_PARTS
        )
        pace = median(row.simulated_s / wall for row, wall in zip(here, walls, strict=True))
        lines.append(
            (name, f"{3600.0 / median(walls):.0f}", f"{pace:.2f}", *(format_number(one, "share") for one in shares))
        )
    head = ("method", "episodes an hour and core", "simulated s per s", *WALL_TIME_PARTS)
    return Table(
        "Throughput",
        head,
        tuple(lines),
        "by the median episode, shares as means over episodes; wall time on the machine that flew, whatever else ran "
        "there; what was alike in every input was flown once, and what was asked beforehand stands under decisions",
    )


def markdown_table(grid: Table) -> list[str]:
    """One table under its title."""
    lines = [f"## {grid.title}", ""]
    if grid.note:
        lines += [f"{grid.note[0].upper()}{grid.note[1:]}.", ""]
    if not grid.rows:
        return [*lines, "None.", ""]
    for head, rows in grid.split_columns():
        lines += [_markdown_row(head), _markdown_row(["---"] * len(head)), *map(_markdown_row, rows), ""]
    return lines


def markdown_page(title: str, header_lines: Sequence[str], tables: Iterable[Table]) -> str:
    """A whole page."""
    lines = [f"# {title}", "", *(f"{line}  " for line in header_lines), ""]
    for grid in tables:
        lines += markdown_table(grid)
    return "\n".join(lines)


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
