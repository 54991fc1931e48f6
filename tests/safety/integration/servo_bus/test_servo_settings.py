"""Settings of a guarded servo arm: obstacles of a site, the digest of the robot model, and refusals."""

import msgspec
import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.loader import encode_robot, load_robot
from dualbrain.safety.integration.servo_bus.servo_map import ServoCalibration
from dualbrain.safety.integration.servo_bus.servo_settings import ServoSettings, make_guarded_servos, model_digest
from tests.safety.integration.servo_bus.ideal_servos import KEYS, SO101

DIGEST = model_digest(SO101)


def obstacles(guarded):
    """Names of the obstacles that the filter knows."""
    return guarded.safety(np.array(SO101.home), np.zeros(5), np.zeros(5), 0.0).names.obstacles


def test_without_a_site_there_is_a_table_and_the_speed_of_the_tool_is_limited():
    guarded = make_guarded_servos(ServoSettings(model="so101", digest=DIGEST[:12].upper()), KEYS)
    assert guarded.period == 0.005
    assert guarded.guard.steps_per_action == 7
    assert guarded.safety.config.cartesian_speed == SO101.tool_speed.value
    assert obstacles(guarded) == ("table",)


def test_a_site_file_gives_planes_boxes_and_limits(tmp_path):
    site = tmp_path / "desk.toml"
    site.write_text(
        '[limits]\nvelocity = 0.5\n[[plane]]\nname = "desk"\npoint = [0, 0, 0]\ninward = [0, 0, 1]\nparts = ["arm"]\n'
        '[[keep_out]]\nname = "screen"\nposition = [0.0, 0.3, 0.2]\nhalf_extents = [0.2, 0.02, 0.2]\n'
    )
    settings = ServoSettings(model="so101", site=str(site), rate=100.0, action_rate=50.0)
    guarded = make_guarded_servos(settings, KEYS)
    assert guarded.period == 0.01
    assert guarded.guard.steps_per_action == 2
    assert {joint.velocity.value for joint in guarded.safety.robot_model.joints} == {0.5}
    assert set(obstacles(guarded)) == {"desk", "screen"}


def test_a_site_file_keeps_the_period_of_the_bus_and_does_not_remove_the_table(tmp_path):
    plane = '[[plane]]\nname = "desk"\npoint = [0, 0, 0]\ninward = [0, 0, 1]\nparts = ["arm"]\n'
    site = tmp_path / "desk.toml"
    site.write_text(f"[robot]\nperiod = 0.002\n{plane}")
    assert make_guarded_servos(ServoSettings(model="so101", site=str(site)), KEYS).period == 0.005
    site.write_text("[limits]\nvelocity = 0.5\n")
    with pytest.raises(ConfigurationError, match=r"no plane and no keep-out box.*Add at least one \[\[plane\]\]"):
        make_guarded_servos(ServoSettings(model="so101", site=str(site)), KEYS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"digest": "0" * 12}, f"has the digest {DIGEST[:12]}, expected is '000000000000'"),
        ({"digest": DIGEST[:4]}, "at least 8 digits"),
        ({"rate": 50.0}, r"rate of the servo bus \[1/s\]: got 50"),
        ({"action_rate": 400.0}, r"rate of the actions"),
        ({"site": "no_such.toml"}, "no site file"),
        ({"model": "so102"}, "so102"),
        ({"calibration": {"elbow": ServoCalibration(sign=-1)}}, "elbow"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(change, message):
    with pytest.raises((ConfigurationError, UnknownNameError), match=message):
        make_guarded_servos(ServoSettings(**{"model": "so101"} | change), KEYS)


def test_another_robot_and_a_model_that_is_not_identified_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="panda_joint1"):
        make_guarded_servos(ServoSettings(model="panda"), KEYS)
    changed = msgspec.structs.replace(
        SO101, tracking=msgspec.structs.replace(SO101.tracking, position_error=0.0, lag=0.0)
    )
    file = tmp_path / "body.json"
    file.write_bytes(encode_robot(changed))
    with pytest.raises(ConfigurationError, match=r"not identified.*as `tracking` in body.json"):
        make_guarded_servos(ServoSettings(model=str(tmp_path)), KEYS)
    assert model_digest(changed) != DIGEST
    assert model_digest(load_robot("so101")) == DIGEST
