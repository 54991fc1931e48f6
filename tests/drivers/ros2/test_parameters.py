"""Parameters in the form of ROS 2: sections, types, names; every wrong entry is an error with a remedy."""

import pytest

from dualbrain.drivers.ros2.parameters import NodeParameters, parse_parameters, read_parameters
from dualbrain.errors import ConfigurationError, UnknownNameError

EVERY_NODE = b"""
/**:
  ros__parameters:
    robot: ur5e
    period: 0.008
    joints: [a, b]
    use_sim_time: true
"""


def parse(text, name="filter"):
    return parse_parameters(text, "node.yaml", name)


def test_parameters_of_every_node_are_read():
    found = parse(EVERY_NODE)
    assert (found.robot, found.period, found.joints, found.use_sim_time) == ("ur5e", 0.008, ("a", "b"), True)


@pytest.mark.parametrize("section", [b"filter", b"/filter"])
def test_the_section_of_the_node_replaces_the_common_one(section):
    found = parse(
        EVERY_NODE + section + b":\n  ros__parameters:\n    period: 0.004\nother:\n  ros__parameters:\n    x: 1\n"
    )
    assert (found.robot, found.period) == ("ur5e", 0.004)


def test_a_file_is_read(tmp_path):
    path = tmp_path / "node.yaml"
    path.write_bytes(EVERY_NODE)
    assert read_parameters(path, "filter").robot == "ur5e"
    with pytest.raises(ConfigurationError, match="no file"):
        read_parameters(tmp_path / "other.yaml", "filter")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "mapping"),
        (b"- 1\n", "mapping"),
        (b"a: [1", "not YAML"),
        (b"\xff\xfe\x00", "not YAML"),
        (b"!!python/object/apply:os.system ['true']", "not YAML"),
        (b"other:\n  ros__parameters:\n    robot: panda\n", "no parameters of filter"),
        (b"/**:\n  robot: panda\n", "ros__parameters"),
        (b"/**: 3\n", "ros__parameters"),
        (EVERY_NODE + b"    deviation: sideways\n", "deviation"),
        (EVERY_NODE + b"    command_timeout: soon\n", "command_timeout"),
        (EVERY_NODE + b"    command_timeout: .nan\n", "command_timeout"),
        (EVERY_NODE + b"    command_timeout: 0.0\n", "command_timeout"),
        (EVERY_NODE + b"    state_timeout: 0.001\n", "state_timeout"),
        (EVERY_NODE + b"    command_topic: 'a b'\n", "command_topic"),
        (EVERY_NODE + b"    command_topic: /x\n    safe_command_topic: x\n", "its own commands"),
        (EVERY_NODE + b"    check_description: off\n", "check_description"),
    ],
)
def test_wrong_entries_are_errors(text, words):
    with pytest.raises(ConfigurationError, match=words):
        parse(text)


def test_an_unknown_parameter_is_an_error_with_the_closest_name():
    with pytest.raises(UnknownNameError, match="Closest: 'command_timeout'"):
        parse(EVERY_NODE + b"    comand_timeout: 1.0\n")


def test_the_silence_of_joint_states_is_three_periods_by_default():
    assert NodeParameters(period=0.01).state_silence == pytest.approx(0.03)
    assert NodeParameters(period=0.01, state_timeout=0.05).state_silence == 0.05
