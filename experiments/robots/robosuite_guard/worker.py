"""The process in robosuite's environment: one episode per request, of a policy without a guard or behind one."""

from __future__ import annotations

import sys
import time
from typing import Any

import mujoco
import numpy as np
import robosuite

from dualbrain.simulation.environments import guard_robosuite
from experiments.engine.worker_process import serve
from experiments.robots.robosuite_guard.contact_judge import ContactJudge
from experiments.robots.robosuite_guard.policies import RandomPolicy, ScriptedPolicy

CLAMP = 0.2
"""Largest entry of an action of the arm behind the clamp: 1 cm and 0.1 rad per policy step."""
MAX_STEPS = 600
HORIZON = 1_000_000


def run_episode(parameters: dict[str, Any]) -> dict[str, Any]:
    """The row of one episode."""
    task, mode = parameters["task"], parameters["mode"]
    env = robosuite.make(
        task,
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        horizon=HORIZON,
        ignore_done=True,
        seed=parameters["seed"],
    )
    env.sim.forward()  # robosuite leaves the poses of the model before its first step
    guarded = guard_robosuite(env) if mode == "guarded" else None
    judge = ContactJudge(env, task)
    update = env._update_observables

    def judged_update(*arguments: Any, **options: Any) -> None:
        judge.update()
        update(*arguments, **options)

    env._update_observables = judged_update
    policy = RandomPolicy(parameters["seed"]) if parameters["policy"] == "random" else None
    policy = policy or ScriptedPolicy(env, task, parameters["policy"] == "careless")
    record: dict[str, Any] = {"steps": 0, "changed": 0, "h_min": 1.0, "strayed": 0.0, "status": {}}
    started = time.process_time()
    while not policy.done and record["steps"] < MAX_STEPS:
        action = policy()
        if mode == "clamped":
            action = np.append(np.clip(action[:6], -CLAMP, CLAMP), action[6])
        if guarded is None:
            env.step(action)
        else:
            _record_guard(record, guarded.step(action)[3], guarded)
        record["steps"] += 1
    record["cpu"] = round((time.process_time() - started) / record["steps"] * 1e3, 2)
    success = bool(env._check_success())
    env.close()
    return {**parameters, **record, "success": success, "outside": judge.outside, "links": judge.between_links}


def _record_guard(record: dict[str, Any], info: dict[str, Any], guarded: Any) -> None:
    record["changed"] += bool(info["changed"])
    record["h_min"] = min(record["h_min"], info["h_min"])
    record["status"][info["status"]] = record["status"].get(info["status"], 0) + 1
    allowed = np.array(guarded.safety.robot_model.tracking.position_errors(guarded.safety.robot_model.n))
    record["strayed"] = max(record["strayed"], float(np.max(info["tracking_error"] / allowed)))


def main() -> None:
    """Answer requests until the input ends."""
    serve({"robosuite": robosuite.__version__, "mujoco": mujoco.__version__, "numpy": np.__version__}, run_episode)


if __name__ == "__main__":
    sys.exit(main())
