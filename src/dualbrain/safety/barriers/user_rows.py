"""user_rows: rows a'u ≥ b that come from outside, given up first."""

from __future__ import annotations

import numpy as np

from dualbrain.safety.barriers.barrier import Array, Barrier, Trial
from dualbrain.safety.barriers.scenarios import arm_filter, home
from dualbrain.safety.cbf.rows import Rank, Row


def _trial() -> Trial:
    safety = arm_filter()
    a = (1.0, -0.5, 0.0, 0.25, 0.0, 0.0, 0.0)
    safety.constrain([Row("user_rows: slow shoulder", a, -0.2)])
    push = np.array([-1.0, 1.0, 0.0, -1.0, 0.5, 0.0, 0.0])

    def h(q: Array, u: Array) -> float:
        del q
        return float(np.array(a) @ u + 0.2 + 1e-6)

    return Trial(safety, home(safety), lambda q: push, h, seconds=0.5)


BARRIER = Barrier(
    name="user_rows",
    says="linear rows on the joint velocity that the user hands in for one step or until further notice",
    h="a'u − b",
    row="a'u ≥ b, as given; the user's own margins",
    rank=Rank.TASK,
    alpha="the user's",
    margins=(),
    source="SafetyFilter.constrain",
    where="safety/cbf/rows.py onto kernel/src/dbk_rows.c",
    trial=_trial,
)
