"""dualbrain fault: inject one fault into a simulated pick and place, and report the reaction of the supervisor."""

from __future__ import annotations

from typing import Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.common.arguments import Seed
from dualbrain.cli.common.exit_codes import ExitCode

FaultSource = Literal["state", "scene", "clock", "qp", "drive", "planner", "socket", "target"]
FaultKind = Literal["off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
FaultMoment = Literal["closing", "descending", "grasping", "carrying", "lowering", "acknowledgement", "drawn"]


def fault(
    source: FaultSource,
    kind: FaultKind,
    /,
    *,
    moment: FaultMoment = "closing",
    scene: str = "tabletop:1",
    robot: str = "panda",
    seed: Seed = 0,
    target: str = "",
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Inject a fault in simulation. Exit code 0 if the supervisor reacts as specified, 4 if a violation is observed.

    Examples: `dualbrain fault qp stuck --moment carrying`; `dualbrain fault target off --target an500` loses the link
    to an emulated board on which filter and supervisor run.

    Parameters
    ----------
    source
        Faulty component: joint states, perceived scene, clock, QP, drive; planner or socket, behind a gatekeeper; the
        link to a target, with --target.
    kind
        Kind of the fault.
    moment
        Moment of the fault. acknowledgement: between a command and the state that answers it; drawn: drawn by the seed.
    scene
        A scene with a red cube and a blue bowl; for a base a scene with a shelf (boxes:0, crossing:1).
    robot
        The robot.
    seed
        Seed of the fault (and of a drawn moment) and of the perception noise.
    target
        An emulated board on which filter and supervisor run too (an386, an500, an505); not for planner and socket.
    json
        Print the report as one JSON object on stdout.
    """
    import msgspec

    from dualbrain.cli.common.console import print_message, print_result
    from dualbrain.evaluation.fault_injection.faults import Fault, draw_moment
    from dualbrain.evaluation.fault_injection.trial import run_fault_trial

    full = {"acknowledgement": "between write and acknowledgement", "drawn": draw_moment(seed)}
    when = full.get(moment, moment)
    report = run_fault_trial(Fault(source, kind, when, seed), robot=robot, scene=scene, seed=seed, target=target)
    if json:
        print_result(msgspec.json.encode(report).decode())
    struck = "not injected: its moment never came" if report.struck is None else f"injected at {report.struck:.2f} s"
    reaction = f"expected {report.expected}, reached {report.reached} ({', '.join(report.checks) or 'no check'})"
    if report.struck is not None and report.as_declared and report.reached != report.expected:
        reaction += " (at least as strong as expected)"
    print_message(f"{report.fault}: {struck}; {reaction}; {report.outcome}: {report.reason}")
    if (board := report.target) is not None:
        lost = f"; lost: {board.lost}" if board.lost else ""
        different = f"{board.differences} of {board.steps} steps with other bits than the host's"
        print_message(f"board {board.board}: its supervisor reached {board.reached}, {different}{lost}")
    for one in report.unsafe:
        print_message(f"violation {one.kind} at {one.start:.2f} s: {' × '.join(one.bodies)}")
    if not report.safe:
        return ExitCode.VIOLATION
    return ExitCode.SUCCESS if report.as_declared else ExitCode.FAILED_SAFELY
