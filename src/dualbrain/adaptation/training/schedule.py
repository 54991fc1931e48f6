"""The order of samples and the learning rate of each step: functions of settings and seed alone."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

from dualbrain.adaptation.config import FitConfig

FINAL_RATE_SHARE = 0.1
"""The final learning rate divided by the highest one."""


def plan_batches(repeats: Sequence[int], config: FitConfig) -> list[list[int]]:
    """The samples of each step, as indices. Sample i occurs `repeats[i]` times per epoch; each epoch is shuffled.

    The remainder of an epoch is used in the next batch, so no sample is skipped. Law: the plan depends only on seed,
    batch size and `repeats`, so a resumed run has the same plan.
    """
    stack: list[int] = []
    epoch, plan = 0, list[list[int]]()
    for _ in range(config.steps):
        while len(stack) < config.batch:
            rows = [row for row, times in enumerate(repeats) for _ in range(times)]
            random.Random(f"{config.seed}:{epoch}").shuffle(rows)
            stack, epoch = stack + rows, epoch + 1
        plan.append(stack[: config.batch])
        stack = stack[config.batch :]
    return plan


def learning_rate(step: int, config: FitConfig) -> float:
    """The learning rate of `step`, counted from 1: a linear rise, then half a cosine down to a tenth."""
    rise = min(1.0, step / config.warm_up) if config.warm_up else 1.0
    fall = FINAL_RATE_SHARE + (1.0 - FINAL_RATE_SHARE) * 0.5 * (1.0 + math.cos(math.pi * step / config.steps))
    return config.rate * rise * fall
