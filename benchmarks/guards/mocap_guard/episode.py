"""One episode: a policy's displacements go to the environment directly, or through the guard."""

from __future__ import annotations

import time
from collections import Counter
from typing import Any

import numpy as np

from benchmarks.guards.mocap_guard.contact_judge import ContactJudge
from benchmarks.guards.mocap_guard.policies import make_policy
from benchmarks.guards.mocap_guard.suites import make_task
from dualbrain.simulation.environments.mocap.gymnasium_robotics import BODIES_AT_TORSO

OPTIONS: dict[str, dict[str, dict[str, Any]]] = {
    "fetch": {"guarded": {}, "guarded, 12 mm": {"deviation": 0.012}},
    "metaworld": {"guarded": {}, "guarded, table ignored": {"ignored": ("obj", "tablelink")}},
}
"""Options of the guard by suite and mode."""
IGNORED = {"fetch": ("object0",), "metaworld": ("obj",)}
"""Bodies that a policy may touch in every mode."""
OWN = {"fetch": BODIES_AT_TORSO, "metaworld": ()}
"""Further bodies of the robot that the suite does not let collide with the shoulder."""
MAX_STEPS = {"fetch": 150, "metaworld": 450}
AIMLESS_STEPS = 120
"""Length of an episode without a task: low and random."""
STOP_WORDS = "from its computed place"


def run_episode(parameters: dict[str, Any]) -> dict[str, Any]:
    """The row of one episode; `parameters`: suite, task, policy, mode and seed."""
    suite, mode, seed = parameters["suite"], parameters["mode"], parameters["seed"]
    task = make_task(suite, parameters["task"], seed)
    guarded = mode != "unguarded"
    env = task.guard(**OPTIONS[suite][mode]) if guarded else task.env
    times = _timed(env) if guarded else []
    observation = task.start(env, seed)
    inner: Any = task.env.unwrapped
    ignored = OPTIONS[suite].get(mode, {}).get("ignored", IGNORED[suite])
    judge = ContactJudge(inner.model, first=task.arm_root, robot=task.robot_root, ignored=(*ignored, *OWN[suite]))
    judge.update(inner.data)
    task.watch(lambda: judge.update(inner.data))
    policy = make_policy(parameters["policy"], parameters["task"], seed, getattr(task, "expert", None))
    aims = parameters["policy"] in ("careful", "straight")
    places = task.places(observation)
    record: dict[str, Any] = {"start": {name: place.round(4).tolist() for name, place in places.items()}}
    watch = _GuardRecord() if guarded else None
    success, steps, began = 0, 0, time.process_time()
    for steps in range(1, (MAX_STEPS[suite] if aims else AIMLESS_STEPS) + 1):
        observation, _, _, _, info = env.step(policy(places, observation).astype(np.float32))
        places = task.places(observation)
        if watch is not None:
            watch.add(info)
        if aims and task.succeeded(info):
            success = steps
            break
    record |= {
        "steps": steps,
        "success": success,
        "time": round(steps * float(inner.dt), 3),
        "cpu": round((time.process_time() - began) / steps * 1e3, 2),
        "at_start": sorted(judge.at_start or ()),
        "depth": {pair: round(depth, 5) for pair, depth in judge.depth.items()},
        "contact_time": {pair: round(seconds, 4) for pair, seconds in judge.time.items()},
        "end": {name: place.round(4).tolist() for name, place in places.items()},
    }
    if watch is not None:
        record |= watch.row(times)
    return {**parameters, **record}


class _GuardRecord:
    """What the guard reported in one episode."""

    def __init__(self) -> None:
        self._worst = {"deviation": 0.0, "arm_deviation": 0.0}
        self._status, self._stops, self._h_min, self._last = Counter[str](), 0, float("inf"), ""

    def add(self, info: dict[str, Any]) -> None:
        for name in self._worst:
            self._worst[name] = max(self._worst[name], float(info[name]))
        self._status[info["status"]] += 1
        self._stops += STOP_WORDS in info["safety"]
        self._h_min, self._last = min(self._h_min, float(info["h_min"])), info["safety"]

    def row(self, times: list[float]) -> dict[str, Any]:
        """The entries of the row; `filter_ms` are the median and the 99th percentile of `times` [s]."""
        return {
            **{name: round(value, 5) for name, value in self._worst.items()},
            "status": dict(self._status),
            "stops": self._stops,
            "h_min": round(self._h_min, 5),
            "last": self._last[:160],
            "filter_ms": [round(1e3 * float(np.quantile(times, share)), 2) for share in (0.5, 0.99)],
        }


def _timed(env: Any) -> list[float]:
    """The times [s] of all calls of the guard of `env` from now on."""
    guarded, times = env._guarded_action, list[float]()

    def timed(action: Any) -> Any:
        began = time.perf_counter()
        applied = guarded(action)
        times.append(time.perf_counter() - began)
        return applied

    env._guarded_action = timed
    return times
