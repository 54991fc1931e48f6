"""Periods that the control thread misses under an emulated PREEMPT_RT kernel, idle and beside busy processes."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.errors import ConfigurationError
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.engine.virtual_environment import BUILD
from experiments.figures.tables import markdown_table
from experiments.gatekeeper.preempt_rt.build_program import build_program
from experiments.gatekeeper.preempt_rt.debian_kernel import fetch_kernel
from experiments.gatekeeper.preempt_rt.punctuality import Punctuality, parse_console
from experiments.gatekeeper.preempt_rt.virtual_machine import find_emulator, run_machine

KERNEL_FOLDER = BUILD / "preempt_rt"
PRIORITY, N_BUSY = 80, 4
N_BOOTS = 3
"""Boots of each variant; they are not identical."""
ALLOWED_MISSED, REQUIRED_MISSED = 0, 1000
"""Periods that SCHED_FIFO may miss, and that the negative control must exceed."""


@dataclass(frozen=True, slots=True)
class Variant:
    """One run: `title`, number of `periods`, `priority` (0: ordinary), and number of `busy` processes."""

    title: str
    periods: int
    priority: int
    busy: int

    @property
    def arguments(self) -> tuple[str, ...]:
        """Arguments of the program."""
        return (str(self.periods), str(self.priority), str(self.busy))


VARIANTS = {
    "idle": Variant("idle, SCHED_FIFO", 20_000, PRIORITY, 0),
    "ordinary": Variant("four busy processes, ordinary priority", 10_000, 0, N_BUSY),
    "loaded": Variant("four busy processes, SCHED_FIFO", 20_000, PRIORITY, N_BUSY),
}


class PreemptRt:
    """Missed periods of the control thread as a task of a real-time kernel."""

    name = "preempt_rt"
    claim = (
        "Under a PREEMPT_RT kernel in emulation, the control thread in C with SCHED_FIFO misses none of 20,000 periods "
        "at 1 kHz, idle and beside four busy processes; with ordinary priority beside them it misses more than 1,000 "
        "of 10,000. This holds in each of three boots."
    )
    intervals = "least and most of the boots; time is counted in instructions"

    def units(self, options: Options) -> list[WorkUnit]:
        """Rounds of one boot for each variant."""
        del options
        return [
            WorkUnit(f"{variant} {number}", {"variant": variant}) for number in range(N_BOOTS) for variant in VARIANTS
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Boot the kernel with the program as its first process."""
        variant = VARIANTS[parameters["variant"]]
        find_emulator()
        kernel = fetch_kernel(KERNEL_FOLDER)
        with tempfile.TemporaryDirectory() as folder:
            program = build_program(Path(folder))
            found = parse_console(run_machine(kernel, program, variant.arguments))
        check_run(variant, found)
        return {"variant": parameters["variant"], **msgspec.to_builtins(found)}

    def summarize_row(self, row: Row) -> str:
        """The missed periods and the longest delay."""
        return f"{row['missed']} of {row['periods']} periods missed, at most {row['delay_max_us']} µs late"

    def report(self, rows: list[Row]) -> list[str]:
        """The verdict, and one line for each variant."""
        heads = ("variant", "boots", "periods", "missed", "missed by boot", "late > 0.2 ms", "median [µs]")
        heads += ("99.9 % [µs]", "longest [µs]", "longest tick [µs]", "arm moves", "filter changes the control")
        by_variant = {name: [row for row in rows if row["variant"] == name] for name in VARIANTS}
        body = [_table_row(one.title, by_variant[name]) for name, one in VARIANTS.items() if by_variant[name]]
        kernels = ", ".join(sorted({row["kernel"] for row in rows}))
        notes = [
            "Missed: periods without a tick. Delays are those of the begin of a tick after its time, the largest of "
            "the boots; the last two columns are numbers of ticks.",
            f"Kernel: {kernels}; /sys/kernel/realtime is 1 in each run.",
        ]
        return [_verdict(by_variant), "", *markdown_table(heads, body), *notes]


def check_run(variant: Variant, found: Punctuality) -> None:
    """Refuse a run that is not that of `variant` under a real-time kernel.

    Raises:
        ConfigurationError: the kernel, the priority or the lock of the memory is another one, or periods are lacking.
    """
    expected: dict[str, object] = {
        "realtime": True,
        "policy": "SCHED_FIFO" if variant.priority else "SCHED_OTHER",
        "priority": variant.priority,
        "memory_locked": True,
        "busy": variant.busy,
        "dropped": 0,
    }
    for name, value in expected.items():
        if getattr(found, name) != value:
            raise ConfigurationError(f"{name} in the virtual machine", got=getattr(found, name), allowed=repr(value))
    if found.periods < variant.periods:
        raise ConfigurationError("periods", got=found.periods, allowed=f"at least {variant.periods}")


def _verdict(rows: dict[str, list[Row]]) -> str:
    """Whether the claim holds in all boots, once all variants have run."""
    if not all(rows.values()):
        return "Not all variants have run."
    punctual = all(row["missed"] <= ALLOWED_MISSED for name in ("idle", "loaded") for row in rows[name])
    distinct = all(row["missed"] > REQUIRED_MISSED for row in rows["ordinary"])
    return "The claim holds." if punctual and distinct else "The claim does **not** hold."


def _table_row(title: str, rows: list[Row]) -> tuple[object, ...]:
    """Sums of the counts and maxima of the times over the boots of one variant."""
    missed = [row["missed"] for row in rows]
    times = ("delay_median_us", "delay_p999_us", "delay_max_us", "work_max_us")
    return (
        title,
        len(rows),
        _total(rows, "periods"),
        sum(missed),
        f"[{min(missed)}, {max(missed)}]",
        _total(rows, "late"),
        *(max(row[name] for row in rows) for name in times),
        _total(rows, "moving"),
        _total(rows, "modified"),
    )


def _total(rows: list[Row], name: str) -> int:
    return sum(row[name] for row in rows)
