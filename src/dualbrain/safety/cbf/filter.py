"""The local safety filter (paper 4): the closest safe control to a nominal one, every control period."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, sin

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Box
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.records import SceneObject
from dualbrain.robots.differential_drive import integrate_arc
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.batch import BatchResult, run_batch
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.kernel import make_kernel, max_gain, obstacle_table, tool_frame
from dualbrain.safety.cbf.obstacles import Contact, Obstacle, SpeedAndSeparation
from dualbrain.safety.cbf.result import FilterResult, FilterStatus, RowNames
from dualbrain.safety.cbf.rows import BarrierRow, ConstraintRow, PythonBarrier, Rank, row_table

__all__ = [
    "BarrierRow",
    "Contact",
    "FilterConfig",
    "FilterResult",
    "PythonBarrier",
    "Obstacle",
    "Rank",
    "ConstraintRow",
    "SafetyFilter",
    "SpeedAndSeparation",
    "FilterStatus",
    "ToolState",
]

Array = NDArray[np.float64]

HELD = "held"
MAX_ROWS = 16
"""Rows that may be handed in for one step."""


@dataclass(frozen=True, slots=True)
class ToolState:
    """Where the tool is: position (3,) [m], rotation (3, 3), Jacobian (6, n) of linear then angular velocity."""

    position: Array
    rotation: Array
    jacobian: Array


class SafetyFilter:
    """Closest safe control to the nominal one: min ½‖u − u_nom‖²_R s.t. A u ≥ b, u in the box (paper 4.3).

    Promise: if `certified` and the model holds (spheres cover the body, obstacles are where they are said to be within
    their margins, ẏ = u within `tracking_error` for y = q + lag v), no h falls below zero before the next update. Says
    nothing about obstacles it was not told of. Spheres of the base (frame 0) get no rows: it is bolted to the world.
    """

    def __init__(
        self,
        robot_model: RobotModel,
        config: FilterConfig | None = None,
        *,
        weight: Array | None = None,
        barriers: Sequence[PythonBarrier] = (),
        fixed_obstacles: Sequence[Obstacle] = (),
    ) -> None:
        """Compile `body` for the kernel; `weight` is R (n, n), by default diag(1/v_max²).

        `barriers` are asked for their rows in every step; `standing` obstacles stay beside whatever is observed.
        """
        self.robot_model, self.config = robot_model, config or FilterConfig()
        self._n = robot_model.n
        self._mobile = robot_model.base == "differential"
        self._base_lag = (robot_model.base_lag or 0.0) if self.config.lag_compensation else 0.0
        self._barriers = tuple(barriers)
        self._needs_state = self._mobile or bool(self._barriers)
        self._rows: tuple[ConstraintRow, ...] = ()
        self._extra_rows: tuple[ConstraintRow, ...] = ()
        self._kernel = make_kernel(robot_model, self.config, weight)
        self._step = self._kernel.step
        self._max_gain = max_gain(robot_model, self.config) if self.config.tracking_error is None else np.inf
        self._stamp = 0.0
        self._obstacles: tuple[Obstacle, ...] = ()
        self._permits: tuple[Contact, ...] = ()
        self._tool_rotation, self._tool_offset = tool_frame(robot_model)
        self._part_links = _links_by_part(robot_model)
        links = [link.name for link in robot_model.links for sphere in robot_model.spheres if sphere.link == link.name]
        self._names = RowNames(
            spheres=tuple(links),
            obstacles=(),
            joints=tuple(joint.name for joint in robot_model.joints),
            v_max=tuple(j.velocity.value for j in robot_model.joints),
        )
        groups = {link.name: link.group for link in robot_model.links}
        self._groups = tuple(groups[name] for name in self._names.spheres)
        self._fixed_obstacles = tuple(fixed_obstacles)
        self.keep_out_boxes = tuple(
            SceneObject(
                name=one.name, role="obstacle", shape=one.shape, pose=one.pose, error=one.margin, category="keep_out"
            )
            for one in self._fixed_obstacles
            if isinstance(one.shape, Box)
        )
        """The boxes among what stands there for good, as things, for those who look for ways."""
        if fixed_obstacles:
            self.observe(())

    # --- what the filter knows --------------------------------------------------------------------------------

    def observe(self, obstacles: Sequence[Obstacle], stamp: float = 0.0) -> None:
        """Replace the obstacle table by what was seen at `stamp` [s]; a non-finite number in it stops the robot."""
        obstacles = (*obstacles, *self._fixed_obstacles)
        self._check_gains(obstacles)
        self._kernel.set_obstacles(obstacle_table(obstacles, self._part_links))
        self._obstacles, self._stamp = obstacles, stamp
        self._names = msgspec.structs.replace(
            self._names,
            obstacles=tuple(thing.name for thing in obstacles),
            barriers=tuple(thing.barrier for thing in obstacles),
        )
        self._apply_permits()

    def _check_gains(self, obstacles: Sequence[Obstacle]) -> None:
        """What the rows keep for tracking was measured up to the filter's own largest gain."""
        for thing in obstacles:
            if thing.alpha is not None and thing.alpha > self._max_gain:
                raise ConfigurationError(
                    f"alpha of obstacle {thing.name!r}",
                    got=thing.alpha,
                    allowed=f"at most {self._max_gain:.6g} 1/s, up to where the rows keep the tracking error",
                    fix="Raise FilterConfig.alpha, or give FilterConfig.tracking_error for this gain.",
                )

    def constrain(self, rows: Sequence[ConstraintRow]) -> None:
        """Rows a'u ≥ b that hold from now on, until others are given: at most 16 with those of the live barriers."""
        self._rows = tuple(rows)
        self._set_rows(self._rows)

    @property
    def extra_rows(self) -> tuple[ConstraintRow, ...]:
        """The rows of the last step that no table holds: those of `constrain`, and what live barriers asked for."""
        return self._extra_rows

    def _set_rows(self, rows: Sequence[ConstraintRow]) -> None:
        for row in rows:
            if len(row.a) != self.robot_model.n:
                raise ConfigurationError(
                    f"row {row.name!r}", got=len(row.a), allowed=f"{self.robot_model.n} coefficients"
                )
        if len(rows) > MAX_ROWS:
            raise ConfigurationError("rows at once", got=len(rows), allowed=f"at most {MAX_ROWS}")
        self._kernel.constrain(row_table(rows, self.robot_model.n))
        self._extra_rows = tuple(rows)
        self._names = msgspec.structs.replace(self._names, rows=tuple(row.name for row in rows))

    def _update_python_barriers(self, state: RobotState) -> None:
        """Rows of the live barriers at this state."""
        jacobian = self.tool(state.q).jacobian
        live = [row for barrier in self._barriers for row in barrier.rows(state, jacobian)]
        self._set_rows((*self._rows, *live))

    def permit(self, permits: Sequence[Contact]) -> None:
        """The complete list of contacts that are allowed from now on; every other pair is kept apart again."""
        for contact in permits:
            if contact.robot_part not in self._part_links:
                raise UnknownNameError(
                    "part of the robot", contact.robot_part, tuple(self._part_links), owner=self.robot_model.name
                )
            if not contact.speed >= 0.0:
                raise ConfigurationError("contact speed [m/s]", got=contact.speed, allowed="0 or more")
        self._permits = tuple(permits)
        self._apply_permits()

    def _apply_permits(self) -> None:
        self._kernel.clear_permits()
        for contact in self._permits:
            for index, obstacle in enumerate(self._obstacles):
                if obstacle.name == contact.obstacle:
                    for link in self._part_links[contact.robot_part]:
                        self._kernel.permit(link, index, contact.speed)

    def attach(self, spheres: Array, error: float) -> None:
        """Carry `spheres` (k, 4) of x, y, z, radius [m] in the tool frame, k ≤ 8; `error` [m] inflates their rows."""
        held = np.asarray(spheres, float).reshape(-1, 4).copy()
        held[:, :3] = held[:, :3] @ self._tool_rotation.T + self._tool_offset
        if len(held) > 8 or not np.all(np.linalg.norm(held[:, :3] - self._tool_offset, axis=1) <= 0.5):
            raise ConfigurationError("held spheres", got=len(held), allowed="at most 8, within 0.5 m of the tool")
        self._kernel.attach(np.ascontiguousarray(held), error)

    def detach(self) -> None:
        """Nothing is held any more."""
        self._kernel.attach(np.empty((0, 4)), 0.0)

    def reset(self, u_prev: Array | float = 0.0) -> None:
        """Forget the past: the robot moves at `u_prev` (n,) [rad/s]."""
        self._kernel.reset(np.ascontiguousarray(np.broadcast_to(np.asarray(u_prev, float), (self.robot_model.n,))))

    # --- control ----------------------------------------------------------------------------------------------

    def __call__(self, q: Array, v: Array, u_nom: Array, now: float = 0.0, opening: float = 0.0) -> FilterResult:
        """One control step from joint angles q, velocities v and the nominal control u_nom, each (n,), SI.

        With moving obstacles `now` [s] must be the time on the clock of `observe`'s stamps; the state counts as fresh.
        """
        if self._needs_state:
            q, v = np.asarray(q, float), np.asarray(v, float)
            return self.filter(
                RobotState(stamp=now, sequence=0, q=q, v=v, opening=opening, finger_forces=(0.0, 0.0)), u_nom, now
            )
        try:
            return self._step(q, v, u_nom, opening, 0.0, now - self._stamp, self._names)
        except ValueError:
            raise self._shape_error(q=q, v=v, u_nom=u_nom) from None

    def filter(self, state: RobotState, u_nom: Array, now: float) -> FilterResult:
        """One control step; to be called once per period, as it owns the last control and the warm start."""
        state = self._prepare(state)
        ages = (now - state.stamp, now - self._stamp)
        try:
            return self._step(state.q, state.v, u_nom, state.opening, *ages, self._names)
        except ValueError:
            raise self._shape_error(q=state.q, v=state.v, u_nom=u_nom) from None

    def _shape_error(self, **given: object) -> ConfigurationError:
        """Which of the arrays is not (n,) numbers."""
        allowed = f"an array ({self.robot_model.n},) of numbers"
        for name, values in given.items():
            try:
                shape = np.asarray(values, float).shape
            except (TypeError, ValueError):
                return ConfigurationError(f"{name} of a step", got=values, allowed=allowed)
            if shape != (self.robot_model.n,):
                return ConfigurationError(f"{name} of a step", got=shape, allowed=allowed)
        return ConfigurationError(
            "the arrays of a step", got=[type(v).__name__ for v in given.values()], allowed=allowed
        )

    def rows(self) -> tuple[BarrierRow, ...]:
        """Every row of the last step that a control of its box could have violated, or whose pair was within 1 mm.

        In the order of the kernel, the first 512 where there are more; joint limits are not among them, they are bounds
        of the box. Right sides are those of the relaxation where no control met all. To be asked before the obstacles
        are changed; none after an input that was refused.
        """
        names = self._names
        return tuple(
            BarrierRow(names.row_name(kind, i, j), names.barrier_name(kind, i, j), h, np.array(a), b, norm, kind, i, j)
            for kind, i, j, h, norm, b, a in self._kernel.rows()
        )

    def batch(
        self,
        Q: Array,
        V: Array,
        U: Array,
        now: float = 0.0,
        *,
        u_prev: Array | None = None,
        opening: Array | float = 0.0,
    ) -> BatchResult:
        """Filter m independent states, one a row of Q, V and U (m, n): for Monte-Carlo and learning.

        Row i is what a fresh filter answers after `reset(u_prev[i])`, bit for bit; `u_prev` (m, n) is V by default.
        Obstacles, permits, rows handed in and a held object count as for a single call; this filter's own memory is
        neither read nor changed.

        Raises:
            InvalidSetup: the shapes do not agree; or a base that moves, or live barriers: both belong to one state.
        """
        if self._barriers or self._mobile:
            raise ConfigurationError(
                "a batch", got=self.robot_model.name, allowed="a bolted body, no barriers that are computed anew"
            )
        last = V if u_prev is None else u_prev
        return run_batch(self._kernel, self.robot_model.n, Q, V, U, last, opening, now - self._stamp)

    def project(self, state: RobotState, u_desired: Array, u_nom_prev: Array, now: float) -> Array:
        """φ's own projection of a wish (n,): known obstacles, the box around `u_nom_prev`, a little more clearance.

        Where everything is known, `filter` passes the result bit-identically. Leaves the filter's memory alone.
        """
        state = self._prepare(state)
        u = np.empty(self._n)
        ages = (now - state.stamp, now - self._stamp)
        try:
            self._kernel.project(
                state.q, state.v, u_desired, u_nom_prev, state.opening, *ages, self.config.projection_margin, u
            )
        except ValueError:
            raise self._shape_error(q=state.q, v=state.v, u_wish=u_desired, u_nom_prev=u_nom_prev) from None
        return u

    def _prepare(self, state: RobotState) -> RobotState:
        """Hand over the live barriers' rows at `state`; the state in the chain's own terms."""
        if self._barriers:
            self._update_python_barriers(state)
        return replace(state, q=self._lagged_chain_q(state)) if self._mobile else state

    def _lagged_chain_q(self, state: RobotState) -> Array:
        """The chain's angles (n,) for a step; where the base goes on arcs, it is ahead by its own lag, y = q + lag v.

        In the kernel a base slides straight for one period and turns. It stands turned on by half a period's turn ω
        dt/2, its turning joint back by as much: everything is where it is, and the slide points along the chord of
        the arc.
        """
        if self.robot_model.base_lag is None:
            return self._chain_q(state.q)
        x, y, heading, *joints = state.q.tolist()
        v, w = state.v[:2].tolist()
        x, y, heading = integrate_arc(x, y, heading, v, w, self._base_lag)
        half = 0.5 * self.robot_model.period * w
        self._set_base_pose(x, y, heading + half)
        return np.array([0.0, -half, *joints])

    def _chain_q(self, q: Array) -> Array:
        """The chain's angles (n,) at configuration q; a mobile base stands where q says, its own two joints at zero."""
        if not self._mobile:
            return q
        x, y, heading, *joints = q.tolist()
        self._set_base_pose(x, y, heading)
        return np.array([0.0, 0.0, *joints])

    def _set_base_pose(self, x: float, y: float, heading: float) -> None:
        """Tell the kernel where the base stands [m, rad]."""
        c, s = cos(heading), sin(heading)
        self._kernel.set_base_pose(np.array([c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0, x, y, 0.0]))

    # --- kinematics -------------------------------------------------------------------------------------------

    def tool(self, q: Array) -> ToolState:
        """The tool frame at joint angles q (n,) [rad], in the world."""
        n, flat = self._n, np.empty(12 + 6 * self._n)
        self._kernel.tool(self._chain_q(q), flat)
        return ToolState(flat[:3], flat[3:12].reshape(3, 3), flat[12:].reshape(6, n))

    def spheres(self, q: Array, opening: float) -> tuple[Array, Array, tuple[str, ...]]:
        """Centres (k, 3) [m], radii (k,) [m] and group of every sphere, held ones last."""
        flat = np.empty((len(self._groups) + 8, 4))
        count = self._kernel.spheres(self._chain_q(q), opening, flat)
        held = (HELD,) * (count - len(self._groups))
        return flat[:count, :3], flat[:count, 3], self._groups + held


def _links_by_part(robot_model: RobotModel) -> dict[str, tuple[int, ...]]:
    """Link indices behind every name that a permit may use: links, groups (they win over links), what is held."""
    parts: dict[str, tuple[int, ...]] = {link.name: (i,) for i, link in enumerate(robot_model.links)}
    parts |= {
        link.group: tuple(i for i, other in enumerate(robot_model.links) if other.group == link.group)
        for link in robot_model.links
    }
    return parts | {HELD: (len(robot_model.links),)}
