"""Evidence folder: all pages, copies of the given files, and a manifest with the SHA-256 of every file."""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.control.recording.channels import EpisodeInfo, read_recording
from dualbrain.control.recording.recorded_robot import recorded_robot
from dualbrain.control.recording.replay import replay
from dualbrain.core.markdown import markdown_table
from dualbrain.core.storage.atomic_files import atomic_folder
from dualbrain.core.storage.checksum import file_sha256
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.evaluation.evidence import pages
from dualbrain.evaluation.evidence.bill_of_materials import write_bill_of_materials
from dualbrain.evaluation.evidence.copied_documents import read_safety_page
from dualbrain.evaluation.evidence.pages import ReplayedRun
from dualbrain.evaluation.evidence.requirement import read_requirements
from dualbrain.evaluation.evidence.subject import EvidenceInputs, Subject, load_subject
from dualbrain.evaluation.evidence.test_report import RequirementStatus, read_test_report
from dualbrain.evaluation.runner.provenance import collect_provenance, git_revision, machine_description
from dualbrain.robots.loader import encode_robot

MANIFEST_FILE = "manifest.json"
PAGES = {
    "evidence.html": "all pages, to read and to print",
    "safety.md": "guarantee, assumptions and limits of the software (SAFETY.md of this version)",
    "hazard_log.md": "hazards, measures, and the hazards that remain",
    "requirement_trace.md": "requirements, their code, their tests with results, their experiments",
    "robot_limits.md": "every limit with its provenance, and the measures of the site file",
    "experiment_figures.md": "measured figures with date and revision",
    "replay.md": "how to recompute a run, and the runs that were recomputed",
    "software.md": "versions and hashes",
    "sbom.cdx.json": "software bill of materials (CycloneDX 1.6), with the model files",
    MANIFEST_FILE: "SHA-256 of every file",
}
"""Files of the folder with their contents."""
_RESULTS = {"no test report": "without a result (no test report)"}
NOT_STATED = (
    "**It is no certificate and no conformity assessment.** dualbrain is research software; it is not safety-rated.",
    "It is no risk assessment: severity, exposure and avoidability belong to the installation (ISO 12100).",
    "It states no performance level and no safety integrity level; no hardware was assessed.",
    "The figures were measured in simulation and on fakes of interfaces, not on this robot at this site. A number in "
    "brackets after a revision is the number of units that ran at it.",
    "The manifest shows changes of the files. It is not a signature.",
)


@dataclass(frozen=True, slots=True)
class EvidenceSummary:
    """Number of requirements by status, the recordings that are not identical, and the SHA-256 of the manifest."""

    statuses: Mapping[RequirementStatus, int]
    differing_runs: tuple[str, ...]
    manifest_sha256: str


def write_evidence(
    inputs: EvidenceInputs,
    out: Path,
    *,
    now: float,
    render: Callable[[Sequence[str]], str],
) -> EvidenceSummary:
    """Write the evidence folder `out`, completely or not at all, at `now` [s, 1970 UTC].

    `render` makes one HTML page of the Markdown pages.

    Raises:
        ConfigurationError: An input does not exist or is invalid, or `out` contains files.
        FileWriteError: The folder cannot be written.
    """
    _check_empty(out)
    subject = load_subject(inputs)
    report = None if inputs.test_report is None else read_test_report(inputs.test_report)
    runs = [_replay(path, subject.robot_model.name) for path in inputs.runs]
    bill = write_bill_of_materials()
    statuses = pages.requirement_statuses(report, subject.robot_model)
    texts = {
        "safety.md": read_safety_page(),
        "hazard_log.md": pages.hazard_log(subject, statuses),
        "requirement_trace.md": pages.requirement_trace(report, statuses),
        "robot_limits.md": pages.robot_limits(subject),
        "experiment_figures.md": pages.experiment_figures(),
        "replay.md": pages.replay_page(runs),
        "software.md": pages.software_page(_software(now)),
    }
    counts = Counter(statuses.values())
    texts = {"README.md": _overview(inputs, subject, counts, runs, now), **texts}
    with atomic_folder(out) as folder:
        for name, text in texts.items():
            (folder / name).write_text(text, "utf-8")
        (folder / "evidence.html").write_text(render(list(texts.values())), "utf-8")
        (folder / "sbom.cdx.json").write_bytes(bill)
        _copy_inputs(inputs, subject, folder / "inputs")
        manifest = {str(file.relative_to(folder)): file_sha256(file) for file in sorted(_files(folder))}
        (folder / MANIFEST_FILE).write_bytes(msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n")
    differing = tuple(run.recording for run in runs if not run.identical)
    return EvidenceSummary(counts, differing, file_sha256(out / MANIFEST_FILE))


def changed_files(folder: Path) -> list[str]:
    """The files of an evidence folder that differ from its manifest, are missing, or are not in it.

    Raises:
        ConfigurationError: The folder has no readable manifest.
    """
    try:
        manifest = msgspec.json.decode((folder / MANIFEST_FILE).read_bytes(), type=dict[str, str])
    except (OSError, *DECODE_ERRORS) as error:
        raise ConfigurationError.stating(
            f"The evidence folder {folder} has no readable manifest: {error}.",
            fix="Name a folder that `dualbrain evidence write` wrote.",
        ) from error
    present = {str(file.relative_to(folder)): file for file in _files(folder)} if folder.is_dir() else {}
    present.pop(MANIFEST_FILE, None)
    return sorted(
        name
        for name in manifest.keys() | present.keys()
        if name not in manifest or name not in present or file_sha256(present[name]) != manifest[name]
    )


def _check_empty(out: Path) -> None:
    if out.is_dir() and any(out.iterdir()):
        raise ConfigurationError.stating(f"The folder {out} contains files.", fix="Give an empty or a new folder.")
    if out.exists() and not out.is_dir():
        raise ConfigurationError.stating(f"{out} is a file.", fix="Give an empty or a new folder.")


def _tested_robots(robot: str) -> str:
    """The limit that follows from the robots of the tests."""
    tested = list(dict.fromkeys(name for one in read_requirements().values() for name in one.robots))
    own = [name for name, one in read_requirements().items() if robot in one.robots]
    if not own:
        return f"The tests ran on {', '.join(tested)}, not on {robot}."
    return (
        f"The tests ran in simulation; those of {', '.join(own)} on {robot}, the others on other robot models or none."
    )


def _files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.is_file()]


def _replay(path: Path, robot: str) -> ReplayedRun:
    recording = path / "episode.mcap" if path.is_dir() else path
    if not recording.exists():
        raise ConfigurationError.stating(f"There is no recording {recording}.", fix="Name the folder of a run.")
    result = replay(recording)
    about = _recorded_facts(recording)
    recorded = recorded_robot(about).name
    if recorded != robot:
        raise ConfigurationError.stating(
            f"The recording {recording} is of the robot {recorded}, the evidence is for {robot}.",
            fix="Name a run of this robot.",
        )
    kernel = str(dict(about.get("versions", {})).get("kernel", "not recorded"))
    identical = result.identical and result.complete
    if result.differing:
        comparison = f"{result.differing} differ, the first at tick {result.first}"
    elif not result.complete:
        comparison = f"incomplete: {result.problem or 'messages were lost'}"
    else:
        comparison = "identical, bit for bit" if result.identical else "no controls to compare"
    return ReplayedRun(
        recording=f"{recording.parent.name}/{recording.name}",
        controls=result.ticks,
        comparison=comparison,
        identical=identical,
        robot=recorded,
        kernel=kernel,
        sha256=file_sha256(recording),
    )


def _recorded_facts(recording: Path) -> dict[str, Any]:
    """The data of the /episode message; `replay` has checked that there is one."""
    return next(message.data for message in read_recording(recording) if isinstance(message, EpisodeInfo))


def _software(now: float) -> dict[str, str]:
    facts = {"written": _utc(now), "revision": git_revision(Path(__file__).parent, ("src", "kernel"))}
    return {**facts, **collect_provenance(), "processor": machine_description()}


def _overview(
    inputs: EvidenceInputs,
    subject: Subject,
    counts: Mapping[RequirementStatus, int],
    runs: list[ReplayedRun],
    now: float,
) -> str:
    identical = sum(run.identical for run in runs)
    results = ", ".join(f"{count} {_RESULTS.get(status, status)}" for status, count in counts.items())
    facts = [
        ("robot", subject.robot_model.name),
        ("site file", inputs.site.name if inputs.site else "none"),
        ("commissioning", subject.record),
        ("requirements", results),
        ("recomputed runs", f"{identical} of {len(runs)} identical" if runs else "none given"),
        ("written", _utc(now)),
    ]
    return "\n".join(
        [
            f"# Safety evidence: {subject.robot_model.name}",
            "",
            *markdown_table(("", ""), facts),
            "",
            "## Limits of this evidence",
            "",
            *(f"- {line}" for line in (*NOT_STATED, _tested_robots(subject.robot_model.name))),
            "",
            "## Contents",
            "",
            *markdown_table(("file", "contents"), list(PAGES.items())),
            "",
            "`inputs/` contains the robot model at this site and copies of the given files. `manifest.json` has the "
            "SHA-256 of every file; `dualbrain evidence verify DIR` compares them.",
            "",
        ]
    )


def _copy_inputs(inputs: EvidenceInputs, subject: Subject, folder: Path) -> None:
    folder.mkdir()
    (folder / "robot_model.json").write_bytes(encode_robot(subject.robot_model))
    for file, name in (
        (inputs.site, "site.toml"),
        (inputs.test_report, "test_report.xml"),
        (inputs.commissioned, "commissioning_record.json"),
    ):
        if file is not None:
            shutil.copyfile(file, folder / name)


def _utc(now: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(now))
