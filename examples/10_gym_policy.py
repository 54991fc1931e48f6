"""A policy behind the filter: any gymnasium environment whose actions are joint velocities.

Run: `python examples/10_gym_policy.py`. Needs gymnasium (`pip install 'dualbrain[gym]'`).
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, SafetyFilter
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.gym_env import FilteredEnv
from dualbrain.safety.integration.shadow_mode import ShadowFilter

BODY = derate(load_robot("panda"), period=0.005, max_speed=1.5)  # this environment's own period and speed limit
SCENE = [
    Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0))),
    Obstacle("shelf", Box((0.15, 0.25, 0.02)), Pose((0.6, -0.1, 0.2))),
]
EXACT = FilterConfig(lag_compensation=False, tracking_error=0.0)  # here the joints do exactly what they are told


class Reach(gymnasium.Env[Any, Any]):
    """Joints that follow at once; actions in [-1, 1] are shares of 1.5 rad/s. The observation is q and v."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)
    observation_space = gymnasium.spaces.Box(-6.0, 6.0, (14,), np.float64)
    dt = 0.005

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """The arm is at home, at rest."""
        super().reset(seed=seed)
        self.q = np.array(BODY.home)
        return np.concatenate([self.q, np.zeros(7)]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One period at constant speed; the reward is for a low hand, which is how policies learn to hit tables."""
        v = 1.5 * np.asarray(action, float)
        self.q = self.q + self.dt * v
        return np.concatenate([self.q, v]), float(self.q[1]), False, False, {}


def behind(safety: SafetyFilter | ShadowFilter) -> FilteredEnv:
    """The environment behind `safety`: the policy acts at 50 Hz, the filter at 200 Hz."""
    return FilteredEnv(
        Reach(),
        safety,
        decode_action=lambda action: 1.5 * np.asarray(action),
        encode_action=lambda u, _: (u / 1.5).astype(np.float32),
        action_repeat=4,
    )


def roll(env: FilteredEnv, title: str) -> None:
    """Two seconds of a random policy that likes to go down."""
    rng, action, least, cost, said = np.random.default_rng(0), np.zeros(7), np.inf, 0.0, ""
    env.reset(seed=0)
    for _ in range(100):
        wish = rng.normal([0.0, 0.4, 0.0, 0.1, 0.0, 0.0, 0.0], 0.5)
        action = np.clip(action + 0.1 * (wish - action), -1.0, 1.0)
        _, _, _, _, info = env.step(action.astype(np.float32))
        cost += info["cost_rows"]
        if info["h_min"] < least:
            least, said = info["h_min"], info["safety"]
    print(f"{title}: least h {least * 1e3:.1f} mm, total cost {cost:.2f}; there: {said}")


def main() -> None:
    """The same policy, watched and filtered."""
    for title, wrap in (("watched", ShadowFilter), ("filtered", lambda safety: safety)):
        safety = SafetyFilter(BODY, EXACT)
        safety.observe(SCENE)
        roll(behind(wrap(safety)), title)


if __name__ == "__main__":
    main()
