"""Setting a load down: the support bears it before the fingers open, wherever perception sees the support."""

import msgspec
import pytest

from dualbrain.simulation.perception.noisy_perception import PerceptionNoise
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.arm.place import MAX_OVERTRAVEL
from dualbrain.skills.kinematics.release_point import DROP_HEIGHT
from tests.skills.arm.test_skills_in_simulation import SkillCell, grasp, place

GLASS = "clear_glass"


class ShiftedPlaces:
    """A world in which every place is perceived `shift` [m] higher than it is."""

    def __init__(self, world, shift):
        self._world, self._shift = world, shift

    def perceive(self):
        scene = self._world.perceive()
        shifted = []
        for place_ in scene.places:
            x, y, z = place_.position
            shifted.append(msgspec.structs.replace(place_, position=(x, y, z + self._shift)))
        return msgspec.structs.replace(scene, places=tuple(shifted))

    def advance(self):
        self._world.advance()


def set_down(robot="panda", seed=1, shift=0.0):
    """The cell after a glass was placed, and the true height of the glass [m] at every tick of phase "open"."""
    cell = SkillCell("fragile_ii", seed=seed, noise=PerceptionNoise(), robot=robot)
    cell.executor.loop.world = ShiftedPlaces(cell.world, shift)
    heights, write = [], cell.plant.write

    def record(command):
        if cell.executor.loop.phase == "open":
            heights.append(cell.plant.true_pose(GLASS).position[2])
        write(command)

    cell.plant.write = record
    outcome = cell.run(
        grasp(object=GLASS, opening=0.08, finger_axis="across" if seed % 2 else "along", force=20.0, clearance=0.15),
        place(destination="coaster", clearance=0.15),
    )
    assert outcome.kind == "succeeded", outcome.reason
    return cell, heights


@pytest.mark.parametrize(
    ("robot", "seed", "shift"),
    [pytest.param("panda", 1, -0.003, marks=pytest.mark.slow), ("panda", 1, 0.003), ("ur5e", 2, 0.0)],
)
def test_the_support_bears_the_load_before_the_fingers_open(robot, seed, shift):
    cell, heights = set_down(robot, seed, shift)
    assert heights[0] - heights[-1] < 0.0005
    assert not cell.monitor.violations()


def test_a_support_far_below_its_perceived_height_is_not_searched_for():
    _, heights = set_down(shift=0.02)
    assert 0.02 - MAX_OVERTRAVEL - 0.001 < heights[0] - heights[-1] < 0.021


def test_without_force_sensing_the_load_is_released_at_the_drop_height(monkeypatch):
    monkeypatch.setattr(ArmController, "tool_force", None)
    _, heights = set_down()
    assert DROP_HEIGHT - 0.001 < heights[0] - heights[-1] < DROP_HEIGHT + 0.001
