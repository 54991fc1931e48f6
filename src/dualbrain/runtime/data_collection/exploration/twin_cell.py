"""One robot in the kinematic twin of a scene, with the same gate, skills and filter as in the full simulation."""

from __future__ import annotations

from dualbrain.control.control_loop import ControlLoopConfig
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.assembly import SimulatedCell
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.twin.twin_plant import TwinPlant, twin_model
from dualbrain.simulation.twin.twin_world import TwinWorld

PERCEPTION_PERIOD, SETTLE_TIME = 0.05, 0.05
"""Time between two perceived scenes, and at rest after a contract [s]."""


def make_twin_cell(spec: SceneSpec, *, seed: int = 0, time_limit: float = float("inf")) -> SimulatedCell:
    """The twin of `spec`; a contract that has not ended after `time_limit` [s] of simulated time has failed.

    Raises `ConfigurationError` for a robot with a mobile base.
    """
    robot = load_robot(spec.robot)
    if robot.is_mobile:
        raise ConfigurationError("robot of a kinematic twin", got=spec.robot, allowed="an arm without a mobile base")
    model = twin_model(robot)
    return SimulatedCell(
        model,
        TwinWorld(TwinPlant(spec, model), seed=seed),
        config=ControlLoopConfig(perception_period=PERCEPTION_PERIOD, settle_time=SETTLE_TIME),
        time_limit=time_limit,
    )
