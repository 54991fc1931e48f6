"""Reference of the relaxation and the certificate in numpy, from their definitions.

If no control satisfies all rows, the hardest braking is the reference. No pair is violated more than by braking,
and the violation is minimal rank by rank, first as if all obstacles were static, then with their motion.
"""

from dataclasses import replace

import numpy as np

from tests.safety.kernel_step.reference_active_set import ReferenceQP
from tests.safety.kernel_step.reference_rows import OBSTACLE, USER, ReferenceRows

VIOLATION_TOLERANCE, MIN_REPORTED_VIOLATION, SLACK_WEIGHT, STOP_SHARE = 4e-10, 1e-4, 1e-3, 0.05
"""Tolerance [rad/s] and reported violation [m/s]; weight of the slack; share of the box for stopping."""
UNCONSTRAINED = -1e9


def braking_control(model, u_prev):
    """The control at which all joints slow down by one factor, one of them at its full deceleration."""
    step = model["a_max"] * model["period"]
    keep = max(0.0, *(1.0 - step / np.maximum(np.abs(u_prev), step)))
    return keep * u_prev


class ReferenceRelaxation(ReferenceRows):
    """Reference of the relaxation for rows `names`, in their order."""

    @property
    def brake_target(self):
        return np.clip(braking_control(self.model, self.case.u_prev), self.low, self.high)

    def passive_bound(self, name, want, change):
        """Bound for the robot alone: no approach faster than the row permits, nor than it can stop from."""
        _, b, h, norm, *_ = self.rows[name]
        t = self.obstacles[name[2]]
        drift = t.distance(self.centre[name[1]])[1] @ t.velocity + t.velocity_error
        if h <= 0.0:
            return min(want, 0.0)
        static_bound = b - drift / norm
        if drift <= 0.0:
            return min(want, static_bound)
        return min(want, max(static_bound, -STOP_SHARE * change * h / (drift * self.model["period"])))

    def solve_relaxation(self, names):
        """(u, bits of the relaxed ranks); None if a control satisfies all rows, or if rounding decides."""
        A, b = np.array([self.rows[name][0] for name in names]), np.array([self.rows[name][1] for name in names])
        if ReferenceQP(self.model["scale"], A, b, b, self.low, self.high, self.case.u_nom, slack=False).solve() == 0:
            return None
        A = np.array([self.rows[name][0] for name in names])
        best, worst = (pick(A * self.low, A * self.high).sum(axis=1) for pick in (np.maximum, np.minimum))
        norm, brake = np.array([self.rows[name][3] for name in names]), self.brake_target
        want = np.minimum([self.rows[name][1] for name in names], best)
        moving = np.array([self.rows[name][5] > 0.0 for name in names])
        rank = np.array([self.rows[name][6] for name in names])
        passive = np.array(
            [
                self.passive_bound(name, want[r], 0.5 * (best - worst)[r]) if moving[r] else want[r]
                for r, name in enumerate(names)
            ]
        )
        floor = np.where(rank <= 2, np.minimum(passive, A @ brake - VIOLATION_TOLERANCE), UNCONSTRAINED)
        rank = np.where((rank <= 2) & (A @ brake >= want), 0, rank)
        soft, u, relaxed_mask = np.minimum(1.0, SLACK_WEIGHT / norm), brake, 0
        for level in range(1, int(rank.max(initial=0)) + 1):
            mine = rank == level
            for target in ([passive] if np.any(moving & mine) else []) + [want]:
                if not np.any(mine):
                    continue
                p = ReferenceQP(
                    self.model["scale"],
                    np.vstack([A, A[mine]]),
                    np.concatenate([floor, target[mine]]),
                    np.concatenate([np.zeros(len(A)), soft[mine]]),
                    self.low,
                    self.high,
                    brake,
                    slack=True,
                )
                if p.solve():
                    return None
                slack, u = max(p.slack, 0.0), np.clip(p.u, self.low, self.high)
                floor = np.where(mine, np.maximum(floor, target - soft * slack - VIOLATION_TOLERANCE), floor)
            relaxed_mask |= (1 << level) * bool(np.any(mine) and slack * SLACK_WEIGHT > MIN_REPORTED_VIOLATION)
        return u, relaxed_mask

    # --- the next step --------------------------------------------------------------------------------------------

    def true_h(self):
        """(kind, i, j) -> h of every pair that must keep apart, with the margins of the certificate."""
        out, m = {}, self.model
        for link in filter(self.is_active, range(self.links + 1)):
            for j, t in enumerate(self.obstacles):
                if self.applies_to_link(link, t) and (link, j) not in self.case.permits:
                    margin = t.margin + t.velocity_error * self.case.age + m["rounding"] + self.held_error(link)
                    for s in self.sphere_indices(link):
                        out[OBSTACLE, s, j] = t.distance(self.centre[s])[0] - self.radius[s] - margin
        for near, far in self.pairs():
            for i in self.sphere_indices(near):
                h = self.self_distances(i, far)[0] + m["sampling"]
                out |= {(USER, s, i): gap for s, gap in zip(self.sphere_indices(far), h, strict=True)}
        return out

    def keeps_barriers(self, u, tolerance=-1e-12):
        """Whether every h of the next step is at least `tolerance`, or no deeper than now."""
        m = replace(
            self.case, q=self.y + self.model["period"] * u, v=np.zeros(self.n), age=self.case.age + self.model["period"]
        )
        then = ReferenceRelaxation(self.model, m, (self.low, self.high), (self.trust_low, self.trust_high)).true_h()
        now = self.true_h()
        return all(h >= tolerance or h >= now[name] + tolerance for name, h in then.items())
