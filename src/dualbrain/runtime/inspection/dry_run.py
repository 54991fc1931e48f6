"""Planning without a robot: the question, the answer and the gate's word, and nothing moves.

The same question and the same gate as in a run, from the scene as it is specified (a run sees it with perception's
errors), with the body at home. Memory and documents are only read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import msgspec

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Accepted, Rejected, Verdict
from dualbrain.core.text import storable_text
from dualbrain.grounding.offline_gate import controller_at_home
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import planner_grants, scene_names
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.planner.introspection import planner_messages, planner_template, unsupported_fields
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED, ChatMessage
from dualbrain.planner.protocol import Planner, has_answer
from dualbrain.records import Attempt, Proposal, RetrievedContext, Scene
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.episode import reject_incomplete
from dualbrain.runtime.planner_request import PassageRetriever, PlanningContext, Retriever, build_request, retrieve
from dualbrain.runtime.planning_time import Clock, decision_timings

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Shot:
    """One question and its answer: what the planner read, what it wrote, what the gate said."""

    prompt: tuple[ChatMessage, ...]
    attempt: Attempt


@dataclass(frozen=True, slots=True, kw_only=True)
class DryRunResult:
    """What became of an instruction: the scene in symbols, what was retrieved, every shot, the time of the decision.

    `template` is the hash of the fixed text of the prompt that the planner read.
    """

    summary: str
    recall: RetrievedContext
    shots: tuple[Shot, ...]
    timings: dict[str, float]
    template_hash: str

    @property
    def verdict(self) -> Verdict:
        """The gate's last word."""
        return self.shots[-1].attempt.verdict

    @property
    def unsupported_fields(self) -> tuple[str, ...]:
        """What was retrieved and has no place in the prompt of this planner: fields of `recall`."""
        return unsupported_fields(self.template_hash, self.recall)

    @property
    def has_answer(self) -> bool:
        """Whether the planner said anything at all."""
        return has_answer(self.shots[-1].attempt.proposal)

    @property
    def is_declined(self) -> bool:
        """Whether the planner refused the instruction."""
        verdict = self.verdict
        return isinstance(verdict, Accepted) and verdict.contract.action_sequence[0].skill == "decline"


def context_at_home(robot: str, scene: Scene) -> PlanningContext:
    """`robot` at rest at home with an empty hand before `scene`."""
    robot_model = load_robot(robot)
    state = home_state(robot_model)
    return PlanningContext(
        robot_model=robot_model, scene=scene, holding=None, posture=Posture(tuple(state.q.tolist()), state.opening)
    )


def plan(
    instruction: str,
    context: PlanningContext,
    planner: Planner,
    memory: Retriever | None,
    retrieve_passages: PassageRetriever,
    *,
    shots: int,
    clock: Clock,
) -> DryRunResult:
    """Ask `planner` for a contract, at most `shots` times, each time with the gate's last refusal in the prompt."""
    recall, retrieval = _timed(clock, lambda: _retrieve(instruction, context, memory, retrieve_passages))
    request = build_request(instruction, context, recall)
    limb = controller_at_home(context.robot_model.name, context.scene)
    gate = Gate(context.registry, planner_grants(context.registry), scene_rules(context.scene, limb))
    done: list[Shot] = []
    while len(done) < shots:
        prompt, proposal = tuple(planner_messages(planner, request)), planner.propose(request)
        verdict, spent = _timed(
            clock, lambda answer=proposal: reject_incomplete(answer) or _check(gate, answer, context.scene)
        )
        kept = msgspec.structs.replace(proposal, text=storable_text(proposal.text))
        done.append(Shot(prompt, Attempt(kept, verdict, spent)))
        if not isinstance(verdict, Rejected) or not has_answer(proposal):
            break
        request = msgspec.structs.replace(request, refusal=verdict, contract_id=f"c-{len(done) + 1:04d}")
    spent = decision_timings([one.attempt for one in done], retrieval)
    return DryRunResult(
        summary=context.summary,
        recall=recall,
        shots=tuple(done),
        timings=spent,
        template_hash=planner_template(planner),
    )


def _check(gate: Gate, answer: Proposal, scene: Scene) -> Verdict:
    data = answer.text.encode("utf-8", "surrogatepass")
    return gate.check(data, names=scene_names(scene), principal=PLANNER, now=0.0)


def _retrieve(
    instruction: str, here: PlanningContext, memory: Retriever | None, look_up: PassageRetriever
) -> RetrievedContext:
    if memory is None:
        return RetrievedContext(passages=look_up(instruction, here.summary))
    return retrieve(instruction, here, memory, MAX_RECALLED, look_up)


def _timed(clock: Clock, do: Callable[[], T]) -> tuple[T, float]:
    start = clock()
    return do(), clock() - start
