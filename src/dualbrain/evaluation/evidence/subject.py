"""The subject of the evidence: a robot model at a site, with the inputs that the user gives."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dualbrain.drivers.catalogue import find_driver_kind
from dualbrain.drivers.commissioning.record import require_record
from dualbrain.errors import UsageError
from dualbrain.grounding.envelope.object_limits import site_object_limits
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.robots.site_config import SiteFile, read_site
from dualbrain.safety.integration.site import site_obstacles, site_persons, site_robot, site_skill_grants
from dualbrain.skills.registry import skill_registry


@dataclass(frozen=True, slots=True, kw_only=True)
class EvidenceInputs:
    """Robot name or path, site file, test report, folders of runs, and commissioning record with its driver."""

    robot: str
    site: Path | None = None
    test_report: Path | None = None
    runs: tuple[Path, ...] = ()
    commissioned: Path | None = None
    driver: str = ""


@dataclass(frozen=True, slots=True)
class Subject:
    """The robot model after narrowing by the site, the site file, and a sentence on the commissioning record."""

    robot_model: RobotModel
    site: SiteFile | None
    record: str


def load_subject(inputs: EvidenceInputs) -> Subject:
    """The robot at its site; every file is checked.

    Raises:
        ConfigurationError: Robot model, site file or commissioning record do not exist, are invalid, or do not fit.
        UsageError: A commissioning record was given without driver or site file, or a driver without a record.
    """
    robot_model = load_robot(inputs.robot)
    site = None if inputs.site is None else read_site(inputs.site)
    if site is not None:
        robot_model = site_robot(robot_model, site)
        site_obstacles(robot_model, site)
        site_persons(site)
        registry = skill_registry(robot_model)
        site_object_limits(site, registry)
        site_skill_grants(site, frozenset(registry.by_name))
    return Subject(robot_model, site, _describe_record(inputs, robot_model))


def _describe_record(inputs: EvidenceInputs, robot_model: RobotModel) -> str:
    if inputs.commissioned is None:
        if inputs.driver:
            raise UsageError.stating("--driver needs --commissioned.", fix="Name the commissioning record as well.")
        return "no commissioning record was given"
    if not inputs.driver or inputs.site is None:
        raise UsageError.stating("--commissioned needs --driver and --site.", fix="Give both: the record names them.")
    kind = find_driver_kind(inputs.driver, robot_model.name)
    record = require_record(inputs.commissioned, robot_model, inputs.site, kind)
    return f"valid commissioning record for {record.driver}, answered by {record.answers.by}, {record.answers.on}"
