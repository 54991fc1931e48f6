"""The relaxation and the certificate once more, in numpy and from definitions: what is given up, and what is kept.

No control meets all rows: the hardest braking is the aim, no pair is met worse than by braking, and rank by rank the
violation is the least that what came before allows; first as if everything stood still, then with what moves.
"""

from dataclasses import replace

import numpy as np

from tests.safety.kernel_step.reference_active_set import ReferenceQP
from tests.safety.kernel_step.reference_rows import OBSTACLE, USER, ReferenceRows

VIOLATION_TOLERANCE, MIN_REPORTED_VIOLATION, SLACK_WEIGHT, STOP_SHARE = 4e-10, 1e-4, 1e-3, 0.05
"""[rad/s] beyond the least violation; [m/s] that counts; weight of the slack; share of the box that helps to stop."""
UNCONSTRAINED = -1e9


def braking_control(model, u_prev):
    """Every joint slows by one factor; one of them with its full acceleration."""
    step = model["a_max"] * model["period"]
    keep = max(0.0, *(1.0 - step / np.maximum(np.abs(u_prev), step)))
    return keep * u_prev


class ReferenceRelaxation(ReferenceRows):
    """What remains of `names`, rows in their order, when no control meets all of them."""

    @property
    def brake_target(self):
        return np.clip(braking_control(self.model, self.case.u_prev), self.low, self.high)

    def passive_bound(self, name, want, change):
        """The robot's own part: never toward what comes faster than alpha h, nor than it can surely be at rest."""
        _, b, h, norm, *_ = self.rows[name]
        t = self.obstacles[name[2]]
        drift = t.distance(self.centre[name[1]])[1] @ t.velocity + t.error
        if h <= 0.0:
            return min(want, 0.0)
        still = b - drift / norm
        if drift <= 0.0:
            return min(want, still)
        return min(want, max(still, -STOP_SHARE * change * h / (drift * self.model["period"])))

    def solve_relaxation(self, names):
        """(u, bits of the ranks given up); None where a control meets all rows, or rounding decides."""
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
        soft, u, given_up = np.minimum(1.0, SLACK_WEIGHT / norm), brake, 0
        for level in range(1, int(rank.max(initial=0)) + 1):
            mine = rank == level
            for asked in ([passive] if np.any(moving & mine) else []) + [want]:
                if not np.any(mine):
                    continue
                p = ReferenceQP(
                    self.model["scale"],
                    np.vstack([A, A[mine]]),
                    np.concatenate([floor, asked[mine]]),
                    np.concatenate([np.zeros(len(A)), soft[mine]]),
                    self.low,
                    self.high,
                    brake,
                    slack=True,
                )
                if p.solve():
                    return None
                slack, u = max(p.slack, 0.0), np.clip(p.u, self.low, self.high)
                floor = np.where(mine, np.maximum(floor, asked - soft * slack - VIOLATION_TOLERANCE), floor)
            given_up |= (1 << level) * bool(np.any(mine) and slack * SLACK_WEIGHT > MIN_REPORTED_VIOLATION)
        return u, given_up

    # --- the next step --------------------------------------------------------------------------------------------

    def true_h(self):
        """(kind, i, j) -> h of every pair that is kept apart, with the margins of the certificate."""
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
        """Is every h of the next step at least zero, or no deeper than now? By `spare`, for rounding."""
        m = replace(
            self.case, q=self.y + self.model["period"] * u, v=np.zeros(self.n), age=self.case.age + self.model["period"]
        )
        then = ReferenceRelaxation(self.model, m, (self.low, self.high), (self.trust_low, self.trust_high)).true_h()
        now = self.true_h()
        return all(h >= tolerance or h >= now[name] + tolerance for name, h in then.items())
