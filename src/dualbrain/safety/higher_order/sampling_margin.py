"""Bounds of the motion of spheres within one control period, and the margin of rows that covers it.

With sorted indices every derivative of a sphere's centre is a product of unit axes and one column of the Jacobian, that
of the joint nearest to the sphere: |∂³c/∂q_i∂q_j∂q_k| ≤ ρ_max(i,j,k), where ρ_j is the lever about joint j. Hence for
|q̇_i| ≤ V_i, |q̈_i| ≤ U_i held constant, T_j = Σ_{i≤j} V_i, S_j = Σ_{i≤j} U_i and differences Δ over j:

    |ċ| ≤ Σ ρ_j V_j,   |c̈| ≤ Σ ρ_j (U_j + Δ(T_j²)),   |c⃛| ≤ Σ ρ_j (3 Δ(S_j T_j) + Δ(T_j³)).
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.safety.higher_order.sphere_kinematics import SphereKinematics, SphereMotion

Array = NDArray[np.float64]


class MotionBounds(msgspec.Struct, frozen=True, eq=False):
    """Bounds over the next period for every sphere (k,), relative to one frame: |ċ|, |c̈|, |c⃛| in SI units.

    `authority` [m/s²] bounds |J q̈|, the effect of the controls, at the start of the period.
    """

    speed: Array
    acceleration: Array
    jerk: Array
    authority: Array


def motion_bounds(
    spheres: SphereKinematics, motion: SphereMotion, v: Array, lower: Array, upper: Array, dt: float
) -> tuple[MotionBounds, ...]:
    """Bounds relative to each frame 0..n, for q̈ in the box [lower, upper] (n,) and a period dt [s].

    Only joints beyond j change the lever about j, each at most by its velocity times its own longest lever.
    """
    U = np.maximum(np.abs(lower), np.abs(upper))
    V = np.maximum(np.abs(v), np.maximum(np.abs(v + dt * lower), np.abs(v + dt * upper)))
    later = spheres.max_levers * V
    growth = later[:, ::-1].cumsum(axis=1)[:, ::-1] - later
    levers = np.minimum(motion.lever_lengths + dt * growth, spheres.max_levers)
    seen = np.arange(spheres.n) >= np.arange(spheres.n + 1)[:, None]
    T, S = np.cumsum(V * seen, axis=1), np.cumsum(U * seen, axis=1)
    speed, acceleration = levers @ (V * seen).T, levers @ (U * seen + _differences(T**2)).T
    jerk = levers @ (3.0 * _differences(S * T) + _differences(T**3)).T
    authority = motion.lever_lengths @ (U * seen).T
    return tuple(
        MotionBounds(*(bound[:, f] for bound in (speed, acceleration, jerk, authority))) for f in range(spheres.n + 1)
    )


def _differences(sums: Array) -> Array:
    steps = sums.copy()
    steps[:, 1:] -= sums[:, :-1]
    return steps


def sampling_margin(bounds: MotionBounds, speed: Array, curvature_radius: Array, alpha_1: Array, dt: float) -> Array:
    """Margin m = dt/2 · M [m/s²] such that ψ̇₁ + α₂ψ₁ ≥ m at the sample implies ψ₁ ≥ 0 over the whole period.

    ψ̇₁ = n'ẇ + κ + α₁ḣ. Over the period n'ẇ falls no faster than |ẅ| + |ṅ||ẇ| with |ṅ| ≤ |w|/d, and ḣ no faster than
    |ẇ| because κ ≥ 0; so M = |ẅ| + |w||ẇ|/d + α₁|ẇ| and, for a constant control and α₂ dt ≤ 1,
    ψ₁(s) ≥ ψ₁ + s ψ̇₁ − s² M/2 ≥ (1 − α₂ s) ψ₁ + s (m − s M/2) ≥ 0.
    `speed` is an upper bound of |w|, `curvature_radius` a lower bound of d.
    """
    return 0.5 * dt * (bounds.jerk + bounds.acceleration * (speed / curvature_radius + alpha_1))


def guaranteed_curvature(kappa: Array, bounds: MotionBounds, speed: Array, curvature_radius: Array, dt: float) -> Array:
    """A lower bound of κ over the whole period: κ − dt/2 |κ̇|, at least zero.

    |κ̇| = |2 w⊥'ẇ/d − 3 (n'w)|w⊥|²/d²| ≤ 2|w||ẇ|/d + 1.16 |w|³/d².
    """
    rate = speed / curvature_radius * (2.0 * bounds.acceleration + 1.16 * speed**2 / curvature_radius)
    return np.maximum(kappa - 0.5 * dt * rate, 0.0)
