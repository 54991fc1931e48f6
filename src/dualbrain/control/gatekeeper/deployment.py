"""Where a gatekeeper is put to work: the body as the site narrows it, what stands there, who may ask for what."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.capability import Capability, full
from dualbrain.control.gatekeeper.config import Plan
from dualbrain.control.gatekeeper.robot_link.driver_process import DriverSettings, surveyed
from dualbrain.control.gatekeeper.robot_link.simulated_robot import Settings
from dualbrain.drivers.catalogue import DriverKind, driver_kind
from dualbrain.drivers.commissioning.record import demand
from dualbrain.robots.loader import load_body
from dualbrain.robots.model import Body
from dualbrain.robots.site_config import read_site
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.integration.site import site_body, site_grants, site_obstacles
from dualbrain.safety.supervisor.timing import Timing, simulated
from dualbrain.skills.registry import registry_of


@dataclass(frozen=True, slots=True)
class Place:
    """What a plan comes to, checked before anything is connected. Without a `kind` the robot is simulated."""

    body: Body
    standing: tuple[Obstacle, ...]
    capability: Capability
    kind: DriverKind | None

    @classmethod
    def of(cls, plan: Plan) -> Place:
        """The place of `plan`.

        Raises:
            SiteError: the site file does not fit the body.
            NotCommissioned: the driver is one for hardware, and nobody has answered for this body at this site.
            UnknownName, InvalidSetup: there is no such robot or driver, or they do not go together.
        """
        path = Path(plan.site) if plan.site else None
        site = read_site(path) if path else None
        whole = load_body(plan.robot)
        body = site_body(whole, site) if site else whole
        kind = driver_kind(plan.driver, body.name) if plan.driver else None
        if kind is not None and kind.hardware:
            demand(Path(plan.commissioned) if plan.commissioned else None, body, path, kind)
        if kind is not None:
            surveyed(plan.scene)
        capability = full(registry_of(body))
        granted = site_grants(site, capability.skills) if site else None
        if granted is not None:
            capability = capability.narrowed(Capability(granted.get(PLANNER, frozenset())))
        if plan.capability is not None:
            capability = capability.narrowed(plan.capability)
        return cls(body, site_obstacles(body, site) if site else (), capability, kind)

    @property
    def timing(self) -> Timing:
        """How punctual the robot's bus is."""
        return self.kind.timing if self.kind else simulated(self.body.period)

    @property
    def config(self) -> FilterConfig | None:
        """The filter's dials: an arm that refuses a jerk has its limits in the filter."""
        return FilterConfig(jerk_limits=True) if self.kind and self.kind.jerk_limits else None

    def settings(self, plan: Plan) -> Settings | DriverSettings:
        """What the robot's process needs to know."""
        if self.kind is not None:
            return DriverSettings(self.kind.name, plan.address, self.body, plan.scene)
        body = self.body if plan.site else None
        return Settings(plan.robot, plan.scene, plan.seed, plan.goal, plan.report, body)

    def about(self, plan: Plan) -> dict[str, Any]:
        """What a recording says of itself; with a site, all that replay needs of it."""
        about: dict[str, Any] = {"robot": plan.robot, "guard": True, "instruction": plan.instruction}
        if plan.site:
            about |= {"body": self.body, "standing": self.standing}
        return about
