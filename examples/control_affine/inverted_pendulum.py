"""An inverted pendulum with limited torque whose angle must stay below 0.3 rad while a nominal torque pushes it over.

Run: `python examples/control_affine/inverted_pendulum.py`. Needs `pip install 'dualbrain[symbolic]'`.

|θ| ≤ θ_max is expressed as two barriers of relative degree two. The nominal torque pushes to alternating sides: with
the filter the angle stays within the limit on both sides, without it the pendulum falls.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from dualbrain.safety.control_affine import Barrier, ControlAffine, ControlAffineFilter

MASS, LENGTH, GRAVITY, TORQUE = 2.0, 1.0, 10.0, 20.0  # [kg], [m], [m/s²], [Nm]
MAX_ANGLE, A1, A2, DT = 0.3, 3.0, 6.0, 2e-3  # [rad], [1/s], [1/s], [s]

x = ca.SX.sym("x", 2)  # angle [rad], rate [rad/s]
INERTIA = MASS * LENGTH**2
PENDULUM = ControlAffine(x, f=[x[1], GRAVITY / LENGTH * ca.sin(x[0])], g=[0, 1.0 / INERTIA])
# The margin covers half a period of a row rate that changes by up to 100 rad/s³.
SIDES = [
    Barrier(name="right", h=MAX_ANGLE - x[0], alphas=(A1, A2), margin=0.1),
    Barrier(name="left", h=MAX_ANGLE + x[0], alphas=(A1, A2), margin=0.1),
]


def swing(safety: ControlAffineFilter | None) -> float:
    """The largest angle [rad] in eight seconds of pushes that change sides every two seconds."""
    angle, rate, largest = 0.0, 0.0, 0.0
    for step in range(4000):
        u = TORQUE if step // 1000 % 2 == 0 else -TORQUE
        if safety is not None:
            u = safety([angle, rate], [u]).u[0]
        rate += DT * (GRAVITY / LENGTH * np.sin(angle) + u / INERTIA)
        angle += DT * rate
        largest = max(largest, abs(angle))
        if largest > np.pi / 2:
            break
    return largest


def main() -> None:
    """Run with and without the filter."""
    safety = ControlAffineFilter(PENDULUM, SIDES, -TORQUE, TORQUE)
    result = safety([0.28, 0.02], [TORQUE])
    print(f"relative degrees {safety.relative_degrees}; at 0.28 rad: u {result.u[0]:.2f} Nm, {result.explain()}")
    print(f"with the filter: largest angle {swing(safety):.3f} rad, limit {MAX_ANGLE} rad")
    print(f"without the filter: {'falls' if swing(None) > np.pi / 2 else 'does not fall'}")


if __name__ == "__main__":
    main()
