"""user_rows: rows a'u ≥ b from the application, which are relaxed first."""

from __future__ import annotations

import numpy as np

from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import home_posture, sparse_panda_filter
from dualbrain.safety.cbf.rows import ConstraintRow, Rank


def _scenario() -> Scenario:
    safety = sparse_panda_filter()
    a = (1.0, -0.5, 0.0, 0.25, 0.0, 0.0, 0.0)
    safety.constrain([ConstraintRow(name="user_rows: slow shoulder", a=a, b=-0.2)])
    push = np.array([-1.0, 1.0, 0.0, -1.0, 0.5, 0.0, 0.0])

    def h(q: Array, u: Array) -> float:
        del q
        return float(np.array(a) @ u + 0.2 + 1e-6)

    return Scenario(safety=safety, start=home_posture(safety), nominal=lambda q: push, h=h, duration=0.5)


BARRIER = BarrierSpec(
    name="user_rows",
    description="linear constraints on the joint velocity that the application sets with SafetyFilter.constrain; "
    "a row may have another rank than task",
    h="h = a'u − b",
    row="a'u ≥ b, as given, without added margins",
    rank=Rank.TASK,
    alpha="chosen by the application",
    margins=(),
    source="SafetyFilter.constrain",
    implementation="safety/cbf/rows.py onto kernel/src/dbk_build_rows.c",
    scenario=_scenario,
)
