"""A unicycle and a disc: a barrier of relative degree two (Xiao and Belta, CDC 2019), and one on a point ahead.

Run: `python examples/control_affine/unicycle.py`. Needs `pip install 'dualbrain[symbolic]'`.

The turn rate does not enter the first derivative of the distance, so that a barrier of order one can only brake. The
barrier of order two avoids a disc near the path by turn rate and acceleration. The distance of a point ahead of the
axle has relative degree one and steers too.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from dualbrain.safety.control_affine import Barrier, ControlAffine, ControlAffineFilter

CENTRE, RADIUS, AHEAD, DT = np.array([3.0, 0.3]), 0.8, 0.2, 0.01  # [m], [m], [m], [s]

x = ca.SX.sym("x", 4)  # position (2) [m], heading [rad], speed [m/s]
forward = ca.vertcat(ca.cos(x[2]), ca.sin(x[2]))
BY_FORCE = ControlAffine(x, f=[x[3] * forward, 0, 0], g=[[0, 0], [0, 0], [1, 0], [0, 1]])  # u: turn rate, acceleration
DISTANCE = Barrier(name="disc", h=ca.sumsqr(x[:2] - CENTRE) - RADIUS**2, alphas=(1.0, 2.0), margin=0.05)

y = ca.SX.sym("y", 3)  # position (2) [m], heading [rad]
toward = ca.vertcat(ca.cos(y[2]), ca.sin(y[2]))
BY_SPEED = ControlAffine(y, f=[0, 0, 0], g=[[toward[0], 0], [toward[1], 0], [0, 1]])  # u: speed, turn rate
GAP = ca.norm_2(y[:2] + AHEAD * toward - CENTRE) - RADIUS - AHEAD
POINT = Barrier(name="disc ahead", h=GAP, alphas=2.0, margin=0.02)


def drive(safety: ControlAffineFilter | None, *, by_force: bool) -> tuple[float, float, float]:
    """Drive along x for 12 s: smallest distance to the disc, distance covered, largest lateral deviation [m]."""
    position, heading, speed = np.zeros(2), 0.0, 0.0 if by_force else 1.0
    least, lateral = np.inf, 0.0
    for _ in range(1200):
        steer = -heading - 0.5 * position[1]
        state = [*position, heading, speed] if by_force else [*position, heading]
        u = np.array([steer, 2.0 * (1.0 - speed)] if by_force else [1.0, steer])
        if safety is not None:
            u = safety(state, u).u
        turn, speed = (u[0], speed + DT * u[1]) if by_force else (u[1], u[0])
        position = position + DT * speed * np.array([np.cos(heading), np.sin(heading)])
        heading += DT * turn
        least = min(least, float(np.linalg.norm(position - CENTRE)) - RADIUS)
        lateral = max(lateral, abs(position[1]))
    return least, float(position[0]), lateral


def main() -> None:
    """Run without a filter, with the barrier of order two, and with the barrier of the point ahead."""
    gentle = np.diag([0.01, 1.0])  # a turn costs less than braking
    force = ControlAffineFilter(BY_FORCE, [DISTANCE], -2.0, 2.0, weight=gentle, domain=(0.1, 2.0))
    speed = ControlAffineFilter(BY_SPEED, [POINT], [0.0, -2.0], [1.0, 2.0])
    cases = (("no filter", None, True), ("turn rate, acceleration", force, True), ("point ahead", speed, False))
    for name, safety, by_force in cases:
        degree = "-" if safety is None else safety.relative_degrees[0]
        least, distance, lateral = drive(safety, by_force=by_force)
        print(
            f"{name:>24}: relative degree {degree}, smallest gap {least:6.3f} m, distance {distance:5.2f} m, "
            f"lateral {lateral:4.2f} m"
        )


if __name__ == "__main__":
    main()
