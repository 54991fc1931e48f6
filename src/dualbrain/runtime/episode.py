"""The whole loop on one screen: words → recall → propose → gate → motion → outcome → memory (paper 3.4).

Data flows one way; what seems to flow back is a value: a refusal in the second prompt, a weight read next time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, get_args

import msgspec

from dualbrain.contracts.contract import Contract, ContractHeader
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Accepted, Rejected, Stage, Verdict
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.gatekeeper.remote_executor import RemoteExecutor, RemoteGate
from dualbrain.core.text import storable_text
from dualbrain.grounding.outcome_check import check_outcome
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import planner_grants, scene_names
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.memory import StoreReport
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED
from dualbrain.planner.protocol import STOP, Planner, has_answer
from dualbrain.records import Attempt, Episode, FailureFeedback, Judgement, Outcome, Proposal
from dualbrain.runtime.planner_request import PassageRetriever, PlanningContext, Retriever, build_request, retrieve
from dualbrain.runtime.planning_time import PlanningClock, decision_timings
from dualbrain.runtime.replanning import should_retry
from dualbrain.skills.registry import skill_registry

STAGES = get_args(Stage)
"""The gate's stages, in their order."""
CONTRACT_LIFETIME = 660.0
"""A contract that was not accepted within this time of the question is too old [s]; planners give up before."""


class ContractGate(Protocol):
    """What a proposal has to pass: the gate, or what stands in its place where methods are compared."""

    def check(self, data: bytes, *, names: SceneNames, principal: str, now: float, header: ContractHeader) -> Verdict:
        """The word on `data`; never raises on any bytes."""
        ...


class EpisodicMemory(Retriever, Protocol):
    """What the loop asks of memory; `memory.store.Memory` is one, and a baseline may have one that keeps nothing."""

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Keep the episode, and let its outcome teach."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRequest:
    """What is asked, its name and date: the words, how many shots the planner has, how many memories it is shown.

    No `exemplars`: nothing is recalled, warnings neither, as for a contract that is given; an outcome teaches only what
    stood in a prompt. `tries` contracts may still be carried out for it; `setback` is what became of the one before.
    """

    id: str
    started: str
    instruction: str
    seed: int
    max_shots: int = 2
    max_exemplars: int = MAX_RECALLED
    tries_left: int = 1
    setback: FailureFeedback | None = None


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """What only a simulation has: it hears of the accepted contract, judges on truth at the end, knows the versions."""

    start_contract: Callable[[Contract], None]
    judge: Callable[[], Judgement | None]
    versions: dict[str, str]
    image_features: Callable[[], ImageFeatures | None] = lambda: None
    """What the robot's camera sees before it plans, if it has one."""


def run_episode(
    episode_request: EpisodeRequest,
    planner: Planner,
    memory: EpisodicMemory,
    executor: ContractExecutor | RemoteExecutor,
    planning_clock: PlanningClock,
    ground_truth: GroundTruth,
    save: Callable[[Episode], None],
    *,
    now: float,
    retrieve_passages: PassageRetriever = lambda instruction, summary: (),
    allowed_skills: Mapping[str, frozenset[str]] | None = None,
    wrap_gate: Callable[[Gate | RemoteGate], ContractGate] | None = None,
) -> tuple[Episode, StoreReport]:
    """Carry one instruction through the loop; `now` [s, 1970 UTC] stamps what memory writes.

    `look_up` gives the passages of documents that bear on the instruction in this scene. `granted` says who may call
    which skill; by default the planner may call every one. `door` puts another door in the gate's place (evaluation). A
    try that another one follows is not judged.

    The episode is handed to `keep` before memory has it: what moved is on record, whatever happens to the ledger.
    """
    registry, scene = skill_registry(executor.robot_model), executor.scene
    held = executor.controller.holding.name if executor.controller.holding else None
    posture = Posture(tuple(executor.state.q.tolist()), executor.state.opening)
    here = PlanningContext(
        robot_model=executor.robot_model,
        scene=scene,
        holding=held,
        posture=posture,
        image=ground_truth.image_features(),
    )
    recall, retrieval = planning_clock.measure(
        lambda: retrieve(episode_request.instruction, here, memory, episode_request.max_exemplars, retrieve_passages)
    )
    gate = _gate(executor, registry, planner_grants(registry) if allowed_skills is None else allowed_skills)
    gate = wrap_gate(gate) if wrap_gate else gate
    request = build_request(episode_request.instruction, here, recall, episode_request.setback)
    bound = executor.log.binding.copy()
    attempts: list[Attempt] = []
    verdict: Verdict | None = None
    for shot in range(1, episode_request.max_shots + 1):
        asked = executor.state.stamp
        proposal = planning_clock.wait_for(executor, lambda ask=request: planner.propose(ask))
        if proposal is None:
            break
        header = ContractHeader(
            sequence=shot,
            issued=asked,
            expires=asked + CONTRACT_LIFETIME,
            principal=PLANNER,
            scene_version=scene.version,
        )
        verdict, gate_s = planning_clock.measure(
            lambda text=proposal, header=header: _check(
                gate, text, scene_names(executor.scene), executor.state.stamp, header
            )
        )
        attempts.append(Attempt(msgspec.structs.replace(proposal, text=storable_text(proposal.text)), verdict, gate_s))
        executor.log.attempt(executor.state.stamp, attempts[-1])
        executor.log.note(executor.state.stamp, "verdict", _format_verdict(shot, verdict))
        if isinstance(verdict, Accepted) or not has_answer(proposal):
            break
        request = msgspec.structs.replace(request, refusal=verdict, contract_id=f"c-{shot + 1:04d}")
    contract = verdict.contract if isinstance(verdict, Accepted) else None
    if contract:
        ground_truth.start_contract(contract)
    outcome = executor.execute(contract) if contract else _outcome_without_motion(executor, attempts)
    episode = Episode(
        id=episode_request.id,
        started=episode_request.started,
        instruction=episode_request.instruction,
        robot=executor.robot_model.name,
        registry=registry.hash,
        seed=episode_request.seed,
        scene=scene,
        summary=here.summary,
        recall=recall,
        attempts=tuple(attempts),
        contract=msgspec.to_builtins(contract) if contract else None,
        outcome=outcome,
        judgement=None if should_retry(outcome, episode_request.tries_left) else ground_truth.judge(),
        timings=decision_timings(attempts, retrieval) | {"motion": outcome.duration},
        versions=ground_truth.versions,
        binding=dict(executor.log.binding - bound),
        second_opinion=check_outcome(executor.scene, contract, outcome),
        setback=episode_request.setback,
    )
    save(episode)
    return episode, memory.store(episode, posture, now=now, image=here.image)


def _gate(
    layer: ContractExecutor | RemoteExecutor, registry: SkillRegistry, granted: Mapping[str, frozenset[str]]
) -> Gate | RemoteGate:
    """The gate before this layer: a gatekeeper has its own, to which bytes are only brought."""
    if isinstance(layer, RemoteExecutor):
        return RemoteGate(layer.client)
    return Gate(registry, granted, (lambda contract: _check_scene_rules(contract, layer),))


def reject_incomplete(proposal: Proposal) -> Rejected | None:
    """Why there is no contract to check: the answer was cut, timed out or crashed; None if it is whole."""
    if proposal.finish_reason == STOP:
        return None
    return Rejected(
        stage="syntax",
        pointer="",
        got=proposal.finish_reason,
        allowed=STOP,
        hint="the answer is not whole, so it is no contract",
    )


def _check(
    gate: Gate | RemoteGate | ContractGate, proposal: Proposal, names: SceneNames, now: float, header: ContractHeader
) -> Verdict:
    """The gate's word on a proposal."""
    data = proposal.text.encode("utf-8", "surrogatepass")
    return reject_incomplete(proposal) or gate.check(data, names=names, principal=PLANNER, now=now, header=header)


def _outcome_without_motion(layer: ContractExecutor | RemoteExecutor, attempts: Sequence[Attempt]) -> Outcome:
    """The outcome when no contract was accepted: nothing has moved.

    A planner that gave no answer is a fault, of which nothing is learnt; one whose answer was refused is not.
    """
    if layer.interrupted():
        return Outcome(kind="aborted", reason="interrupted by a person before a contract was accepted")
    if not attempts:
        return Outcome(kind="rejected", reason=_format_verdict(0, None))
    if not has_answer(attempts[-1].proposal):
        return Outcome(kind="stopped", reason=f"the planner gave no answer: {attempts[-1].proposal.finish_reason}")
    return Outcome(kind="rejected", reason=_format_verdict(len(attempts), attempts[-1].verdict))


def _check_scene_rules(contract: Contract, layer: ContractExecutor) -> Rejected | None:
    """The first of the scene's rules that refuses, by the scene and the hand as they are at this moment."""
    refusals = (rule(contract) for rule in scene_rules(layer.scene, layer.controller))
    return next((refusal for refusal in refusals if refusal), None)


def _format_verdict(shot: int, verdict: Verdict | None) -> str:
    match verdict:
        case Accepted(contract):
            skills = " → ".join(action.skill for action in contract.action_sequence)
            return f"shot {shot}: accepted, {_format_passed_stages(len(STAGES))}: {skills}"
        case Rejected(stage=stage, pointer=pointer, got=got, allowed=_, hint=hint):
            passed = _format_passed_stages(STAGES.index(stage))
            return f"shot {shot}: rejected, {passed}{stage} ✗ at {pointer or '/'}: got {got!r}; {hint}"
        case None:
            return "no shot was taken"


def _format_passed_stages(count: int) -> str:
    return " ".join(f"{stage} ✓" for stage in STAGES[:count]) + (" " if 0 < count < len(STAGES) else "")
