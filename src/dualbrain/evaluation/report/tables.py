"""Results as tables of words: the same ones in Markdown, in HTML and on the screen."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import ceil, isfinite, isnan
from statistics import fmean, median

from dualbrain.evaluation.analysis.failure_taxonomy import CLASSES, class_of
from dualbrain.evaluation.analysis.hypotheses import Answer, Claim
from dualbrain.evaluation.analysis.metrics import BY_NAME, MAIN, Metric
from dualbrain.evaluation.analysis.severity import SAFETY, UNAUTHORISED
from dualbrain.evaluation.analysis.statistics import Clusters, Estimate, estimate
from dualbrain.evaluation.protocol.method import METHODS
from dualbrain.evaluation.report.captions import KINDS
from dualbrain.evaluation.results.episode_row import Row
from dualbrain.planner.prompt.prompt_format import NOTHING

NONE = "–"
PERCENT = ("rate", "share")
KEY = ("violation rate", "success", "Δ of successes", "intervention frequency")
"""The metrics that are told family by family."""
WALL = ("physics", "monitor", "filter", "planner", "rest")
"""Parts of an episode's wall time."""
ROUNDING = 1e-12
"""What is left of sums that cancel out is nothing."""
WALL_TIME = "wall time of a process that shares its processor"
MOST_COLUMNS = 11
"""Beside the names of the rows: as many as the table of hypotheses has."""


@dataclass(frozen=True, slots=True)
class Grid:
    """A table: its title, heads, rows of cells (the first cell of a row names it), and what to know of it."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def parts(self) -> list[tuple[tuple[str, ...], list[tuple[str, ...]]]]:
        """Heads and rows, side by side where a table is too wide to be read: each part begins with the rows' names."""
        count = max(1, ceil((len(self.head) - 1) / MOST_COLUMNS))
        wide = ceil((len(self.head) - 1) / count)
        return [
            (
                (self.head[0], *self.head[start : start + wide]),
                [(row[0], *row[start : start + wide]) for row in self.rows],
            )
            for start in range(1, len(self.head), wide)
        ]


def methods_of(rows: Sequence[Row]) -> tuple[str, ...]:
    """The methods that flew, in the order of the main table."""
    flown = {row.method for row in rows}
    return tuple(name for name in METHODS if name in flown)


def by_cluster(rows: Sequence[Row], metric: Metric) -> Clusters:
    """The metric's values by cluster."""
    found: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        value = metric.of(row)
        if value is not None:
            found[row.cluster].append(value)
    return found


def measured(rows: Sequence[Row], method: str, metric: str) -> Estimate:
    """One metric of one method."""
    chosen = BY_NAME[metric]
    return estimate(by_cluster([row for row in rows if row.method == method], chosen), rate=chosen.unit == "rate")


def number(value: float, unit: str = "") -> str:
    """A number with as many digits as people read; shares in percent."""
    if isnan(value):
        return NONE
    if not isfinite(value):
        return "∞" if value > 0 else "−∞"
    value = 0.0 if abs(value) < ROUNDING else value
    text = f"{100.0 * value:.1f} %" if unit in PERCENT else f"{value:.3g}"
    return text.replace("-", "−")


def cell(found: Estimate, unit: str) -> str:
    """Mean ± standard deviation [95 % interval]."""
    if not found.n:
        return NONE
    low, high = (number(end, unit).removesuffix(" %") for end in (found.low, found.high))
    spread = "" if unit in PERCENT else f" ± {number(found.sd, unit)}"
    interval = f" [{low}, {high}]" if isfinite(found.low + found.high) else ""
    return f"{number(found.mean, unit)}{spread}{interval}"


def overview(rows: Sequence[Row]) -> Grid:
    """Every metric of every method."""
    methods = methods_of(rows)
    counts = Counter(row.method for row in rows)
    clusters = {name: len({row.cluster for row in rows if row.method == name}) for name in methods}
    lines = [("episodes (clusters)", *(f"{counts[name]} ({clusters[name]})" for name in methods))]
    for name in MAIN:
        unit = BY_NAME[name].unit
        label = name if unit in (*PERCENT, "1") else f"{name} [{unit}]"
        lines.append((label, *(cell(measured(rows, method, name), unit) for method in methods)))
    note = (
        "mean ± standard deviation [95 % interval over clusters, none from a single one]; – : nothing to measure; "
        f"gate time and filter step are {WALL_TIME}"
    )
    return Grid("Methods and metrics", ("metric", *methods), tuple(lines), note)


def violations(rows: Sequence[Row]) -> Grid:
    """The violation rate by kind."""
    methods = methods_of(rows)
    others = sorted({v.kind for row in rows for v in row.violations} - set(SAFETY))
    lines = [(KINDS[kind], *_shares_of(rows, methods, kind)) for kind in SAFETY]
    for kind in others:
        told = [[row for row in rows if row.method == method] for method in methods]
        shares = [sum(any(v.kind == kind for v in row.violations) for row in some) / len(some) for some in told]
        lines.append((f"{KINDS.get(kind, kind)} (beside the rate)", *(number(share, "share") for share in shares)))
    note = "on simulator truth, by the monitor"
    if any(NONE in line for line in lines):
        note += f"; {NONE} : a grammar bound every answer, so that no skill could be called that nobody holds"
    return Grid("Violations by kind", ("episodes with", *methods), tuple(lines), note)


def _shares_of(rows: Sequence[Row], methods: Sequence[str], kind: str) -> list[str]:
    """The share of episodes with a violation of `kind`; a dash where none could be."""
    return [
        NONE if kind == UNAUTHORISED and _bound(rows, method) else cell(measured(rows, method, kind), "rate")
        for method in methods
    ]


def _bound(rows: Sequence[Row], method: str) -> bool:
    """Whether every answer that `method` got was bound by a grammar while it was written."""
    by = [row.constrained_by for row in rows if row.method == method]
    return all(one and not one.startswith(NOTHING) for one in by)


def families(rows: Sequence[Row]) -> Grid:
    """The main metrics, family by family, and level by level where a family has several."""
    methods = methods_of(rows)
    groups: dict[str, list[Row]] = {}
    for row in sorted(rows, key=lambda row: (row.robot, row.task)):
        groups.setdefault(f"{row.robot} {row.task.split()[0]}", []).append(row)
    lines: list[tuple[str, ...]] = []
    for family, some in groups.items():
        tasks = sorted({row.task for row in some})
        parts = [(f"{some[0].robot} {task}", [row for row in some if row.task == task]) for task in tasks]
        for label, here in parts if len(parts) == 1 else [(family, some), *parts]:
            lines += [(f"{label}: {name}", *_cells(here, methods, name)) for name in KEY]
    return Grid("By robot and family", ("", *methods), tuple(lines))


def _cells(rows: Sequence[Row], methods: Sequence[str], name: str) -> list[str]:
    return [cell(measured(rows, method, name), BY_NAME[name].unit) for method in methods]


def failures(rows: Sequence[Row]) -> Grid:
    """How many episodes failed, by class."""
    methods = methods_of(rows)
    counts = {name: Counter(class_of(row) for row in rows if row.method == name) for name in methods}
    lines = [(one, *(str(counts[name][one]) for name in methods)) for one in CLASSES]
    lines.append(("all failures", *(str(sum(counts[name][one] for one in CLASSES)) for name in methods)))
    return Grid("Failures by class", ("class", *methods), tuple(lines), "by the first stage that failed")


def verdicts(told: Sequence[Answer]) -> Grid:
    """The hypotheses claim by claim."""
    lines = [
        (f"{answer.name}: {answer.verdict}" if not index else "", *_claim(claim))
        for answer in told for index, claim in enumerate(answer.claims)
    ]  # fmt: skip
    note = "by the rule of docs/evaluation.md; the effects and the least that counts stood before the run"
    return Grid("Hypotheses", ("hypothesis", *CLAIM), tuple(lines), note)


def beside_verdicts(told: Sequence[Claim]) -> Grid:
    """What was asked of the same rule and decides no hypothesis."""
    lines = tuple((claim.hypothesis, *_claim(claim)) for claim in told)
    return Grid("Beside the hypotheses", ("like", *CLAIM), lines, "by the same rule; part of no verdict")


CLAIM = ("methods", "effect", "found", "95 %", "wanted", "claim", "p (Holm)", "p (Wilcoxon)", "d_z", "rank-biserial",
         "clusters")  # fmt: skip


def _claim(claim: Claim) -> tuple[str, ...]:
    found = claim.found
    return (
        f"{claim.a} against {claim.b}", f"{claim.effect} of {claim.quantity}", number(found.effect),
        f"[{number(found.low)}, {number(found.high)}]",
        f"{'at most' if claim.side < 0 else 'at least'} {claim.minimum:g}", claim.verdict, number(claim.p),
        number(found.wilcoxon), number(found.dz), number(found.rank_biserial), str(found.clusters),
    )  # fmt: skip


def throughput(rows: Sequence[Row]) -> Grid:
    """Wall time by part, and episodes an hour and core; an episode that stood still with its machine moves no median.

    In tables of before 2026-11-24 parts overlap, and what was asked aside was subtracted whole: there an episode takes
    at least as long as its parts.
    """
    lines: list[tuple[str, ...]] = []
    own = [row for row in rows if not row.same_as]
    for name in methods_of(own):
        here = [row for row in own if row.method == name]
        walls = [max(row.wall_s, sum(row.wall.values())) for row in here]
        shares = (fmean(row.wall.get(part, 0.0) / wall for row, wall in zip(here, walls, strict=True)) for part in WALL)
        pace = median(row.simulated_s / wall for row, wall in zip(here, walls, strict=True))
        lines.append((name, f"{3600.0 / median(walls):.0f}", f"{pace:.2f}", *(number(one, "share") for one in shares)))
    head = ("method", "episodes an hour and core", "simulated s per s", *WALL)
    return Grid(
        "Throughput",
        head,
        tuple(lines),
        "by the median episode, shares as means over episodes; wall time on the machine that flew, whatever else ran "
        "there; what was alike in every input was flown once, and what was asked beforehand stands under decisions",
    )


def grid_lines(grid: Grid) -> list[str]:
    """One table under its title."""
    lines = [f"## {grid.title}", ""]
    if grid.note:
        lines += [f"{grid.note[0].upper()}{grid.note[1:]}.", ""]
    if not grid.rows:
        return [*lines, "None.", ""]
    for head, rows in grid.parts():
        lines += [_line(head), _line(["---"] * len(head)), *map(_line, rows), ""]
    return lines


def page(title: str, about: Sequence[str], grids: Iterable[Grid]) -> str:
    """A whole page."""
    lines = [f"# {title}", "", *(f"{line}  " for line in about), ""]
    for grid in grids:
        lines += grid_lines(grid)
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
