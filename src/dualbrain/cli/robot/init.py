"""dualbrain robot init: a robot's description becomes a body that the filter can guard."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.common.exit_codes import Exit
from dualbrain.errors import WrongUsage

if TYPE_CHECKING:
    from dualbrain.robots.importer.build_arm import Made, Wish
    from dualbrain.robots.importer.output.robot_folder import Written


def init(
    description: Path,
    /,
    *,
    out: Path | None = None,
    name: str = "",
    chain: str = "",
    tool: str = "",
    lock: Annotated[tuple[str, ...], Parameter(consume_multiple=False)] = (),
    home: str = "",
    packages: Annotated[tuple[Path, ...], Parameter(consume_multiple=False)] = (),
    site: Path | None = None,
    acceleration: float | None = None,
    velocity: float | None = None,
    period: float | None = None,
    tool_speed: float | None = None,
    grip: str = "",
    base: Literal["fixed", "differential"] = "fixed",
    wheels: str = "",
    turn: float | None = None,
    turn_acceleration: float | None = None,
    spheres: int = 96,
    quick: Annotated[bool, Parameter(negative="")] = False,
    seed: int = 0,
    discard_edits: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Make a robot from its description: a folder with what the filter reads, a page for people, and a picture.

    Nothing is assumed: a limit that neither the description nor you state is asked for. Making again keeps the edits in
    body.json and shows what changed. Afterwards `dualbrain robot inspect FOLDER --view`, `dualbrain schema --robot
    FOLDER`, and in Python `SafetyFilter(load_body("FOLDER"))`.

    Parameters
    ----------
    description
        URDF, or MJCF (.xml).
    out
        Folder to write; default: the robot's name, here.
    name
        What to call the robot; default: as in the description.
    chain
        BASE..TIP, names of links, where the description has several arms or ends in fingers.
    tool
        Link whose frame is the tool's; default: the chain's tip.
    lock
        JOINT=VALUE: hold a joint still. May be repeated.
    home
        Joint values, separated by commas; default: one that is free is found.
    packages
        Folder in which packages (package://NAME/...) and meshes may lie as well. May be repeated.
    site
        Site file (TOML) with limits and caps; see docs/site.md.
    acceleration
        Greatest acceleration of every joint [rad/s², m/s²]; of a base along its way.
    velocity
        Cap of every joint's velocity [rad/s, m/s].
    period
        Control period [s].
    tool_speed
        Greatest speed of the tool [m/s]; of a base along its way.
    grip
        LEAST,GREATEST grip force [N] of two fingers that slide; the greatest may be left to the description.
    base
        differential: a base that drives, its upper parts standing still, instead of an arm.
    wheels
        LEFT,RIGHT: wheel joints of the base, from which its speeds follow.
    turn
        Greatest turn rate of a base [rad/s].
    turn_acceleration
        Greatest turn acceleration of a base [rad/s²].
    spheres
        At most so many spheres.
    quick
        Fit spheres coarsely, in seconds; coverage is proven all the same, the excess is larger.
    seed
        Of everything random.
    discard_edits
        Overwrite what a person changed in body.json.
    """
    from dualbrain.cli.robot.read_description import read_description
    from dualbrain.robots.importer.build_arm import Wish, build_arm
    from dualbrain.robots.importer.build_mobile_base import build_base
    from dualbrain.robots.importer.required_limits import policy_of
    from dualbrain.robots.site_config import read_site

    began = time.monotonic()
    start, tip = _ends(chain)
    wish = Wish(name, start, tip, tool, _locks(lock), quick, spheres, seed, _home(home))
    options = {
        "acceleration": acceleration, "velocity": velocity, "period": period, "tool_speed": tool_speed, "turn": turn,
        "turn_acceleration": turn_acceleration, **_grip(grip),
    }  # fmt: skip
    policy = policy_of(read_site(site) if site else None, options)
    tree = read_description(description, packages)
    made = (
        build_arm(tree, policy, wish, _tell)
        if base == "fixed"
        else build_base(tree, policy, wish, _pair(wheels), _tell)
    )
    folder = out or Path(made.body.name)
    written = _write(folder, description, packages, wish, made, base, _pair(wheels), discard_edits)
    _account(folder, made, written, time.monotonic() - began)
    return Exit.SUCCESS


def _write(
    folder: Path, description: Path, packages: Sequence[Path], wish: Wish, made: Made, base: str,
    wheels: tuple[str, str] | None, discard_edits: bool,
) -> Written:  # fmt: skip
    from dualbrain.robots.importer.output.robot_folder import PICTURE, Recipe, sha256, write_folder
    from dualbrain.safety.cbf.filter import SafetyFilter
    from dualbrain.visualization.robot.image import draw_body

    SafetyFilter(made.body)  # what the kernel has no room for is refused before anything is written
    recipe = Recipe(
        str(description.resolve()), sha256(description), tuple(str(path.resolve()) for path in packages), wish.base,
        wish.tip, wish.tool, dict(wish.lock), wish.quick, wish.spheres, wish.seed, base, wheels,
    )  # fmt: skip
    written = write_folder(folder, made.body, made.report, recipe, discard_edits=discard_edits)
    draw_body(written.body, made.shapes, folder / PICTURE)
    return written


def _account(folder: Path, made: Made, written: Written, seconds: float) -> None:
    from dualbrain.robots.importer.output.diff import summary
    from dualbrain.robots.importer.output.markdown import gaps

    body, report = written.body, made.report
    worst = max((link.worst for link in report.links), default=0.0)
    print(f"{folder}: {body.name}, {body.n} joints, {len(body.spheres)} spheres, {seconds:.0f} s")
    print(
        f"  cover: {report.coverage:.2%} of every part's surface at least; spheres stand off by {worst * 1e3:.0f} mm "
        f"at most; {len(body.self_pairs.kept)} pairs of parts kept apart"
    )
    for line in gaps(body, report):
        print(f"  missing: {line}")
    for title, lines in (
        ("changed by making again", summary(written.by_making)), ("your edits, kept", summary(written.kept)),
        ("your edits that found no place", summary(written.lost)),
    ):  # fmt: skip
        for line in lines:
            print(f"  {title}: {line}")
    if not written.new and not written.by_making:
        print("  made again: nothing changed")
    width = shutil.get_terminal_size().columns
    print(f"Next: dualbrain robot inspect {folder} --view"[:width])


def _tell(text: str) -> None:
    print(text, file=sys.stderr)


def _ends(chain: str) -> tuple[str, str]:
    if not chain:
        return "", ""
    start, dots, tip = chain.partition("..")
    if not dots or not tip:
        raise WrongUsage("--chain", got=chain, allowed="BASE..TIP, two links")
    return start, tip


def _locks(given: Sequence[str]) -> dict[str, float]:
    locks: dict[str, float] = {}
    for one in given:
        joint, sign, value = one.partition("=")
        try:
            locks[joint] = float(value if sign else "none")
        except ValueError:
            raise WrongUsage("--lock", got=one, allowed="JOINT=VALUE, in rad or m") from None
    return locks


def _home(given: str) -> tuple[float, ...] | None:
    try:
        return tuple(float(value) for value in given.split(",")) if given else None
    except ValueError:
        raise WrongUsage("--home", got=given, allowed="numbers separated by commas") from None


def _grip(given: str) -> dict[str, float]:
    """Least and greatest grip force [N], as far as they are given."""
    try:
        values = [float(value) for value in given.split(",")] if given else []
    except ValueError:
        values = [0.0]
    if len(values) > 2 or any(not value > 0.0 for value in values):
        raise WrongUsage("--grip", got=given, allowed="LEAST or LEAST,GREATEST, above 0 N")
    return dict(zip(("grip_force_min", "grip_force"), values, strict=False))


def _pair(wheels: str) -> tuple[str, str] | None:
    if not wheels:
        return None
    left, comma, right = wheels.partition(",")
    if not comma or not right:
        raise WrongUsage("--wheels", got=wheels, allowed="LEFT,RIGHT, two joints")
    return left.strip(), right.strip()
