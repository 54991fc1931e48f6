"""Numbers in an instruction: read with units, kept by accepted contracts, and declined if no skill takes them."""

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.parameter_domains import ParameterDomain
from dualbrain.grounding.envelope.robot_at_site import open_robot_at_site
from dualbrain.grounding.envelope.value_bounds import why_out_of_bounds, with_stated_values
from dualbrain.grounding.instruction.goals.goal_coverage import find_uncovered
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.stated_values import StatedValue, stated_values
from dualbrain.grounding.instruction.words import normalise
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.runtime.inspection.dry_run import context_at_home, plan
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from tests.grounding.outcome.tabletop_cases import BEFORE

PANDA = load_skill_registry("panda")
PUSH = {"object": "red_cube", "destination": "blue_bowl", "speed": 0.2, "clearance": 0.15, "wait": "none"}


@pytest.mark.parametrize(
    ("words", "values"),
    [
        ("put the cube in the bowl at 0.1 m/s", ["a speed of 0.1 m/s"]),
        ("at five centimetres per second", ["a speed of 0.05 m/s"]),
        ("half a metre per second", ["a speed of 0.5 m/s"]),
        ("grip it with no more than 15 newtons", ["a force of at most 15 N"]),
        ("grip it with 12N", ["a force of 12 N"]),
        (
            "lift the cube twenty centimetres and hold it for five seconds",
            ["a duration of 5 s", "a clearance of 0.2 m"],
        ),
        ("push the tin 8 cm, then lift the box 12 cm", ["a distance of 0.08 m", "a clearance of 0.12 m"]),
        ("hover 15 cm above the block", ["a clearance of 0.15 m"]),
        ("push it four inches", ["a distance of 0.102 m"]),
        ("be so kind as to put an orange tin in the bowl", []),
        ("the 5 cm cube into the bowl", []),
        ("wait a second, then half a second", ["a duration of 0.5 s"]),
    ],
)
def test_numbers_are_read_in_si_units(words, values):
    assert [str(one) for one in stated_values(normalise(words).text)] == values


def push_contract(distance):
    return Contract("c", Context("panda", "h"), (Action("push", PUSH | {"distance": distance}),))


@given(st.floats(0.03, 0.25), st.floats(0.03, 0.25))
def test_the_gate_and_the_decoder_admit_the_same_numbers(stated, proposed):
    value = StatedValue("distance", round(stated, 3))
    goal = read_goal(f"push the red cube {stated:.3f} m towards the bowl", BEFORE)
    assert goal.values == (value,)
    (part,) = with_stated_values({}, goal.values, PANDA)["push"]
    admitted = part.least["distance"] <= proposed <= part.most["distance"]
    assert admitted == value.admits(proposed)
    assert (find_uncovered(push_contract(proposed), goal, BEFORE) is None) == admitted


def test_a_contract_with_another_number_is_rejected_with_the_stated_one():
    goal = read_goal("push the red cube 8 cm towards the bowl at no more than 0.1 m/s", BEFORE)
    assert "speed of at most 0.1 m/s" in find_uncovered(push_contract(0.08), goal, BEFORE).hint
    goal = read_goal("push the red cube 8 cm towards the bowl at no more than 0.2 m/s", BEFORE)
    assert "distance of 0.08 m" in find_uncovered(push_contract(0.05), goal, BEFORE).hint
    assert find_uncovered(push_contract(0.08), goal, BEFORE) is None


def test_the_bounds_of_a_decoder_are_within_those_of_the_scene():
    domains = {"grasp": (ParameterDomain({"object": ("red_cube",)}, {"opening": 0.05}, {"force": 12.0}),)}
    (part,) = with_stated_values(domains, (StatedValue("force", 20.0, at_most=True),), PANDA)["grasp"]
    assert (part.admitted, part.least["opening"], part.most["force"]) == ({"object": ("red_cube",)}, 0.05, 12.0)
    assert with_stated_values({}, (StatedValue("speed", 0.1), StatedValue("speed", 0.3)), PANDA) == {}


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("grip the red cube with at most 3 newtons", "a force of at most 3 N, and grasp takes 5 to 60 N"),
        ("put the red cube in the bowl at 2 m/s", "a speed of 2 m/s, and move_to takes 0.05 to 0.4 m/s"),
        ("put the red cube in the bowl at 0.2 m/s", ""),
        ("put the red cube in the bowl at no more than 2 m/s", ""),
    ],
)
def test_a_number_that_no_skill_takes_is_declined_before_a_planner_is_asked(words, reason):
    at_site = open_robot_at_site("panda")
    context, planner = context_at_home(at_site, scene_from_spec(open_scene("bare:0"))), ScriptedPlanner(["{}"])
    found = plan(words, at_site, context, planner, None, lambda *_: (), shots=1, clock=time.monotonic)
    assert bool(planner.requests) == (reason == "")
    assert reason in found.refusal


def test_a_robot_without_the_parameter_takes_no_number_for_it():
    assert "no skill of this robot takes a force" in why_out_of_bounds(
        (StatedValue("force", 10.0),), load_skill_registry("base")
    )
