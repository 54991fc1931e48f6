"""The gate: bytes from an untrusted planner become an accepted contract or a rejection with its reason (paper 3.3)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import msgspec

from dualbrain.contracts.contract import Context, Contract, ContractHeader
from dualbrain.contracts.gate.authorization import AuthorizationStage, check_header
from dualbrain.contracts.gate.envelope import EnvelopeStage
from dualbrain.contracts.gate.strict_json import parse
from dualbrain.contracts.gate.syntax import SyntaxStage
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Accepted, Rejected, Verdict
from dualbrain.core.text import to_printable

ContractRule = Callable[[Contract], Rejected | None]
"""A condition of the envelope stage on more than one parameter (a pair of parameters, reachability)."""


class Gate:
    """Checks a contract in three stages: syntax, authorization, envelope. Each stage can reject the contract alone.

    The gate is an allow-list: a contract is rejected unless all its skills are registered and granted and all its
    parameters are in their domains. The only state is the last accepted sequence number of each principal.
    Raises `UnknownNameError` if a grant names a skill that is not registered.
    """

    def __init__(
        self, registry: SkillRegistry, grants: Mapping[str, frozenset[str]], rules: tuple[ContractRule, ...] = ()
    ) -> None:
        """Check against `registry`; `grants` maps principals to skills; `rules` run in order after all other checks."""
        self.registry, self.rules = registry, rules
        self._syntax = SyntaxStage(registry)
        self._authorization = AuthorizationStage(registry, grants)
        self._envelope = EnvelopeStage(registry)
        self._last_sequence: dict[str, int] = {}

    def check(
        self, data: bytes, *, names: SceneNames, principal: str, now: float, header: ContractHeader | None = None
    ) -> Verdict:
        """`Accepted(contract)` or `Rejected(stage, pointer, got, allowed, hint)`; never raises, for any bytes.

        A rule that raises an exception rejects the contract. `now` [s] is the gate's clock. Without a header there is
        no protection against replayed and old contracts: use this only to inspect a contract, not to run it. Acceptance
        consumes the sequence number of the header; a rejection changes no state.
        """
        document = parse(data)
        if isinstance(document, Rejected):
            return document
        rejection = self._syntax.check(document) or self._authorize(document, names, principal, now, header)
        if rejection is not None:
            return rejection
        verdict = self._check_envelope(document, names)
        if header is not None and isinstance(verdict, Accepted):
            self._last_sequence[principal] = header.sequence
        return verdict

    def _authorize(
        self, document: Any, names: SceneNames, principal: str, now: float, header: ContractHeader | None
    ) -> Rejected | None:
        """The authorization stage: context and skills of the contract, then its header."""
        rejection = self._authorization.check(document, principal)
        if rejection is not None or header is None:
            return rejection
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
                rejection = rule(contract)
            except Exception as error:  # a contract that a rule cannot judge is not accepted
                return Rejected(
                    stage="envelope",
                    pointer="",
                    got=to_printable(f"{type(error).__name__}: {error}"),
                    allowed="a decision of the rule",
                    hint="a rule failed",
                )
            if rejection is not None:
                return msgspec.structs.replace(rejection, stage="envelope")
        return Accepted(contract)
