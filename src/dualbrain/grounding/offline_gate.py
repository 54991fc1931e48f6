"""Gate check of a contract without a robot, on the initial scene of a run."""

from __future__ import annotations

from pathlib import Path

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.verdict import Accepted, Rejected, Verdict
from dualbrain.core.geometry.shapes import HalfSpace, Pose
from dualbrain.core.text import to_printable
from dualbrain.grounding.envelope.object_limits import with_object_limits
from dualbrain.grounding.envelope.robot_at_site import RobotAtSite, open_robot_at_site
from dualbrain.grounding.envelope.scene_rules import scene_rules
from dualbrain.grounding.instruction.correspondence import INSTRUCTION_POINTER, SceneVocabulary, find_mismatch
from dualbrain.grounding.instruction.goals.goal_coverage import find_uncovered
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.review import Refusal, review_instruction
from dualbrain.grounding.vocabulary import planner_grants, scene_names
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec, keep_out_objects
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.mobile_base.controller import BaseController
from dualbrain.skills.mobile_manipulator import MobileManipulatorController
from dualbrain.skills.registry import make_controller, skill_registry
from dualbrain.skills.skill import Observation


def check_contract(data: bytes, *, robot: str, scene: str, instruction: str = "", site: Path | None = None) -> Verdict:
    """The verdict of all gate stages, including the scene rules, on the contract `data` for `robot` at home in `scene`.

    With an `instruction`, a contract that the gate accepts must also be about these words. With the file of
    a `site` its limits, obstacles and grants apply.
    Raises `UnknownNameError` for an unknown robot or scene, and `ConfigurationError` for an invalid scene or site file.
    """
    at_site = open_robot_at_site(robot, site)
    registry = skill_registry(at_site.robot_model)
    perceived = with_object_limits(scene_from_spec(open_scene(scene, robot)), at_site.object_limits)
    gate = gate_at_home(at_site, perceived)
    verdict = gate.check(data, names=scene_names(perceived), principal=PLANNER, now=0.0)
    if not instruction or isinstance(verdict, Rejected):
        return verdict
    return _check_words(verdict, instruction, registry, perceived) or verdict


def _check_words(verdict: Accepted, instruction: str, registry: SkillRegistry, scene: Scene) -> Rejected | None:
    """The rejection of an accepted contract whose instruction is declined, differs, or asks for more."""
    review = review_instruction(instruction, registry, scene.receptive, scene.graspable)
    if all(action.skill == "decline" for action in verdict.contract.action_sequence):
        return None
    if isinstance(review, Refusal):
        return Rejected(
            stage="envelope",
            pointer=INSTRUCTION_POINTER,
            got=to_printable(instruction),
            allowed=["decline"],
            hint=review.reason,
        )
    names = SceneVocabulary(scene.graspable, scene.receptive)
    goal = read_goal(instruction, scene)
    return find_mismatch(verdict.contract, instruction, names) or find_uncovered(verdict.contract, goal, scene)


def gate_at_home(at_site: RobotAtSite, scene: Scene) -> Gate:
    """The gate for the robot at home at its site, in `scene`, which has the site's limits of objects."""
    registry = skill_registry(at_site.robot_model)
    grants = planner_grants(registry) if at_site.grants is None else at_site.grants
    return Gate(registry, grants, scene_rules(scene, _controller_at_home(at_site, scene)))


def controller_at_home(robot: str, scene: Scene) -> ArmController | BaseController | MobileManipulatorController:
    """The controller of `robot`, with the arm in its home posture and the base at its start, that observed `scene`."""
    return _controller_at_home(open_robot_at_site(robot), scene)


def _controller_at_home(
    at_site: RobotAtSite, scene: Scene
) -> ArmController | BaseController | MobileManipulatorController:
    robot_model = at_site.robot_model
    safety = SafetyFilter(robot_model, obstacles=at_site.fixed_obstacles)
    controller = make_controller(robot_model, safety)
    state = home_state(robot_model)
    controller.observe(Observation(state=state, scene=scene, now=0.0, tool=safety.tool(state.q)))
    return controller


def scene_from_spec(spec: SceneSpec) -> Scene:
    """The scene of a specification with exact poses, at rest, and without a person."""
    table = SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))
    objects = (
        SceneObject(
            name=obj.name,
            role=obj.role,
            shape=obj.shape,
            pose=Pose(obj.position, obj.quaternion),
            category=obj.category,
            colour=obj.colour,
            fragile_limit=obj.fragile_limit,
        )
        for obj in spec.objects
    )
    support = () if spec.region else (table,)
    return Scene(
        robot=spec.robot,
        stamp=0.0,
        version=1,
        objects=(*support, *objects, *keep_out_objects(spec, 0.0)),
        places=spec.places,
        region=spec.floor,
    )
