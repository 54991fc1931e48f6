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
from dualbrain.errors import InvalidSetup
from dualbrain.robots.model import Body, Vector
from dualbrain.robots.site_config import PlaneEntry, Site

Array = NDArray[np.float64]

MARGIN = 0.98
"""Our limits of velocity, acceleration and jerk are at most this share of the maker's."""
INSIDE = 0.01
"""[rad] by which our joint ranges lie inside the maker's."""
ABOVE, BELOW = 0.002, 0.010
"""[m] by which a touched point of the table may lie above and below the plane in the site file."""
LEVEL = 0.01
"""[rad] by which the base may lean."""
STOPS_WITHIN = 0.5
"""[s] in which the emergency stop must have brought the arm to rest."""
SAME_TIP = 0.002
LARGEST = 2**16


class Entry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Root of the tables: a word that is not known is an error."""


class ToolAnswer(Entry, frozen=True):
    """[tool]: what is on the flange: name, mass [kg], tip in the body's tool frame [m], set at the maker's too."""

    name: str
    mass: float
    tip: Vector = (0.0, 0.0, 0.0)
    set_at_controller: bool = False


class PayloadAnswer(Entry, frozen=True):
    """[payload]: the heaviest thing that will be carried [kg]."""

    mass: float


class MountingAnswer(Entry, frozen=True):
    """[mounting]: on what the base stands, and how far it leans [rad], by a level."""

    on: Literal["floor", "wall", "ceiling"]
    lean: float
    bolted: bool = False


class TableAnswer(Entry, frozen=True):
    """[table]: at least three points of the table that the tip has touched [m, base frame]."""

    points: tuple[Vector, ...]


class EstopAnswer(Entry, frozen=True):
    """[estop]: pressed while a joint moved at `speed` [rad/s]: at rest after `rest` [s]; did it stay latched."""

    speed: float
    rest: float
    latched: bool = False
    reset_in_two_steps: bool = False


class Checklist(Entry, frozen=True):
    """The whole file: who answered (`by`), when (`on`), and the answers."""

    by: str
    on: str
    tool: ToolAnswer
    payload: PayloadAnswer
    mounting: MountingAnswer
    table: TableAnswer
    estop: EstopAnswer


@dataclass(frozen=True, slots=True)
class Flaw:
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
    if not path.is_file() or path.stat().st_size > LARGEST:
        raise InvalidSetup("checklist", got=str(path), allowed=f"a TOML file of at most {LARGEST} bytes")
    try:
        return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Checklist)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, msgspec.ValidationError) as error:
        raise InvalidSetup("checklist", got=str(error), allowed="every table of the template", fix=str(path)) from error


def flaws(answers: Checklist, body: Body, site: Site, kind: DriverKind) -> tuple[Flaw, ...]:
    """Everything that will not do; `body` is the one that the site file has narrowed."""
    found = [*_people(answers), *_tool(answers, site, kind), *_mounting(answers.mounting), *_table(answers, site)]
    return (*found, *_estop(answers.estop), *limit_flaws(body, kind))


def limit_flaws(body: Body, kind: DriverKind) -> tuple[Flaw, ...]:
    """Where a limit of `body` is not strictly inside the maker's: ours must be the one that trips first."""
    limits, found = kind.limits, list[Flaw]()
    fastest = _fastest(body, kind)
    for index, joint in enumerate(body.joints):
        low, high = (float(value) for value in limits.range[index])
        if not (joint.lower.value >= low + INSIDE and joint.upper.value <= high - INSIDE):
            got = (joint.lower.value, joint.upper.value)
            found.append(Flaw(f"range of {joint.name} [rad]", got, f"within {low + INSIDE:.4f} … {high - INSIDE:.4f}"))
        sides = [("velocity", joint.velocity.value, float(fastest[index]))]
        if limits.acceleration is not None:
            sides.append(("acceleration", joint.acceleration.value, float(limits.acceleration[index])))
        if limits.jerk is not None:
            sides.append(("jerk", joint.jerk.value if joint.jerk else np.inf, float(limits.jerk[index])))
        for name, ours, theirs in sides:
            if not ours <= MARGIN * theirs:
                found.append(Flaw(f"{name} of {joint.name}", ours, f"at most {MARGIN * theirs:.4g} by the site file"))
    return tuple(found)


def _fastest(body: Body, kind: DriverKind) -> Array:
    """What the maker allows everywhere in the body's range (n,) [rad/s]: the limits shrink toward its ends."""
    lower, upper = (np.array([getattr(joint, side).value for joint in body.joints]) for side in ("lower", "upper"))
    (down, up), (down_there, up_there) = kind.limits.velocities(lower), kind.limits.velocities(upper)
    return np.minimum.reduce([-down, up, -down_there, up_there])


def _people(answers: Checklist) -> list[Flaw]:
    named = (("by", answers.by), ("on", answers.on))
    return [Flaw(name, said, "who answered, and when") for name, said in named if not said.strip()]


def _tool(answers: Checklist, site: Site, kind: DriverKind) -> list[Flaw]:
    tool, load, found = answers.tool, answers.payload.mass, list[Flaw]()
    if not tool.name.strip() or not tool.mass >= 0.0:
        found.append(Flaw("tool", (tool.name, tool.mass), "a name, and a mass that was weighed [kg]"))
    declared = site.tool.position if site.tool else (0.0, 0.0, 0.0)
    if not np.linalg.norm(np.array(tool.tip) - np.array(declared)) <= SAME_TIP:
        found.append(Flaw("tool.tip [m]", tool.tip, f"the site file's {declared}"))
    if not tool.set_at_controller:
        found.append(Flaw("tool.set_at_controller", False, "true: the arm's own collision detection needs it"))
    if not (load >= 0.0 and tool.mass + load <= kind.payload):
        found.append(Flaw("payload.mass [kg]", load, f"with the tool at most the rated {kind.payload} kg"))
    return found


def _mounting(mounting: MountingAnswer) -> list[Flaw]:
    found = list[Flaw]()
    if mounting.on != "floor":
        found.append(Flaw("mounting.on", mounting.on, "floor: scenes and planes here count on z upward"))
    if not abs(mounting.lean) <= LEVEL:
        found.append(Flaw("mounting.lean [rad]", mounting.lean, f"at most {LEVEL}"))
    if not mounting.bolted:
        found.append(Flaw("mounting.bolted", False, "true"))
    return found


def _table(answers: Checklist, site: Site) -> list[Flaw]:
    points = np.array(answers.table.points, dtype=float).reshape(-1, 3)
    flat = np.linalg.matrix_rank(points - points[0], tol=0.05) >= 2 if len(points) >= 3 else False
    if not (flat and np.isfinite(points).all()):
        return [Flaw("table.points", len(points), "three or more that are not on one line, 5 cm apart or more")]
    if any(_lies_on(plane, points) for plane in site.plane):
        return []
    allowed = f"within {1e3 * BELOW:.0f} mm below and {1e3 * ABOVE:.0f} mm above a [[plane]] of the site file"
    return [Flaw("table.points", [tuple(point) for point in points.tolist()], allowed)]


def _lies_on(plane: PlaneEntry, points: Array) -> bool:
    inward = np.array(plane.inward) / np.linalg.norm(plane.inward)
    heights = (points - np.array(plane.point)) @ inward
    return bool((heights <= ABOVE).all() and (heights >= -BELOW).all())


def _estop(estop: EstopAnswer) -> list[Flaw]:
    found = list[Flaw]()
    if not estop.speed > 0.0:
        found.append(Flaw("estop.speed [rad/s]", estop.speed, "above 0: it is tried while the arm moves"))
    if not 0.0 <= estop.rest <= STOPS_WITHIN:
        found.append(Flaw("estop.rest [s]", estop.rest, f"at most {STOPS_WITHIN}"))
    for name, said in (("latched", estop.latched), ("reset_in_two_steps", estop.reset_in_two_steps)):
        if not said:
            found.append(Flaw(f"estop.{name}", False, "true"))
    return found
