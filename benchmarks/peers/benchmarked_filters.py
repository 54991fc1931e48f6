"""Who takes part: name, environment and configuration of every contestant."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.peers.setup_environments import python_of

OWN = "dualbrain"
"""The contestant whose median everybody's ratio is taken over."""


@dataclass(frozen=True, slots=True)
class Contestant:
    """`module` run in `environment` (None: ours) with `options`.

    `shipped` marks cbfpy's defaults, `primitives` who takes part in the second setting, `exact` who states the same
    rows as everybody else. `gains` are the α of the closed loop under acceleration limits, None being the body's.
    """

    name: str
    module: str
    environment: str | None = None
    options: dict[str, Any] = field(default_factory=dict)
    shipped: bool = False
    primitives: bool = True
    exact: bool = True
    gains: tuple[float | None, ...] = ()

    @property
    def python(self) -> Path:
        """The interpreter to run it with."""
        return Path(sys.executable) if self.environment is None else python_of(self.environment)

    @property
    def ours(self) -> bool:
        """Is it one of our own?"""
        return self.name.startswith(OWN)


BOTH = (None, 10.0)
"""The body's α, min a/v, and the α of oscbf's examples."""


def _cbfpy(
    jax: str, kinematics: str, backend: str, *, primitives: bool = False, gains: tuple[float | None, ...] = ()
) -> Contestant:
    options: dict[str, Any] = {"kinematics": kinematics}
    if backend == "hard":
        options["relax"] = False
    if backend == "elastiqp":
        options |= {"backend": "elastiqp", "tolerance": 1e-6}
    return Contestant(
        f"cbfpy {backend}, {kinematics}, JAX {jax}", "benchmarks.peers.filters.cbfpy_filter", f"cbfpy-jax-{jax}", options,
        shipped=backend == "default", primitives=primitives, gains=gains,
    )  # fmt: skip


OLD, NEW = "0.4.30", "0.10.2"
CONTESTANTS = (
    Contestant(OWN, "benchmarks.peers.filters.dualbrain_filter", options={"how": "call"}, gains=(None,)),
    Contestant(f"{OWN}, RobotState", "benchmarks.peers.filters.dualbrain_filter", options={"how": "state"}),
    Contestant(f"{OWN}, in C", "benchmarks.peers.filters.dualbrain_filter", options={"how": "c"}),
    _cbfpy(OLD, "oscbf", "default"),
    _cbfpy(OLD, "oscbf", "hard"),
    _cbfpy(OLD, "plain", "default", primitives=True, gains=BOTH),
    _cbfpy(OLD, "plain", "hard", primitives=True),
    _cbfpy(NEW, "frax", "default"),
    _cbfpy(NEW, "frax", "hard"),
    _cbfpy(NEW, "frax", "elastiqp", primitives=True, gains=BOTH),
    Contestant("pink daqp, all pairs", "benchmarks.peers.filters.pink_filter", "pink", gains=BOTH),
    Contestant("mink daqp, all pairs", "benchmarks.peers.filters.mink_filter", "mink", gains=BOTH),
    Contestant(
        "mink daqp, broadphase 0.1 m", "benchmarks.peers.filters.mink_filter", "mink", {"broadphase": True, "detection": 0.1},
        exact=False, gains=BOTH,
    ),
    Contestant(
        "mink daqp, its defaults", "benchmarks.peers.filters.mink_filter", "mink", {"defaults": True}, exact=False, gains=(None,),
    ),
)  # fmt: skip
QUICK = (
    CONTESTANTS[0],
    CONTESTANTS[2],
    Contestant("fake", "benchmarks.peers.filters.fake_filter", options={"nap": 2e-4}, shipped=True, gains=(None,)),
)
