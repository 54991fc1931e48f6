"""dualbrain robot inspect: what the filter sees of a robot, as a table and in the browser."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from dualbrain.cli.common.exit_codes import Exit

if TYPE_CHECKING:
    from dualbrain.robots.assets.meshes import Mesh
    from dualbrain.robots.importer.report import Report
    from dualbrain.robots.model import Body


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
    from dualbrain.robots.importer.output.markdown import gaps
    from dualbrain.robots.importer.output.robot_folder import edits, read_report
    from dualbrain.robots.loader import load_body

    body = load_body(robot)
    folder = Path(robot)
    report, _ = read_report(folder) if folder.is_dir() else (None, None)
    console = Console()
    console.print(_bounds(body))
    if report:
        console.print(_cover(report))
    kept = len(body.self_pairs.kept)
    console.print(f"{len(body.spheres)} spheres, {kept} pairs of parts kept apart, α at most {body.alpha:.2f}/s")
    for change in edits(folder) if folder.is_dir() else ():
        console.print(f"edited: {change}", markup=False)
    missing = gaps(body, report)
    for line in missing:
        console.print(f"[red]missing[/]: {line}")
    if view:
        _view(body, folder, port)
    return Exit.SETUP if missing else Exit.SUCCESS


def _bounds(body: Body) -> Table:
    from dualbrain.robots.importer.output.markdown import bound_rows

    table = Table("joint", "bound", "value", "from", box=None, pad_edge=False)
    for row in bound_rows(body):
        table.add_row(*row)
    return table


def _cover(report: Report) -> Table:
    table = Table("part", "group", "spheres", "covered", "stands off [mm]: mean", "worst", box=None, pad_edge=False)
    for link in report.links:
        table.add_row(
            link.link, link.group, str(link.spheres), f"{link.coverage:.2%}", f"{link.mean * 1e3:.1f}",
            f"{link.worst * 1e3:.1f}",
        )  # fmt: skip
    return table


def _view(body: Body, folder: Path, port: int) -> None:
    """Serve until a key is pressed; without a terminal, not at all (a script that asks is told where to look)."""
    from dualbrain.visualization.robot.viewer import BodyView

    shapes, why = _shapes(folder)
    if why:
        print(f"dualbrain: spheres only: {why}", file=sys.stderr)
    view = BodyView(body, shapes, port)
    try:
        print(f"Look at {view.url}", flush=True)
        if sys.stdin.isatty():
            input("Enter ends it. ")
    finally:
        view.close()


def _shapes(folder: Path) -> tuple[dict[str, Mesh], str]:
    """The shapes that the spheres were fitted to, and why there are none."""
    from dualbrain.cli.robot.read_description import read_description
    from dualbrain.errors import DualbrainError
    from dualbrain.robots.importer.output.robot_folder import read_report, sha256
    from dualbrain.robots.importer.output.source_meshes import shapes_of

    _, recipe = read_report(folder) if folder.is_dir() else (None, None)
    if recipe is None:
        return {}, "no description beside this robot"
    file = Path(recipe.description)
    if not file.is_file() or sha256(file) != recipe.sha256:
        return {}, f"{file} is gone or has changed since"
    try:
        tree = read_description(file, [Path(path) for path in recipe.packages])
        return shapes_of(tree, recipe), ""
    except DualbrainError as error:
        return {}, str(error)
