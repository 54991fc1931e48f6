"""dualbrain robot conform: the laws of the driver contract, tried on a driver."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from dualbrain.cli.common.exit_codes import ExitCode


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

    from dualbrain.cli.common.console import print_result
    from dualbrain.control.gatekeeper.robot_link.simulated_driver import SimulatedDriver
    from dualbrain.drivers.catalogue import DRIVER_KINDS, find_driver_kind
    from dualbrain.drivers.commissioning.record import require_record
    from dualbrain.drivers.conformance.harness import DriverUnderTest
    from dualbrain.drivers.conformance.rules import RequirementStatus
    from dualbrain.drivers.conformance.rules import check_conformance as tried
    from dualbrain.robots.loader import load_robot
    from dualbrain.robots.site_config import read_site
    from dualbrain.safety.integration.site import site_robot

    robot = robot or next((kind.robot for kind in DRIVER_KINDS if kind.name == driver), "panda")
    kind = None if driver == "plant" else find_driver_kind(driver, robot)
    robot_model = load_robot(robot)
    robot_model = site_robot(robot_model, read_site(site)) if site else robot_model
    if kind is not None and kind.hardware:
        require_record(commissioned, robot_model, site, kind)

    def make() -> DriverUnderTest:
        return DriverUnderTest(
            kind.open(address, robot_model, None) if kind else SimulatedDriver(robot_model), robot_model
        )

    findings = tried(make)
    for finding in findings:
        print(
            f"{finding.requirement}: {finding.status.value}{f' ({finding.reason})' if finding.reason else ''}",
            file=sys.stderr,
        )
    if json:
        print_result(
            msgspec.json.encode(
                {finding.requirement: [finding.status.value, finding.reason] for finding in findings}
            ).decode()
        )
    broken = any(finding.status is RequirementStatus.VIOLATED for finding in findings)
    return ExitCode.FAILED_SAFELY if broken else ExitCode.SUCCESS
