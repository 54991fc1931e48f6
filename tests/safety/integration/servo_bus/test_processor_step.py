"""The processor step of LeRobot, with a stand-in for the few names of LeRobot that it uses."""

import importlib.util
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from tests.safety.integration.servo_bus.ideal_servos import KEYS, SO101, action

STEP = Path(__file__).resolve().parents[4] / "integrations/lerobot/lerobot_robot_dualbrain/safety_filter_step.py"
HOME = np.array(SO101.home)


class RobotActionStep:
    """As in LeRobot 0.6: `action` gets the action of the transition, and `transition` is a copy of it."""

    def __call__(self, transition):
        self.transition = dict(transition)
        return {**transition, "action": self.action(dict(transition["action"]))}


@pytest.fixture
def step(monkeypatch):
    """The processor step before its first action."""
    names = {
        "lerobot.configs": {"PipelineFeatureType": object, "PolicyFeature": object},
        "lerobot.processor": {
            "EnvTransition": dict,
            "ProcessorStepRegistry": SimpleNamespace(register=lambda _: lambda one: one),
            "RobotActionProcessorStep": RobotActionStep,
            "TransitionKey": SimpleNamespace(ACTION="action", OBSERVATION="observation", INFO="info"),
        },
        "lerobot.teleoperators.utils": {"TeleopEvents": SimpleNamespace(IS_INTERVENTION="is_intervention")},
    }
    for name in ("lerobot", "lerobot.teleoperators", *names):
        module = ModuleType(name)
        module.__dict__.update(names.get(name, {}))
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("safety_filter_step", STEP)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "safety_filter_step", module)
    spec.loader.exec_module(module)
    return module.DualbrainSafetyFilterStep()


def run(step, given, reading):
    return step({"action": given, "observation": reading, "info": None})


def test_a_safe_action_passes_without_a_mark(step):
    found = run(step, action(HOME), action(HOME))
    assert found["action"] == pytest.approx(action(HOME))
    assert not found["info"]["is_intervention"]


@pytest.mark.parametrize(("rate", "action_rate"), [(200.0, 30.0), (100.0, 60.0), (200.0, 200.0)])
def test_a_far_action_moves_no_joint_faster_than_its_limit(step, rate, action_rate, monkeypatch):
    """An action of 33 ms has time for six periods of 5 ms; with seven the arm moves at 105 % of its speed."""
    now, reading, travelled = 100.0, action(HOME), []
    monkeypatch.setattr(time, "monotonic", lambda: now)
    step.rate, step.action_rate = rate, action_rate
    for _ in range(int(action_rate)):
        written = run(step, action(HOME + np.array([1.5, 0.0, 0.0, 0.0, 0.0])), reading)["action"]
        travelled.append(np.radians(written[KEYS[0]] - reading[KEYS[0]]))
        reading, now = written, now + 1.0 / action_rate
    assert step._servos.state.problem == ""
    limit = SO101.joints[0].velocity.value
    assert 0.5 * limit < max(travelled) * action_rate <= limit + 1e-6


@pytest.mark.parametrize(
    ("reading", "message"),
    [
        (None, "no finite number for shoulder_pan.pos"),
        ({"gripper.pos": 3.0}, "no finite number for shoulder_pan.pos"),
        (action(HOME) | {KEYS[1]: float("nan")}, "no finite number for shoulder_lift.pos"),
        (action(HOME) | {KEYS[0]: 200.0}, "shoulder_pan.pos reads 200.0° after calibration"),
    ],
)
def test_the_first_observation_of_an_episode_must_fit_the_robot_model(step, reading, message):
    for _ in range(2):
        with pytest.raises(ConfigurationError, match=message):
            run(step, action(HOME + 0.3), reading)
    run(step, action(HOME), action(HOME))
    run(step, action(HOME), reading)  # during an episode the arm comes to rest, and holds its command
    step.reset()
    with pytest.raises(ConfigurationError, match=message):
        run(step, action(HOME), reading)
