"""An inverted pendulum that may not lean more than 0.3 rad, pushed to fall; torque is limited.

Run: `python examples/08_inverted_pendulum.py`. Needs `pip install 'dualbrain[symbolic]'`.

See: |θ| ≤ θ_max as two barriers of relative degree two. The nominal torque pushes to one side, then to the other: with
the filter the lean stops short of the limit on either side, without it the pendulum falls.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from dualbrain.safety.control_affine import Barrier, ControlAffine, ControlAffineFilter

MASS, LENGTH, GRAVITY, TORQUE = 2.0, 1.0, 10.0, 20.0  # [kg], [m], [m/s²], [Nm]
LEAN, A1, A2, DT = 0.3, 3.0, 6.0, 2e-3  # [rad], [1/s], [1/s], [s]

x = ca.SX.sym("x", 2)  # lean [rad], its rate [rad/s]
INERTIA = MASS * LENGTH**2
PENDULUM = ControlAffine(x, f=[x[1], GRAVITY / LENGTH * ca.sin(x[0])], g=[0, 1.0 / INERTIA])
# The rate of the row may change by 100 rad/s³: half a period of that is kept as margin.
SIDES = [
    Barrier(name="right", h=LEAN - x[0], alphas=(A1, A2), margin=0.1),
    Barrier(name="left", h=LEAN + x[0], alphas=(A1, A2), margin=0.1),
]


def swing(safety: ControlAffineFilter | None) -> float:
    """Eight seconds of pushes that change sides every two: the largest lean [rad]."""
    lean, rate, most = 0.0, 0.0, 0.0
    for step in range(4000):
        u = TORQUE if step // 1000 % 2 == 0 else -TORQUE
        if safety is not None:
            u = safety([lean, rate], [u]).u[0]
        rate += DT * (GRAVITY / LENGTH * np.sin(lean) + u / INERTIA)
        lean += DT * rate
        most = max(most, abs(lean))
        if most > np.pi / 2:
            break
    return most


def main() -> None:
    """Pushed with and without the filter."""
    safety = ControlAffineFilter(PENDULUM, SIDES, -TORQUE, TORQUE)
    answer = safety([0.28, 0.02], [TORQUE])
    print(f"relative degrees {safety.relative_degrees}; at 0.28 rad: u {answer.u[0]:.2f} Nm, {answer.explain()}")
    print(f"with the filter: leans {swing(safety):.3f} rad of {LEAN} rad at most")
    print(f"without: {'falls' if swing(None) > np.pi / 2 else 'stands'}")


if __name__ == "__main__":
    main()
