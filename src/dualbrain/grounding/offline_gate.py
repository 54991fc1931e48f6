"""Looking at a contract without a robot: the gate on a scene as it would be at the start of a run."""

from __future__ import annotations

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Verdict
from dualbrain.core.geometry.shapes import HalfSpace, Pose
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import load_skill_registry, planner_grants, scene_names
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec, keep_out_objects
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.mobile_base.controller import BaseController
from dualbrain.skills.mobile_manipulator import MobileManipulatorController
from dualbrain.skills.registry import make_controller
from dualbrain.skills.skill import Observation


def check_contract(data: bytes, *, robot: str, scene: str) -> Verdict:
    """What the gate says of `data` for `robot` at home in front of `scene`, all three stages and the scene's rules."""
    registry = load_skill_registry(robot)
    seen = scene_from_spec(open_scene(scene, robot))
    limb = controller_at_home(robot, seen)
    gate = Gate(registry, planner_grants(registry), scene_rules(seen, limb))
    return gate.check(data, names=scene_names(seen), principal=PLANNER, now=0.0)


def controller_at_home(robot: str, scene: Scene) -> ArmController | BaseController | MobileManipulatorController:
    """An arm at its home posture, a base at its start, or both, that sees `scene`."""
    robot_model = load_robot(robot)
    safety = SafetyFilter(robot_model)
    limb = make_controller(robot_model, safety)
    state = home_state(robot_model)
    limb.observe(Observation(state=state, scene=scene, now=0.0, tool=safety.tool(state.q)))
    return limb


def scene_from_spec(spec: SceneSpec) -> Scene:
    """The scene as its specification puts it: exact poses, nothing moving."""
    table = SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))
    things = (
        SceneObject(
            name=thing.name,
            role=thing.role,
            shape=thing.shape,
            pose=Pose(thing.position, thing.quaternion),
            category=thing.category,
            colour=thing.colour,
            fragile_limit=thing.fragile_limit,
        )
        for thing in spec.objects
    )
    support = () if spec.region else (table,)
    return Scene(
        robot=spec.robot,
        stamp=0.0,
        version=1,
        objects=(*support, *things, *keep_out_objects(spec, 0.0)),
        places=spec.places,
        region=spec.floor,
    )
