"""dualbrain gatekeeper (filter and supervisor as a process) and dualbrain operate (operator commands to it)."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.common.arguments import Seed, parse_fraction
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.core.paths import dualbrain_home

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
    seed: Seed = 0,
    record: Path | None = None,
    site: Path | None = None,
    driver: str = "",
    address: str = "",
    commissioned: Path | None = None,
    realtime: str = "enforce",
    control_thread: bool | None = None,
    unrecorded: Annotated[bool, Parameter(negative="")] = False,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Control a robot until shut down, and execute the contracts that arrive at a Unix socket.

    It continues when its terminal closes and when its commander ends; `dualbrain doctor` lists it. The robot is
    simulated unless a driver is given. A hardware driver needs a matching commissioning record.

    Parameters
    ----------
    robot
        The robot.
    scene
        A number, FAMILY:SEED or a scene file.
    socket
        Path of the socket (mode 0600). Default: gatekeeper.sock in the data folder of dualbrain.
    keys
        Folder with the key files planner.key and operator.key, created if necessary. Default: keys in the data folder.
    speed
        Initial speed scale, as 10% or 0.1.
    seed
        Seed of the perception noise.
    record
        MCAP file that records every tick.
    site
        Site file (TOML): planes, keep-out boxes, tool, payload, caps and permissions; see docs/how-to/site.md.
    driver
        Hardware driver: franka or ur; fake_franka and fake_ur imitate the vendor interfaces without an arm.
    address
        Network address of the arm's controller.
    commissioned
        Commissioning record, written by `dualbrain robot commission`.
    realtime
        enforce, or ignore to connect from a kernel without PREEMPT_RT (driver franka; for simulators and tests).
    control_thread
        Move the joints from a thread in C, which filters every control again and does not wait for Python. For arms
        with a fixed base. Default: with a driver, not with the simulated robot.
    unrecorded
        Move on if the recording of --record cannot be written (disk full). Without this option the arm then comes to
        rest.
    json
        At the end, print tick timing statistics as one JSON object on stdout.
    """
    import msgspec

    from dualbrain.cli.common.console import print_message, print_result
    from dualbrain.cli.common.running_gatekeepers import STARTED_BY_PERSON
    from dualbrain.cli.common.signals import survive_closed_terminal
    from dualbrain.control.gatekeeper.config import GatekeeperConfig
    from dualbrain.control.gatekeeper.process import run_gatekeeper
    from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, load_keys
    from dualbrain.control.gatekeeper.protocol.registration import REGISTRATIONS
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    survive_closed_terminal()
    where, secrets = socket or dualbrain_home() / "gatekeeper.sock", keys or dualbrain_home() / "keys"
    config = GatekeeperConfig(
        robot=robot,
        scene=open_scene(scene, robot),
        socket=str(where),
        keys=str(secrets),
        seed=seed,
        speed_scale=parse_fraction(speed),
        recording=str(record) if record else "",
        site=str(site or ""),
        driver=driver,
        address=address,
        commissioned=str(commissioned or ""),
        realtime=realtime,
        registrations=str(dualbrain_home() / REGISTRATIONS),
        started_by=STARTED_BY_PERSON,
        unrecorded=unrecorded,
        control_thread=control_thread,
    )
    if notice := load_keys(secrets, PRINCIPALS).notice:
        print_message(notice)
    ready = f"The gatekeeper of {robot} listens at {where}. Ctrl-C shuts it down."
    timing = run_gatekeeper(config, lambda: print_message(ready), on_warning=print_message)
    p50, p99, _, worst = (1e3 * value for value in timing.interval)
    print_message(
        f"{timing.ticks} ticks: interval {p50:.2f} ms (median), {p99:.2f} ms (99 %), {worst:.1f} ms (longest); "
        f"{timing.late} late, {timing.missed} states missed"
    )
    if json:
        print_result(msgspec.json.encode(timing).decode())
    return ExitCode.SUCCESS


def operate(
    act: OperatorAction,
    /,
    *,
    speed: str = "",
    socket: Path | None = None,
    keys: Path | None = None,
    run: Path | None = None,
) -> int:
    """Send an operator command to a running gatekeeper: pause, resume, abort, take over, set the speed, emergency stop.

    Parameters
    ----------
    act
        The command. `estop` reads no key, and without an address stops every running gatekeeper of this user; after
        it, `release_estop`, `reset` and `resume` are needed in this order.
    speed
        With the command `speed`, which requires it: the speed scale, as 10% or 0.1.
    socket
        Path of the gatekeeper's socket. Default: gatekeeper.sock in the data folder of dualbrain, or that of the only
        running gatekeeper.
    keys
        Key folder, of which operator.key is read. Default: that of the running gatekeeper at the socket.
    run
        Run folder of a `dualbrain run --live`, whose gatekeeper gets the command.
    """
    from dualbrain.errors import UsageError

    if act == "speed" and not speed:
        raise UsageError.stating(
            "The command `speed` needs the speed scale.", fix="For example: dualbrain operate speed --speed 25%"
        )
    if speed and act not in ("speed", "estop"):
        raise UsageError.stating(
            f"The command `{act}` changes no speed, so --speed has no effect.",
            fix=f"First `dualbrain operate speed --speed {speed}`, then `dualbrain operate {act}`.",
        )
    if act == "estop":
        return _stop_all() if socket is None and run is None else _stop(socket or run_address(run)[0])
    where, secrets = _command_address(socket, keys, run)
    return _send_command(where, secrets, act, parse_fraction(speed) if speed else 1.0)


def _command_address(socket: Path | None, keys: Path | None, run: Path | None) -> tuple[Path, Path]:
    """Socket and keys as given; a missing one is that of the run, or of a running gatekeeper."""
    if socket is not None and keys is not None:
        return socket, keys
    found = run_address(run) if run is not None else running_address(dualbrain_home(), socket)
    return socket or found[0], keys or found[1]


def running_address(home: Path, socket: Path | None) -> tuple[Path, Path]:
    """Socket and keys of the gatekeeper at `socket`, by default of the one in the data folder `home`.

    If none runs there, of the only one that runs: an agent or a program may have started it. Raises `UsageError` if
    several run elsewhere, because the command is for one robot.
    """
    import shlex

    from dualbrain.cli.common.running_gatekeepers import find_gatekeepers
    from dualbrain.errors import UsageError

    default = socket or home / "gatekeeper.sock", home / "keys"
    if socket is None and default[0].exists():
        return default
    others = [(one.robot, Path(one.socket), Path(one.keys)) for one in find_gatekeepers(home) if one.keys]
    if socket is not None:
        return next((one[1:] for one in others if one[1] == socket.absolute()), default)
    if len(others) > 1:
        names = [
            f"robot {robot}: --socket {shlex.quote(str(socket))} --keys {shlex.quote(str(keys))}"
            for robot, socket, keys in others
        ]
        raise UsageError.stating(
            f"{len(others)} gatekeepers run, and none of them is the one of the data folder.",
            fix="Name one of them. " + "; ".join(names),
        )
    return others[0][1:] if others else default


def run_address(run: Path | None) -> tuple[Path, Path]:
    """Socket and keys of the gatekeeper of a run; raises `ConfigurationError` if the run folder names none."""
    from dualbrain.errors import ConfigurationError

    assert run is not None
    address = run / "gatekeeper.address"
    try:
        socket, *more = address.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise ConfigurationError.stating(
            f"The run folder has no running gatekeeper (no readable file {address.name}).",
            fix=f"Give the folder of a `dualbrain run --live` that is running. {run}",
        ) from error
    return Path(socket), Path(more[0] if more else "")


def _stop_all() -> int:
    """Stop every running gatekeeper of this user at once: one that does not answer delays no other."""
    from dualbrain.cli.common.running_gatekeepers import running_sockets

    stops, default = _SimultaneousStops(), Path()
    with suppress(Exception):  # there may be no home folder
        default = dualbrain_home() / "gatekeeper.sock"
        if default.exists():
            stops.begin(default)
    with suppress(Exception):  # a list of processes that cannot be read must not hide the results so far
        for one in running_sockets(dualbrain_home()):
            stops.begin(one)
    return stops.finish() if stops.results else _stop(default)


class _SimultaneousStops:
    """Emergency stops of several gatekeepers, each in a thread of its own; `results` has the exit code by socket."""

    def __init__(self) -> None:
        self.results: dict[Path, int] = {}
        self._threads: list[threading.Thread] = []

    def begin(self, where: Path) -> None:
        """Send the stop to the gatekeeper at `where`, once."""
        if where in self.results:
            return
        self.results[where] = ExitCode.SETUP
        thread = threading.Thread(target=self._stop, args=(where,), daemon=True)
        try:
            thread.start()
        except RuntimeError:  # the system has no more threads
            self._stop(where)
        else:
            self._threads.append(thread)

    def finish(self) -> int:
        """The worst exit code, once every stop is confirmed or not."""
        for thread in self._threads:
            thread.join()
        return max(self.results.values())

    def _stop(self, where: Path) -> None:
        self.results[where] = _stop(where)


def _stop(where: Path) -> int:
    """Send an emergency stop, which reads no file, and report whether the gatekeeper confirms it."""
    from dualbrain.cli.common.console import print_message
    from dualbrain.control.gatekeeper.protocol.emergency_stop import send_emergency_stop

    problem = send_emergency_stop(where)
    advice = "Use the emergency stop of the robot itself."
    unconfirmed = f"dualbrain: The emergency stop is not confirmed: {problem}. {advice}"
    with suppress(OSError, ValueError, AttributeError):  # stderr may be closed or absent
        print_message(unconfirmed if problem else f"estop: ESTOP, reported by the gatekeeper at {where}")
    return ExitCode.SETUP if problem else ExitCode.SUCCESS


def _send_command(where: Path, secrets: Path, act: OperatorAction, speed_scale: float) -> int:
    """Send a command that needs the operator's key, and print the state of the gatekeeper after it."""
    import time

    from dualbrain.cli.common.console import print_message
    from dualbrain.control.gatekeeper.protocol.authentication import read_keys
    from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient

    link = GatekeeperClient(where, read_keys(secrets, ("operator",)), "operator")
    link.operate(act, speed_scale)
    time.sleep(0.2)
    status = link.status
    link.close()
    print_message(f"{act}: {status.action} {status.check}".rstrip() if status else f"{act}: sent")
    return ExitCode.SUCCESS
