"""The filter on joint accelerations: a barrier of relative degree two for every pair, in one QP (Xiao and Belta)."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import InvalidSetup
from dualbrain.robots.model import Body
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.qp import Closest, ClosestControl
from dualbrain.safety.cbf.relaxation import Conflict, above
from dualbrain.safety.cbf.result import Reason, Status
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.higher_order.acceleration_box import acceleration_box, limits_of
from dualbrain.safety.higher_order.pairs import OWN, OwnPairs, Pairs, ThingPairs, joined
from dualbrain.safety.higher_order.result import FilteredAcceleration
from dualbrain.safety.higher_order.sampling_margin import courses
from dualbrain.safety.higher_order.sphere_kinematics import Spheres

Array = NDArray[np.float64]
FAR_OUTSIDE = 0.2
"""[rad] Beyond a joint limit by more: the state is not believed."""
UNBELIEVABLE = 10.0
"""Times the limit: a velocity or a nominal control beyond it is not believed."""


class AccelerationConfig(msgspec.Struct, frozen=True):
    """The dials of the acceleration filter.

    `alpha_1`, `alpha_2` [1/s] are the gains of ψ₁ = ḣ + α₁h and of ψ̇₁ + α₂ψ₁ ≥ 0; None takes for α₁ 0.8 of what the
    acceleration limits can follow at full speed, min_i a_i/v_i (the rest is left for the arm's curvature). An
    obstacle's own `alpha` replaces α₁. `acceleration_error` [rad/s²] bounds |q̈ − u| of every joint. `self_margin` [m]
    is the clearance between own parts, `recovery_speed` [rad/s] how fast a joint returns from beyond its limit,
    `stale_after` [s] the age at which obstacles that may move are no longer believed. `period` [s] replaces the body's.
    """

    alpha_1: float | None = None
    alpha_2: float = 20.0
    acceleration_error: float = 0.0
    self_margin: float = 0.0
    recovery_speed: float = 0.05
    stale_after: float = 0.5
    period: float | None = None


class AccelerationFilter:
    """Closest safe joint acceleration: min ½‖u − u_nom‖²_R s.t. one row for every pair, u in the box; q̈ = u.

    For the gap h of a sphere and an obstacle, or of two own spheres, with unit normal n, relative velocity w and
    distance d (relative degree two; Xiao and Belta, "Control barrier functions for systems with high relative degree",
    CDC 2019):

        ψ₁ = ḣ + α₁h,   ḣ = n'(J q̇ − v_o),   ψ₂ = ψ̇₁ + α₂ψ₁ ≥ m:
        n'J u + n'J̇q̇ + κ + (α₁ + α₂) ḣ + α₁α₂ h ≥ m,

    with κ ≥ 0 for how the distance bends (`gaps`) and m for the period (`sampling.margin`). Joint limits are the box
    (`limits.acceleration_box`), which is never given up.

    Promise: if h ≥ 0 and ψ₁ ≥ 0 for all pairs at the start, every step is `certified`, u is held for one period and
    q̈ = u within `acceleration_error`, and obstacles move at the velocity they are said to have within `velocity_error`,
    then h ≥ 0 and ψ₁ ≥ 0 at all times, between the samples too. A new observation of a moving obstacle is a new start.
    With acceleration limits the rows can conflict; then the answer is RELAXED and promises nothing but what follows.

    Where ψ₁ < 0 (`too_fast`) the row asks for ψ₁ ≥ 0 at the end of the period: restored as fast as the box allows.
    Where rows conflict they are given up by rank, in each rank those with ψ₁ < 0 after the others, as little as
    possible; and no row is met worse than braking along the path, u = −k q̇ with the largest admissible k, meets it. So
    in no step is h heading for less than if the arm braked.
    """

    def __init__(self, body: Body, config: AccelerationConfig | None = None, *, weight: Array | None = None) -> None:
        """Lay out spheres and pairs of `body`; `weight` is R (n, n), by default diag(1/a_max²)."""
        self.body, self.config = body, config or AccelerationConfig()
        if body.base != "fixed":
            raise InvalidSetup("base of the body", got=body.base, allowed="fixed")
        self.alpha_1 = 0.8 * body.alpha if self.config.alpha_1 is None else self.config.alpha_1
        self.period = self.config.period or body.period
        if not (self.alpha_1 > 0.0 and 0.0 < self.config.alpha_2 * self.period <= 1.0):
            raise InvalidSetup(
                "gains of the filter", got=(self.alpha_1, self.config.alpha_2), allowed="above 0, α₂dt ≤ 1"
            )
        self._limits = limits_of(body)
        self._spheres = Spheres(body)
        self._own = OwnPairs(body, self._spheres, self.config.self_margin, self.alpha_1)
        self._closest = ClosestControl(self._limits.acceleration, weight)
        self._v, self._u = np.zeros(body.n), np.zeros(body.n)
        self.observe(())

    def observe(self, obstacles: Sequence[Obstacle], stamp: float = 0.0) -> None:
        """Replace the obstacle table by what was seen at `stamp` [s]; a non-finite number in it stops the robot."""
        numbers = [_numbers(thing) for thing in obstacles]
        self._believed = bool(np.isfinite(stamp) and all(np.isfinite(row).all() for row in numbers))
        usable = tuple(obstacles) if self._believed else ()
        self._things = ThingPairs(self.body, self._spheres, usable, self.alpha_1) if usable else None
        self._names, self._stamp = tuple(thing.name for thing in usable), stamp
        self._moving = any(not thing.static for thing in usable)

    def __call__(
        self, q: Array, v: Array, u_nom: Array, now: float = 0.0, *, opening: float = 0.0
    ) -> FilteredAcceleration:
        """One control step from joint positions, velocities and the nominal acceleration, each (n,), SI.

        `now` [s] is on the clock of `observe`'s stamps.
        """
        q, v, wish = (np.asarray(x, float).reshape(-1) for x in (q, v, u_nom))
        bad = self._refusal(q, v, wish, now, opening)
        self._v = self._v + self.period * self._u if Reason.BAD_INPUT in bad else v.copy()
        if bad:
            limit = self._limits.acceleration
            answer = self._told(_blank(wish), self._brake(self._v, -limit, limit), Status.STOPPED, bad)
        else:
            answer = self._step(q, v, wish, max(0.0, now - self._stamp), opening)
        self._u = answer.u
        return answer

    def _refusal(self, q: Array, v: Array, wish: Array, now: float, opening: float) -> Reason:
        n, limits, bad = self.body.n, self._limits, Reason(0)
        if any(x.shape != (n,) for x in (q, v, wish)):
            raise InvalidSetup("sizes of q, v and u_nom", got=(len(q), len(v), len(wish)), allowed=f"{n} numbers each")
        if not (
            np.isfinite([*q, *v, *wish, now, opening]).all() and np.all(np.abs(v) < UNBELIEVABLE * limits.velocity)
        ):
            return Reason.BAD_INPUT
        if np.any(q < limits.lower - FAR_OUTSIDE) or np.any(q > limits.upper + FAR_OUTSIDE):
            bad |= Reason.OUTSIDE_LIMITS
        if not self._believed:
            bad |= Reason.BAD_SCENE
        if self._moving and now - self._stamp > self.config.stale_after:
            bad |= Reason.STALE_SCENE
        return bad

    # --- one step ---------------------------------------------------------------------------------------------

    def _step(self, q: Array, v: Array, wish: Array, age: float, opening: float) -> FilteredAcceleration:
        dt, limits = self.period, self._limits
        lower, upper = acceleration_box(limits, q, v, dt, self.config.recovery_speed)
        pairs = self._pairs(q, v, age, opening, lower, upper)
        psi = pairs.rate + pairs.alpha_1 * pairs.h
        gain = np.where(psi < 0.0, 1.0 / dt, self.config.alpha_2)
        free = pairs.rest + pairs.alpha_1 * pairs.rate + gain * psi
        may = free < pairs.authority
        kept, A, b = self._rows(pairs.only(may), free[may], lower, upper)
        seen = msgspec.structs.replace(
            _blank(wish), h_min=float(pairs.h.min(initial=np.inf)), psi_min=float(psi.min(initial=np.inf)),
            inside=self._named(pairs, pairs.h < 0.0), too_fast=self._named(pairs, psi < 0.0), n_rows=len(b),
        )  # fmt: skip
        brake = self._brake(v, lower, upper)
        return self._solve(seen, kept, A, b, lower, upper, brake)

    def _pairs(self, q: Array, v: Array, age: float, opening: float, lower: Array, upper: Array) -> Pairs:
        """All pairs at this state; what the period may change counts the acceleration's error too."""
        error, dt = self.config.acceleration_error, self.period
        self._motion = self._spheres.at(q, v, opening)
        seen = courses(self._spheres, self._motion, v, lower - error, upper + error, dt)
        own = self._own.at(self._motion, seen, dt)
        return own if self._things is None else joined(self._things.at(self._motion, seen[0], age, dt), own)

    def _rows(self, pairs: Pairs, free: Array, lower: Array, upper: Array) -> tuple[Pairs, Array, Array]:
        """Rows A u ≥ b of those pairs that some control in the box would bring below their bound."""
        J = self._motion.jacobian
        columns = J[pairs.far] - J[pairs.near] * (pairs.near != OWN)[:, None, None]
        A = np.einsum("pi,pni->pn", pairs.normal, columns)
        b = -free + self.config.acceleration_error * np.abs(A).sum(axis=1)
        binds = np.minimum(A * lower, A * upper).sum(axis=1) < b
        return pairs.only(binds), np.ascontiguousarray(A[binds]), b[binds]

    def _solve(
        self, seen: FilteredAcceleration, pairs: Pairs, A: Array, b: Array, lower: Array, upper: Array, brake: Array
    ) -> FilteredAcceleration:
        limit = UNBELIEVABLE * self._limits.acceleration
        found = self._closest.solve(A, b, lower, upper, np.clip(seen.u_nom, -limit, limit))
        seen = msgspec.structs.replace(seen, active=self._active(found, pairs), iterations=found.iterations)
        if found.met:
            same = np.array_equal(found.u, seen.u_nom)
            return self._told(seen, found.u, Status.SAFE if same else Status.MODIFIED, Reason(0))
        late = pairs.rate + pairs.alpha_1 * pairs.h < 0.0
        floor = above(A, b, brake)
        conflict = Conflict(self._closest, A, b, np.ones(len(b)), lower, upper, brake, floor)
        least, lost = conflict.least(2 * pairs.rank + late)
        seen = msgspec.structs.replace(seen, given_up=tuple(dict.fromkeys(Rank(rank // 2) for rank in lost)))
        if not least.met:
            return self._told(seen, brake, Status.STOPPED, Reason.QP_ITERATIONS)
        reason = Reason.QP_ITERATIONS if found.capped else Reason.INFEASIBLE
        return self._told(seen, least.u, Status.RELAXED, reason)

    def _brake(self, v: Array, lower: Array, upper: Array) -> Array:
        """The hardest braking along the path: −k q̇ with the largest k that the acceleration limits admit."""
        fastest = float(np.max(np.abs(v) / self._limits.acceleration))
        return np.clip(-v * min(1.0 / self.period, 1.0 / max(fastest, 1e-12)), lower, upper)

    # --- words ------------------------------------------------------------------------------------------------

    def _told(self, seen: FilteredAcceleration, u: Array, status: Status, reason: Reason) -> FilteredAcceleration:
        wish = np.nan_to_num(seen.u_nom, posinf=0.0, neginf=0.0)
        apart = (u - np.clip(wish, -1e9, 1e9)) / self._limits.acceleration
        delta = float(np.sqrt(np.mean(apart**2)))
        return msgspec.structs.replace(seen, u=u, status=status, reason=reason, delta=delta)

    def _active(self, found: Closest, pairs: Pairs) -> tuple[tuple[str, float], ...]:
        n = self._spheres.n
        names = [f"{joint.name} {side}" for side in ("lower", "upper") for joint in self.body.joints]
        return tuple((names[i] if i < 2 * n else self._name(pairs, i - 2 * n), weight) for i, weight in found.active)

    def _named(self, pairs: Pairs, which: NDArray[np.bool_]) -> tuple[str, ...]:
        """Names of the marked pairs, each once, the deepest first."""
        marked = np.flatnonzero(which)
        return tuple(dict.fromkeys(self._name(pairs, int(i)) for i in marked[np.argsort(pairs.h[marked])]))

    def _name(self, pairs: Pairs, i: int) -> str:
        """A pair's name, as `SafetyFilter` gives it: "hand vs 'cup'", "link5 vs link2"."""
        near, thing = int(pairs.near[i]), int(pairs.thing[i])
        other = self._spheres.names[near] if thing == OWN else repr(self._names[thing])
        return f"{self._spheres.names[int(pairs.far[i])]} vs {other}"


def _blank(wish: Array) -> FilteredAcceleration:
    return FilteredAcceleration(u=np.zeros_like(wish), u_nom=wish, status=Status.STOPPED)


def _numbers(thing: Obstacle) -> Array:
    """Every number of an obstacle."""
    shape = [x for part in msgspec.structs.astuple(thing.shape) for x in np.atleast_1d(np.asarray(part, float))]
    pose = (*thing.pose.position, *thing.pose.quaternion, *thing.velocity)
    return np.array([*shape, *pose, thing.margin, thing.velocity_error, thing.alpha or 0.0])
