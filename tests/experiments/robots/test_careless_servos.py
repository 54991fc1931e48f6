"""The simulated SO-101 sags, and a careless policy touches the table only without the guard."""

import numpy as np
import pytest

from dualbrain.errors import MissingDependencyError
from dualbrain.robots.loader import load_robot
from experiments.robots.so101 import careless_servos
from experiments.robots.so101.servo_arm import ServoArm, mjcf_file

SO101 = load_robot("so101")


@pytest.fixture(autouse=True)
def package():
    try:
        mjcf_file()
    except MissingDependencyError as missing:
        pytest.skip(str(missing))


def test_the_arm_sags_under_its_own_weight_and_more_under_a_load():
    stretched = (0.0, 0.4, -0.4, 0.0, 0.0, 0.5)
    empty, loaded = ServoArm(start=stretched), ServoArm(start=stretched, load=0.1)
    sags = [arm.command[:5] - arm.q for arm in (empty, loaded)]
    assert 0.03 < np.abs(sags[0]).max() < 0.3
    assert np.abs(sags[1]).max() > np.abs(sags[0]).max() + 0.01
    assert abs(sags[0][0]) < 0.01  # the vertical axis carries nothing


def test_only_the_guarded_arm_stays_clear():
    rows = {mode: careless_servos.run_episode(mode, 0, seconds=5.0) for mode in ("raw", "guarded")}
    assert rows["raw"]["touched"]
    assert rows["raw"]["force"] > 1.0
    assert not rows["guarded"]["touched"]
    assert rows["guarded"]["below"] == 0
    assert rows["guarded"]["clearance"] > 0.005
    assert rows["guarded"]["faults"] == 0
    assert rows["guarded"]["interventions"] > 0.05


def test_the_crate_is_clear_of_the_start_posture():
    for seed in range(careless_servos.SEEDS):
        heights = careless_servos.sphere_heights(np.array([SO101.home]), careless_servos.scene(seed))
        assert heights.min() > 0.0, seed
