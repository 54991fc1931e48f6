"""A double integrator in front of a wall: the barrier of order two compared with its closed form.

Run: `python examples/control_affine/double_integrator.py`. Needs `pip install 'dualbrain[symbolic]'`.

p̈ = u, h = p ≥ 0. The filter returns u = max(u_nom, −(α₁+α₂) ṗ − α₁α₂ p) up to rounding. Under a constant push at the
wall, p follows a sum of two exponentials and never passes the wall; without the filter it does.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from dualbrain.safety.control_affine import Barrier, ControlAffine, ControlAffineFilter

A1, A2, PUSH, DT = 1.0, 4.0, -50.0, 2e-3  # [1/s], [1/s], [m/s²], [s]

x = ca.SX.sym("x", 2)  # position [m], speed [m/s]
CART = ControlAffine(x, f=[x[1], 0], g=[0, 1])
WALL = Barrier(name="wall", h=x[0], alphas=(A1, A2))


def closed_form(p: float, v: float, u_nom: float) -> float:
    """The solution of the QP with one row: the nominal control, or the bound of the row."""
    return max(u_nom, -(A1 + A2) * v - A1 * A2 * p)


def trajectory(p: float, v: float, t: float) -> float:
    """Position at time t on p̈ + (α₁+α₂) ṗ + α₁α₂ p = 0, the equation that the active row imposes."""
    c1, c2 = (A2 * p + v) / (A2 - A1), (A1 * p + v) / (A1 - A2)
    return c1 * np.exp(-A1 * t) + c2 * np.exp(-A2 * t)


def main() -> None:
    """Print the position every second, beside the exact trajectory."""
    safety = ControlAffineFilter(CART, [WALL], domain=(0.0, 1.0))
    p, v, worst = 1.0, 0.0, 0.0
    print(f"relative degree {safety.relative_degrees[0]}")
    for step in range(2001):
        u = safety([p, v], [PUSH]).u[0]
        worst = max(worst, abs(u - closed_form(p, v, PUSH)))
        if step % 500 == 0:
            t = step * DT
            free = 1.0 + 0.5 * PUSH * t * t
            print(f"{t:3.0f} s  p {p:7.5f} m, exact {trajectory(1.0, 0.0, t):7.5f} m, unfiltered {free:6.0f} m")
        p, v = p + DT * v + 0.5 * DT * DT * u, v + DT * u
    print(f"largest difference from the closed form {worst:.1e} m/s²")


if __name__ == "__main__":
    main()
