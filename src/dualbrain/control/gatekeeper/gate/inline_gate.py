"""A gate in the control process, for lockstep simulations: the result does not depend on the machine's speed."""

from __future__ import annotations

import time

from dualbrain.control.gatekeeper.gate.contract_checker import ContractChecker
from dualbrain.control.gatekeeper.gate.exchange import GateReply, GateRequest, GateSetup


class InlineGate:
    """Checks a contract within `submit`; implements `ContractGate`. Not for real time: the check delays the tick."""

    def __init__(self, setup: GateSetup) -> None:
        """Prepare the gate of the robot in `setup`."""
        self._checker = ContractChecker(setup)
        self._reply: GateReply | None = None

    @property
    def busy(self) -> bool:
        """Whether a reply has not been taken."""
        return self._reply is not None

    def submit(self, request: GateRequest) -> bool:
        """Check a request; returns False if the reply to another one has not been taken."""
        if self.busy:
            return False
        start = time.monotonic()
        verdict = self._checker.check(request)
        self._reply = GateReply(request, verdict, time.monotonic() - start)
        return True

    def take_reply(self) -> GateReply | None:
        """The reply, or None if no request was submitted."""
        reply, self._reply = self._reply, None
        return reply

    def close(self) -> None:
        """Nothing to end."""
