"""Commissioning checklist: measurements and tests at the real arm, and the check of all answers.

The checklist is a TOML file of five tables. Each answer is compared with the robot model, the site file and the
manufacturer's limits. An unacceptable answer is a `ChecklistFlaw`, never an exception.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.core.untrusted.toml_document import TomlFault, parse_toml
from dualbrain.drivers.catalogue import DriverKind
from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel, Vector
from dualbrain.robots.site_config import PlaneEntry, Site

Array = NDArray[np.float64]

MAX_VENDOR_LIMIT_SHARE = 0.98
"""Maximum share of the manufacturer's limit for our limits of velocity, acceleration and jerk."""
RANGE_MARGIN = 0.01
"""Minimum distance [rad] of the ends of our joint ranges from those of the manufacturer."""
MAX_POINT_ABOVE_PLANE, MAX_POINT_BELOW_PLANE = 0.002, 0.010
"""Maximum distance [m] of a touched table point above and below the plane in the site file."""
MAX_LEAN = 0.01
"""Maximum inclination of the base [rad]."""
MAX_ESTOP_STOP_TIME = 0.5
"""Maximum time [s] from the emergency stop until the arm is at rest."""
TIP_TOLERANCE = 0.002
"""Maximum distance [m] between the tool tip in the checklist and in the site file."""
MAX_FILE_BYTES = 2**16


class ChecklistEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of the tables: an unknown field is an error."""


class ToolAnswer(ChecklistEntry, frozen=True):
    """[tool]: name and mass [kg] of the tool, its tip in the tool frame of the robot model [m].

    `set_at_controller` confirms that mass and centre are also set at the controller of the arm.
    """

    name: str
    mass: float
    tip: Vector = (0.0, 0.0, 0.0)
    set_at_controller: bool = False


class PayloadAnswer(ChecklistEntry, frozen=True):
    """[payload]: mass of the heaviest object that will be carried [kg]."""

    mass: float


class MountingAnswer(ChecklistEntry, frozen=True):
    """[mounting]: the surface on which the base is mounted, and its inclination [rad], measured with a level."""

    on: Literal["floor", "wall", "ceiling"]
    lean: float
    bolted: bool = False


class TableAnswer(ChecklistEntry, frozen=True):
    """[table]: at least three points of the table that the tool tip has touched [m, base frame]."""

    points: tuple[Vector, ...]


class EstopAnswer(ChecklistEntry, frozen=True):
    """[estop]: test of the emergency stop while a joint moved at `speed` [rad/s]; the arm stopped within `rest` [s].

    `latched` confirms that releasing the button moved nothing, `reset_in_two_steps` that motion needed a reset and a
    resume.
    """

    speed: float
    rest: float
    latched: bool = False
    reset_in_two_steps: bool = False


class Checklist(ChecklistEntry, frozen=True, kw_only=True):
    """The whole checklist: the person who answered (`by`), the date (`on`), and the answers."""

    by: str
    on: str
    tool: ToolAnswer
    payload: PayloadAnswer
    mounting: MountingAnswer
    table: TableAnswer
    estop: EstopAnswer


@dataclass(frozen=True, slots=True)
class ChecklistFlaw:
    """An unacceptable answer: the entry, the answer, and the allowed values."""

    item: str
    got: object
    allowed: str


TEMPLATE = """# Commissioning of {robot} with driver {driver}. Measure and test every entry at the arm, in SI units.
# Then run `dualbrain robot commission` again. Entries that are left empty are refused.
by = ""                     # your name
on = ""                     # the date

[tool]
name = ""                   # the tool on the flange
mass = nan                  # its mass [kg]
tip = [0.0, 0.0, 0.0]       # its tip in the tool frame of the robot model [m], as in the site file
set_at_controller = false   # true: mass and centre are set at the controller of the arm

[payload]
mass = nan                  # mass of the heaviest object that will be carried [kg]

[mounting]
on = "floor"                # floor, wall or ceiling
lean = nan                  # inclination of the base, measured with a level [rad]
bolted = false              # true: the base does not move when pushed

[table]
points = []                 # three points or more that the tool tip has touched [m, base frame]

[estop]
speed = nan                 # speed of a joint when the button was pressed [rad/s]
rest = nan                  # time until the arm was at rest [s]
latched = false             # true: releasing the button moved nothing
reset_in_two_steps = false  # true: the arm moved again only after release, reset and resume
"""


def read_checklist(path: Path) -> Checklist:
    """The checklist in the file `path`.

    Raises:
        ConfigurationError: The file does not exist, is too large, is not TOML, or lacks an entry.
    """
    content = read_regular_file(path, MAX_FILE_BYTES)
    if isinstance(content, FileRefusal):
        problem = f"There is no checklist at {path}." if content.kind == "missing" else content.sentence
        raise ConfigurationError.stating(problem, fix=f"Give a TOML file of at most {MAX_FILE_BYTES} bytes.")
    tables = parse_toml(content)
    if isinstance(tables, TomlFault):
        raise _unreadable(path, tables.problem)
    try:
        return msgspec.convert(tables, Checklist)
    except msgspec.ValidationError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, reason: object) -> ConfigurationError:
    sentence = f"The checklist {path} cannot be read: {reason}."
    return ConfigurationError.stating(sentence, fix="Fill in every table of the template.")


def find_flaws(answers: Checklist, robot_model: RobotModel, site: Site, kind: DriverKind) -> tuple[ChecklistFlaw, ...]:
    """All unacceptable answers; `robot_model` is the model after narrowing by the site file."""
    found = [
        *_check_signature(answers),
        *_check_tool(answers, site, kind),
        *_check_mounting(answers.mounting),
        *_check_table(answers, site),
    ]
    return (*found, *_check_estop(answers.estop), *find_limit_flaws(robot_model, kind))


def find_limit_flaws(robot_model: RobotModel, kind: DriverKind) -> tuple[ChecklistFlaw, ...]:
    """Limits of `robot_model` that are not strictly inside those of the manufacturer: ours must be reached first."""
    limits, found = kind.limits, list[ChecklistFlaw]()
    max_velocity = _vendor_velocity_limits(robot_model, kind)
    for index, joint in enumerate(robot_model.joints):
        low, high = (float(value) for value in limits.position_range[index])
        if not (joint.lower.value >= low + RANGE_MARGIN and joint.upper.value <= high - RANGE_MARGIN):
            got = (joint.lower.value, joint.upper.value)
            found.append(
                ChecklistFlaw(
                    f"range of {joint.name} [rad]", got, f"within {low + RANGE_MARGIN:.4f} … {high - RANGE_MARGIN:.4f}"
                )
            )
        limit_pairs = [("velocity", joint.velocity.value, float(max_velocity[index]))]
        if limits.acceleration is not None:
            limit_pairs.append(("acceleration", joint.acceleration.value, float(limits.acceleration[index])))
        if limits.jerk is not None:
            limit_pairs.append(("jerk", joint.jerk.value if joint.jerk else np.inf, float(limits.jerk[index])))
        for name, ours, vendor in limit_pairs:
            if not ours <= MAX_VENDOR_LIMIT_SHARE * vendor:
                allowed = f"at most {MAX_VENDOR_LIMIT_SHARE * vendor:.4g}, set in the site file"
                found.append(ChecklistFlaw(f"{name} of {joint.name}", ours, allowed))
    return tuple(found)


def _vendor_velocity_limits(robot_model: RobotModel, kind: DriverKind) -> Array:
    """Velocity (n,) [rad/s] that the manufacturer allows in the whole joint range, at whose ends the limits shrink."""
    ends = [np.array([getattr(joint, end).value for joint in robot_model.joints]) for end in ("lower", "upper")]
    velocities: list[Array] = []
    for q in ends:
        lowest, highest = kind.limits.velocity_limits(q)
        velocities += [-lowest, highest]
    return np.minimum.reduce(velocities)


def _check_signature(answers: Checklist) -> list[ChecklistFlaw]:
    required = (("by", answers.by, "a name"), ("on", answers.on, "a date"))
    return [ChecklistFlaw(name, answer, allowed) for name, answer, allowed in required if not answer.strip()]


def _check_tool(answers: Checklist, site: Site, kind: DriverKind) -> list[ChecklistFlaw]:
    tool, payload, found = answers.tool, answers.payload.mass, list[ChecklistFlaw]()
    if not tool.name.strip() or not tool.mass >= 0.0:
        found.append(ChecklistFlaw("tool", (tool.name, tool.mass), "a name and a measured mass [kg]"))
    site_tip = site.tool.position if site.tool else (0.0, 0.0, 0.0)
    if not np.linalg.norm(np.array(tool.tip) - np.array(site_tip)) <= TIP_TOLERANCE:
        found.append(ChecklistFlaw("tool.tip [m]", tool.tip, f"{site_tip}, as in the site file"))
    if not tool.set_at_controller:
        allowed = "true: the collision detection of the arm needs the mass of the tool"
        found.append(ChecklistFlaw("tool.set_at_controller", False, allowed))
    if not (payload >= 0.0 and tool.mass + payload <= kind.payload):
        allowed = f"together with the tool at most the rated {kind.payload} kg"
        found.append(ChecklistFlaw("payload.mass [kg]", payload, allowed))
    return found


def _check_mounting(mounting: MountingAnswer) -> list[ChecklistFlaw]:
    found = list[ChecklistFlaw]()
    if mounting.on != "floor":
        found.append(ChecklistFlaw("mounting.on", mounting.on, "floor: scenes and planes assume that z is up"))
    if not abs(mounting.lean) <= MAX_LEAN:
        found.append(ChecklistFlaw("mounting.lean [rad]", mounting.lean, f"at most {MAX_LEAN}"))
    if not mounting.bolted:
        found.append(ChecklistFlaw("mounting.bolted", False, "true"))
    return found


def _check_table(answers: Checklist, site: Site) -> list[ChecklistFlaw]:
    points = np.array(answers.table.points, dtype=float).reshape(-1, 3)
    if not np.isfinite(points).all():
        got = [tuple(point) for point in points.tolist()]
        return [ChecklistFlaw("table.points", got, "finite coordinates [m]")]
    if not (len(points) >= 3 and np.linalg.matrix_rank(points - points[0], tol=0.05) >= 2):
        allowed = "three points or more, at least 5 cm apart and not on one line"
        return [ChecklistFlaw("table.points", len(points), allowed)]
    if any(_are_on_plane(plane, points) for plane in site.plane):
        return []
    below, above = 1e3 * MAX_POINT_BELOW_PLANE, 1e3 * MAX_POINT_ABOVE_PLANE
    allowed = f"at most {below:.0f} mm below and {above:.0f} mm above a [[plane]] of the site file"
    return [ChecklistFlaw("table.points", [tuple(point) for point in points.tolist()], allowed)]


def _are_on_plane(plane: PlaneEntry, points: Array) -> bool:
    inward = np.array(plane.inward) / np.linalg.norm(plane.inward)
    heights = (points - np.array(plane.point)) @ inward
    return bool((heights <= MAX_POINT_ABOVE_PLANE).all() and (heights >= -MAX_POINT_BELOW_PLANE).all())


def _check_estop(estop: EstopAnswer) -> list[ChecklistFlaw]:
    found = list[ChecklistFlaw]()
    if not estop.speed > 0.0:
        found.append(ChecklistFlaw("estop.speed [rad/s]", estop.speed, "above 0: the test is made while the arm moves"))
    if not 0.0 <= estop.rest <= MAX_ESTOP_STOP_TIME:
        found.append(ChecklistFlaw("estop.rest [s]", estop.rest, f"at most {MAX_ESTOP_STOP_TIME}"))
    for name, confirmed in (("latched", estop.latched), ("reset_in_two_steps", estop.reset_in_two_steps)):
        if not confirmed:
            found.append(ChecklistFlaw(f"estop.{name}", False, "true"))
    return found
