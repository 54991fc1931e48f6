"""dualbrain robot export-c and dualbrain robot firmware: a robot as C tables, and firmware built with them."""

from __future__ import annotations

from pathlib import Path
from secrets import token_bytes

from dualbrain.cli.common.console import print_message
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import open_private
from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.errors import UsageError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import FilterConfig, operating_config
from dualbrain.safety.target.build import KEY_BYTES
from dualbrain.safety.target.robot_tables import render_robot_tables, robot_tables_hash


def export_c(*, robot: str = "panda", out: Path = Path("robot_tables.c")) -> int:
    """Write a robot as C source: the tables that the firmware links, and their hash.

    Parameters
    ----------
    robot
        A packaged robot, or a folder written by `dualbrain robot init`.
    out
        The file to write.
    """
    robot_model = load_robot(robot)
    config = operating_config(robot_model)
    write_atomically(out, render_robot_tables(robot_model, config).encode(), private=False)
    print_message(f"{out}: tables of {robot_model.name}, hash {robot_tables_hash(robot_model, config):016x}")
    return ExitCode.SUCCESS


def firmware(
    *,
    robot: str = "panda",
    board: str = "an500",
    toolchain: str = "zig",
    link: str = "uart",
    profile: str = "full",
    key: Path = Path("firmware.key"),
    out: Path = Path("firmware"),
) -> int:
    """Build the firmware of the safety layer for a robot and a board, and try it on the emulated board.

    The build runs with its own clock, as on a board: without a message of the host the watchdog brakes the arm after
    50 ms and switches the drive off after 150 ms. It is for emulated boards; no hardware was tested. For your own board
    write the functions of firmware/port/hal.h.

    Parameters
    ----------
    robot
        A packaged robot, or a folder written by `dualbrain robot init`.
    board
        an386 (Cortex-M4F), an500 (Cortex-M7) or an505 (Cortex-M33).
    toolchain
        zig (a package from PyPI) or gcc (Debian: gcc-arm-none-eabi).
    link
        uart, or mailbox: two rings in memory that the host shares.
    profile
        full, or small for little RAM: up to 12 obstacles, and the opening of the gripper counts as unknown.
    key
        File of the key that host and target share, 16 bytes; it is created, readable by its owner, if it is absent.
    out
        Folder for firmware.elf and the generated sources.
    """
    from dualbrain.safety.target.boards import find_board
    from dualbrain.safety.target.build import Firmware, build_firmware
    from dualbrain.safety.target.emulated_board import EmulatedBoard
    from dualbrain.safety.target.firmware_size import firmware_size
    from dualbrain.safety.target.session import TargetSession

    robot_model, found = load_robot(robot), find_board(board)
    config: FilterConfig = operating_config(robot_model)
    build = Firmware(board=found, key=_read_key(key), toolchain=toolchain, link=link, profile=profile, lockstep=False)
    elf = build_firmware(build, robot_model, config, out)
    size = firmware_size(elf)
    print_message(
        f"{elf}: {robot_model.name} for {found.name} ({found.core}), built with {toolchain}, profile {profile}: "
        f"flash {size.flash / 1000:.1f} kB, RAM {size.ram / 1000:.1f} kB without the stack"
    )
    with EmulatedBoard(found, elf, link=link) as emulated:
        described = TargetSession(emulated.link, build.key, robot_tables_hash(robot_model, config)).description
    print_message(
        f"The emulated board answers: robot tables {described.robot_hash:016x}, kernel {described.kernel_hash:016x}, "
        f"{described.joints} joints, at most {described.max_obstacles} obstacles"
    )
    return ExitCode.SUCCESS


def _read_key(path: Path) -> bytes:
    """The key in the file; a new one if there is no file."""
    if not path.exists():
        with open_private(path, "xb") as file:
            file.write(token_bytes(KEY_BYTES))
    key = read_regular_file(path, KEY_BYTES)
    if isinstance(key, FileRefusal):
        raise UsageError.stating(f"--key: {key.sentence}", fix=key.fix)
    if len(key) < KEY_BYTES:
        fix = "Name another --key, or remove the file: then a new key is written."
        raise UsageError("--key", got=f"{path} with {len(key)} bytes", allowed=f"a file of {KEY_BYTES} bytes", fix=fix)
    return key
