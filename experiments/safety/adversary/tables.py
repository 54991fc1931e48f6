"""Tables of the experiment `adversary`."""

from __future__ import annotations

from typing import Any

from experiments.figures.tables import markdown_table
from experiments.safety.adversary.classes import CLASSES, MOVING_CLASSES, NEGATIVE_CONTROLS, STATIC_CLASSES

PREMISES = ("feasible", "fresh", "on time", "certified")
STATUSES = ("safe", "modified", "relaxed", "stopped", "fault")
MAX_STOPPED_SHARE = 1e-3
"""Largest accepted share of STOPPED steps in static scenes."""


def adversary_tables(totals: dict[str, dict[str, Any]]) -> list[str]:
    """All tables about the classes in `totals`."""
    static = [kind.name for kind in STATIC_CLASSES if kind.name in totals]
    moving = [kind.name for kind in MOVING_CLASSES if kind.name in totals]
    controls = [kind.name for kind in NEGATIVE_CONTROLS if kind.name in totals]
    return [
        *_verdict(totals, static, moving),
        "",
        *_static(totals, static),
        *_moving(totals, moving),
        *_premises(totals, [*static, *moving]),
        *_causes(totals, [*static, *moving]),
        *_controls(totals, controls),
    ]


def count_violations(total: dict[str, Any]) -> int:
    """Steps with true h < 0 at static obstacles, own links or joint limits, and the robot's at moving obstacles."""
    return sum(total["still"]) + sum(map(sum, total["moving"]))


def _verdict(totals: dict[str, Any], static: list[str], moving: list[str]) -> list[str]:
    steps = sum(totals[name]["steps"] for name in static)
    below = sum(sum(totals[name]["still"]) for name in static)
    stopped = sum(totals[name]["status"][3] for name in static)
    every = sum(totals[name]["steps"] for name in [*static, *moving])
    share = stopped / max(steps, 1)
    return [
        f"Steps with every sphere of the arm: **{every:.3g}**, of them {steps:.3g} among static obstacles only. "
        f"Static: true h below zero on **{below}** steps (if none, upper 95 % bound {3 / max(steps, 1):.1e}); "
        f"STOPPED on {share:.2%} (limit {MAX_STOPPED_SHARE:.1%}: {'met' if share <= MAX_STOPPED_SHARE else 'not met'})."
    ]


def _static(totals: dict[str, Any], names: list[str]) -> list[str]:
    def cells(name: str) -> tuple[object, ...]:
        t = totals[name]
        shares = " / ".join(f"{count / t['steps']:.2%}" for count in t["status"])
        least = f"{t['h_still'] * 1e3:.3f} / {t['h_self'] * 1e3:.3f} mm, {t['h_joint'] * 1e3:.3f} mrad"
        return (
            name,
            CLASSES[name].description,
            f"{t['steps']:.3g}",
            sum(t["still"]),
            least,
            shares,
            t["most_iterations"],
            t["most_rows"],
            t["jerks"],
        )

    head = (
        "class",
        "errors",
        "steps",
        "h < 0",
        "smallest h: obstacles / own links, joints",
        " / ".join(STATUSES),
        "most iterations",
        "most rows",
        "acceleration limit exceeded",
    )
    return markdown_table(head, map(cells, names)) if names else []


def _moving(totals: dict[str, Any], names: list[str]) -> list[str]:
    """By the oracle's result for the moving obstacle's plan, not by the intention of the class."""

    def cells(name: str, at: int) -> tuple[object, ...]:
        t = totals[name]
        steps = max(t["attacked"][at], 1)
        return (
            name,
            ("no escape found", "an escape existed")[at],
            t["plans"][at],
            f"{t['attacked'][at]:.3g}",
            f"{t['touched'][at]} ({t['touched'][at] / steps:.1e})",
            f"{sum(t['moving'][at])} ({sum(t['moving'][at]) / steps:.1e})",
            t["contacts"][at],
            t["approaching"][at],
            f"{max(t['approach'][at], 0.0) * 1e3:.1f} mm/s",
            f"{sum(t['still'])} ({sum(t['still']) / t['steps']:.1e})" if at == 0 else "",
        )

    head = (
        "class",
        "oracle",
        "plans",
        "steps",
        "steps h < 0",
        "robot's violations",
        "contacts",
        "contacts while approaching",
        "fastest own approach",
        "static h < 0 (class)",
    )
    rows = [cells(name, at) for name in names for at in (1, 0) if totals[name]["plans"][at]]
    return markdown_table(head, rows) if rows else []


def _premises(totals: dict[str, Any], names: list[str]) -> list[str]:
    rows = [(name, *(f"{count / totals[name]['steps']:.3%}" for count in totals[name]["held"])) for name in names]
    return ["Share of steps on which each premise held:", "", *markdown_table(("class", *PREMISES, "all four"), rows)]


def _causes(totals: dict[str, Any], names: list[str]) -> list[str]:
    """The cause of a violation: the premises that failed since every h was last above 1 cm."""
    rows = []
    for mask in range(16):
        counts = [
            (name, totals[name]["still"][mask], totals[name]["moving"][0][mask] + totals[name]["moving"][1][mask])
            for name in names
        ]
        failed = ", ".join(word for bit, word in enumerate(PREMISES) if mask >> bit & 1) or "none"
        rows += [(failed, name, still, moved) for name, still, moved in counts if still or moved]
    if not rows:
        return ["Violations by the premise that failed: none.", ""]
    head = ("premises that failed", "class", "static h < 0 [steps]", "moving, robot's [steps]")
    return ["Violations by the premise that failed:", "", *markdown_table(head, rows)]


def _control_verdict(*, holds: bool, is_covered: bool) -> str:
    if holds:
        return "holds, as expected" if is_covered else "HOLDS"
    return "FAILS" if is_covered else "fails, as expected"


def _controls(totals: dict[str, Any], names: list[str]) -> list[str]:
    """Each control is a class with one element removed; the factor compares it with the complete class."""

    def cells(name: str) -> tuple[object, ...]:
        control, base = totals[name], totals.get(CLASSES[name].compared_with)
        rate = count_violations(control) / control["steps"]
        bound = max(count_violations(base), 3) / base["steps"] if base else float("nan")
        depth = min(control["h_still"], *control["h_moving"]) * 1e3
        return (
            name,
            CLASSES[name].description,
            f"{control['steps']:.3g}",
            f"{rate:.2e}",
            f"{depth:.1f} mm",
            f">= {rate / bound:.0f} times {CLASSES[name].compared_with}",
            _control_verdict(holds=rate == 0, is_covered=CLASSES[name].is_covered),
        )

    head = ("negative control", "removed element", "steps", "share of violations", "deepest", "factor", "verdict")
    return markdown_table(head, map(cells, names)) if names else []
