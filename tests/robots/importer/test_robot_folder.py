"""A robot folder can be read and edited; a new import reports its changes, and no edit is lost without a report."""

import json

import msgspec
import numpy as np
import pytest

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.importer.build_arm import ImportOptions, build_arm, no_gripper
from dualbrain.robots.importer.output import robot_folder
from dualbrain.robots.importer.output.diff import find_changes, reapply_edits, summarize_changes
from dualbrain.robots.importer.output.robot_folder import (
    ImportRecord,
    find_edits,
    read_import_files,
    write_robot_folder,
)
from dualbrain.robots.importer.urdf import read_urdf
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import Bound
from dualbrain.safety.cbf.filter import SafetyFilter
from tests.robots.importer.urdf_builder import full_featured_arm, limit_policy, write_file

RECORD = ImportRecord(description="robot.urdf", sha256="0" * 64)


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    file = write_file(tmp_path_factory.mktemp("arm"), full_featured_arm())
    options = ImportOptions(quick=True, sphere_budget=30)
    return lambda **stated: build_arm(read_urdf(file), limit_policy(**stated), options)


@pytest.fixture(scope="module")
def first(build):
    return build()


@pytest.fixture
def folder(first, tmp_path):
    write_robot_folder(tmp_path / "arm", first.robot_model, first.report, RECORD)
    return tmp_path / "arm"


def edit(folder, change):
    data = json.loads((folder / "body.json").read_text())
    change(data)
    (folder / "body.json").write_text(json.dumps(data))


def test_the_filter_accepts_the_folder(folder, first):
    robot_model = load_robot(str(folder))
    assert robot_model == first.robot_model == load_robot(str(folder / "body.json"))
    answer = SafetyFilter(robot_model)(np.array(robot_model.home), np.zeros(3), np.full(3, 0.1))
    assert answer.certified
    assert read_import_files(folder) == (first.report, RECORD)


def test_the_page_names_every_bound_and_the_missing_information(folder, first):
    page = (folder / "README.md").read_text()
    for text in ("robot.urdf:12: shoulder limit upper", "not identified", "100.00%"):
        assert text in page
    assert all(pair[0] in page for pair in first.robot_model.self_pairs.kept)


def test_a_new_import_reports_its_changes_and_keeps_edits(folder, build):
    edit(folder, lambda data: data["joints"][1]["velocity"].update(value=0.7, provenance="measured by Ada"))
    assert [change.entry for change in find_edits(folder)] == [
        "joints.shoulder.velocity.value",
        "joints.shoulder.velocity.provenance",
    ]
    second = build(acceleration=5.0)
    written = write_robot_folder(folder, second.robot_model, second.report, RECORD)
    assert "joints.shoulder.acceleration.value: 10 → 5" in summarize_changes(written.generator_changes)
    assert len(written.kept_edits) == 2
    assert not written.lost_edits
    shoulder = load_robot(str(folder)).joints[1]
    assert (shoulder.velocity.value, shoulder.acceleration.value) == (0.7, 5.0)
    assert "measured by Ada" in (folder / "README.md").read_text()


def shoulder_velocity(folder):
    return load_robot(str(folder)).joints[1].velocity


def set_velocity(value, **entries):
    return lambda data: data["joints"][1]["velocity"].update(value=value, **entries)


@pytest.mark.parametrize("entries", [{}, {"provenance": "measured by Ada"}])
def test_a_narrower_limit_that_the_site_states_later_holds(folder, build, entries):
    edit(folder, set_velocity(2.0, **entries))
    second = build(velocity=1.0)
    written = write_robot_folder(folder, second.robot_model, second.report, RECORD)
    assert shoulder_velocity(folder) == Bound(
        1.0, "rad/s", "test; wider: 1.5 of robot.urdf:12: shoulder limit velocity"
    )
    assert not written.kept_edits
    assert "joints.shoulder.velocity.value: 1.5 → 2" in summarize_changes(written.lost_edits)


def test_a_limit_that_the_site_states_later_at_the_same_value_holds_too(folder, build):
    edit(folder, set_velocity(2.0))
    second = build(velocity=1.5)
    write_robot_folder(folder, second.robot_model, second.report, RECORD)
    assert shoulder_velocity(folder).value == 1.5


def test_an_edit_that_is_narrower_than_a_later_limit_is_kept_as_an_edit(folder, build):
    edit(folder, set_velocity(0.7))
    for stated in (1.0, 0.9):
        second = build(velocity=stated)
        written = write_robot_folder(folder, second.robot_model, second.report, RECORD)
        assert not written.lost_edits
        assert shoulder_velocity(folder).value == 0.7
        assert shoulder_velocity(folder).provenance.startswith(
            f"edit in body.json; wider: {stated:g} of test; wider: 1.5"
        )


def test_a_provenance_that_the_user_stated_does_not_move_to_another_value(folder, build):
    edit(folder, lambda data: data["joints"][1]["velocity"].update(provenance="measured by Ada"))
    second = build(velocity=1.0)
    written = write_robot_folder(folder, second.robot_model, second.report, RECORD)
    assert shoulder_velocity(folder) == second.robot_model.joints[1].velocity
    assert [change.entry for change in written.lost_edits] == ["joints.shoulder.velocity.provenance"]


def test_of_a_lower_limit_the_larger_one_is_narrower(first):
    before = first.robot_model
    wide, narrow, stated = (
        with_lower(before, Bound(value, "rad", text)) for value, text in ((-3.0, "Ada"), (-0.5, "Ada"), (-1.0, "site"))
    )
    result, kept, lost = reapply_edits(before, wide, stated)
    assert (result, len(kept), len(lost)) == (stated, 0, 2)
    result, kept, lost = reapply_edits(before, narrow, stated)
    assert (result, len(kept), len(lost)) == (narrow, 2, 0)


def test_other_lines_of_a_description_lose_no_edit(first):
    before = first.robot_model
    moved = with_lower(before, Bound(-2.0, "rad", "robot.urdf:99: shoulder limit lower"))
    edited = with_lower(before, Bound(-3.0, "rad", before.joints[1].lower.provenance))
    result, kept, _ = reapply_edits(before, edited, moved)
    assert result.joints[1].lower == Bound(-3.0, "rad", "robot.urdf:99: shoulder limit lower")
    assert len(kept) == 1


def test_a_gripper_that_was_added_is_kept_also_if_another_reason_is_given(first):
    def without_gripper(reason):
        return msgspec.structs.replace(first.robot_model, gripper=no_gripper(reason))

    edited = msgspec.structs.replace(first.robot_model, gripper=load_robot("panda").gripper)
    result, _, lost = reapply_edits(without_gripper("no moving fingers"), edited, without_gripper("jointed fingers"))
    assert result.gripper == edited.gripper
    assert not lost


def with_lower(model, bound):
    lift, shoulder, *others = model.joints
    return msgspec.structs.replace(model, joints=(lift, msgspec.structs.replace(shoulder, lower=bound), *others))


@pytest.mark.parametrize("last", ["nothing", "made.next.json", "recipe.json", "README.md", "body.json"])
@pytest.mark.parametrize("is_edited", [False, True])
def test_after_an_interrupted_import_old_limits_do_not_count_as_edits(folder, build, monkeypatch, last, is_edited):
    if is_edited:
        edit(folder, lambda data: data["joints"][1]["velocity"].update(value=0.7))
    second = build(acceleration=5.0)

    def interrupted_write(path, data):
        if path.name == last:
            write_atomically(path, data)
        if path.name == last or last == "nothing":
            raise KeyboardInterrupt
        write_atomically(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(robot_folder, "write_atomically", interrupted_write)
        with pytest.raises(KeyboardInterrupt):
            write_robot_folder(folder, second.robot_model, second.report, RECORD)
    changes = ["joints.shoulder.velocity.value"] if is_edited else []
    assert [change.entry for change in find_edits(folder)] == changes
    written = write_robot_folder(folder, second.robot_model, second.report, RECORD)
    assert [change.entry for change in written.kept_edits] == changes
    shoulder = load_robot(str(folder)).joints[1]
    assert (shoulder.velocity.value, shoulder.acceleration.value) == (0.7 if is_edited else 1.5, 5.0)
    assert not (folder / "made.next.json").exists()


def test_an_interrupted_first_import_can_be_repeated(first, tmp_path, monkeypatch):
    def interrupted_write(path, data):
        if path.name == "body.json":
            raise KeyboardInterrupt
        write_atomically(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(robot_folder, "write_atomically", interrupted_write)
        with pytest.raises(KeyboardInterrupt):
            write_robot_folder(tmp_path / "arm", first.robot_model, first.report, RECORD)
    write_robot_folder(tmp_path / "arm", first.robot_model, first.report, RECORD)
    assert load_robot(str(tmp_path / "arm")) == first.robot_model


def test_edits_are_discarded_only_on_request(folder, first):
    edit(folder, lambda data: data.update(period=0.004))
    write_robot_folder(folder, first.robot_model, first.report, RECORD, discard_edits=True)
    assert load_robot(str(folder)) == first.robot_model


def test_an_edit_whose_entry_no_longer_exists_is_reported(first):
    model = first.robot_model
    edited = msgspec.structs.replace(model, spheres=model.spheres[:-1])
    result, kept, lost = reapply_edits(model, edited, model)
    assert result == model
    assert not kept
    assert {change.entry.split(".")[0] for change in lost} == {"spheres"}
    assert not find_changes(model, model)


def test_folders_of_other_robots_and_of_other_files_are_not_changed(folder, first, tmp_path):
    other = msgspec.structs.replace(first.robot_model, name="other")
    with pytest.raises(ConfigurationError, match="test_arm_7"):
        write_robot_folder(folder, other, first.report, RECORD)
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("text")
    with pytest.raises(ConfigurationError, match="is not a robot folder"):
        write_robot_folder(tmp_path / "home", first.robot_model, first.report, RECORD)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data["joints"][0]["velocity"].update(value=0.0), "velocity of joint 'lift'"),
        (lambda data: data["joints"][0]["lower"].update(value=9.0), "range of joint 'lift'"),
        (lambda data: data["spheres"][0].update(radius=-1.0), "sphere of"),
        (lambda data: data["spheres"][0].update(link="elbo"), "link of a sphere"),
        (lambda data: data["links"][0].update(frame=7), "frame of link"),
        (lambda data: data["joints"][0].update(quaternion=[2, 0, 0, 0]), "of length 1"),
        (lambda data: data.update(home=[0.0]), "home"),
        (lambda data: data.update(home=[9.0, *data["home"][1:]]), "home of joint 'lift'"),
        (lambda data: data.update(spheres=[]), "spheres"),
        (lambda data: data.update(period=0), "period"),
        (lambda data: data.update(tool="hand"), r"\$\.tool"),
        (lambda data: data["tool"].update(link="hnad"), "link of the tool"),
        (lambda data: data["tool"].update(quaternion=[0, 0, 0, 0]), "quaternion of the tool"),
        (lambda data: data["tool"].update(quaternion=[2, 0, 0, 0]), "quaternion of the tool"),
        (lambda data: data["tool_speed"].update(value=-0.1), "tool_speed"),
        (lambda data: data["joints"][0].update(jerk=data["joints"][0]["velocity"] | {"value": 0.0}), "jerk of joint"),
        (lambda data: data["joints"][1].update(name=data["joints"][0]["name"]), "each name once"),
    ],
)
def test_an_invalid_edit_is_reported_with_its_entry(folder, change, message):
    edit(folder, change)
    with pytest.raises(ConfigurationError, match=message):
        load_robot(str(folder))


def test_a_model_that_could_not_be_loaded_is_not_written(folder, first, tmp_path):
    without = msgspec.structs.replace(first.robot_model, spheres=())
    with pytest.raises(ConfigurationError, match="spheres of the imported robot test_arm_7"):
        write_robot_folder(tmp_path / "new", without, first.report, RECORD)
    assert not (tmp_path / "new").exists()
    edit(folder, lambda data: data["home"].__setitem__(0, 0.4))
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    lift, *others = first.robot_model.joints
    short = msgspec.structs.replace(lift, upper=Bound(0.3, "m", "site"))
    narrowed = msgspec.structs.replace(
        first.robot_model, joints=(short, *others), home=(0.1, *first.robot_model.home[1:])
    )
    with pytest.raises(ConfigurationError, match=r"home of joint 'lift'.*--discard-edits"):
        write_robot_folder(folder, narrowed, first.report, RECORD)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    assert write_robot_folder(folder, narrowed, first.report, RECORD, discard_edits=True).robot_model == narrowed


def test_a_path_without_a_robot_is_an_error(tmp_path):
    with pytest.raises(ConfigurationError, match=r"a folder with body\.json"):
        load_robot(str(tmp_path / "nothing.json"))
    with pytest.raises(UnknownNameError):
        load_robot("pandaa")
