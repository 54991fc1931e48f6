"""Gymnasium environment in which every action of a policy passes the safety filter.

Requires the extra `gym`. Vectorised environments need one filter each: build the filter in the function that builds
the environment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from math import inf, isclose, nan
from typing import Any, SupportsFloat, cast

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.validation import as_real_array
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout, FunctionLayout
from dualbrain.safety.integration.policy_guard.action_range import check_action_range
from dualbrain.safety.integration.policy_guard.action_space import ActionSpace
from dualbrain.safety.integration.policy_guard.guard import Deviation, GuardReport, PolicyGuard
from dualbrain.safety.integration.policy_guard.joint_actions import JointVelocity
from dualbrain.safety.integration.policy_guard.step_info import step_info
from dualbrain.safety.integration.policy_guard.torque_actions import JointTorque, TorqueDrive
from dualbrain.safety.integration.shadow_mode import ShadowFilter

try:
    import gymnasium
except ImportError as error:
    raise MissingDependencyError(
        "The package gymnasium", fix="Install it with `pip install 'dualbrain[gym]'`."
    ) from error

Array = NDArray[np.float64]
JointState = tuple[Array, Array]
OUTSIDE = ("StickyAction", "DelayObservation", "MaxAndSkipObservation", "RepeatAction")
"""Wrappers of gymnasium that execute an action again or later, or state an earlier observation."""
WITHOUT_CLIP = "Leave out the wrapper `ClipAction`, or give the environment in it a wider action space."


class FilteredEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Environment wrapper that replaces every action by the closest safe one.

    Velocity policies: the nominal control u_nom is decoded from the action, and the safe control u is encoded into it.
    The guarantee is that of `SafetyFilter`, if one step of the environment is one period of the robot model and the
    joints follow u without clipping.

    Torque policies (`torque`, or the action space `JointTorque`): the nominal control is the velocity that the torque
    would cause, u_nom = v + dt M⁻¹(τ − c − g). If the filter does not change u_nom, the torque is applied unchanged;
    otherwise `TorqueDrive.track` tracks u. The guarantee then holds for u, and for the arm only if
    `info["tracking_error"]` [rad/s], the largest |v − u| of a joint one step later, stays below the filter's
    `tracking_error`. Saturated torques, contacts and wrong dynamics violate that; forces are not covered. With exact
    tracking there is no lag: turn off `lag_compensation`.

    `info` of each step contains `cost` (delta) and its part `cost_rows` (the rest is due to jumps of the action beyond
    joint limits), `h_min` [m] before the action, `status` (a name), `safety` (a sentence) and `applied`, the action
    that the environment received. For a repeated action these are the mean costs, the least h, the highest status and
    the sentence of the largest change. With a `ShadowFilter` the action is not changed, and `info` reports the
    hypothetical result.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        safety: SafetyFilter | ShadowFilter,
        *,
        state: Callable[[Any], JointState] | None = None,
        decode_action: Callable[[Any], Array] | None = None,
        encode_action: Callable[[Array, Any], Any] | None = None,
        scene: Callable[[Any, float], Sequence[Obstacle]] | None = None,
        opening: Callable[[Any], float | None] = lambda _: None,
        torque: TorqueDrive | None = None,
        action_space: ActionSpace | None = None,
        action_repeat: int = 1,
        deviation: Deviation = "nearest",
        step_time: float | None = None,
    ) -> None:
        """Filter `env` with `safety`, or only observe it with a `ShadowFilter`.

        - `state(observation)`: joint angles and velocities; by default the entries "q" and "v", or the first n and the
          next n numbers.
        - `decode_action(action)`: joint velocities [rad/s] or torques [Nm]; by default the first n numbers.
          `encode_action(control, action)` writes them into a copy of the action.
        - `scene(observation, now)`: the obstacles of this step; by default those of the last `safety.observe`.
        - `opening(observation)`: opening of each finger [m]; by default unknown: the fingers cover every opening.
        - `action_space`: the meaning of the actions, instead of `decode_action`, `encode_action` and `torque`: joint
          positions, poses or twists of the tool … (`policy_guard`). An environment that is slower than the filter is
          filtered several times per step, on the predicted motion.
        - `action_repeat`: number of environment steps per action. Each step is filtered again and rewards are summed:
          20 ms of a policy are 4 steps of an environment of 5 ms.
        - `deviation`: the nearest safe control, or braking along the commanded direction ("along_path").
        - `step_time`: time of one step of the environment [s]; by default its `dt` or `control_timestep`.

        Raises:
            ConfigurationError: the time of one step is unknown, or is not the period of the robot model (with
                `action_space`: no multiple of it), `action_repeat` is below 1, the actions of `env` are narrower than
                the velocity limits of the robot model (for joint positions: than its joint limits), or `action_space`
                is given beside the functions that it replaces.
        """
        super().__init__(env)
        self.shadow = safety if isinstance(safety, ShadowFilter) else None
        self.safety = safety.safety if isinstance(safety, ShadowFilter) else safety
        self._n = self.safety.robot_model.n
        self._state = state or self._default_state
        self._scene, self._opening, self._action_repeat = scene, opening, action_repeat
        if type(action_repeat) is not int or action_repeat < 1:
            raise ConfigurationError("action_repeat", got=action_repeat, allowed="a whole number of 1 or more")
        if action_space is not None and any((decode_action, encode_action, torque)):
            raise ConfigurationError.stating(
                "FilteredEnv has an `action_space` beside `decode_action`, `encode_action` or `torque`.",
                fix="Pass the layout and the drive to the action space.",
            )
        self._decode_action = decode_action or self._default_decode
        layout = FunctionLayout(self._decode_action, encode_action or self._default_encode)
        given = JointVelocity(layout=layout) if torque is None else JointTorque(drive=torque, layout=layout)
        step = find_step_time(env.unwrapped) if step_time is None else _checked_step_time(step_time)
        if action_space is None:
            self._check_period(step)
        self.guard = PolicyGuard(
            safety, action_space or given, period=step if action_space else None, deviation=deviation
        )
        check_action_bounds(env, self.guard.space, self.safety.robot_model, step)
        self._reports_tracking = isinstance(self.guard.space, JointTorque) and self.shadow is None
        self._now = 0.0
        self._joint_state: JointState = (np.array(self.safety.robot_model.home), np.zeros(self._n))
        self._observation: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, and the filter to the joint velocity of the first observation."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._now = 0.0
        self._read_observation(observation)
        self.guard.reset(*self._joint_state)
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Filter and execute `action`, `action_repeat` times; `info` reports the changes."""
        reports: list[GuardReport] = []
        total, errors = 0.0, [0.0]
        while True:
            applied = self._guarded_action(action)
            observation, reward, terminated, truncated, info = self.env.step(applied)
            self._now += self.guard.steps_per_action * self.safety.robot_model.period
            self._read_observation(observation)
            reports.append(self.guard.report)
            total += float(reward)
            errors.append(float(np.abs(self._joint_state[1] - self.guard.control).max()))
            if terminated or truncated or len(reports) == self._action_repeat:
                break
        info = {**info, **step_info(reports), "applied": applied}
        if self._reports_tracking:
            info["tracking_error"] = max(errors)
        return observation, total, terminated, truncated, info

    def _guarded_action(self, action: Any) -> Any:
        """The safe action for the newest observation."""
        if self._scene:
            self.safety.observe(self._scene(self._observation, self._now), self._now)
        return self.guard(action, *self._joint_state, self._now, self._opening(self._observation))

    def _read_observation(self, observation: Any) -> None:
        q, v = self._state(observation)
        joints = (
            as_real_array("q of the observation", q, (self.safety.robot_model.nq,)).copy(),
            as_real_array("v of the observation", v, (self._n,)).copy(),
        )
        self._observation, self._joint_state = observation, joints

    # --- default layout of observations and actions -------------------------------------------------------------

    def _default_state(self, observation: Any) -> JointState:
        if isinstance(self.env.observation_space, gymnasium.spaces.Dict):
            return observation["q"], observation["v"]
        return observation[: self._n], observation[self._n : 2 * self._n]

    def _default_decode(self, action: Any) -> Array:
        return action[: self._n]

    def _default_encode(self, velocity: Array, action: Any) -> Any:
        return ActionLayout().write(velocity, action)

    # --- conditions of the guarantee ----------------------------------------------------------------------------

    def _check_period(self, step: float) -> None:
        period = self.safety.robot_model.period
        if not isclose(step, period, rel_tol=1e-6):
            raise ConfigurationError(
                "one step of the environment [s]",
                got=step,
                allowed=f"the period of the robot model, {period:g}",
                fix="Build the filter for `derate(robot_model, period=...)` (dualbrain.safety.integration.derating).",
            )


def check_action_bounds(
    env: Any, space: ActionSpace, robot_model: RobotModel, step_time: float, *, clips: bool = True
) -> None:
    """Refuse `env` if it clips safe actions of `space`; `step_time` [s] is the time of one action.

    The bounds are those of its action space, if it `clips` to them, and those to which a `ClipAction` in it clips: that
    wrapper states an unbounded action space. Inside of any other wrapper of actions, the actions have other units.

    Raises:
        ConfigurationError: bounds are narrower than the safe actions, `space` cannot read them, or a wrapper in `env`
            executes an action again or later, or states an earlier observation.
    """
    _check_wrappers(env)
    if clips:
        check_action_range(env.action_space, space, robot_model, step_time)
    for wrapper in _wrappers(env):
        if isinstance(wrapper, gymnasium.wrappers.ClipAction):
            check_action_range(cast("Any", wrapper).env.action_space, space, robot_model, step_time, fix=WITHOUT_CLIP)
        elif isinstance(wrapper, gymnasium.ActionWrapper):
            return


def _check_wrappers(env: Any) -> None:
    for wrapper in _wrappers(env):
        name = next((one.__name__ for one in type(wrapper).__mro__ if one.__name__ in OUTSIDE), None)
        if name is not None:
            raise ConfigurationError.stating(
                f"The wrapper {name} is between the filter and the environment, and changes the motion unseen.",
                fix="Put it around the filtered environment, where every action that it causes is filtered.",
            )


def _wrappers(env: Any) -> Iterator[Any]:
    """The wrappers of an environment, the outermost first."""
    while isinstance(env, gymnasium.Wrapper):
        yield env
        env = cast("Any", env).env


def find_step_time(env: Any) -> float:
    """The time of one step [s] that an environment states itself.

    Gymnasium, gymnasium-robotics and metaworld have `dt`, robosuite and dm_control `control_timestep` (a number or a
    method), and gym-aloha a dm_control environment as `_env`. Raises `ConfigurationError` without any of them.
    """
    for owner, name in ((env, "dt"), (env, "control_timestep"), (getattr(env, "_env", None), "control_timestep")):
        stated = getattr(owner, name, None)
        if stated is not None:
            return _checked_step_time(stated() if callable(stated) else stated)
    raise ConfigurationError.stating(
        f"The environment {type(env).__name__} does not state the time of one step.",
        fix="Pass it in seconds: `step_time=0.02` for 50 steps per second.",
    )


def _checked_step_time(stated: Any) -> float:
    """The time of one step [s]; raises `ConfigurationError` if it is no positive number."""
    try:
        step = float(stated)
    except (TypeError, ValueError):
        step = nan
    if not 0.0 < step < inf:
        raise ConfigurationError("time of one step of the environment [s]", got=stated, allowed="a positive number")
    return step
