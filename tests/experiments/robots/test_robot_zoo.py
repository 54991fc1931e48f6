"""A light sample of the proof `zoo`, an arm and a base; and that the list of robots leaves none out unsaid."""

import pytest

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterStatus
from experiments.robots.robot_zoo import KINEMATICS_TOLERANCE, ROBOTS_BY_NAME, RobotZoo, failure_reasons
from experiments.robots.zoo_adversary import run_attack
from experiments.robots.zoo_robots import EMPTY_FILES, EXCLUDED, ROBOTS, robots_folder


@pytest.mark.parametrize("name", ["ur3_robot", "tiago_base"])
def test_a_robot_that_nobody_here_wrote(name):
    row = RobotZoo().run({"robot": name}, scenes=1, steps=400, states=10)
    assert failure_reasons(row) == ""
    assert max(row["pose"], row["jacobian"]) < KINEMATICS_TOLERANCE
    assert row["coverage"] == 1.0


def test_a_mobile_manipulator_under_the_same_attack():
    """Arm and base driven at the worst at once; the whole proof is `test_no_h_below_zero_in_1e5_steps`."""
    account = run_attack(load_robot("mobile_panda"), seed=0, steps=500)
    assert account.n_below_zero == 0
    assert account.status[FilterStatus.FAULT] == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_no_h_below_zero_in_1e5_steps(seed):
    account = run_attack(load_robot("mobile_panda"), seed, 10_000)
    assert account.n_below_zero == 0
    assert account.status[FilterStatus.FAULT] == 0


def test_every_folder_of_the_package_is_made_or_named():
    folders = {
        path.parts[0] for path in (file.relative_to(robots_folder()) for file in robots_folder().rglob("*.urdf"))
    }
    made = {robot.file.split("/")[0] for robot in ROBOTS} | {name.split("/")[0] for name in EMPTY_FILES}
    named = {f"{name}_description" for names in EXCLUDED.values() for name in names}
    assert folders <= made | named
    assert len(ROBOTS_BY_NAME) == len(ROBOTS)
