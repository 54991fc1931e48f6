"""dualbrain robot init: import a robot model from a URDF or MJCF description."""

from __future__ import annotations

import shlex
import time
from collections.abc import Mapping, Sequence
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.common.arguments import Seed
from dualbrain.cli.common.console import print_message, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.errors import UsageError

if TYPE_CHECKING:
    from dualbrain.robots.importer.build_arm import ImportOptions, ImportResult
    from dualbrain.robots.importer.output.robot_folder import FolderWriteResult


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
    seed: Seed = 0,
    discard_edits: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Import a robot from its description into a folder with robot model, README and image.

    No limit is assumed: the command lists every limit that neither the description nor an option states. A repeated
    import keeps the edits in body.json and lists the changes. Next: `dualbrain robot inspect FOLDER --view`, `dualbrain
    schema --robot FOLDER`, and in Python `SafetyFilter(load_robot("FOLDER"))`.

    Parameters
    ----------
    description
        URDF or MJCF (.xml) file.
    out
        Folder to write. Default: a folder named after the robot, in the current folder.
    name
        Name of the robot. Default: the name in the description.
    chain
        BASE..TIP, two link names, if the description has several arms or ends in fingers.
    tool
        Link whose frame is the tool frame. Default: the tip of the chain.
    lock
        JOINT=VALUE: lock a joint. May be repeated.
    home
        Joint positions of the home configuration, separated by commas. Default: a collision-free one is searched.
    packages
        Additional folder with packages (package://NAME/...) and meshes. May be repeated.
    site
        Site file (TOML) with limits and caps; see docs/how-to/site.md.
    acceleration
        Maximum acceleration of every joint [rad/s², m/s²]; for a base along its path.
    velocity
        Maximum velocity of every joint [rad/s, m/s]; for a base of driving, of turning and of the wheels.
    period
        Control period [s].
    tool_speed
        Maximum speed of the tool [m/s]; for a base along its path.
    grip
        MIN,MAX grip force [N] of a gripper with two sliding fingers; MAX may come from the description.
    base
        differential: a mobile base with fixed upper parts, instead of an arm.
    wheels
        LEFT,RIGHT: wheel joints of the base, which determine its speed limits.
    turn
        Maximum turn rate of a base [rad/s].
    turn_acceleration
        Maximum turn acceleration of a base [rad/s²].
    spheres
        Maximum number of spheres.
    quick
        Fit spheres coarsely, in seconds; coverage is verified as usual, but the spheres are larger.
    seed
        Random seed.
    discard_edits
        Overwrite manual edits in body.json.
    """
    from dualbrain.cli.robot.read_description import read_description
    from dualbrain.robots.importer.build_arm import ImportOptions, build_arm
    from dualbrain.robots.importer.build_mobile_base import build_base
    from dualbrain.robots.importer.required_limits import make_limit_policy
    from dualbrain.robots.site_config import read_site

    started = time.monotonic()
    _refuse_unused_options(base, {"--wheels": wheels}, {"--home": home, "--tool": tool, "--grip": grip})
    start, tip = _parse_chain(chain)
    options = ImportOptions(
        name=name,
        base=start,
        tip=tip,
        tool=tool,
        lock=_parse_locks(lock),
        quick=quick,
        sphere_budget=spheres,
        seed=seed,
        home=_parse_home(home),
    )
    limits = {
        "acceleration": acceleration,
        "velocity": velocity,
        "period": period,
        "tool_speed": tool_speed,
        "turn": turn,
        "turn_acceleration": turn_acceleration,
        **_parse_grip(grip),
    }
    policy = make_limit_policy(read_site(site) if site else None, limits)
    tree = read_description(description, packages)
    imported = (
        build_arm(tree, policy, options, _print_progress)
        if base == "fixed"
        else build_base(tree, policy, options, _parse_wheels(wheels), _print_progress)
    )
    folder = out or Path(imported.robot_model.name)
    written = _write_robot(folder, description, packages, options, imported, base, _parse_wheels(wheels), discard_edits)
    _print_summary(folder, imported, written, time.monotonic() - started)
    return ExitCode.SUCCESS


def _write_robot(
    folder: Path,
    description: Path,
    packages: Sequence[Path],
    options: ImportOptions,
    imported: ImportResult,
    base: str,
    wheels: tuple[str, str] | None,
    discard_edits: bool,
) -> FolderWriteResult:
    from dualbrain.core.storage.checksum import file_sha256
    from dualbrain.robots.importer.output.robot_folder import (
        IMAGE_FILE,
        ImportRecord,
        write_robot_folder,
    )
    from dualbrain.safety.cbf.filter import SafetyFilter
    from dualbrain.visualization.robot.image import draw_robot

    SafetyFilter(imported.robot_model)  # refuses a model beyond the capacity of the kernel before anything is written
    record = ImportRecord(
        description=str(description.resolve()),
        sha256=file_sha256(description),
        packages=tuple(str(path.resolve()) for path in packages),
        base=options.base,
        tip=options.tip,
        tool=options.tool,
        lock=dict(options.lock),
        quick=options.quick,
        spheres=options.sphere_budget,
        seed=options.seed,
        kind=base,
        wheels=wheels,
    )
    written = write_robot_folder(folder, imported.robot_model, imported.report, record, discard_edits=discard_edits)
    draw_robot(written.robot_model, imported.shapes, folder / IMAGE_FILE)
    return written


def _print_summary(folder: Path, imported: ImportResult, written: FolderWriteResult, seconds: float) -> None:
    from dualbrain.robots.importer.output.diff import summarize_changes
    from dualbrain.robots.importer.output.markdown import missing_information

    robot_model, report = written.robot_model, imported.report
    worst = max((link.worst for link in report.links), default=0.0)
    print_result(
        f"{folder}: {robot_model.name}, {robot_model.n} joints, {len(robot_model.spheres)} spheres, {seconds:.0f} s"
    )
    print_result(
        f"  coverage: at least {report.coverage:.2%} of the surface of every link; spheres exceed it by at most "
        f"{worst * 1e3:.0f} mm; {len(robot_model.self_pairs.kept)} link pairs checked for self-collision"
    )
    for line in missing_information(robot_model, report):
        print_result(f"  missing: {line}")
    for title, lines in (
        ("changed by the import", summarize_changes(written.generator_changes)),
        ("your edits, kept", summarize_changes(written.kept_edits)),
        ("your edits, not applicable", summarize_changes(written.lost_edits)),
    ):
        for line in lines:
            print_result(f"  {title}: {line}")
    if not written.is_new and not written.generator_changes:
        print_result("  imported again: nothing changed")
    print_result(f"Next: dualbrain robot inspect {shlex.quote(str(folder))} --view")


def _print_progress(text: str) -> None:
    print_message(text)


def _refuse_unused_options(base: str, of_base: Mapping[str, str], of_arm: Mapping[str, str]) -> None:
    """Raise `UsageError` for an option that has no effect on the kind of robot that `base` states."""
    unused, kind = (of_base, "an arm") if base == "fixed" else (of_arm, "a mobile base")
    for option, got in unused.items():
        if got:
            fix = "For a mobile base give --base differential." if base == "fixed" else "Leave it out."
            raise UsageError(option, got=got, allowed=f"no such option for {kind}", fix=fix)


def _parse_chain(chain: str) -> tuple[str, str]:
    if not chain:
        return "", ""
    start, dots, tip = chain.partition("..")
    if not dots or not tip:
        raise UsageError("--chain", got=chain, allowed="BASE..TIP, two links")
    return start, tip


def _parse_locks(given: Sequence[str]) -> dict[str, float]:
    locks: dict[str, float] = {}
    for one in given:
        joint, sign, value = one.partition("=")
        try:
            locks[joint] = float(value if sign else "none")
        except ValueError:
            locks[joint] = nan
        if not isfinite(locks[joint]):
            raise UsageError("--lock", got=one, allowed="JOINT=VALUE, in rad or m")
    return locks


def _parse_home(given: str) -> tuple[float, ...] | None:
    try:
        return tuple(float(value) for value in given.split(",")) if given else None
    except ValueError:
        raise UsageError("--home", got=given, allowed="numbers separated by commas") from None


def _parse_grip(given: str) -> dict[str, float]:
    """Minimum and maximum grip force [N], as far as given."""
    try:
        values = [float(value) for value in given.split(",")] if given else []
    except ValueError:
        values = [0.0]
    if len(values) > 2 or any(not value > 0.0 for value in values):
        raise UsageError("--grip", got=given, allowed="MIN or MIN,MAX, above 0 N")
    return dict(zip(("grip_force_min", "grip_force"), values, strict=False))


def _parse_wheels(wheels: str) -> tuple[str, str] | None:
    if not wheels:
        return None
    left, comma, right = wheels.partition(",")
    if not comma or not right:
        raise UsageError("--wheels", got=wheels, allowed="LEFT,RIGHT, two joints")
    return left.strip(), right.strip()
