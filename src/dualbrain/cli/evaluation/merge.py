"""dualbrain evaluate --merge: join the parts of an evaluation, and name those that are missing or not finished."""

from __future__ import annotations

import time
from pathlib import Path

import msgspec

from dualbrain.cli.common.console import StderrConsole, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.evaluation.results import resume_command, write_table


def merge_results(folder: Path, console: StderrConsole, *, as_json: bool) -> int:
    """Merge the parts in `folder` and write its table; FAILED_SAFELY if episodes are missing."""
    from dualbrain.evaluation.results.parquet import RESULTS_FILE
    from dualbrain.evaluation.runner.parts.merge import merge_parts
    from dualbrain.evaluation.runner.runner import Runner

    report = merge_parts(folder)
    runner = Runner(report.suite, folder, clock=time.monotonic, on_progress=lambda progress: None)
    n_rows = write_table(runner)
    left = {part: count for part, count in report.unfinished.items() if count}
    for part, count in left.items():
        command = resume_command(report.suite, folder, str(part))
        console.print(f"part {part}: {count} episodes left; run it with: {command}", markup=False, soft_wrap=True)
    where = f"{n_rows} episodes in {folder / RESULTS_FILE}" if n_rows else "no episode is finished"
    following = "then merge again" if left else f"make the report with: dualbrain report {folder}"
    console.print(f"{where}; {following}", markup=False, soft_wrap=True)
    if as_json:
        merged = {"out": str(folder), "episodes": n_rows, "whole": not left, "left": [str(one) for one in left]}
        print_result(msgspec.json.encode(merged).decode())
    return ExitCode.FAILED_SAFELY if left else ExitCode.SUCCESS
