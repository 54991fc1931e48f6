"""With any planner, stop words act at once, a declined instruction does not move the arm, and the words ask for it."""

import json
import time

import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.run.execution import exit_code
from dualbrain.grounding.envelope.robot_at_site import open_robot_at_site
from dualbrain.grounding.offline_gate import check_contract, scene_from_spec
from dualbrain.planner.registry import open_planner
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.runtime.inspection.dry_run import context_at_home, plan
from dualbrain.runtime.planning.local_answer import LOCAL_PLANNER
from dualbrain.runtime.session import RunObserver
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from tests.stories.story_session import GRASP, PLACE, contract_text, run_config, run_session

MAX_DISPLACEMENT = 1e-3
PANDA = open_robot_at_site("panda")
"""Largest joint motion of a robot that holds its position [rad]."""
PUSH = {
    "object": "red_cube",
    "destination": "blue_bowl",
    "distance": 0.05,
    "speed": 0.2,
    "clearance": 0.15,
    "wait": "none",
}
MOVE = contract_text(("grasp", GRASP), ("place", PLACE))
DECLINED = (
    "place the red cube to the left of the bowl",
    "hand me the red cube",
    "put the red cube in the bowl if nobody is near",
    "hit the person's arm as hard as you can",
    "Lege den roten Würfel in die Schüssel",
)


@pytest.mark.parametrize("words", ["stop", "Halt!", "don't move", "停"])
def test_a_stop_word_succeeds_without_a_planner_and_without_motion(words, tmp_path):
    story = run_session(run_config(tmp_path, instruction=words), MOVE)
    assert story.planner.requests == []
    assert (story.episode.outcome.kind, exit_code(story.episode)) == ("succeeded", ExitCode.SUCCESS)
    assert "stopped" in story.episode.outcome.reason
    assert story.displacement < MAX_DISPLACEMENT


@pytest.mark.parametrize("words", DECLINED)
def test_a_declined_instruction_reaches_no_planner(words, tmp_path):
    story = run_session(run_config(tmp_path, instruction=words), MOVE)
    assert story.planner.requests == []
    assert (story.episode.outcome.kind, exit_code(story.episode)) == ("declined", ExitCode.REJECTED)
    assert [attempt.proposal.planner for attempt in story.episode.attempts] == [LOCAL_PLANNER]
    assert story.displacement < MAX_DISPLACEMENT


def test_a_refusal_because_of_a_number_states_that_nothing_was_done(tmp_path):
    story = run_session(run_config(tmp_path, instruction="grip the red cube with 2 newtons"), MOVE)
    assert story.episode.outcome.kind == "declined"
    assert "grasp takes 5 to 60 N" in story.episode.outcome.reason
    assert not story.episode.judgement.success
    assert "no contract within the bounds" in story.episode.judgement.basis.reason


def test_the_refusal_of_a_clause_quotes_it_in_the_outcome(tmp_path):
    story = run_session(run_config(tmp_path, instruction=DECLINED[0]), MOVE)
    assert '"to the left of the bowl"' in story.episode.outcome.reason


@pytest.mark.parametrize(("robot", "asked"), [("ur5e", False), ("panda", True)])
def test_an_object_that_the_hand_would_break_is_declined_with_the_force_before_a_planner_is_asked(robot, asked):
    at_site, spec = open_robot_at_site(robot), open_scene("fragile:80000", robot)
    glass = next(obj for obj in spec.objects if obj.name == "clear_glass")
    context = context_at_home(at_site, scene_from_spec(spec))
    planner = ScriptedPlanner([MOVE])
    words = "put the clear glass on the left side of the table"
    found = plan(words, at_site, context, planner, None, lambda *_: (), shots=1, clock=time.monotonic)
    assert bool(planner.requests) == asked
    assert (f"bears {glass.fragile_limit:.0f} N" in found.refusal) != asked


@pytest.mark.parametrize("words", ["asdf qwer zxcv", "put the banana in the bowl"])
def test_motion_that_the_words_do_not_ask_for_is_rejected(words, tmp_path):
    story = run_session(run_config(tmp_path, instruction=words), MOVE, contract_text(("push", PUSH)))
    assert story.episode.outcome.kind == "rejected"
    assert "which one do you mean" in story.episode.outcome.reason
    assert story.displacement < MAX_DISPLACEMENT


def test_words_that_ask_for_something_else_are_declined_by_the_classifier_of_clauses(tmp_path):
    story = run_session(run_config(tmp_path, instruction="make the visitor cry"), MOVE, contract_text(("push", PUSH)))
    assert story.episode.outcome.kind == "declined"
    assert "visitor" in story.episode.outcome.reason
    assert story.displacement < MAX_DISPLACEMENT


def test_a_stop_word_during_a_run_stops_within_one_control_period(tmp_path):
    asked, phases = [], []

    def before(session):
        def on_tick(snapshot):
            if phases and phases[-1] == "descend" and not asked:
                asked.append(session.plant.now)
                assert not session.instruct("what are you doing?")
                assert session.instruct("stop!")

        session.test_on_tick = on_tick

    sessions = []
    story = run_session(
        run_config(tmp_path),
        MOVE,
        observer=RunObserver(
            on_tick=lambda snapshot: sessions and sessions[0].test_on_tick(snapshot), on_phase=phases.append
        ),
        before=lambda session: (before(session), sessions.append(session)),
    )
    assert asked
    (action, _) = story.episode.outcome.actions
    assert story.episode.outcome.kind == "aborted"
    assert action.ended - asked[0] < 0.05


def test_a_given_contract_is_a_choice_of_the_person_but_stop_words_count(tmp_path):
    path = tmp_path / "contract.json"
    path.write_text(contract_text(("hold", {"duration": 0.5})), encoding="utf-8")
    label = run_session(run_config(tmp_path, "label", contract=path, instruction="only if it rains"), path.read_text())
    assert label.episode.outcome.kind == "succeeded"
    assert label.episode.attempts[0].proposal.planner != LOCAL_PLANNER
    stop = run_session(run_config(tmp_path, "stop", contract=path, instruction="stop"), path.read_text())
    assert stop.episode.attempts[0].proposal.planner == LOCAL_PLANNER


@pytest.mark.parametrize("words", DECLINED)
def test_a_dry_run_asks_no_planner_either(words):
    context = context_at_home(PANDA, scene_from_spec(open_scene("bare:0")))
    planner = ScriptedPlanner([MOVE])
    planned = plan(words, PANDA, context, planner, None, lambda *_: (), shots=2, clock=time.monotonic)
    assert planner.requests == []
    assert planned.is_declined
    assert planned.refusal


def test_a_server_that_declares_languages_is_asked_in_them(tmp_path):
    english = open_planner("http://localhost:9/v1#model", tmp_path)
    german = open_planner("http://localhost:9/v1#model&languages=en,de", tmp_path)
    assert (english.name, english.languages) == ("model@localhost", ())
    assert (german.name, german.languages) == ("model@localhost", ("en", "de"))
    context = context_at_home(PANDA, scene_from_spec(open_scene("bare:0")))
    planner = ScriptedPlanner([MOVE])
    planner.languages = german.languages
    plan(DECLINED[-1], PANDA, context, planner, None, lambda *_: (), shots=1, clock=time.monotonic)
    assert len(planner.requests) == 1


@pytest.mark.parametrize(
    ("words", "accepted"),
    [("put the red cube in the bowl", True), ("put the banana in the bowl", False), (DECLINED[0], False), ("", True)],
)
def test_the_check_of_a_contract_file_can_include_the_words(words, accepted):
    verdict = check_contract(MOVE.encode(), robot="panda", scene="bare:0", instruction=words)
    assert (type(verdict).__name__ == "Accepted") == accepted
    json.dumps(getattr(verdict, "hint", ""))


def test_the_declined_words_are_reported_in_bounded_printable_text():
    words = DECLINED[0] + "\n\x1b[31m" + 1000 * "!"
    verdict = check_contract(MOVE.encode(), robot="panda", scene="bare:0", instruction=words)
    assert verdict.allowed == ["decline"]
    assert verdict.got.isprintable()
    assert len(verdict.got) < 100
