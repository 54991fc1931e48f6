"""Adaptive cruise control: keep 1.8 s of headway behind a slower car (Ames et al., CDC 2014), with limited brakes.

Run: `python examples/control_affine/cruise_control.py`. Needs `pip install 'dualbrain[symbolic]'`.

Without a filter the headway is lost. The plain barrier D − 1.8 v becomes infeasible when the brakes are too weak for it
(RELAXED). With the braking distance in the barrier, the headway is kept.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from dualbrain import FilterStatus
from dualbrain.safety.control_affine import Barrier, ControlAffine, ControlAffineFilter

MASS, BRAKE = 1650.0, 0.3 * 9.81  # [kg], hardest braking and acceleration [m/s²]
HEADWAY, DESIRED, LEAD = 1.8, 24.0, 14.0  # [s], desired speed and speed of the other car [m/s]

x = ca.SX.sym("x", 3)  # own speed v, the other car's speed [m/s], distance D [m]
v, lead, D = x[0], x[1], x[2]
drag = 0.1 + 5.0 * v + 0.25 * v**2  # [N]
CAR = ControlAffine(x, f=[-drag / MASS, 0.0, lead - v], g=[1.0 / MASS, 0.0, 0.0])  # u is the wheels' force [N]

PLAIN = Barrier(name="headway", h=D - HEADWAY * v, alphas=5.0)
BRAKING_DISTANCE = 0.5 * ca.fmax(v - lead, 0.0) ** 2 / BRAKE
BRAKING = Barrier(name="headway with braking", h=D - HEADWAY * v - BRAKING_DISTANCE, alphas=5.0, margin=0.5)
FASTER = ([15.0, 0.0, 10.0], [30.0, 14.0, 200.0])  # bounds of the states in which the own car is faster


def cruise(barrier: Barrier | None) -> tuple[float, str]:
    """Approach for 60 s at 20 Hz: the smallest D − 1.8 v [m], and the explanation of the worst filter status."""
    limit = BRAKE * MASS
    safety = (
        None if barrier is None else ControlAffineFilter(CAR, [barrier], -limit, limit, fallback=-limit, domain=FASTER)
    )
    speed, distance, least, worst, reason = 20.0, 100.0, np.inf, FilterStatus.SAFE, "not filtered"
    for _ in range(1200):
        u = np.clip(5.0 * MASS * (DESIRED - speed), -limit, limit)
        if safety is not None:
            result = safety([speed, LEAD, distance], [u])
            u = result.u[0]
            if result.status >= worst:
                worst, reason = result.status, result.explain()
        acceleration = (u - 0.1 - 5.0 * speed - 0.25 * speed**2) / MASS
        distance += 0.05 * (LEAD - speed) - 0.5 * 0.05**2 * acceleration
        speed += 0.05 * acceleration
        least = min(least, distance - HEADWAY * speed)
    return least, reason


def main() -> None:
    """Run without a filter, with the plain barrier, and with the barrier that includes the braking distance."""
    for name, barrier in (("no filter", None), ("headway", PLAIN), ("headway with braking", BRAKING)):
        least, reason = cruise(barrier)
        print(f"{name:>20}: least D - 1.8 v {least:8.3f} m  ({reason})")


if __name__ == "__main__":
    main()
