"""Reference of the pairs that a step checks and of the rows that it poses, in numpy and float64, from definitions.

A pair is skipped only by a lower bound of its h. Lists, rows and rechecked pairs are compared as sets.
"""

from functools import cached_property

import numpy as np

from tests.safety.kernel_step.reference_obstacles import ALWAYS_CHECKED_DISTANCE, MAX_DISTANCE, separation_speed
from tests.safety.kernel_step.reference_step import ReferenceStep

OBSTACLE, SELF, LOWER, UPPER, USER = range(5)
ZERO_GRADIENT, ROW_TIGHTENING, SPEED_ROUNDING, VELOCITY_ROUNDING = 1e-4, 1e-10, 1e-5, 4e-6
"""Smallest effective normal [m/rad]; tightening of rows [rad/s]; rounding of right-hand sides [m/s]; of velocities."""


class ReferenceRows(ReferenceStep):
    """Lists, rows and rechecked pairs of one case; `extra` [m] and `known_only` are those of a projection."""

    extra, known_only = 0.0, False

    # --- obstacles --------------------------------------------------------------------------------------------

    def margin(self, obstacle):
        """Margin that is subtracted from the distance to an obstacle."""
        m = self.model
        return obstacle.margin + obstacle.velocity_error * self.case.age + m["sampling"] + m["rounding"] + self.extra

    def applies_to_link(self, link, obstacle):
        """Whether this link must keep away from the obstacle."""
        return bool(obstacle.mask >> link & 1) and (bool(obstacle.flags & 1) or not self.known_only)

    def alpha(self, obstacle):
        return obstacle.alpha if obstacle.alpha > 0.0 else self.model["alpha"]

    @cached_property
    def h_lower_bounds(self):
        """(links + 1, obstacles): lower bounds of h, bounding sphere against capsule."""
        return np.array(
            [
                [t.capsule_distance(b[:3]) - self.margin(t) - b[3] - self.held_error(link) for t in self.obstacles]
                for link, b in enumerate(self.bounding_spheres)
            ]
        ).reshape(self.links + 1, -1)

    @cached_property
    def min_h_bound(self):
        """Upper bound of the smallest h of all pairs with a plain capsule, from the innermost spheres."""
        most = [MAX_DISTANCE]
        for link in filter(self.is_active, range(self.links + 1)):
            for j, t in enumerate(self.obstacles):
                if t.is_plain_capsule and self.applies_to_link(link, t) and (link, j) not in self.case.permits:
                    most.append(
                        self.h_lower_bounds[link, j] + self.bounding_spheres[link, 3] + self.bounding_spheres[link, 4]
                    )
        return min(most) + self.model["sampling"]

    @cached_property
    def nearby_obstacles(self):
        """For every link, the obstacles that its bounds cannot exclude."""
        return [[j for j in range(len(self.obstacles)) if self.is_relevant(link, j)] for link in range(self.links + 1)]

    def is_relevant(self, link, j):
        """Whether a control in the trust region may violate a row, any may reach h = 0, or it may be nearest."""
        t = self.obstacles[j]
        if not self.is_active(link) or not self.applies_to_link(link, t):
            return False
        h, soon = (
            self.h_lower_bounds[link, j],
            self.model["period"] * (t.speed + self.max_speed[link]) + ALWAYS_CHECKED_DISTANCE,
        )
        deceleration = self.max_acceleration_term[link] / (0.5 * self.model["period"])
        allowed = self.approach_speed(self.alpha(t), h, deceleration)
        if not (h > soon and allowed >= t.speed + self.trust_region_speed[link]):
            return True
        if not h + self.model["sampling"] >= self.min_h_bound:
            return True
        if not t.brake > 0.0:
            return False
        return separation_speed(t.reaction, t.brake, h, max(t.approach, t.speed)) < self.trust_region_speed[link]

    def approach_speed(self, alpha, h, deceleration):
        """Largest rate at which h may fall: alpha h, and what leaves h ≥ 0 at the end of a stop along the path."""
        stop_time = np.max(self.model["v_max"] / self.model["a_max"])
        advance = 0.5 * stop_time  # [s] of the present motion
        return min(alpha * h, (h - 0.5 * deceleration * advance**2) / advance)

    def bound_row(self, h, n, moves, spread, bend, alpha, cap, drift):
        """Right-hand side of a row, and its slack for the worst control of the trust region."""
        deceleration = max(0.0, -(n @ bend))
        allowed = self.approach_speed(alpha, h, deceleration)
        barrier = min(-(max(allowed, 0.0) if h >= 0.0 else alpha * h), cap)
        rhs = barrier + drift + 0.5 * self.model["period"] * deceleration
        return rhs, n @ moves - spread - rhs

    def obstacle_rows(self, link, j):
        """(h of all spheres, rows as (kind, i, j, h, n, rhs, yielding)) of a link and an obstacle."""
        t, hs, rows = self.obstacles[j], [], []
        permit = self.case.permits.get((link, j), -1.0)
        for s in self.sphere_indices(link):
            d, n = t.distance(self.centre[s])
            h = d - self.radius[s] - self.margin(t) - self.held_error(link)
            cap, error = (-permit, 0.0) if permit >= 0.0 else (self.model["recovery"], t.velocity_error)
            rhs, room = self.bound_row(
                h,
                n,
                self.velocity[s],
                self.spread[s],
                self.acceleration[s],
                self.alpha(t),
                cap,
                n @ t.velocity + error,
            )
            yields = permit >= 0.0
            if t.brake > 0.0 and permit < 0.0:
                person = max(t.approach, n @ t.velocity + error, 0.0)
                tighter = -separation_speed(t.reaction, t.brake, h, person)
                if tighter > rhs:
                    rhs, room, yields = tighter, room - (tighter - rhs), True
            hs.append(h)
            if not room >= 0.0 or (not h >= ALWAYS_CHECKED_DISTANCE and permit < 0.0):
                rows.append((OBSTACLE, s, j, h, n, rhs, yields))
        return hs, rows

    # --- self-collision -----------------------------------------------------------------------------------------

    def pairs(self):
        """(near link, far link) in the order of the kernel; the held object is last."""
        kept = self.model["pairs"].astype(int).reshape(-1, 2).tolist()[::-1]
        held = [(int(link), self.links) for link in self.model["held_links"]] if len(self.case.held) else []
        return [
            (a, b)
            for a, b in (*kept, *held)
            if len(self.sphere_indices(b)) and self.link_frame[a] != self.link_frame[b]
        ]

    def self_margin(self, far):
        m = self.model
        return m["self_margin"] + m["sampling"] + m["rounding"] + self.extra + self.held_error(far)

    def between_control(self, near, far):
        """The centre of the box for the joints between two links, and 0 for the others, which change no distance."""
        u = np.zeros(self.n)
        between = slice(self.link_frame[near], self.link_frame[far])
        u[between] = 0.5 * (self.low + self.high)[between]
        return u

    def coarse_acceleration_term(self, near, far):
        """Upper bound of the sampling terms of two links, by the speeds of the joints between them."""
        between = range(self.link_frame[near], self.link_frame[far])
        most = self.max_joint_speed + self.box_excess
        turns = np.where(self.slides, 0.0, most)
        total = sum(most[k] * self.link_reach[k, far] * (2.0 * turns[between[0] : k].sum() + turns[k]) for k in between)
        if self.model["moving_base"] and between[0] == 0:
            total += most[0] * most[1]
        return 0.5 * self.model["period"] * total

    def acceleration_term(self, near, far):
        """Upper bound of the sampling terms of the spheres of two links, by the motion of the farther one."""
        if (near, far) in self.terms_of_pairs:
            return self.terms_of_pairs[near, far]
        u, frame, ball = self.between_control(near, far), self.link_frame[far], self.bounding_spheres[far]
        turn = np.linalg.norm(self.turn_acceleration(u, frame)) + np.sum(self.turn_rate(u, frame) ** 2)
        most = np.linalg.norm(self.point_acceleration(u, ball[:3], frame)) + turn * ball[5]
        term = min(self.coarse_acceleration_term(near, far), 0.5 * self.model["period"] * most)
        self.terms_of_pairs[near, far] = term
        return term

    @cached_property
    def terms_of_pairs(self):
        """Results of `acceleration_term`."""
        return {}

    def closing_speeds(self, near, far):
        """Upper bounds of the closing speed in the trust region: by joints or in space, and for single spheres."""
        between = slice(self.link_frame[near], self.link_frame[far])
        by_joints = self.max_joint_speed[between] @ self.link_reach[between, far]
        in_space = self.trust_region_speed[near] + self.trust_region_speed[far]
        coarse = min(by_joints, in_space) + self.coarse_acceleration_term(near, far)
        relative, spread = self.relative_velocity(near, far)
        fine = np.linalg.norm(relative, axis=1) + spread + self.acceleration_term(near, far) + SPEED_ROUNDING
        return coarse, min(coarse, fine.max())

    def relative_velocity(self, near, far):
        """Velocity (k, 3) of far spheres relative to the near link, and its range over the trust region."""
        twist = self.twist[self.link_frame[far]] - self.twist[self.link_frame[near]]
        between = slice(self.link_frame[near], self.link_frame[far])
        mine = list(self.sphere_indices(far))
        return twist[3:] + np.cross(twist[:3], self.centre[mine]), self.half_width[between] @ self.reach[between][
            :, mine
        ]

    def excess_between(self, near, far):
        between = slice(self.link_frame[near], self.link_frame[far])
        return self.box_excess[between] @ self.link_reach[between, far]

    def self_distances(self, i, far):
        """h of sphere i and all spheres of a link, and normals toward the latter."""
        mine = list(self.sphere_indices(far))
        way = self.centre[mine] - self.centre[i]
        d = np.linalg.norm(way, axis=1)
        return d - self.radius[mine] - self.radius[i] - self.self_margin(far), way / d[:, None]

    def self_collision_rows(self, near, far):
        """Rows of two links."""
        rows, (relative, spread) = [], self.relative_velocity(near, far)
        u = self.between_control(near, far)
        bend = [self.point_acceleration(u, self.centre[s], self.link_frame[far]) for s in self.sphere_indices(far)]
        moves = np.einsum("k,skx->sx", u, self.jacobian[list(self.sphere_indices(far))])
        for i in self.sphere_indices(near):
            h, n = self.self_distances(i, far)
            for at, s in enumerate(self.sphere_indices(far)):
                distance = np.linalg.norm(self.centre[s] - self.centre[i])
                across = moves[at] - (n[at] @ moves[at]) * n[at]
                rhs, room = self.bound_row(
                    h[at],
                    n[at],
                    relative[at],
                    spread[at],
                    bend[at] + n[at] * (across @ across) / max(distance, self.radius[i]),
                    self.model["alpha_self"],
                    self.model["recovery"],
                    0.0,
                )
                if not room >= 0.0 or not h[at] >= ALWAYS_CHECKED_DISTANCE:
                    rows.append((SELF, s, i, h[at], n[at], rhs, False))
        return rows

    # --- all rows ------------------------------------------------------------------------------------------------

    @cached_property
    def rows(self):
        """(kind, i, j) -> (a, b, h, norm, yielding, moving, rank) as unit rows, without rows of zero gradient."""
        raw = [
            row
            for link, near in enumerate(self.nearby_obstacles)
            for j in near
            for row in self.obstacle_rows(link, j)[1]
        ]
        raw += [row for near, far in self.pairs() for row in self.self_collision_rows(near, far)]
        out, self.zero_gradient_rows = {}, []
        for kind, i, j, h, n, rhs, yields in raw:
            t = self.obstacles[j] if kind == OBSTACLE else None
            J = self.jacobian[i] if t else self.jacobian[i] - self.jacobian[j]
            a = J @ n
            norm, b = np.linalg.norm(a), rhs + self.model["tracking"] @ np.abs(a)
            if not norm > ZERO_GRADIENT:
                self.zero_gradient_rows.append((kind, i, j, h, b))
                continue
            if yields or h < 0.0:
                b = min(b, np.maximum(a * self.low, a * self.high).sum() - 4.0 * ROW_TIGHTENING * norm)
            moving, rank = (float(not t.flags & 2), t.rank) if t else (0.0, 1)
            out[kind, i, j] = (a / norm, b / norm, h + self.model["sampling"], norm, float(yields), moving, rank)
        for i, row in enumerate(self.case.rows):
            norm = np.linalg.norm(row[: self.n])
            a, b, h, rank = row[: self.n], row[self.n], row[self.n + 1], row[self.n + 2]
            out[USER, i, 0] = (a / norm, b / norm, h, norm, 0.0, 0.0, rank)
        return out

    @cached_property
    def h_min(self):
        """The smallest h of all pairs without a permit, without the sampling margin."""
        hs = [MAX_DISTANCE]
        for link, near in enumerate(self.nearby_obstacles):
            hs += [h for j in near if (link, j) not in self.case.permits for h in self.obstacle_rows(link, j)[0]]
        least = min([hs[0], *(h + self.model["sampling"] for h in hs[1:])])
        return min([least, *(h.min() + self.model["sampling"] for _, h in self.all_self_distances())])

    def all_self_distances(self):
        """((near, far, i), h) of every sphere against every link that it must keep apart from."""
        return [
            ((near, far, i), self.self_distances(i, far)[0])
            for near, far in self.pairs()
            for i in self.sphere_indices(near)
        ]

    @cached_property
    def revisit_pairs(self):
        """(first sphere, count, obstacle or -1 - sphere) of pairs that may reach h = 0 within one period."""
        out, dt = set(), self.model["period"]
        for link, near in enumerate(self.nearby_obstacles):
            for j in near:
                h = min(self.obstacle_rows(link, j)[0])
                soon = dt * (self.obstacles[j].speed + self.max_speed[link]) + ALWAYS_CHECKED_DISTANCE
                if (link, j) not in self.case.permits and not h >= soon:
                    out.add((self.first[link], len(self.sphere_indices(link)), j))
        for (near, far, i), h in self.all_self_distances():
            soon = dt * (self.closing_speeds(near, far)[1] + self.excess_between(near, far)) + ALWAYS_CHECKED_DISTANCE
            if not h.min() >= soon:
                out.add((self.first[far], len(self.sphere_indices(far)), -1 - i))
        return out

    def closing_by_direction(self, near, far, closing, way, product, radius, bend):
        """Smaller of `closing` and the closing speed of points within `radius` of `way`; `product` bounds (way)'v."""
        nearest = np.linalg.norm(way) - radius
        if not nearest > ALWAYS_CHECKED_DISTANCE:
            return closing
        between = slice(self.link_frame[near], self.link_frame[far])
        turn = np.linalg.norm(self.relative_twist(near, far)[:3])
        rounding = SPEED_ROUNDING + VELOCITY_ROUNDING * turn * np.abs(self.bounding_spheres[far, :3]).sum()
        change = self.half_width[between] @ self.link_reach[between, far] + bend + rounding
        return min(closing, max(-product, 0.0) / nearest + change)

    def relative_twist(self, near, far):
        return self.twist[self.link_frame[far]] - self.twist[self.link_frame[near]]

    def velocity_at(self, near, far, point):
        """Velocity of the far link at a point, relative to the near link."""
        twist = self.relative_twist(near, far)
        return twist[3:] + np.cross(twist[:3], point)

    def closing_of_links(self, near, far):
        """Upper bounds of the closing speed of two links by the direction of their motion, then by the acceleration."""
        a, b = self.bounding_spheres[near], self.bounding_spheres[far]
        at_near, at_far = self.velocity_at(near, far, a[:3]), self.velocity_at(near, far, b[:3])
        turn = np.linalg.norm(self.relative_twist(near, far)[:3])
        range_ = b[5] * np.linalg.norm(at_near) + a[5] * np.linalg.norm(at_far) + turn * a[5] * b[5]
        way, coarse = b[:3] - a[:3], self.closing_speeds(near, far)[0]
        bend = self.coarse_acceleration_term(near, far)
        closing = self.closing_by_direction(near, far, coarse, way, way @ at_near - range_, a[5] + b[5], bend)
        return closing, closing - bend + self.acceleration_term(near, far)

    def closing_of_sphere(self, near, far, i):
        """The same of sphere i of the near link."""
        b, v = self.bounding_spheres[far], self.velocity_at(near, far, self.centre[i])
        way = b[:3] - self.centre[i]
        product = way @ v - b[5] * np.linalg.norm(v)
        most, bend = self.closing_of_links(near, far)[1], self.acceleration_term(near, far)
        return self.closing_by_direction(near, far, most, way, product, b[5], bend)

    def n_pair_checks(self, start):
        """Number of spheres that are checked against another link; `start` is an upper bound of h_min."""
        obstacles = [
            h + self.model["sampling"]
            for link, near in enumerate(self.nearby_obstacles)
            for j in near
            if (link, j) not in self.case.permits
            for h in self.obstacle_rows(link, j)[0]
        ]
        count, h_min = 0, min([start, *obstacles])

        def matters(h, closing, bend):
            allowed = self.approach_speed(self.model["alpha_self"], h, bend / (0.5 * self.model["period"]))
            return not (h > soon and allowed >= closing and h + self.model["sampling"] >= h_min)

        for near, far in self.pairs():
            to, coarse = self.bounding_spheres[far], self.closing_speeds(near, far)[0]
            soon = self.model["period"] * (coarse + self.excess_between(near, far)) + ALWAYS_CHECKED_DISTANCE
            bounds = [self.coarse_acceleration_term(near, far), self.acceleration_term(near, far)]
            gap = np.linalg.norm(to[:3] - self.bounding_spheres[near, :3]) - self.bounding_spheres[near, 3]
            gap -= to[3] + self.self_margin(far)
            by_direction, by_acceleration = self.closing_of_links(near, far)
            stages = [(coarse, bounds[0]), (by_direction, bounds[0]), (by_acceleration, bounds[1])]
            if not all(matters(gap, *stage) for stage in stages):
                continue
            for i in self.sphere_indices(near):
                own = np.linalg.norm(to[:3] - self.centre[i]) - to[3] - self.radius[i] - self.self_margin(far)
                if matters(own, self.closing_of_sphere(near, far, i), bounds[1]):
                    count += 1
                    h_min = min(h_min, self.self_distances(i, far)[0].min() + self.model["sampling"])
        return count
