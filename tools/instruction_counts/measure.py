"""Measurement of closed loops, and the committed counts."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tools.instruction_counts.emulator import GCC, ZIG, Emulator, Toolchain, build, build_counter

COUNTS_FILE = Path(__file__).with_name("counts.json")
TOOLCHAINS = {toolchain.name: toolchain for toolchain in (ZIG, GCC)}
OBSTACLES = (0, 4, 12, 40)
STEPS = 1500


@dataclass(frozen=True, slots=True)
class Build:
    """A compiler by name, an optimisation level and a robot."""

    toolchain: str
    level: str
    robot: str

    @property
    def name(self) -> str:
        """Key in the committed counts."""
        return f"{self.toolchain} {self.level} {self.robot}"


SHIPPED = tuple(
    Build(toolchain, level, robot)
    for toolchain in ("gcc", "zig")
    for level in ("-O2", "-Os")
    for robot in ("panda", "ur5e", "ur5e_lean", "fr3")
)
"""The builds in the committed counts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopCounts:
    """Instructions of `dbk_step` in one closed loop: mean, maximum, and those of the first step."""

    obstacles: int
    steps: int
    mean: float
    most: int
    first: int
    hash: str
    profile: dict[str, float]

    def as_record(self) -> dict[str, object]:
        """The committed fields."""
        return {"steps": self.steps, "mean": self.mean, "most": self.most, "first": self.first, "hash": self.hash}


def measure(program: Build, folder: Path, obstacles: Iterable[int] = OBSTACLES, steps: int = STEPS) -> list[LoopCounts]:
    """Build a program in `folder` and run one closed loop for every number of obstacles."""
    toolchain: Toolchain = TOOLCHAINS[program.toolchain]
    elf = build(toolchain, program.level, program.robot, folder)
    counter = build_counter(folder)
    return [run_loop(Emulator(elf, counter), count, steps) for count in obstacles]


def run_loop(machine: Emulator, obstacles: int, steps: int) -> LoopCounts:
    """Run one closed loop; the scene depends on the number of obstacles only."""
    placed = machine.call("loop_begin", obstacles, 7 + OBSTACLES.index(obstacles))
    machine.clear_profile()
    counts = list(_step_counts(machine, steps))
    low, high = machine.read_integers("loop_hash", 2)
    return LoopCounts(
        obstacles=placed,
        steps=steps,
        mean=round(sum(counts) / steps, 1),
        most=max(counts),
        first=counts[0],
        hash=f"{high << 32 | low:016x}",
        profile={name: n / steps for name, n in machine.profile().items() if not name.startswith("loop_")},
    )


def _step_counts(machine: Emulator, steps: int) -> Iterator[int]:
    """Instructions of every step."""
    for _ in range(steps):
        machine.call("loop_propose")
        before = machine.instructions
        machine.call("loop_step")
        yield machine.instructions - before
        machine.call("loop_apply")


def committed_counts() -> dict[str, dict[str, dict[str, object]]]:
    """Committed counts by build and number of obstacles."""
    return json.loads(COUNTS_FILE.read_text())
