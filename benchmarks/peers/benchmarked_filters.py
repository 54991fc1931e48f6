"""The compared filters: name, environment and configuration of each."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.peers.setup_environments import python_of

OWN_NAME = "dualbrain"
"""The filter whose median is the reference of all ratios."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchmarkedFilter:
    """A filter: the class `Filter` of `module` in `environment` (None: that of dualbrain), built with `options`.

    `is_default` marks the default configuration of cbfpy, `in_primitives` the filters of the setting *primitives*,
    `same_rows` the filters that solve the same QP rows as all others. `gains` are the values of α [1/s] in the closed
    loop under acceleration limits; None is the α of the robot.
    """

    name: str
    module: str
    environment: str | None = None
    options: dict[str, Any] = field(default_factory=dict)
    is_default: bool = False
    in_primitives: bool = True
    same_rows: bool = True
    gains: tuple[float | None, ...] = ()

    @property
    def python(self) -> Path:
        """Python interpreter of the filter."""
        return Path(sys.executable) if self.environment is None else python_of(self.environment)

    @property
    def is_own(self) -> bool:
        """Whether this is a filter of dualbrain."""
        return self.name.startswith(OWN_NAME)


BOTH_GAINS = (None, 10.0)
"""The α of the robot (min a/v), and the α of the examples of oscbf [1/s]."""


def _cbfpy_entry(
    jax: str, kinematics: str, backend: str, *, primitives: bool = False, gains: tuple[float | None, ...] = ()
) -> BenchmarkedFilter:
    options: dict[str, Any] = {"kinematics": kinematics}
    if backend == "hard":
        options["relax"] = False
    if backend == "elastiqp":
        options |= {"backend": "elastiqp", "tolerance": 1e-6}
    return BenchmarkedFilter(
        name=f"cbfpy {backend}, {kinematics}, JAX {jax}",
        module="benchmarks.peers.filters.cbfpy_filter",
        environment=f"cbfpy-jax-{jax}",
        options=options,
        is_default=backend == "default",
        in_primitives=primitives,
        gains=gains,
    )


OLD_JAX, NEW_JAX = "0.4.30", "0.10.2"
BENCHMARKED_FILTERS = (
    BenchmarkedFilter(
        name=OWN_NAME, module="benchmarks.peers.filters.dualbrain_filter", options={"how": "call"}, gains=(None,)
    ),
    BenchmarkedFilter(
        name=f"{OWN_NAME}, RobotState", module="benchmarks.peers.filters.dualbrain_filter", options={"how": "state"}
    ),
    BenchmarkedFilter(
        name=f"{OWN_NAME}, in C", module="benchmarks.peers.filters.dualbrain_filter", options={"how": "c"}
    ),
    _cbfpy_entry(OLD_JAX, "oscbf", "default"),
    _cbfpy_entry(OLD_JAX, "oscbf", "hard"),
    _cbfpy_entry(OLD_JAX, "plain", "default", primitives=True, gains=BOTH_GAINS),
    _cbfpy_entry(OLD_JAX, "plain", "hard", primitives=True),
    _cbfpy_entry(NEW_JAX, "frax", "default"),
    _cbfpy_entry(NEW_JAX, "frax", "hard"),
    _cbfpy_entry(NEW_JAX, "frax", "elastiqp", primitives=True, gains=BOTH_GAINS),
    BenchmarkedFilter(
        name="pink daqp, all pairs", module="benchmarks.peers.filters.pink_filter", environment="pink", gains=BOTH_GAINS
    ),
    BenchmarkedFilter(
        name="mink daqp, all pairs", module="benchmarks.peers.filters.mink_filter", environment="mink", gains=BOTH_GAINS
    ),
    BenchmarkedFilter(
        name="mink daqp, broadphase 0.1 m",
        module="benchmarks.peers.filters.mink_filter",
        environment="mink",
        options={"broadphase": True, "detection": 0.1},
        same_rows=False,
        gains=BOTH_GAINS,
    ),
    BenchmarkedFilter(
        name="mink daqp, its defaults",
        module="benchmarks.peers.filters.mink_filter",
        environment="mink",
        options={"defaults": True},
        same_rows=False,
        gains=(None,),
    ),
)
QUICK_FILTERS = (
    BENCHMARKED_FILTERS[0],
    BENCHMARKED_FILTERS[2],
    BenchmarkedFilter(
        name="fake",
        module="benchmarks.peers.filters.fake_filter",
        options={"delay": 2e-4},
        is_default=True,
        gains=(None,),
    ),
)
