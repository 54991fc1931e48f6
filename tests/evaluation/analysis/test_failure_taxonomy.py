"""Failure classes: the rule of each class, and the class of every reason that a skill can give."""

import ast
from pathlib import Path

import msgspec
import pytest

import dualbrain.skills
from dualbrain.control.contract_executor import TIME_LIMIT_REASON
from dualbrain.evaluation.analysis.failure_taxonomy import (
    FAILURE_CLASSES,
    FAILURE_TAXONOMY,
    PAPER_CLASSES,
    REASON_PARTS,
    FailureEvidence,
    classify_failure,
    failure_class_of,
)
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.records import ActionResult, FailureCause, Outcome, Violation
from dualbrain.runtime.planning.local_answer import UNGRASPABLE
from dualbrain.safety.supervisor.checks import CHECKS
from dualbrain.skills.arm.load_monitor import LoadEvent
from tests.evaluation.sample_rows import COLLISION, TOOL_SPEED, episode_row

ORDINARY = {
    "moved": True,
    "on_task": True,
    "declined": False,
    "outcome": "failed",
    "claimed": False,
    "violations": (),
    "perceived_error": 0.002,
    "perceived_bound": 0.009,
}
CLAIMED = {"claimed": True, "outcome": "succeeded"}
CRUSHED = Violation(kind="force_fragile", start=1.0, duration=0.1, peak=44.0, bodies=("hand", "glass"))
UNSEEN = Violation(kind="collision_env", start=1.0, duration=0.1, peak=14.0, bodies=("hand", "cup"), perceived=False)
DROPPED = Violation(kind="object_dropped", start=1.0, duration=0.1, peak=0.3, bodies=("cube",))
SHAKEN = Violation(kind="shaken_load", start=1.0, duration=0.1, peak=12.0, bodies=("glass",))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"bad_physics": True, "outcome": "stopped"}, "simulator"),
        ({"outcome": "aborted"}, "operator"),
        ({"outcome": "emergency", "reason": "the emergency stop was pressed"}, "operator"),
        ({"moved": False, "outcome": "rejected", "answered": False}, "communication"),
        ({"outcome": "stopped", "reason": "the connection to the commander is lost"}, "communication"),
        ({"perceived_error": 0.02}, "perception"),
        ({"violations": (UNSEEN,)}, "perception"),
        ({"outcome": "stopped", "reason": "the last observation of moving objects is too old"}, "perception"),
        ({"moved": False, "on_task": False}, "contract refused"),
        ({"outcome": "stopped", "reason": "KeyError: 'ghost'"}, "program error"),
        ({"moved": False, "on_task": False, "declined": True}, "needless decline"),
        ({"moved": False, "declined": True, "reason": f"{UNGRASPABLE} egg: it is wide."}, "beyond the hand"),
        ({"on_task": False, "outcome": "taken_over"}, "instruction misread"),
        (CLAIMED | {"violations": (CRUSHED,)}, "excessive force"),
        ({"violations": (CRUSHED, SHAKEN), "outcome": "taken_over"}, "excessive force"),
        (CLAIMED | {"violations": (SHAKEN,)}, "rough handling"),
        (CLAIMED | {"violations": (COLLISION,)}, "collision"),
        (CLAIMED | {"violations": (DROPPED,)}, "load lost"),
        ({"reason": "lift: red_cube slipped from the fingers"}, "load lost"),
        ({"reason": "close: the two-finger test felt nothing between the fingers"}, "grasp"),
        ({"reason": "carry: a person stayed in the way for 12 s"}, "person in the way"),
        ({"outcome": "taken_over", "reason": "no safe control for 50 ms: hand vs 'forearm' 3 mm"}, "infeasible"),
        ({"outcome": "stopped", "reason": "filter STOPPED for 50 ms"}, "infeasible"),
        ({"outcome": "taken_over", "reason": "lift: no progress for 1.5 s, 3 cm from the goal"}, "motion blocked"),
        ({"reason": f"{TIME_LIMIT_REASON}, 60 s"}, "motion blocked"),
        ({"outcome": "taken_over", "reason": "the contract was taken over"}, "motion blocked"),
        ({"reason": "nothing is held"}, "unmet precondition"),
        ({"reason": "red_cube is 12 cm from blue_bowl after letting go"}, "goal missed"),
        ({"outcome": "stopped", "reason": "the arm is not where its commands led it"}, "drive"),
        (CLAIMED | {"violations": (TOOL_SPEED,)}, "drive"),
        (CLAIMED, "false success"),
        (CLAIMED | {"reason": "dropped_ring is at blue_bowl"}, "false success"),
        ({}, "incomplete plan"),
    ],
)
def test_the_first_stage_that_failed_names_the_class(changes, expected):
    assert classify_failure(FailureEvidence(**(ORDINARY | changes))) == expected


def test_every_class_has_a_case_and_belongs_to_a_class_of_the_paper():
    (mark,) = test_the_first_stage_that_failed_names_the_class.pytestmark
    assert {expected for _, expected in mark.args[1]} == set(FAILURE_CLASSES)
    assert {one.paper_class for one in FAILURE_TAXONOMY} == set(PAPER_CLASSES)


def test_the_table_of_the_documentation_is_that_of_the_code():
    page = Path(__file__).parents[3] / "docs" / "reference" / "evaluation.md"
    rows = [f"| {one.name} | {one.definition} | {one.paper_class} |" for one in FAILURE_TAXONOMY]
    assert "\n".join(rows) in page.read_text("utf-8")


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_a_contract_that_a_check_ended_is_classified_by_the_cause_of_the_check(check):
    """The end of a contract by a check is no failure of the plan."""
    evidence = FailureEvidence(**(ORDINARY | {"outcome": "stopped", "reason": check.description}))
    assert evidence.check_cause is check.cause
    assert classify_failure(evidence) != "incomplete plan"


FAILED = {"success": False, "claimed": False, "outcome": "failed", "progress": 0.25, "frequency": 0.0}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "incomplete plan"),
        ({"success": True}, ""),
        ({"perceived_error": 0.02}, "perception"),
        ({"perceived_error": float("inf"), "perceived_bound": 0.0}, "perception"),
        ({"perceived_error": None, "perceived_bound": None}, "incomplete plan"),
        ({"contract": "", "outcome": "rejected"}, "contract refused"),
        ({"contract": "", "outcome": "rejected", "answers": [["", "error: status 401"]]}, "communication"),
        (
            {"contract": "", "outcome": "rejected", "answers": [["", "error: status 500"], ["{", "stop"]]},
            "contract refused",
        ),
        ({"contract": "", "outcome": "rejected", "answers": []}, "contract refused"),
        ({"contract": "", "outcome": "declined", "declined": True}, "needless decline"),
        (
            {"contract": "", "outcome": "declined", "declined": True, "reason": f"{UNGRASPABLE} egg: it is wide."},
            "beyond the hand",
        ),
        ({"outcome": "stopped", "reason": "KeyError: 'ghost'"}, "program error"),
        ({"physics_warnings": 2}, "simulator"),
        ({"progress": 0.75, "reason": f"{TIME_LIMIT_REASON}, 60 s"}, "motion blocked"),
        ({"claimed": True, "outcome": "succeeded", "violations": (CRUSHED,)}, "excessive force"),
    ],
)
def test_the_failure_class_is_computed_from_the_row_not_from_its_stored_class(changes, expected):
    """Also from a row that was read from JSON, which has no infinite numbers."""
    row = episode_row(**FAILED | {"failure": "frequent takeover"} | changes)
    stored = msgspec.json.decode(msgspec.json.encode(row), type=EpisodeRow)
    assert failure_class_of(row) == failure_class_of(stored) == expected


# --- reasons of the skills --------------------------------------------------------------------------------------------

CLASS_OF_CAUSE = {
    FailureCause.PRECONDITION: "unmet precondition",
    FailureCause.OUT_OF_REACH: "motion blocked",
    FailureCause.NO_PROGRESS: "motion blocked",
    FailureCause.PERSON: "person in the way",
    FailureCause.NOT_GRIPPED: "grasp",
    FailureCause.LOAD_SLIPPED: "load lost",
    FailureCause.LOAD_LOST: "load lost",
    FailureCause.GOAL_MISSED: "goal missed",
}
VALUES = {"why": "no progress for 1.5 s", "event.describe()": LoadEvent("red_cube").describe()}
"""Values of the parts of a reason that are words and not names or numbers."""


def skill_failures():
    """The source, reason and cause of each result of a skill that failed or was taken over."""
    for path in sorted(Path(*dualbrain.skills.__path__).rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        for call in ast.walk(tree):
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "SkillResult":
                status = ast.unparse(call.args[0])
                if status not in ("SkillStatus.DONE", "SkillStatus.RUNNING"):
                    yield f"{path.name}:{call.lineno}", status, reason_of(call.args[1], tree), call.args[2:]


def reason_of(node, tree):
    """The text of a reason, with a word in the place of each name and number."""
    if isinstance(node, ast.Name):
        assigned = (one for one in ast.walk(tree) if isinstance(one, ast.Assign))
        (node,) = (one.value for one in assigned if ast.unparse(one.targets[0]) == node.id)
    if isinstance(node, ast.Constant):
        return node.value
    assert isinstance(node, ast.JoinedStr), ast.unparse(node)
    parts = (one.value for one in node.values)
    return "".join(one if isinstance(one, str) else VALUES.get(ast.unparse(one), "7") for one in parts)


@pytest.mark.parametrize(("status", "reason", "causes"), [pytest.param(*one, id=at) for at, *one in skill_failures()])
def test_every_failure_of_a_skill_has_a_cause_and_a_reason_of_one_class(status, reason, causes):
    """Rows with the cause, and rows of earlier versions, which have only the reason, are in the same class."""
    assert status in ("SkillStatus.FAILED", "SkillStatus.TAKEN_OVER")
    (cause,) = (ast.unparse(one) for one in causes)
    cause = LoadEvent("red_cube").cause if cause == "event.cause" else FailureCause[cause.removeprefix("FailureCause.")]
    for recorded in (cause, ""):
        evidence = FailureEvidence(**ORDINARY | {"reason": reason, "cause": recorded})
        assert classify_failure(evidence) == CLASS_OF_CAUSE[cause], reason


def test_the_failures_of_all_skills_are_found():
    """Every cause occurs, so that the test above does not pass because it finds nothing."""
    found = [ast.unparse(causes[0]) for *_, causes in skill_failures()]
    assert len(found) >= 20
    assert {f"FailureCause.{one.name}" for one in FailureCause} - set(found) == {"FailureCause.LOAD_SLIPPED"}
    assert "event.cause" in found


@pytest.mark.parametrize(
    ("event", "cause"),
    [
        (LoadEvent("red_cube"), FailureCause.LOAD_LOST),
        (LoadEvent("red_cube", slip=0.02), FailureCause.LOAD_SLIPPED),
    ],
)
def test_a_change_of_the_load_is_a_lost_load(event, cause):
    assert event.cause is cause
    for recorded in (cause, ""):
        evidence = FailureEvidence(**ORDINARY | {"reason": f"carry: {event.describe()}", "cause": recorded})
        assert classify_failure(evidence) == "load lost"


def test_the_recorded_cause_decides_and_not_the_words_of_the_reason():
    misleading = {"reason": "lift: nothing is held, out of reach", "cause": FailureCause.NOT_GRIPPED}
    assert classify_failure(FailureEvidence(**ORDINARY | misleading)) == "grasp"


def test_every_cause_has_words_for_rows_without_a_cause():
    assert REASON_PARTS.keys() == set(FailureCause)
    assert CLASS_OF_CAUSE.keys() == set(FailureCause)


def test_the_cause_of_an_outcome_is_that_of_its_failed_action():
    done = ActionResult(skill="grasp", status="done", reason="holds a", started=0.0, ended=1.0, Delta=0.0)
    failed = msgspec.structs.replace(done, skill="place", status="failed", cause=FailureCause.GOAL_MISSED)
    assert Outcome(kind="succeeded", reason="", actions=(done,)).failure_cause is None
    outcome = Outcome(kind="failed", reason="", actions=(done, failed))
    assert outcome.failure_cause is FailureCause.GOAL_MISSED
    assert msgspec.json.decode(msgspec.json.encode(outcome), type=Outcome) == outcome
    older = {name: value for name, value in msgspec.to_builtins(done).items() if name != "cause"}
    assert msgspec.convert(older, ActionResult) == done
