"""Several arms in an environment that simulates with MuJoCo: one filter each, and each an obstacle of the others."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import gymnasium
import numpy as np
from msgspec.structs import replace

from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.integration.gym_env import check_action_bounds, find_step_time
from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout
from dualbrain.safety.integration.policy_guard.guard import Deviation, PolicyGuard
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition
from dualbrain.safety.integration.policy_guard.step_info import step_info
from dualbrain.simulation.environments.arm_spheres import ArmSpheres, Parts
from dualbrain.simulation.environments.guarded_mujoco_env import MujocoHandles, mujoco_handles
from dualbrain.simulation.environments.mujoco_arm import MujocoArm
from dualbrain.simulation.environments.mujoco_obstacles import MujocoObstacles


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmPlace:
    """One arm of an environment: its `name`, and in the MuJoCo model the names of its `joints` and of its `base` body.

    `entries` are the indices of its joint positions [rad] in the action.
    """

    name: str
    joints: tuple[str, ...]
    base: str
    entries: tuple[int, ...]


class GuardedArms(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Environment wrapper that replaces the joint positions of every arm by the closest safe ones.

    Each arm has a `SafetyFilter` and a `PolicyGuard` of its own. In every step all arms are filtered from the same
    state, before any of them moves, and each has half of the responsibility for its distance from another one
    (`arm_spheres`). Two moving spheres of two arms keep h ≥ 0 if both filters are certified and the joints follow
    within the tracking error of the robot model. Entries of the action that belong to no arm pass unchanged.

    An action that is not usable (wrong size, not finite) brings all arms to rest, with the other entries of the last
    usable one. Before a usable action it raises `ConfigurationError`, as does a state of the simulation that is not
    finite.

    `info` of each step has the entries of `FilteredEnv` (`cost` is the sum over the arms, `h_min` the least, `status`
    the highest) and `arms`, the entries of each arm by its name.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        robot_model: RobotModel,
        places: Sequence[ArmPlace],
        *,
        ignored: Callable[[Any], Collection[str]] = lambda _: (),
        obstacle_parts: Mapping[str, Parts] = MappingProxyType({}),
        arm_parts: Mapping[str, Parts] = MappingProxyType({}),
        margin: float = 0.0,
        config: FilterConfig | None = None,
        deviation: Deviation = "nearest",
        clips: bool = True,
    ) -> None:
        """Guard the arms at `places` of `env`, which is reset once; all of them are of `robot_model`.

        - `ignored(model)`: the bodies of the MuJoCo model that are no obstacles.
        - `obstacle_parts`: parts of an arm (groups, links) that keep away from an obstacle "body/geom", by its name;
          `arm_parts`: parts that keep away from a group of links of another arm. Without an entry, all parts keep away.
        - `margin` [m] enlarges obstacles other than arms.
        - `clips`: whether `env` clips actions to its action space. A `ClipAction` in `env` is recognised in any case.

        Raises:
            ConfigurationError: the environment has no MuJoCo simulation, an arm is not that of `robot_model`, two
                places have the same name, joint or entry, the time of one step is unknown or no multiple of the period
                of `robot_model`, or actions or servos of an arm are clipped to less than the joint limits of
                `robot_model`.
            UnknownNameError: the MuJoCo model has no joint or body of a name.
        """
        super().__init__(env)
        _check_places(places)
        self._robot_model, self._places, self._config = robot_model, tuple(places), config or FilterConfig()
        self._ignored, self._margin = ignored, margin
        self._obstacle_parts, self._arm_parts = dict(obstacle_parts), dict(arm_parts)
        self._handles: MujocoHandles = (None, None)
        self._step_time = find_step_time(env.unwrapped)
        size = int(np.prod(env.action_space.shape or (0,)))
        self.guards = {
            place.name: PolicyGuard(
                SafetyFilter(robot_model, self._config),
                JointPosition(layout=ActionLayout(entries=place.entries)),
                period=self._step_time,
                action_size=size,
                deviation=deviation,
            )
            for place in self._places
        }
        for guard in self.guards.values():
            check_action_bounds(env, guard.space, robot_model, self._step_time, clips=clips)
        env.reset()
        self._now = 0.0
        self._find_arms()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, and each guard to the state of its arm."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._now = 0.0
        self._find_arms()
        for name, guard in self.guards.items():
            guard.reset(self._arms[name].q, self._arms[name].v)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Filter the joint positions of every arm, and execute the action; `info` reports the changes."""
        applied = self._guarded_action(action)
        observation, reward, terminated, truncated, info = self.env.step(applied)
        self._now += self._step_time
        arms = {name: step_info([guard.report]) for name, guard in self.guards.items()}
        return observation, reward, terminated, truncated, {**info, **_all_arms(arms), "applied": applied}

    def _guarded_action(self, action: Any) -> Any:
        """The action of which each arm has filtered its entries; all arms are filtered from the present state."""
        self._find_arms()
        safe: dict[str, Any] = {}
        for name, guard in self.guards.items():
            guard.safety.observe(self._scene(name), self._now)
            safe[name] = guard(action, self._arms[name].q, self._arms[name].v, self._now)
        if all(one is action for one in safe.values()):
            return action
        merged = np.array(next(one for one in safe.values() if one is not action))
        for place in self._places:
            entries = list(place.entries)
            merged[entries] = np.asarray(safe[place.name])[entries]
        return merged

    def _scene(self, name: str) -> list[Obstacle]:
        """The obstacles of one arm: the geometry around it, and all other arms."""
        others = [spheres for other, spheres in self._spheres.items() if other != name]
        parts, own = self._obstacle_parts, self._obstacles[name].observe()
        return [
            *(replace(one, parts=parts[one.name]) if one.name in parts else one for one in own),
            *(sphere for other in others for sphere in other.observe(self._arms[name])),
        ]

    def _find_arms(self) -> None:
        """Find arms and obstacles in the present model of the environment, which a reset may have built again."""
        model, data = mujoco_handles(self.env)
        if self._handles[0] is model and self._handles[1] is data:
            return
        self._arms = {
            place.name: MujocoArm(model, data, self._robot_model, place.joints, place.base) for place in self._places
        }
        for arm in self._arms.values():
            arm.check_servo_ranges()
        bodies = {model.body(body).name for arm in self._arms.values() for body in arm.bodies}
        ignored = bodies | set(self._ignored(model))
        self._obstacles = {
            name: MujocoObstacles(arm, ignored=ignored, margin=self._margin) for name, arm in self._arms.items()
        }
        self._spheres = {name: ArmSpheres(name, arm, self._config, self._arm_parts) for name, arm in self._arms.items()}
        self._handles = (model, data)


def _check_places(places: Sequence[ArmPlace]) -> None:
    """Refuse no place at all, and places that share a name, a joint or an entry: an arm would be unguarded."""
    if not places:
        raise ConfigurationError("places", got="none", allowed="one place for each arm")
    shared = (
        ("names", [place.name for place in places]),
        ("joints", [joint for place in places for joint in place.joints]),
        ("entries", [str(entry) for place in places for entry in place.entries]),
    )
    for key, values in shared:
        if twice := sorted({value for value in values if values.count(value) > 1}):
            got = f"{', '.join(twice)} more than once"
            raise ConfigurationError(f"{key} of the places", got=got, allowed="each one once: every arm has its own")


def _all_arms(arms: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Entries of `info` for all arms: sums, the least h, the highest status, and the sentence of the largest change."""
    first = max(arms, key=lambda name: (FilterStatus[arms[name]["status"]], arms[name]["cost"]))
    return {
        "cost": sum(arm["cost"] for arm in arms.values()),
        "cost_rows": sum(arm["cost_rows"] for arm in arms.values()),
        "h_min": float(np.fmin.reduce([arm["h_min"] for arm in arms.values()])),
        "status": arms[first]["status"],
        "safety": f"{first} arm: {arms[first]['safety']}",
        "arms": arms,
    }
