"""Render docs/reference/verification/peers.md from a run's figures."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

INTRODUCTION_FILE = Path(__file__).with_name("introduction.md")


LATENCY_TEXT = """## Latency of one step

Median and p99 in µs of time that passed, ratio of medians over `dualbrain` in the same unit. *processor* is the median
over blocks of the mean processor time of a step [µs]: on a busy machine a step of milliseconds is interrupted and one
of microseconds is not, so that medians beyond a millisecond, and all p99, overstate what the step costs."""


def write_report(whole: dict[str, Any], path: Path) -> None:
    """Write the document of a run to `path`."""
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


def _markdown_table(head: Iterable[str], lines: Iterable[Iterable[object]]) -> str:
    head = list(head)
    body = ["| " + " | ".join(str(cell) for cell in line) + " |" for line in lines]
    return "\n".join(["| " + " | ".join(head) + " |", "|" + " --- |" * len(head), *body])


def _provenance(whole: dict[str, Any]) -> str:
    units = whole["units"]
    revisions = sorted({unit["revision"] for unit in units})
    kernels = sorted({unit["kernel"] for unit in units})
    dates = sorted({unit["date"] for unit in units})
    loads = ", ".join(f"{unit['unit']} {unit['load']:.1f}" for unit in units if unit["pairs"])
    return (
        f"*Measured {' to '.join(dates[:1] + dates[1:][-1:])}, revision {', '.join(revisions)}, kernel "
        f"{', '.join(kernels)}; {units[0]['machine']}. Load average when each size began: {loads}. "
        f"Rendered {datetime.now(UTC).date().isoformat()}.*"
    )


def _targets(whole: dict[str, Any]) -> str:
    lines = [
        (bar["bar"], f"{bar['wanted']:g}", f"{bar['reached']:.1f}", "met" if bar["met"] else "**missed**", bar["by"])
        for bar in whole["bars"]
    ]
    return "## Bars\n\nSet before measuring; ratios of medians over ours.\n\n" + _markdown_table(
        ("bar", "wanted", "reached", "", "by"), lines
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
                ("contestant", "median", "p99", "processor", "ratio", "rows in QP", "samples", "failed"), lines
            )
        )
    return "\n\n".join(parts)


def _rows_in_qp(row: dict[str, Any]) -> str:
    evaluated = row["evaluated"]
    text = str(evaluated.get("rows_in_qp", ""))
    if evaluated.get("pairs_wanted", 0) > evaluated.get("pairs", 0):
        text += f" ({evaluated['pairs']} of {evaluated['pairs_wanted']} pairs: the others are dropped)"
    return text


def _first_calls(whole: dict[str, Any]) -> str:
    found = [one for one in whole["first_call"] if one["setting"] == "rows"]
    sizes = sorted({one["n"] for one in found})
    peers = list(dict.fromkeys(one["peer"] for one in found))
    total = {(one["peer"], one["n"]): _seconds(one) for one in found}
    lines = [(peer, *(total.get((peer, n), "") for n in sizes)) for peer in peers]
    return (
        "## First call\n\nSeconds from the imported library to the first answer: building the filter and, for JAX, "
        "tracing and compiling (again for every number of rows); in brackets the processor time, as the machine is "
        "shared.\n\n" + _markdown_table(("contestant", *(f"{n} rows" for n in sizes)), lines)
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
        "## Deviation from the exact optimum\n\nLargest and median |u − u\\*|∞ [rad/s] against DAQP in float64 on the "
        "plain rows (for ours with its margin of 0.21 mm, but without the sampling term of its rows), and on the rows "
        "that ours itself states. *Row* is the worst b − A u of the plain rows [m/s], negative where all hold. *Idle* "
        "counts states where u_nom was safe and u moved by more than 1e-4 rad/s all the same.\n\n"
        + _markdown_table(("contestant", "rows", "max", "median", "max on own rows", "row", "idle", "no answer"), lines)
    )


def _format_small(value: float | None) -> str:
    return "" if value is None else f"{value:.1e}"


def _infeasible(whole: dict[str, Any]) -> str:
    cases = {one["case"]: one["what"] for one in whole["infeasible"]}
    peers = list(dict.fromkeys(one["peer"] for one in whole["infeasible"]))
    by = {(one["peer"], one["case"]): one for one in whole["infeasible"]}
    lines = [
        (peer, *(_describe_answer(by[peer, case]) if (peer, case) in by else "" for case in cases)) for peer in peers
    ]
    return (
        "## Where there is no answer\n\n"
        + "\n".join(f"- *{case}*: {what}." for case, what in cases.items())
        + "\n\n*silent*: a control came back and nothing says that it is none. Inside an obstacle mink asks only that "
        "h does not shrink, so that the contradiction has an answer for it.\n\n"
        + _markdown_table(("contestant", *cases), lines)
    )


def _describe_answer(one: dict[str, Any]) -> str:
    if one["said"].startswith("raised"):
        return one["said"]
    if not one["finite"]:
        return f"{one['said']}: u is NaN"
    what = "u is the nominal" if one["is_nominal"] else f"max u {one['u_max']:.2g}"
    if not one["within_v_max"]:
        what += " **beyond v_max**"
    return f"{one['said']}: {what}"


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
        "## Clearance under acceleration limits\n\nA plant that follows commands as far as Panda's a_max allows (no "
        f"lag, no noise), 50 rows, {steps} steps of 1 ms, a nominal at full speed toward one of the nearest obstacles, "
        "changed every 150 ms; each contestant in its own loop from the same start and seeds. Least true h in mm: "
        "negative is penetration. Ours knows the limits; peers get α = min a/v, with which a velocity-level filter can "
        "nearly be followed, and α = 10, the value of oscbf's examples. A missing answer brakes. *Followed*: share of "
        "commands that the plant could follow.\n\n"
        + _markdown_table(("contestant", "α [1/s]", "least h [mm]", "no answer", "followed"), lines)
    )


def _unavailable(whole: dict[str, Any]) -> str:
    if not whole["refused"]:
        return ""
    lines = [(one["peer"], one["setting"], one["n"], one["why"]) for one in whole["refused"]]
    why = "Where no answer came in time, this machine was busy; it says nothing else about the contestant."
    return f"## Who did not take part\n\n{why}\n\n" + _markdown_table(("contestant", "setting", "n", "why"), lines)


def _versions(whole: dict[str, Any]) -> str:
    lines = [
        (peer, ", ".join(f"{name} {version}" for name, version in found.items()))
        for peer, found in whole["versions"].items()
    ]
    return "## Versions\n\n" + _markdown_table(("contestant", "versions"), lines)
