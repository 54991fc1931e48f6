"""Builds the plant for a robot model: an arm on a table, a mobile base in a room, or a mobile manipulator."""

from __future__ import annotations

from dualbrain.robots.model import RobotModel
from dualbrain.simulation.plant.mobile_base_plant import MobileBasePlant
from dualbrain.simulation.plant.mobile_manipulator_plant import MobileManipulatorPlant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec


def make_plant(spec: SceneSpec, robot_model: RobotModel, *, visuals: bool = False) -> Plant:
    """The simulated scene `spec` with the robot `robot_model`; `visuals` as for `Plant`."""
    kind = (
        MobileManipulatorPlant
        if robot_model.is_mobile_manipulator
        else MobileBasePlant
        if robot_model.is_mobile
        else Plant
    )
    return kind(spec, robot_model, visuals=visuals)
