"""dualbrain lets an LLM plan for a robot without trusting it.

Plans are typed contracts that a gate validates, and every joint velocity passes a CBF-QP safety filter. The names in
`__all__` are the public API, with the sub-namespaces `dualbrain.safety`, `dualbrain.safety.barriers`,
`dualbrain.safety.control_affine`, `dualbrain.safety.higher_order`, `dualbrain.skills`, `dualbrain.memory`,
`dualbrain.evaluation`, `dualbrain.drivers` and `dualbrain.control`; all other modules are private. Names are imported
on first use, so that `import dualbrain` is light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dualbrain.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dualbrain.agent_api.robot import Robot
    from dualbrain.agent_api.submission import SubmissionReport
    from dualbrain.api import open_planner, run
    from dualbrain.contracts.contract import Contract
    from dualbrain.contracts.gate.gate import Gate
    from dualbrain.contracts.registry import SkillRegistry
    from dualbrain.contracts.scene_names import SceneNames
    from dualbrain.contracts.skill_spec import SkillSpec
    from dualbrain.contracts.verdict import Accepted, Rejected
    from dualbrain.control.recording.replay import replay
    from dualbrain.core.connectors import Connector
    from dualbrain.core.geometry.shapes import Box, Capsule, Cylinder, HalfSpace, Pose, Sphere
    from dualbrain.errors import ConfigurationError, DualbrainError, MissingDependencyError, UnknownNameError
    from dualbrain.knowledge.library import Library
    from dualbrain.memory.memory import Memory
    from dualbrain.planner.protocol import Planner
    from dualbrain.planner.request import PlanRequest
    from dualbrain.records import Judgement, Outcome, Proposal
    from dualbrain.robots.interface import Command, RobotInterface, RobotState
    from dualbrain.robots.loader import load_robot
    from dualbrain.robots.model import RobotModel
    from dualbrain.runtime.agent import Agent
    from dualbrain.runtime.assembly import CellOptions, SimulatedCell
    from dualbrain.runtime.config import RunObserver, RunResult
    from dualbrain.safety.cbf.config import FilterConfig
    from dualbrain.safety.cbf.filter import SafetyFilter
    from dualbrain.safety.cbf.obstacles import Contact, Obstacle
    from dualbrain.safety.cbf.result import FilterResult, FilterStatus
    from dualbrain.safety.integration.gym_env import FilteredEnv
    from dualbrain.safety.integration.policy_guard.guard import PolicyGuard
    from dualbrain.safety.integration.shadow_mode import ShadowFilter
    from dualbrain.safety.supervisor.actions import SafetyAction
    from dualbrain.safety.supervisor.controller import SafetyController
    from dualbrain.simulation.scenes.generators.tabletop import make_scene
    from dualbrain.simulation.scenes.scene_spec import SceneSpec
    from dualbrain.skills.registry import skill_registry

__version__ = "0.2.0"

_MODULES = {
    "agent_api.robot": ("Robot",),
    "agent_api.submission": ("SubmissionReport",),
    "api": ("open_planner", "run"),
    "contracts.contract": ("Contract",),
    "contracts.gate.gate": ("Gate",),
    "contracts.registry": ("SkillRegistry",),
    "contracts.scene_names": ("SceneNames",),
    "contracts.skill_spec": ("SkillSpec",),
    "contracts.verdict": ("Accepted", "Rejected"),
    "control.recording.replay": ("replay",),
    "core.connectors": ("Connector",),
    "core.geometry.shapes": ("Box", "Capsule", "Cylinder", "HalfSpace", "Pose", "Sphere"),
    "errors": ("ConfigurationError", "DualbrainError", "MissingDependencyError", "UnknownNameError"),
    "knowledge.library": ("Library",),
    "memory.memory": ("Memory",),
    "planner.protocol": ("Planner",),
    "planner.request": ("PlanRequest",),
    "records": ("Judgement", "Outcome", "Proposal"),
    "robots.interface": ("Command", "RobotInterface", "RobotState"),
    "robots.loader": ("load_robot",),
    "robots.model": ("RobotModel",),
    "runtime.agent": ("Agent",),
    "runtime.assembly": ("CellOptions", "SimulatedCell"),
    "runtime.config": ("RunObserver", "RunResult"),
    "safety.cbf.config": ("FilterConfig",),
    "safety.cbf.filter": ("SafetyFilter",),
    "safety.cbf.obstacles": ("Contact", "Obstacle"),
    "safety.cbf.result": ("FilterResult", "FilterStatus"),
    "safety.integration.gym_env": ("FilteredEnv",),
    "safety.integration.policy_guard.guard": ("PolicyGuard",),
    "safety.integration.shadow_mode": ("ShadowFilter",),
    "safety.supervisor.actions": ("SafetyAction",),
    "safety.supervisor.controller": ("SafetyController",),
    "simulation.scenes.generators.tabletop": ("make_scene",),
    "simulation.scenes.scene_spec": ("SceneSpec",),
    "skills.registry": ("skill_registry",),
}
"""Public names by the module that defines them."""
__all__ = [
    "Accepted",
    "Agent",
    "Box",
    "Capsule",
    "CellOptions",
    "Command",
    "ConfigurationError",
    "Connector",
    "Contact",
    "Contract",
    "Cylinder",
    "DualbrainError",
    "FilterConfig",
    "FilterResult",
    "FilterStatus",
    "FilteredEnv",
    "Gate",
    "HalfSpace",
    "Judgement",
    "Library",
    "Memory",
    "MissingDependencyError",
    "Obstacle",
    "Outcome",
    "PlanRequest",
    "Planner",
    "PolicyGuard",
    "Pose",
    "Proposal",
    "Rejected",
    "Robot",
    "RobotInterface",
    "RobotModel",
    "RobotState",
    "RunObserver",
    "RunResult",
    "SafetyAction",
    "SafetyController",
    "SafetyFilter",
    "SceneNames",
    "SceneSpec",
    "ShadowFilter",
    "SimulatedCell",
    "SkillRegistry",
    "SkillSpec",
    "Sphere",
    "SubmissionReport",
    "UnknownNameError",
    "__version__",
    "load_robot",
    "make_scene",
    "open_planner",
    "replay",
    "run",
    "skill_registry",
]

__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
