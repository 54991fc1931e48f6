"""The operator's hand: what a person has asked for, as conditions that hold or buttons that are pressed."""

from __future__ import annotations

from dualbrain.control.gatekeeper.protocol.messages import Operate
from dualbrain.safety.supervisor.conditions import Condition

FREE_FOR_ALL = ("estop",)
"""What every local process may do, without a key."""
SLOWEST = 0.01
HELD = {"pause": Condition.PAUSE, "takeover": Condition.TAKEOVER, "estop": Condition.ESTOP}
LET_GO = {"resume": Condition.PAUSE, "hand_back": Condition.TAKEOVER, "release_estop": Condition.ESTOP}
PRESSED = {"resume": Condition.RESUME, "reset": Condition.RESET, "abort": Condition.ABORT}
"""Resume both lets a pause go and leads out of the HOLD after a reset."""


class Hand:
    """Takes acts in, gives `Condition` bits out; `stage` is the chosen speed, (0, 1]."""

    def __init__(self, stage: float = 1.0) -> None:
        """Nothing is held."""
        self.stage = stage
        self._held = 0
        self._pressed = 0

    def act(self, wish: Operate) -> str:
        """Do what is asked; "" or why not."""
        self._held |= int(HELD.get(wish.act, 0))
        self._held &= ~int(LET_GO.get(wish.act, 0))
        self._pressed |= int(PRESSED.get(wish.act, 0))
        if wish.act == "speed":
            if not SLOWEST <= wish.speed <= 1.0:
                return f"speed {wish.speed}: allowed is {SLOWEST} to 1"
            self.stage = wish.speed
        return ""

    def conditions(self) -> int:
        """What is held, and what was pressed since the last call."""
        pressed, self._pressed = self._pressed, 0
        return self._held | pressed


def allowed(act: str, role: str) -> bool:
    """Whoever commands may also stop; only the operator's key lets go, resets, resumes, or changes the speed."""
    return act in FREE_FOR_ALL or role == "operator" or (role == "commander" and act in ("pause", "abort"))
