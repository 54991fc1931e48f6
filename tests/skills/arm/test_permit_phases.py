"""The permits of the arm's skills: the routine of each skill enters every phase that its specification permits."""

from dataclasses import replace

import pytest

from dualbrain.robots.loader import load_robot
from dualbrain.skills.registry import ARM_SKILLS
from tests.skills.arm.test_skills_in_simulation import SkillCell, grasp, move_to, place

HOME = ("home", {"speed": 0.4})
PUSH = (
    "push",
    {
        "object": "red_cube",
        "destination": "blue_bowl",
        "distance": 0.05,
        "speed": 0.4,
        "clearance": 0.1,
        "wait": "none",
    },
)
SEQUENCES = {
    "grasp and place": (
        grasp(clearance=0.05, speed=0.4),
        move_to("table_left", clearance=0.15, speed=0.4),
        place(destination="table_left", clearance=0.25, speed=0.4),
    ),
    "release": (grasp(clearance=0.05, speed=0.4), ("release", {"speed": 0.4}), HOME),
    "push": (PUSH,),
}


def permitted_phases(skill):
    return {permit.phase for permit in ARM_SKILLS[skill].spec(load_robot("panda")).permits}


@pytest.mark.parametrize("name", SEQUENCES)
def test_a_routine_enters_every_phase_of_its_permits(name):
    cell = SkillCell()
    outcome = cell.run(*SEQUENCES[name])
    assert {action.status for action in outcome.actions} == {"done"}, outcome.reason
    entered = {tuple(event.text.split(": ")) for event in cell.trace.events if event.kind == "phase"}
    for skill, _ in SEQUENCES[name]:
        assert permitted_phases(skill) <= {phase for running, phase in entered if running == skill}, skill


def test_a_contract_that_begins_in_the_phase_of_the_last_stop_has_its_permits():
    """`place` is stopped when it begins to lower, and begins with lowering when it is repeated."""
    cell = SkillCell(seed=1)
    loop, lowered = cell.executor.loop, []
    cell.run(grasp())
    loop.inputs = replace(loop.inputs, interrupted=lambda: loop.phase == "lower" and not lowered)
    assert cell.run(place(destination="table_left")).kind == "aborted"
    lowered.append(True)
    again = len(cell.trace)
    outcome = cell.run(place(destination="table_left"))
    assert outcome.kind == "succeeded", outcome.reason
    assert cell.trace.phases[int(cell.trace["phase"][again])] == "lower"


def test_the_sequences_contain_every_skill_with_permits():
    used = {skill for sequence in SEQUENCES.values() for skill, _ in sequence}
    assert used == {skill for skill in ARM_SKILLS if permitted_phases(skill)}
