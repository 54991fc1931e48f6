"""The robot's folder: it can be read and edited, making again is a diff, and no edit is lost in silence."""

import json

import msgspec
import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.importer.build_arm import ImportOptions, build_arm
from dualbrain.robots.importer.output.diff import find_changes, reapply_edits, summarize_changes
from dualbrain.robots.importer.output.robot_folder import (
    ImportRecord,
    find_edits,
    read_import_files,
    write_robot_folder,
)
from dualbrain.robots.importer.urdf import read_urdf
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from tests.robots.importer.urdf_builder import full_featured_arm, limit_policy, write_file

RECIPE = ImportRecord(description="robot.urdf", sha256="0" * 64)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    file = write_file(tmp_path_factory.mktemp("arm"), full_featured_arm())
    return lambda **said: build_arm(read_urdf(file), limit_policy(**said), ImportOptions(quick=True, sphere_budget=30))


@pytest.fixture(scope="module")
def first(made):
    return made()


@pytest.fixture
def folder(first, tmp_path):
    write_robot_folder(tmp_path / "arm", first.robot_model, first.report, RECIPE)
    return tmp_path / "arm"


def edit(folder, change):
    data = json.loads((folder / "body.json").read_text())
    change(data)
    (folder / "body.json").write_text(json.dumps(data))


def test_the_filter_takes_the_folder_as_it_lies(folder, first):
    robot_model = load_robot(str(folder))
    assert robot_model == first.robot_model == load_robot(str(folder / "body.json"))
    answer = SafetyFilter(robot_model)(np.array(robot_model.home), np.zeros(3), np.full(3, 0.1))
    assert answer.certified
    assert read_import_files(folder) == (first.report, RECIPE)


def test_the_page_names_every_bound_and_what_is_missing(folder, first):
    page = (folder / "README.md").read_text()
    for bound in ("robot.urdf:12: shoulder limit upper", "not identified", "100.00%"):
        assert bound in page
    assert all(pair[0] in page for pair in first.robot_model.self_pairs.kept)


def test_making_again_shows_what_changed_and_keeps_edits(folder, made):
    edit(folder, lambda data: data["joints"][1]["velocity"].update(value=0.7, provenance="measured by Ada"))
    assert [change.entry for change in find_edits(folder)] == [
        "joints.shoulder.velocity.value",
        "joints.shoulder.velocity.provenance",
    ]
    again = made(acceleration=5.0)
    written = write_robot_folder(folder, again.robot_model, again.report, RECIPE)
    assert "joints.shoulder.acceleration.value: 10 → 5" in summarize_changes(written.generator_changes)
    assert len(written.kept_edits) == 2
    assert not written.lost_edits
    shoulder = load_robot(str(folder)).joints[1]
    assert (shoulder.velocity.value, shoulder.acceleration.value) == (0.7, 5.0)
    assert "measured by Ada" in (folder / "README.md").read_text()


def test_edits_go_only_when_asked_to(folder, first):
    edit(folder, lambda data: data.update(period=0.004))
    write_robot_folder(folder, first.robot_model, first.report, RECIPE, discard_edits=True)
    assert load_robot(str(folder)) == first.robot_model


def test_an_edit_that_has_no_place_any_more_is_told(first):
    body = first.robot_model
    edited = msgspec.structs.replace(body, spheres=body.spheres[:-1])
    fresh, kept, lost = reapply_edits(body, edited, body)
    assert fresh == body
    assert not kept
    assert {change.entry.split(".")[0] for change in lost} == {"spheres"}
    assert not find_changes(body, body)


def test_another_robots_folder_and_foreign_files_are_left_alone(folder, first, tmp_path):
    other = msgspec.structs.replace(first.robot_model, name="other")
    with pytest.raises(ConfigurationError, match="test_arm_7"):
        write_robot_folder(folder, other, first.report, RECIPE)
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("dear")
    with pytest.raises(ConfigurationError, match="not a robot's"):
        write_robot_folder(tmp_path / "home", first.robot_model, first.report, RECIPE)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda data: data["joints"][0]["velocity"].update(value=0.0), "velocity of joint 'lift'"),
        (lambda data: data["joints"][0]["lower"].update(value=9.0), "range of joint 'lift'"),
        (lambda data: data["spheres"][0].update(radius=-1.0), "sphere of"),
        (lambda data: data["spheres"][0].update(link="elbo"), "link of a sphere"),
        (lambda data: data["links"][0].update(frame=7), "frame of link"),
        (lambda data: data["joints"][0].update(quaternion=[2, 0, 0, 0]), "of length 1"),
        (lambda data: data.update(home=[0.0]), "home"),
        (lambda data: data.update(period=0), "period"),
        (lambda data: data.update(tool="hand"), r"\$\.tool"),
        (lambda data: data["tool"].update(link="hnad"), "link of the tool"),
    ],
)
def test_an_edit_that_breaks_the_body_is_told_by_its_entry(folder, change, said):
    edit(folder, change)
    with pytest.raises(ConfigurationError, match=said):
        load_robot(str(folder))


def test_no_folder_is_no_robot(tmp_path):
    with pytest.raises(ConfigurationError, match=r"a folder with body\.json"):
        load_robot(str(tmp_path / "nothing.json"))
    with pytest.raises(UnknownNameError):
        load_robot("pandaa")
