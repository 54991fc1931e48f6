"""The commissioning checklist: what a person has measured and tried at the arm, and whether that will do.

A TOML file of five tables; each answer is compared with body, site file and the maker's limits. What will not do is a
`Flaw`, never an exception.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.drivers.catalogue import DriverKind
from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel, Vector
from dualbrain.robots.site_config import PlaneEntry, Site

Array = NDArray[np.float64]

MAX_VENDOR_LIMIT_SHARE = 0.98
"""Our limits of velocity, acceleration and jerk are at most this share of the maker's."""
RANGE_MARGIN = 0.01
"""[rad] by which our joint ranges lie inside the maker's."""
MAX_POINT_ABOVE_PLANE, MAX_POINT_BELOW_PLANE = 0.002, 0.010
"""[m] by which a touched point of the table may lie above and below the plane in the site file."""
MAX_LEAN = 0.01
"""[rad] by which the base may lean."""
MAX_ESTOP_STOP_TIME = 0.5
"""[s] in which the emergency stop must have brought the arm to rest."""
TIP_TOLERANCE = 0.002
MAX_FILE_BYTES = 2**16


class ChecklistEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Root of the tables: a word that is not known is an error."""


class ToolAnswer(ChecklistEntry, frozen=True):
    """[tool]: what is on the flange: name, mass [kg], tip in the body's tool frame [m], set at the maker's too."""

    name: str
    mass: float
    tip: Vector = (0.0, 0.0, 0.0)
    set_at_controller: bool = False


class PayloadAnswer(ChecklistEntry, frozen=True):
    """[payload]: the heaviest thing that will be carried [kg]."""

    mass: float


class MountingAnswer(ChecklistEntry, frozen=True):
    """[mounting]: on what the base stands, and how far it leans [rad], by a level."""

    on: Literal["floor", "wall", "ceiling"]
    lean: float
    bolted: bool = False


class TableAnswer(ChecklistEntry, frozen=True):
    """[table]: at least three points of the table that the tip has touched [m, base frame]."""

    points: tuple[Vector, ...]


class EstopAnswer(ChecklistEntry, frozen=True):
    """[estop]: pressed while a joint moved at `speed` [rad/s]: at rest after `rest` [s]; did it stay latched."""

    speed: float
    rest: float
    latched: bool = False
    reset_in_two_steps: bool = False


class Checklist(ChecklistEntry, frozen=True):
    """The whole file: who answered (`by`), when (`on`), and the answers."""

    by: str
    on: str
    tool: ToolAnswer
    payload: PayloadAnswer
    mounting: MountingAnswer
    table: TableAnswer
    estop: EstopAnswer


@dataclass(frozen=True, slots=True)
class ChecklistFlaw:
    """An answer that will not do."""

    item: str
    got: object
    allowed: str


TEMPLATE = """# Commissioning of {robot} with driver {driver}. Measure and try everything at the arm; SI units; then run
# `dualbrain robot commission` again. What is left empty here is refused.
by = ""                     # your name
on = ""                     # the date

[tool]
name = ""                   # what is on the flange
mass = nan                  # [kg]
tip = [0.0, 0.0, 0.0]       # its tip in the body's tool frame [m], as in the site file
set_at_controller = false   # mass and centre are set at the arm's own controller

[payload]
mass = nan                  # the heaviest thing that will be carried [kg]

[mounting]
on = "floor"                # floor, wall or ceiling
lean = nan                  # by a level on the base [rad]
bolted = false              # the base does not give when pushed

[table]
points = []                 # three points or more that the tip has touched [m, base frame]

[estop]
speed = nan                 # a joint moved this fast [rad/s] when the button was pressed
rest = nan                  # and stood after [s]
latched = false             # releasing the button alone moved nothing
reset_in_two_steps = false  # release, reset, resume: only then it moved again
"""


def read_checklist(path: Path) -> Checklist:
    """The checklist in `path`; raises `InvalidSetup` if it is not there, not TOML, or lacks an answer."""
    if not path.is_file() or path.stat().st_size > MAX_FILE_BYTES:
        raise ConfigurationError("checklist", got=str(path), allowed=f"a TOML file of at most {MAX_FILE_BYTES} bytes")
    try:
        return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Checklist)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, msgspec.ValidationError) as error:
        raise ConfigurationError(
            "checklist", got=str(error), allowed="every table of the template", fix=str(path)
        ) from error


def find_flaws(answers: Checklist, robot_model: RobotModel, site: Site, kind: DriverKind) -> tuple[ChecklistFlaw, ...]:
    """Everything that will not do; `body` is the one that the site file has narrowed."""
    found = [
        *_check_signature(answers),
        *_check_tool(answers, site, kind),
        *_check_mounting(answers.mounting),
        *_check_table(answers, site),
    ]
    return (*found, *_check_estop(answers.estop), *find_limit_flaws(robot_model, kind))


def find_limit_flaws(robot_model: RobotModel, kind: DriverKind) -> tuple[ChecklistFlaw, ...]:
    """Where a limit of `body` is not strictly inside the maker's: ours must be the one that trips first."""
    limits, found = kind.limits, list[ChecklistFlaw]()
    fastest = _vendor_velocity_limits(robot_model, kind)
    for index, joint in enumerate(robot_model.joints):
        low, high = (float(value) for value in limits.position_range[index])
        if not (joint.lower.value >= low + RANGE_MARGIN and joint.upper.value <= high - RANGE_MARGIN):
            got = (joint.lower.value, joint.upper.value)
            found.append(
                ChecklistFlaw(
                    f"range of {joint.name} [rad]", got, f"within {low + RANGE_MARGIN:.4f} … {high - RANGE_MARGIN:.4f}"
                )
            )
        sides = [("velocity", joint.velocity.value, float(fastest[index]))]
        if limits.acceleration is not None:
            sides.append(("acceleration", joint.acceleration.value, float(limits.acceleration[index])))
        if limits.jerk is not None:
            sides.append(("jerk", joint.jerk.value if joint.jerk else np.inf, float(limits.jerk[index])))
        for name, ours, theirs in sides:
            if not ours <= MAX_VENDOR_LIMIT_SHARE * theirs:
                found.append(
                    ChecklistFlaw(
                        f"{name} of {joint.name}",
                        ours,
                        f"at most {MAX_VENDOR_LIMIT_SHARE * theirs:.4g} by the site file",
                    )
                )
    return tuple(found)


def _vendor_velocity_limits(robot_model: RobotModel, kind: DriverKind) -> Array:
    """What the maker allows everywhere in the body's range (n,) [rad/s]: the limits shrink toward its ends."""
    lower, upper = (
        np.array([getattr(joint, side).value for joint in robot_model.joints]) for side in ("lower", "upper")
    )
    (down, up), (down_there, up_there) = kind.limits.velocity_limits(lower), kind.limits.velocity_limits(upper)
    return np.minimum.reduce([-down, up, -down_there, up_there])


def _check_signature(answers: Checklist) -> list[ChecklistFlaw]:
    named = (("by", answers.by), ("on", answers.on))
    return [ChecklistFlaw(name, said, "who answered, and when") for name, said in named if not said.strip()]


def _check_tool(answers: Checklist, site: Site, kind: DriverKind) -> list[ChecklistFlaw]:
    tool, load, found = answers.tool, answers.payload.mass, list[ChecklistFlaw]()
    if not tool.name.strip() or not tool.mass >= 0.0:
        found.append(ChecklistFlaw("tool", (tool.name, tool.mass), "a name, and a mass that was weighed [kg]"))
    declared = site.tool.position if site.tool else (0.0, 0.0, 0.0)
    if not np.linalg.norm(np.array(tool.tip) - np.array(declared)) <= TIP_TOLERANCE:
        found.append(ChecklistFlaw("tool.tip [m]", tool.tip, f"the site file's {declared}"))
    if not tool.set_at_controller:
        found.append(ChecklistFlaw("tool.set_at_controller", False, "true: the arm's own collision detection needs it"))
    if not (load >= 0.0 and tool.mass + load <= kind.payload):
        found.append(ChecklistFlaw("payload.mass [kg]", load, f"with the tool at most the rated {kind.payload} kg"))
    return found


def _check_mounting(mounting: MountingAnswer) -> list[ChecklistFlaw]:
    found = list[ChecklistFlaw]()
    if mounting.on != "floor":
        found.append(ChecklistFlaw("mounting.on", mounting.on, "floor: scenes and planes here count on z upward"))
    if not abs(mounting.lean) <= MAX_LEAN:
        found.append(ChecklistFlaw("mounting.lean [rad]", mounting.lean, f"at most {MAX_LEAN}"))
    if not mounting.bolted:
        found.append(ChecklistFlaw("mounting.bolted", False, "true"))
    return found


def _check_table(answers: Checklist, site: Site) -> list[ChecklistFlaw]:
    points = np.array(answers.table.points, dtype=float).reshape(-1, 3)
    flat = np.linalg.matrix_rank(points - points[0], tol=0.05) >= 2 if len(points) >= 3 else False
    if not (flat and np.isfinite(points).all()):
        return [
            ChecklistFlaw("table.points", len(points), "three or more that are not on one line, 5 cm apart or more")
        ]
    if any(_are_on_plane(plane, points) for plane in site.plane):
        return []
    allowed = f"within {1e3 * MAX_POINT_BELOW_PLANE:.0f} mm below and {1e3 * MAX_POINT_ABOVE_PLANE:.0f} mm above a [[plane]] of the site file"
    return [ChecklistFlaw("table.points", [tuple(point) for point in points.tolist()], allowed)]


def _are_on_plane(plane: PlaneEntry, points: Array) -> bool:
    inward = np.array(plane.inward) / np.linalg.norm(plane.inward)
    heights = (points - np.array(plane.point)) @ inward
    return bool((heights <= MAX_POINT_ABOVE_PLANE).all() and (heights >= -MAX_POINT_BELOW_PLANE).all())


def _check_estop(estop: EstopAnswer) -> list[ChecklistFlaw]:
    found = list[ChecklistFlaw]()
    if not estop.speed > 0.0:
        found.append(ChecklistFlaw("estop.speed [rad/s]", estop.speed, "above 0: it is tried while the arm moves"))
    if not 0.0 <= estop.rest <= MAX_ESTOP_STOP_TIME:
        found.append(ChecklistFlaw("estop.rest [s]", estop.rest, f"at most {MAX_ESTOP_STOP_TIME}"))
    for name, said in (("latched", estop.latched), ("reset_in_two_steps", estop.reset_in_two_steps)):
        if not said:
            found.append(ChecklistFlaw(f"estop.{name}", False, "true"))
    return found
