"""The end of a run is the beginning of the next: the same poses, posture and grip, for each kind of robot."""

import msgspec
import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.plant.end_state import load_end_state, read_end_state, save_end_state
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.moving_person import person_path


def moved_plant(robot="panda", scene="forearm:0"):
    """A plant whose robot has moved a little, half a second after the beginning."""
    plant = make_plant(open_scene(scene, robot), load_robot(robot))
    plant.set_configuration(plant.configuration() + 0.02)
    for _ in range(500):
        plant.step()
    return plant


@pytest.mark.parametrize(("robot", "scene"), [("panda", "forearm:0"), ("base", "crossing:1"), ("mobile_panda", "0")])
def test_a_restored_plant_has_the_same_poses_and_posture(tmp_path, robot, scene):
    plant = moved_plant(robot, scene)
    save_end_state(read_end_state(plant), tmp_path / "end.json")
    state = load_end_state(tmp_path / "end.json")
    again = make_plant(state.scene, plant.robot_model)
    again.restore(state.robot)
    assert np.array_equal(again.configuration(), plant.configuration())
    assert again.now == 0.0
    for obj in plant.spec.objects:
        assert again.true_pose(obj.name).position == pytest.approx(plant.true_pose(obj.name).position, abs=1e-12)
    assert again.state() == plant.state()


def test_a_person_continues_the_cycle():
    plant = moved_plant()
    path, later = (person_path(one.mover) for one in (plant.spec, read_end_state(plant).scene))
    for t in (0.0, 3.0, 9.0):
        assert later.state_at(t) == pytest.approx(path.state_at(t + plant.now))


def test_the_state_of_another_robot_is_refused():
    plant, other = make_plant(open_scene("bare:0"), load_robot("panda")), moved_plant("base", "empty_room:0")
    with pytest.raises(ConfigurationError, match="7 numbers"):
        plant.restore(other.state())
    with pytest.raises(ConfigurationError, match="fingers"):
        plant.restore(msgspec.structs.replace(plant.state(), fingers=(0.01,)))


@pytest.mark.parametrize("content", [b"", b"{}", b'{"scene": 1}', b"\xff"])
def test_a_file_that_is_no_end_of_a_run_is_refused(tmp_path, content):
    (tmp_path / "end.json").write_bytes(content)
    with pytest.raises(ConfigurationError, match="does not contain the end of a run"):
        load_end_state(tmp_path / "end.json")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_end_state(tmp_path / "missing.json")
