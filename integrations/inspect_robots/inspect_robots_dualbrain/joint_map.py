"""The joints of a robot model in the actions and observations of an embodiment: entries, names and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi
from typing import Any, Literal

import numpy as np
from inspect_robots.embodiment import EmbodimentInfo
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout
from dualbrain.safety.integration.policy_guard.action_space import ActionSpace
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition, JointVelocity

Array = NDArray[np.float64]
POSITION_KEY, VELOCITY_KEY = "joint_pos", "joint_vel"
"""Canonical state keys of inspect-robots."""
UNITS = {"rad": 1.0, "deg": pi / 180.0}
"""Angle in rad of one unit."""
CONTROL_MODES = ("joint_pos", "joint_vel", "joint_delta")


@dataclass(frozen=True, slots=True, kw_only=True)
class JointMap:
    """Where the joints of a robot model are in the actions and the state of an embodiment.

    `entries` (n,): the index of each joint in an action of `size` numbers. `key`: the state key of the positions.
    `scale` [rad]: the angle of one unit of actions and state.
    """

    entries: tuple[int, ...]
    size: int
    key: str
    scale: float

    @classmethod
    def of(
        cls, info: EmbodimentInfo, robot_model: RobotModel, *, joints: Sequence[str] = (), units: str = ""
    ) -> JointMap:
        """The map for the embodiment with `info`.

        `joints` names the joints of the robot model, in its order, as the labels of the action space do, or as indices
        if it has no labels; by default the labels are the names of the robot model. `units` ("rad", "deg") is needed
        only if the embodiment does not declare them.

        Raises:
            UnknownNameError: a joint is no label of the action space.
            ConfigurationError: shape, labels or units of the embodiment do not fit the robot model.
        """
        box = info.action_space
        if len(box.shape) != 1:
            raise ConfigurationError("shape of the action space", got=box.shape, allowed="one dimension")
        key = _position_key(info)
        return cls(
            entries=_find_entries(info, robot_model, tuple(joints)),
            size=box.dim,
            key=key,
            scale=UNITS[_find_unit(info, key, units)],
        )

    @property
    def layout(self) -> ActionLayout:
        """The layout of the actions; grippers and all other entries pass the guard unchanged."""
        return ActionLayout(entries=self.entries, scale=self.scale)

    def positions(self, state: Mapping[str, Any]) -> Array | str:
        """Joint positions (n,) [rad] of the `state` of an observation, or why it has none."""
        return self._read(state, self.key)

    def velocities(self, state: Mapping[str, Any]) -> Array | str | None:
        """Joint velocities (n,) [rad/s], why they cannot be used, or None if the embodiment does not report them."""
        return self._read(state, VELOCITY_KEY) if VELOCITY_KEY in state else None

    def _read(self, state: Mapping[str, Any], key: str) -> Array | str:
        if key not in state:
            return f"the observation has no state {key!r}; it has {', '.join(sorted(map(str, state))) or 'none'}"
        try:
            values = np.asarray(state[key], dtype=np.float64)
        except (TypeError, ValueError):
            return f"the state {key!r} is no vector of numbers"
        count = len(self.entries)
        if values.shape not in ((self.size,), (count,)):
            return f"the state {key!r} has the shape {values.shape}, expected is ({self.size},) or ({count},)"
        order = self.entries if len(values) == self.size else np.argsort(np.argsort(self.entries))
        found = self.scale * values[list(order)]
        return found if np.isfinite(found).all() else f"the state {key!r} is not finite"


def make_action_space(info: EmbodimentInfo, layout: ActionLayout, delta_reference: str) -> ActionSpace:
    """The action space of the guard for the control mode of the embodiment.

    Raises:
        ConfigurationError: the control mode commands no joints, or `delta_reference` is needed and missing.
    """
    mode = None if info.action_space.semantics is None else info.action_space.semantics.control_mode
    if mode not in CONTROL_MODES:
        raise ConfigurationError(
            f"control mode of {info.name}",
            got=mode,
            allowed=", ".join(CONTROL_MODES),
            fix="Use the joint control of the embodiment: behind a tool pose, its inverse kinematics chooses a joint "
            "motion that the guard does not know.",
        )
    if mode == "joint_vel":
        return JointVelocity(layout=layout)
    if mode == "joint_pos":
        return JointPosition(layout=layout)
    references: dict[str, Literal["commanded", "measured"]] = {"commanded": "commanded", "measured": "measured"}
    if delta_reference not in references:
        raise ConfigurationError(
            "delta reference",
            got=delta_reference,
            allowed="commanded or measured",
            fix=f"State to which position {info.name} adds a joint_delta: the last commanded or the measured one.",
        )
    return JointPosition(layout=layout, delta=True, reference=references[delta_reference])


def _find_entries(info: EmbodimentInfo, robot_model: RobotModel, joints: tuple[str, ...]) -> tuple[int, ...]:
    semantics = info.action_space.semantics
    labels = None if semantics is None else semantics.dim_labels
    known = tuple(map(str, range(info.action_space.dim))) if labels is None else tuple(labels)
    names = joints or tuple(joint.name for joint in robot_model.joints)
    if len(names) != robot_model.n or len(set(names)) != len(names):
        raise ConfigurationError(
            f"joints of {robot_model.name}", got=list(names), allowed=f"{robot_model.n} different names, in its order"
        )
    for name in names:
        if name not in known:
            raise UnknownNameError("joint", name, known, owner=f"the embodiment {info.name}; name them in guard_joints")
    return tuple(known.index(name) for name in names)


def _position_key(info: EmbodimentInfo) -> str:
    """The canonical key, or that of the only state field with the shape of an action, as inspect-robots defines it."""
    space = info.observation_space
    if POSITION_KEY in space.state_keys or space.state is None:
        return POSITION_KEY
    matching = [field.key for field in space.state.fields if field.shape == (info.action_space.dim,)]
    if len(matching) != 1:
        raise ConfigurationError(
            f"state of {info.name}",
            got=sorted(space.state_keys),
            allowed=f"{POSITION_KEY!r}, or one field with the shape of an action",
        )
    return matching[0]


def _find_unit(info: EmbodimentInfo, key: str, units: str) -> str:
    """The unit of the joints: "rad+normalized" is that of an arm in radians with a normalized gripper."""
    state = info.observation_space.state
    declared = [field.unit.partition("+")[0] for field in state.fields if field.key == key] if state else []
    found = next((unit for unit in declared if unit), "")
    chosen = found or units or ("rad" if key == POSITION_KEY else "")
    if chosen not in UNITS or (units and found and units != found):
        raise ConfigurationError(
            f"unit of {key!r} of {info.name}",
            got=found if units in ("", found) else f"{found}, stated: {units}",
            allowed=" or ".join(UNITS),
            fix="Set the embodiment to radians or degrees, or state its unit in guard_units.",
        )
    return chosen
