"""Options of the commands that open a robot for agents."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from dualbrain.cli.common.arguments import Seed, parse_fraction

if TYPE_CHECKING:
    from dualbrain.agent_api.robot import Robot


@Parameter(name="*")
@dataclass(frozen=True, slots=True, kw_only=True)
class RobotOptions:
    """The robot of a command."""

    robot: str = ""
    """The robot. Default: panda, or the robot of the running gatekeeper."""

    scene: str = "0"
    """Scene of the simulated robot: a number, FAMILY:SEED or a scene file."""

    seed: Seed = 0
    """Seed of the perception noise."""

    speed: str = "100%"
    """Initial speed scale of the simulated robot, as 10% or 0.1."""

    site: Path | None = None
    """Site file (TOML) with the limits of the site, as for `dualbrain gatekeeper`."""

    socket: Path | None = None
    """Socket of a running gatekeeper, which is commanded in place of a simulated robot."""

    keys: Path | None = None
    """Key folder of that gatekeeper, of which planner.key is read. Default: keys in the data folder."""

    planner: str = ""
    """A planner, as for `dualbrain run`, that adds the tool `do`, which carries out an instruction in words."""

    ledger: Path | None = None
    """Memory file in which episodes are stored under the name of their client. Default: none are stored."""

    runs: Path | None = None
    """Folder in which each contract gets a folder with its episode and its report. Default: none are saved."""


DEFAULT_ROBOT = RobotOptions()


def open_robot(options: RobotOptions) -> Robot:
    """The robot of the options, simulated or behind a running gatekeeper."""
    from dualbrain.agent_api.robot import Robot
    from dualbrain.errors import UsageError

    planner = options.planner or None
    if options.socket is None:
        if options.keys is not None:
            raise UsageError.stating("--keys belongs to a running gatekeeper.", fix="Name its --socket, too.")
        return Robot.simulated(
            options.robot or "panda",
            options.scene,
            seed=options.seed,
            speed=parse_fraction(options.speed),
            site=options.site,
            planner=planner,
            ledger=options.ledger,
            runs=options.runs,
        )
    _refuse_simulation_options(options)
    return Robot.connect(
        options.socket,
        options.keys,
        robot=options.robot,
        site=options.site,
        planner=planner,
        ledger=options.ledger,
        runs=options.runs,
    )


def _refuse_simulation_options(options: RobotOptions) -> None:
    """Raise `UsageError` for an option that a running gatekeeper would ignore."""
    from dualbrain.errors import UsageError

    ignored = [name for name in ("scene", "seed", "speed") if getattr(options, name) != getattr(DEFAULT_ROBOT, name)]
    if ignored:
        fix = "The operator sets the speed: dualbrain operate speed --speed 25%" if ignored == ["speed"] else ""
        raise UsageError.stating(
            f"--{ignored[0]} belongs to a simulated robot, and --socket to a running gatekeeper.",
            fix=fix or f"Remove --{ignored[0]}.",
        )
