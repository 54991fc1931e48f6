"""The experiments on outcomes on tiny budgets: their units, their judgement of stored rows, and their tables."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.evaluation.protocol.case import make_case
from dualbrain.records import Violation
from dualbrain.runtime.assembly import SimulatedCell
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.arm.grasp import FRAGILE_FRACTION
from experiments.engine.experiment import Options, Row
from experiments.evaluation import clauses
from experiments.evaluation.clauses import Clauses
from experiments.evaluation.demo_sentence import DemoSentence, resolvable_end
from experiments.evaluation.free_instructions import FreeInstructionsExperiment, judge_row
from experiments.evaluation.gentle_force import FORCES, TASKS, GentleForce, contract_text
from experiments.evaluation.instructed_run import instructed_row, open_named_planner, planners_of, run_instruction
from experiments.evaluation.instructions.instruction_set import (
    CLAUSE_FILES,
    FREE_FILES,
    clause_instructions,
    free_instructions,
)
from experiments.evaluation.outcome_confusion import OutcomeConfusion
from experiments.figures.tables import format_share_by_scene
from tests.evaluation.sample_rows import episode_row

PACKAGED = ("base-135m", "explored-135m", "starter-135m")


def test_packaged_planners_are_asked_one_after_the_other(tmp_path):
    assert planners_of("packaged") == PACKAGED
    assert planners_of("some-planner") == ("some-planner",)
    n_sets = len(FREE_FILES)
    assert len(FreeInstructionsExperiment().units(Options(tmp_path, "packaged"))) == 80 * n_sets * len(PACKAGED)
    assert len(DemoSentence().units(Options(tmp_path, "packaged"))) == 900
    assert open_named_planner("starter-135m", "ur5e") is None


def decline(tmp_path, reason: str) -> str:
    """A contract file for a Panda that declines with `reason`."""
    cell = SimulatedCell.make("panda", "bare:80000")
    text = cell.contract([{"skill": "decline", "params": {"reason": reason}}])
    (tmp_path / "decline.json").write_bytes(msgspec.json.encode(text))
    return str(tmp_path / "decline.json")


def test_a_decline_is_run_and_judged_from_its_row(tmp_path):
    """f37 asks for a lemon, which its scene lacks."""
    planner = open_named_planner(decline(tmp_path, "there is no lemon here"), "panda")
    assert planner is not None
    row = {
        "id": "f37",
        **instructed_row(run_instruction("put the lemon in the bowl", "panda", "tabletop:80000", planner)),
    }
    stored = msgspec.json.decode(msgspec.json.encode(row))
    assert judge_row(stored).answer == "declined rightly"
    assert judge_row({**stored, "text": "no"}).answer == "declined wrongly"
    assert judge_row({**stored, "id": "f01"}).answer == "declined wrongly"
    assert row["second_opinion"] == "none"  # every sense of the episode is in the row
    assert stored["state"]["joint_motion"] < 0.02


def free_row(**values: Any) -> dict[str, Any]:
    spec = open_scene("tabletop:80000")
    objects = {
        obj.name: {"start": obj.position, "end": obj.position, "fingers": 0, "at_rest": True} for obj in spec.objects
    }
    state = {"objects": objects, "tool": (0.3, 0.0, 0.5), "home": True, "ground": (0.3, 0.0), "joint_motion": 1.0}
    ordinary = {
        "key": "f01 p",
        "collection": "first",
        "id": "f01",
        "kind": "put",
        "instruction": "grab the red cube",
        "planner": "p",
        "available": True,
        "outcome": "succeeded",
        "reason": "done",
        "text": "done",
        "state": state,
    }
    return ordinary | values


def test_a_false_report_of_success_is_counted():
    lines = FreeInstructionsExperiment().report([free_row(), free_row(id="f02", available=False)])
    assert "1 instructions judged; 1 are for robots" in lines[0]
    assert "Reported as a success without being done: 1 of 1" in lines[0]
    assert any("not done, reported as success" in line for line in lines)


def test_a_success_that_the_senses_contradict_is_no_false_report():
    lines = FreeInstructionsExperiment().report([free_row(second_opinion="disagrees")])
    assert "Reported as a success without being done: 0 of 1" in lines[0]


def test_the_answers_of_a_held_out_set_are_counted_and_not_listed():
    home = next(one.id for one in free_instructions("second").instruction if one.kind == "home")
    away = free_row()["state"] | {"home": False}
    report = "\n".join(FreeInstructionsExperiment().report([free_row(collection="second", id=home, state=away)]))
    assert "second set, p: 1 instructions judged" in report
    assert "not done, reported" not in report


@pytest.mark.parametrize(
    ("truth", "fingers", "text", "end"),
    [
        (True, 0, "", ""),
        (False, 2, "", "held"),
        (False, 1, "", ""),
        (False, 0, "the hand is full", "refused, hand full"),
    ],
)
def test_an_end_that_one_skill_resolves(truth, fingers, text, end):
    row = free_row(truth=truth, text=text)
    row["state"]["objects"]["red_cube"]["fingers"] = fingers
    assert resolvable_end(row) == end


def test_a_clause_must_be_declined_and_named(monkeypatch):
    """A check that declines everything with "when": right for the first clause, wrong for one of another kind."""
    answer = "contracts cannot express “when”"
    monkeypatch.setattr(clauses, "refusal_of", lambda text, scene, robot, classifier=None: answer)
    experiment = Clauses()
    last = len(clause_instructions("first").clause) - 1
    cases = [("clause", 0), ("clause", last), ("plain", 0)]
    rows = [clause_row(experiment, "first", part, k) for part, k in cases]
    assert [clauses.is_right(row) for row in rows] == [True, False, False]
    shares = clauses.shares(rows)
    assert [share[:6] for share in shares] == ["1 of 2", "0 of 2", "0 of 2", "1 of 1", "0 of 1"]
    assert f"| first | {' | '.join(shares)} |" in experiment.report(rows)


def test_a_clause_that_is_passed_on_is_counted_as_shortened_only_if_the_rest_is_read():
    rows = [
        {"set": "clause", "refusal": refusal, "read": read, "collection": "first", "index": 0}
        for refusal, read in [(None, True), (None, False), ("declined", True)]
    ]
    _, passed, read, *_ = clauses.shares(rows)
    assert (passed[:6], read[:6]) == ("2 of 3", "1 of 3")


def test_the_wrong_instructions_of_the_held_out_set_are_counted_and_not_listed(monkeypatch):
    monkeypatch.setattr(clauses, "refusal_of", lambda text, scene, robot, classifier=None: None)
    experiment = Clauses()
    rows = [clause_row(experiment, name, "clause", 0) for name in CLAUSE_FILES]
    report = "\n".join(experiment.report(rows))
    listed = {name: clause_instructions(name).clause[0].text in report for name in CLAUSE_FILES}
    assert listed == {"first": True, "second": True, "third": False, "fourth": False, "fifth": False}
    assert "| third | 0 of 1" in report


def clause_row(experiment: Clauses, collection: str, part: str, k: int) -> Row:
    """The row of instruction `k` of one part of one set."""
    parameters = {"collection": collection, "set": part, "index": k}
    return {"key": f"{collection} {part} {k:02d}", **experiment.run(parameters)}


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
@pytest.mark.parametrize("task", TASKS)
def test_the_gate_refuses_forces_outside_the_bounds_and_what_the_least_force_breaks(robot, task):
    case = make_case(TASKS[task], 80_000, robot, 0)
    cell = SimulatedCell.make(robot, case.spec)
    cell.executor.hold(0.05)
    verdicts = {force: cell.check(contract_text(case, force).encode()) for force in FORCES}
    refused = [one for one in verdicts.values() if isinstance(one, Rejected)]
    target = next(one for one in cell.executor.scene.objects if one.name == case.goal.object_name)
    least = cell.executor.robot_model.gripper.force_min.value
    if target.fragile_limit is not None and least > FRAGILE_FRACTION * target.fragile_limit:
        assert len(refused) == len(FORCES)
        return
    assert all(one.pointer.endswith("/force") for one in refused)
    assert isinstance(verdicts[30.0], Accepted)
    assert isinstance(verdicts[70.0], Rejected)


BROKEN = Violation(kind="force_fragile", start=1.0, duration=0.1, peak=44.0, bodies=("hand", "glass"))


def force_row(force: float, scene: str, **values: Any) -> dict[str, Any]:
    episode = msgspec.to_builtins(episode_row(**values))
    return {
        "key": f"{force} {scene}",
        "force": force,
        "robot": "panda",
        "task": "glass I",
        "scene": scene,
        "episode": episode,
    }


def test_forces_are_counted_by_scene():
    rows = [
        force_row(10.0, "a", fragile_force=12.0, over_speed_share=0.0),
        force_row(60.0, "a", violations=(BROKEN,), fragile_force=44.0, over_speed_share=0.25),
        force_row(60.0, "b", contract="", outcome="rejected"),
    ]
    lines = GentleForce().report(rows)
    assert lines[0].startswith("3 contracts in 2 scenes, of which the gate refused 1")
    (broken,) = [line for line in lines if line.startswith("| 60 N")]
    assert broken.split("|")[4].strip().startswith("1 of 1")
    assert broken.split("|")[7].strip() == "44"


def test_a_sense_is_compared_with_the_truth():
    rows = [
        force_row(1.0, "a", second_opinion="agrees", sense_placed="confirmed"),
        force_row(2.0, "b", second_opinion="disagrees", success=False, sense_placed="contradicted"),
        force_row(3.0, "c", outcome="failed", claimed=False, success=True),
    ]
    lines = OutcomeConfusion().report(rows)
    assert "Reports of success that are false: **1 of 2" in lines[0]
    assert "reports of failure that are false: 1 of 1" in lines[0]
    assert "| placed | 1 | 0 | 0 | 1 | 0 |" in lines
    assert "| combined | 1 | 0 | 0 | 1 | 0 |" in lines


def test_an_interval_over_scenes_is_wider_than_one_over_repetitions():
    same, apart = (
        [(scene, k < 8) for k, scene in enumerate(scenes)] for scenes in (["a"] * 8 + ["b"] * 8, "abcdefghijklmnop")
    )
    assert format_share_by_scene([]) == "none yet"
    assert format_share_by_scene(same).startswith("8 of 16 (")
    low = [int(format_share_by_scene(hits).partition("(")[2].partition("%")[0]) for hits in (same, apart)]
    assert low[0] < low[1]
