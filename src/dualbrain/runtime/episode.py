"""The whole loop on one screen: words → recall → propose → gate → motion → outcome → memory (paper 3.4).

Data flows one way; what seems to flow back is a value: a refusal in the second prompt, a weight read next time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, get_args

import msgspec

from dualbrain.contracts.contract import Contract, Stamp
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import Registry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Accepted, Rejected, Stage, Verdict
from dualbrain.control.contract_executor import LocalLayer
from dualbrain.control.gatekeeper.remote_executor import RemoteGate, RemoteLayer
from dualbrain.core.text import storable
from dualbrain.grounding.outcome_check import second_opinion
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import grants, scene_names
from dualbrain.memory.embedding.image_features import Picture
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.memory import StoreReport
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED
from dualbrain.planner.protocol import STOP, Planner, answered
from dualbrain.records import Attempt, Episode, Judgement, Outcome, Proposal, Setback
from dualbrain.runtime.planner_request import LookUp, Reminder, Standpoint, question, reminded
from dualbrain.runtime.planning_time import Thinking, timings
from dualbrain.runtime.replanning import goes_on
from dualbrain.skills.registry import registry_of

STAGES = get_args(Stage)
"""The gate's stages, in their order."""
CONTRACT_LIFE = 660.0
"""A contract that was not accepted within this time of the question is too old [s]; planners give up before."""


class Door(Protocol):
    """What a proposal has to pass: the gate, or what stands in its place where methods are compared."""

    def check(self, data: bytes, *, names: SceneNames, principal: str, now: float, stamp: Stamp) -> Verdict:
        """The word on `data`; never raises on any bytes."""
        ...


class Experience(Reminder, Protocol):
    """What the loop asks of memory; `memory.store.Memory` is one, and a baseline may have one that keeps nothing."""

    def store(self, episode: Episode, state: Posture, *, now: float, image: Picture | None = None) -> StoreReport:
        """Keep the episode, and let its outcome teach."""
        ...


@dataclass(frozen=True, slots=True)
class Errand:
    """What is asked, its name and date: the words, how many shots the planner has, how many memories it is shown.

    No `exemplars`: nothing is recalled, warnings neither, as for a contract that is given; an outcome teaches only what
    stood in a prompt. `tries` contracts may still be carried out for it; `setback` is what became of the one before.
    """

    id: str
    started: str
    instruction: str
    seed: int
    shots: int = 2
    exemplars: int = MAX_RECALLED
    tries: int = 1
    setback: Setback | None = None


@dataclass(frozen=True, slots=True)
class Witness:
    """What only a simulation has: it hears of the accepted contract, judges on truth at the end, knows the versions."""

    begin: Callable[[Contract], None]
    judge: Callable[[], Judgement | None]
    versions: dict[str, str]
    picture: Callable[[], Picture | None] = lambda: None
    """What the robot's camera sees before it plans, if it has one."""


def run_episode(
    errand: Errand, planner: Planner, memory: Experience, layer: LocalLayer | RemoteLayer, thinking: Thinking,
    witness: Witness, keep: Callable[[Episode], None], *, now: float, look_up: LookUp = lambda instruction, summary: (),
    granted: Mapping[str, frozenset[str]] | None = None, door: Callable[[Gate | RemoteGate], Door] | None = None,
) -> tuple[Episode, StoreReport]:  # fmt: skip
    """Carry one instruction through the loop; `now` [s, 1970 UTC] stamps what memory writes.

    `look_up` gives the passages of documents that bear on the instruction in this scene. `granted` says who may call
    which skill; by default the planner may call every one. `door` puts another door in the gate's place (evaluation). A
    try that another one follows is not judged.

    The episode is handed to `keep` before memory has it: what moved is on record, whatever happens to the ledger.
    """
    registry, scene = registry_of(layer.body), layer.scene
    held = layer.limb.holding.name if layer.limb.holding else None
    posture = Posture(tuple(layer.state.q.tolist()), layer.state.opening)
    here = Standpoint(layer.body, scene, held, posture, witness.picture())
    recall, retrieval = thinking.timed(lambda: reminded(errand.instruction, here, memory, errand.exemplars, look_up))
    gate = _gate(layer, registry, grants(registry) if granted is None else granted)
    gate = door(gate) if door else gate
    request = question(errand.instruction, here, recall, errand.setback)
    bound = layer.log.binding.copy()
    attempts: list[Attempt] = []
    verdict: Verdict | None = None
    for shot in range(1, errand.shots + 1):
        asked = layer.state.stamp
        proposal = thinking.wait_for(layer, lambda ask=request: planner.propose(ask))
        if proposal is None:
            break
        stamp = Stamp(shot, asked, asked + CONTRACT_LIFE, PLANNER, scene.version)
        verdict, gate_s = thinking.timed(
            lambda text=proposal, stamp=stamp: _check(gate, text, scene_names(layer.scene), layer.state.stamp, stamp)
        )
        attempts.append(Attempt(msgspec.structs.replace(proposal, text=storable(proposal.text)), verdict, gate_s))
        layer.log.attempt(layer.state.stamp, attempts[-1])
        layer.log.note(layer.state.stamp, "verdict", _verdict_words(shot, verdict))
        if isinstance(verdict, Accepted) or not answered(proposal):
            break
        request = msgspec.structs.replace(request, refusal=verdict, contract_id=f"c-{shot + 1:04d}")
    contract = verdict.contract if isinstance(verdict, Accepted) else None
    if contract:
        witness.begin(contract)
    outcome = layer.run(contract) if contract else _unmoved(layer, attempts)
    episode = Episode(
        errand.id, errand.started, errand.instruction, layer.body.name, registry.hash, errand.seed, scene, here.summary,
        recall, tuple(attempts), msgspec.to_builtins(contract) if contract else None, outcome,
        None if goes_on(outcome, errand.tries) else witness.judge(),
        timings(attempts, retrieval) | {"motion": outcome.duration}, witness.versions,
        dict(layer.log.binding - bound), second_opinion(layer.scene, contract, outcome), setback=errand.setback,
    )  # fmt: skip
    keep(episode)
    return episode, memory.store(episode, posture, now=now, image=here.image)


def _gate(
    layer: LocalLayer | RemoteLayer, registry: Registry, granted: Mapping[str, frozenset[str]]
) -> Gate | RemoteGate:
    """The gate before this layer: a gatekeeper has its own, to which bytes are only brought."""
    if isinstance(layer, RemoteLayer):
        return RemoteGate(layer.link)
    return Gate(registry, granted, (lambda contract: _against_scene(contract, layer),))


def unfinished(proposal: Proposal) -> Rejected | None:
    """Why there is no contract to check: the answer was cut, timed out or crashed; None if it is whole."""
    if proposal.finish_reason == STOP:
        return None
    return Rejected("syntax", "", proposal.finish_reason, STOP, "the answer is not whole, so it is no contract")


def _check(gate: Gate | RemoteGate | Door, proposal: Proposal, names: SceneNames, now: float, stamp: Stamp) -> Verdict:
    """The gate's word on a proposal."""
    data = proposal.text.encode("utf-8", "surrogatepass")
    return unfinished(proposal) or gate.check(data, names=names, principal=PLANNER, now=now, stamp=stamp)


def _unmoved(layer: LocalLayer | RemoteLayer, attempts: Sequence[Attempt]) -> Outcome:
    """The outcome when no contract was accepted: nothing has moved.

    A planner that gave no answer is a fault, of which nothing is learnt; one whose answer was refused is not.
    """
    if layer.interrupted():
        return Outcome("aborted", "interrupted by a person before a contract was accepted")
    if not attempts:
        return Outcome("rejected", _verdict_words(0, None))
    if not answered(attempts[-1].proposal):
        return Outcome("stopped", f"the planner gave no answer: {attempts[-1].proposal.finish_reason}")
    return Outcome("rejected", _verdict_words(len(attempts), attempts[-1].verdict))


def _against_scene(contract: Contract, layer: LocalLayer) -> Rejected | None:
    """The first of the scene's rules that refuses, by the scene and the hand as they are at this moment."""
    refusals = (rule(contract) for rule in scene_rules(layer.scene, layer.limb))
    return next((refusal for refusal in refusals if refusal), None)


def _verdict_words(shot: int, verdict: Verdict | None) -> str:
    match verdict:
        case Accepted(contract):
            skills = " → ".join(action.skill for action in contract.action_sequence)
            return f"shot {shot}: accepted, {_passed(len(STAGES))}: {skills}"
        case Rejected(stage, pointer, got, _, hint):
            passed = _passed(STAGES.index(stage))
            return f"shot {shot}: rejected, {passed}{stage} ✗ at {pointer or '/'}: got {got!r}; {hint}"
        case None:
            return "no shot was taken"


def _passed(count: int) -> str:
    return " ".join(f"{stage} ✓" for stage in STAGES[:count]) + (" " if 0 < count < len(STAGES) else "")
