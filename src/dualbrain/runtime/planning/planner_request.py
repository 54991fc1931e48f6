"""The request to a planner: retrieved memories and passages, and all other inputs of the prompt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import msgspec

from dualbrain.contracts.canonical_form import reorder_contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.schema import DECLINE, decoding_schema, describe_skills
from dualbrain.grounding.envelope.grasp_fit import parameter_domains, ungraspable
from dualbrain.grounding.envelope.grasp_reach import arm_in_posture, within_reach
from dualbrain.grounding.envelope.scene_rules import skill_order
from dualbrain.grounding.envelope.value_bounds import with_stated_values
from dualbrain.grounding.instruction.goals.goal import Goal, Unread
from dualbrain.grounding.instruction.goals.goal_reading import corrected_instruction, read_goal
from dualbrain.grounding.instruction.goals.goal_scope import goal_scope
from dualbrain.grounding.scene_summary import summarise_scene
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.planner.camera_image import CameraImage
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Exemplar, FailureFeedback, Passage, Precedent, RetrievedContext, Scene
from dualbrain.robots.model import RobotModel
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.registry import skill_registry

PassageRetriever = Callable[[str, str], tuple[Passage, ...]]
"""Function (instruction, scene summary) → document passages for the prompt."""


class Retriever(Protocol):
    """A memory from which episodes are retrieved."""

    def retrieve(
        self,
        instruction: str,
        summary: str,
        state: Posture | None,
        robot: str,
        registry: str,
        *,
        k: int,
        image: ImageFeatures | None = None,
    ) -> RetrievedContext:
        """The `k` best exemplars, and warnings, for an `instruction` in a scene with the `summary`."""
        ...

    def find_precedents(
        self, summary: str, state: Posture | None, robot: str, registry: str, *, max_count: int
    ) -> tuple[Precedent, ...]:
        """At most `max_count` successes in similar scenes, of any instruction."""
        ...

    def find_outcomes(
        self, contract: dict[str, Any], robot: str, registry: str, *, max_count: int
    ) -> tuple[Precedent, ...]:
        """The newest `max_count` outcomes of the actions of `contract` in any scene."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningContext:
    """The situation in which a plan is requested: robot, perceived scene, held object, posture.

    `image` are the features for the memory, `camera_image` is the image for the planner; each is None if not requested.
    """

    robot_model: RobotModel
    scene: Scene
    holding: str | None
    posture: Posture
    image: ImageFeatures | None = None
    camera_image: CameraImage | None = None

    @property
    def registry(self) -> SkillRegistry:
        """The skill registry of the robot."""
        return skill_registry(self.robot_model)

    def make_arm(self) -> ArmController | None:
        """The arm in its present posture; None if it cannot grasp, or is on a base, with which its reach changes."""
        if self.robot_model.is_mobile or "grasp" not in self.registry.by_name:
            return None
        return arm_in_posture(self.robot_model, self.scene, self.posture.q, self.posture.opening)

    @property
    def summary(self) -> str:
        """The scene in symbols."""
        return summarise_scene(self.scene, self.holding)

    @property
    def summary_with_values(self) -> str:
        """The scene in symbols with fitting parameter values."""
        return summarise_scene(self.scene, self.holding, values=True)


def retrieve(
    instruction: str,
    context: PlanningContext,
    memory: Retriever,
    max_exemplars: int,
    retrieve_passages: PassageRetriever,
) -> RetrievedContext:
    """The context for `instruction`: at most `max_exemplars` memories with warnings (neither for 0), and passages."""
    summary, recall = context.summary, RetrievedContext()
    if max_exemplars:
        recall = memory.retrieve(
            instruction,
            summary,
            context.posture,
            context.robot_model.name,
            context.registry.hash,
            k=max_exemplars,
            image=context.image,
        )
    return msgspec.structs.replace(recall, passages=retrieve_passages(instruction, summary))


def build_request(
    instruction: str,
    context: PlanningContext,
    recall: RetrievedContext,
    failure_feedback: FailureFeedback | None = None,
    *,
    restrict: bool = True,
) -> PlanRequest:
    """The first request for `instruction`; `failure_feedback` is on the contract before, if there was one.

    With `restrict`, the schema admits only the names and skills that the goal of the instruction may need, if the goal
    was read; the text of the prompt has all. Misspelled names are corrected if the goal is read only so.
    """
    registry, names = context.registry, scene_names(context.scene)
    return PlanRequest(
        instruction=corrected_instruction(instruction, context.scene),
        scene=context.summary,
        recall=in_prompt_order(recall, registry),
        robot=context.robot_model.name,
        registry_hash=registry.hash,
        skills_text=describe_skills(registry, names),
        schema=answer_schema(
            instruction, context.scene, registry, context.holding, restrict=restrict, arm=context.make_arm()
        ),
        contract_id="c-0001",
        failure_feedback=failure_feedback,
        scene_with_values=context.summary_with_values,
        image=context.camera_image,
    )


def answer_schema(
    instruction: str,
    scene: Scene,
    registry: SkillRegistry,
    holding: str | None,
    *,
    restrict: bool = True,
    arm: ArmController | None = None,
) -> dict[str, Any]:
    """The decoding schema of the first answer to `instruction`; `restrict`: only what its goal may need.

    A goal whose objects do not fit the hand leaves the decline alone. With an `arm` in its present posture only grasps
    within its reach are admitted.
    """
    goal = read_goal(instruction, scene) if restrict else Unread("")
    scope = goal_scope(goal, scene, holding)
    domains = parameter_domains(scene, registry, holding, scope.names.graspable)
    order = skill_order([skill.name for skill in registry.skills], holding)
    if isinstance(goal, Goal) and ungraspable(goal, scene, domains, holding):
        return decoding_schema(registry, scope.names, order=order, skills=(DECLINE,))
    if arm is not None:
        domains = within_reach(domains, scene, arm, scope.names.graspable)
    if isinstance(goal, Goal):
        domains = with_stated_values(domains, goal.values, registry)
    return decoding_schema(
        registry, scope.names, order=order, domains=domains, skills=scope.skills, length=scope.length
    )


def in_prompt_order(recall: RetrievedContext, registry: SkillRegistry) -> RetrievedContext:
    """`recall` with the keys of every contract in the order in which a planner generates them.

    A ledger stores keys sorted, for its hashes. A small model that sees parameters in another order than the one it was
    trained to generate makes more errors.
    """

    def ordered(exemplars: tuple[Exemplar, ...]) -> tuple[Exemplar, ...]:
        return tuple(
            msgspec.structs.replace(one, contract=reorder_contract(one.contract, registry)) for one in exemplars
        )

    return msgspec.structs.replace(recall, exemplars=ordered(recall.exemplars), warnings=ordered(recall.warnings))
