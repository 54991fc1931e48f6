"""Exit codes of the command line."""

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes; they have the same meaning for every command."""

    SUCCESS = 0
    FAILED_SAFELY = 1
    USAGE = 2
    REJECTED = 3
    VIOLATION = 4
    SETUP = 5
    INTERRUPTED = 130
