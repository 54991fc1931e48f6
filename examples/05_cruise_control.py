"""Adaptive cruise control: keep 1.8 s of headway behind a slower car (Ames et al., CDC 2014), with limited brakes.

Run: `python examples/05_cruise_control.py`. Needs `pip install 'dualbrain[symbolic]'`.

See: without a filter the gap is eaten up. The plain headway D − 1.8 v keeps nothing once the brakes are too weak for it
(RELAXED); with the distance that braking needs in the barrier, the headway holds.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.control_affine import Barrier, ControlAffine, ControlAffineFilter

MASS, BRAKE = 1650.0, 0.3 * 9.81  # [kg], hardest braking and acceleration [m/s²]
HEADWAY, WISH, LEAD = 1.8, 24.0, 14.0  # [s], wanted speed and the other car's [m/s]

x = ca.SX.sym("x", 3)  # own speed v, the other car's speed [m/s], distance D [m]
v, lead, D = x[0], x[1], x[2]
drag = 0.1 + 5.0 * v + 0.25 * v**2  # [N]
CAR = ControlAffine(x, f=[-drag / MASS, 0.0, lead - v], g=[1.0 / MASS, 0.0, 0.0])  # u is the wheels' force [N]

PLAIN = Barrier(name="headway", h=D - HEADWAY * v, alphas=5.0)
BRAKING_DISTANCE = 0.5 * ca.fmax(v - lead, 0.0) ** 2 / BRAKE
BRAKING = Barrier(name="headway with braking", h=D - HEADWAY * v - BRAKING_DISTANCE, alphas=5.0, margin=0.5)
FASTER = ([15.0, 0.0, 10.0], [30.0, 14.0, 200.0])  # states between which the own car is the faster one


def cruise(barrier: Barrier | None) -> tuple[float, str]:
    """Approach for 60 s at 20 Hz: the least D − 1.8 v [m], and what the filter had to say at its worst."""
    limit = BRAKE * MASS
    safety = (
        None if barrier is None else ControlAffineFilter(CAR, [barrier], -limit, limit, fallback=-limit, domain=FASTER)
    )
    speed, distance, least, worst, said = 20.0, 100.0, np.inf, FilterStatus.SAFE, "nobody asked"
    for _ in range(1200):
        u = np.clip(5.0 * MASS * (WISH - speed), -limit, limit)
        if safety is not None:
            answer = safety([speed, LEAD, distance], [u])
            u = answer.u[0]
            if answer.status >= worst:
                worst, said = answer.status, answer.explain()
        change = (u - 0.1 - 5.0 * speed - 0.25 * speed**2) / MASS
        distance += 0.05 * (LEAD - speed) - 0.5 * 0.05**2 * change
        speed += 0.05 * change
        least = min(least, distance - HEADWAY * speed)
    return least, said


def main() -> None:
    """No filter, a barrier that forgets the brakes, and one that knows them."""
    for name, barrier in (("no filter", None), ("headway", PLAIN), ("headway with braking", BRAKING)):
        least, said = cruise(barrier)
        print(f"{name:>20}: least D - 1.8 v {least:8.3f} m  ({said})")


if __name__ == "__main__":
    main()
