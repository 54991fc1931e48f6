"""dualbrain run: run one instruction, or one given contract, on a simulated robot."""

from __future__ import annotations

import sys
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.common.arguments import Port, Seed, parse_fraction
from dualbrain.cli.common.console import StderrConsole, print_message
from dualbrain.cli.common.spinner import Spinner
from dualbrain.errors import UsageError
from dualbrain.memory.plasticity.hebbian_update import EPSILON

MAX_TRIES, DEFAULT_TRIES = 5, 2
"""Number of contracts that may be executed for one instruction: the maximum, and the default of `run` and `demo`."""


def run(
    instruction: str = "",
    /,
    *,
    robot: str = "panda",
    scene: str = "0",
    after: Path | None = None,
    planner: str = "",
    filter: Literal["on", "off"] = "on",
    contract: Path | None = None,
    goal: str = "",
    site: Path | None = None,
    headless: bool = False,
    out: Path | None = None,
    ledger: Path | None = None,
    seed: Seed = 0,
    tries: int = DEFAULT_TRIES,
    port: Port = 8080,
    knowledge: Literal["on", "site", "off"] = "site",
    image_memory: Annotated[bool, Parameter(negative="")] = False,
    reuse_contracts: Annotated[bool, Parameter(negative="")] = False,
    image: Annotated[bool, Parameter(negative="")] = False,
    utility: Annotated[bool, Parameter(negative="")] = False,
    epsilon: float = EPSILON,
    map: str = "",
    live: Annotated[bool, Parameter(negative="")] = False,
    speed: str = "100%",
    target: str = "",
    unrecorded: Annotated[bool, Parameter(negative="")] = False,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Run one instruction on a simulated robot, and write a run folder with recording, episode and report.

    Exit code 0 only if the instruction was carried out, 1 if it was not, 3 if it was declined, 4 after a violation,
    6 if it could not be judged.

    Parameters
    ----------
    instruction
        The task in words (English). Optional with --contract. An instruction with a clause that no contract can express
        (a condition, a loop, a time, a count, an exclusion, a direction) is declined and the clause is named. "stop"
        and its like need no planner, and stop every running gatekeeper of this user; during a run, type them and press
        Enter.
    robot
        panda, fr3, ur5e, base or mobile_panda.
    scene
        A number, FAMILY:SEED (bare, tabletop, tall, shelf, forearm, edge, fragile, sorting; for a base boxes, crossing,
        aisles; for mobile_panda workroom, busy_workroom), or a scene file.
    after
        Folder of an earlier simulated run of this robot: begin where it ended, with its objects, its posture and the
        object in the hand, instead of --scene.
    planner
        A name from `dualbrain models list`, an adapter (`adapter:ID`, `adapter:champion`), a GGUF file, or the URL of
        an OpenAI-compatible server (its key is read from OPENAI_API_KEY). Default: qwen2.5-coder-1.5b-instruct, or a
        packaged planner if that model is not downloaded.
    filter
        "off" sends the nominal control unfiltered, for comparison in simulation only.
    contract
        Contract file (JSON) to run instead of asking a planner; it passes the same gate. The instruction is then a
        label: its clauses are not checked, and the contract is not compared with it.
    goal
        Criterion of success on simulator ground truth: "put OBJECT in DESTINATION", in a room also "go to PLACE".
        Default: the instruction itself; without an instruction the goal that the contract states.
    site
        Site file (TOML): planes, keep-out boxes, tool, payload, caps and permissions; see docs/how-to/site.md.
    headless
        Do not open the live view.
    out
        Run folder. Default: a new folder in runs/, named after the time.
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    seed
        Seed of the perception noise.
    tries
        Number of contracts that may be executed, 1 to 5. After a contract that failed or was taken over, the prompt
        states the reason (an adapter samples another answer instead).
    port
        Port of the live view, on the loopback interface.
    knowledge
        "site" puts up to three passages about the task into the prompt, from documents that you added with
        `dualbrain knowledge add --trust site`; "on" from packaged ones and those of trust `vendor`, too. An adapter
        reads none.
    image_memory
        Compare memories by image features of the scene too (needs `efficientnet-lite0`).
    reuse_contracts
        If a contract for this instruction succeeded in this place (every object where it was) and none of its
        memories failed there, reuse it instead of asking the planner. Gate and filter check it as any other contract.
    image
        Send the image of the simulated camera to the planner, which must be a server with a vision-language model
        (--planner URL). The run folder keeps every image that was sent. Not with --live, --contract or --utility.
    utility
        After the run, ask the planner again without each retrieved memory, to measure which memory changed its answer;
        the answers are cached.
    epsilon
        Intervention threshold ε: a successful episode with Δ > ε lowers the weights of the memories it used. Set it to
        the median Δ of pilot successes of your robot.
    map
        MAP:FRAME, a map among the documents and its frame at the robot's base: adds its named places on the table to
        the scene; for a base its places on the floor and the regions in which it may drive.
    live
        Run in real time in two processes: a gatekeeper owns robot, filter and supervisor, and survives the planner.
    speed
        With --live: initial speed scale, as 10% or 0.1; `dualbrain operate` changes it.
    target
        Run the filter and a second supervisor as firmware on an emulated microcontroller, in lockstep with the
        simulation: an386 (Cortex-M4F), an500 (Cortex-M7) or an505 (Cortex-M33). Every step is compared with the host's,
        bit by bit. Needs `pip install "dualbrain[target]"` and qemu-system-arm. Not with --live or --filter off.
    unrecorded
        Move on if the recording cannot be written (disk full). Without this option the arm then comes to rest, and a
        run does not start without reserved space on the disk.
    json
        Print one JSON object on stdout.
    """
    if not instruction.strip() and contract is None:
        raise UsageError(
            "instruction",
            got=instruction,
            allowed="an instruction in words, or --contract FILE",
            fix='For example: dualbrain run "put the red cube in the bowl"',
        )
    if not 1 <= tries <= MAX_TRIES:
        raise UsageError("--tries", got=tries, allowed=f"1 to {MAX_TRIES}")
    if not 0.0 <= epsilon < inf:
        raise UsageError("--epsilon", got=epsilon, allowed="a finite number, at least 0")
    if live and filter == "off":
        raise UsageError("--filter", got="off", allowed="on (a gatekeeper always filters)")
    if target:
        _require_target_conditions(target, live=live, guard=filter == "on")
    if image:
        _require_image_conditions({"--live": live, "--contract": contract is not None, "--utility": utility})
    speed_scale = parse_fraction(speed)
    if speed_scale != 1.0 and not live:
        raise UsageError.stating(
            "--speed scales only a run in real time behind a gatekeeper.", fix="Add --live, or leave out --speed."
        )
    if contract is None and (code := _stop_running_robots(instruction)) is not None:
        return code
    with Spinner(StderrConsole(), "loading") as loading:
        from dualbrain.cli.run.execution import RunView, execute_run
        from dualbrain.runtime.config import default_config

        config = replace(
            default_config(instruction, out=out, ledger=ledger),
            robot=robot,
            scene=scene,
            after=after,
            planner=planner,
            guard=filter == "on",
            contract=contract,
            goal=goal,
            seed=seed,
            tries=tries,
            measured=not headless and contract is None,
            consult=knowledge,
            map=map,
            site=site,
            image_memory=image_memory,
            reuse_contracts=reuse_contracts,
            image=image,
            utility=utility,
            epsilon=epsilon,
            unrecorded=unrecorded,
            target=target,
        )
        view = RunView(
            live_view=not headless,
            keep_open=not headless and sys.stdout.isatty(),
            port=port,
            as_json=json,
            real_time=live,
            speed_scale=speed_scale,
        )
        return execute_run(config, view, loading)


def _require_target_conditions(target: str, *, live: bool, guard: bool) -> None:
    """Raise `UsageError` if the safety layer cannot run on the emulated board `target`."""
    from dualbrain.safety.target.boards import BOARDS

    if target not in BOARDS:
        raise UsageError("--target", got=target, allowed=f"one of {', '.join(BOARDS)}")
    if live or not guard:
        option = "--live" if live else "--filter off"
        reason = "a gatekeeper runs its own filter" if live else "the filter is what runs there"
        raise UsageError.stating(f"--target is impossible with {option}: {reason}.", fix=f"Leave out {option}.")


def _require_image_conditions(excluded: dict[str, bool]) -> None:
    """Raise `UsageError` if an option of `excluded` is given together with --image."""
    reasons = {
        "--live": "the robot of a gatekeeper has no camera for the planner",
        "--contract": "no planner is asked",
        "--utility": "the answers that it compares would be given without the image",
    }
    for option in (name for name, given in excluded.items() if given):
        raise UsageError.stating(
            f"--image is impossible with {option}: {reasons[option]}.", fix=f"Leave out --image or {option}."
        )


def _stop_running_robots(instruction: str) -> int | None:
    """Stop every running gatekeeper if `instruction` is a stop command; None without one, and without a gatekeeper."""
    from dualbrain.grounding.instruction.stop_commands import is_stop_command

    if not is_stop_command(instruction):
        return None
    from dualbrain.cli.common.exit_codes import ExitCode
    from dualbrain.cli.run.stop_command import stop_running_robots
    from dualbrain.core.paths import dualbrain_home

    lines = stop_running_robots(dualbrain_home())
    for line in lines:
        print_message(line)
    if not lines:
        return None
    return ExitCode.SETUP if any("not stopped" in line for line in lines) else ExitCode.SUCCESS
