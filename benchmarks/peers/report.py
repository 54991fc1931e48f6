"""Render docs/reference/verification/peers.md from the results of a run."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dualbrain.core.markdown import markdown_table

INTRODUCTION_FILE = Path(__file__).with_name("report_introduction.md")


LATENCY_TEXT = """## Latency of one step

Median and p99 of wall time in µs, and ratio of the medians to `dualbrain` in the same unit. *processor* is the median
over blocks of the mean processor time of a step [µs]. On a busy machine, steps of milliseconds are interrupted and
steps of microseconds are not; medians above a millisecond, and all p99, therefore overestimate the cost of a step."""


def write_report(whole: dict[str, Any], path: Path) -> None:
    """Write the document to `path`."""
    parts = [
        INTRODUCTION_FILE.read_text(),
        _provenance(whole),
        _targets(whole),
        _latency_tables(whole),
        _first_calls(whole),
        _deviation(whole),
    ]
    parts += [_infeasible(whole), _clearance(whole), _unavailable(whole), _versions(whole)]
    path.write_text("\n\n".join(part.strip() for part in parts if part) + "\n")


def _markdown_table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    return "\n".join(markdown_table(list(head), map(list, rows)))


def _provenance(whole: dict[str, Any]) -> str:
    units = whole["units"]
    revisions = sorted({unit["revision"] for unit in units})
    kernels = sorted({unit["kernel"] for unit in units})
    dates = sorted({unit["date"] for unit in units})
    loads = ", ".join(f"{unit['unit']} {unit['load']:.1f}" for unit in units if unit["pairs"])
    return (
        f"*Measured {' to '.join(dates[:1] + dates[1:][-1:])}, revision {', '.join(revisions)}, kernel "
        f"{', '.join(kernels)}; {units[0]['machine']}. Load average at the start of each size: {loads}. "
        f"Rendered {datetime.now(UTC).date().isoformat()}.*"
    )


def _targets(whole: dict[str, Any]) -> str:
    lines = [
        (
            one["target"],
            f"{one['required']:g}",
            f"{one['reached']:.1f}",
            "met" if one["met"] else "**missed**",
            one["by"],
        )
        for one in whole["targets"]
    ]
    return "## Targets\n\nSet before the measurement; ratios of medians to that of dualbrain.\n\n" + _markdown_table(
        ("target", "required", "reached", "", "filter"), lines
    )


def _latency_tables(whole: dict[str, Any]) -> str:
    parts = [LATENCY_TEXT]
    for unit in whole["units"]:
        setting, _, n = unit["unit"].partition(":")
        rows = [row for row in whole["rows"] if row["setting"] == setting and str(row["n"]) == n]
        if not rows:
            continue
        lines = [
            (
                row["peer"],
                f"{row['median_us']:.1f}",
                f"{row['p99_us']:.1f}",
                "" if "processor_us" not in row else f"{row['processor_us']:.1f}",
                "" if row["ratio"] is None else f"{row['ratio']:.1f}",
                _rows_in_qp(row),
                row["samples"],
                row["failed"] or "",
            )
            for row in sorted(rows, key=lambda row: row["median_us"])
        ]
        parts.append(
            f"### {n} {setting}\n\n{unit['pairs']} pairs of a sphere and an obstacle; the exact filter changes "
            f"{100 * unit['changed_share']:.0f} % of the recorded steps.\n\n"
            + _markdown_table(
                ("filter", "median", "p99", "processor", "ratio", "rows in QP", "samples", "failed"), lines
            )
        )
    return "\n\n".join(parts)


def _rows_in_qp(row: dict[str, Any]) -> str:
    evaluated = row["evaluated"]
    text = str(evaluated.get("rows_in_qp", ""))
    if evaluated.get("pairs_wanted", 0) > evaluated.get("pairs", 0):
        text += f" ({evaluated['pairs']} of {evaluated['pairs_wanted']} pairs; the others are dropped)"
    return text


def _first_calls(whole: dict[str, Any]) -> str:
    found = [one for one in whole["first_call"] if one["setting"] == "rows"]
    sizes = sorted({one["n"] for one in found})
    peers = list(dict.fromkeys(one["peer"] for one in found))
    total = {(one["peer"], one["n"]): _seconds(one) for one in found}
    lines = [(peer, *(total.get((peer, n), "") for n in sizes)) for peer in peers]
    return (
        "## First call\n\nProcessor time in seconds from the imported library to the first answer: construction of the "
        "filter and, for JAX, tracing and compilation, which is repeated for every number of rows. Wall time in "
        "parentheses.\n\n" + _markdown_table(("filter", *(f"{n} rows" for n in sizes)), lines)
    )


def _seconds(one: dict[str, Any]) -> str:
    return f"{one['processor_s']:.2g} ({one['prepare_s'] + one['first_s']:.2g})"


def _deviation(whole: dict[str, Any]) -> str:
    lines = [
        (
            one["peer"],
            one["n"],
            _format_small(one["max"]),
            _format_small(one["median"]),
            _format_small(one["max_on_own_rows"]),
            _format_small(one["worst_row_violation"]),
            f"{one['changed_all_the_same']} of {one['nothing_to_do']}",
            one["no_answer"] or "",
        )
        for one in whole["deviation"]
    ]
    return (
        "## Deviation from the exact optimum\n\nLargest and median |u − u\\*|∞ [rad/s] from the solution of DAQP in "
        "float64 with the plain rows (for dualbrain with its margin of 0.21 mm, but without the sampling term of its "
        "rows), and with the rows that dualbrain itself states. *row*: largest b − A u of the plain rows [m/s]; "
        "negative if all rows hold. *idle*: states with a safe u_nom in which u differs from it by more than 1e-4 "
        "rad/s.\n\n"
        + _markdown_table(("filter", "rows", "max", "median", "max on own rows", "row", "idle", "no answer"), lines)
    )


def _format_small(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}"


def _infeasible(whole: dict[str, Any]) -> str:
    cases = {one["case"]: one["what"] for one in whole["infeasible"]}
    peers = list(dict.fromkeys(one["peer"] for one in whole["infeasible"]))
    by_case = {(one["peer"], one["case"]): one for one in whole["infeasible"]}
    lines = [
        (peer, *(_describe_answer(by_case[peer, case]) if (peer, case) in by_case else "" for case in cases))
        for peer in peers
    ]
    return (
        "## Infeasible problems\n\n"
        + "\n".join(f"- *{case}*: {description}." for case, description in cases.items())
        + "\n\n*silent*: the filter returns a control and reports no failure. Inside an obstacle, mink requires only "
        "that h does not decrease, so the contradiction has a solution for it.\n\n"
        + _markdown_table(("filter", *cases), lines)
    )


def _describe_answer(one: dict[str, Any]) -> str:
    if one["report"].startswith("raised"):
        return one["report"]
    if not one["finite"]:
        return f"{one['report']}: u is NaN"
    answer = "u = u_nom" if one["is_nominal"] else f"max u {one['u_max']:.2g}"
    if not one["within_v_max"]:
        answer += " **above v_max**"
    return f"{one['report']}: {answer}"


def _clearance(whole: dict[str, Any]) -> str:
    if not whole["clearance"]:
        return ""
    lines = [
        (
            one["peer"],
            f"{one['alpha']:.2f}",
            f"{1e3 * one['h_min']:+.2f}",
            one["no_answer"] or "",
            f"{100 * one['followed_share']:.0f} %",
        )
        for one in whole["clearance"]
    ]
    steps = whole["clearance"][0]["steps"]
    return (
        "## Clearance under acceleration limits\n\nThe plant follows commands within the a_max of the Panda (no lag, "
        f"no noise). 50 rows, {steps} steps of 1 ms; the nominal control moves at full speed toward one of the nearest "
        "obstacles and changes every 150 ms. Each filter runs in its own loop with the same start and seeds. The table "
        "holds the smallest true h in mm; negative values are penetrations. dualbrain knows the limits. The peers run "
        "with α = min a/v, at which the plant can nearly follow a velocity-level filter, and α = 10, the value of the "
        "examples of oscbf. If a filter gives no answer, the plant brakes. *followed*: share of commands that the "
        "plant could follow.\n\n"
        + _markdown_table(("filter", "α [1/s]", "smallest h [mm]", "no answer", "followed"), lines)
    )


def _unavailable(whole: dict[str, Any]) -> str:
    if not whole["refused"]:
        return ""
    lines = [(one["peer"], one["setting"], one["n"], one["why"]) for one in whole["refused"]]
    note = "A timeout only shows that the machine was busy; it is no property of the filter."
    return f"## Filters that did not run\n\n{note}\n\n" + _markdown_table(("filter", "setting", "n", "reason"), lines)


def _versions(whole: dict[str, Any]) -> str:
    lines = [
        (peer, ", ".join(f"{name} {version}" for name, version in found.items()))
        for peer, found in whole["versions"].items()
    ]
    return "## Versions\n\n" + _markdown_table(("filter", "versions"), lines)
