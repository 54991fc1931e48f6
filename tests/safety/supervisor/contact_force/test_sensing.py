"""Force sensing from the robot file to the state: declared, shown, measured with its errors, sent and recorded."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dualbrain.control.gatekeeper.robot_link.packets import StatePacket, decode_from_robot, encode
from dualbrain.control.recording.channels import Ticks
from dualbrain.control.recording.trace import columns
from dualbrain.errors import ConfigurationError
from dualbrain.robots.importer.output.markdown import bound_rows
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import BUILTIN_ROBOTS, encode_robot, load_robot, read_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.contact_force.arm_dynamics import ArmDynamics
from dualbrain.safety.contact_force.monitor import ContactForceMonitor
from dualbrain.safety.supervisor.controller import SafetyController
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene

WITHOUT_DYNAMICS = ("base", "so101", "vx300s")


@pytest.mark.parametrize("robot", BUILTIN_ROBOTS)
def test_every_packaged_robot_states_its_force_sensing(robot):
    robot_model = load_robot(robot)
    rows = {name: (value, source) for _, name, value, source in bound_rows(robot_model)}
    value, source = rows["force sensing"]
    assert source
    assert (value == "none") == (robot in WITHOUT_DYNAMICS)
    assert ("moved mass" in rows) == (robot not in WITHOUT_DYNAMICS)


def test_sensing_is_loaded_from_a_file_of_the_user(tmp_path):
    panda = load_robot("panda")
    sensing = msgspec.structs.replace(panda.force_sensing, noise=(0.2,) * 7, provenance="measured at rest")
    file = tmp_path / "mine.json"
    file.write_bytes(encode_robot(msgspec.structs.replace(panda, force_sensing=sensing)))
    assert read_robot(file).force_sensing == sensing
    file.write_bytes(encode_robot(msgspec.structs.replace(panda, dynamics=None)))
    with pytest.raises(ConfigurationError, match="dynamics"):
        read_robot(file)


def test_a_robot_without_sensing_is_not_supervised():
    robot_model = msgspec.structs.replace(load_robot("panda"), force_sensing=None)
    controller = SafetyController(SafetyFilter(robot_model))
    assert controller.contact is None
    assert controller.accept_state(home_state(robot_model), 0.0)


def test_the_plant_measures_its_motors_with_the_declared_errors():
    robot_model = load_robot("panda")
    plant = Plant(make_scene("bare", 0, "panda"), robot_model)
    readings = []
    for _ in range(400):
        plant.advance()
        readings.append(plant.read().torques)
    still = np.zeros(7)
    weight = ArmDynamics(robot_model).torque(np.array(robot_model.home), still, still).own
    noise, accuracy = (
        np.array(values) for values in (robot_model.force_sensing.noise, robot_model.force_sensing.accuracy)
    )
    error = np.mean(readings, axis=0) - weight
    assert np.all(np.abs(error) < accuracy + 0.3 * noise)
    assert np.abs(error).max() > 0.1 * accuracy.max(), "the constant error is simulated"
    assert np.allclose(np.std(readings, axis=0), noise, rtol=0.2)
    assert plant.read().wrench is None


def test_the_plant_delivers_no_reading_that_is_not_declared():
    robot_model = msgspec.structs.replace(load_robot("panda"), force_sensing=None)
    plant = Plant(make_scene("bare", 0, "panda"), robot_model)
    plant.advance()
    assert (plant.read().torques, plant.read().wrench) == (None, None)


def test_a_reading_does_not_change_the_simulation():
    robot_model = load_robot("panda")
    plants = [
        Plant(make_scene("bare", 0, "panda"), one)
        for one in (robot_model, msgspec.structs.replace(robot_model, force_sensing=None))
    ]
    for plant in plants:
        for _ in range(50):
            plant.advance()
            plant.read()
    assert np.array_equal(plants[0].data.qpos, plants[1].data.qpos)


def test_packets_carry_readings_and_older_packets_none():
    robot_model = load_robot("panda")
    plant = Plant(make_scene("bare", 0, "panda"), robot_model)
    plant.advance()
    sent = plant.read()
    back = decode_from_robot(encode(StatePacket.from_state(sent))).to_robot_state()
    assert np.array_equal(back.torques, sent.torques)
    assert back.wrench is None
    whole = msgspec.msgpack.decode(encode(StatePacket.from_state(sent)))
    old = decode_from_robot(msgspec.msgpack.encode(whole[:-4])).to_robot_state()
    assert (old.torques, old.wrench, old.desired_v, old.desired_a) == (None, None, None, None)
    assert np.array_equal(old.q, sent.q)
    without_command = decode_from_robot(msgspec.msgpack.encode(whole[:-2])).to_robot_state()
    assert np.array_equal(without_command.torques, sent.torques)
    assert without_command.desired_v is None


def test_recordings_from_before_force_sensing_are_read():
    where = columns(7)
    old = {
        name: ([0.0] if place.stop - place.start == 1 else [[0.0] * (place.stop - place.start)])
        for name, place in where.items()
        if name not in ("torques", "wrench")
    }
    (row,) = Ticks(t=0.0, n=7, phases=("",), columns=old).rows()
    assert np.isnan(row[where["torques"]]).all()
    assert np.isnan(row[where["wrench"]]).all()
    assert not np.isnan(row[where["q"]]).any()


@pytest.mark.parametrize("bad", [(np.nan,), (np.inf,), (-np.inf,), (np.inf, -np.inf)])
def test_a_reading_that_is_not_finite_ends_the_estimate_until_the_next_window(bad):
    robot_model = load_robot("panda")
    plant, monitor = Plant(make_scene("bare", 0, "panda"), robot_model), ContactForceMonitor(SafetyFilter(robot_model))

    def states(count):
        for _ in range(count):
            plant.advance()
            yield plant.read()

    for state in states(20):
        monitor.update(state)
    assert monitor.force is not None
    (state,) = states(1)
    torques = state.torques.copy()
    torques[: len(bad)] = bad
    assert not monitor.update(replace(state, torques=torques))
    assert monitor.force is None
    for state in states(20):
        assert not monitor.update(state)
    assert np.isfinite(monitor.force.magnitude)
