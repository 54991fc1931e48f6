"""dualbrain fault: break one thing at one moment of a simulated pick and place, and see what the supervisor does."""

from __future__ import annotations

import sys
from typing import Annotated, Literal

from cyclopts import Parameter

from dualbrain.cli.common.exit_codes import ExitCode

FaultSource = Literal["state", "scene", "clock", "qp", "drive", "planner", "socket"]
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
    seed: int = 0,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Inject a fault; simulation only. Exit 0 if the declared order came and nothing unsafe did, 4 if something did.

    Parameters
    ----------
    source
        What breaks: joint states, perceived scene, clock, QP, drive; planner or socket, at a gatekeeper's door.
    kind
        How it breaks.
    moment
        When it strikes; acknowledgement: between a command and the state that answers it; drawn: one of these, by seed.
    scene
        Which world, with a red cube and a blue bowl in it; for a base one with a shelf (boxes:0, crossing:1).
    robot
        Which body.
    seed
        What is random about the fault (its moment, too, if that is drawn), and everything random after the scene.
    json
        Print the report as one JSON object on stdout.
    """
    import msgspec

    from dualbrain.cli.common.console import print_result
    from dualbrain.evaluation.fault_injection.faults import Fault, draw_moment
    from dualbrain.evaluation.fault_injection.trial import run_fault_trial

    full = {"acknowledgement": "between write and acknowledgement", "drawn": draw_moment(seed)}
    when = full.get(moment, moment)
    report = run_fault_trial(Fault(source, kind, when, seed), robot=robot, scene=scene, seed=seed)
    if json:
        print_result(msgspec.json.encode(report).decode())
    struck = "its moment never came" if report.struck is None else f"struck at {report.struck:.2f} s"
    said = f"expected {report.expected}, reached {report.reached} ({', '.join(report.checks) or 'no check'})"
    print(f"{report.fault}: {struck}; {said}; {report.outcome}: {report.reason}", file=sys.stderr)
    for one in report.unsafe:
        print(f"violation {one.kind} at {one.start:.2f} s: {' × '.join(one.bodies)}", file=sys.stderr)
    if not report.safe:
        return ExitCode.VIOLATION
    return ExitCode.SUCCESS if report.as_declared else ExitCode.FAILED_SAFELY
