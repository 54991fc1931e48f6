"""Tables of the experiment `speed_limits`."""

from __future__ import annotations

from experiments.engine.experiment import Row
from experiments.figures.tables import markdown_table
from experiments.safety.speed_limits.classes import COMPLETE_CLASSES, NEGATIVE_CONTROLS, SpeedClass
from experiments.safety.speed_limits.trial import STATUSES

USED = 0.97
"""Share of a limit from which a step counts as one that uses it."""


def speed_tables(totals: dict[str, Row]) -> list[str]:
    """The verdict, the classes, and the negative controls."""
    return [*_verdict(totals), "", *_class_table(totals), "", *_control_table(totals)]


def _verdict(totals: dict[str, Row]) -> list[str]:
    found = [totals[kind.name] for kind in COMPLETE_CLASSES if kind.name in totals]
    steps, above = sum(one["steps"] for one in found), sum(one["above"] for one in found)
    unreported, avoidable, jerks = (sum(one[name] for one in found) for name in ("unreported", "avoidable", "jerks"))
    return [
        f"**{steps:.3g}** steps: a part above its limit on {above} ({above / max(steps, 1):.1e}), on **{unreported}** "
        f"of them without a report, on {avoidable} of them although a control kept all limits; a joint above its jerk "
        f"limit on **{jerks}** (none: upper 95 % bound {3 / max(steps, 1):.1e})."
    ]


def _class_table(totals: dict[str, Row]) -> list[str]:
    head = (
        "class",
        "limits",
        "steps",
        "above",
        "unreported",
        "avoidable",
        f"steps above {USED:.0%} of the limit",
        "largest share of the limit",
    )
    head += ("steps near the person", "largest share of the jerk limit", "safe / modified / relaxed / stopped / fault")
    return markdown_table(head, [_class_cells(kind, totals) for kind in COMPLETE_CLASSES if kind.name in totals])


def _class_cells(kind: SpeedClass, totals: dict[str, Row]) -> tuple[object, ...]:
    one = totals[kind.name]
    return (
        kind.name,
        kind.description,
        f"{one['steps']:.3g}",
        one["above"],
        one["unreported"],
        one["avoidable"],
        f"{one['used'] / one['steps']:.1%}",
        f"{one['largest']:.5f}",
        f"{one['near'] / one['steps']:.1%}" if kind.near else "",
        f"{one['jerk']:.5f}" if kind.judges_jerk else "",
        " / ".join(f"{one[name] / one['steps']:.2%}" for name in STATUSES),
    )


def _control_table(totals: dict[str, Row]) -> list[str]:
    head = ("negative control", "removed element", "steps", "above", "jerk limit exceeded", "largest share", "verdict")
    return markdown_table(head, [_control_cells(kind, totals) for kind in NEGATIVE_CONTROLS if kind.name in totals])


def _control_cells(kind: SpeedClass, totals: dict[str, Row]) -> tuple[object, ...]:
    one = totals[kind.name]
    fails = one["above"] + one["jerks"] > 0
    verdict = "fails, as expected" if fails else "holds: the adversary is too weak"
    largest = max(one["largest"], one["jerk"])
    return (kind.name, kind.description, f"{one['steps']:.3g}", one["above"], one["jerks"], f"{largest:.3g}", verdict)
