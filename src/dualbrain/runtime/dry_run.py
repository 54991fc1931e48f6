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
from dualbrain.core.text import storable
from dualbrain.grounding.offline_gate import limb_at_home
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import grants, scene_names
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.planner.introspection import messages_of, template_of, unread
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED, Message
from dualbrain.planner.protocol import Planner, answered
from dualbrain.records import Attempt, Proposal, Recall, Scene
from dualbrain.robots.interface import at_home
from dualbrain.robots.loader import load_body
from dualbrain.runtime.episode import unfinished
from dualbrain.runtime.planner_request import LookUp, Reminder, Standpoint, question, reminded
from dualbrain.runtime.planning_time import Clock, timings

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Shot:
    """One question and its answer: what the planner read, what it wrote, what the gate said."""

    prompt: tuple[Message, ...]
    attempt: Attempt


@dataclass(frozen=True, slots=True)
class Planned:
    """What became of an instruction: the scene in symbols, what was retrieved, every shot, the time of the decision.

    `template` is the hash of the fixed text of the prompt that the planner read.
    """

    summary: str
    recall: Recall
    shots: tuple[Shot, ...]
    timings: dict[str, float]
    template: str

    @property
    def verdict(self) -> Verdict:
        """The gate's last word."""
        return self.shots[-1].attempt.verdict

    @property
    def unread(self) -> tuple[str, ...]:
        """What was retrieved and has no place in the prompt of this planner: fields of `recall`."""
        return unread(self.template, self.recall)

    @property
    def answered(self) -> bool:
        """Whether the planner said anything at all."""
        return answered(self.shots[-1].attempt.proposal)

    @property
    def declined(self) -> bool:
        """Whether the planner refused the instruction."""
        verdict = self.verdict
        return isinstance(verdict, Accepted) and verdict.contract.action_sequence[0].skill == "decline"


def from_home(robot: str, scene: Scene) -> Standpoint:
    """`robot` at rest at home with an empty hand before `scene`."""
    body = load_body(robot)
    state = at_home(body)
    return Standpoint(body, scene, None, Posture(tuple(state.q.tolist()), state.opening))


def plan(
    instruction: str, here: Standpoint, planner: Planner, memory: Reminder | None, look_up: LookUp, *, shots: int,
    clock: Clock,
) -> Planned:  # fmt: skip
    """Ask `planner` for a contract, at most `shots` times, each time with the gate's last refusal in the prompt."""
    recall, retrieval = _timed(clock, lambda: _reminded(instruction, here, memory, look_up))
    request = question(instruction, here, recall)
    limb = limb_at_home(here.body.name, here.scene)
    gate = Gate(here.registry, grants(here.registry), scene_rules(here.scene, limb))
    done: list[Shot] = []
    while len(done) < shots:
        prompt, proposal = tuple(messages_of(planner, request)), planner.propose(request)
        verdict, spent = _timed(clock, lambda answer=proposal: unfinished(answer) or _check(gate, answer, here.scene))
        kept = msgspec.structs.replace(proposal, text=storable(proposal.text))
        done.append(Shot(prompt, Attempt(kept, verdict, spent)))
        if not isinstance(verdict, Rejected) or not answered(proposal):
            break
        request = msgspec.structs.replace(request, refusal=verdict, contract_id=f"c-{len(done) + 1:04d}")
    spent = timings([one.attempt for one in done], retrieval)
    return Planned(here.summary, recall, tuple(done), spent, template_of(planner))


def _check(gate: Gate, answer: Proposal, scene: Scene) -> Verdict:
    data = answer.text.encode("utf-8", "surrogatepass")
    return gate.check(data, names=scene_names(scene), principal=PLANNER, now=0.0)


def _reminded(instruction: str, here: Standpoint, memory: Reminder | None, look_up: LookUp) -> Recall:
    if memory is None:
        return Recall(passages=look_up(instruction, here.summary))
    return reminded(instruction, here, memory, MAX_RECALLED, look_up)


def _timed(clock: Clock, do: Callable[[], T]) -> tuple[T, float]:
    start = clock()
    return do(), clock() - start
