"""An arm that hits an obstacle which perception does not report, and the true contact force."""

import msgspec
import mujoco
import numpy as np

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopObserver
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.core.geometry.shapes import Box
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.scenes.scene_spec import ObjectSpec
from dualbrain.simulation.world import SimulatedWorld
from tests.stories.story_session import GRASP, PLACE

HIDDEN = "hidden_wall"


class HiddenObstacleCell:
    """A grasp of the red cube with a thin wall between hand and cube that the robot does not perceive."""

    def __init__(self, seed=0, *, robot="panda", supervised=True, wall=True, recorder=None, trace=None):
        robot_model = load_robot(robot)
        sensed = robot_model if supervised else msgspec.structs.replace(robot_model, force_sensing=None)
        self._wall = wall
        self.spec = make_scene("bare", seed, robot)
        if wall:
            self.spec = self._with_wall(self.spec, robot_model)
        self.plant = Plant(self.spec, sensed)
        self.trace = Trace(robot_model.n) if trace is None else trace
        self._world = SimulatedWorld(
            self.plant, NoisyPerception(self.spec, PerceptionNoise(), np.random.default_rng(seed))
        )
        self.loop = ControlLoop(
            sensed,
            self.plant,
            self,
            SafetyFilter(sensed),
            FlightLog(self.trace, recorder),
            ControlLoopConfig(settle_time=0.1),
            LoopObserver(on_phase=self._world.set_phase),
        )
        self.executor = ContractExecutor(self.loop)
        self.forces, self.times = [], []
        """True force on the wall [N] and its time [s], once per tick."""

    @staticmethod
    def _with_wall(spec, robot_model):
        start = SafetyFilter(robot_model).tool(np.array(robot_model.home)).position
        x, y, _ = start + 0.5 * (np.array(spec.find("red_cube").position) - start)
        wall = ObjectSpec(
            name=HIDDEN,
            role="obstacle",
            shape=Box((0.02, 0.02, 0.3)),
            position=(float(x), float(y), 0.3),
            mass=1.0,
            colour="oak",
            category="wall",
            fixed=True,
        )
        return msgspec.structs.replace(spec, objects=(*spec.objects, wall))

    def perceive(self):
        scene = self._world.perceive()
        return msgspec.structs.replace(scene, objects=tuple(obj for obj in scene.objects if obj.name != HIDDEN))

    def advance(self):
        self._world.advance()
        self.forces.append(wall_force(self.plant) if self._wall else 0.0)
        self.times.append(self.plant.now)

    def run(self, *actions, **changes):
        sequence = tuple(Action(skill, params) for skill, params in actions or (("grasp", {**GRASP, **changes}),))
        return self.executor.execute(Contract("c-1", Context(self.spec.robot, ""), sequence))

    def first_contact(self):
        """Time of the first contact [s], None without one."""
        touched = np.flatnonzero(np.array(self.forces) > 0.0)
        return self.times[touched[0]] if len(touched) else None

    def orders(self):
        """(time, check) of every decision of the supervisor."""
        return [
            (event.t, event.data["check"])
            for event in self.trace.events
            if event.kind == "order" and "check" in event.data
        ]


GRASP_AND_PLACE = (("grasp", GRASP), ("place", PLACE))


def wall_force(plant):
    """Length of the total true contact force on the wall [N]."""
    body, total, wrench = int(plant.model.body(HIDDEN).id), np.zeros(3), np.zeros(6)
    for index, contact in enumerate(plant.data.contact[: plant.data.ncon]):
        if body in plant.model.geom_bodyid[[contact.geom1, contact.geom2]]:
            mujoco.mj_contactForce(plant.model, plant.data, index, wrench)
            total += contact.frame.reshape(3, 3).T @ wrench[:3]
    return float(np.linalg.norm(total))
