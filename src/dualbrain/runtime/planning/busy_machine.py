"""Stops of a simulated robot by a busy machine, found by the check of the supervisor that ended a contract."""

from __future__ import annotations

from dualbrain.control.recording.trace import Event
from dualbrain.safety.supervisor.checks import CHECKS, Check

BUSY_MACHINE_CHECKS = ("infeasible", "scene_stale", "heartbeat_lost", "state_stale", "tick_lost", "loop_behind")
"""Checks that trip if the processes of a simulated run get too little processor time.

States, scenes, ticks and commands then come late, and persons move on meanwhile until no safe control is left.
"""
_ENDING_CHECKS = {check.name: check for check in CHECKS if check.contract_outcome}


class ContractEnding:
    """The check of the supervisor that ended the contract of the present try, from the events of the run."""

    def __init__(self) -> None:
        """Start without a check."""
        self._check: Check | None = None

    def begin_try(self) -> None:
        """Forget the check of the try before."""
        self._check = None

    def on_event(self, event: Event) -> None:
        """Keep the first check after the start of a contract that ends it; the data of a decision name its check."""
        if event.kind == "action" and event.data.get("index") == 0:
            self._check = None
        if event.kind == "order" and self._check is None:
            self._check = _ENDING_CHECKS.get(str(event.data.get("check", "")))

    def busy_machine(self) -> Check | None:
        """The check that ended the contract, if a busy machine can be its cause."""
        check = self._check
        return check if check is not None and check.name in BUSY_MACHINE_CHECKS else None
