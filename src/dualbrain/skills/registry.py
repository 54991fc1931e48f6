"""Skills of a robot model: the registry that they form, and the execution of a skill with its parameters."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType

from dualbrain.contracts.contract import ParameterValue
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.robots.mobile_manipulator import extract_arm, extract_base
from dualbrain.robots.model import RobotModel
from dualbrain.skills import decline
from dualbrain.skills.arm import grasp, hold, home, move_to, place, push, release
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.mobile_base import drive_to, drive_to_pose, stop, turn_to
from dualbrain.skills.mobile_base.controller import BaseController
from dualbrain.skills.mobile_manipulator import MobileManipulatorController
from dualbrain.skills.skill import MotionModel, Nominal, Observation, SkillResult, SkillRoutine, SkillStatus
from dualbrain.skills.time_slicing import steps_per_tick

ARM_SKILLS: Mapping[str, ModuleType] = {
    "move_to": move_to,
    "grasp": grasp,
    "place": place,
    "push": push,
    "release": release,
    "hold": hold,
    "home": home,
    "decline": decline,
}
"""Skill modules of an arm, each with `spec(robot_model)` and `routine(arm, **params)`; add new skills here."""
BASE_SKILLS: Mapping[str, ModuleType] = {
    "drive_to": drive_to,
    "drive_to_pose": drive_to_pose,
    "turn_to": turn_to,
    "stop": stop,
    "decline": decline,
}
"""Skill modules of a mobile base; their `routine` gets a `BaseController`."""


MOBILE_MANIPULATOR_SKILLS: Mapping[str, ModuleType] = {**BASE_SKILLS, **ARM_SKILLS}
"""Skill modules of a mobile manipulator; each `routine` gets the controller of the part that it moves."""


def skill_modules(robot_model: RobotModel) -> Mapping[str, ModuleType]:
    """The skill modules of `robot_model`."""
    return (
        MOBILE_MANIPULATOR_SKILLS
        if robot_model.is_mobile_manipulator
        else BASE_SKILLS
        if robot_model.is_mobile
        else ARM_SKILLS
    )


def make_controller(
    robot_model: RobotModel, motion: MotionModel
) -> ArmController | BaseController | MobileManipulatorController:
    """The controller that the routines of `robot_model` use."""
    if robot_model.is_mobile_manipulator:
        return MobileManipulatorController(robot_model, motion)
    return BaseController(robot_model, motion) if robot_model.is_mobile else ArmController(robot_model, motion)


def skill_registry(robot_model: RobotModel) -> SkillRegistry:
    """The vocabulary P of `robot_model`, with its limits as bounds (paper 3.3)."""
    if not robot_model.is_mobile:
        return arm_skill_registry(robot_model)
    driving = tuple(module.spec(extract_base(robot_model)) for module in BASE_SKILLS.values())
    if not robot_model.is_mobile_manipulator:
        return SkillRegistry(robot_model.name, driving)
    taken = {spec.name for spec in driving}
    reaching = tuple(spec for spec in arm_skill_registry(extract_arm(robot_model)).skills if spec.name not in taken)
    return SkillRegistry(robot_model.name, (*driving, *reaching))


GRIPPER_SKILLS = ("grasp", "place", "release")
"""Skills that need a gripper that opens."""


def arm_skill_registry(robot_model: RobotModel) -> SkillRegistry:
    """The vocabulary P of an arm, with its limits as bounds (paper 3.3), without `GRIPPER_SKILLS` if it cannot grip."""
    opens = robot_model.gripper.opening.value > 0.0
    return SkillRegistry(
        robot_model.name,
        tuple(ARM_SKILLS[name].spec(robot_model) for name in ARM_SKILLS if opens or name not in GRIPPER_SKILLS),
    )


class SkillExecution:
    """A running skill: the map φ of paper 4.2."""

    def __init__(
        self,
        controller: ArmController | BaseController | MobileManipulatorController,
        skill: str,
        params: Mapping[str, ParameterValue],
    ) -> None:
        """Prepare `skill` with its validated parameters; nothing moves before the first call of `nominal`."""
        self.controller = controller
        part_controller = (
            controller.activate(skill in BASE_SKILLS)
            if isinstance(controller, MobileManipulatorController)
            else controller
        )
        self._routine: SkillRoutine = skill_modules(controller.robot_model)[skill].routine(part_controller, **params)
        self._steps_per_tick = steps_per_tick(controller.robot_model.period)
        self._phase = skill
        controller.take_load_event()

    def nominal(self, observation: Observation) -> Nominal | SkillResult | None:
        """The control of the next tick, or the result of the skill; None while it computes and the robot must rest."""
        self.controller.observe(observation)
        if event := self.controller.take_load_event():
            return SkillResult(SkillStatus.FAILED, f"{self._phase}: {event.describe()}", event.cause)
        for _ in range(self._steps_per_tick):
            try:
                nominal = next(self._routine)
            except StopIteration as over:
                return over.value
            if nominal is not None:
                self._phase = nominal.phase
                return (
                    self.controller.to_whole_body(nominal)
                    if isinstance(self.controller, MobileManipulatorController)
                    else nominal
                )
        return None
