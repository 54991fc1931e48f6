"""A filter that only watches, for the arms without one: what it would do is measured and obeyed by nobody.

In the full system a filter that finds no safe control says so, and the supervisor ends the contract. An arm without a
filter must not owe its safety to that word: only what is no matter of barriers (inputs that are stale or no numbers)
is still reported, for the supervisor is in every arm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.embodiment.robot import RobotState
from dualbrain.safety.filter import SafetyFilter
from dualbrain.safety.result import Filtered, Status
from dualbrain.safety.shadow import REFUSED


class UnheededFilter(SafetyFilter):
    """As `SafetyFilter`, but an answer of the barriers alone is no alarm; h and its rows are as ever."""

    def filter(self, state: RobotState, u_nom: NDArray[np.float64], now: float) -> Filtered:
        """One step of watching."""
        answer = super().filter(state, u_nom, now)
        alarm = answer.status > Status.MODIFIED and not answer.flags & REFUSED
        return answer.unfiltered() if alarm else answer
