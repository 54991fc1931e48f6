"""dualbrain robot conform: the laws of the driver contract, tried on a driver."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dualbrain.cli.common.exit_codes import Exit


def conform(
    *,
    driver: str = "plant",
    robot: str = "",
    address: str = "",
    site: Path | None = None,
    commissioned: Path | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Try every law of the driver contract on a driver. A real arm moves: every joint by some degrees, and fast.

    Exit 0 if no law is broken. What could not be tried is said; it proves nothing.

    Parameters
    ----------
    driver
        plant, fake_franka, fake_ur; franka or ur with an address and a commissioning record.
    robot
        Which body; default: the driver's own, panda for the plant.
    address
        Where the arm's controller answers.
    site
        Site file (TOML) that narrows the body.
    commissioned
        The record that `dualbrain robot commission` has sealed; hardware is not opened without.
    json
        Print the findings as one JSON object on stdout.
    """
    import msgspec

    from dualbrain.cli.common.console import answer
    from dualbrain.control.gatekeeper.robot_link.simulated_driver import PlantDriver
    from dualbrain.drivers.catalogue import KINDS, driver_kind
    from dualbrain.drivers.commissioning.record import demand
    from dualbrain.drivers.conformance.harness import Subject
    from dualbrain.drivers.conformance.rules import Verdict
    from dualbrain.drivers.conformance.rules import conform as tried
    from dualbrain.robots.loader import load_body
    from dualbrain.robots.site_config import read_site
    from dualbrain.safety.integration.site import site_body

    robot = robot or next((kind.robot for kind in KINDS if kind.name == driver), "panda")
    kind = None if driver == "plant" else driver_kind(driver, robot)
    body = load_body(robot)
    body = site_body(body, read_site(site)) if site else body
    if kind is not None and kind.hardware:
        demand(commissioned, body, site, kind)

    def make() -> Subject:
        return Subject(kind.open(address, body, None) if kind else PlantDriver(body), body)

    findings = tried(make)
    for finding in findings:
        print(f"{finding.law}: {finding.verdict.value}{f' ({finding.why})' if finding.why else ''}", file=sys.stderr)
    if json:
        answer(
            msgspec.json.encode({finding.law: [finding.verdict.value, finding.why] for finding in findings}).decode()
        )
    broken = any(finding.verdict is Verdict.BROKEN for finding in findings)
    return Exit.FAILED_SAFELY if broken else Exit.SUCCESS
