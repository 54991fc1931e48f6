"""The question to a planner: what it is reminded of, and everything that stands in the prompt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import msgspec

from dualbrain.contracts.canonical_form import canonical_order
from dualbrain.contracts.registry import Registry
from dualbrain.contracts.schema import decoding_schema, short_form
from dualbrain.grounding.scene_summary import summarise
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.memory.embedding.image_features import Picture
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Exemplar, Passage, Recall, Scene, Setback
from dualbrain.robots.model import Body
from dualbrain.skills.registry import registry_of

LookUp = Callable[[str, str], tuple[Passage, ...]]
"""Instruction and scene summary → passages to show."""


class Reminder(Protocol):
    """What a question asks of memory."""

    def recall(
        self, instruction: str, summary: str, state: Posture | None, robot: str, registry: str, *, k: int,
        image: Picture | None = None,
    ) -> Recall:  # fmt: skip
        """The `k` best exemplars, and warnings."""
        ...


@dataclass(frozen=True, slots=True)
class Standpoint:
    """From where a question is asked: the body, the scene as perceived, what is held, posture, the camera's picture."""

    body: Body
    scene: Scene
    holding: str | None
    posture: Posture
    image: Picture | None = None

    @property
    def registry(self) -> Registry:
        """The vocabulary of the body."""
        return registry_of(self.body)

    @property
    def summary(self) -> str:
        """The scene in symbols."""
        return summarise(self.scene, self.holding)


def reminded(instruction: str, here: Standpoint, memory: Reminder, exemplars: int, look_up: LookUp) -> Recall:
    """What bears on `instruction`: at most `exemplars` memories with warnings (none of both for 0), and passages."""
    summary, recall = here.summary, Recall()
    if exemplars:
        recall = memory.recall(
            instruction, summary, here.posture, here.body.name, here.registry.hash, k=exemplars, image=here.image
        )  # fmt: skip
    return msgspec.structs.replace(recall, passages=look_up(instruction, summary))


def question(instruction: str, here: Standpoint, recall: Recall, setback: Setback | None = None) -> PlanRequest:
    """The first question for `instruction`; `setback` is what became of the contract before, if there was one."""
    registry, names = here.registry, scene_names(here.scene)
    return PlanRequest(
        instruction, here.summary, as_written(recall, registry), here.body.name, registry.hash,
        short_form(registry, names), decoding_schema(registry, names), contract_id="c-0001", setback=setback,
    )  # fmt: skip


def as_written(recall: Recall, registry: Registry) -> Recall:
    """`recall` with every contract in the order in which a planner writes one.

    A ledger keeps keys sorted, for its hashes. A small model that is shown parameters in one order and was taught to
    write them in another loses its place.
    """

    def ordered(exemplars: tuple[Exemplar, ...]) -> tuple[Exemplar, ...]:
        return tuple(
            msgspec.structs.replace(one, contract=canonical_order(one.contract, registry)) for one in exemplars
        )

    return msgspec.structs.replace(
        recall, exemplars=ordered(recall.exemplars), warnings=ordered(recall.warnings)
    )  # fmt: skip
