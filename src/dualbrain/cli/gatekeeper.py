"""dualbrain gatekeeper: the spinal cord as a process; and dualbrain operate: a person's hand on it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.common.arguments import parse_fraction
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.paths import dualbrain_home

OperatorAction = Literal[
    "pause", "resume", "abort", "takeover", "hand_back", "speed", "estop", "release_estop", "reset", "shut_down"
]


def gatekeeper(
    *,
    robot: str = "panda",
    scene: str = "0",
    socket: Path | None = None,
    keys: Path | None = None,
    speed: str = "100%",
    seed: int = 0,
    record: Path | None = None,
    site: Path | None = None,
    driver: str = "",
    address: str = "",
    commissioned: Path | None = None,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Own a robot and its control tick until told to shut down; contracts come in over the socket.

    The robot is simulated unless a driver is named. Hardware is opened only with a commissioning record that fits it.

    Parameters
    ----------
    robot
        Which body.
    scene
        Which world: a number, FAMILY:SEED or a scene file.
    socket
        Where to listen (mode 0600); default: gatekeeper.sock in dualbrain's home.
    keys
        The file with the keys of planner and operator, made if there is none; default in dualbrain's home.
    speed
        The speed stage to begin with, as 10% or 0.1.
    seed
        Everything random after the scene (perception).
    record
        Write every tick to this MCAP file.
    site
        Site file (TOML): planes, keep-out boxes, tool, payload, caps, who may command; see docs/how-to/site.md.
    driver
        Move a real arm: franka or ur; fake_franka and fake_ur are the makers' interfaces without an arm.
    address
        Where the arm's controller answers.
    commissioned
        The record that `dualbrain robot commission` has sealed.
    json
        At the end, print how punctual the tick was as one JSON object on stdout.
    """
    import msgspec

    from dualbrain.cli.common.console import print_result
    from dualbrain.control.gatekeeper.config import GatekeeperConfig
    from dualbrain.control.gatekeeper.process import run_gatekeeper
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    where, secrets = socket or dualbrain_home() / "gatekeeper.sock", keys or dualbrain_home() / "keys.json"
    plan = GatekeeperConfig(
        robot=robot,
        scene=open_scene(scene, robot),
        socket=str(where),
        keys=str(secrets),
        seed=seed,
        stage=parse_fraction(speed),
        recording=str(record) if record else "",
        site=str(site or ""),
        driver=driver,
        address=address,
        commissioned=str(commissioned or ""),
    )
    said = f"gatekeeper of {robot} at {where}; Ctrl-C to shut down"
    punctuality = run_gatekeeper(plan, lambda: print(said, file=sys.stderr))
    p50, p99, _, worst = (1e3 * value for value in punctuality.interval)
    print(
        f"{punctuality.ticks} ticks: interval {p50:.2f} ms (median), {p99:.2f} (99 %), {worst:.1f} (longest); "
        f"{punctuality.late} late, {punctuality.missed} states missed",
        file=sys.stderr,
    )
    if json:
        print_result(msgspec.json.encode(punctuality).decode())
    return ExitCode.SUCCESS


def operate(
    act: OperatorAction,
    /,
    *,
    speed: str = "100%",
    socket: Path | None = None,
    keys: Path | None = None,
    run: Path | None = None,
) -> int:
    """A person's hand: pause, resume, abort, take over, choose a speed, stop in an emergency, and reset after it.

    Parameters
    ----------
    act
        What to do. An emergency stop needs no key; release_estop, then reset, then resume lead out of it.
    speed
        With `speed`: the stage, as 10% or 0.1.
    socket
        Where the gatekeeper listens; default: gatekeeper.sock in dualbrain's home.
    keys
        The key file; default in dualbrain's home.
    run
        The folder of a `dualbrain run --live`: its gatekeeper is meant.
    """
    import time

    from dualbrain.control.gatekeeper.protocol.authentication import load_or_create_keys
    from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
    from dualbrain.errors import ConfigurationError

    where, secrets = socket or dualbrain_home() / "gatekeeper.sock", keys or dualbrain_home() / "keys.json"
    if run is not None:
        address = run / "gatekeeper.address"
        if not address.exists():
            raise ConfigurationError(
                "run folder", got="no gatekeeper.address", allowed="a live run under way", fix=str(run)
            )
        where, secrets = (Path(line) for line in address.read_text(encoding="utf-8").split())
    free = act == "estop" and not secrets.exists()
    link = GatekeeperClient(where) if free else GatekeeperClient(where, load_or_create_keys(secrets), "operator")
    link.operate(act, parse_fraction(speed))
    time.sleep(0.2)
    beat = link.status
    print(f"{act}: {beat.action} {beat.check}".rstrip() if beat else f"{act}: sent", file=sys.stderr)
    link.close()
    return ExitCode.SUCCESS
