"""Operator commands, as conditions that hold until they are released or that hold for one tick."""

from __future__ import annotations

from dualbrain.control.gatekeeper.protocol.messages import OperatorCommand
from dualbrain.safety.supervisor.conditions import Condition

UNRESTRICTED_ACTIONS = ("estop",)
"""Commands that every local process may send, without a key."""
MIN_SPEED = 0.01
"""Lowest speed scale."""
LATCHED_CONDITIONS = {"pause": Condition.PAUSE, "takeover": Condition.TAKEOVER, "estop": Condition.ESTOP}
"""Conditions that hold until they are released, and at least for one tick."""
RELEASE_ACTIONS = {"resume": Condition.PAUSE, "hand_back": Condition.TAKEOVER, "release_estop": Condition.ESTOP}
"""Commands that release a latched condition."""
MOMENTARY_CONDITIONS = {"resume": Condition.RESUME, "reset": Condition.RESET, "abort": Condition.ABORT}
"""Conditions that hold for one tick; resume both releases a pause and ends the HOLD after a reset."""


class OperatorCommands:
    """Translates operator commands to `Condition` bits; `speed_scale` is the chosen speed scale, (0, 1]."""

    def __init__(self, speed_scale: float = 1.0) -> None:
        """Start without conditions."""
        self.speed_scale = speed_scale
        self._latched = 0
        self._momentary = 0

    def apply(self, command: OperatorCommand) -> str:
        """Apply a command; returns "" or the reason why it is refused."""
        pressed = int(LATCHED_CONDITIONS.get(command.act, 0))
        self._latched |= pressed
        self._latched &= ~int(RELEASE_ACTIONS.get(command.act, 0))
        self._momentary |= pressed | int(MOMENTARY_CONDITIONS.get(command.act, 0))
        if command.act == "speed":
            if not MIN_SPEED <= command.speed <= 1.0:
                return f"speed: got {command.speed}, allowed {MIN_SPEED} to 1"
            self.speed_scale = command.speed
        return ""

    def conditions(self) -> int:
        """The latched `Condition` bits, and the momentary ones of commands since the last call."""
        momentary, self._momentary = self._momentary, 0
        return self._latched | momentary


def is_allowed(act: str, role: str) -> bool:
    """Whether `role` may send `act`: a commander may also stop; all other commands need the operator's key."""
    return act in UNRESTRICTED_ACTIONS or role == "operator" or (role == "commander" and act in ("pause", "abort"))
