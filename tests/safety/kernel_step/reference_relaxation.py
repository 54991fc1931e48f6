"""The relaxation and the certificate once more, in numpy and from definitions: what is given up, and what is kept.

No control meets all rows: the hardest braking is the aim, no pair is met worse than by braking, and rank by rank the
violation is the least that what came before allows; first as if everything stood still, then with what moves.
"""

from dataclasses import replace

import numpy as np

from tests.safety.kernel_step.reference_active_set import Problem
from tests.safety.kernel_step.reference_rows import OBSTACLE, USER, Weighing

GRANTED, GIVEN_UP, SOFT, SPARE = 4e-10, 1e-4, 1e-3, 0.05
"""[rad/s] beyond the least violation; [m/s] that counts; weight of the slack; share of the box that helps to stop."""
NEVER = -1e9


def braking(model, u_prev):
    """Every joint slows by one factor; one of them with its full acceleration."""
    step = model["a_max"] * model["period"]
    keep = max(0.0, *(1.0 - step / np.maximum(np.abs(u_prev), step)))
    return keep * u_prev


class Relaxing(Weighing):
    """What remains of `names`, rows in their order, when no control meets all of them."""

    @property
    def brake(self):
        return np.clip(braking(self.model, self.m.u_prev), self.low, self.high)

    def passive(self, name, want, change):
        """The robot's own part: never toward what comes faster than alpha h, nor than it can surely be at rest."""
        _, b, h, norm, *_ = self.rows[name]
        t = self.things[name[2]]
        drift = t.distance(self.centre[name[1]])[1] @ t.velocity + t.error
        if h <= 0.0:
            return min(want, 0.0)
        still = b - drift / norm
        if drift <= 0.0:
            return min(want, still)
        return min(want, max(still, -SPARE * change * h / (drift * self.model["period"])))

    def relax(self, names):
        """(u, bits of the ranks given up); None where a control meets all rows, or rounding decides."""
        A, b = np.array([self.rows[name][0] for name in names]), np.array([self.rows[name][1] for name in names])
        if Problem(self.model["scale"], A, b, b, self.low, self.high, self.m.u_nom, slack=False).solve() == 0:
            return None
        A = np.array([self.rows[name][0] for name in names])
        best, worst = (pick(A * self.low, A * self.high).sum(axis=1) for pick in (np.maximum, np.minimum))
        norm, brake = np.array([self.rows[name][3] for name in names]), self.brake
        want = np.minimum([self.rows[name][1] for name in names], best)
        moving = np.array([self.rows[name][5] > 0.0 for name in names])
        rank = np.array([self.rows[name][6] for name in names])
        passive = np.array([
            self.passive(name, want[r], 0.5 * (best - worst)[r]) if moving[r] else want[r]
            for r, name in enumerate(names)
        ])  # fmt: skip
        floor = np.where(rank <= 2, np.minimum(passive, A @ brake - GRANTED), NEVER)
        rank = np.where((rank <= 2) & (A @ brake >= want), 0, rank)
        soft, u, given_up = np.minimum(1.0, SOFT / norm), brake, 0
        for level in range(1, int(rank.max(initial=0)) + 1):
            mine = rank == level
            for asked in ([passive] if np.any(moving & mine) else []) + [want]:
                if not np.any(mine):
                    continue
                p = Problem(
                    self.model["scale"], np.vstack([A, A[mine]]), np.concatenate([floor, asked[mine]]),
                    np.concatenate([np.zeros(len(A)), soft[mine]]), self.low, self.high, brake, slack=True,
                )  # fmt: skip
                if p.solve():
                    return None
                slack, u = max(p.slack, 0.0), np.clip(p.u, self.low, self.high)
                floor = np.where(mine, np.maximum(floor, asked - soft * slack - GRANTED), floor)
            given_up |= (1 << level) * bool(np.any(mine) and slack * SOFT > GIVEN_UP)
        return u, given_up

    # --- the next step --------------------------------------------------------------------------------------------

    def true_h(self):
        """(kind, i, j) -> h of every pair that is kept apart, with the margins of the certificate."""
        out, m = {}, self.model
        for link in filter(self.takes_part, range(self.links + 1)):
            for j, t in enumerate(self.things):
                if self.meant(link, t) and (link, j) not in self.m.permits:
                    margin = t.margin + t.error * self.m.age + m["rounding"] + self.held_error(link)
                    for s in self.of(link):
                        out[OBSTACLE, s, j] = t.distance(self.centre[s])[0] - self.radius[s] - margin
        for near, far in self.pairs():
            for i in self.of(near):
                h = self.apart(i, far)[0] + m["sampling"]
                out |= {(USER, s, i): gap for s, gap in zip(self.of(far), h, strict=True)}
        return out

    def kept(self, u, spare=-1e-12):
        """Is every h of the next step at least zero, or no deeper than now? By `spare`, for rounding."""
        m = replace(
            self.m, q=self.y + self.model["period"] * u, v=np.zeros(self.n), age=self.m.age + self.model["period"]
        )  # fmt: skip
        then = Relaxing(self.model, m, (self.low, self.high), (self.trust_low, self.trust_high)).true_h()
        now = self.true_h()
        return all(h >= spare or h >= now[name] + spare for name, h in then.items())
