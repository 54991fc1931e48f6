"""A planner with an adapter: it answers only for the robot, vocabulary and prompt of its training data."""

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
"""Returns the fault in the answers of a newly started process, "" if there is none (see `canary`)."""


class AdapterMismatchError(DualbrainError):
    """A process with an adapter does not give the answers that were recorded for this adapter."""

    def __init__(self, adapter: str, fault: str) -> None:
        """Report the adapter and the difference."""
        self.adapter, self.fault = adapter, fault
        super().__init__(
            f"The adapter {adapter[:16]} does not answer as recorded: {fault}. It makes no proposals. Check it with "
            f"`dualbrain adapters verify`, or return to the former one with `dualbrain adapters rollback`."
        )


class AdaptedPlanner:
    """Proposes with the adapter of `card`.

    Each new process is checked before its first answer is used: once in the constructor, and again after every restart.
    The constructor raises `AdapterMismatchError` and the errors of the check; later, a fault is the finish reason of an
    empty proposal.
    """

    def __init__(
        self,
        inner: LlamaPlanner,
        card: AdapterCard,
        check: PlannerCheck = lambda planner: "",
        narrowed_registries: Mapping[str, str] = {},
    ) -> None:
        """Use `inner`, which has the adapter loaded; `inner` is closed if the constructor raises.

        `narrowed_registries` maps narrower vocabularies to wider ones (see `require_compatible`).
        """
        self._inner, self.card, self._check, self._narrowed_registries = inner, card, check, narrowed_registries
        self._checked_pid: int | None = None
        with ExitStack() as on_failure:
            on_failure.callback(inner.close)
            if fault := self._find_fault():
                raise AdapterMismatchError(card.id, fault)
            on_failure.pop_all()

    @property
    def name(self) -> str:
        """The author recorded for its proposals: base and adapter."""
        return self._inner.name

    @property
    def template(self) -> str:
        """Hash of the prompt template."""
        return self._inner.template

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`; raises `ConfigurationError` for a robot or vocabulary outside the training data."""
        require_compatible(self.card, request.robot, request.registry_hash, self._narrowed_registries)
        if fault := self._fault_or_error():
            return Proposal(
                text="",
                finish_reason=f"{protocol.ERROR}: the adapter does not answer as recorded: {fault}",
                planner=self.name,
                timings={"total": 0.0},
            )
        return self._inner.propose(request)

    def messages(self, request: PlanRequest) -> list[ChatMessage]:
        """The messages that the model receives for `request`."""
        return self._inner.messages(request)

    def show_answers(self, show: Callable[[str], None]) -> None:
        """Call `show` with the text of an answer while it is generated, for display only."""
        self._inner.show_answers(show)

    def close(self) -> None:
        """End the process."""
        self._inner.close()

    def _fault_or_error(self) -> str:
        """As `_find_fault`; an error of the check is a fault too, because a robot may be waiting."""
        try:
            return self._find_fault()
        except DualbrainError as error:
            return str(error)

    def _find_fault(self) -> str:
        """The fault of the present process, "" if it has none or was checked already."""
        pid = self._inner.pid
        if pid is not None and pid == self._checked_pid:
            return ""
        fault = self._check(self._inner)
        self._checked_pid = None if fault else self._inner.pid
        return fault
