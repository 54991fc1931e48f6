"""In which order samples are shown, and how fast is learnt at each step: functions of the dials and the seed alone."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

from dualbrain.adaptation.config import FitDials

FLOOR = 0.1
"""The last rate over the highest."""


def batches(shown: Sequence[int], dials: FitDials) -> list[list[int]]:
    """The rows of each step's samples. Sample i stands `shown[i]` times in an epoch; each epoch is shuffled anew.

    What is left of an epoch flows into the next, so that no sample is passed over. Law: nothing but seed, batch and
    `shown` decides them, so that a run that is resumed sees what it would have seen.
    """
    stack: list[int] = []
    epoch, plan = 0, list[list[int]]()
    for _ in range(dials.steps):
        while len(stack) < dials.batch:
            rows = [row for row, times in enumerate(shown) for _ in range(times)]
            random.Random(f"{dials.seed}:{epoch}").shuffle(rows)
            stack, epoch = stack + rows, epoch + 1
        plan.append(stack[: dials.batch])
        stack = stack[dials.batch :]
    return plan


def rate(step: int, dials: FitDials) -> float:
    """The learning rate of `step`, counted from 1: a linear rise, then half a cosine down to a tenth."""
    rise = min(1.0, step / dials.warm_up) if dials.warm_up else 1.0
    fall = FLOOR + (1.0 - FLOOR) * 0.5 * (1.0 + math.cos(math.pi * step / dials.steps))
    return dials.rate * rise * fall
