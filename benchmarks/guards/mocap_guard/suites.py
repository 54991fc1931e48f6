"""The tasks of both suites with the same interface: start from a seed, step, and where tool, object and goal are."""

# The suites and MuJoCo ship no type stubs, and are installed in environments of their own:
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

from __future__ import annotations

from typing import Any, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.simulation.environments import guard_fetch, guard_metaworld

Array = NDArray[np.float64]


class Suite(Protocol):
    """One task of a suite. `env` is the environment; `substep` is called after every step of its simulation."""

    env: Any
    arm_root: str
    robot_root: str

    def guard(self, **options: Any) -> Any:
        """The guarded environment."""
        ...

    def start(self, env: Any, seed: int) -> Any:
        """Reset `env`, which is `self.env` or has it behind a guard, to the start of `seed`; the observation."""
        ...

    def watch(self, substep: Any) -> None:
        """Call `substep()` after every step of the simulation."""
        ...

    def places(self, observation: Any) -> dict[str, Array]:
        """`tool`, `object` and `goal` (3,) [m]; without an object it is the goal."""
        ...

    def succeeded(self, info: dict[str, Any]) -> bool:
        """The success check of the suite."""
        ...


class FetchTask:
    """A Fetch environment of gymnasium-robotics."""

    arm_root, robot_root = "robot0:shoulder_pan_link", "robot0:torso_lift_link"

    def __init__(self, name: str, seed: int) -> None:
        """Make the environment `name` without a time limit."""
        import gymnasium  # noqa: PLC0415  # each suite is in an environment of its own
        import gymnasium_robotics  # noqa: PLC0415

        del seed
        gymnasium.register_envs(gymnasium_robotics)
        self.env = gymnasium.make(f"{name}-v4", max_episode_steps=10_000, disable_env_checker=True)

    def guard(self, **options: Any) -> Any:
        """`guard_fetch`."""
        return guard_fetch(self.env, **options)

    def start(self, env: Any, seed: int) -> Any:
        """Reset to the start of `seed`."""
        return env.reset(seed=seed)[0]

    def watch(self, substep: Any) -> None:
        """Replace the call that simulates all steps of one action."""
        inner = self.env.unwrapped

        def simulate(_: Any) -> None:
            for _ in range(inner.n_substeps):
                mujoco.mj_step(inner.model, inner.data)
                substep()

        inner._mujoco_step = simulate

    def places(self, observation: Any) -> dict[str, Array]:
        """The tool is the site `grip`."""
        tool, goal = np.array(observation["observation"][:3]), np.array(observation["desired_goal"])
        thing = np.array(observation["achieved_goal"]) if self.env.unwrapped.has_object else goal
        return {"tool": tool, "object": thing, "goal": goal}

    def succeeded(self, info: dict[str, Any]) -> bool:
        """`is_success`."""
        return bool(info["is_success"])


class MetaworldTask:
    """A v3 environment of metaworld, with the first task of a seed."""

    arm_root, robot_root = "right_l0", "base"

    def __init__(self, name: str, seed: int) -> None:
        """Make the environment `name` with the goal and the object of `seed`."""
        import metaworld  # noqa: PLC0415
        from metaworld.policies import ENV_POLICY_MAP  # noqa: PLC0415

        benchmark = metaworld.MT1(name, seed=seed)
        self.env = benchmark.train_classes[name]()
        self.env.set_task(benchmark.train_tasks[0])
        self.expert = ENV_POLICY_MAP[name]()

    def guard(self, **options: Any) -> Any:
        """`guard_metaworld`."""
        return guard_metaworld(self.env, **options)

    def start(self, env: Any, seed: int) -> Any:
        """Reset; the seed is that of the task."""
        del seed
        return env.reset()[0]

    def watch(self, substep: Any) -> None:
        """Replace the call that simulates all steps of one action."""
        inner = self.env.unwrapped

        def simulate(ctrl: Any, n_frames: int) -> None:
            inner.data.ctrl[:] = ctrl
            for _ in range(n_frames):
                mujoco.mj_step(inner.model, inner.data)
                substep()
            mujoco.mj_rnePostConstraint(inner.model, inner.data)

        inner._step_mujoco_simulation = simulate

    def places(self, observation: Any) -> dict[str, Array]:
        """The tool is the end effector of the suite."""
        tool, goal = np.array(observation[:3]), np.array(self.env.unwrapped._target_pos)
        return {"tool": tool, "object": np.array(observation[4:7]), "goal": goal}

    def succeeded(self, info: dict[str, Any]) -> bool:
        """`success`."""
        return bool(info["success"])


def make_task(suite: str, name: str, seed: int) -> FetchTask | MetaworldTask:
    """The task `name` of `suite`, "fetch" or "metaworld"."""
    return FetchTask(name, seed) if suite == "fetch" else MetaworldTask(name, seed)
