"""dualbrain robot commission: the checklist that hardware is opened with; written, checked, sealed."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

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
    """Answer for a real arm: tool, payload, mounting, table plane, emergency stop, limits inside the maker's.

    The first call writes a checklist to fill in at the arm. Once it is filled in, every answer is compared with the
    body, the site file and the maker's limits; if all will do, a record is sealed, which `dualbrain gatekeeper
    --commissioned` demands. Body, site file or driver changed afterwards: the record is worth nothing, answer again.
    Exit 0: sealed (or, with --check, still good); 1: something will not do, or is still to be filled in.

    Parameters
    ----------
    checklist
        The file with the answers (TOML).
    driver
        franka or ur.
    site
        The site file that holds where the arm stands.
    robot
        Which body; default: the driver's own.
    record
        Where the sealed record goes; default: beside the checklist, with .sealed.json at the end.
    check
        Change nothing; say whether the sealed record still fits body and site.
    """
    from dualbrain.drivers.catalogue import DRIVER_KINDS, find_driver_kind
    from dualbrain.drivers.commissioning.checklist import TEMPLATE, find_flaws, read_checklist
    from dualbrain.drivers.commissioning.record import make_record, require_record
    from dualbrain.robots.loader import load_robot
    from dualbrain.robots.site_config import read_site
    from dualbrain.safety.integration.site import site_robot

    robot = robot or next((kind.robot for kind in DRIVER_KINDS if kind.name == driver), "")
    kind, file = find_driver_kind(driver, robot), read_site(site)
    robot_model, seal_in = site_robot(load_robot(robot), file), record or checklist.with_suffix(".sealed.json")
    if check:
        answered = require_record(seal_in, robot_model, site, kind)
        print(f"{seal_in}: good; answered by {answered.answers.by}, {answered.answers.on}", file=sys.stderr)
        return ExitCode.SUCCESS
    if not checklist.exists():
        checklist.write_text(TEMPLATE.format(robot=robot, driver=driver), encoding="utf-8")
        print(f"{checklist}: fill it in at the arm, then run this again", file=sys.stderr)
        return ExitCode.FAILED_SAFELY
    answers = read_checklist(checklist)
    if found := find_flaws(answers, robot_model, file.site, kind):
        for flaw in found:
            print(f"{flaw.item}: got {flaw.got!r}, allowed: {flaw.allowed}", file=sys.stderr)
        return ExitCode.FAILED_SAFELY
    import msgspec

    whole = make_record(answers, robot_model, site, kind)
    seal_in.write_bytes(msgspec.json.format(msgspec.json.encode(whole), indent=2) + b"\n")
    print(f"sealed: {seal_in} ({whole.seal[:16]})", file=sys.stderr)
    return ExitCode.SUCCESS
