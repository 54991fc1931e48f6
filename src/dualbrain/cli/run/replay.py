"""dualbrain replay: recompute a recorded run and compare it bit for bit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.console import StderrConsole, print_message, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.spinner import Spinner
from dualbrain.errors import ConfigurationError


def replay(recording: Path, /, *, json: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Recompute every control of a recording from its recorded inputs. Exit code 0 only if all are identical.

    Parameters
    ----------
    recording
        The recording: RUN/episode.mcap.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.control.recording.replay import replay as recompute

    if recording.is_dir():
        fix = f"Replay its recording: dualbrain replay {recording / 'episode.mcap'}"
        raise ConfigurationError.stating(f"{recording} is a folder.", fix=fix)
    if not recording.exists():
        fix = "Name the file episode.mcap in the folder of a run."
        raise ConfigurationError.stating(f"There is no recording {recording}.", fix=fix)
    with Spinner(StderrConsole(), f"recomputing {recording.name}"):
        result = recompute(recording)
    if json:
        print_result(msgspec.json.encode({"identical": result.identical, **msgspec.to_builtins(result)}).decode())
    if result.identical:
        comparison = "identical, bit for bit"
    elif result.differing:
        comparison = f"{result.differing} differ, first at tick {result.first}"
    else:
        comparison = "the recording has none to compare"
    print_message(f"{recording.name}: {result.ticks} controls recomputed: {comparison}")
    if not result.complete:
        print_message(f"The recording is incomplete: {result.problem or 'messages were lost'}.")
    return ExitCode.SUCCESS if result.identical else ExitCode.FAILED_SAFELY
