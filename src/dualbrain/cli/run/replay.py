"""dualbrain replay: compute a recorded run again and compare bit for bit."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.console import print_result
from dualbrain.cli.common.exit_codes import ExitCode


def replay(recording: Path, /, *, json: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Recompute every control of a recording from its recorded inputs; exit 0 only if all are identical.

    Parameters
    ----------
    recording
        RUN/episode.mcap
    json
        Print one JSON object on stdout.
    """
    from dualbrain.control.recording.replay import replay as compute_again

    result = compute_again(recording)
    if json:
        print_result(msgspec.json.encode({"identical": result.identical, **msgspec.to_builtins(result)}).decode())
    word = "identical, bit for bit" if result.identical else f"{result.differing} differ, first at tick {result.first}"
    print(f"{recording.name}: {result.ticks} controls computed again: {word}", file=sys.stderr)
    if not result.complete:
        print(f"the recording is not complete: {result.problem or 'messages were lost'}", file=sys.stderr)
    return ExitCode.SUCCESS if result.identical else ExitCode.FAILED_SAFELY
