"""Pages of the evidence as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dualbrain.core.markdown import markdown_table
from dualbrain.core.text import count_noun
from dualbrain.evaluation.evidence.copied_documents import read_figures
from dualbrain.evaluation.evidence.requirement import Equipment, Requirement, read_hazards, read_requirements
from dualbrain.evaluation.evidence.site_measures import NO_SITE, describe_site_measure, list_entries
from dualbrain.evaluation.evidence.subject import Subject
from dualbrain.evaluation.evidence.test_report import RequirementStatus, TestReport, requirement_status
from dualbrain.robots.importer.output.markdown import bound_rows, missing_information
from dualbrain.robots.model import RobotModel

NO_REPORT: RequirementStatus = "no test report"


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayedRun:
    """A run that was recomputed: recording, robot, kernel hash, SHA-256, number of controls, comparison in words."""

    recording: str
    controls: int
    comparison: str
    identical: bool
    robot: str
    kernel: str
    sha256: str


def requirement_statuses(report: TestReport | None, robot_model: RobotModel) -> dict[str, RequirementStatus]:
    """Status of each requirement by id; "not applicable" without the equipment that it needs."""
    missing = missing_equipment(robot_model)
    return {name: _status(one, report, missing) for name, one in read_requirements().items()}


def missing_equipment(robot_model: RobotModel) -> set[Equipment]:
    """Equipment that the robot does not have."""
    present: dict[Equipment, bool] = {
        "force sensing": robot_model.force_sensing is not None,
        "gripper": robot_model.gripper.opening.value > 0,
    }
    return {name for name, has in present.items() if not has}


def _status(one: Requirement, report: TestReport | None, missing: set[Equipment]) -> RequirementStatus:
    if one.needs in missing:
        return "not applicable"
    return NO_REPORT if report is None else requirement_status(report.status(test) for test in one.tests)


def hazard_log(subject: Subject, statuses: Mapping[str, RequirementStatus]) -> str:
    """One section per hazard: cause, measures, the state at this site, requirements with status, remaining hazard."""
    lines = [
        "# Hazard log",
        "",
        "Hazards that the software addresses, and those that it does not. The log rates no risk: severity, exposure "
        "and avoidability depend on the installation, and belong to its risk assessment. Hazards of the robot itself, "
        "of its tool and of its surroundings (electrical, thermal, noise …) are not part of the log.",
    ]
    for name, one in read_hazards().items():
        rows = [
            ("cause", one.cause),
            ("measures", one.measures),
            *(
                [("at this site", describe_site_measure(one.site, subject.site, subject.robot_model, subject.record))]
                if one.site
                else []
            ),
            ("requirements", ", ".join(f"{key} ({statuses[key]})" for key in one.requirements) or "none"),
            ("remaining hazard", one.residual),
            ("severity, exposure, avoidability", "to be assessed at the installation"),
        ]
        lines += ["", f"## {name} {one.hazard}", "", *markdown_table(("", ""), rows)]
    return _page(lines)


def requirement_trace(report: TestReport | None, statuses: Mapping[str, RequirementStatus]) -> str:
    """Every requirement with its code, its tests with their results, and its experiments."""
    lines = ["# Requirements, tests and results", "", _trace_note(report)]
    summary = [(name, one.statement, statuses[name]) for name, one in read_requirements().items()]
    lines += ["", *markdown_table(("id", "requirement", "tests"), summary)]
    for name, one in read_requirements().items():
        lines += ["", f"## {name}", "", one.statement, "", *_reference_table(one, report)]
        lines += ["", f"Robots of the tests: {', '.join(one.robots) or 'none'}."]
    return _page(lines)


def _trace_note(report: TestReport | None) -> str:
    if report is None:
        return (
            "No test report was given, so no requirement has a result. `make evidence` runs the tests and includes it."
        )
    began = ", ".join(time for time in report.began if time) or "not stated"
    return (
        f"Results are those of the test report (began: {began}), which is included. It does not name the revision that "
        "was tested; it must come from the same revision as this package. *incomplete*: a test was skipped, or is not "
        "in the report. *not applicable*: the robot lacks the equipment. The number of cases is that in the report: "
        "parameters of a test that are missing from the report are not noticed."
    )


def _reference_table(one: Requirement, report: TestReport | None) -> list[str]:
    rows = [("code", f"src/dualbrain/{path}", "") for path in one.code]
    rows += [("test", test, _test_result(test, report)) for test in one.tests]
    rows += [("experiment", name, f"revision {read_figures()[name].facts['revision']}") for name in one.experiments]
    return markdown_table(("kind", "reference", "result"), rows)


def _test_result(test: str, report: TestReport | None) -> str:
    if report is None:
        return NO_REPORT
    count = report.cases.get(test, 0)
    return f"{report.status(test)} ({count_noun(count, 'case')})" if count else report.status(test)


def robot_limits(subject: Subject) -> str:
    """Every limit of the robot at this site with its provenance, the tracking model, and missing information."""
    robot_model = subject.robot_model
    tracking = robot_model.tracking
    errors = ", ".join(f"{error:.6g}" for error in sorted(set(tracking.position_errors(robot_model.n))))
    mixed = robot_model.is_mobile or any(joint.kind == "prismatic" for joint in robot_model.joints)
    unit = "rad (m for prismatic joints and the base)" if mixed else "rad"
    lines = [
        "# Limits of the robot",
        "",
        f"Robot model {robot_model.name}, from {robot_model.source}; licence {robot_model.licence}. "
        f"{len(robot_model.spheres)} collision spheres, {len(robot_model.self_pairs.kept)} pairs of own parts. "
        'The limits are those of the model after narrowing by the site file. The provenance "site policy" of a model '
        "means a default that dualbrain chose; it is no decision of a site.",
        "",
        *markdown_table(("joint", "bound", "value", "provenance"), bound_rows(robot_model)),
        "",
        "## Tracking model",
        "",
        f"y = q + lag v follows the commanded velocity: lag {tracking.lag * 1e3:.3g} ms, position error "
        f"{errors} {unit}, drive {tracking.drive or 'not named'}. Provenance: {tracking.provenance}.",
        "",
        "## Missing information",
        "",
        *([f"- {line}" for line in missing_information(robot_model, None)] or ["None."]),
        "",
        "## Site file",
        "",
    ]
    if subject.site is None:
        lines += [
            f"None: {NO_SITE}. Planes, keep-out boxes, permissions, limits of persons and objects are not stated."
        ]
    else:
        lines += markdown_table(("entry", "value", "line"), list_entries(subject.site))
    return _page([*lines, "", f"Commissioning: {subject.record}."])


def experiment_figures() -> str:
    """The figures of every experiment that a requirement names, with date and revision."""
    lines = [
        "# Measured figures",
        "",
        "Results of the experiments that the requirements name, as committed with the software. They were measured in "
        "simulation or on fakes of interfaces, each at the revision that its table states, which may be older "
        "than this version; "
        '"not recorded" means that the revision of the run is unknown. A number in brackets after a revision is the '
        "number of units that ran at it. "
        "No experiment was run for this robot at this site.",
    ]
    for name, figures in read_figures().items():
        lines += ["", f"## {name}: {figures.title}", "", f"Claim: {figures.claim}", ""]
        lines += [*markdown_table(("", ""), list(figures.facts.items())), "", _deeper(figures.results)]
    return _page(lines)


def replay_page(runs: Sequence[ReplayedRun]) -> str:
    """How to recompute a recorded run, and the runs that were recomputed for this evidence."""
    lines = [
        "# Replay",
        "",
        "Every control of a recorded run can be recomputed from its recorded inputs and compared bit for bit:",
        "",
        "```",
        "dualbrain replay RUN/episode.mcap     # exit code 0: identical",
        "dualbrain memory verify               # the chain of hashes of the ledger",
        "dualbrain doctor                      # versions and kernel hash of this installation",
        "```",
        "",
        "A replay needs the same kernel (its hash is in software.md and in the recording), not the same machine. To "
        "investigate an incident, copy the folder of the run before anything else. `config.json` states the start, "
        "`scene.json` the scene, `episode.json` the decisions, `episode.mcap` every input and control.",
        "",
        "## Runs recomputed for this evidence",
        "",
    ]
    rows = [(one.recording, one.robot, str(one.controls), one.comparison, one.kernel, one.sha256) for one in runs]
    heads = ("recording", "robot", "controls", "result", "kernel", "SHA-256 of the recording")
    lines += markdown_table(heads, rows) if rows else ["None were given (`--run`)."]
    return _page(lines)


def software_page(facts: Mapping[str, str]) -> str:
    """Versions and hashes of the software."""
    return _page(
        [
            "# Software",
            "",
            "Versions and hashes of this installation. `sbom.cdx.json` lists the model files and all packages "
            "of the environment, development tools included.",
            "",
            *markdown_table(("", ""), list(facts.items())),
        ]
    )


def _deeper(text: str) -> str:
    """Markdown with its headings one level below those of the page."""
    return "\n".join(f"#{line}" if line.startswith("#") else line for line in text.splitlines())


def _page(lines: Sequence[str]) -> str:
    return "\n".join(lines).rstrip() + "\n"
