"""An adapter that plans: only for the robot, vocabulary and prompt it was taught, and only while it is itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.adaptation.adapters.compatibility import require_compatible
from dualbrain.errors import DualbrainError
from dualbrain.planner import protocol
from dualbrain.planner.backends.llama_cpp import LlamaPlanner
from dualbrain.planner.prompt.full_prompt import ChatMessage
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal

PlannerCheck = Callable[[LlamaPlanner], str]
"""What is wrong with the answers of a process that has just started, "" if nothing is (see `canary`)."""


class AdapterMismatchError(DualbrainError):
    """A process that should wear an adapter does not answer as that adapter did."""

    def __init__(self, adapter: str, fault: str) -> None:
        """Name the adapter and what differs."""
        self.adapter, self.fault = adapter, fault
        super().__init__(
            f"adapter {adapter[:16]} does not answer as it did: {fault}. It proposes nothing. See `dualbrain adapters "
            f"verify`, and `dualbrain adapters rollback` to let the former one serve."
        )


class AdaptedPlanner:
    """Proposes with the adapter of `card`.

    Each new process is checked before its first answer counts: at once when this is made, and again should it have had
    to be started anew. Raises `NotItself`, and what the check raises; later, that is the reason for which there is no
    answer.
    """

    def __init__(
        self,
        inner: LlamaPlanner,
        card: AdapterCard,
        check: PlannerCheck = lambda planner: "",
        narrowed_registries: Mapping[str, str] = {},
    ) -> None:
        """Let `inner`, which wears the adapter, propose, also in the vocabularies of `narrowed`.

        `inner` is closed if this raises.
        """
        self._inner, self.card, self._check, self._narrowed_registries = inner, card, check, narrowed_registries
        self._checked_pid: int | None = None
        with ExitStack() as unless_itself:
            unless_itself.callback(inner.close)
            if fault := self._find_fault():
                raise AdapterMismatchError(card.id, fault)
            unless_itself.pop_all()

    @property
    def name(self) -> str:
        """What is recorded as the author of a proposal: base and adapter."""
        return self._inner.name

    @property
    def template(self) -> str:
        """Hash of the prompt's fixed text."""
        return self._inner.template

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`. Raises `InvalidSetup` for a robot or vocabulary that the adapter was not taught."""
        require_compatible(self.card, request.robot, request.registry_hash, self._narrowed_registries)
        if fault := self._fault_or_error():
            return Proposal(
                text="",
                finish_reason=f"{protocol.ERROR}: not the adapter it was: {fault}",
                planner=self.name,
                constrained_by="",
                timings={"total": 0.0},
            )
        return self._inner.propose(request)

    def messages(self, request: PlanRequest) -> list[ChatMessage]:
        """What the model reads for `request`."""
        return self._inner.messages(request)

    def close(self) -> None:
        """End the process."""
        self._inner.close()

    def _fault_or_error(self) -> str:
        """As `_fault`; what the check raises is a fault, too, for a robot may be waiting."""
        try:
            return self._find_fault()
        except DualbrainError as error:
            return str(error)

    def _find_fault(self) -> str:
        """What is wrong with the present process, if it has not been looked at yet."""
        pid = self._inner.pid
        if pid is not None and pid == self._checked_pid:
            return ""
        fault = self._check(self._inner)
        self._checked_pid = None if fault else self._inner.pid
        return fault
