"""Exit codes of the command line."""

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes; they have the same meaning for every command.

    A run ends with SUCCESS only if the instruction was carried out: by ground truth of a simulation where it can judge
    the instruction, else by the independent senses of the robot. NOT_JUDGED: the contract ended as planned, but neither
    could decide whether that is the request.
    """

    SUCCESS = 0
    FAILED_SAFELY = 1
    USAGE = 2
    REJECTED = 3
    VIOLATION = 4
    SETUP = 5
    NOT_JUDGED = 6
    INTERRUPTED = 130
