"""The question to a planner: what it is reminded of, and everything that stands in the prompt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import msgspec

from dualbrain.contracts.canonical_form import reorder_contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.schema import decoding_schema, describe_skills
from dualbrain.grounding.scene_summary import summarise_scene
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Exemplar, FailureFeedback, Passage, RetrievedContext, Scene
from dualbrain.robots.model import RobotModel
from dualbrain.skills.registry import skill_registry

PassageRetriever = Callable[[str, str], tuple[Passage, ...]]
"""Instruction and scene summary → passages to show."""


class Retriever(Protocol):
    """What a question asks of memory."""

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
        """The `k` best exemplars, and warnings."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningContext:
    """From where a question is asked: the body, the scene as perceived, what is held, posture, the camera's picture."""

    robot_model: RobotModel
    scene: Scene
    holding: str | None
    posture: Posture
    image: ImageFeatures | None = None

    @property
    def registry(self) -> SkillRegistry:
        """The vocabulary of the body."""
        return skill_registry(self.robot_model)

    @property
    def summary(self) -> str:
        """The scene in symbols."""
        return summarise_scene(self.scene, self.holding)


def retrieve(
    instruction: str,
    context: PlanningContext,
    memory: Retriever,
    max_exemplars: int,
    retrieve_passages: PassageRetriever,
) -> RetrievedContext:
    """What bears on `instruction`: at most `exemplars` memories with warnings (none of both for 0), and passages."""
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
    instruction: str, context: PlanningContext, recall: RetrievedContext, setback: FailureFeedback | None = None
) -> PlanRequest:
    """The first question for `instruction`; `setback` is what became of the contract before, if there was one."""
    registry, names = context.registry, scene_names(context.scene)
    return PlanRequest(
        instruction=instruction,
        scene=context.summary,
        recall=in_prompt_order(recall, registry),
        robot=context.robot_model.name,
        registry_hash=registry.hash,
        skills_text=describe_skills(registry, names),
        schema=decoding_schema(registry, names),
        contract_id="c-0001",
        setback=setback,
    )


def in_prompt_order(recall: RetrievedContext, registry: SkillRegistry) -> RetrievedContext:
    """`recall` with every contract in the order in which a planner writes one.

    A ledger keeps keys sorted, for its hashes. A small model that is shown parameters in one order and was taught to
    write them in another loses its place.
    """

    def ordered(exemplars: tuple[Exemplar, ...]) -> tuple[Exemplar, ...]:
        return tuple(
            msgspec.structs.replace(one, contract=reorder_contract(one.contract, registry)) for one in exemplars
        )

    return msgspec.structs.replace(recall, exemplars=ordered(recall.exemplars), warnings=ordered(recall.warnings))
