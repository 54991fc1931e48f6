"""Power and force limiting in the terms of ISO/TS 15066: the speed at which a contact stays below the limits of a body.

The module computes the formula. It certifies nothing: a risk assessment decides which body regions can be touched, and
a measurement at the robot decides whether a limit is kept.

A contact is modelled as an inelastic impact between the robot and a part of the body, a mass m_H behind a spring k.
With the reduced mass μ = 1/(1/m_H + 1/m_R) and the relative speed v, the spring takes up the transfer energy

    E = μ v²/2 = F²/(2 k),    so that    v_max = F_max / √(μ k) = √(2 E_max / μ).

The effective mass of the robot is m_R = M/2 + m_L with the mass M of its moving parts and the load m_L.
"""

from __future__ import annotations

from math import sqrt

import msgspec

from dualbrain.core.geometry.validation import check_length, check_number, check_positive
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.safety.cbf.config import MAX_CARTESIAN_SPEED, MIN_CARTESIAN_SPEED

MAX_MASS = 1e4
"""Largest mass [kg]."""
MAX_STIFFNESS = 1e9
"""Largest stiffness [N/m]."""
MAX_FORCE = 1e5
"""Largest force [N]."""


class BodyRegion(msgspec.Struct, frozen=True, kw_only=True):
    """A body region: effective `mass` [kg], `stiffness` [N/m], and the largest `force` [N] of a quasi-static contact.

    `transient` is the factor by which the force of a transient contact may be larger; None if no transient contact is
    permissible. `source` states where the numbers are from.

    Raises `GeometryError` for a number that is not above 0, or a factor below 1.
    """

    mass: float
    stiffness: float
    force: float
    transient: float | None
    source: str

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_positive("BodyRegion.mass [kg]", self.mass, MAX_MASS)
        check_positive("BodyRegion.stiffness [N/m]", self.stiffness, MAX_STIFFNESS)
        check_positive("BodyRegion.force [N]", self.force, MAX_FORCE)
        if self.transient is not None:
            check_number("BodyRegion.transient", self.transient, 1.0, 10.0)


TABLE_SOURCE = "ISO/TS 15066:2016, tables A.2 and A.3, as cited in the literature; compare with your edition"


def _region(mass: float, stiffness: float, force: float, transient: float | None) -> BodyRegion:
    return BodyRegion(mass=mass, stiffness=stiffness, force=force, transient=transient, source=TABLE_SOURCE)


BODY_REGIONS: dict[str, BodyRegion] = {
    "skull": _region(4.4, 150e3, 130.0, None),
    "face": _region(4.4, 75e3, 65.0, None),
    "neck": _region(1.2, 50e3, 150.0, 2.0),
    "back": _region(40.0, 35e3, 210.0, 2.0),
    "chest": _region(40.0, 25e3, 140.0, 2.0),
    "abdomen": _region(40.0, 10e3, 110.0, 2.0),
    "pelvis": _region(40.0, 25e3, 180.0, 2.0),
    "upper_arm": _region(3.0, 30e3, 150.0, 2.0),
    "lower_arm": _region(2.0, 40e3, 160.0, 2.0),
    "hand": _region(0.6, 75e3, 140.0, 2.0),
    "thigh": _region(75.0, 50e3, 220.0, 2.0),
    "lower_leg": _region(75.0, 60e3, 130.0, 2.0),
}
"""Body regions by name; "back" includes the shoulders, "upper_arm" the elbow, "lower_arm" the wrist, "hand" the
fingers, "thigh" the knee. A site can state its own numbers with their source."""


def body_region(name: str) -> BodyRegion:
    """The body region `name` of the table; raises `UnknownNameError`."""
    if name not in BODY_REGIONS:
        raise UnknownNameError("body region", name, tuple(BODY_REGIONS))
    return BODY_REGIONS[name]


def effective_mass(moving_mass: float, load: float = 0.0) -> float:
    """Effective mass of the robot m_R = M/2 + m_L [kg], from the mass M of its moving parts and the load m_L [kg].

    Raises:
        GeometryError: a mass is not a number in its range.
    """
    moving = check_positive("moving mass of the robot [kg]", moving_mass, MAX_MASS)
    return 0.5 * moving + check_length("load [kg]", load, MAX_MASS)


def reduced_mass(human: float, robot: float) -> float:
    """Reduced mass μ = 1/(1/m_H + 1/m_R) [kg]."""
    return 1.0 / (1.0 / human + 1.0 / robot)


def transfer_energy(region: BodyRegion, *, pressure: float | None = None, area: float | None = None) -> float:
    """Largest transfer energy of a transient contact E = F²/(2 k) [J].

    F is the largest transient force of the region, or `pressure` [Pa] × `area` [m²] if this is smaller.

    Raises:
        ConfigurationError: the region permits no transient contact, or only one of pressure and area is stated.
    """
    return 0.5 * _largest_force(region, pressure, area) ** 2 / region.stiffness


def contact_speed(
    region: BodyRegion, robot_mass: float, *, pressure: float | None = None, area: float | None = None
) -> float:
    """Largest relative speed of a transient contact v = F / √(μ k) [m/s], at most `MAX_CARTESIAN_SPEED`.

    `robot_mass` [kg] is the effective mass of the robot, `effective_mass` or a reflected mass in the direction of the
    motion. `pressure` [Pa], the largest transient pressure, and `area` [m²] of the contact limit the force further.

    Raises:
        ConfigurationError: the region permits no transient contact, only one of pressure and area is stated, or the
            speed is below what the filter resolves.
        GeometryError: the mass is not above 0.
    """
    mass = reduced_mass(region.mass, check_positive("effective mass of the robot [kg]", robot_mass, MAX_MASS))
    speed = _largest_force(region, pressure, area) / sqrt(mass * region.stiffness)
    if speed < MIN_CARTESIAN_SPEED:
        raise ConfigurationError.stating(
            f"The contact speed of {speed:.2g} m/s is below {MIN_CARTESIAN_SPEED:g} m/s, the smallest speed limit of "
            "the filter.",
            fix="Use speed and separation monitoring for this body region.",
        )
    return min(speed, MAX_CARTESIAN_SPEED)


def _largest_force(region: BodyRegion, pressure: float | None, area: float | None) -> float:
    """The largest force of a transient contact [N]."""
    if region.transient is None:
        raise ConfigurationError.stating(
            "This body region permits no transient contact.",
            fix="Use speed and separation monitoring for a person whose head can be reached.",
        )
    force = region.transient * region.force
    if (pressure is None) != (area is None):
        raise ConfigurationError.stating(
            "A limit of the pressure needs the largest transient pressure and the area of the contact.",
            fix="State both `pressure` [Pa] and `area` [m²], or neither.",
        )
    if pressure is None or area is None:
        return force
    return min(force, check_positive("pressure [Pa]", pressure, 1e9) * check_positive("area [m²]", area, 10.0))
