"""One episode in gym-aloha: a policy's actions go to the environment directly, clamped, or through the guard.

The cameras are not rendered: the policies and the guard need no images.
"""

# MuJoCo and gym-aloha ship no type stubs:
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false, reportUnknownMemberType=false

from __future__ import annotations

from collections import Counter
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.loader import load_robot
from dualbrain.simulation.environments import guard_aloha
from dualbrain.simulation.environments.guarded_arms import GuardedArms
from dualbrain.simulation.environments.guarded_mujoco_env import mujoco_handles
from dualbrain.simulation.identification.excitation import ExcitationLog
from dualbrain.simulation.identification.tracking_model import leaky_error
from experiments.robots.aloha.judge import ContactJudge
from experiments.robots.aloha.policies import STEP_TIME, Policy, RandomPolicy, transfer_policy

Array = NDArray[np.float64]

MODES = ("unguarded", "clamped", "guarded", "guarded, hands free")
"""The policy's action directly; each joint at most `CLAMP` from its position; through the guard without and with
permitted contacts of the hands."""
CLAMP = np.radians(5.0)
"""Largest distance of a commanded joint position from the measured one [rad], as LeRobot's `max_relative_target`."""
TASKS = {"transfer": "gym_aloha/AlohaTransferCube-v0", "insertion": "gym_aloha/AlohaInsertion-v0"}
MAX_STEPS = {"random": 300, "careful": 1200, "careless": 600}
"""Steps of 20 ms of an episode by policy; gym-aloha's own limit is 300."""
SIDES = ("left", "right")


class _Recorder:
    """Joint states of both arms before every step, and the commanded positions of the guards."""

    def __init__(self, env: Any) -> None:
        self.model, self.data = mujoco_handles(env)
        names = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
        joints = {side: [self.model.joint(f"vx300s_{side}/{name}") for name in names] for side in SIDES}
        self._q = {side: [int(joint.qposadr[0]) for joint in joints[side]] for side in SIDES}
        self._v = {side: [int(joint.dofadr[0]) for joint in joints[side]] for side in SIDES}
        self.logs: dict[str, list[tuple[Array, Array, Array]]] = {side: [] for side in SIDES}

    def q(self) -> dict[str, Array]:
        """Joint positions of both arms [rad]."""
        return {side: self.data.qpos[self._q[side]].copy() for side in SIDES}

    def v(self) -> dict[str, Array]:
        """Joint velocities of both arms [rad/s]."""
        return {side: self.data.qvel[self._v[side]].copy() for side in SIDES}


def run_episode(parameters: dict[str, Any]) -> dict[str, Any]:
    """The row of one episode with its `parameters`: task, policy, mode and seed."""
    task, policy_name, mode, seed = (parameters[name] for name in ("task", "policy", "mode", "seed"))
    bare = gymnasium.make(TASKS[task], max_episode_steps=MAX_STEPS[policy_name], disable_env_checker=True)
    _disable_cameras(bare)
    env = _in_mode(bare, mode)
    env.reset(seed=seed)
    record = _Recorder(bare)
    judge = ContactJudge(record.model, record.data)
    _judge_every_substep(bare, judge)
    policy = _make_policy(policy_name, record, seed)
    rewards, status, h_min, changes, fastest = [0.0], Counter[str](), float("inf"), [], 0.0
    ended, steps = False, 0
    while not ended:
        q, v = record.q(), record.v()
        action = policy.action(q)
        if mode == "clamped":
            action = _clamped(action, q)
        before = _targets(env)
        _, reward, terminated, truncated, info = env.step(action)
        after = _targets(env)
        for side in before:
            record.logs[side].append((q[side], v[side], (after[side] - before[side]) / STEP_TIME))
        rewards.append(float(reward))
        fastest = max(fastest, *(float(np.abs(one).max()) for one in record.v().values()))
        if isinstance(env, GuardedArms):
            status[info["status"]] += 1
            h_min = min(h_min, info["h_min"])
            changes.append(info["cost"])
        ended, steps = bool(terminated or truncated), steps + 1
    row = {
        **parameters,
        "success": max(rewards) == 4.0,
        "reward": max(rewards),
        "steps": steps,
        "peaks": {kind: round(force, 2) for kind, force in judge.peaks.items()},
        "times": {kind: round(time, 3) for kind, time in judge.times.items()},
        "speed": round(fastest, 3),
    }
    if isinstance(env, GuardedArms):
        row |= {"status": dict(status), "h_min": round(h_min, 5), "cost": round(float(np.mean(changes)), 4)}
        row |= {"tracking": _tracking_share(record)}
    return row


def _in_mode(env: Any, mode: str) -> Any:
    if mode == "guarded":
        return guard_aloha(env)
    return guard_aloha(env, may_touch=("table", "hand")) if mode == "guarded, hands free" else env


def _make_policy(name: str, record: _Recorder, seed: int) -> Policy:
    if name == "random":
        return RandomPolicy(seed)
    cube = record.data.body("box").xpos.copy()
    return transfer_policy(record.model, cube, careful=name == "careful")


def _clamped(action: Array, q: dict[str, Array]) -> Array:
    clamped = action.copy()
    for first, side in ((0, "left"), (7, "right")):
        clamped[first : first + 6] = np.clip(action[first : first + 6], q[side] - CLAMP, q[side] + CLAMP)
    return clamped


def _targets(env: Any) -> dict[str, Array]:
    """Commanded positions (6,) [rad] of the guards, if there are any."""
    if not isinstance(env, GuardedArms):
        return {}
    return {side: guard.target for side, guard in env.guards.items()}


def _tracking_share(record: _Recorder) -> float:
    """The largest tracking error of a joint as a share of the error in the robot model."""
    model = load_robot("vx300s")
    bound = np.array(model.tracking.position_errors(model.n))
    worst = 0.0
    for entries in record.logs.values():
        log = ExcitationLog(*(np.array(values) for values in zip(*entries, strict=True)))
        error = leaky_error(log, model.tracking.lag, model.tracking.rate, STEP_TIME)
        worst = max(worst, float((np.abs(error) / bound).max()))
    return round(worst, 4)


def _disable_cameras(env: Any) -> None:
    """Images without content instead of three rendered ones per step."""

    def render(height: int = 240, width: int = 320, **_: Any) -> NDArray[np.uint8]:
        return np.zeros((height, width, 3), np.uint8)

    env.unwrapped._env.physics.render = render


def _judge_every_substep(env: Any, judge: ContactJudge) -> None:
    """Let `judge` see every step of the simulation, of which one step of the environment has ten."""
    physics = env.unwrapped._env.physics
    step = physics.step

    def judged_step(nstep: int = 1) -> None:
        for _ in range(nstep):
            step(1)
            judge.update()

    physics.step = judged_step
