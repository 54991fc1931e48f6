"""dualbrain robot conform: test a driver against the driver contract."""

from __future__ import annotations

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
    realtime: str = "enforce",
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Test every requirement of the driver contract on a driver. A real arm moves every joint by some degrees, fast.

    Exit code 0 if no requirement is violated. Requirements that could not be tested are listed; they are not proven.

    Parameters
    ----------
    driver
        plant (the simulator), fake_franka, fake_ur; franka or ur with an address and a commissioning record.
    robot
        The robot. Default: the robot of the driver, panda for the plant.
    address
        Network address of the arm's controller.
    site
        Site file (TOML) that restricts the robot model; its planes and boxes must be clear of the home posture.
    commissioned
        Commissioning record, written by `dualbrain robot commission`; required for hardware.
    realtime
        enforce, or ignore to connect from a kernel without PREEMPT_RT (driver franka; for simulators and tests).
    json
        Print the findings as one JSON object on stdout.
    """
    import msgspec

    from dualbrain.cli.common.console import print_message, print_result
    from dualbrain.control.gatekeeper.robot_link.simulated_driver import SimulatedDriver
    from dualbrain.drivers.catalogue import DRIVER_KINDS, find_driver_kind
    from dualbrain.drivers.commissioning.record import require_record
    from dualbrain.drivers.conformance.harness import DriverUnderTest
    from dualbrain.drivers.conformance.rules import RequirementStatus, check_conformance, make_requirements
    from dualbrain.robots.loader import load_robot
    from dualbrain.robots.site_config import read_site
    from dualbrain.safety.integration.site import site_obstacles, site_robot

    robot = robot or next((kind.robot for kind in DRIVER_KINDS if kind.name == driver), "panda")
    kind = None if driver == "plant" else find_driver_kind(driver, robot)
    robot_model = load_robot(robot)
    file = read_site(site) if site else None
    robot_model = site_robot(robot_model, file) if file else robot_model
    requirements = make_requirements(site_obstacles(robot_model, file) if file else ())
    if kind is not None and kind.hardware:
        require_record(commissioned, robot_model, site, kind)

    def make() -> DriverUnderTest:
        return DriverUnderTest(
            kind.open(address, robot_model, None, realtime=kind.check_realtime(realtime))
            if kind
            else SimulatedDriver(robot_model),
            robot_model,
        )

    findings = check_conformance(make, requirements)
    descriptions = {one.name: one.description for one in requirements}
    for finding in findings:
        reason = f" ({finding.reason})" if finding.reason else ""
        print_message(f"{finding.status.value}: {descriptions[finding.requirement]}{reason}")
    if json:
        print_result(
            msgspec.json.encode(
                {finding.requirement: [finding.status.value, finding.reason] for finding in findings}
            ).decode()
        )
    violated = any(finding.status is RequirementStatus.VIOLATED for finding in findings)
    return ExitCode.FAILED_SAFELY if violated else ExitCode.SUCCESS
