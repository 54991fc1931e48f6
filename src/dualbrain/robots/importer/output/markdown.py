"""The page that stands beside a body for people: bounds with their provenance, cover, pairs, what is missing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dualbrain.robots.importer.build_arm import is_identified
from dualbrain.robots.importer.output.diff import Change
from dualbrain.robots.importer.report import Report
from dualbrain.robots.model import Body, Bound


def page(body: Body, report: Report, kept: Sequence[Change] = ()) -> str:
    """Markdown; `kept` are a person's edits."""
    parts = [
        f"# {body.name}", f"From {body.source}. Licence of the description: {body.licence}.",
        "![Spheres](picture.png)",
        *_section("Still missing", [f"- {line}" for line in gaps(body, report)]),
        *_section("Edited by hand", [f"- {change}" for change in kept]),
        "## Bounds and where they come from", _bounds(body), "## Cover", _cover(report),
        "## Pairs of parts that are kept apart", _pairs(body),
        *_section("Notes", [f"- {note}" for note in report.notes]),
        "Edit `body.json`; `dualbrain robot init` again keeps the edits and shows what it changed. "
        "`dualbrain robot inspect --view` shows what the filter sees.",
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def gaps(body: Body, report: Report | None) -> list[str]:
    """What the filter would have to be told for its promise to hold on this robot."""
    found: list[str] = []
    if not is_identified(body.tracking):
        found.append(f"tracking model: {body.tracking.provenance}")
    if body.gripper.opening.value == 0.0 and body.base == "fixed":
        why = body.gripper.opening.provenance
        found.append(f"gripper: none known ({why}), so no skill grasps (or edit `gripper` in body.json)")
    for link in body.links:
        if not any(sphere.link == link.name for sphere in body.spheres):
            found.append(f"spheres of {link.name!r}: none, the description gives it no shape")
    for link in report.links if report else ():
        if link.coverage < 1.0:
            found.append(f"cover of {link.link!r}: {link.coverage:.2%} of its surface")
    always = [f"{a}–{b}" for a, b, why in body.self_pairs.allowed if "overlap in all" in why]
    if always:
        found.append(f"pairs not kept apart because their spheres always overlap: {', '.join(always)}")
    return found


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "/") for cell in line) + " |" for line in lines)


def _section(title: str, lines: list[str]) -> list[str]:
    return [f"## {title}", "\n".join(lines)] if lines else []


def bound_rows(body: Body) -> list[tuple[str, str, str, str]]:
    """(joint, side, value with unit, provenance) of every bound."""
    rows = [
        (joint.name, side, _value(bound), bound.provenance)
        for joint in body.joints
        for side in ("lower", "upper", "velocity", "acceleration", "jerk")
        if (bound := getattr(joint, side)) is not None
    ]
    hand = body.gripper
    grip = (("opening", hand.opening), ("grip, least", hand.force_min), ("grip, greatest", hand.force))
    whole = (("tool speed", body.tool_speed), ("gain α", body.gain), *(grip if hand.opening.value else ()))
    return [*rows, *(("robot", side, _value(bound), bound.provenance) for side, bound in whole if bound is not None)]


def _value(bound: Bound) -> str:
    return f"{bound.value:g} {bound.unit}"


def _bounds(body: Body) -> str:
    return table(("joint", "bound", "value", "from"), bound_rows(body))


def _cover(report: Report) -> str:
    rows = [
        (link.link, link.group, link.spheres, link.parts, f"{link.coverage:.2%}", *(f"{length * 1e3:.1f}" for length in
         (link.mean, link.p95, link.worst)))
        for link in report.links
    ]  # fmt: skip
    head = ("part", "group", "spheres", "convex parts", "surface covered", "excess mean [mm]", "95 %", "worst")
    words = f"Effort: {report.effort}. Excess is how far the spheres stand off the description's own shapes."
    return f"{words}\n\n{table(head, rows)}"


def _pairs(body: Body) -> str:
    kept = ", ".join(f"{a}–{b}" for a, b in body.self_pairs.kept) or "none"
    rows = [pair for pair in body.self_pairs.allowed if pair[2] not in ("adjacent", "rigidly connected")]
    left = table(("part", "part", "why they are not kept apart"), rows) if rows else "None left out but neighbours."
    return f"{len(body.self_pairs.kept)} kept: {kept}.\n\n{left}"
