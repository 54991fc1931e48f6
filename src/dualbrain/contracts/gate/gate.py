"""The one door: bytes from an untrusted planner become a contract, or a refusal that says where and why (paper 3.3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from dualbrain.contracts.contract import Context, Contract, ContractHeader
from dualbrain.contracts.gate.authorization import AuthorizationStage, check_header
from dualbrain.contracts.gate.envelope import EnvelopeStage
from dualbrain.contracts.gate.parse import parse
from dualbrain.contracts.gate.syntax import SyntaxStage
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Accepted, Rejected, Verdict

ContractRule = Callable[[Contract], Rejected | None]
"""A condition that no single parameter shows (a pair of parameters, reachability); belongs to the envelope stage."""


class Gate:
    """Syntax, then authorization, then envelope; each stage sees the whole contract and can refuse alone.

    Allow-list by construction: what is not registered, granted and inside its domain is refused. The only state is the
    last accepted sequence number of each principal. Raises `UnknownName` when a grant names an unregistered skill.
    """

    def __init__(
        self, registry: SkillRegistry, grants: Mapping[str, frozenset[str]], rules: tuple[ContractRule, ...] = ()
    ) -> None:
        """Guard `registry`; `grants` maps principals to skills; `rules` run in order on what is else good."""
        self.registry, self.rules = registry, rules
        self._syntax = SyntaxStage(registry)
        self._authorization = AuthorizationStage(registry, grants)
        self._envelope = EnvelopeStage(registry)
        self._last_sequence: dict[str, int] = {}

    def check(
        self, data: bytes, *, names: SceneNames, principal: str, now: float, header: ContractHeader | None = None
    ) -> Verdict:
        """`Accepted(contract)` or `Rejected(stage, pointer, got, allowed, hint)`; never raises on any bytes.

        A rule that raises refuses. `now` [s] is the gate's clock. Without a stamp nothing guards against replay and
        age: only for looking at a contract, not for running it. Acceptance uses up the stamp's sequence number; a
        refusal leaves no trace.
        """
        document = parse(data)
        if isinstance(document, Rejected):
            return document
        refusal = self._syntax.check(document) or self._authorize(document, names, principal, now, header)
        if refusal is not None:
            return refusal
        verdict = self._check_envelope(document, names)
        if header is not None and isinstance(verdict, Accepted):
            self._last_sequence[principal] = header.sequence
        return verdict

    def _authorize(
        self, document: Any, names: SceneNames, principal: str, now: float, header: ContractHeader | None
    ) -> Rejected | None:
        """The authorization stage: the contract's context and skills, then the runtime's stamp."""
        refusal = self._authorization.check(document, principal)
        if refusal is not None or header is None:
            return refusal
        return check_header(
            header, principal=principal, now=now, names=names, last_sequence=self._last_sequence.get(principal)
        )

    def _check_envelope(self, document: Any, names: SceneNames) -> Verdict:
        """The envelope stage: every domain, then the rules."""
        actions = self._envelope.check(document["action_sequence"], names)
        if isinstance(actions, Rejected):
            return actions
        contract = Contract(document["id"], Context(**document["context"]), actions)
        for rule in self.rules:
            try:
                refusal = rule(contract)
            except Exception as error:  # what cannot be judged is not accepted
                return Rejected(
                    stage="envelope",
                    pointer="",
                    got=f"{type(error).__name__}: {error}",
                    allowed="a rule's word",
                    hint="a rule failed",
                )
            if refusal is not None:
                return msgspec.structs.replace(refusal, stage="envelope")
        return Accepted(contract)
