"""dualbrain check: check a contract file with the gate."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.console import print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.errors import ConfigurationError


def check(
    contract: Annotated[Path, Parameter(allow_leading_hyphen=True)],
    /,
    *,
    robot: str = "panda",
    scene: str = "0",
) -> int:
    """Check a contract file against a robot's skills and a scene, and print the verdict as one JSON object.

    The verdict has `accepted`, and for a rejection `stage` (syntax, authorization or envelope), `pointer`, `got`,
    `allowed` and `hint`. Exit code 0 when accepted, 3 when rejected.

    Parameters
    ----------
    contract
        Contract file (JSON), or - for standard input.
    robot
        The robot: panda, fr3, ur5e, base, mobile_panda, or the folder of a robot model.
    scene
        The scene: a number, FAMILY:SEED or a scene file.
    """
    from dualbrain.contracts.verdict import Accepted
    from dualbrain.grounding.offline_gate import check_contract

    try:
        data = sys.stdin.buffer.read() if str(contract) == "-" else contract.read_bytes()
    except OSError as error:
        raise ConfigurationError.stating(
            f"The contract file could not be read: {error.strerror}.", fix=str(contract)
        ) from error
    verdict = check_contract(data, robot=robot, scene=scene)
    accepted = isinstance(verdict, Accepted)
    body = {} if accepted else {key: value for key, value in msgspec.to_builtins(verdict).items() if key != "verdict"}
    print_result(msgspec.json.encode({"accepted": accepted, **body}).decode())
    return ExitCode.SUCCESS if accepted else ExitCode.REJECTED
