"""Safety filter on joint accelerations: a barrier of relative degree two for every pair, in one QP (Xiao and Belta)."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.core.geometry.validation import (
    as_real_array,
    check_length,
    check_positive,
    check_real,
    check_stamp,
)
from dualbrain.errors import ConfigurationError, GeometryError
from dualbrain.robots.collision_model.opening_hull import opening_hull
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import MAX_AGE, MAX_GAIN, MAX_MARGIN, MAX_RATE
from dualbrain.safety.cbf.kernel import MAX_OBSTACLES
from dualbrain.safety.cbf.obstacles import MAX_CLOCK_LEAD, Obstacle, check_obstacles
from dualbrain.safety.cbf.qp import ControlQp, QpResult
from dualbrain.safety.cbf.relaxation import RelaxationProblem, floor_at_control
from dualbrain.safety.cbf.result import FilterStatus, Reason
from dualbrain.safety.cbf.rows import Rank
from dualbrain.safety.higher_order.acceleration_box import acceleration_box, joint_limits
from dualbrain.safety.higher_order.pairs import NO_INDEX, ObstaclePairs, Pairs, SelfCollisionPairs, concatenate
from dualbrain.safety.higher_order.result import FilteredAcceleration
from dualbrain.safety.higher_order.sampling_margin import motion_bounds
from dualbrain.safety.higher_order.sphere_kinematics import SphereKinematics
from dualbrain.safety.stop_cause import describe_age, describe_not_finite, describe_position, describe_refusal

Array = NDArray[np.float64]
MAX_LIMIT_EXCESS = 0.2
"""Excess over a joint limit [rad] above which the filter rejects the state."""
MAX_OPENING_EXCESS = 0.005
"""Excess of a finger opening over the range of the gripper [m] above which the filter rejects the state."""
MAX_ACCELERATION_ERROR = 1e4
IMPLAUSIBLE_FACTOR = 10.0
"""Multiple of a limit above which the filter rejects a velocity, and to which it clips a nominal control."""


class AccelerationConfig(msgspec.Struct, frozen=True, kw_only=True):
    """Configuration of the acceleration filter.

    - `alpha_1`, `alpha_2` [1/s]: gains of ψ₁ = ḣ + α₁h and of ψ̇₁ + α₂ψ₁ ≥ 0. With None, α₁ is 0.8 of the gain that the
      acceleration limits can follow at full speed, min_i a_i/v_i; the rest is for the curvature of the arm's motion.
      `Obstacle.alpha` replaces α₁ for one obstacle.
    - `acceleration_error` [rad/s²]: bound of |q̈ − u| of every joint.
    - `self_margin` [m]: clearance between links. `recovery_speed` [rad/s]: speed of return from beyond a joint limit.
    - `scene_stale_after` [s]: age after which moving obstacles are rejected.
    - `period` [s]: control period instead of that of the robot model.

    Raises `GeometryError` for a value of another type, below zero, or not finite.
    """

    alpha_1: float | None = None
    alpha_2: float = 20.0
    acceleration_error: float = 0.0
    self_margin: float = 0.0
    recovery_speed: float = 0.05
    scene_stale_after: float = 0.5
    period: float | None = None

    def __post_init__(self) -> None:
        """Check every field, also of a configuration that `msgspec.structs.replace` makes."""
        if self.alpha_1 is not None:
            check_positive("AccelerationConfig.alpha_1 [1/s]", self.alpha_1, MAX_GAIN)
        check_positive("AccelerationConfig.alpha_2 [1/s]", self.alpha_2, MAX_GAIN)
        check_length("AccelerationConfig.acceleration_error [rad/s²]", self.acceleration_error, MAX_ACCELERATION_ERROR)
        check_length("AccelerationConfig.self_margin [m]", self.self_margin, MAX_MARGIN)
        check_length("AccelerationConfig.recovery_speed [rad/s]", self.recovery_speed, MAX_RATE)
        check_length("AccelerationConfig.scene_stale_after [s]", self.scene_stale_after, MAX_AGE)
        if self.period is not None:
            check_positive("AccelerationConfig.period [s]", self.period, 1.0)


class _Body:
    """Spheres and pairs of one collision model: with fingers that slide, or with fingers that cover every opening."""

    def __init__(self, robot_model: RobotModel, self_margin: float, alpha_1: float) -> None:
        self.robot_model, self._alpha_1 = robot_model, alpha_1
        self.spheres = SphereKinematics(robot_model)
        self.self_pairs = SelfCollisionPairs(robot_model, self.spheres, self_margin, alpha_1)
        self.obstacle_pairs: ObstaclePairs | None = None

    def observe(self, obstacles: Sequence[Obstacle]) -> None:
        """Prepare the pairs with `obstacles`."""
        self.obstacle_pairs = (
            ObstaclePairs(self.robot_model, self.spheres, obstacles, self._alpha_1) if obstacles else None
        )


class AccelerationFilter:
    """Closest safe joint acceleration: min ½‖u − u_nom‖²_R s.t. one row for every pair, u in the box; q̈ = u.

    For the gap h of a sphere and an obstacle, or of two spheres of the robot, with unit normal n, relative velocity w
    and distance d (relative degree two; Xiao and Belta, "Control barrier functions for systems with high relative
    degree", CDC 2019):

        ψ₁ = ḣ + α₁h,   ḣ = n'(J q̇ − v_o),   ψ₂ = ψ̇₁ + α₂ψ₁ ≥ m:
        n'J u + n'J̇q̇ + κ + (α₁ + α₂) ḣ + α₁α₂ h ≥ m,

    with κ ≥ 0 for the curvature of the distance (`distances`) and m for the length of the period (`sampling_margin`).
    Joint limits are the box (`acceleration_box`), which is never relaxed.

    Guarantee: if h ≥ 0 and ψ₁ ≥ 0 for all pairs at the start, every step is `certified`, u is held for one period with
    q̈ = u within `acceleration_error`, and obstacles move at their reported velocity within `velocity_error`, then h ≥ 0
    and ψ₁ ≥ 0 at all times, also between samples. A new observation of a moving obstacle is a new start. Under
    acceleration limits rows can conflict. The result is then RELAXED, and only the following holds.

    For ψ₁ < 0 (`too_fast_pairs`) the row asks for ψ₁ ≥ 0 at the end of the period, as fast as the box allows.
    Conflicting rows are relaxed by rank, in each rank rows with ψ₁ < 0 last, as little as possible. No row is violated
    more than by braking along the path, u = −k q̇ with the largest admissible k.
    """

    def __init__(
        self, robot_model: RobotModel, config: AccelerationConfig | None = None, *, weight: Array | None = None
    ) -> None:
        """Prepare the spheres and pairs of `robot_model`; `weight` is R (n, n), by default diag(1/a_max²).

        Raises:
            ConfigurationError: the base is mobile, a gain is outside its range, or R is not positive definite.
        """
        self.robot_model, self.config = robot_model, config or AccelerationConfig()
        if robot_model.base != "fixed":
            raise ConfigurationError("base of the robot model", got=robot_model.base, allowed="fixed")
        self.alpha_1 = 0.8 * robot_model.alpha if self.config.alpha_1 is None else self.config.alpha_1
        self.period = self.config.period or robot_model.period
        if not (self.alpha_1 > 0.0 and 0.0 < self.config.alpha_2 * self.period <= 1.0):
            raise ConfigurationError(
                "gains of the filter", got=(self.alpha_1, self.config.alpha_2), allowed="α₁ and α₂ above 0, α₂dt ≤ 1"
            )
        self._limits = joint_limits(robot_model)
        self._known_body = _Body(robot_model, self.config.self_margin, self.alpha_1)
        hull = opening_hull(robot_model)
        self._hull_body = (
            self._known_body if hull is robot_model else _Body(hull, self.config.self_margin, self.alpha_1)
        )
        self._body, self._spheres = self._known_body, self._known_body.spheres
        self._qp = ControlQp(self._limits.acceleration, weight)
        self._v, self._u = np.zeros(robot_model.n), np.zeros(robot_model.n)
        self.observe(())

    def observe(self, obstacles: Sequence[Obstacle], stamp: float = 0.0) -> None:
        """Replace the obstacle table by `obstacles`, observed at `stamp` [s].

        If this raises, the previous table is no longer in force: every step stops the robot until a valid observation.

        Raises:
            GeometryError: there are too many obstacles, or one has a number, size, pose, shape or field that is not
                usable (`dualbrain.core.geometry.validation`), or `stamp` is not finite.
            ConfigurationError: an obstacle has speed and separation, which is a rule on velocities.
            UnknownNameError: an obstacle names a part that the robot does not have.
        """
        self._scene_valid, self._bad_scene = False, "the last observation was refused"
        try:
            self._replace_obstacles(obstacles, stamp)
        except BaseException as error:
            self._bad_scene = f"the last observation was refused: {describe_refusal(error)}"
            raise
        self._scene_valid = True

    def _replace_obstacles(self, obstacles: Sequence[Obstacle], stamp: float) -> None:
        usable = check_obstacles(obstacles, MAX_OBSTACLES)
        self._stamp = check_stamp("stamp of the observation", stamp)
        for body in dict.fromkeys((self._known_body, self._hull_body)):
            body.observe(usable)
        self._names = tuple(obstacle.name for obstacle in usable)
        self._has_moving_obstacles = any(obstacle.moves for obstacle in usable)

    def __call__(
        self, q: ArrayLike, v: ArrayLike, u_nom: ArrayLike, now: float = 0.0, *, opening: float | None = None
    ) -> FilteredAcceleration:
        """Run one control step from joint positions, velocities and the nominal acceleration, each (n,), in SI units.

        `now` [s] must be on the clock of the stamps passed to `observe`. Without the `opening` [m] of each finger, the
        spheres of the fingers cover every opening. Raises `ConfigurationError` for wrong sizes and types.
        """
        n, given = self.robot_model.n, {"q": q, "v": v, "u_nom": u_nom}
        q, v, desired = arrays = [as_real_array(f"{name} of a step", values) for name, values in given.items()]
        if any(values.shape != (n,) for values in arrays):
            shapes = tuple(values.shape for values in arrays)
            raise GeometryError("sizes of q, v and u_nom", got=shapes, allowed=f"{n} numbers each")
        now = check_real("now of a step", now)
        known = 0.0 if opening is None else check_real("opening of a step", opening)
        faults = self._input_faults(q, v, desired, now, known)
        self._v = self._v + self.period * self._u if Reason.BAD_INPUT in faults else v.copy()
        if faults:
            limit = self._limits.acceleration
            result = self._finish(
                _empty_result(desired), self._brake(self._v, -limit, limit), FilterStatus.STOPPED, faults
            )
            result = msgspec.structs.replace(result, detail=self._describe_faults(faults, q, v, desired, now, known))
        else:
            self._body = self._hull_body if opening is None else self._known_body
            result = self._step(q, v, desired, max(0.0, now - self._stamp), known)
        self._u = result.u
        return result

    def _input_faults(self, q: Array, v: Array, u_nom: Array, now: float, opening: float) -> Reason:
        limits, faults = self._limits, Reason(0)
        if not (
            np.isfinite([*q, *v, *u_nom, now, opening]).all()
            and np.all(np.abs(v) < IMPLAUSIBLE_FACTOR * limits.velocity)
            and self._opening_is_plausible(opening)
        ):
            return Reason.BAD_INPUT
        if np.any(q < limits.lower - MAX_LIMIT_EXCESS) or np.any(q > limits.upper + MAX_LIMIT_EXCESS):
            faults |= Reason.OUTSIDE_LIMITS
        if not self._scene_valid:
            return faults | Reason.BAD_SCENE
        age = now - self._stamp
        if (self._has_moving_obstacles and age > self.config.scene_stale_after) or (
            self._names and age < -MAX_CLOCK_LEAD
        ):
            faults |= Reason.STALE_SCENE
        return faults

    def _opening_is_plausible(self, opening: float) -> bool:
        """Whether the gripper can be open that far; true for a robot without sliding fingers."""
        most = self.robot_model.gripper.opening.value
        without_fingers = self._hull_body is self._known_body
        return without_fingers or -MAX_OPENING_EXCESS <= opening <= most + MAX_OPENING_EXCESS

    def _describe_faults(self, faults: Reason, q: Array, v: Array, u_nom: Array, now: float, opening: float) -> str:
        """The numbers behind the faults of an input."""
        limits, parts = self._limits, list[str]()
        if Reason.BAD_INPUT in faults:
            parts.append(
                describe_not_finite(q=q, v=v, u_nom=u_nom, now=now, opening=opening)
                or self._describe_implausible(v, opening)
            )
        if Reason.OUTSIDE_LIMITS in faults:
            k = int(np.argmax(np.maximum(q - limits.upper, limits.lower - q)))
            limit = limits.upper[k] if q[k] > limits.upper[k] else limits.lower[k]
            parts.append(describe_position(self.robot_model.joints[k].name, float(q[k]), float(limit)))
        if Reason.BAD_SCENE in faults:
            parts.append(self._bad_scene)
        if Reason.STALE_SCENE in faults:
            parts.append(describe_age(now - self._stamp, self.config.scene_stale_after))
        return "; ".join(parts)

    def _describe_implausible(self, v: Array, opening: float) -> str:
        """The finite input that is not plausible."""
        if not self._opening_is_plausible(opening):
            return f"opening is {opening:g}, the gripper opens by {self.robot_model.gripper.opening.value:g} [m]"
        limit = self._limits.velocity
        k = int(np.argmax(np.abs(v) / limit))
        return f"v[{k}] is {v[k]:g}, more than {IMPLAUSIBLE_FACTOR:g} times its limit {limit[k]:g} [rad/s]"

    # --- one step ---------------------------------------------------------------------------------------------

    def _step(self, q: Array, v: Array, u_nom: Array, age: float, opening: float) -> FilteredAcceleration:
        dt, limits = self.period, self._limits
        lower, upper = acceleration_box(limits, q, v, dt, self.config.recovery_speed)
        pairs = self._pairs(q, v, age, opening, lower, upper)
        psi = pairs.h_dot + pairs.alpha_1 * pairs.h
        gain = np.where(psi < 0.0, 1.0 / dt, self.config.alpha_2)
        free = pairs.drift + pairs.alpha_1 * pairs.h_dot + gain * psi
        may = free < pairs.authority
        kept, A, b = self._rows(pairs.select(may), free[may], lower, upper)
        seen = msgspec.structs.replace(
            _empty_result(u_nom),
            h_min=float(pairs.h.min(initial=np.inf)),
            psi_min=float(psi.min(initial=np.inf)),
            penetrating_pairs=self._pair_names(pairs, pairs.h < 0.0),
            too_fast_pairs=self._pair_names(pairs, psi < 0.0),
            n_rows=len(b),
        )
        brake = self._brake(v, lower, upper)
        return self._solve(seen, kept, A, b, lower, upper, brake)

    def _pairs(self, q: Array, v: Array, age: float, opening: float, lower: Array, upper: Array) -> Pairs:
        """All pairs at this state; motion bounds over the period include the acceleration error."""
        error, dt = self.config.acceleration_error, self.period
        body = self._body
        self._motion = body.spheres.motion(q, v, opening)
        seen = motion_bounds(body.spheres, self._motion, v, lower - error, upper + error, dt)
        own = body.self_pairs.compute(self._motion, seen, dt)
        return (
            own
            if body.obstacle_pairs is None
            else concatenate(body.obstacle_pairs.compute(self._motion, seen[0], age, dt), own)
        )

    def _rows(self, pairs: Pairs, free: Array, lower: Array, upper: Array) -> tuple[Pairs, Array, Array]:
        """Rows A u ≥ b of the pairs whose bound some control in the box would violate."""
        J = self._motion.jacobian
        columns = J[pairs.sphere] - J[pairs.near_sphere] * (pairs.near_sphere != NO_INDEX)[:, None, None]
        A = np.einsum("pi,pni->pn", pairs.normal, columns)
        b = -free + self.config.acceleration_error * np.abs(A).sum(axis=1)
        binds = np.minimum(A * lower, A * upper).sum(axis=1) < b
        return pairs.select(binds), np.ascontiguousarray(A[binds]), b[binds]

    def _solve(
        self, result: FilteredAcceleration, pairs: Pairs, A: Array, b: Array, lower: Array, upper: Array, brake: Array
    ) -> FilteredAcceleration:
        limit = IMPLAUSIBLE_FACTOR * self._limits.acceleration
        found = self._qp.solve(A, b, lower, upper, np.clip(result.u_nom, -limit, limit))
        result = msgspec.structs.replace(
            result, active_rows=self._active_rows(found, pairs), iterations=found.iterations
        )
        if found.rows_met:
            same = np.array_equal(found.u, result.u_nom)
            return self._finish(result, found.u, FilterStatus.SAFE if same else FilterStatus.MODIFIED, Reason(0))
        late = pairs.h_dot + pairs.alpha_1 * pairs.h < 0.0
        floor = floor_at_control(A, b, brake)
        conflict = RelaxationProblem(
            qp=self._qp,
            A=A,
            b=b,
            violation_unit=np.ones(len(b)),
            lower=lower,
            upper=upper,
            reference=brake,
            floor=floor,
        )
        relaxed, relaxed_ranks = conflict.solve(2 * pairs.rank + late)
        result = msgspec.structs.replace(
            result, relaxed_ranks=tuple(dict.fromkeys(Rank(rank // 2) for rank in relaxed_ranks))
        )
        if not relaxed.rows_met:
            result = msgspec.structs.replace(result, detail=f"{found.iterations} iterations for {len(b)} rows")
            return self._finish(result, brake, FilterStatus.STOPPED, Reason.QP_ITERATIONS)
        reason = Reason.QP_ITERATIONS if found.limit_reached else Reason.INFEASIBLE
        return self._finish(result, relaxed.u, FilterStatus.RELAXED, reason)

    def _brake(self, v: Array, lower: Array, upper: Array) -> Array:
        """The hardest braking along the path: −k q̇ with the largest k that the acceleration limits admit."""
        fastest = float(np.max(np.abs(v) / self._limits.acceleration))
        return np.clip(-v * min(1.0 / self.period, 1.0 / max(fastest, 1e-12)), lower, upper)

    # --- results ----------------------------------------------------------------------------------------------

    def _finish(
        self, result: FilteredAcceleration, u: Array, status: FilterStatus, reason: Reason
    ) -> FilteredAcceleration:
        desired = np.nan_to_num(result.u_nom, posinf=0.0, neginf=0.0)
        change = (u - np.clip(desired, -1e9, 1e9)) / self._limits.acceleration
        delta = float(np.sqrt(np.mean(change**2)))
        return msgspec.structs.replace(result, u=u, status=status, reason=reason, delta=delta)

    def _active_rows(self, solution: QpResult, pairs: Pairs) -> tuple[tuple[str, float], ...]:
        n = self._spheres.n
        names = [f"{joint.name} {side}" for side in ("lower", "upper") for joint in self.robot_model.joints]
        return tuple(
            (names[i] if i < 2 * n else self._pair_name(pairs, i - 2 * n), weight) for i, weight in solution.active
        )

    def _pair_names(self, pairs: Pairs, which: NDArray[np.bool_]) -> tuple[str, ...]:
        """Names of the marked pairs, each once, those with the smallest h first."""
        marked = np.flatnonzero(which)
        return tuple(dict.fromkeys(self._pair_name(pairs, int(i)) for i in marked[np.argsort(pairs.h[marked])]))

    def _pair_name(self, pairs: Pairs, i: int) -> str:
        """Name of a pair in the format of `SafetyFilter`: "hand vs 'cup'", "link5 vs link2"."""
        near, obstacle = int(pairs.near_sphere[i]), int(pairs.obstacle[i])
        other = self._spheres.names[near] if obstacle == NO_INDEX else repr(self._names[obstacle])
        return f"{self._spheres.names[int(pairs.sphere[i])]} vs {other}"


def _empty_result(u_nom: Array) -> FilteredAcceleration:
    return FilteredAcceleration(u=np.zeros_like(u_nom), u_nom=u_nom, status=FilterStatus.STOPPED)
