"""The page that stands beside a body for people: bounds with their provenance, cover, pairs, what is missing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dualbrain.robots.importer.build_arm import is_identified
from dualbrain.robots.importer.output.diff import ModelChange
from dualbrain.robots.importer.report import ImportReport
from dualbrain.robots.model import Bound, RobotModel


def render_readme(robot_model: RobotModel, report: ImportReport, kept_edits: Sequence[ModelChange] = ()) -> str:
    """Markdown; `kept` are a person's edits."""
    parts = [
        f"# {robot_model.name}",
        f"From {robot_model.source}. Licence of the description: {robot_model.licence}.",
        "![Spheres](picture.png)",
        *_section("Still missing", [f"- {line}" for line in missing_information(robot_model, report)]),
        *_section("Edited by hand", [f"- {change}" for change in kept_edits]),
        "## Bounds and where they come from",
        _bounds_table(robot_model),
        "## Cover",
        _cover_table(report),
        "## Pairs of parts that are kept apart",
        _pairs_section(robot_model),
        *_section("Notes", [f"- {note}" for note in report.notes]),
        "Edit `body.json`; `dualbrain robot init` again keeps the edits and shows what it changed. "
        "`dualbrain robot inspect --view` shows what the filter sees.",
    ]
    return "\n\n".join(parts) + "\n"


def missing_information(robot_model: RobotModel, report: ImportReport | None) -> list[str]:
    """What the filter would have to be told for its promise to hold on this robot."""
    found: list[str] = []
    if not is_identified(robot_model.tracking):
        found.append(f"tracking model: {robot_model.tracking.provenance}")
    if robot_model.gripper.opening.value == 0.0 and robot_model.base == "fixed":
        why = robot_model.gripper.opening.provenance
        found.append(f"gripper: none known ({why}), so no skill grasps (or edit `gripper` in body.json)")
    for link in robot_model.links:
        if not any(sphere.link == link.name for sphere in robot_model.spheres):
            found.append(f"spheres of {link.name!r}: none, the description gives it no shape")
    for link in report.links if report else ():
        if link.coverage < 1.0:
            found.append(f"cover of {link.link!r}: {link.coverage:.2%} of its surface")
    always = [f"{a}–{b}" for a, b, why in robot_model.self_pairs.allowed if "overlap in all" in why]
    if always:
        found.append(f"pairs not kept apart because their spheres always overlap: {', '.join(always)}")
    return found


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "/") for cell in line) + " |" for line in lines)


def _section(title: str, lines: list[str]) -> list[str]:
    return [f"## {title}", "\n".join(lines)] if lines else []


def bound_rows(robot_model: RobotModel) -> list[tuple[str, str, str, str]]:
    """(joint, side, value with unit, provenance) of every bound."""
    rows = [
        (joint.name, side, _format_bound(bound), bound.provenance)
        for joint in robot_model.joints
        for side in ("lower", "upper", "velocity", "acceleration", "jerk")
        if (bound := getattr(joint, side)) is not None
    ]
    hand = robot_model.gripper
    grip = (("opening", hand.opening), ("grip, least", hand.force_min), ("grip, greatest", hand.force))
    whole = (
        ("tool speed", robot_model.tool_speed),
        ("gain α", robot_model.gain),
        *(grip if hand.opening.value else ()),
    )
    return [
        *rows,
        *(("robot", side, _format_bound(bound), bound.provenance) for side, bound in whole if bound is not None),
    ]


def _format_bound(bound: Bound) -> str:
    return f"{bound.value:g} {bound.unit}"


def _bounds_table(robot_model: RobotModel) -> str:
    return markdown_table(("joint", "bound", "value", "from"), bound_rows(robot_model))


def _cover_table(report: ImportReport) -> str:
    rows = [
        (
            link.link,
            link.group,
            link.spheres,
            link.parts,
            f"{link.coverage:.2%}",
            *(f"{length * 1e3:.1f}" for length in (link.mean, link.p95, link.worst)),
        )
        for link in report.links
    ]
    head = ("part", "group", "spheres", "convex parts", "surface covered", "excess mean [mm]", "95 %", "worst")
    words = f"Effort: {report.effort}. Excess is how far the spheres stand off the description's own shapes."
    return f"{words}\n\n{markdown_table(head, rows)}"


def _pairs_section(robot_model: RobotModel) -> str:
    kept = ", ".join(f"{a}–{b}" for a, b in robot_model.self_pairs.kept) or "none"
    rows = [pair for pair in robot_model.self_pairs.allowed if pair[2] not in ("adjacent", "rigidly connected")]
    left = (
        markdown_table(("part", "part", "why they are not kept apart"), rows)
        if rows
        else "None left out but neighbours."
    )
    return f"{len(robot_model.self_pairs.kept)} kept: {kept}.\n\n{left}"
