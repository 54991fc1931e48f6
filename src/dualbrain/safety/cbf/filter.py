"""Local safety filter (paper 4): computes the safe control closest to the nominal control in every control period."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, isfinite, nan, sin
from typing import cast

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.core.geometry import validation
from dualbrain.core.geometry.shapes import Box
from dualbrain.errors import ConfigurationError, GeometryError, UnknownNameError
from dualbrain.records import SceneObject
from dualbrain.robots.differential_drive import integrate_arc
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.batch import BatchResult, run_batch
from dualbrain.safety.cbf.compiled import _kernel64_wide as dynamics
from dualbrain.safety.cbf.compiled._kernel import Kernel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.kernel import (
    MAX_OBSTACLES,
    UNUSABLE_TABLE,
    make_kernel,
    max_gain,
    obstacle_table,
    tool_frame,
)
from dualbrain.safety.cbf.obstacles import MAX_CONTACT_SPEED, Contact, Obstacle, SpeedAndSeparation, check_obstacles
from dualbrain.safety.cbf.result import OBSTACLE, FilterResult, FilterStatus, RowNames
from dualbrain.safety.cbf.rows import BarrierRow, ConstraintRow, PythonBarrier, Rank, row_table
from dualbrain.safety.stop_cause import describe_refusal

__all__ = [
    "BarrierRow",
    "ConstraintRow",
    "Contact",
    "FilterConfig",
    "FilterResult",
    "FilterStatus",
    "Obstacle",
    "PythonBarrier",
    "Rank",
    "SafetyFilter",
    "SpeedAndSeparation",
    "ToolState",
]

Array = NDArray[np.float64]

HELD = "held"
MAX_HELD_SPHERES, MAX_HELD_DISTANCE = 8, 0.5
"""Most spheres of a grasped object, and their largest distance from the tool and radius [m]."""
MAX_ROW_COEFFICIENT = 1e6
"""Largest coefficient and right-hand side of a row of `SafetyFilter.constrain`."""
MAX_ROWS = 16
"""Most rows that one step takes from `SafetyFilter.constrain` and from Python barriers together."""


@dataclass(frozen=True, slots=True)
class ToolState:
    """Pose of the tool: position (3,) [m], rotation (3, 3); Jacobian (6, n) of linear, then angular velocity."""

    position: Array
    rotation: Array
    jacobian: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterTables:
    """The tables of a filter: obstacles, their stamp [s], permitted contacts, error of the grasped object [m].

    `grasp_changes` is the number of grasps and releases so far.
    """

    obstacles: tuple[Obstacle, ...]
    stamp: float
    permits: tuple[Contact, ...]
    held_error: float
    grasp_changes: int


class SupervisedTick(msgspec.Struct, frozen=True, kw_only=True):
    """The supervisor's view of one tick at `now` [s], with a joint state of `stamp` [s] and `conditions` (`Condition`).

    `yielding`: the arm yields to a contact force. `standstill`: u = 0 is written, and not the control of the filter.
    `action` is the decision (`SafetyAction`). `stopped`: it is CONTROLLED_STOP or above.
    """

    now: float
    stamp: float
    conditions: int
    yielding: bool = False
    standstill: bool = False
    stopped: bool = False
    action: int = 0


class SafetyFilter:
    """Closest safe control to the nominal one: min ½‖u − u_nom‖²_R s.t. A u ≥ b, u in the box (paper 4.3).

    Guarantee: if the result is `certified` and the model holds, no h falls below zero before the next update. The model
    holds if the spheres cover the robot, every obstacle is at its reported pose within its margin, and ẏ = u within
    `tracking_error` for y = q + lag v. The guarantee covers only `obstacles` and those passed to `observe`. Spheres of
    the base (frame 0) have no rows, because the base is bolted to the world.

    Every argument that is an array may be any sequence of numbers. A configuration q has n entries, and for a mobile
    base n + 1: the pose (x, y, θ) of the base is before the joint angles.

    Unknown means worst case. Without a finger opening the finger spheres cover every opening of the gripper. If an
    update (`observe`, `attach`, `constrain`) raises, what it would have replaced is no longer in force: every step
    stops the robot (`Reason.BAD_SCENE`) until the next update of that kind succeeds. A `permit` that raises leaves no
    contact permitted.
    """

    def __init__(
        self,
        robot_model: RobotModel,
        config: FilterConfig | None = None,
        *,
        weight: ArrayLike | None = None,
        barriers: Sequence[PythonBarrier] = (),
        obstacles: Sequence[Obstacle] = (),
    ) -> None:
        """Compile `robot_model` for the kernel.

        `weight` is R (n, n), by default diag(1/v_max²). `barriers` compute additional rows in every step.
        `obstacles` are permanent: they are in effect immediately, and `observe` keeps them in the obstacle table.

        Raises:
            ConfigurationError: no kernel build has room for the robot model, R is not positive definite, jerk limits
                are missing, or the tool is not on the last frame.
            GeometryError: an obstacle is not usable, see `observe`.
        """
        self.robot_model, self.config = robot_model, config or FilterConfig()
        self._n, self._nq = robot_model.n, robot_model.nq
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
        self._table_usable = True
        self._permits: tuple[Contact, ...] = ()
        self._held_error, self._grasp_changes = 0.0, 0
        self._tool_rotation, self._tool_offset = tool_frame(robot_model)
        self._part_links = links_by_part(robot_model)
        links = [link.name for link in robot_model.links for sphere in robot_model.spheres if sphere.link == link.name]
        self._refusals: dict[str, str] = {}
        self._names = RowNames(
            spheres=tuple(links),
            obstacles=(),
            joints=tuple(joint.name for joint in robot_model.joints),
            v_max=tuple(j.velocity.value for j in robot_model.joints),
        )
        groups = {link.name: link.group for link in robot_model.links}
        self._groups = tuple(groups[name] for name in self._names.spheres)
        self.keep_out_boxes: tuple[SceneObject, ...] = ()
        """The boxes among the permanent obstacles, as scene objects for path planning."""
        self._set_fixed_obstacles(obstacles)

    def _set_fixed_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Put the permanent obstacles in effect."""
        self._fixed_obstacles = check_obstacles(obstacles, MAX_OBSTACLES)
        self.keep_out_boxes = tuple(
            SceneObject(
                name=box.name, role="obstacle", shape=box.shape, pose=box.pose, error=box.margin, category="keep_out"
            )
            for box in self._fixed_obstacles
            if isinstance(box.shape, Box)
        )
        if obstacles:
            self.observe(())

    # --- a supervisor on a target -----------------------------------------------------------------------------

    def supervise(self, tick: SupervisedTick) -> None:
        """Pass a tick to a supervisor on a target; a filter on the host has none."""

    def target_conditions(self) -> int:
        """`Condition` bits that a target adds; none for a filter on the host."""
        return 0

    def describe_target(self) -> str:
        """One sentence about the target and its results so far; "" for a filter on the host."""
        return ""

    # --- obstacles, rows, contacts, grasped object ------------------------------------------------------------

    def observe(self, obstacles: Sequence[Obstacle], stamp: float = 0.0) -> None:
        """Replace the obstacle table by `obstacles`, observed at `stamp` [s].

        If this raises, the previous table is no longer in force: every step stops the robot until a valid observation.
        An observation with a stamp more than 5 ms after `now` of a step counts as stale.

        Raises:
            GeometryError: there are too many obstacles, or one has a number, size, pose, shape or field that is not
                usable (`dualbrain.core.geometry.validation`), or `stamp` is not finite.
            ConfigurationError: an obstacle's `alpha` exceeds the gain for which the tracking margin was identified.
            UnknownNameError: `Obstacle.parts` names a part that the robot does not have.
        """
        try:
            self._replace_obstacles(obstacles, validation.check_stamp("stamp of the observation", stamp))
        except BaseException as error:
            self._discard_obstacles()
            self._note_refusal("obstacles", error)
            raise
        self._note_refusal("obstacles", None)

    def _replace_obstacles(self, obstacles: Sequence[Obstacle], stamp: float) -> None:
        room = MAX_OBSTACLES - len(self._fixed_obstacles)
        usable = (*check_obstacles(obstacles, room), *self._fixed_obstacles)
        self._check_gains(usable)
        self._kernel.set_obstacles(obstacle_table(usable, self._part_links))
        for index, obstacle in enumerate(usable):
            if obstacle.near is not None:
                near = obstacle.near
                self._kernel.limit_near(index, near.speed, near.distance, near.brake, near.approach)
        self._obstacles, self._stamp = usable, stamp
        names, barriers = tuple([one.name for one in usable]), tuple([one.barrier for one in usable])
        if (names, barriers) != (self._names.obstacles, self._names.barriers):
            self._names = msgspec.structs.replace(self._names, obstacles=names, barriers=barriers)
        self._table_usable = True
        self._apply_permits()

    def _discard_obstacles(self) -> None:
        """Put a table in force that the kernel rejects, so that no step relies on an observation that was refused."""
        self._kernel.set_obstacles(UNUSABLE_TABLE)
        self._obstacles, self._table_usable = (), False

    def _note_refusal(self, update: str, error: BaseException | None) -> None:
        """Note that an `update` was refused because of `error`, or accepted (None), for the explanation of a stop."""
        if error is None and update not in self._refusals:
            return
        self._refusals.pop(update, None)
        if error is not None:
            self._refusals[update] = describe_refusal(error)
        self._names = msgspec.structs.replace(self._names, refusal="; ".join(self._refusals.values()))

    def _check_gains(self, obstacles: Sequence[Obstacle]) -> None:
        """Reject gains above the largest gain of the filter, up to which the tracking margin was identified."""
        for obstacle in obstacles:
            if obstacle.alpha is not None and obstacle.alpha > self._max_gain:
                raise ConfigurationError(
                    f"alpha of obstacle {obstacle.name!r}",
                    got=obstacle.alpha,
                    allowed=f"at most {self._max_gain:.6g} 1/s, the gain up to which rows cover the tracking error",
                    fix="Raise FilterConfig.alpha, or set FilterConfig.tracking_error for this gain.",
                )

    @property
    def tables(self) -> FilterTables:
        """The tables in force; the obstacles include the permanent ones."""
        return FilterTables(
            obstacles=self._obstacles,
            stamp=self._stamp,
            permits=self._permits,
            held_error=self._held_error,
            grasp_changes=self._grasp_changes,
        )

    @property
    def has_batch(self) -> bool:
        """Whether `batch` can be called: the base is fixed, and there are no Python barriers."""
        return not self._needs_state

    def kernel_scene(self) -> tuple[Kernel, float]:
        """The compiled kernel with the scene in force, and the stamp of the scene [s], for a control loop in C.

        Raises:
            ConfigurationError: the base is mobile, or there are Python barriers, which need Python in every step.
        """
        if self._needs_state:
            raise ConfigurationError.stating(
                f"A control loop in C needs a fixed base and no Python barriers; {self.robot_model.name} has "
                f"{'a mobile base' if self._mobile else 'Python barriers'}.",
                fix="Use the control loop in Python (SafetyController).",
            )
        return self._kernel, self._stamp

    def is_permitted(self, kind: int, i: int, j: int) -> bool:
        """Whether contact of the pair of a row with these indices (`BarrierRow`) is permitted, so that h may be < 0."""
        if kind != OBSTACLE or not self._permits:
            return False
        name = self._names.obstacles[j]
        link = self._link_index(i)
        return any(one.obstacle == name and link in self._part_links[one.robot_part] for one in self._permits)

    def _link_index(self, sphere: int) -> int:
        """Index of the link of a sphere; the grasped object is the link after the last."""
        links = self.robot_model.links
        if sphere >= len(self._names.spheres):
            return len(links)
        return next(i for i, link in enumerate(links) if link.name == self._names.spheres[sphere])

    def constrain(self, rows: Sequence[ConstraintRow]) -> None:
        """Set rows a'u ≥ b that hold until the next call; at most 16, including the rows of Python barriers.

        If this raises, every step stops the robot until a call succeeds.

        Raises:
            ConfigurationError: a row does not have n finite coefficients, or there are more than 16 rows.
        """
        unusable = ConstraintRow(name="rows that were refused", a=(nan,) * self._n, b=nan)
        self._rows = (unusable,)
        self._set_rows(self._rows)
        try:
            found = validation.check_sequence("rows at once", rows, MAX_ROWS, of="rows")
            usable = tuple(self._check_row(row) for row in found)
            self._set_rows(usable)
        except BaseException as error:
            self._note_refusal("rows", error)
            raise
        self._rows = usable
        self._note_refusal("rows", None)

    @property
    def extra_rows(self) -> tuple[ConstraintRow, ...]:
        """Rows of the last step that are not in the obstacle table: rows of `constrain` and of Python barriers."""
        return self._extra_rows

    def _check_row(self, row: object) -> ConstraintRow:
        """A row with n finite coefficients; raises `GeometryError`."""
        given = validation.check_instance("row", row, ConstraintRow)
        of = f"row {validation.check_name('name of a row', given.name)[:40]!r}"
        a = validation.check_array(of, given.a, (self._n,), MAX_ROW_COEFFICIENT)
        if type(given.rank) is not Rank:
            raise GeometryError(f"rank of {of}", got=given.rank, allowed="a Rank")
        return msgspec.structs.replace(
            given,
            a=tuple(a.tolist()),
            b=validation.check_number(f"b of {of}", given.b, -MAX_ROW_COEFFICIENT, MAX_ROW_COEFFICIENT),
            h=validation.check_number(f"h of {of}", given.h),
        )

    def _set_rows(self, rows: Sequence[ConstraintRow]) -> None:
        if len(rows) > MAX_ROWS:
            raise ConfigurationError("rows at once", got=len(rows), allowed=f"at most {MAX_ROWS}")
        self._kernel.constrain(row_table(rows, self._n))
        self._extra_rows = tuple(rows)
        self._names = msgspec.structs.replace(self._names, rows=tuple(row.name for row in rows))

    def _update_python_barriers(self, state: RobotState) -> None:
        """Set the rows of the Python barriers at this state, after the rows of `constrain`."""
        jacobian = self.tool(state.q).jacobian
        computed = [self._check_row(row) for barrier in self._barriers for row in barrier.rows(state, jacobian)]
        self._set_rows((*self._rows, *computed))

    def permit(self, permits: Sequence[Contact]) -> None:
        """Replace the list of permitted contacts; every pair that is not listed keeps its distance.

        If this raises, no contact is permitted.

        Raises:
            UnknownNameError: a contact names a part that the robot does not have.
            ConfigurationError: a contact speed is not a number from 0 to 10 m/s.
        """
        self._permits = ()
        self._apply_permits()
        found = validation.check_sequence("permits", permits, validation.MAX_NAME_LENGTH, of="contacts")
        self._permits = tuple(self._check_contact(contact) for contact in found)
        self._apply_permits()

    def _check_contact(self, contact: object) -> Contact:
        given = validation.check_instance("permit", contact, Contact)
        part = validation.check_name("part of the robot", given.robot_part)
        if part not in self._part_links:
            raise UnknownNameError("part of the robot", part, tuple(self._part_links), owner=self.robot_model.name)
        validation.check_length("contact speed [m/s]", given.speed, MAX_CONTACT_SPEED)
        return given

    def _apply_permits(self) -> None:
        self._kernel.clear_permits()
        for contact in self._permits:
            for index, obstacle in enumerate(self._obstacles):
                if obstacle.name == contact.obstacle:
                    for link in self._part_links[contact.robot_part]:
                        self._kernel.permit(link, index, contact.speed)

    def attach(self, spheres: ArrayLike, error: float) -> None:
        """Attach a grasped object made of 1 to 8 `spheres` (k, 4): x, y, z, radius [m] in the tool frame.

        `error` [m] is the pose error of the object in the hand and inflates its rows. If this raises, every step stops
        the robot until `attach` or `detach` succeeds, because the shape in the hand is unknown.

        Raises:
            GeometryError: `spheres` is not such an array, a radius or the error is below zero, or a centre is more than
                0.5 m from the tool.
        """
        self._kernel.attach(np.full((1, 4), nan), 0.0)
        self._grasp_changes += 1
        try:
            self._attach(spheres, error)
        except BaseException as problem:
            self._note_refusal("held object", problem)
            raise
        self._note_refusal("held object", None)

    def _attach(self, spheres: ArrayLike, error: float) -> None:
        held = validation.check_array("held spheres", spheres, (-1, 4), MAX_HELD_DISTANCE).copy()
        error = validation.check_length("error of the held object", error, MAX_HELD_DISTANCE)
        for radius in held[:, 3]:
            validation.check_length("radius of a held sphere", float(radius), MAX_HELD_DISTANCE)
        if not 1 <= len(held) <= MAX_HELD_SPHERES or np.any(np.linalg.norm(held[:, :3], axis=1) > MAX_HELD_DISTANCE):
            raise GeometryError(
                "held spheres",
                got=spheres,
                allowed=f"1 to {MAX_HELD_SPHERES} spheres within {MAX_HELD_DISTANCE:g} m of the tool",
                fix="Call `detach` if nothing is held.",
            )
        held[:, :3] = held[:, :3] @ self._tool_rotation.T + self._tool_offset
        self._kernel.attach(np.ascontiguousarray(held), error)
        self._held_error = error

    def detach(self) -> None:
        """Remove the grasped object."""
        self._kernel.attach(np.empty((0, 4)), 0.0)
        self._held_error, self._grasp_changes = 0.0, self._grasp_changes + 1
        self._note_refusal("held object", None)

    def reset(self, u_prev: ArrayLike = 0.0, u_change: ArrayLike = 0.0) -> None:
        """Clear the memory of the filter and set the last control to `u_prev`, one number or (n,) [rad/s].

        `u_change` is the last control minus the one before it, one number or (n,) [rad/s]; the jerk limits need it.
        A number that is not finite counts as 0: the arm begins at rest, as far as is known.

        Raises:
            ConfigurationError: A value is neither one number nor n numbers.
        """
        self._kernel.reset(self._as_control("u_prev", u_prev), self._as_control("u_change", u_change))

    def _as_control(self, name: str, value: ArrayLike) -> Array:
        if validation.is_real(value):
            value = np.full(self._n, value)
        numbers = validation.as_real_array(name, value, (self._n,))
        return np.where(np.isfinite(numbers), numbers, 0.0)

    # --- control ----------------------------------------------------------------------------------------------

    def __call__(
        self, q: ArrayLike, v: ArrayLike, u_nom: ArrayLike, now: float = 0.0, opening: float | None = None
    ) -> FilterResult:
        """Run one control step from configuration q, velocities v (n,) and nominal control u_nom (n,), in SI units.

        q is (n,), for a mobile base (n + 1,). With moving obstacles `now` [s] must be on the clock of the stamps passed
        to `observe`. The joint state counts as fresh. `opening` [m] is the opening of each finger; without it the
        spheres of the fingers cover every opening from closed to open. An opening more than 5 mm outside the range of
        the gripper is a bad input.

        Raises:
            ConfigurationError: an argument does not have this shape, or does not consist of numbers.
        """
        if self._needs_state:
            q, v = cast("Array", q), cast("Array", v)  # `filter` converts them
            return self.filter(
                RobotState(stamp=now, sequence=0, q=q, v=v, opening=opening, finger_forces=(0.0, 0.0)), u_nom, now
            )
        try:
            opened = ... if opening is None else opening
            return self._step(q, v, u_nom, opened, 0.0, now - self._stamp, self._names)
        except (ValueError, TypeError):
            raise self._input_error(now, opening, q=q, v=v, u_nom=u_nom) from None

    def filter(self, state: RobotState, u_nom: ArrayLike, now: float) -> FilterResult:
        """Run one control step from `state`; call it once per period, because it stores the last control.

        `u_nom` (n,) [rad/s] is the nominal control, `now` the time [s].

        Raises:
            ConfigurationError: `state.q`, `state.v` or `u_nom` does not have the shape of `__call__`, or does not
                consist of numbers.
        """
        state = self._prepare(state)
        try:
            ages = (now - state.stamp, now - self._stamp)
            opened = ... if state.opening is None else state.opening
            return self._step(state.q, state.v, u_nom, opened, *ages, self._names)
        except (ValueError, TypeError):
            raise self._input_error(now, state.opening, q=state.q, v=state.v, u_nom=u_nom) from None

    def _input_error(self, now: object, opening: object, **arrays: ArrayLike) -> ConfigurationError:
        """The error for the input of a step that is not of its type or shape."""
        try:
            for name, values in arrays.items():
                validation.as_real_array(f"{name} of a step", values, (self._n,))
        except ConfigurationError as error:
            return error
        if opening is not None and not validation.is_real(opening):
            return GeometryError("opening of a step", got=opening, allowed="a number [m], or None if it is unknown")
        return GeometryError("now of a step", got=now, allowed="a number [s], as the stamps of state and scene")

    def rows(self) -> tuple[BarrierRow, ...]:
        """Rows of the last step that a control in its box could have violated, or whose pair was within 1 mm.

        Rows are in the order of the kernel, at most 512. Joint limits are bounds of the box and not among them. If no
        control satisfied all rows, the right-hand sides are the relaxed ones. Call this before the obstacles change.
        The list is empty after a rejected input or observation.
        """
        if not self._table_usable:
            return ()
        names = self._names
        return tuple(
            BarrierRow(names.row_name(kind, i, j), names.barrier_name(kind, i, j), h, np.array(a), b, norm, kind, i, j)
            for kind, i, j, h, norm, b, a in self._kernel.rows()
        )

    def batch(
        self,
        Q: ArrayLike,
        V: ArrayLike,
        U: ArrayLike,
        now: float = 0.0,
        *,
        u_prev: ArrayLike | None = None,
        opening: ArrayLike | None = None,
    ) -> BatchResult:
        """Filter m independent states, one per row of Q, V and U (m, n), for Monte-Carlo studies and learning.

        Row i equals, bit for bit, the result of a new filter after `reset(u_prev[i])`; `u_prev` (m, n) is V by default.
        Obstacles, permits, rows and the grasped object apply as in a single call. `opening` [m] is one number or (m,);
        without it the fingers cover every opening. The memory of this filter is neither read nor changed.

        Raises:
            ConfigurationError: the shapes do not agree, the base is mobile, or there are Python barriers (both depend
                on a single state).
        """
        if not self.has_batch:
            raise ConfigurationError.stating(
                f"A batch needs a fixed base and no Python barriers; {self.robot_model.name} has "
                f"{'a mobile base' if self._mobile else 'Python barriers'}.",
                fix="Filter the states one by one.",
            )
        previous = V if u_prev is None else u_prev
        age = validation.check_real("now of a batch", now) - self._stamp
        return run_batch(self._kernel, self._n, Q, V, U, previous, opening, age)

    def project(self, state: RobotState, u_desired: ArrayLike, u_nom_prev: ArrayLike, now: float) -> Array:
        """Projection φ of a desired control (n,) onto rows of known obstacles and the box around `u_nom_prev` (n,).

        Rows keep `FilterConfig.projection_margin` in addition. If all obstacles are known, `filter` passes the result
        unchanged, bit for bit. The memory of the filter is not changed. Controls are in rad/s, `now` is in s.

        Raises:
            ConfigurationError: `u_desired`, `u_nom_prev`, `state.q` or `state.v` does not have the shape of
                `__call__`, or does not consist of numbers.
        """
        state = self._prepare(state)
        u_nom_prev = validation.as_real_array("u_nom_prev of a step", u_nom_prev, (self._n,))
        u = np.empty(self._n)
        try:
            ages = (now - state.stamp, now - self._stamp)
            opened = ... if state.opening is None else state.opening
            self._kernel.project(
                state.q, state.v, u_desired, u_nom_prev, opened, *ages, self.config.projection_margin, u
            )
        except (ValueError, TypeError):
            raise self._input_error(now, state.opening, q=state.q, v=state.v, u_desired=u_desired) from None
        return u

    def _prepare(self, state: RobotState) -> RobotState:
        """Set the rows of Python barriers at `state` and return the state in the coordinates of the kernel's chain.

        The arrays of the state are converted here only if Python code reads them; the kernel converts them itself.
        """
        if not self._needs_state:
            return state
        q = validation.as_real_array("q of a step", state.q, (self._nq,))
        v = validation.as_real_array("v of a step", state.v, (self._n,))
        if q is not state.q or v is not state.v:
            state = replace(state, q=q, v=v)
        if self._barriers:
            self._update_python_barriers(state)
        return replace(state, q=self._lagged_chain_q(state)) if self._mobile else state

    def _lagged_chain_q(self, state: RobotState) -> Array:
        """Joint angles (n,) of the kernel's chain for a step, with the base ahead by its own lag, y = q + lag v.

        In the kernel a base translates straight for one period and turns. The base pose is therefore turned by half the
        turn of one period, ω dt/2, and the base's turning joint is turned back by the same angle. All spheres stay
        where they are, and the translation points along the chord of the arc.
        """
        if self.robot_model.base_lag is None:
            return self._chain_q(state.q)
        x, y, heading, *joints = state.q.tolist()
        v, w = state.v[:2].tolist()
        if not (isfinite(heading) and isfinite(w)):  # the kernel rejects the pose, and the robot stops
            self._set_base_pose(nan, nan, 0.0)
            return np.array([0.0, 0.0, *joints])
        x, y, heading = integrate_arc(x, y, heading, v, w, self._base_lag)
        half = 0.5 * self.robot_model.period * w
        self._set_base_pose(x, y, heading + half)
        return np.array([0.0, -half, *joints])

    def _chain_q(self, q: Array) -> Array:
        """Joint angles (n,) of the kernel's chain at configuration q (nq,); a mobile base is placed by its pose."""
        if not self._mobile:
            return q
        x, y, heading, *joints = q.tolist()
        if not isfinite(heading):
            x = y = heading = nan
        self._set_base_pose(x, y, heading)
        return np.array([0.0, 0.0, *joints])

    def _set_base_pose(self, x: float, y: float, heading: float) -> None:
        """Set the pose of the base [m, rad] in the kernel."""
        c, s = cos(heading), sin(heading)
        self._kernel.set_base_pose(np.array([c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0, x, y, 0.0]))

    # --- kinematics -------------------------------------------------------------------------------------------

    def tool(self, q: ArrayLike) -> ToolState:
        """The tool frame in the world at configuration q, (n,) or for a mobile base (n + 1,) [rad, m].

        Raises:
            ConfigurationError: q does not have this shape, or does not consist of numbers.
        """
        n, flat = self._n, np.empty(12 + 6 * self._n)
        self._kernel.tool(self._chain_q(validation.as_real_array("configuration q", q, (self._nq,))), flat)
        return ToolState(flat[:3], flat[3:12].reshape(3, 3), flat[12:].reshape(6, n))

    def damped_least_squares(self, J: Array, damping: float, task: Array, free: Array) -> Array:
        """Jᵀ (J Jᵀ + λ² 1)⁻¹ (task − J free) + free (n,): the joint motion that moves the tool by `task` (6,).

        `J` (6, n) is the Jacobian of the tool, `damping` is λ² > 0, and `free` (n,) acts within the null space of J.
        Numbers that are not finite give a motion that is not finite. Compiled: `np.linalg.solve` takes 20 µs longer.

        Raises:
            ValueError: an array does not have its shape.
        """
        u = np.empty(len(free))
        dynamics.damped_step(J, damping, task, free, u)
        return u

    def spheres(self, q: ArrayLike, opening: float | None) -> tuple[Array, Array, tuple[str, ...]]:
        """Centres (k, 3) [m], radii (k,) [m] and group of every sphere at q, with `opening` [m] per finger.

        q is as for `tool`. With None the spheres of the fingers cover every opening. Spheres of a grasped object are
        last.

        Raises:
            ConfigurationError: q does not have this shape, or q or the opening does not consist of numbers.
        """
        flat = np.empty((len(self._groups) + 8, 4))
        opened = nan if opening is None else validation.check_number("opening [m]", opening)
        chain = self._chain_q(validation.as_real_array("configuration q", q, (self._nq,)))
        count = self._kernel.spheres(chain, opened, flat)
        held = (HELD,) * (count - len(self._groups))
        return flat[:count, :3], flat[:count, 3], self._groups + held


def links_by_part(robot_model: RobotModel) -> dict[str, tuple[int, ...]]:
    """Link indices of every part name of permits: links, groups (which take precedence) and "held"."""
    parts: dict[str, tuple[int, ...]] = {link.name: (i,) for i, link in enumerate(robot_model.links)}
    parts |= {
        link.group: tuple(i for i, other in enumerate(robot_model.links) if other.group == link.group)
        for link in robot_model.links
    }
    return parts | {HELD: (len(robot_model.links),)}
