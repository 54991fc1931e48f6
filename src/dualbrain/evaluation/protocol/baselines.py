"""The door of each method: the whole gate, or the two weaker ones of the paper's baselines.

`syntax` (B1): bytes, form, and authorization; every value is taken as it was written. `clip` (B2): as `syntax`, and
numbers are clipped to their bounds, while names and words that are not offered are intercepted. `gate`: all three
stages and the scene's rules. Whatever the door lets through, the verdict of the whole gate is noted, for compliance is
the same question for every method.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.contract import Action, Context, Contract, ContractHeader, ParameterValue
from dualbrain.contracts.gate.authorization import AuthorizationStage
from dualbrain.contracts.gate.envelope import EnvelopeStage
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.gate.parse import parse
from dualbrain.contracts.gate.syntax import SyntaxStage
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.skill_spec import NumberParameter
from dualbrain.contracts.verdict import Accepted, Rejected, Verdict
from dualbrain.evaluation.protocol.method import GateKind
from dualbrain.grounding.vocabulary import planner_grants
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.ledger import Head
from dualbrain.memory.memory import StoreReport
from dualbrain.records import Episode, Proposal, RetrievedContext
from dualbrain.robots.interface import RobotState
from dualbrain.runtime.episode import reject_incomplete
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.result import FilterResult, FilterStatus
from dualbrain.safety.integration.shadow_mode import REFUSED_REASONS


class BaselineGate:
    """Checks as `kind` says; `strict` holds the whole gate's verdict on each proposal, in order.

    What was put `aside` is judged beside the next proposal, by the whole gate in the same moment, and let through
    nowhere: `free` has the verdict. Where no proposal followed that was whole, `look_aside` judges it at the end.
    """

    def __init__(self, kind: GateKind, gate: Gate, registry: SkillRegistry) -> None:
        """Stand beside `gate`, which guards `registry`."""
        self.kind: GateKind = kind
        self.full_gate_verdicts: list[Verdict] = []
        self.unconstrained_answer: Proposal | None = None
        self.unconstrained_verdict: Verdict | None = None
        self._gate = gate
        self._registry = registry
        self._syntax, self._envelope = SyntaxStage(registry), EnvelopeStage(registry)
        self._authorization = AuthorizationStage(registry, planner_grants(registry))

    def check(self, data: bytes, *, names: SceneNames, principal: str, now: float, header: ContractHeader) -> Verdict:
        """This door's word; never raises on any bytes."""
        self.check_unconstrained_answer(names, principal, now)
        strict = self._gate.check(data, names=names, principal=principal, now=now, header=header)
        self.full_gate_verdicts.append(strict)
        if self.kind == "gate" or isinstance(strict, Accepted):
            return strict
        document = parse(data)
        if isinstance(document, Rejected):
            return document
        return self._check_syntax_and_authorization(document, principal) or self._accept(document, names)

    def check_unconstrained_answer(self, names: SceneNames, principal: str, now: float) -> None:
        """Judge what was put aside, if that is not done yet."""
        if self.unconstrained_answer is not None and self.unconstrained_verdict is None:
            self.unconstrained_verdict = self._check_full_gate(self.unconstrained_answer, names, principal, now)

    def _check_full_gate(self, aside: Proposal, names: SceneNames, principal: str, now: float) -> Verdict:
        """The whole gate's word without a stamp: nothing is used up."""
        data = aside.text.encode("utf-8", "surrogatepass")
        return reject_incomplete(aside) or self._gate.check(
            data, names=names, principal=principal, now=now, header=None
        )

    def _check_syntax_and_authorization(self, document: Any, principal: str) -> Rejected | None:
        return self._syntax.check(document) or self._authorization.check(document, principal)

    def _accept(self, document: Any, names: SceneNames) -> Verdict:
        steps = document["action_sequence"]
        if self.kind == "clip":
            actions = self._envelope.check(_clip_steps(steps, self._registry), names)
            if isinstance(actions, Rejected):
                return actions
        else:
            actions = tuple(Action(step["skill"], dict(step["params"])) for step in steps)
        return Accepted(Contract(document["id"], Context(**document["context"]), actions))


def _clip_steps(steps: list[Any], registry: SkillRegistry) -> list[dict[str, Any]]:
    """The steps with every number brought into its bounds; NaN cannot come here, for it is no JSON."""
    return [{"skill": step["skill"], "params": _clip_params(step, registry)} for step in steps]


def _clip_params(step: dict[str, Any], registry: SkillRegistry) -> dict[str, ParameterValue]:
    params: dict[str, ParameterValue] = dict(step["params"])
    for parameter in registry.skill(step["skill"]).parameters:
        if isinstance(parameter, NumberParameter):
            params[parameter.name] = min(max(float(params[parameter.name]), parameter.lower), parameter.upper)
    return params


class PassiveFilter(SafetyFilter):
    """As `SafetyFilter`, but an answer of the barriers alone is no alarm; h and its rows are as ever."""

    def filter(self, state: RobotState, u_nom: NDArray[np.float64], now: float) -> FilterResult:
        """One step of watching."""
        answer = super().filter(state, u_nom, now)
        alarm = answer.status > FilterStatus.MODIFIED and not answer.flags & REFUSED_REASONS
        return answer.unfiltered() if alarm else answer


class NoMemory:
    """Answers as a memory without memories."""

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
        """Nothing."""
        del instruction, summary, state, robot, registry, k, image
        return RetrievedContext()

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Keep nothing; no weight moves."""
        del state, now, image
        return StoreReport(episode_id=episode.id, seq=0, head=Head(0, ""), weight_updates=())
