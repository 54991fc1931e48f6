"""The operator's hand: what a person has asked for, as conditions that hold or buttons that are pressed."""

from __future__ import annotations

from dualbrain.control.gatekeeper.protocol.messages import OperatorCommand
from dualbrain.safety.supervisor.conditions import Condition

UNRESTRICTED_ACTIONS = ("estop",)
"""What every local process may do, without a key."""
MIN_SPEED = 0.01
LATCHED_CONDITIONS = {"pause": Condition.PAUSE, "takeover": Condition.TAKEOVER, "estop": Condition.ESTOP}
RELEASE_ACTIONS = {"resume": Condition.PAUSE, "hand_back": Condition.TAKEOVER, "release_estop": Condition.ESTOP}
MOMENTARY_CONDITIONS = {"resume": Condition.RESUME, "reset": Condition.RESET, "abort": Condition.ABORT}
"""Resume both lets a pause go and leads out of the HOLD after a reset."""


class OperatorCommands:
    """Takes acts in, gives `Condition` bits out; `stage` is the chosen speed, (0, 1]."""

    def __init__(self, speed_stage: float = 1.0) -> None:
        """Nothing is held."""
        self.speed_stage = speed_stage
        self._latched = 0
        self._pressed = 0

    def apply(self, command: OperatorCommand) -> str:
        """Do what is asked; "" or why not."""
        self._latched |= int(LATCHED_CONDITIONS.get(command.act, 0))
        self._latched &= ~int(RELEASE_ACTIONS.get(command.act, 0))
        self._pressed |= int(MOMENTARY_CONDITIONS.get(command.act, 0))
        if command.act == "speed":
            if not MIN_SPEED <= command.speed <= 1.0:
                return f"speed {command.speed}: allowed is {MIN_SPEED} to 1"
            self.speed_stage = command.speed
        return ""

    def conditions(self) -> int:
        """What is held, and what was pressed since the last call."""
        pressed, self._pressed = self._pressed, 0
        return self._latched | pressed


def is_allowed(act: str, role: str) -> bool:
    """Whoever commands may also stop; only the operator's key lets go, resets, resumes, or changes the speed."""
    return act in UNRESTRICTED_ACTIONS or role == "operator" or (role == "commander" and act in ("pause", "abort"))
