"""Gentle handling: a calm glass is unharmed; tilting, dropping and shaking are caught, and undo a success."""

import msgspec
import numpy as np
import pytest

from dualbrain.errors import UnknownName
from dualbrain.records import Violation
from dualbrain.simulation.monitoring.handling import HARMS, SHAKE, TILT, unharmed
from dualbrain.simulation.monitoring.safety_monitor import UNITS, Monitor
from dualbrain.simulation.perception.noisy_perception import EXACT, Perception
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.tasks.families import assign
from dualbrain.simulation.world import SimulatedWorld
from tests.simulation.scripted_hand import BODY, rest

GIVEN = assign("fragile_transfer", "II", 1, "panda")


def watched(spec=GIVEN.spec):
    p = Plant(spec, BODY)
    monitor = Monitor(p)
    monitor.handle("clear_glass")
    rest(p, 0.4, each=monitor.tick)
    return p, monitor


def kinds(monitor):
    return {violation.kind for violation in monitor.violations() if "clear_glass" in violation.bodies}


def place(p, position, quaternion=(1, 0, 0, 0)):
    joint = p.data.joint("clear_glass")
    joint.qpos[:3], joint.qpos[3:], joint.qvel[:] = position, quaternion, 0.0


def test_a_glass_that_stands_is_unharmed():
    _, monitor = watched()
    assert monitor.violations() == ()


def test_set_down_from_four_millimetres_is_gentle_and_from_three_centimetres_is_not():
    for height, gentle in ((0.004, True), (0.03, False)):
        p, monitor = watched()
        monitor.allow(held="clear_glass", phase="release")
        x, y, _ = GIVEN.spec.place("coaster").position
        rest(p, 0.1)
        place(p, (x, y, 0.0451 + height))
        monitor.handle("clear_glass")
        rest(p, 0.4, each=monitor.tick)
        assert ("shaken_load" in kinds(monitor)) is not gentle
    peak = next(v.peak for v in monitor.violations() if v.kind == "shaken_load")
    assert peak == pytest.approx(np.sqrt(2 * 9.81 * 0.03) / 0.05, rel=0.1)
    assert peak > SHAKE


@pytest.mark.parametrize(("angle", "tilted"), [(TILT - 0.05, False), (TILT + 0.05, True)])
def test_a_lean_counts_above_its_limit(angle, tilted):
    p, monitor = watched()
    rest(p, 0.02, each=monitor.tick)
    for _ in range(20):
        place(p, (0.5, 0.0, 0.3), (np.cos(angle / 2), np.sin(angle / 2), 0, 0))
        p.advance()
        monitor.tick()
    assert ("tilted_load" in kinds(monitor)) is tilted


def test_other_things_are_not_handled():
    p = Plant(GIVEN.spec, BODY)
    with pytest.raises(UnknownName, match="clear_glass"):
        Monitor(p).handle("cleer_glass")


@pytest.mark.parametrize("kind", HARMS)
def test_harm_to_the_thing_undoes_a_success_and_harm_to_another_does_not(kind):
    harm = Violation(kind, 0.0, 0.1, 9.0, ("clear_glass",))
    assert kind in UNITS
    assert not unharmed("clear_glass", (harm,))
    assert unharmed("clear_glass", (msgspec.structs.replace(harm, bodies=("other_glass",)),))


@pytest.mark.parametrize(("fall", "success"), [(0.0005, True), (0.03, False)])
def test_a_glass_that_was_dropped_on_its_coaster_has_not_been_delivered(fall, success):
    p = Plant(GIVEN.spec, BODY)
    world = SimulatedWorld(p, Perception(GIVEN.spec, EXACT, np.random.default_rng(0)), goal=GIVEN.goal)
    x, y, _ = GIVEN.spec.place("coaster").position
    for _ in range(320):
        place(p, (x, y, 0.0451 + fall))
        world.advance()
    for _ in range(1000):
        world.advance()
    verdict = world.judgement()
    assert verdict.success is success
    assert verdict.progress == (1.0 if success else 0.99)
