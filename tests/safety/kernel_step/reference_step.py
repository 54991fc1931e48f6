"""Reference of the quantities of a step in numpy and float64, from definitions, without vectors or evaluation order.

Speeds, bounding spheres and lists decide which pairs the kernel checks. They must be valid bounds, and no looser than
defined; each is stated here as one number.
"""

from functools import cached_property

import numpy as np

from tests.safety.kernel_step.reference_obstacles import ReferenceObstacle, bounding_sphere

MAX_GRIPPER_OPENING = 0.1
"""Largest opening of any gripper [m]."""
MAX_HELD_SPHERES, MAX_HELD_DISTANCE = 8, 0.5
"""Most spheres of a held object, and their largest distance from the tool [m]."""


class ReferenceStep:
    """Robot, obstacles and motion of one case; rows are only posed for controls in the trust region `trust`."""

    def __init__(self, model, m, box, trust):
        self.model, self.case = model, m
        (self.low, self.high), (self.trust_low, self.trust_high) = box, trust
        self.n, self.links = model["n"], len(model["link_frame"])
        self.y = m.q + model["lag"] * m.v
        self.slides = model["joint_kind"] > 0.0
        self.first = [*model["link_first"].astype(int), len(model["spheres"]) + len(m.held)]
        self.link_frame = [*model["link_frame"].astype(int), self.n]
        self.obstacles = [ReferenceObstacle(row, m.age) for row in m.obstacles]

    def sphere_indices(self, link):
        """Indices of the spheres of a link; the last link is the held object."""
        return range(self.first[link], self.first[link + 1])

    def held_error(self, link):
        """Additional margin of the rows of the held object [m]."""
        return self.case.held_error if link == self.links else 0.0

    def is_active(self, link):
        return self.link_frame[link] > 0 and len(self.sphere_indices(link)) > 0

    # --- robot model ------------------------------------------------------------------------------------------

    def joint_spans(self):
        """Largest distance by which each joint can move the following joint away from its parent."""
        fixed = np.linalg.norm(self.model["joint_offset"].reshape(-1, 3), axis=1)
        return fixed + self.slides * np.maximum(np.abs(self.model["q_lower"]), np.abs(self.model["q_upper"]))

    @cached_property
    def reach(self):
        """(n, spheres + 8): longest lever arm of the joint on the sphere over all postures."""
        spheres, spans = self.model["spheres"], self.joint_spans()
        own = np.linalg.norm(spheres[:, :3], axis=1) + MAX_GRIPPER_OPENING * np.linalg.norm(spheres[:, 4:], axis=1)
        held = MAX_HELD_DISTANCE + np.linalg.norm(self.model["tool_offset"])
        frames = np.repeat(self.link_frame[:-1], np.diff(self.first[:-1]))
        arms, frames = [*own, *[held] * MAX_HELD_SPHERES], [*frames, *[self.n] * MAX_HELD_SPHERES]
        out = np.zeros((self.n, len(arms)))
        for s, (arm, frame) in enumerate(zip(arms, frames, strict=True)):
            for k in range(frame):
                out[k, s] = 1.0 if self.slides[k] else arm + spans[k + 1 : frame].sum()
        return out

    @cached_property
    def link_reach(self):
        """(n, links + 1): longest lever arm among the spheres of a link."""
        room = [*self.first[:-1], len(self.model["spheres"]) + MAX_HELD_SPHERES]
        return np.array(
            [
                [self.reach[k, room[link] : room[link + 1]].max(initial=0.0) for link in range(self.links + 1)]
                for k in range(self.n)
            ]
        )

    @cached_property
    def local_bounding_spheres(self):
        """(links + 1, 6); fingers that open in different directions move relative to each other."""
        out = []
        for link in range(self.links):
            mine = self.model["spheres"][list(self.sphere_indices(link))]
            shift = MAX_GRIPPER_OPENING * np.linalg.norm(mine[:, 4:] - mine[:1, 4:], axis=1).max(initial=0.0)
            out.append(bounding_sphere(mine[:, :3], mine[:, 3], shift))
        return np.array([*out, bounding_sphere(self.case.held[:, :3], self.case.held[:, 3], 0.0)])

    # --- posture ----------------------------------------------------------------------------------------------

    @cached_property
    def frames(self):
        """Rotation and origin of frames 0..n."""
        R, p = self.case.base or (np.eye(3), np.zeros(3))
        out = [(R, p)]
        for k in range(self.n):
            p = p + R @ self.model["joint_offset"][3 * k : 3 * k + 3]
            R = R @ self.model["joint_rotation"][9 * k : 9 * k + 9].reshape(3, 3)
            if self.slides[k]:
                p = p + R[:, 2] * self.y[k]
            else:
                c, s = np.cos(self.y[k]), np.sin(self.y[k])
                R = R @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            out.append((R, p))
        return out

    @cached_property
    def frame(self):
        """The frame that each sphere is attached to."""
        return np.concatenate(
            [np.full(len(self.sphere_indices(link)), self.link_frame[link]) for link in range(self.links + 1)]
        )

    @cached_property
    def centre(self):
        """Centres (spheres, 3) [m]."""
        body = self.model["spheres"][:, :3] + self.case.opening * self.model["spheres"][:, 4:]
        local = np.concatenate([body, self.case.held[:, :3]])
        return np.array([self.frames[f][1] + self.frames[f][0] @ c for f, c in zip(self.frame, local, strict=True)])

    @cached_property
    def radius(self):
        return np.concatenate([self.model["spheres"][:, 3], self.case.held[:, 3]])

    # --- motion -----------------------------------------------------------------------------------------------

    @cached_property
    def axes(self):
        """Axes z_k (n, 3) of the joints, and points p_k (n, 3) on them."""
        return np.array([R[:, 2] for R, _ in self.frames[1:]]), np.array([p for _, p in self.frames[1:]])

    @cached_property
    def jacobian(self):
        """(spheres, n, 3): velocity of a centre per unit speed of a joint."""
        z, p = self.axes
        J = np.where(self.slides[None, :, None], z[None], np.cross(z[None], self.centre[:, None] - p[None]))
        return J * (np.arange(self.n)[None, :, None] < self.frame[:, None, None])

    @cached_property
    def acceleration(self):
        """(spheres, 3) at a constant control, the centre of the box: every axis moves with the preceding joints."""
        u = 0.5 * (self.low + self.high)
        return np.array([self.point_acceleration(u, *at) for at in zip(self.centre, self.frame, strict=True)])

    def point_acceleration(self, u, point, frame):
        """Acceleration (3,) of a point that is fixed to a frame, at a constant control."""
        out, z, p = np.zeros(3), *self.axes

        def velocity(at, joints):
            steady = [z[j] if self.slides[j] else np.cross(z[j], at - p[j]) for j in range(joints)]
            return u[:joints] @ np.array(steady) if joints else np.zeros(3)

        for k in range(frame):
            dz = np.cross(self.turn_rate(u, k), z[k])
            by_turn = np.cross(dz, point - p[k]) + np.cross(z[k], velocity(point, frame) - velocity(p[k], k))
            out += u[k] * (dz if self.slides[k] else by_turn)
        if self.model["moving_base"] and frame >= 2:  # the turn of a base also turns the axis of its drive
            out += np.cross(u[1] * z[1], u[0] * z[0])
        return out

    def turn_rate(self, u, frame):
        """Angular velocity (3,) of a frame."""
        turns = np.arange(frame)[~self.slides[:frame]]
        return u[turns] @ self.axes[0][turns] if len(turns) else np.zeros(3)

    def turn_acceleration(self, u, frame):
        """Angular acceleration (3,) of a frame at a constant control."""
        turns, axes = np.arange(frame)[~self.slides[:frame]], self.axes[0]
        return sum((u[k] * np.cross(self.turn_rate(u, k), axes[k]) for k in turns), np.zeros(3))

    @cached_property
    def half_width(self):
        """(n,) half the width of the trust region plus the tracking error."""
        return 0.5 * (self.trust_high - self.trust_low) + self.model["tracking"]

    @cached_property
    def box_centre(self):
        return 0.5 * (self.trust_low + self.trust_high)

    @cached_property
    def max_joint_speed(self):
        return np.abs(self.box_centre) + self.half_width

    @cached_property
    def box_excess(self):
        """(n,) excess of the box over the trust region."""
        return np.maximum(self.high - self.trust_high, self.trust_low - self.low)

    @cached_property
    def velocity(self):
        return np.einsum("k,skx->sx", self.box_centre, self.jacobian)

    @cached_property
    def spread(self):
        """(spheres,) largest change of the velocity by a control of the trust region."""
        return self.half_width @ self.reach[:, : len(self.centre)]

    @cached_property
    def twist(self):
        """(n + 1, 6) of every frame about the base origin at the centre of the trust region: angular, linear."""
        z, p = self.axes
        out = [np.zeros(6)]
        for k in range(self.n):
            one = [0.0, 0.0, 0.0, *z[k]] if self.slides[k] else [*z[k], *np.cross(p[k], z[k])]
            out.append(out[-1] + self.box_centre[k] * np.array(one))
        return np.array(out)

    @cached_property
    def acceleration_terms(self):
        """(spheres,) largest contribution of the acceleration to the right-hand side of a row."""
        return 0.5 * self.model["period"] * np.linalg.norm(self.acceleration, axis=1)

    def max_per_link(self, values):
        """(links + 1,) the largest value of the spheres of each link."""
        return np.array([values[list(self.sphere_indices(link))].max(initial=0.0) for link in range(self.links + 1)])

    @cached_property
    def max_acceleration_term(self):
        return self.max_per_link(self.acceleration_terms)

    @cached_property
    def trust_region_speed(self):
        """(links + 1,) upper bound of the speed of the link's spheres in the trust region."""
        return self.max_per_link(np.linalg.norm(self.velocity, axis=1) + self.spread + self.acceleration_terms)

    @cached_property
    def max_speed(self):
        """(links + 1,) upper bound of the speed of the link's spheres in the box."""
        return self.trust_region_speed + self.box_excess @ self.link_reach

    @cached_property
    def bounding_spheres(self):
        """(links + 1, 6) bounding spheres in the world as in `bounding_sphere`; zero without spheres."""
        out = np.zeros((self.links + 1, 6))
        for link in range(self.links + 1):
            if len(self.sphere_indices(link)):
                R = self.frames[self.link_frame[link]][0]
                at = self.centre[self.first[link]] + R @ self.local_bounding_spheres[link, :3]
                out[link] = [*at, *(self.local_bounding_spheres[link, 3:] + 1e-6 * np.abs(at).sum())]
        return out
