"""dualbrain robot inspect: show a robot model as tables and in the browser."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.markup import escape

from dualbrain.cli.common.arguments import Port
from dualbrain.cli.common.console import VisibleConsole, print_message, print_result, print_table
from dualbrain.cli.common.exit_codes import ExitCode

if TYPE_CHECKING:
    from dualbrain.robots.assets.meshes import Mesh
    from dualbrain.robots.importer.report import LinkReport
    from dualbrain.robots.model import RobotModel

COVERAGE_HEADS = ("link", "group", "spheres", "coverage", "excess [mm]: mean", "maximum")


def inspect(
    robot: str = "panda",
    /,
    *,
    view: Annotated[bool, Parameter(negative="")] = False,
    port: Port = 8081,
) -> int:
    """Show the robot model that the filter uses: bounds with provenance, spheres, link pairs, missing information.

    Exit code 0 if nothing is missing, 5 otherwise.

    Parameters
    ----------
    robot
        A name, or a folder made by `dualbrain robot init`.
    view
        Show spheres and meshes in the browser, with a slider for every joint (loopback interface only).
    port
        Port of the view.
    """
    from dualbrain.robots.importer.output.markdown import bound_rows, missing_information
    from dualbrain.robots.importer.output.robot_folder import find_edits, read_import_files
    from dualbrain.robots.loader import load_robot

    robot_model = load_robot(robot)
    folder = Path(robot)
    report, _ = read_import_files(folder) if folder.is_dir() else (None, None)
    console = VisibleConsole()
    print_table(("joint", "bound", "value", "from"), bound_rows(robot_model), wrap_columns=("from",))
    if report:
        print_table(COVERAGE_HEADS, map(_coverage_row, report.links))
    kept = len(robot_model.self_pairs.kept)
    console.print(
        f"{len(robot_model.spheres)} spheres, {kept} link pairs checked for self-collision, "
        f"α at most {robot_model.alpha:.2f}/s"
    )
    for change in find_edits(folder) if folder.is_dir() else ():
        console.print(f"edited: {change}", markup=False)
    missing = missing_information(robot_model, report)
    for line in missing:
        console.print(f"[red]missing[/]: {escape(line)}")
    if view:
        _serve_view(robot_model, folder, port)
    return ExitCode.SETUP if missing else ExitCode.SUCCESS


def _coverage_row(link: LinkReport) -> tuple[str, ...]:
    excess = (f"{link.mean * 1e3:.1f}", f"{link.worst * 1e3:.1f}")
    return (link.link, link.group, str(link.spheres), f"{link.coverage:.2%}", *excess)


def _serve_view(robot_model: RobotModel, folder: Path, port: int) -> None:
    """Serve the view until Enter is pressed; without a terminal, print its address and close it."""
    from dualbrain.visualization.robot.viewer import RobotViewer

    shapes, reason = _load_meshes(folder)
    if reason:
        print_message(f"dualbrain: no meshes: {reason}")
    view = RobotViewer(robot_model, shapes, port)
    try:
        print_result(f"view: {view.url}")
        if sys.stdin.isatty():
            input("Press Enter to close the view. ")
    finally:
        view.close()


def _load_meshes(folder: Path) -> tuple[dict[str, Mesh], str]:
    """The meshes that the spheres were fitted to, and the reason if there are none."""
    from dualbrain.cli.robot.read_description import read_description
    from dualbrain.core.storage.checksum import file_sha256
    from dualbrain.errors import DualbrainError
    from dualbrain.robots.importer.output.robot_folder import read_import_files
    from dualbrain.robots.importer.output.source_meshes import load_source_meshes

    _, record = read_import_files(folder) if folder.is_dir() else (None, None)
    if record is None:
        return {}, "the folder has no import record"
    file = Path(record.description)
    if not file.is_file() or file_sha256(file) != record.sha256:
        return {}, f"{file} does not exist or has changed since the import"
    try:
        tree = read_description(file, [Path(path) for path in record.packages])
        return load_source_meshes(tree, record), ""
    except DualbrainError as error:
        return {}, str(error)
