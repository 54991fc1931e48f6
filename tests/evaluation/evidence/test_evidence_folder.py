"""The evidence states robot, site, results and limits; a change of any file is detected."""

import re

import pytest

from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import Trace
from dualbrain.errors import ConfigurationError, UsageError
from dualbrain.evaluation.evidence import evidence_folder, pages
from dualbrain.evaluation.evidence.bill_of_materials import remove_local_references
from dualbrain.evaluation.evidence.evidence_folder import changed_files, write_evidence
from dualbrain.evaluation.evidence.requirement import read_hazards, read_requirements, required_tests
from dualbrain.evaluation.evidence.subject import EvidenceInputs, load_subject
from dualbrain.evaluation.evidence.test_report import TestReport
from dualbrain.robots.loader import BUILTIN_ROBOTS, load_robot
from dualbrain.robots.site_config import SiteError
from dualbrain.visualization.html.evidence_page import render_evidence_page

SITE = """
[robot]
tool_speed = 0.25
[[plane]]
name = "table"
point = [0, 0, 0]
inward = [0, 0, 1]
[person.operator]
monitoring = "barrier"
[commander.planner]
skills = ["home", "hold", "decline"]
[object.wine_glass]
force = 8.0
clearance = 0.2
"""
PASSED = TestReport(dict.fromkeys(required_tests(), "passed"), ("2026-01-01T00:00:00",))


@pytest.fixture
def site(tmp_path):
    (tmp_path / "lab.toml").write_text(SITE)
    return tmp_path / "lab.toml"


@pytest.fixture
def written(tmp_path, site, monkeypatch):
    """An evidence folder, without the slow list of the installed packages."""
    monkeypatch.setattr(evidence_folder, "write_bill_of_materials", lambda: b"{}")
    out = tmp_path / "evidence"
    summary = write_evidence(EvidenceInputs(robot="panda", site=site), out, now=0.0, render=render_evidence_page)
    return out, summary


def test_every_file_is_in_the_manifest_and_every_change_is_detected(written):
    out, _ = written
    assert changed_files(out) == []
    files = [path for path in out.rglob("*") if path.is_file() and path.name != "manifest.json"]
    for path in files:
        content = path.read_bytes()
        path.write_bytes(content + b" ")
        assert changed_files(out) == [str(path.relative_to(out))]
        path.write_bytes(content)
    (out / "added.txt").touch()
    files[0].unlink()
    assert changed_files(out) == sorted(["added.txt", str(files[0].relative_to(out))])


def test_without_a_test_report_no_requirement_counts_as_passed(written):
    out, summary = written
    assert summary.statuses == {"no test report": len(read_requirements())}
    assert "(passed)" not in (out / "hazard_log.md").read_text("utf-8")


def test_the_first_page_states_what_the_evidence_is_not(written):
    out, _ = written
    text = (out / "README.md").read_text("utf-8")
    for words in ("no certificate", "no risk assessment", "no performance level", "not a signature"):
        assert words in text


def test_the_html_page_contains_every_page_and_no_markup_of_texts(written):
    out, _ = written
    html = (out / "evidence.html").read_text("utf-8")
    for name in read_hazards():
        assert f"<h2>{name} " in html
    assert "<img" not in html
    assert "&lt;script" in render_evidence_page(["# <script>a</script>\n\n<script>b</script>"])
    assert "<script" not in render_evidence_page(["# <script>a</script>\n\n<script>b</script>"])


def test_entries_of_the_site_are_named_with_their_lines(site):
    subject = load_subject(EvidenceInputs(robot="panda", site=site))
    log = pages.hazard_log(subject, pages.requirement_statuses(PASSED, subject.robot_model))
    for words in (
        "plane table (lab.toml:4)",
        "operator: barrier (lab.toml:8)",
        "planner: home, hold, decline (lab.toml:10)",
        "wine_glass: force at most 8 N, clearance at least 0.2 m (lab.toml:12)",
    ):
        assert words in log
    assert "tool speed 0.25 m/s" in log
    assert "(passed)" in log
    assert "no test report" not in log


FULL_SITE = """
[robot]
period = 0.002
moving_mass = 18.0
[tool]
position = [0, 0, 0.12]
[[plane]]
name = "table"
point = [0, 0, -0.1]
inward = [0, 0, 1]
parts = ["hand", "arm"]
[[keep_out]]
name = "cabinet"
position = [0.6, 0.5, 0.4]
half_extents = [0.2, 0.1, 0.3]
yaw = 0.3
margin = 0.05
[person.others]
monitoring = "separation"
approach = 1.6
[person.operator]
monitoring = "power_and_force"
body_region = "hand"
distance = 0.4
"""


def test_entries_of_the_site_are_listed_with_all_their_numbers(site):
    site.write_text(FULL_SITE)
    page = pages.robot_limits(load_subject(EvidenceInputs(robot="panda", site=site)))
    for row in (
        "| control period | 0.002 s | lab.toml:3 |",
        "| mass of the moving parts | 18 kg, load 0 kg | lab.toml:4 |",
        "| tool | tip at (0, 0, 0.12) m, 0 spheres | lab.toml:5 |",
        "| plane table | through (0, 0, -0.1) m, inward (0, 0, 1), margin 0 m, parts hand, arm | lab.toml:7 |",
        "| at (0.6, 0.5, 0.4) m, half extents (0.2, 0.1, 0.3) m, yaw 0.3 rad, margin 0.05 m | lab.toml:12 |",
        "| person others | separation, reaction 0.1 s, brake 2 m/s², approach 1.6 m/s | lab.toml:18 |",
        "| power and force, at most 1.36 m/s within 0.4 m for body region hand, brake 1 m/s², approach 0 m/s |",
    ):
        assert row in page


def test_a_permitted_skill_that_the_robot_does_not_have_is_an_error(site):
    site.write_text("[commander.planner]\nskills = ['home', 'drive_to']\n")
    load_subject(EvidenceInputs(robot="mobile_panda", site=site))
    with pytest.raises(SiteError, match=r"line 2.*drive_to"):
        load_subject(EvidenceInputs(robot="panda", site=site))


def test_limits_of_an_object_that_no_grasp_keeps_are_an_error(site):
    site.write_text("[object.wine_glass]\nforce = 1.0\n")
    with pytest.raises(SiteError, match="at least 5 N"):
        load_subject(EvidenceInputs(robot="panda", site=site))


def test_a_failed_test_fails_its_requirements_alone():
    failing = required_tests()[0]
    statuses = pages.requirement_statuses(TestReport({**PASSED.statuses, failing: "failed"}, ()), load_robot("panda"))
    expected = {name for name, one in read_requirements().items() if failing in one.tests}
    assert {name for name, status in statuses.items() if status == "failed"} == expected
    assert expected


@pytest.mark.parametrize("robot", BUILTIN_ROBOTS)
def test_every_packaged_robot_has_its_limits_with_provenance(robot):
    subject = load_subject(EvidenceInputs(robot=robot))
    page = pages.robot_limits(subject)
    for joint in subject.robot_model.joints:
        assert f"| {joint.name} | velocity | {joint.velocity.value:g} {joint.velocity.unit} | " in page
    assert not re.search(r"\| *\|$", page.partition("## Tracking model")[0].partition("| --- |")[2], re.MULTILINE)


def test_a_commissioning_record_needs_driver_and_site(tmp_path):
    with pytest.raises(UsageError):
        load_subject(EvidenceInputs(robot="fr3", commissioned=tmp_path / "a.json"))


def test_a_missing_recording_is_a_configuration_error_and_nothing_is_written(tmp_path):
    inputs = EvidenceInputs(robot="panda", runs=(tmp_path / "run",))
    with pytest.raises(ConfigurationError):
        write_evidence(inputs, tmp_path / "out", now=0.0, render=render_evidence_page)
    assert not (tmp_path / "out").exists()


def test_a_driver_without_a_record_is_refused():
    with pytest.raises(UsageError, match="--driver needs --commissioned"):
        load_subject(EvidenceInputs(robot="fr3", driver="franka"))


def test_a_folder_with_files_is_refused_before_any_work(tmp_path):
    (tmp_path / "a").touch()
    with pytest.raises(ConfigurationError, match=r"contains files\. Give an empty or a new folder"):
        write_evidence(EvidenceInputs(robot="no robot"), tmp_path, now=0.0, render=render_evidence_page)


@pytest.mark.parametrize(("robot", "expected"), [("panda", set()), ("base", {"SU-7", "SF-10", "CO-8", "SK-1"})])
def test_a_requirement_for_missing_equipment_is_not_applicable(robot, expected):
    statuses = pages.requirement_statuses(PASSED, load_robot(robot))
    assert {name for name, status in statuses.items() if status == "not applicable"} == expected


def test_the_first_page_states_that_no_test_ran_on_an_untested_robot(tmp_path, monkeypatch):
    monkeypatch.setattr(evidence_folder, "write_bill_of_materials", lambda: b"{}")
    write_evidence(EvidenceInputs(robot="base"), tmp_path / "out", now=0.0, render=render_evidence_page)
    assert re.search("The tests ran on panda, .*, not on base", (tmp_path / "out" / "README.md").read_text("utf-8"))


def test_the_trace_states_the_number_of_cases_of_a_test():
    test = required_tests()[0]
    report = TestReport(PASSED.statuses, (), {test: 3})
    page = pages.requirement_trace(report, pages.requirement_statuses(report, load_robot("panda")))
    assert f"{test} | passed (3 cases) |" in page


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
def test_a_run_of_another_robot_is_refused_with_both_names(tmp_path, monkeypatch, robot):
    monkeypatch.setattr(evidence_folder, "write_bill_of_materials", lambda: b"{}")
    (tmp_path / "run").mkdir()
    with Recorder(tmp_path / "run" / "episode.mcap", Trace(7)) as recorder:
        recorder.episode(0.0, {"robot": "panda", "guard": True, "instruction": ""})
    inputs = EvidenceInputs(robot=robot, runs=(tmp_path / "run",))
    if robot == "panda":
        write_evidence(inputs, tmp_path / "out", now=0.0, render=render_evidence_page)
        assert "| run/episode.mcap | panda |" in (tmp_path / "out" / "replay.md").read_text("utf-8")
    else:
        with pytest.raises(ConfigurationError, match="of the robot panda, the evidence is for ur5e"):
            write_evidence(inputs, tmp_path / "out", now=0.0, render=render_evidence_page)


def test_references_to_local_files_are_not_in_the_bill():
    component = {"externalReferences": [{"url": "file:///a"}, {"url": "https://b"}]}
    remove_local_references(component)
    assert component["externalReferences"] == [{"url": "https://b"}]
