"""A hand that was stopped around a thing: what it holds is held, what it touches may be left, nothing fights it."""

import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopInputs, LoopObserver
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.control.residual_contacts import CLEARANCE, ResidualContacts
from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.skill import PermittedContact

BODY = load_robot("panda")
GRASP = {
    "object": "red_cube",
    "speed": 0.4,
    "clearance": 0.1,
    "finger_axis": "along",
    "opening": 0.08,
    "approach": "top",
    "wait": "none",
    "force": 20.0,
}
PLACE = {"destination": "blue_bowl", "speed": 0.4, "clearance": 0.1, "route": "direct", "wait": "none"}


class Stopped:
    """A grasp whose commander is lost for a moment, as soon as `strikes(layer)`; then the next contract."""

    def __init__(self, strikes, flag=Condition.LINK_LOST):
        spec = open_scene("bare:0")
        self.plant, self.until, self.strikes, self.flag = Plant(spec, BODY), None, strikes, flag
        self.world = SimulatedWorld(self.plant, NoisyPerception(spec, PerceptionNoise(), np.random.default_rng([0, 1])))
        self.log = FlightLog(Trace(BODY.n))
        self.layer = ContractExecutor(
            ControlLoop(
                BODY,
                self.plant,
                self.world,
                SafetyFilter(BODY),
                self.log,
                ControlLoopConfig(),
                LoopObserver(on_phase=self.world.set_phase),
                inputs=LoopInputs(external_conditions=self.asked, clock=lambda: self.plant.now),
            )
        )
        self.outcome = self.run("grasp", GRASP)

    def asked(self):
        if self.until is None and self.strikes(self.layer):
            self.until = self.plant.now + 0.1
        return int(self.flag) if self.until is not None and self.plant.now < self.until else 0

    def run(self, skill, params):
        return self.layer.execute(Contract("c-1", Context("panda", ""), (Action(skill, params),)))

    def unharmed(self):
        return self.world.judgement().violations == ()


def phase(layer):
    return layer.log.trace.events[-1].text if layer.log.trace.events else ""


def closing(layer):
    """The fingers have begun to close, and touch nothing yet."""
    return phase(layer) == "grasp: close" and layer.state.opening < 0.037


def around(layer):
    """The open fingers are around the cube: the last centimetre of the way down."""
    cube = layer.scene.find("red_cube").pose.position
    return phase(layer) == "grasp: descend" and layer.limb.observation.tool.position[2] < cube[2] + 0.018


def test_a_thing_that_the_fingers_were_stopped_on_is_held_and_can_be_put_down():
    story = Stopped(closing)
    assert story.outcome.kind == "stopped"
    assert story.layer.loop.controller.holding is not None, "it is between the fingers, and they press on it"
    assert story.layer.loop.controller.holding.name == "red_cube"
    then = story.run("place", PLACE)
    assert (then.kind, then.reason) == ("succeeded", "red_cube is at blue_bowl")
    assert then.delta_peak < 0.02
    assert story.unharmed()


def test_open_fingers_that_were_stopped_around_a_thing_get_away_from_it():
    story = Stopped(around)
    assert story.outcome.kind == "stopped"
    assert story.layer.loop.controller.holding is None
    told, permit = [], story.layer.loop.safety.permit
    story.layer.loop.safety.permit = lambda contacts: (
        told.append({(contact.robot_part, contact.obstacle) for contact in contacts}) or permit(contacts)
    )
    then = story.run("home", {"speed": 0.3})
    assert ("fingers", "red_cube") in told[0], "the next contract has what is still needed"
    assert ("fingers", "red_cube") not in told[-1], "until it is clear"
    assert (then.kind, then.reason) == ("succeeded", "at home")
    assert then.delta_peak < 0.02
    assert story.unharmed()


def seen(gap, part="fingers"):
    """A cube beside the part of an arm at home, `gap` [m] from its nearest ball."""
    safety = SafetyFilter(BODY)
    state = home_state(BODY)
    centres, radii, groups = safety.spheres(state.q, state.opening)
    balls = [k for k, group in enumerate(groups) if group == part]
    low = min(balls, key=lambda k: centres[k, 2] - radii[k])
    x, y, z = centres[low]
    cube = SceneObject(
        name="cube", role="object", shape=Box((0.02, 0.02, 0.02)), pose=Pose((x, y, z - radii[low] - gap - 0.02))
    )
    return safety, state, Scene(robot="panda", stamp=0.0, version=1, objects=(cube,))


FINGERS, LOAD = PermittedContact("fingers", "cube", 0.05), PermittedContact("held", "table", 0.05)


@pytest.mark.parametrize("gap", [-0.01, 0.0, 0.8 * CLEARANCE, 1.2 * CLEARANCE, 0.1])
def test_contacts_stay_until_they_are_clear(gap):
    safety, state, scene = seen(gap)
    left = ResidualContacts(safety)
    left.retain("descend", (FINGERS, LOAD), state, scene)
    assert (left.touches == (FINGERS, LOAD)) == (gap < CLEARANCE)
    assert left.closing_target == ""
    if gap >= CLEARANCE:
        assert left.touches == ()


def test_what_is_not_seen_is_not_known_to_be_clear():
    safety, state, scene = seen(0.0)
    left = ResidualContacts(safety)
    left.retain("close", (FINGERS,), state, scene)
    assert left.closing_target == "cube"
    assert not left.update(state, Scene(robot="panda", stamp=0.1, version=2, objects=()))
    assert left.object_names == {"cube"}
    _, _, away = seen(0.1)
    assert left.update(state, away)
    assert (left.touches, left.closing_target) == ((), "")


def test_a_pair_is_permitted_once():
    safety, state, scene = seen(0.0)
    left = ResidualContacts(safety)
    left.retain("close", (FINGERS,), state, scene)
    wanted = (PermittedContact("fingers", "cube", 0.02), PermittedContact("hand", "cube", 0.02))
    assert left.combine(wanted) == wanted
    assert left.combine(()) == (FINGERS,)
