"""Firmware that is built once in a worker process."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.target.build import Firmware, build_firmware

_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []
"""Folders of the firmware, removed when the process ends."""


@cache
def built_firmware(robot: str, firmware: Firmware) -> tuple[Firmware, Path]:
    """The firmware of one robot, and its ELF file."""
    _FOLDERS.append(folder := tempfile.TemporaryDirectory(prefix="dualbrain-firmware-"))
    model = load_robot(robot)
    return firmware, build_firmware(firmware, model, operating_config(model), Path(folder.name))
