"""The deployment of a gatekeeper: the robot with the site's limits, its fixed obstacles, capability and driver."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.capability import Capability, full_capability
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.robot_link.driver_process import DriverSettings, surveyed_scene
from dualbrain.control.gatekeeper.robot_link.simulated_robot import SimulatedRobotSettings
from dualbrain.drivers.catalogue import DriverKind, find_driver_kind
from dualbrain.drivers.commissioning.record import require_record
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.envelope.object_limits import site_object_limits
from dualbrain.records import ObjectLimits
from dualbrain.robots.loader import BUILTIN_ROBOTS, load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.robots.site_config import read_site
from dualbrain.safety.cbf.config import FilterConfig, operating_config
from dualbrain.safety.cbf.obstacles import Obstacle, PersonLimits
from dualbrain.safety.integration.site import site_obstacles, site_persons, site_robot, site_skill_grants
from dualbrain.safety.supervisor.timing import Timing, simulated_timing
from dualbrain.skills.registry import skill_registry


@dataclass(frozen=True, slots=True, kw_only=True)
class Deployment:
    """A checked configuration, before anything is connected. Without a `driver` the robot is simulated.

    With `control_thread` a thread in C moves the joints.
    """

    robot_model: RobotModel
    fixed_obstacles: tuple[Obstacle, ...]
    capability: Capability
    driver: DriverKind | None
    control_thread: bool = False
    persons: PersonLimits | None = None
    object_limits: Mapping[str, ObjectLimits] = field(default_factory=dict[str, ObjectLimits])

    @classmethod
    def from_config(cls, config: GatekeeperConfig) -> Deployment:
        """The deployment of `config`.

        Raises:
            SiteError: the site file does not fit the robot.
            NotCommissionedError: the driver moves hardware, and there is no valid commissioning record for this robot
                at this site.
            UnknownNameError: there is no such robot or driver.
            ConfigurationError: the driver or a control thread does not fit the robot, or an object of the scene moves.
        """
        path = Path(config.site) if config.site else None
        site = read_site(path) if path else None
        full_model = load_robot(config.robot)
        robot_model = site_robot(full_model, site) if site else full_model
        if config.control_thread and robot_model.is_mobile:
            raise ConfigurationError.stating(
                f"The control thread needs a fixed base, and {robot_model.name} has a mobile one.",
                fix="Leave `--control-thread` out.",
            )
        kind = find_driver_kind(config.driver, robot_model.name) if config.driver else None
        if kind is not None and kind.hardware:
            require_record(Path(config.commissioned) if config.commissioned else None, robot_model, path, kind)
        if kind is not None:
            surveyed_scene(config.scene)
            kind.check_realtime(config.realtime)
        capability = full_capability(skill_registry(robot_model))
        granted = site_skill_grants(site, capability.skills) if site else None
        if granted is not None:
            capability = capability.intersect(Capability(granted.get(PLANNER, frozenset())))
        if config.capability is not None:
            capability = capability.intersect(config.capability)
        persons = site_persons(site) if site else None
        return cls(
            robot_model=robot_model,
            fixed_obstacles=site_obstacles(robot_model, site) if site else (),
            capability=capability,
            driver=kind,
            control_thread=kind is not None if config.control_thread is None else config.control_thread,
            persons=persons,
            object_limits=site_object_limits(site, skill_registry(robot_model)) if site else {},
        )

    @property
    def timing(self) -> Timing:
        """Limits on the delays of the robot's interface."""
        return self.driver.timing if self.driver else simulated_timing(self.robot_model.period)

    @property
    def filter_config(self) -> FilterConfig:
        """Settings of the filter; for an arm that refuses high jerk, the filter enforces its jerk limits."""
        return operating_config(self.robot_model, jerk_limits=bool(self.driver and self.driver.jerk_limits))

    def process_settings(self, config: GatekeeperConfig) -> SimulatedRobotSettings | DriverSettings:
        """Settings of the robot process."""
        if self.driver is not None:
            realtime = self.driver.check_realtime(config.realtime)
            return DriverSettings(
                driver=self.driver.name,
                address=config.address,
                robot_model=self.robot_model,
                scene=config.scene,
                realtime=realtime,
            )
        robot_model = self.robot_model if config.site else None
        return SimulatedRobotSettings(
            robot=config.robot,
            scene=config.scene,
            seed=config.seed,
            goal=config.goal,
            instruction=config.instruction,
            report=config.report,
            robot_model=robot_model,
            start=config.start,
        )

    def recording_metadata(self, config: GatekeeperConfig) -> dict[str, Any]:
        """Metadata of the recording; with a site file, everything about the site that a replay needs."""
        about: dict[str, Any] = {"robot": config.robot, "guard": True, "instruction": config.instruction}
        about["cartesian_speed"] = self.filter_config.cartesian_speed
        if config.site or config.robot not in BUILTIN_ROBOTS:  # a recording names known robots only
            about |= {"body": self.robot_model, "standing": self.fixed_obstacles}
        return about
