"""Dry run: request, proposal and verdict of the gate, without motion.

Request and gate are those of a run. The scene is the specified one, without the errors of perception, and the robot is
at its home position. Memory and documents are only read.
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
from dualbrain.grounding.envelope.object_limits import with_object_limits
from dualbrain.grounding.envelope.robot_at_site import RobotAtSite
from dualbrain.grounding.instruction.clauses.clause_classifier import ClauseClassifier
from dualbrain.grounding.instruction.recalled_steps import fit_recall
from dualbrain.grounding.instruction.review import Refusal
from dualbrain.grounding.offline_gate import gate_at_home
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.planner.introspection import planner_messages, planner_template, unsupported_fields
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED, ChatMessage
from dualbrain.planner.protocol import Planner, has_answer
from dualbrain.records import Attempt, Proposal, RetrievedContext, Scene
from dualbrain.robots.interface import home_state
from dualbrain.runtime.planning.local_answer import answer_locally, local_proposal
from dualbrain.runtime.planning.planner_request import (
    PassageRetriever,
    PlanningContext,
    Retriever,
    build_request,
    retrieve,
)
from dualbrain.runtime.planning.planning_time import Clock, decision_timings
from dualbrain.runtime.planning.proposal_checks import proposal_bytes, reject_before_gate, reject_mismatch

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Shot:
    """One request: the prompt of the planner, its proposal and the gate's verdict."""

    prompt: tuple[ChatMessage, ...]
    attempt: Attempt


@dataclass(frozen=True, slots=True, kw_only=True)
class DryRunResult:
    """Result of a dry run: scene summary, retrieved context, every shot, and the times of the decision [s].

    `template_hash` is the hash of the fixed text of the planner's prompt.
    """

    summary: str
    recall: RetrievedContext
    shots: tuple[Shot, ...]
    timings: dict[str, float]
    template_hash: str
    refusal: str = ""
    """The reason of the local layer, which declined the instruction before the planner was asked."""

    @property
    def verdict(self) -> Verdict:
        """The gate's last verdict."""
        return self.shots[-1].attempt.verdict

    @property
    def unsupported_fields(self) -> tuple[str, ...]:
        """Fields of `recall` that are not empty and that the prompt of this planner does not show."""
        return unsupported_fields(self.template_hash, self.recall)

    @property
    def has_answer(self) -> bool:
        """Whether the planner gave an answer."""
        return has_answer(self.shots[-1].attempt.proposal)

    @property
    def is_declined(self) -> bool:
        """Whether the planner declined the instruction."""
        verdict = self.verdict
        return isinstance(verdict, Accepted) and verdict.contract.action_sequence[0].skill == "decline"


def context_at_home(at_site: RobotAtSite, scene: Scene) -> PlanningContext:
    """The context of the robot at rest at its home position, with an empty gripper, in `scene` with its limits."""
    robot_model = at_site.robot_model
    state = home_state(robot_model)
    return PlanningContext(
        robot_model=robot_model,
        scene=with_object_limits(scene, at_site.object_limits),
        holding=None,
        posture=Posture(tuple(state.q.tolist()), state.opening),
    )


def plan(
    instruction: str,
    at_site: RobotAtSite,
    context: PlanningContext,
    planner: Planner,
    memory: Retriever | None,
    retrieve_passages: PassageRetriever,
    *,
    shots: int,
    clock: Clock,
    classifier: ClauseClassifier | None = None,
) -> DryRunResult:
    """Request a contract from `planner` at most `shots` times, with the gate's last rejection in the prompt.

    `context` is that of the robot `at_site` (`context_at_home`); the gate knows grants and obstacles of the site. The
    planner is not asked for a stop command or for an instruction that the local layer declines, with the `classifier`
    of clauses if there is one.
    """
    answer = answer_locally(instruction, context, planner, classifier=classifier)
    withheld: tuple[str, ...] = ()
    if answer is None:
        recall, retrieval = _timed(clock, lambda: _retrieve(instruction, context, memory, retrieve_passages))
        recall, withheld = fit_recall(recall, instruction)
    else:
        recall, retrieval = RetrievedContext(), 0.0
    request = build_request(instruction, context, recall)
    gate = gate_at_home(at_site, context.scene)
    taken: list[Shot] = []
    while len(taken) < shots:
        if answer is None:
            prompt, proposal = tuple(planner_messages(planner, request)), planner.propose(request)
        else:
            prompt, proposal = (), local_proposal(answer, context.registry, request.contract_id)
        verdict, gate_s = _timed(
            clock,
            lambda given=proposal: (
                reject_before_gate(given, instruction, withheld)
                or reject_mismatch(
                    given,
                    instruction,
                    context,
                    "all" if answer is None else "before_planning",
                    reject_decline=not taken and shots > 1,
                )
                or _check(gate, given, context.scene)
            ),
        )
        stored = msgspec.structs.replace(proposal, text=storable_text(proposal.text))
        taken.append(Shot(prompt, Attempt(stored, verdict, gate_s)))
        if not isinstance(verdict, Rejected) or not has_answer(proposal):
            break
        request = msgspec.structs.replace(request, rejection=verdict, contract_id=f"c-{len(taken) + 1:04d}")
    return DryRunResult(
        summary=context.summary,
        recall=recall,
        shots=tuple(taken),
        timings=decision_timings([one.attempt for one in taken], retrieval),
        template_hash=planner_template(planner),
        refusal=answer.reason if isinstance(answer, Refusal) else "",
    )


def _check(gate: Gate, answer: Proposal, scene: Scene) -> Verdict:
    return gate.check(proposal_bytes(answer), names=scene_names(scene), principal=PLANNER, now=0.0)


def _retrieve(
    instruction: str, context: PlanningContext, memory: Retriever | None, retrieve_passages: PassageRetriever
) -> RetrievedContext:
    if memory is None:
        return RetrievedContext(passages=retrieve_passages(instruction, context.summary))
    return retrieve(instruction, context, memory, MAX_RECALLED, retrieve_passages)


def _timed(clock: Clock, do: Callable[[], T]) -> tuple[T, float]:
    start = clock()
    return do(), clock() - start
