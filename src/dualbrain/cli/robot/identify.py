"""dualbrain robot identify: identify how closely a robot's drive follows joint velocities, in simulation."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import Parameter
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from dualbrain import __version__
from dualbrain.cli.common.console import StderrConsole, VisibleConsole, print_message, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.core.storage.atomic_files import atomic_file
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import MODEL_FILE, encode_robot, load_robot, read_robot
from dualbrain.robots.model import RobotModel, TrackingErrorModel

if TYPE_CHECKING:
    from dualbrain.simulation.identification.tracking_model import TrackingModel
    from dualbrain.simulation.plant.joint_drive import DriveKind


def identify(
    *,
    robot: str = "panda",
    drive: str = "computed_torque",
    seeds: int = 4,
    seconds: float = 10.0,
    load: float = 0.5,
    json: Annotated[bool, Parameter(negative="")] = False,
    write: Path | None = None,
) -> int:
    """Identify the tracking model of a robot: its lag and the remaining error (method: help text in cli/main.py).

    Parameters
    ----------
    robot
        The robot.
    drive
        computed_torque (the simulator's default), velocity (velocity actuators of MuJoCo), or position (stock position
        servos, which sag under the weight of the arm).
    seeds
        Number of repetitions with different random numbers.
    seconds
        Duration of each run [s]; there are three runs for each seed and load.
    load
        Largest undeclared load at the tool that the model covers [kg].
    json
        Print the result as one JSON object.
    write
        Robot model file (JSON), with the joints of the robot, in which the tracking model of this drive is replaced.
    """
    from dualbrain.simulation.identification.mobile_tracking_model import identify_mobile_manipulator
    from dualbrain.simulation.identification.tracking_model import identify_plant
    from dualbrain.simulation.plant.joint_drive import parse_drive_kind  # MuJoCo is heavy

    kind, robot_model = parse_drive_kind(drive), load_robot(robot)
    target = _written_robot(write, robot_model)
    with _progress_bar() as bar:
        task = bar.add_task(f"{robot}, {drive}", total=1.0)
        options = {
            "load": load,
            "seeds": range(seeds),
            "seconds": seconds,
            "progress": lambda share, word: bar.update(task, completed=share, description=word),
        }
        provenance, base_lag = _provenance(robot, kind, seeds, seconds, load), robot_model.base_lag
        if robot_model.is_mobile_manipulator:
            both = identify_mobile_manipulator(robot_model, kind, **options)
            found, (entry, base_lag) = both.arm, both.to_error_model(drive, provenance)
        else:
            found = identify_plant(robot_model, kind, **options)
            entry = found.to_error_model(drive, provenance)
    if write is not None:
        data = encode_robot(msgspec.structs.replace(target.with_tracking(entry), base_lag=base_lag))
        with atomic_file(write) as temporary:
            temporary.write_bytes(data)
        print_message(f"{write}: tracking model of the {drive} drive replaced")
    if json:
        print_result(msgspec.json.format(msgspec.json.encode({"entry": entry, "found": found}), indent=1).decode())
    else:
        _print_tracking_model(robot_model, entry, found, base_lag, written=write is not None)
    return ExitCode.SUCCESS


def _written_robot(write: Path | None, robot_model: RobotModel) -> RobotModel:
    """The robot model in the file `write` if it exists, else `robot_model`.

    Raises `ConfigurationError` if the file is no valid robot model, or that of a robot with other joints.
    """
    if write is None or not write.exists():
        return robot_model
    if write.is_dir():
        raise ConfigurationError.stating(f"{write} is a folder.", fix=f"Name the file: --write {write / MODEL_FILE}")
    target = read_robot(write)
    joints, expected = ([joint.name for joint in model.joints] for model in (target, robot_model))
    if joints != expected:
        fix = "Name a new file, or that of a robot with these joints."
        raise ConfigurationError(f"joints in {write.name}", got=joints, allowed=", ".join(expected), fix=fix)
    return target


def _progress_bar() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    return Progress(*columns, console=StderrConsole(), transient=True)


def _provenance(robot: str, drive: DriveKind, seeds: int, seconds: float, load: float) -> str:
    options = f"--robot {robot} --drive {drive} --seeds {seeds} --seconds {seconds:g} --load {load:g}"
    return f"dualbrain robot identify {options}; MuJoCo plant, dualbrain {__version__}, {datetime.now(UTC):%Y-%m-%d}"


def _print_tracking_model(
    robot_model: RobotModel, entry: TrackingErrorModel, found: TrackingModel, base_lag: float | None, *, written: bool
) -> None:
    table = Table("", "", box=None, pad_edge=False, show_header=False)
    table.add_row("lag", f"{entry.lag * 1e3:.3f} ms" + (f", base {base_lag * 1e3:.3f} ms more" if base_lag else ""))
    n = robot_model.n
    table.add_row("position errors e", f"{_list_milli(entry.position_errors(n))} mrad, with factor 1.25")
    margins = _list_milli(entry.row_margins(robot_model.alpha, n))
    table.add_row("margins α e of the rows", f"{margins} mrad/s at α = {entry.rate:.2f}/s")
    table.add_row("measured, by seed", f"{_list_milli(found.by_seed)} mrad")
    table.add_row("measured, by joint", f"{_list_milli(found.largest)} mrad")
    table.add_row("largest |ẏ − u|", f"{found.velocity_error:.4f} rad/s")
    known = {tracking.drive: tracking for tracking in (robot_model.tracking, *robot_model.other_drives)}.get(
        entry.drive
    )
    if known is not None:
        errors = _list_milli(sorted(set(known.position_errors(n))))
        table.add_row("stored model", f"lag {known.lag * 1e3:.3f} ms, e {errors} mrad")
    VisibleConsole().print(table)
    if not written:
        print_result(
            "To use it: --write FILE replaces it in a robot model file; FilterConfig(tracking_error=...) overrides it."
        )


def _list_milli(values: Iterable[float]) -> str:
    """`values` in thousandths."""
    return ", ".join(f"{value * 1e3:.3f}" for value in values)
