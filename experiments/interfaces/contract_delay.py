"""Delay of a 1 kHz control loop by the worst contracts: without contracts, with a gate process, and with a gate thread.

The loop steps a filter in each period, as the gatekeeper does, and passes contracts on as soon as the last one has its
verdict. The gate thread is the design before 0.3: it shares the interpreter with the loop.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from threading import Thread
from typing import Any

import numpy as np

from dualbrain.contracts.contract import ContractHeader
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.capability import full_capability
from dualbrain.control.gatekeeper.gate.exchange import ContractGate, GateReply, GateRequest, GateSetup
from dualbrain.control.gatekeeper.gate.gate_process import GateProcess
from dualbrain.control.gatekeeper.gate.inline_gate import InlineGate
from dualbrain.control.gatekeeper.process import SWITCH_INTERVAL
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.registry import skill_registry
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.interfaces.worst_contracts import worst_contracts

REPEATS = 3
N_TICKS = 20_000
"""Ticks of one run: 20 s at 1 kHz."""
N_RANDOM_CONTRACTS = 200
PERIOD = 1e-3
"""Period of the loop [s]."""
VARIANTS = ("no contracts", "gate process", "gate thread")
LIMIT = 2e-3
"""Largest delay beyond the undisturbed loop that is allowed [s]."""


class GateThread:
    """A gate on a thread of the control process; implements `ContractGate`."""

    def __init__(self, setup: GateSetup) -> None:
        """Prepare the gate; each check has a thread of its own."""
        self._gate, self._thread = InlineGate(setup), None

    @property
    def busy(self) -> bool:
        """Whether a contract is being checked, or its reply has not been taken."""
        return self._thread is not None

    def submit(self, request: GateRequest) -> bool:
        """Start to check a request."""
        if self._thread is not None:
            return False
        self._thread: Thread | None = Thread(target=self._gate.submit, args=(request,))
        self._thread.start()
        return True

    def take_reply(self) -> GateReply | None:
        """The reply, once the thread has ended."""
        if self._thread is None or self._thread.is_alive():
            return None
        self._thread = None
        return self._gate.take_reply()

    def close(self) -> None:
        """Wait for the thread."""
        if self._thread is not None:
            self._thread.join()


class ContractDelay:
    """Largest interval and largest processor time of a control loop, beside the worst contracts."""

    name = "contract_delay"
    claim = (
        "Beside the worst contracts known, the largest interval of a 1 kHz control loop grows by less than 2 ms, "
        "because the gate is a process of its own. A gate on a thread of the control process delays the loop."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Return the variants in turn, so that each repeat sees the same load; the machine should be idle."""
        del options
        return [
            WorkUnit(f"{variant} {repeat}", {"variant": variant, "seed": repeat})
            for repeat in range(REPEATS)
            for variant in VARIANTS
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run the loop of one variant."""
        robot_model = load_robot("panda")
        registry = skill_registry(robot_model)
        setup = GateSetup(robot_model=robot_model, capabilities={PLANNER: full_capability(registry)})
        gate = _make_gate(parameters["variant"], setup)
        contracts = list(worst_contracts(registry, n_random=N_RANDOM_CONTRACTS, seed=parameters["seed"]).values())
        with suppress(OSError, AttributeError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
        try:
            return {"variant": parameters["variant"], **_run_loop(robot_model, gate, contracts)}
        finally:
            with suppress(OSError, AttributeError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            if gate is not None:
                gate.close()

    def summarize_row(self, row: Row) -> str:
        """Summarize the row for the progress line."""
        return f"{row['variant']}: {row['contracts']} contracts, largest interval {1e3 * row['intervals'][-1]:.2f} ms"

    def report(self, rows: list[Row]) -> list[str]:
        """Report the largest values of each variant, and the extra delay of each repeat."""
        by_variant = {name: [row for row in rows if row["variant"] == name] for name in VARIANTS}
        table = markdown_table(
            ("variant", "contracts", "interval, median", "99.9 %", "largest", "processor time of a tick, largest"),
            [
                (
                    name,
                    f"{sum(row['contracts'] for row in found):,}",
                    *(f"{1e3 * max(row['intervals'][k] for row in found):.2f} ms" for k in range(3)),
                    f"{1e3 * max(row['cpu'][-1] for row in found):.2f} ms",
                )
                for name, found in by_variant.items()
                if found
            ],
        )
        return [*table, "", *_extra_delays(by_variant)]


def _extra_delays(by_variant: dict[str, list[Row]]) -> list[str]:
    """Sentences on the extra delay: the largest interval of a repeat minus that of the undisturbed loop."""
    lines: list[str] = []
    for name in VARIANTS[1:]:
        pairs = list(zip(by_variant[VARIANTS[0]], by_variant[name], strict=False))
        extra = [1e3 * (one["intervals"][-1] - calm["intervals"][-1]) for calm, one in pairs]
        cpu = [1e3 * (one["cpu"][-1] - calm["cpu"][-1]) for calm, one in pairs]
        if pairs:
            lines.append(
                f"- {name}: largest interval beyond that of the undisturbed loop, by repeat: "
                f"{', '.join(f'{value:+.2f}' for value in extra)} ms; processor time of a tick: "
                f"{', '.join(f'{value:+.2f}' for value in cpu)} ms (allowed: {1e3 * LIMIT:.0f} ms)."
            )
    return lines


def _make_gate(variant: str, setup: GateSetup) -> ContractGate | None:
    if variant == "gate process":
        gate = GateProcess(setup)
        gate.wait_until_ready()
        return gate
    return GateThread(setup) if variant == "gate thread" else None


def _run_loop(robot_model: RobotModel, gate: ContractGate | None, contracts: list[bytes]) -> Row:
    """Run the loop; returns the median, the 99.9 % point and the largest of intervals and of processor times [s]."""
    sys.setswitchinterval(SWITCH_INTERVAL)
    scene = scene_from_spec(open_scene("tabletop:1"))
    safety, q, v = SafetyFilter(robot_model), np.array(robot_model.home), np.zeros(robot_model.n)
    state = RobotState(stamp=0.0, sequence=1, q=q, v=v, opening=0.04, finger_forces=(0.0, 0.0))
    starts, cpu, submitted, next_tick = [0.0] * N_TICKS, [0.0] * N_TICKS, 0, time.monotonic() + PERIOD
    for tick in range(N_TICKS):
        time.sleep(max(0.0, next_tick - time.monotonic()))
        next_tick = max(next_tick + PERIOD, time.monotonic())
        starts[tick], cpu[tick] = time.monotonic(), time.process_time()
        safety(q, v, np.full(robot_model.n, 0.1), opening=0.04)
        if gate is not None and not gate.busy:
            stamp = ContractHeader(
                sequence=tick + 1, issued=0.0, expires=1e6, principal=PLANNER, scene_version=scene.version
            )
            contract = contracts[submitted % len(contracts)]
            request = GateRequest(
                connection_number=1,
                sequence=tick + 1,
                contract=contract,
                stamp=stamp,
                now=1.0,
                scene=scene,
                state=state,
                holding=None,
            )
            submitted += gate.submit(request)
        if gate is not None:
            gate.take_reply()
    points = [0.5, 0.999, 1.0]
    return {
        "contracts": submitted,
        "intervals": np.quantile(np.diff(starts)[10:], points).tolist(),
        "cpu": np.quantile(np.diff(cpu)[10:], points).tolist(),
    }
