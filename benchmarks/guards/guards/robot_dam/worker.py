"""robot-dam's motion limits in its own environment: one JSON request a line on stdin, one safe target a line on stdout.

The rows and the program are robot-dam's own functions, put together as its callbacks do (`joint_position_limits`,
`joint_velocity_limit`, `workspace`, `keep_out_zone`) with its default gains. Its `Guardrail` is not used because it
takes the period from the wall clock, and a simulation is faster or slower than that.
"""

import json
import sys

import numpy as np
from dam.runtime import qp_solver


def main() -> None:
    """Answer requests until the end of the input; the first line is the configuration."""
    if not qp_solver.available():
        sys.exit("proxsuite is missing")
    setup = {name: np.array(value, float) for name, value in json.loads(sys.stdin.readline()).items()}
    print("ready", flush=True)
    for line in sys.stdin:
        request = {name: np.array(value, float) for name, value in json.loads(line).items()}
        print(json.dumps(safe_target(setup, **request).tolist()), flush=True)


def safe_target(setup, action, q, position, jacobian):
    """The target of robot-dam for `action` [rad] at q, with the `position` and `jacobian` (3, n) of the tool."""
    dt = float(setup["period"])
    common = {"q": q, "ee_pos": position, "J_linear": jacobian, "dt": dt}
    rows = [qp_solver.workspace_cbf_constraints(bounds=setup["workspace"], **common)]
    if len(setup["spheres"]):
        rows.append(qp_solver.sphere_keepout_constraints(spheres=setup["spheres"].tolist(), **common))
    span = setup["v_max"] * dt
    found = qp_solver.solve_box_with_slack(
        action,
        upper=setup["upper"],
        lower=setup["lower"],
        vel_upper=q + span,
        vel_lower=q - span,
        extra_A=np.vstack([a for a, _ in rows]),
        extra_ub=np.concatenate([b for _, b in rows]),
    )
    return q if found is None else found  # without a solution robot-dam holds the measured posture


if __name__ == "__main__":
    main()
