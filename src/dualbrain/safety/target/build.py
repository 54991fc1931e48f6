"""Build of the firmware: sources, robot tables and key become one ELF file, with either toolchain."""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from pathlib import Path

from dualbrain.core.paths import dualbrain_home
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder, tighten
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.target.boards import MAILBOX_OFFSET, RAM_SIZE, Board, compiler
from dualbrain.safety.target.robot_tables import render_robot_tables, robot_capacities

KERNEL_FLAGS = ("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fno-tree-slp-vectorize")
"""Flags of the kernel on every target, so that the results are the same bits (DBK_FLAGS of CMakeLists.txt)."""
PROFILES = {
    "full": ("-DDBK_LANES=1", "-DDBK_MAX_OBSTACLES=48"),
    "small": (
        "-DPROFILE_SMALL",
        "-DDBK_LANES=1",
        "-DDBK_MAX_OBSTACLES=12",
        "-DDBK_MAX_ROWS=128",
        "-DDBK_MAX_REVISITS=256",
    ),
}
"""Capacities without SIMD lanes; the results are the same bits. "small" has tables of the robot's own size."""
BUILD_TIMEOUT_S = 300.0
"""Longest time of one build [s]."""
KEY_BYTES = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class Firmware:
    """Contents of a build: `link` is "mailbox" or "uart"; in `lockstep` the time passes with the messages.

    `profile` is "full", or "small" for little RAM: up to 12 obstacles, and an opening of the gripper that counts as
    unknown. `extra` are further arguments of the compiler.
    """

    board: Board
    key: bytes
    toolchain: str = "zig"
    link: str = "mailbox"
    lockstep: bool = True
    profile: str = "full"
    optimisation: str = "-O2"
    extra: tuple[str, ...] = ()


def source_root() -> Path:
    """The folder with `kernel` and `firmware`: that of a checkout, or that of an installed package.

    Raises:
        ConfigurationError: neither has the sources.
    """
    here = Path(__file__).resolve()
    for folder in (here.parents[4], here.parent / "sources"):
        if (folder / "firmware/main.c").is_file():
            return folder
    raise ConfigurationError.stating(
        "The sources of the firmware are not installed.", fix="Run from a checkout of dualbrain."
    )


def build_firmware(firmware: Firmware, robot_model: RobotModel, config: FilterConfig, folder: Path) -> Path:
    """Build `firmware` for `robot_model` in `folder`; returns the path of the ELF file, which only its owner may read.

    Raises:
        UnknownNameError: there is no such profile.
        ConfigurationError: the toolchain is missing or failed, or the robot does not fit a target.
    """
    if firmware.profile not in PROFILES:
        raise UnknownNameError("profile", firmware.profile, tuple(PROFILES))
    if len(firmware.key) != KEY_BYTES:
        raise ConfigurationError("length of the key [bytes]", got=len(firmware.key), allowed=str(KEY_BYTES))
    create_private_folder(folder)
    tables, key, script = folder / "robot_tables.c", folder / "shared_key.c", folder / "link.ld"
    write_atomically(tables, render_robot_tables(robot_model, config).encode())
    write_atomically(key, _render_key(firmware).encode())
    write_atomically(script, _render_linker_script(firmware).encode())
    elf = folder / "firmware.elf"
    sizes = robot_capacities(robot_model, config) if firmware.profile == "small" else ()
    _compile([*_command(firmware, script), *sizes, str(tables), str(key), "-o", str(elf)], firmware.toolchain)
    tighten(elf)  # the key is in it
    return elf


def _render_linker_script(firmware: Firmware) -> str:
    text = (source_root() / "firmware/boards/link.ld.in").read_text()
    size = MAILBOX_OFFSET if firmware.link == "mailbox" else RAM_SIZE
    addresses = {"CODE_ORIGIN": firmware.board.code_origin, "RAM_ORIGIN": firmware.board.ram_origin, "RAM_SIZE": size}
    for name, value in addresses.items():
        text = text.replace(f"@{name}@", f"{value:#x}")
    return text


def _command(firmware: Firmware, script: Path) -> list[str]:
    root, board = source_root(), firmware.board
    kernel, own = root / "kernel", root / "firmware"
    folders = (kernel / "src", kernel / "supervisor", own)
    sources = sorted(str(path) for folder in folders for path in folder.rglob("*.c"))
    defines = {
        "UART_BASE": f"{board.uart_base:#x}u",
        "UART_RX_IRQ": str(board.uart_rx_irq),
        "DRIVE_OUTPUT_ADDRESS": f"{board.drive_output:#x}u",
        "CLOCK_HZ": f"{board.clock_hz}u",
        "WATCHDOG_BASE": f"{board.watchdog_base:#x}u",
        "MAILBOX_BASE": f"{board.ram_origin + MAILBOX_OFFSET:#x}u",
    }
    return [
        *compiler(board, firmware.toolchain),
        "-std=c99",
        firmware.optimisation,
        *KERNEL_FLAGS,
        *PROFILES[firmware.profile],
        "-ffreestanding",
        "-fno-builtin",
        "-ffunction-sections",
        "-fdata-sections",
        "-nostdlib",
        f"-I{kernel / 'include'}",
        f"-I{kernel / 'src'}",
        f"-I{own}",
        *(f"-D{name}={value}" for name, value in defines.items()),
        *(["-DLINK_MAILBOX"] if firmware.link == "mailbox" else []),
        *(["-DLOCKSTEP"] if firmware.lockstep else []),
        "-T",
        str(script),
        "-Wl,--gc-sections",
        *sources,
        *firmware.extra,
    ]


def _render_key(firmware: Firmware) -> str:
    low, high = (int.from_bytes(firmware.key[i : i + 8], "little") for i in (0, 8))
    name = ", ".join(f"'{letter}'" for letter in firmware.board.name)
    return (
        '#include "executive/executive.h"\n\n'
        f"const siphash_key shared_key = {{UINT64_C(0x{low:016x}), UINT64_C(0x{high:016x})}};\n"
        f"const char board_name[15] = {{{name}}};\n"
    )


def _compile(command: list[str], toolchain: str) -> None:
    cache = str(dualbrain_home() / "cache/zig")
    caches = {"ZIG_LOCAL_CACHE_DIR": cache, "ZIG_GLOBAL_CACHE_DIR": cache}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=BUILD_TIMEOUT_S, env=caches | os.environ
        )
    except FileNotFoundError:
        fix = "Install it (Debian: gcc-arm-none-eabi), or use the toolchain zig (pip install ziglang)."
        raise ConfigurationError.stating(f"The compiler {command[0]} is not installed.", fix=fix) from None
    if done.returncode != 0:
        missing = "No module named ziglang" in done.stderr
        fix = "pip install ziglang" if missing else f"The compiler reported:\n{done.stderr[-2000:]}"
        raise ConfigurationError.stating(f"The firmware could not be built with {toolchain}.", fix=fix)
