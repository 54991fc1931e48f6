"""The gate of each method: the full gate, or one of the two weaker ones of the paper's baselines.

`syntax` (B1): encoding, form and authorization are checked; every value is accepted as written. `clip` (B2): as
`syntax`, and numbers are clipped to their bounds, while unknown names and choices are rejected. `gate`: all three
stages and the scene's rules. The verdict of the full gate is recorded in any case, because compliance means the same
for every method.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike

from dualbrain.contracts.contract import Action, Context, Contract, ContractHeader, ParameterValue
from dualbrain.contracts.gate.authorization import AuthorizationStage
from dualbrain.contracts.gate.envelope import EnvelopeStage
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.gate.strict_json import parse
from dualbrain.contracts.gate.syntax import SyntaxStage
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.skill_spec import NumberParameter
from dualbrain.contracts.verdict import Accepted, Rejected, Verdict
from dualbrain.evaluation.protocol.method import GateKind
from dualbrain.grounding.vocabulary import planner_grants
from dualbrain.records import Proposal
from dualbrain.robots.interface import RobotState
from dualbrain.runtime.planning.proposal_checks import proposal_bytes, reject_incomplete
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.result import FilterResult, FilterStatus
from dualbrain.safety.integration.shadow_mode import REFUSED_REASONS


class BaselineGate:
    """Checks proposals according to `kind`; `full_gate_verdicts` holds the full gate's verdict on each, in order.

    An `unconstrained_answer` is only judged, by the full gate together with the next proposal, and never accepted;
    `unconstrained_verdict` is its verdict. If no complete proposal follows, `check_unconstrained_answer` judges it at
    the end of the episode.
    """

    def __init__(self, kind: GateKind, gate: Gate, registry: SkillRegistry) -> None:
        """`gate` is the full gate for the skills in `registry`."""
        self.kind: GateKind = kind
        self.full_gate_verdicts: list[Verdict] = []
        self.unconstrained_answer: Proposal | None = None
        self.unconstrained_verdict: Verdict | None = None
        self._gate = gate
        self._registry = registry
        self._syntax, self._envelope = SyntaxStage(registry), EnvelopeStage(registry)
        self._authorization = AuthorizationStage(registry, planner_grants(registry))

    def check(self, data: bytes, *, names: SceneNames, principal: str, now: float, header: ContractHeader) -> Verdict:
        """The verdict of this gate; any `data` is judged without an exception."""
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
        """Judge the unconstrained answer, if there is one without a verdict."""
        if self.unconstrained_answer is not None and self.unconstrained_verdict is None:
            self.unconstrained_verdict = self._check_full_gate(self.unconstrained_answer, names, principal, now)

    def _check_full_gate(self, answer: Proposal, names: SceneNames, principal: str, now: float) -> Verdict:
        """The full gate's verdict without a contract header, so that no sequence number is consumed."""
        return reject_incomplete(answer) or self._gate.check(
            proposal_bytes(answer), names=names, principal=principal, now=now, header=None
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
    """The steps with every number clipped to its bounds; NaN cannot occur, because it is no JSON."""
    return [{"skill": step["skill"], "params": _clip_params(step, registry)} for step in steps]


def _clip_params(step: dict[str, Any], registry: SkillRegistry) -> dict[str, ParameterValue]:
    params: dict[str, ParameterValue] = dict(step["params"])
    for parameter in registry.skill(step["skill"]).parameters:
        if isinstance(parameter, NumberParameter):
            params[parameter.name] = min(max(float(params[parameter.name]), parameter.lower), parameter.upper)
    return params


class PassiveFilter(SafetyFilter):
    """A `SafetyFilter` that raises no alarm because of the barriers alone; h and the rows are computed as usual."""

    def filter(self, state: RobotState, u_nom: ArrayLike, now: float) -> FilterResult:
        """The filter's result, without its intervention if the barriers alone caused an alarm.

        `u_nom` (n_controls,) is the nominal control [rad/s], `now` the time [s].
        """
        result = super().filter(state, u_nom, now)
        alarm = result.status > FilterStatus.MODIFIED and not result.flags & REFUSED_REASONS
        return result.unfiltered() if alarm else result
