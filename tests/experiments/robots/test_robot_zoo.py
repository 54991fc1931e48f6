"""A small sample of experiment `robot_zoo`, an arm and a base; every robot of the package is listed or excluded."""

import pytest

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterStatus
from experiments.robots.zoo.robot_zoo import KINEMATICS_TOLERANCE, ROBOTS_BY_NAME, RobotZoo, failure_reasons
from experiments.robots.zoo.zoo_adversary import run_attack
from experiments.robots.zoo.zoo_robots import EMPTY_FILES, EXCLUDED, ROBOTS, robots_folder


@pytest.mark.parametrize("name", [pytest.param("ur3_robot", marks=pytest.mark.slow), "tiago_base"])
def test_a_foreign_robot_meets_the_claim(name):
    row = RobotZoo().run({"robot": name}, scenes=1, steps=400, states=10)
    assert failure_reasons(row) == ""
    assert max(row["pose"], row["jacobian"]) < KINEMATICS_TOLERANCE
    assert row["coverage"] == 1.0


def test_a_mobile_manipulator_withstands_the_adversary():
    """Adversarial motion of arm and base at once; `test_no_h_below_zero_in_1e5_steps` is the long run."""
    result = run_attack(load_robot("mobile_panda"), seed=0, steps=500)
    assert result.n_below_zero == 0
    assert result.status[FilterStatus.FAULT] == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_no_h_below_zero_in_1e5_steps(seed):
    result = run_attack(load_robot("mobile_panda"), seed, 10_000)
    assert result.n_below_zero == 0
    assert result.status[FilterStatus.FAULT] == 0


def test_every_folder_of_the_package_is_imported_or_excluded():
    folders = {
        path.parts[0] for path in (file.relative_to(robots_folder()) for file in robots_folder().rglob("*.urdf"))
    }
    imported = {robot.file.split("/")[0] for robot in ROBOTS} | {name.split("/")[0] for name in EMPTY_FILES}
    excluded = {f"{name}_description" for names in EXCLUDED.values() for name in names}
    assert folders <= imported | excluded
    assert len(ROBOTS_BY_NAME) == len(ROBOTS)
