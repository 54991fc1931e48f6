"""The protocol of approvers, and what an embodiment contributes."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable


@runtime_checkable
class Approver(Protocol):
    def review(self, action, store):
        """The action to execute."""
        ...


@dataclass(frozen=True)
class GuardrailContribution:
    approvers: tuple[tuple[str, Any], ...] = ()
    warnings: tuple[str, ...] = ()


class DeltaLimitApprover:
    @staticmethod
    def rewind_reference(store, pose):
        """The position from which the next step is measured, if there is one."""
        if "delta_limit:last" in store:
            store["delta_limit:last"] = pose.copy()
