"""Tables of results as text; Markdown, HTML and the terminal show the same tables."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, isfinite, isnan
from statistics import fmean, median

from dualbrain.core import markdown
from dualbrain.evaluation.analysis.failure_taxonomy import FAILURE_CLASSES, failure_class_of
from dualbrain.evaluation.analysis.hypotheses import Claim, HypothesisResult
from dualbrain.evaluation.analysis.metrics import MAIN_METRICS, METRIC_BY_NAME, Metric
from dualbrain.evaluation.analysis.statistics import Clusters, Estimate, estimate
from dualbrain.evaluation.analysis.violation_kinds import SAFETY_KINDS, UNAUTHORISED, has_kind, violation_kinds
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.report.captions import VIOLATION_LABELS
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.planner.prompt.prompt_format import NO_CONSTRAINT

DASH = "–"
PERCENT_UNITS = ("rate", "share")
FAMILY_METRICS = ("violation rate", "success", "Δ of successes", "intervention frequency")
"""Metrics that are reported for each task family."""
WALL_TIME_PARTS = ("physics", "monitor", "filter", "planner", "rest")
"""Parts of the wall time of an episode."""
ROUNDING_TOLERANCE = 1e-12
"""Numbers below this are rounding errors of sums that cancel, and are printed as 0."""
THROUGHPUT_TITLE = "Throughput"
WALL_TIME_NOTE = "wall time of a process that shares its processor"
MAX_COLUMNS = 11
"""Maximum number of columns besides the row names: that of the table of hypotheses."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text: title, column names, rows of cells (the first cell names the row), and a note."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def split_columns(self) -> list[tuple[tuple[str, ...], list[tuple[str, ...]]]]:
        """Split a wide table into parts of at most `MAX_COLUMNS` columns, each with the row names in front."""
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
    """Methods that occur in `rows`, in the order of the main table."""
    present = {row.method for row in rows}
    return tuple(name for name in METHODS if name in present)


def values_by_cluster(rows: Sequence[EpisodeRow], metric: Metric) -> Clusters:
    """Values of the metric by cluster."""
    found: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        value = metric.value_of(row)
        if value is not None:
            found[row.cluster].append(value)
    return found


def estimate_metric(rows: Sequence[EpisodeRow], method: str, metric: str) -> Estimate:
    """Estimate of one metric of one method."""
    chosen = METRIC_BY_NAME[metric]
    return estimate(
        values_by_cluster([row for row in rows if row.method == method], chosen), is_rate=chosen.unit == "rate"
    )


def format_number(value: float, unit: str = "") -> str:
    """A number with three significant digits; rates and shares in percent with one decimal."""
    if isnan(value):
        return DASH
    if not isfinite(value):
        return "∞" if value > 0 else "−∞"
    value = 0.0 if abs(value) < ROUNDING_TOLERANCE else value
    text = f"{100.0 * value:.1f} %" if unit in PERCENT_UNITS else f"{value:.3g}"
    return text.replace("-", "−")


def format_estimate(estimate: Estimate, unit: str) -> str:
    """Text "mean ± standard deviation [95 % interval]", without the deviation for rates and shares."""
    if not estimate.n:
        return DASH
    low, high = (format_number(end, unit).removesuffix(" %") for end in (estimate.low, estimate.high))
    spread = "" if unit in PERCENT_UNITS else f" ± {format_number(estimate.sd, unit)}"
    interval = f" [{low}, {high}]" if isfinite(estimate.low + estimate.high) else ""
    return f"{format_number(estimate.mean, unit)}{spread}{interval}"


def overview_table(rows: Sequence[EpisodeRow]) -> Table:
    """Table of every metric of every method."""
    methods = methods_of(rows)
    counts = Counter(row.method for row in rows)
    clusters = {name: len({row.cluster for row in rows if row.method == name}) for name in methods}
    lines = [("episodes (clusters)", *(f"{counts[name]} ({clusters[name]})" for name in methods))]
    for name in MAIN_METRICS:
        unit = METRIC_BY_NAME[name].unit
        label = name if unit in (*PERCENT_UNITS, "1") else f"{name} [{unit}]"
        lines.append((label, *(format_estimate(estimate_metric(rows, method, name), unit) for method in methods)))
    note = (
        "mean ± standard deviation [95 % interval over clusters, none from a single cluster]; – : nothing to measure; "
        f"gate time and filter step are {WALL_TIME_NOTE}"
    )
    return Table("Methods and metrics", ("metric", *methods), tuple(lines), note)


def violations_table(rows: Sequence[EpisodeRow]) -> Table:
    """Table of the violation rate by kind."""
    methods = methods_of(rows)
    others = sorted(violation_kinds(one for row in rows for one in row.violations) - set(SAFETY_KINDS))
    lines = [(VIOLATION_LABELS[kind], *_violation_shares(rows, methods, kind)) for kind in SAFETY_KINDS]
    for kind in others:
        by_method = [[row for row in rows if row.method == method] for method in methods]
        shares = [sum(has_kind(row.violations, kind) for row in some) / len(some) for some in by_method]
        lines.append(
            (
                f"{VIOLATION_LABELS.get(kind, kind)} (not part of the rate)",
                *(format_number(share, "share") for share in shares),
            )
        )
    note = "measured by the monitor on ground truth"
    if any(DASH in line for line in lines):
        note += f"; {DASH} : a grammar constrained every answer, so that no unauthorised skill could be called"
    return Table("Violations by kind", ("episodes with", *methods), tuple(lines), note)


def _violation_shares(rows: Sequence[EpisodeRow], methods: Sequence[str], kind: str) -> list[str]:
    """Share of episodes with a violation of `kind` by method; a dash if the violation was impossible."""
    return [
        DASH
        if kind == UNAUTHORISED and _is_always_constrained(rows, method)
        else format_estimate(estimate_metric(rows, method, kind), "rate")
        for method in methods
    ]


def _is_always_constrained(rows: Sequence[EpisodeRow], method: str) -> bool:
    """Whether a grammar constrained the decoding of every answer of `method`."""
    constraints = [row.constrained_by for row in rows if row.method == method]
    return all(one and not one.startswith(NO_CONSTRAINT) for one in constraints)


def families_table(rows: Sequence[EpisodeRow]) -> Table:
    """Table of the main metrics by robot and family, and by level if a family has several."""
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
    """Table of the number of failed episodes by class."""
    methods = methods_of(rows)
    counts = {name: Counter(failure_class_of(row) for row in rows if row.method == name) for name in methods}
    lines = [(one, *(str(counts[name][one]) for name in methods)) for one in FAILURE_CLASSES]
    lines.append(("all failures", *(str(sum(counts[name][one] for one in FAILURE_CLASSES)) for name in methods)))
    return Table("Failures by class", ("class", *methods), tuple(lines), "by the first stage that failed")


def hypotheses_table(results: Sequence[HypothesisResult]) -> Table:
    """Table of the hypotheses, one row for each claim."""
    lines = [
        (f"{result.name}: {result.verdict}" if not index else "", *_claim_cells(claim))
        for result in results
        for index, claim in enumerate(result.claims)
    ]
    note = "by the rule of docs/reference/evaluation.md; effects and minima were fixed before the run"
    return Table("Hypotheses", ("hypothesis", *CLAIM_COLUMNS), tuple(lines), note)


def secondary_claims_table(claims: Sequence[Claim]) -> Table:
    """Table of the claims that follow the same rule but belong to no verdict."""
    lines = tuple((claim.hypothesis, *_claim_cells(claim)) for claim in claims)
    return Table("Secondary claims", ("rule of", *CLAIM_COLUMNS), lines, "by the same rule; part of no verdict")


CLAIM_COLUMNS = (
    "methods",
    "effect",
    "estimate",
    "95 %",
    "required",
    "verdict",
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
    """Table of the episodes per hour and core, and of the wall time by part.

    Medians are used because a suspended machine prolongs single episodes. In results from before 2026-11-24 the parts
    overlap, so an episode counts as at least as long as the sum of its parts.
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
    header = ("method", "episodes per hour and core", "simulated s per s", *WALL_TIME_PARTS)
    return Table(
        THROUGHPUT_TITLE,
        header,
        tuple(lines),
        "medians over episodes, shares as means; wall time on the machine of the run under its load; episodes with "
        "equal inputs ran once, and the plan pass is listed under decision times",
    )


def markdown_table(table: Table) -> list[str]:
    """Lines of Markdown: the title as a heading, the note, the table. Title and cells are escaped."""
    lines = [f"## {markdown.escape_markdown(table.title)}", ""]
    if table.note:
        lines += [f"{table.note[0].upper()}{table.note[1:]}.", ""]
    if not table.rows:
        return [*lines, "None.", ""]
    for header, rows in table.split_columns():
        head, *cells = ([markdown.escape_markdown(cell) for cell in row] for row in (header, *rows))
        lines += [*markdown.markdown_table(head, cells, pipe="|"), ""]
    return lines


def markdown_page(title: str, header_lines: Sequence[str], tables: Iterable[Table]) -> str:
    """A Markdown page: title, which is escaped, header lines, tables."""
    lines = [f"# {markdown.escape_markdown(title)}", "", *(f"{line}  " for line in header_lines), ""]
    for table in tables:
        lines += markdown_table(table)
    return "\n".join(lines)
