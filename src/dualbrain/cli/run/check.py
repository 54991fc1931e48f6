"""dualbrain check: check a contract file with the gate."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.console import print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.contracts.gate.strict_json import MAX_CONTRACT_FILE_BYTES
from dualbrain.core.untrusted.bounded_file import read_bounded_file, read_bounded_stream


def check(
    contract: Annotated[Path, Parameter(allow_leading_hyphen=True)],
    /,
    *,
    robot: str = "panda",
    scene: str = "0",
    instruction: str = "",
    site: Path | None = None,
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
    instruction
        The words that the contract is to carry out: they must not be declined, and they must mention every object and
        place of the contract, as for the contract of a planner.
    site
        Site file (TOML): its limits of the robot and of objects, and its permissions, apply; see docs/how-to/site.md.
    """
    from dualbrain.contracts.verdict import Accepted
    from dualbrain.grounding.offline_gate import check_contract

    if str(contract) == "-":
        data = read_bounded_stream(sys.stdin.buffer, MAX_CONTRACT_FILE_BYTES, "standard input")
    else:
        data = read_bounded_file(contract, MAX_CONTRACT_FILE_BYTES)
    verdict = check_contract(data, robot=robot, scene=scene, instruction=instruction, site=site)
    accepted = isinstance(verdict, Accepted)
    body = {} if accepted else {key: value for key, value in msgspec.to_builtins(verdict).items() if key != "verdict"}
    print_result(msgspec.json.encode({"accepted": accepted, **body}).decode())
    return ExitCode.SUCCESS if accepted else ExitCode.REJECTED
