"""The boards and toolchains of the firmware."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from dualbrain.errors import UnknownNameError


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """One board that QEMU emulates: core, addresses, and the flags of both compilers for its processor."""

    name: str
    machine: str
    core: str
    gcc: tuple[str, ...]
    zig_cpu: str
    code_origin: int
    ram_origin: int
    uart_base: int
    uart_rx_irq: int
    drive_output: int
    watchdog_base: int
    clock_hz: int


BOARDS = {
    board.name: board
    for board in (
        Board(
            name="an386",
            machine="mps2-an386",
            core="Cortex-M4F",
            gcc=("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16"),
            zig_cpu="cortex_m4+vfp4d16sp",
            code_origin=0x0,
            ram_origin=0x21000000,
            uart_base=0x40004000,
            uart_rx_irq=0,
            drive_output=0x40028000,
            watchdog_base=0x40008000,
            clock_hz=25_000_000,
        ),
        Board(
            name="an500",
            machine="mps2-an500",
            core="Cortex-M7",
            gcc=("-mcpu=cortex-m7", "-mfpu=fpv5-sp-d16"),
            zig_cpu="cortex_m7+fp_armv8d16sp",
            code_origin=0x0,
            ram_origin=0x60000000,
            uart_base=0x40004000,
            uart_rx_irq=0,
            drive_output=0x40028000,
            watchdog_base=0x40008000,
            clock_hz=25_000_000,
        ),
        Board(
            name="an505",
            machine="mps2-an505",
            core="Cortex-M33",
            gcc=("-mcpu=cortex-m33", "-mfpu=fpv5-sp-d16"),
            zig_cpu="cortex_m33+fp_armv8d16sp",
            code_origin=0x10000000,
            ram_origin=0x80000000,
            uart_base=0x50200000,
            uart_rx_irq=32,
            drive_output=0x50302000,
            watchdog_base=0x50081000,
            clock_hz=20_000_000,
        ),
    )
}
RAM_SIZE = 16 << 20
"""Size of the external RAM of all three boards [bytes]; the firmware and the mailbox are in it."""
MAILBOX_OFFSET = RAM_SIZE - (64 << 10)
"""Offset of the mailbox in the RAM [bytes]; the firmware uses the RAM below it."""
TOOLCHAINS = ("zig", "gcc")


def find_board(name: str) -> Board:
    """The board `name`.

    Raises:
        UnknownNameError: there is no such board.
    """
    if name not in BOARDS:
        raise UnknownNameError("board", name, tuple(BOARDS))
    return BOARDS[name]


def compiler(board: Board, toolchain: str) -> list[str]:
    """Command of the C compiler of `toolchain` with the flags for the processor of `board`."""
    if toolchain == "gcc":
        return ["arm-none-eabi-gcc", *board.gcc, "-mthumb", "-mfloat-abi=hard"]
    if toolchain != "zig":
        raise UnknownNameError("toolchain", toolchain, TOOLCHAINS)
    target = ["-target", "thumb-freestanding-eabihf", f"-mcpu={board.zig_cpu}"]
    no_runtime = ["-fno-sanitize=all", "-fno-unwind-tables", "-fno-asynchronous-unwind-tables"]
    return [sys.executable, "-m", "ziglang", "cc", *target, *no_runtime]
