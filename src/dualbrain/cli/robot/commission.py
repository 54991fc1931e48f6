"""dualbrain robot commission: the commissioning checklist of a real arm."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dualbrain.cli.common.console import print_message
from dualbrain.cli.common.exit_codes import ExitCode


def commission(
    checklist: Path,
    /,
    *,
    driver: str,
    site: Path,
    robot: str = "",
    record: Path | None = None,
    check: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Fill in and sign the commissioning checklist of a real arm.

    The checklist covers tool, payload, mounting, table plane, emergency stop, and limits within those of the
    manufacturer. The first call writes a checklist to fill in at the arm. The second call compares every answer with
    the robot model, the site file and the manufacturer's limits, and writes a record with a checksum if all agree;
    `dualbrain gatekeeper --commissioned` requires this record. A change of robot model, site file or driver invalidates
    it.
    Exit code 0: written (or, with --check, valid); 1: incomplete or inconsistent answers.

    Parameters
    ----------
    checklist
        File with the answers (TOML).
    driver
        franka or ur.
    site
        Site file with the mounting of the arm.
    robot
        The robot. Default: the robot of the driver.
    record
        Signed record to write. Default: beside the checklist, with the suffix .sealed.json.
    check
        Only check whether the record is valid for this robot model and site file.
    """
    from dualbrain.core.storage.atomic_files import atomic_file
    from dualbrain.drivers.catalogue import DRIVER_KINDS, find_driver_kind
    from dualbrain.drivers.commissioning.checklist import TEMPLATE, find_flaws, read_checklist
    from dualbrain.drivers.commissioning.record import make_record, require_record
    from dualbrain.robots.loader import load_robot
    from dualbrain.robots.site_config import read_site
    from dualbrain.safety.integration.site import site_robot

    robot = robot or next((kind.robot for kind in DRIVER_KINDS if kind.name == driver), "")
    kind, file = find_driver_kind(driver, robot), read_site(site)
    robot_model, record_file = site_robot(load_robot(robot), file), record or checklist.with_suffix(".sealed.json")
    if check:
        answered = require_record(record_file, robot_model, site, kind)
        print_message(f"{record_file}: valid; answered by {answered.answers.by}, {answered.answers.on}")
        return ExitCode.SUCCESS
    if not checklist.exists():
        with atomic_file(checklist) as temporary:
            temporary.write_text(TEMPLATE.format(robot=robot, driver=driver), encoding="utf-8")
        print_message(f"{checklist}: written. Fill it in at the arm, then run this command again.")
        return ExitCode.FAILED_SAFELY
    answers = read_checklist(checklist)
    if found := find_flaws(answers, robot_model, file.site, kind):
        for flaw in found:
            print_message(f"{flaw.item}: got {flaw.got!r}, allowed: {flaw.allowed}")
        return ExitCode.FAILED_SAFELY
    import msgspec

    whole = make_record(answers, robot_model, site, kind)
    with atomic_file(record_file) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(whole), indent=2) + b"\n")
    print_message(f"commissioned: {record_file} ({whole.seal[:16]})")
    return ExitCode.SUCCESS
