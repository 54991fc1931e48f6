"""dualbrain run: words (or a given contract) become safe motion; a run folder, a report and an account remain."""

from __future__ import annotations

import sys
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.common.arguments import parse_fraction
from dualbrain.errors import UsageError
from dualbrain.memory.plasticity.rule import EPSILON

DEFAULT_PLANNER = "qwen2.5-coder-1.5b-instruct"
MAX_TRIES = 5


def run(
    instruction: str = "",
    /,
    *,
    robot: str = "panda",
    scene: str = "0",
    planner: str = DEFAULT_PLANNER,
    filter: Literal["on", "off"] = "on",
    contract: Path | None = None,
    goal: str = "",
    site: Path | None = None,
    headless: bool = False,
    out: Path | None = None,
    ledger: Path | None = None,
    seed: int = 0,
    tries: int = 2,
    port: int = 8080,
    knowledge: Literal["on", "off"] = "off",
    image_memory: Annotated[bool, Parameter(negative="")] = False,
    utility: Annotated[bool, Parameter(negative="")] = False,
    epsilon: float = EPSILON,
    map: str = "",
    live: Annotated[bool, Parameter(negative="")] = False,
    speed: str = "100%",
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Run one instruction on the simulated robot.

    Parameters
    ----------
    instruction
        What to do, in words. May be empty with --contract.
    robot
        Which body: panda, fr3, ur5e, base or mobile_panda.
    scene
        Which world: a number, FAMILY:SEED (bare, tabletop, tall, shelf, forearm, edge, fragile; of a base boxes,
        crossing, aisles; of mobile_panda workroom, busy_workroom) or a scene file.
    planner
        Name from `dualbrain models list`, an adapter (`adapter:ID`, `adapter:champion`, or one that comes with
        dualbrain), or the URL of an OpenAI-compatible server.
    filter
        "off" writes the nominal control unfiltered: for comparison in simulation only.
    contract
        Run this contract file instead of asking a planner; it passes the same gate.
    goal
        What counts as success on truth, as "put THING in DESTINATION", in a room also "go to PLACE"; default: what the
        contract itself says.
    site
        Site file (TOML): planes, keep-out boxes, tool, payload, caps, who may command; see docs/site.md.
    headless
        No live view.
    out
        Run folder; default: a new one in runs/, named after the time.
    ledger
        Memory to use; default in dualbrain's home.
    seed
        Everything random after the scene (perception).
    tries
        How many contracts may be carried out, 1 to 5: after one that failed or was taken over the planner is told why
        (an adapter is not: it draws another answer).
    port
        Where the live view listens, on this machine only.
    eyes
        A picture of the scene, as features, becomes part of what memory compares (needs `efficientnet-lite0`).
    knowledge
        "on" shows the planner up to three passages of your documents that bear on the task (`dualbrain knowledge`); an
        adapter reads none.
    utility
        Afterwards ask the planner again without each memory it was shown, to tell which was of use; answers are kept.
    epsilon
        ε of memory: with more Δ than this even a success lowers the weights of what led to it. Set it for your robot,
        to the median Δ of some successes that were corrected.
    map
        MAP:FRAME, a map among the documents and its frame at the robot's base: its places on the table get names; for a
        base those on the floor, and its regions bound where it drives.
    live
        In real time and two processes: a gatekeeper holds robot, filter and supervisor, and outlives the planner.
    speed
        With --live: the speed stage to begin with, as 10% or 0.1; `dualbrain operate` changes it.
    json
        Print one JSON object on stdout.
    """
    if not instruction.strip() and contract is None:
        raise UsageError(
            "instruction",
            got=instruction,
            allowed="some words, or --contract FILE",
            fix='For example: dualbrain run "put the red cube in the bowl"',
        )
    if not 1 <= tries <= MAX_TRIES:
        raise UsageError("--tries", got=tries, allowed=f"1 to {MAX_TRIES}")
    if not 0.0 <= epsilon < inf:
        raise UsageError("--epsilon", got=epsilon, allowed="a number, 0 or more")
    if live and filter == "off":
        raise UsageError("--filter", got="off", allowed="on, with --live: the gatekeeper cannot do without")
    from dualbrain.cli.run.execution import RunView, default_config, execute_run

    config = replace(
        default_config(instruction, out=out, ledger=ledger),
        robot=robot,
        scene=scene,
        planner=planner,
        guard=filter == "on",
        contract=contract,
        goal=goal,
        seed=seed,
        tries=tries,
        measured=not headless and contract is None,
        consult=knowledge == "on",
        map=map,
        site=site,
        image_memory=image_memory,
        utility=utility,
        epsilon=epsilon,
    )
    view = RunView(
        live_view=not headless,
        keep_open=not headless and sys.stdout.isatty(),
        port=port,
        as_json=json,
        real_time=live,
        speed_stage=parse_fraction(speed),
    )
    return execute_run(config, view)
