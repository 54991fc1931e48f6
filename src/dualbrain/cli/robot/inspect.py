"""dualbrain robot inspect: what the filter sees of a robot, as a table and in the browser."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from dualbrain.cli.common.exit_codes import ExitCode

if TYPE_CHECKING:
    from dualbrain.robots.assets.meshes import Mesh
    from dualbrain.robots.importer.report import ImportReport
    from dualbrain.robots.model import RobotModel


def inspect(
    robot: str = "panda",
    /,
    *,
    view: Annotated[bool, Parameter(negative="")] = False,
    port: int = 8081,
) -> int:
    """Show what the filter sees of a robot: bounds with their provenance, spheres, pairs, and what is still missing.

    Exit code 0 when nothing is missing, 5 otherwise.

    Parameters
    ----------
    robot
        A known name, or a folder that `dualbrain robot init` made.
    view
        Spheres over meshes in the browser, with a slider for every joint; on this machine only.
    port
        Where the view listens.
    """
    from dualbrain.robots.importer.output.markdown import missing_information
    from dualbrain.robots.importer.output.robot_folder import find_edits, read_import_files
    from dualbrain.robots.loader import load_robot

    robot_model = load_robot(robot)
    folder = Path(robot)
    report, _ = read_import_files(folder) if folder.is_dir() else (None, None)
    console = Console()
    console.print(_bounds_table(robot_model))
    if report:
        console.print(_coverage_table(report))
    kept = len(robot_model.self_pairs.kept)
    console.print(
        f"{len(robot_model.spheres)} spheres, {kept} pairs of parts kept apart, α at most {robot_model.alpha:.2f}/s"
    )
    for change in find_edits(folder) if folder.is_dir() else ():
        console.print(f"edited: {change}", markup=False)
    missing = missing_information(robot_model, report)
    for line in missing:
        console.print(f"[red]missing[/]: {line}")
    if view:
        _serve_view(robot_model, folder, port)
    return ExitCode.SETUP if missing else ExitCode.SUCCESS


def _bounds_table(robot_model: RobotModel) -> Table:
    from dualbrain.robots.importer.output.markdown import bound_rows

    table = Table("joint", "bound", "value", "from", box=None, pad_edge=False)
    for row in bound_rows(robot_model):
        table.add_row(*row)
    return table


def _coverage_table(report: ImportReport) -> Table:
    table = Table("part", "group", "spheres", "covered", "stands off [mm]: mean", "worst", box=None, pad_edge=False)
    for link in report.links:
        table.add_row(
            link.link,
            link.group,
            str(link.spheres),
            f"{link.coverage:.2%}",
            f"{link.mean * 1e3:.1f}",
            f"{link.worst * 1e3:.1f}",
        )
    return table


def _serve_view(robot_model: RobotModel, folder: Path, port: int) -> None:
    """Serve until a key is pressed; without a terminal, not at all (a script that asks is told where to look)."""
    from dualbrain.visualization.robot.viewer import RobotViewer

    shapes, why = _load_meshes(folder)
    if why:
        print(f"dualbrain: spheres only: {why}", file=sys.stderr)
    view = RobotViewer(robot_model, shapes, port)
    try:
        print(f"Look at {view.url}", flush=True)
        if sys.stdin.isatty():
            input("Enter ends it. ")
    finally:
        view.close()


def _load_meshes(folder: Path) -> tuple[dict[str, Mesh], str]:
    """The shapes that the spheres were fitted to, and why there are none."""
    from dualbrain.cli.robot.read_description import read_description
    from dualbrain.errors import DualbrainError
    from dualbrain.robots.importer.output.robot_folder import file_sha256, read_import_files
    from dualbrain.robots.importer.output.source_meshes import load_source_meshes

    _, recipe = read_import_files(folder) if folder.is_dir() else (None, None)
    if recipe is None:
        return {}, "no description beside this robot"
    file = Path(recipe.description)
    if not file.is_file() or file_sha256(file) != recipe.sha256:
        return {}, f"{file} is gone or has changed since"
    try:
        tree = read_description(file, [Path(path) for path in recipe.packages])
        return load_source_meshes(tree, recipe), ""
    except DualbrainError as error:
        return {}, str(error)
