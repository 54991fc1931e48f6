"""The guarded embodiment: everything is that of the inner one, but it executes only reviewed actions."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import ceil, isfinite
from typing import Any

from inspect_robots.approver import GuardrailContribution
from inspect_robots.embodiment import Embodiment, EmbodimentInfo
from inspect_robots.errors import ConfigError
from inspect_robots.registry import resolve
from inspect_robots.scene import Scene as TaskScene
from inspect_robots.spaces import Box
from inspect_robots.types import Action, Observation, StepResult

from dualbrain import PolicyGuard, RobotModel, SafetyFilter, load_robot
from dualbrain.errors import ConfigurationError, DualbrainError
from dualbrain.safety import derate
from dualbrain.safety.integration.servo_bus.servo_settings import make_filter
from inspect_robots_dualbrain.approver import RECORD, DualbrainApprover, Scene
from inspect_robots_dualbrain.joint_map import JointMap, make_action_space
from inspect_robots_dualbrain.joint_state import JointStateReader

FILTER_PERIOD = 0.004
"""Largest period of the filter [s], up to which the kernel has room for all rows (`derate`).

An action that takes longer is filtered several times, on the predicted motion.
"""
MAX_STATE_AGE = 1.0
"""Age of the joint state [s] at which a real embodiment holds instead of moving."""


class GuardedEmbodiment:
    """An embodiment behind the guard; its `approver` reviews the actions, and `step` refuses all others.

    The motions of `reset`, of parking and of `close` are those of the inner embodiment and pass no guard.
    """

    def __init__(
        self,
        inner: Embodiment,
        robot_model: RobotModel,
        *,
        safety: Callable[[RobotModel], SafetyFilter] | None = None,
        joints: Sequence[str] = (),
        units: str = "",
        delta_reference: str = "",
        max_state_age: float = MAX_STATE_AGE,
        scene: Scene | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Guard `inner`, whose arm is `robot_model`.

        `safety` makes the filter for the robot model with the period of the guard; by default the plane z = 0 of the
        base is a table. `joints`, `units`: see `JointMap.of`. `delta_reference`: the position to which the embodiment
        adds a joint_delta. `max_state_age` [s]: age of the joint state at which a real embodiment holds instead of
        moving. `scene(observation, now)` gives moving obstacles.

        Raises:
            ConfigurationError, UnknownNameError: the embodiment does not fit the robot model or the guard.
        """
        self.inner = inner
        self.info: EmbodimentInfo = replace(inner.info, name=f"{inner.info.name}+dualbrain")
        period, filter_period = _periods(inner.info)
        joint_map = JointMap.of(inner.info, robot_model, joints=joints, units=units)
        space = make_action_space(inner.info, joint_map.layout, delta_reference)
        derated = derate(robot_model, period=filter_period)
        chosen = make_filter(derated, "") if safety is None else safety(derated)
        if not max_state_age > 0.0:
            raise ConfigurationError("max_state_age [s]", got=max_state_age, allowed="above 0")
        max_age = None if inner.info.is_simulated else max_state_age
        self.approver = DualbrainApprover(
            PolicyGuard(chosen, space, period=period, action_size=joint_map.size),
            JointStateReader(joint_map, period=period, max_age=max_age, clock=clock),
            scene,
        )

    def contribute_guardrails(self, action_space: Box) -> GuardrailContribution:
        """The guardrails of the inner embodiment, and the approver as the last one."""
        hook = getattr(self.inner, "contribute_guardrails", None)
        own: GuardrailContribution = GuardrailContribution() if hook is None else hook(action_space)
        return GuardrailContribution(
            approvers=(*own.approvers, (RECORD, self.approver)),
            warnings=own.warnings,
        )

    def reset(self, scene: TaskScene, *, seed: int | None = None) -> Observation:
        """Reset the inner embodiment, and begin an episode at its joint state."""
        observation = self.inner.reset(scene, seed=seed)
        self.approver.begin(observation)
        return observation

    def step(self, action: Action) -> StepResult:
        """Execute a reviewed action; `info` and the observation's `extra` have the review.

        Raises:
            SafetyAbort: the approver did not return this action.
        """
        self.approver.claim(action)
        result = self.inner.step(action)
        self.approver.update(result.observation)
        review = self.approver.last
        record = {} if review is None else {RECORD: review.as_dict()}
        observation = replace(result.observation, extra={**result.observation.extra, **record})
        return replace(result, observation=observation, info={**result.info, **record})

    def close(self) -> None:
        """Close the inner embodiment."""
        self.inner.close()

    def __getattr__(self, name: str) -> Any:
        """The optional hooks of inspect-robots (`bind_task`, `connect_operator_session` …) of the inner embodiment."""
        if name == "inner":
            raise AttributeError(name)
        return getattr(self.inner, name)


def dualbrain_guarded(
    *,
    inner: str,
    guard_model: str,
    guard_site: str = "",
    guard_joints: str = "",
    guard_units: str = "",
    guard_delta_reference: str = "",
    guard_max_state_age: float = MAX_STATE_AGE,
    **inner_arguments: Any,
) -> GuardedEmbodiment:
    """The registered embodiment `inner` behind the guard, for `-E inner=franka -E guard_model=fr3 …`.

    `guard_model`: a packaged robot, or the folder of an imported one. `guard_site`: a site file with planes, boxes and
    limits. `guard_joints`: labels or indices, separated by commas. All other arguments are those of `inner`.

    Raises:
        ConfigError: the embodiment does not fit the robot model or the guard.
    """
    embodiment: Embodiment = resolve("embodiment", inner, **inner_arguments)
    try:
        return GuardedEmbodiment(
            embodiment,
            load_robot(str(guard_model)),
            safety=lambda model: make_filter(model, guard_site),
            joints=tuple(part.strip() for part in str(guard_joints).split(",") if part.strip()),
            units=guard_units,
            delta_reference=guard_delta_reference,
            max_state_age=guard_max_state_age,
        )
    except DualbrainError as error:
        embodiment.close()
        raise ConfigError(str(error)) from error


def _periods(info: EmbodimentInfo) -> tuple[float, float]:
    """The period of the embodiment and of the filter [s].

    Raises `ConfigurationError` if the embodiment declares no usable rate.
    """
    rate = info.control_hz
    if rate is None or not (isfinite(rate) and rate > 0.0):
        raise ConfigurationError(
            f"control_hz of {info.name} [1/s]",
            got=rate,
            allowed="above 0",
            fix="Declare the rate at which the embodiment executes actions: the guard predicts the motion of one.",
        )
    period = 1.0 / rate
    return period, period / ceil(period / FILTER_PERIOD - 1e-9)
