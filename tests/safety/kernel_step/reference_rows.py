"""Which pairs a step looks at and which rows it states, in numpy and float64 and from definitions.

A pair is left out by a lower bound of its h alone, and never in vain: lists, rows, visits and glances are sets here.
"""

from functools import cached_property

import numpy as np

from tests.safety.kernel_step.reference_obstacles import BEYOND, FLOOR, separation_speed
from tests.safety.kernel_step.reference_step import Anatomy

OBSTACLE, SELF, LOWER, UPPER, USER = range(5)
ZERO_GRADIENT, SHIFT, ROUNDED = 1e-4, 1e-10, 1e-5
"""[m/rad] a smaller normal cannot be acted upon; [rad/s] rows are tightened; [m/s] rounding of a right side."""


class Weighing(Anatomy):
    """Lists, rows, visits and glances of one moment; `extra` [m] and `known_only` are those of a projection."""

    extra, known_only = 0.0, False

    # --- things -----------------------------------------------------------------------------------------------

    def margin(self, thing):
        """What is taken off the distance to a thing."""
        m = self.model
        return thing.margin + thing.error * self.m.age + m["sampling"] + m["rounding"] + self.extra

    def meant(self, link, thing):
        """Is the thing kept away from this link at all?"""
        return bool(thing.mask >> link & 1) and (bool(thing.flags & 1) or not self.known_only)

    def alpha(self, thing):
        return thing.alpha if thing.alpha > 0.0 else self.model["alpha"]

    @cached_property
    def gaps(self):
        """(links + 1, things): lower bounds of h, ball against capsule."""
        return np.array([
            [t.gap(b[:3]) - self.margin(t) - b[3] - self.held_error(link) for t in self.things]
            for link, b in enumerate(self.bounds)
        ]).reshape(self.links + 1, -1)  # fmt: skip

    @cached_property
    def nearest(self):
        """No more than the smallest h of all pairs with an open capsule: the innermost sphere is that near."""
        most = [BEYOND]
        for link in filter(self.takes_part, range(self.links + 1)):
            for j, t in enumerate(self.things):
                if t.plain and self.meant(link, t) and (link, j) not in self.m.permits:
                    most.append(self.gaps[link, j] + self.bounds[link, 3] + self.bounds[link, 4])
        return min(most) + self.model["sampling"]

    @cached_property
    def near(self):
        """Of every link, the things that its bounds cannot rule out."""
        return [[j for j in range(len(self.things)) if self.matters(link, j)] for link in range(self.links + 1)]

    def matters(self, link, j):
        """May a control of the trust box violate a row, any bring h to 0 in this period, or is it the nearest?"""
        t = self.things[j]
        if not self.takes_part(link) or not self.meant(link, t):
            return False
        h, soon = self.gaps[link, j], self.model["period"] * (t.speed + self.haste[link]) + FLOOR
        if not (h > soon and self.alpha(t) * h >= t.speed + self.speed[link]):
            return True
        if not h + self.model["sampling"] >= self.nearest:
            return True
        if not t.brake > 0.0:
            return False
        return separation_speed(t.reaction, t.brake, h, max(t.approach, t.speed)) < self.speed[link]

    def weigh(self, h, n, moves, spread, bend, alpha, cap, drift):
        """Right side of a row, and the room that the worst control of the trust box leaves."""
        barrier = min(-alpha * h, cap)
        rhs = barrier + drift + max(0.0, -0.5 * self.model["period"] * (n @ bend))
        return rhs, n @ moves - spread - rhs

    def meet(self, link, j):
        """(h of all spheres, rows as (kind, i, j, h, n, rhs, yielding)) of a link and a thing."""
        t, hs, rows = self.things[j], [], []
        permit = self.m.permits.get((link, j), -1.0)
        for s in self.of(link):
            d, n = t.distance(self.centre[s])
            h = d - self.radius[s] - self.margin(t) - self.held_error(link)
            cap, error = (-permit, 0.0) if permit >= 0.0 else (self.model["recovery"], t.error)
            rhs, room = self.weigh(
                h, n, self.velocity[s], self.spread[s], self.acceleration[s], self.alpha(t), cap,
                n @ t.velocity + error,
            )  # fmt: skip
            yields = permit >= 0.0
            if t.brake > 0.0 and permit < 0.0:
                person = max(t.approach, n @ t.velocity + error, 0.0)
                tighter = -separation_speed(t.reaction, t.brake, h, person)
                if tighter > rhs:
                    rhs, room, yields = tighter, room - (tighter - rhs), True
            hs.append(h)
            if not room >= 0.0 or (not h >= FLOOR and permit < 0.0):
                rows.append((OBSTACLE, s, j, h, n, rhs, yields))
        return hs, rows

    # --- the body against itself --------------------------------------------------------------------------------

    def pairs(self):
        """(near link, far link) in the order in which they are looked at; what is held comes last."""
        kept = self.model["pairs"].astype(int).reshape(-1, 2).tolist()[::-1]
        held = [(int(link), self.links) for link in self.model["held_links"]] if len(self.m.held) else []
        return [(a, b) for a, b in (*kept, *held) if len(self.of(b)) and self.link_frame[a] != self.link_frame[b]]

    def own_margin(self, far):
        m = self.model
        return m["self_margin"] + m["sampling"] + m["rounding"] + self.extra + self.held_error(far)

    def closing(self, near, far):
        """No pair closes faster in the trust box: as the joints between can, or in space; and as single spheres do."""
        between = slice(self.link_frame[near], self.link_frame[far])
        bend = self.bend[near] + self.bend[far]
        by_joints = bend + self.fast[between] @ self.link_reach[between, far]
        coarse = min(by_joints, self.speed[near] + self.speed[far])
        relative, spread = self.relative(near, far)
        fine = np.linalg.norm(relative, axis=1) + spread + bend + ROUNDED
        return coarse, min(coarse, fine.max())

    def relative(self, near, far):
        """Velocity (k, 3) of far spheres as seen from the near link, and how much the trust box changes it."""
        twist = self.twist[self.link_frame[far]] - self.twist[self.link_frame[near]]
        between = slice(self.link_frame[near], self.link_frame[far])
        mine = list(self.of(far))
        return twist[3:] + np.cross(twist[:3], self.centre[mine]), self.wide[between] @ self.reach[between][:, mine]

    def beyond_between(self, near, far):
        between = slice(self.link_frame[near], self.link_frame[far])
        return self.beyond[between] @ self.link_reach[between, far]

    def apart(self, i, far):
        """h of sphere i and all spheres of a link, and normals toward the latter."""
        mine = list(self.of(far))
        way = self.centre[mine] - self.centre[i]
        d = np.linalg.norm(way, axis=1)
        return d - self.radius[mine] - self.radius[i] - self.own_margin(far), way / d[:, None]

    def meet_self(self, near, far):
        """Rows of two links."""
        rows, (relative, spread) = [], self.relative(near, far)
        for i in self.of(near):
            h, n = self.apart(i, far)
            for at, s in enumerate(self.of(far)):
                rhs, room = self.weigh(
                    h[at], n[at], relative[at], spread[at], self.acceleration[s] - self.acceleration[i],
                    self.model["alpha_self"], self.model["recovery"], 0.0,
                )  # fmt: skip
                if not room >= 0.0 or not h[at] >= FLOOR:
                    rows.append((SELF, s, i, h[at], n[at], rhs, False))
        return rows

    # --- together ------------------------------------------------------------------------------------------------

    @cached_property
    def rows(self):
        """(kind, i, j) -> (a, b, h, norm, yielding, moving, rank) as unit rows; `fixed` are those of no gradient."""
        raw = [row for link, near in enumerate(self.near) for j in near for row in self.meet(link, j)[1]]
        raw += [row for near, far in self.pairs() for row in self.meet_self(near, far)]
        out, self.fixed = {}, []
        for kind, i, j, h, n, rhs, yields in raw:
            t = self.things[j] if kind == OBSTACLE else None
            J = self.jacobian[i] if t else self.jacobian[i] - self.jacobian[j]
            a = J @ n
            norm, b = np.linalg.norm(a), rhs + self.model["tracking"] * np.abs(a).sum()
            if not norm > ZERO_GRADIENT:
                self.fixed.append((kind, i, j, h, b))
                continue
            if yields or h < 0.0:
                b = min(b, np.maximum(a * self.low, a * self.high).sum() - 4.0 * SHIFT * norm)
            moving, rank = (float(not t.flags & 2), t.rank) if t else (0.0, 1)
            out[kind, i, j] = (a / norm, b / norm, h + self.model["sampling"], norm, float(yields), moving, rank)
        for i, row in enumerate(self.m.rows):
            norm = np.linalg.norm(row[: self.n])
            a, b, h, rank = row[: self.n], row[self.n], row[self.n + 1], row[self.n + 2]
            out[USER, i, 0] = (a / norm, b / norm, h, norm, 0.0, 0.0, rank)
        return out

    @cached_property
    def h_min(self):
        """The smallest h of all pairs without a permit, without the sampling margin."""
        hs = [BEYOND]
        for link, near in enumerate(self.near):
            hs += [h for j in near if (link, j) not in self.m.permits for h in self.meet(link, j)[0]]
        least = min([hs[0], *(h + self.model["sampling"] for h in hs[1:])])
        return min([least, *(h.min() + self.model["sampling"] for _, h in self.all_apart())])

    def all_apart(self):
        """((near, far, i), h) of every sphere against every link that it is kept apart from."""
        return [((near, far, i), self.apart(i, far)[0]) for near, far in self.pairs() for i in self.of(near)]

    @cached_property
    def visits(self):
        """(first sphere, how many, thing or -1 - sphere) of what any control could bring to h = 0 in one period."""
        out, dt = set(), self.model["period"]
        for link, near in enumerate(self.near):
            for j in near:
                h = min(self.meet(link, j)[0])
                soon = dt * (self.things[j].speed + self.haste[link]) + FLOOR
                if (link, j) not in self.m.permits and not h >= soon:
                    out.add((self.first[link], len(self.of(link)), j))
        for (near, far, i), h in self.all_apart():
            soon = dt * (self.closing(near, far)[1] + self.beyond_between(near, far)) + FLOOR
            if not h.min() >= soon:
                out.add((self.first[far], len(self.of(far)), -1 - i))
        return out

    @cached_property
    def glances(self):
        """How many spheres are held against another link: those that its ball cannot rule out, pair by pair."""
        count, things = 0, [h + self.model["sampling"] for link, near in enumerate(self.near) for j in near
                            if (link, j) not in self.m.permits for h in self.meet(link, j)[0]]  # fmt: skip
        h_min = min([BEYOND, *things])

        def matters(h, speed):
            soon = self.model["period"] * (speed + more) + FLOOR
            safe = h > soon and self.model["alpha_self"] * h >= speed and h + self.model["sampling"] >= h_min
            return not safe

        for near, far in self.pairs():
            more, (coarse, fine) = self.beyond_between(near, far), self.closing(near, far)
            to = self.bounds[far]
            gap = np.linalg.norm(to[:3] - self.bounds[near, :3]) - to[3] - self.bounds[near, 3] - self.own_margin(far)
            if not (matters(gap, coarse) and matters(gap, fine)):
                continue
            for i in self.of(near):
                own = np.linalg.norm(to[:3] - self.centre[i]) - to[3] - self.radius[i] - self.own_margin(far)
                if matters(own, fine):
                    count += 1
                    h_min = min(h_min, self.apart(i, far)[0].min() + self.model["sampling"])
        return count
