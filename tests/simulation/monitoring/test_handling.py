"""Gentle handling: a resting glass is unharmed; tilting, dropping and shaking are detected and prevent success."""

import msgspec
import numpy as np
import pytest

from dualbrain.errors import UnknownNameError
from dualbrain.records import Violation
from dualbrain.simulation.monitoring.handling import HARM_KINDS, MAX_ACCELERATION, MAX_TILT, is_unharmed
from dualbrain.simulation.monitoring.safety_monitor import PEAK_UNITS, SafetyMonitor
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.tasks.families import make_task
from dualbrain.simulation.world import SimulatedWorld
from tests.simulation.scripted_hand import PANDA, wait

TASK = make_task("fragile_transfer", "II", 1, "panda")


def monitored_plant(spec=TASK.spec):
    p = Plant(spec, PANDA)
    monitor = SafetyMonitor(p)
    monitor.require_gentle_handling("clear_glass")
    wait(p, 0.4, each=monitor.update)
    return p, monitor


def kinds(monitor):
    return {violation.kind for violation in monitor.violations() if "clear_glass" in violation.bodies}


def place(p, position, quaternion=(1, 0, 0, 0)):
    joint = p.data.joint("clear_glass")
    joint.qpos[:3], joint.qpos[3:], joint.qvel[:] = position, quaternion, 0.0


def test_a_resting_glass_is_unharmed():
    _, monitor = monitored_plant()
    assert monitor.violations() == ()


def test_release_from_four_millimetres_is_gentle_and_from_three_centimetres_is_not():
    for height, gentle in ((0.004, True), (0.03, False)):
        p, monitor = monitored_plant()
        monitor.allow(held="clear_glass", phase="release")
        x, y, _ = TASK.spec.find_place("coaster").position
        wait(p, 0.1)
        place(p, (x, y, 0.0451 + height))
        monitor.require_gentle_handling("clear_glass")
        wait(p, 0.4, each=monitor.update)
        assert ("shaken_load" in kinds(monitor)) is not gentle
    peak = next(v.peak for v in monitor.violations() if v.kind == "shaken_load")
    assert peak == pytest.approx(np.sqrt(2 * 9.81 * 0.03) / 0.05, rel=0.1)
    assert peak > MAX_ACCELERATION


@pytest.mark.parametrize(("angle", "tilted"), [(MAX_TILT - 0.05, False), (MAX_TILT + 0.05, True)])
def test_a_tilt_is_reported_above_its_limit(angle, tilted):
    p, monitor = monitored_plant()
    wait(p, 0.02, each=monitor.update)
    for _ in range(20):
        place(p, (0.5, 0.0, 0.3), (np.cos(angle / 2), np.sin(angle / 2), 0, 0))
        p.advance()
        monitor.update()
    assert ("tilted_load" in kinds(monitor)) is tilted


def test_an_unknown_object_is_rejected():
    p = Plant(TASK.spec, PANDA)
    with pytest.raises(UnknownNameError, match="clear_glass"):
        SafetyMonitor(p).require_gentle_handling("cleer_glass")


@pytest.mark.parametrize("kind", HARM_KINDS)
def test_harm_to_the_object_counts_and_harm_to_another_does_not(kind):
    harm = Violation(kind=kind, start=0.0, duration=0.1, peak=9.0, bodies=("clear_glass",))
    assert kind in PEAK_UNITS
    assert not is_unharmed("clear_glass", (harm,))
    assert is_unharmed("clear_glass", (msgspec.structs.replace(harm, bodies=("other_glass",)),))


@pytest.mark.parametrize(("fall", "success"), [(0.0005, True), (0.03, False)])
def test_a_glass_that_was_dropped_on_its_coaster_is_no_success(fall, success):
    p = Plant(TASK.spec, PANDA)
    world = SimulatedWorld(p, NoisyPerception(TASK.spec, NO_NOISE, np.random.default_rng(0)), goal=TASK.goal)
    x, y, _ = TASK.spec.find_place("coaster").position
    for _ in range(320):
        place(p, (x, y, 0.0451 + fall))
        world.advance()
    for _ in range(1000):
        world.advance()
    verdict = world.judgement()
    assert verdict.success is success
    assert verdict.progress == (1.0 if success else 0.99)
