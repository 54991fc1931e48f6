"""Growth of the cost of a function with the size of its input, measured in processor time."""

import time
from collections.abc import Callable

REPETITIONS = 3
MIN_MEASURABLE_S = 2e-3
"""A shorter cost is not measurable; the size is then increased."""


def growth_of_cost(work: Callable[[int], object], size: int, *, factor: int = 4, max_size: int = 1 << 20) -> float:
    """Cost of `work(factor · size)` relative to `factor` times the cost of `work(size)`.

    About 1 for a linear cost, `factor` for a quadratic one; 0 if the largest size costs too little to be measured. The
    least of three measurements counts, because other processes can only make a larger size appear more expensive.
    """
    return min(_measure(work, size, factor, max_size) for _ in range(REPETITIONS))


def _measure(work: Callable[[int], object], size: int, factor: int, max_size: int) -> float:
    while (cost := _least_cost(work, size)) < MIN_MEASURABLE_S:
        if size * factor > max_size:
            return 0.0
        size *= 2
    return _least_cost(work, factor * size) / (factor * cost)


def _least_cost(work: Callable[[int], object], size: int) -> float:
    """The least processor time of three calls [s]; one call if it takes long."""
    costs: list[float] = []
    for _ in range(3):
        start = time.process_time()
        work(size)
        costs.append(time.process_time() - start)
        if costs[0] > 1.0:
            break
    return min(costs)
