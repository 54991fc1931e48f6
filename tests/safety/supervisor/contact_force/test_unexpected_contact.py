"""Closed loop: an arm that hits an obstacle it does not see yields within the declared time, and only then."""

import msgspec
import numpy as np
import pytest

from dualbrain.control.recording.channels import FilterCall, read_recording, read_trace
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.replay import replay
from dualbrain.control.recording.trace import Trace
from dualbrain.safety.contact_force.limits import ContactForceLimits
from dualbrain.safety.supervisor.checks import CHECKS
from tests.safety.supervisor.contact_force.hidden_obstacle import GRASP_AND_PLACE, HiddenObstacleCell

REACTION_TIME = 0.1
"""Declared time from the first contact to a force below the limit of an unexpected contact [s]."""
DETECTION_TIME = 0.012
"""Declared time from the first contact to the decision [s]: the window, the filter and one control period."""
LIMIT = ContactForceLimits().unexpected.value


def hit(robot="panda", seed=0, *, supervised=True):
    """The cell after a grasp into the hidden wall, its outcome, forces [N] and times after the first contact [s]."""
    cell = HiddenObstacleCell(seed, robot=robot, supervised=supervised)
    outcome = cell.run(speed=0.4)
    return cell, outcome, np.array(cell.forces), np.array(cell.times) - cell.first_contact()


@pytest.mark.parametrize(("robot", "seed"), [("panda", 0), ("panda", 3), ("ur5e", 2)])
def test_the_arm_yields_to_an_obstacle_that_it_does_not_see(robot, seed):
    cell, outcome, forces, times = hit(robot, seed)
    (first, check), *_ = cell.orders()
    assert check == "unexpected_contact"
    assert first - cell.first_contact() <= DETECTION_TIME
    assert forces[times > REACTION_TIME].max(initial=0.0) < LIMIT
    cell.loop.hold(0.2)
    assert not cell.loop.safety_controller.drive_wanted  # the stop ends with the drive off
    assert outcome.kind == "stopped"
    assert "a force of" in outcome.reason


def test_without_the_check_the_arm_presses_on():
    _, _, forces, times = hit()
    _, _, unsupervised, unsupervised_times = hit(supervised=False)
    later, unsupervised_later = forces[times > 0.01], unsupervised[unsupervised_times > 0.01]
    assert unsupervised.max() > 1.5 * forces.max()
    assert unsupervised_later.sum() > 20.0 * later.sum()  # impulse after the impact


@pytest.mark.parametrize(
    ("robot", "seed"), [("panda", 11), pytest.param("panda", 12, marks=pytest.mark.slow), ("ur5e", 11)]
)
def test_a_grasp_and_a_placement_are_no_unexpected_contact(robot, seed):
    cell = HiddenObstacleCell(seed, robot=robot, wall=False)
    outcome = cell.run(*GRASP_AND_PLACE)
    assert "unexpected_contact" not in [check for _, check in cell.orders()]
    assert outcome.kind == "succeeded"


def test_the_next_contract_moves_the_arm_again():
    cell, *_ = hit()
    cell.run(("home", {"speed": 0.2}))
    assert cell.loop.safety_controller.drive_wanted
    assert cell.loop.safety_controller.decision.check == ""


def test_a_recorded_retreat_is_recomputed_bit_for_bit(tmp_path):
    path, trace = tmp_path / "episode.mcap", Trace(7)
    with Recorder(path, trace, when_full="wait") as recorder:
        recorder.episode(0.0, {"robot": "panda", "guard": True, "instruction": ""})
        HiddenObstacleCell(recorder=recorder, trace=trace).run(speed=0.4)
    resets = [m for m in read_recording(path) if isinstance(m, FilterCall) and m.name == "reset"]
    assert len(resets) > 1
    assert replay(path).identical
    back = read_trace(path)
    assert back is not None
    assert np.array_equal(back["torques"], trace["torques"])
    assert np.isfinite(back["torques"]).all()
    assert np.isnan(back["wrench"]).all()


def test_a_declared_sensor_that_delivers_nothing_is_reported():
    cell = HiddenObstacleCell(wall=False)
    cell.plant.robot_model = msgspec.structs.replace(cell.plant.robot_model, force_sensing=None)
    cell.loop.hold(0.05)
    texts = [event.text for event in cell.trace.events]
    assert sum("contact forces are not supervised" in text for text in texts) == 1


def test_the_check_ends_the_contract_in_a_controlled_stop():
    (check,) = [check for check in CHECKS if check.name == "unexpected_contact"]
    assert check.action.name == "CONTROLLED_STOP"
    assert check.contract_outcome == "stopped"
