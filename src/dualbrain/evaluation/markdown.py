"""Tables as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dualbrain.evaluation.grids import Grid


def grid_lines(grid: Grid) -> list[str]:
    """One table under its title."""
    lines = [f"## {grid.title}", ""]
    if grid.note:
        lines += [f"{grid.note[0].upper()}{grid.note[1:]}.", ""]
    if not grid.rows:
        return [*lines, "None.", ""]
    for head, rows in grid.parts():
        lines += [_line(head), _line(["---"] * len(head)), *map(_line, rows), ""]
    return lines


def page(title: str, about: Sequence[str], grids: Iterable[Grid]) -> str:
    """A whole page."""
    lines = [f"# {title}", "", *(f"{line}  " for line in about), ""]
    for grid in grids:
        lines += grid_lines(grid)
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"
