"""README page of a robot folder: bounds with provenance, sphere cover, link pairs, missing information."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dualbrain.core.markdown import markdown_table
from dualbrain.robots.importer.build_arm import is_identified
from dualbrain.robots.importer.output.diff import ModelChange
from dualbrain.robots.importer.report import ImportReport
from dualbrain.robots.model import Bound, RobotModel


def render_readme(robot_model: RobotModel, report: ImportReport, kept_edits: Sequence[ModelChange] = ()) -> str:
    """The page as Markdown; `kept_edits` are the user's edits."""
    sections = [
        f"# {robot_model.name}",
        f"From {robot_model.source}. Licence of the description: {robot_model.licence}.",
        "![Spheres](picture.png)",
        *_section("Missing information", [f"- {line}" for line in missing_information(robot_model, report)]),
        *_section("Edits", [f"- {change}" for change in kept_edits]),
        "## Bounds and their provenance",
        _bounds_table(robot_model),
        "## Sphere cover",
        _cover_table(report),
        "## Self-collision pairs",
        _pairs_section(robot_model),
        *_section("Notes", [f"- {note}" for note in report.notes]),
        "You may edit `body.json`: a second `dualbrain robot init` keeps the edits and reports its own changes. "
        "`dualbrain robot inspect --view` shows the model that the filter uses.",
    ]
    return "\n\n".join(sections) + "\n"


def missing_information(robot_model: RobotModel, report: ImportReport | None) -> list[str]:
    """Information without which the guarantee of the filter does not hold on this robot."""
    found: list[str] = []
    if not is_identified(robot_model.tracking):
        found.append(f"tracking model: {robot_model.tracking.provenance}")
    if robot_model.gripper.opening.value == 0.0 and robot_model.base == "fixed":
        reason = robot_model.gripper.opening.provenance
        found.append(f"gripper: none detected ({reason}), so no skill grasps; to add one, edit `gripper` in body.json")
    for link in robot_model.links:
        if not any(sphere.link == link.name for sphere in robot_model.spheres):
            found.append(f"spheres of {link.name!r}: none, because the description has no shape for it")
    for link in report.links if report else ():
        if link.coverage < 1.0:
            found.append(f"cover of {link.link!r}: {link.coverage:.2%} of its surface")
    overlapping = [f"{a}–{b}" for a, b, reason in robot_model.self_pairs.allowed if "overlap in all" in reason]
    if overlapping:
        found.append(f"pairs excluded because their spheres always overlap: {', '.join(overlapping)}")
    return found


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    return "\n".join(markdown_table(head, rows))


def _section(title: str, lines: list[str]) -> list[str]:
    return [f"## {title}", "\n".join(lines)] if lines else []


def bound_rows(robot_model: RobotModel) -> list[tuple[str, str, str, str]]:
    """(joint or "robot", name, value with unit, provenance) of every bound."""
    rows = [
        (joint.name, name, _format_bound(bound), bound.provenance)
        for joint in robot_model.joints
        for name in ("lower", "upper", "velocity", "acceleration", "jerk")
        if (bound := getattr(joint, name)) is not None
    ]
    gripper = robot_model.gripper
    gripper_bounds = (
        ("opening", gripper.opening),
        ("minimum grip force", gripper.force_min),
        ("maximum grip force", gripper.force),
    )
    robot_bounds = (
        ("tool speed", robot_model.tool_speed),
        ("gain α", robot_model.gain),
        *(gripper_bounds if gripper.opening.value else ()),
    )
    return [
        *rows,
        *_force_sensing_rows(robot_model),
        *(("robot", name, _format_bound(bound), bound.provenance) for name, bound in robot_bounds if bound is not None),
    ]


def _force_sensing_rows(robot_model: RobotModel) -> list[tuple[str, str, str, str]]:
    """The force sensor with its errors, and the masses that its evaluation needs."""
    sensing, dynamics = robot_model.force_sensing, robot_model.dynamics
    if sensing is None:
        none = "contact forces are not supervised: add force_sensing and dynamics to the model"
        return [("robot", "force sensing", "none", none)]
    units = "Nm" if sensing.kind == "motor_torques" else "N, Nm"
    rows = [
        ("robot", "force sensing", sensing.kind.replace("_", " "), sensing.provenance),
        *(
            ("robot", f"force sensing, {name}", f"{_format_values(values)} {units}", sensing.provenance)
            for name, values in (("noise (σ)", sensing.noise), ("constant error", sensing.accuracy))
        ),
    ]
    if dynamics is not None:
        mass = sum(body.mass for body in dynamics.bodies)
        rows.append(("robot", "moved mass", f"{mass:.2f} kg", dynamics.provenance))
        rows.append(("robot", "payload", _format_bound(dynamics.payload), dynamics.payload.provenance))
    return rows


def _format_values(values: Sequence[float]) -> str:
    """Numbers in one cell; a single one if all are equal."""
    return f"{values[0]:g}" if len(set(values)) == 1 else ", ".join(f"{value:g}" for value in values)


def _format_bound(bound: Bound) -> str:
    return f"{bound.value:g} {bound.unit}"


def _bounds_table(robot_model: RobotModel) -> str:
    return _table(("joint", "bound", "value", "provenance"), bound_rows(robot_model))


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
    head = ("link", "group", "spheres", "convex parts", "surface covered", "excess mean [mm]", "95 %", "worst")
    text = f"Effort: {report.effort}. The excess is the distance of the spheres from the shapes of the description."
    return f"{text}\n\n{_table(head, rows)}"


def _pairs_section(robot_model: RobotModel) -> str:
    kept = ", ".join(f"{a}–{b}" for a, b in robot_model.self_pairs.kept) or "none"
    rows = [pair for pair in robot_model.self_pairs.allowed if pair[2] not in ("adjacent", "rigidly connected")]
    excluded = (
        _table(("link", "link", "reason for the exclusion"), rows)
        if rows
        else "No pair is excluded except adjacent links."
    )
    return f"{len(robot_model.self_pairs.kept)} kept apart: {kept}.\n\n{excluded}"
