"""A policy behind the filter, in a gymnasium environment whose actions are joint velocities.

Run: `python examples/06_gym_policy.py`. Needs gymnasium (`pip install 'dualbrain[gym]'`).
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from dualbrain import (
    Box,
    FilterConfig,
    FilteredEnv,
    HalfSpace,
    Obstacle,
    Pose,
    SafetyFilter,
    ShadowFilter,
    load_robot,
)
from dualbrain.safety import derate

ROBOT = derate(load_robot("panda"), period=0.005, max_speed=1.5)  # period and speed limit of this environment
OBSTACLES = [
    Obstacle("table", HalfSpace()),
    Obstacle("shelf", Box((0.15, 0.25, 0.02)), Pose((0.6, -0.1, 0.2))),
]
EXACT = FilterConfig(lag_compensation=False, tracking_error=0.0)  # the joints follow the control exactly


class Reach(gymnasium.Env[Any, Any]):
    """Joints that follow immediately; an action in [-1, 1] is a fraction of 1.5 rad/s. The observation is (q, v)."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)
    observation_space = gymnasium.spaces.Box(-6.0, 6.0, (14,), np.float64)
    dt = 0.005

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the arm to its home position."""
        super().reset(seed=seed)
        self.q = np.array(ROBOT.home)
        return np.concatenate([self.q, np.zeros(7)]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Simulate one period at constant speed; the reward is for a low hand."""
        v = 1.5 * np.asarray(action, float)
        self.q = self.q + self.dt * v
        return np.concatenate([self.q, v]), float(self.q[1]), False, False, {}


def wrap(safety: SafetyFilter | ShadowFilter) -> FilteredEnv:
    """The environment behind `safety`: the policy runs at 50 Hz, the filter at 200 Hz."""
    return FilteredEnv(
        Reach(),
        safety,
        decode_action=lambda action: 1.5 * np.asarray(action),
        encode_action=lambda u, _: (u / 1.5).astype(np.float32),
        action_repeat=4,
    )


def run_policy(env: FilteredEnv, title: str) -> None:
    """Run a random policy with a tendency downward for two seconds."""
    rng, action, least, cost, reason = np.random.default_rng(0), np.zeros(7), np.inf, 0.0, ""
    env.reset(seed=0)
    for _ in range(100):
        target = rng.normal([0.0, 0.4, 0.0, 0.1, 0.0, 0.0, 0.0], 0.5)
        action = np.clip(action + 0.1 * (target - action), -1.0, 1.0)
        _, _, _, _, info = env.step(action.astype(np.float32))
        cost += info["cost_rows"]
        if info["h_min"] < least:
            least, reason = info["h_min"], info["safety"]
    print(f"{title}: minimum h {least * 1e3:.1f} mm, total cost {cost:.2f}; at the minimum: {reason}")


def main() -> None:
    """Run the same policy in shadow mode and with the active filter."""
    for title, make in (("shadow mode", ShadowFilter), ("active filter", lambda safety: safety)):
        safety = SafetyFilter(ROBOT, EXACT, obstacles=OBSTACLES)
        run_policy(wrap(make(safety)), title)


if __name__ == "__main__":
    main()
