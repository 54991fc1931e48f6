"""A gymnasium environment whose every action passes the safety filter; its policy may be anything.

Needs the extra `gym`. Vectorised environments need one filter each: build it in the function that builds the
environment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isclose, isnan, nan
from typing import Any, Protocol, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.result import FilterResult, FilterStatus
from dualbrain.safety.integration.shadow_mode import ShadowFilter

try:
    import gymnasium
except ImportError as error:
    raise MissingDependencyError(
        "The package gymnasium", fix="Install it with `pip install 'dualbrain[gym]'`."
    ) from error

Array = NDArray[np.float64]
JointState = tuple[Array, Array]


class TorqueDrive(Protocol):
    """What a torque-driven environment must know of its own dynamics; all arrays (n,), SI."""

    def acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        """Joint accelerations that `torque` causes at angles q and velocities v (forward dynamics)."""
        ...

    def track(self, q: Array, v: Array, u: Array) -> Array:
        """The torque that brings the joints from v to u within one step: computed torque, or a PD law."""
        ...


class FilteredEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Every action becomes the closest safe one before the environment sees it.

    Velocity policies: the wish u_nom is read from the action, the answer u is written back into it. Promise: as for
    `SafetyFilter`, if one step of the environment is one period of the body and the joints follow u unclipped.

    Torque policies (`torque` given): the wish is the velocity that the torque would bring about, u_nom = v + dt M⁻¹(τ −
    c − g). If the filter leaves it alone, the torque passes untouched; else the environment's own law tracks u. The
    promise then holds for u, and for the arm only as far as it follows: `info["tracking_error"]` [rad/s], the largest
    |v − u| of a joint one step later, must stay below the filter's `tracking_error`. Saturated torques, contact and
    wrong dynamics break that; nothing is said about forces. With exact tracking there is no lag: turn off
    `lag_compensation`.

    `info` of each step tells `cost` (delta) and its part `cost_rows` (the rest: the action jumped more than the joints
    can), `h_min` [m] before the action, `status` (its name), `safety` (a sentence) and `applied`, the action that the
    environment got; of an action that is held: the mean costs, the least h, the worst status and what was said of the
    largest change. With a `Shadow` in place of the filter the action passes untouched, and `info` tells what would have
    been.
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
        opening: Callable[[Any], float] = lambda _: 0.0,
        torque: TorqueDrive | None = None,
        action_repeat: int = 1,
    ) -> None:
        """Filter `env` with `safety`, or only watch it with a `Shadow`.

        `state(observation)` gives joint angles and velocities; by default its entries "q" and "v", or the first n and
        the next n numbers. `wish(action)` gives joint velocities [rad/s] (torques [Nm]), by default its first n
        numbers; `act(wish, action)` writes them back into a copy of the action. `scene(observation, now)` gives the
        obstacles of this step; without it those that `safety.observe` was told of stay. `opening(observation)` is how
        far each finger is open [m]. A slow policy's action is carried out `hold` times in one step, filtered anew each
        time, rewards added up: 20 ms of a policy are 4 steps of an environment of 5 ms.

        Raises:
            InvalidSetup: the environment's `dt` is not the body's period, or its action space is narrower than the
                body's velocity limits.
        """
        super().__init__(env)
        self.shadow = safety if isinstance(safety, ShadowFilter) else None
        self.safety = safety.safety if isinstance(safety, ShadowFilter) else safety
        self._n, self._period = self.safety.robot_model.n, self.safety.robot_model.period
        self._state = state or self._default_state
        self._decode_action = decode_action or self._default_decode
        self._encode_action = encode_action or self._default_encode
        self._scene, self._opening, self._torque = scene, opening, torque
        self._action_repeat = action_repeat
        self._now = 0.0
        self._joint_state: JointState = (np.array(self.safety.robot_model.home), np.zeros(self._n))
        self._observation: Any = None
        self._check_period()
        if torque is None:
            self._check_actions(env.action_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and the filter: it starts from the joint velocity of the first observation."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._now = 0.0
        self._read_observation(observation)
        self.safety.reset(self._joint_state[1])
        if self.shadow:
            self.shadow.reset()
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Filter `action`, carry it out, `hold` times anew, and tell in `info` what was done."""
        answers: list[FilterResult] = []
        total, errors = 0.0, [0.0]
        while True:
            answer = self._filter_action(action)
            untouched = self.shadow or answer.status is FilterStatus.SAFE
            applied = action if untouched else self._encode_action(self._tracking_command(answer), action)
            observation, reward, terminated, truncated, info = self.env.step(applied)
            self._now += self._period
            self._read_observation(observation)
            answers.append(answer)
            total += float(reward)
            errors.append(float(np.abs(self._joint_state[1] - answer.u).max()))
            if terminated or truncated or len(answers) == self._action_repeat:
                break
        info = {**info, **_step_info(answers), "applied": applied}
        if self._torque and not self.shadow:
            info["tracking_error"] = max(errors)
        return observation, total, terminated, truncated, info

    # --- the filter ---------------------------------------------------------------------------------------------

    def _filter_action(self, action: Any) -> FilterResult:
        """A torque-driven arm has no velocity command: what it was made to do is the velocity it has."""
        if self._scene:
            self.safety.observe(self._scene(self._observation, self._now), self._now)
        (q, v), u_prev = self._joint_state, None
        wish = np.asarray(self._decode_action(action), float)
        if self._torque:
            u_prev, wish = v, v + self._period * self._torque.acceleration(q, v, wish)
        opening = self._opening(self._observation)
        if self.shadow:
            return self.shadow.evaluate(q, v, wish, self._now, u_prev=u_prev, opening=opening)
        if u_prev is not None:
            self.safety.reset(u_prev)
        return self.safety(q, v, wish, self._now, opening=opening)

    def _tracking_command(self, answer: FilterResult) -> Array:
        return self._torque.track(*self._joint_state, answer.u) if self._torque else answer.u

    def _read_observation(self, observation: Any) -> None:
        q, v = self._state(observation)
        self._observation, self._joint_state = observation, (np.array(q, float), np.array(v, float))

    # --- where things lie by default ----------------------------------------------------------------------------

    def _default_state(self, observation: Any) -> JointState:
        if isinstance(self.env.observation_space, gymnasium.spaces.Dict):
            return observation["q"], observation["v"]
        return observation[: self._n], observation[self._n : 2 * self._n]

    def _default_decode(self, action: Any) -> Array:
        return action[: self._n]

    def _default_encode(self, velocity: Array, action: Any) -> Any:
        replaced = np.array(action)
        replaced[: self._n] = velocity
        return replaced

    # --- what would break the promise ---------------------------------------------------------------------------

    def _check_period(self) -> None:
        step = getattr(self.env.unwrapped, "dt", None)
        if step is not None and not isclose(float(step), self._period, rel_tol=1e-6):
            raise ConfigurationError(
                "one step of the environment [s]",
                got=float(step),
                allowed=f"the body's period, {self._period:g}",
                fix="Give the filter `driven(body, period=...)` from dualbrain.safety.integration.derating.",
            )

    def _check_actions(self, space: Any) -> None:
        if not hasattr(space, "low"):
            return
        v_max = np.array([joint.velocity.value for joint in self.safety.robot_model.joints])
        low, high = (
            np.asarray(self._decode_action(space.low), float),
            np.asarray(self._decode_action(space.high), float),
        )
        if low.shape != v_max.shape or np.any(low > -v_max * (1.0 - 1e-6)) or np.any(high < v_max * (1.0 - 1e-6)):
            raise ConfigurationError(
                "joint velocities that the action space holds [rad/s]",
                got=[low.tolist(), high.tolist()],
                allowed=f"±{v_max.tolist()} or more: a safe answer may not be clipped",
                fix="Name what an action means by `wish` and `act`, or give the filter `driven(body, speed=...)`.",
            )


def _step_info(results: Sequence[FilterResult]) -> dict[str, Any]:
    """What `info` says of the answers to one action."""
    return {
        "cost": sum(answer.delta for answer in results) / len(results),
        "cost_rows": sum(answer.delta_rows for answer in results) / len(results),
        "h_min": min((answer.h_min for answer in results if not isnan(answer.h_min)), default=nan),
        "status": max(answer.status for answer in results).name,
        "safety": max(results, key=lambda answer: answer.delta).explain(),
    }
