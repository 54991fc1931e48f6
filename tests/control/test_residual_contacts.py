"""A hand that is stopped at an object: the grasp is completed, or the hand may leave the object without a conflict."""

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.control_loop import LoopInputs
from dualbrain.control.residual_contacts import INTACT_CLEARANCE, ResidualContacts
from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.assembly import SimulatedCell
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Contact, obstacle_from_checked_object
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.arm.load_monitor import DETECTION_TIME
from dualbrain.skills.kinematics.object_geometry import CLEARANCE
from dualbrain.skills.skill import PermittedContact

MODEL = load_robot("panda")
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


class InterruptedGrasp:
    """A grasp during which the commander is lost for 0.1 s, as soon as `is_due(executor)`."""

    def __init__(self, is_due):
        spec = open_scene("bare:0")
        self.plant, self.until, self.is_due = Plant(spec, MODEL), None, is_due
        self.world = SimulatedWorld(self.plant, NoisyPerception(spec, PerceptionNoise(), np.random.default_rng([0, 1])))
        inputs = LoopInputs(external_conditions=self.conditions, clock=lambda: self.plant.now)
        cell = SimulatedCell(MODEL, self.world, inputs=inputs)
        self.executor, self.loop = cell.executor, cell.loop
        self.outcome = self.run("grasp", GRASP)

    def conditions(self):
        if self.until is None and self.is_due(self.executor):
            self.until = self.plant.now + 0.1
        return int(Condition.LINK_LOST) if self.until is not None and self.plant.now < self.until else 0

    def run(self, skill, params):
        return self.executor.execute(Contract("c-1", Context("panda", ""), (Action(skill, params),)))

    def has_no_violations(self):
        return self.world.judgement().violations == ()


def phase(executor):
    return executor.log.trace.events[-1].text if executor.log.trace.events else ""


def fingers_are_closing(executor):
    """The fingers have begun to close, and touch nothing yet."""
    return phase(executor) == "grasp: close" and executor.state.opening < 0.037


def fingers_are_around_the_cube(executor):
    """The hand is in the last centimetre of its descent, with the open fingers around the cube."""
    cube = executor.scene.find("red_cube").pose.position
    tool = executor.loop.controller.observation.tool
    return phase(executor) == "grasp: descend" and tool.position[2] < cube[2] + 0.018


def test_an_object_on_which_the_fingers_were_stopped_is_held_and_can_be_put_down():
    grasp = InterruptedGrasp(fingers_are_closing)
    assert grasp.outcome.kind == "stopped"
    assert grasp.loop.controller.holding is not None, "it is between the fingers, and they press on it"
    assert grasp.loop.controller.holding.name == "red_cube"
    outcome = grasp.run("place", PLACE)
    assert (outcome.kind, outcome.reason) == ("succeeded", "red_cube is at blue_bowl")
    assert outcome.delta_peak < 0.02
    assert grasp.has_no_violations()


def micro_lift_begins(executor):
    """The fingers press on the cube, and it is not known yet whether it rises with them."""
    return phase(executor) == "grasp: lift"


def test_an_object_on_which_the_lift_was_stopped_is_monitored_until_it_is_lost():
    grasp = InterruptedGrasp(micro_lift_begins)
    assert grasp.outcome.kind == "stopped"
    assert grasp.executor.held_object == "red_cube"
    grasp.plant.data.qpos[grasp.plant.model.joint("red_cube").qposadr[0]] += 0.15  # removed sideways
    grasp.executor.hold(DETECTION_TIME)
    assert grasp.executor.held_object is None
    assert "red_cube" in [one.name for one in grasp.loop.safety.tables.obstacles]


def test_open_fingers_that_were_stopped_around_an_object_can_leave_it():
    grasp = InterruptedGrasp(fingers_are_around_the_cube)
    assert grasp.outcome.kind == "stopped"
    assert grasp.loop.controller.holding is None
    permits, permit = [], grasp.loop.safety.permit
    grasp.loop.safety.permit = lambda contacts: (
        permits.append({(contact.robot_part, contact.obstacle) for contact in contacts}) or permit(contacts)
    )
    outcome = grasp.run("home", {"speed": 0.3})
    assert ("fingers", "red_cube") in permits[0], "the next contract keeps the residual contact"
    assert ("fingers", "red_cube") not in permits[-1], "until it is clear"
    assert (outcome.kind, outcome.reason) == ("succeeded", "at home")
    assert outcome.delta_peak < 0.02
    assert grasp.has_no_violations()


def cube_near(gap, part="fingers"):
    """The filter, an arm at home, and a cube at `gap` [m] from the lowest sphere of one of its parts."""
    safety = SafetyFilter(MODEL)
    state = home_state(MODEL)
    centres, radii, groups = safety.spheres(state.q, state.opening)
    spheres = [k for k, group in enumerate(groups) if group == part]
    low = min(spheres, key=lambda k: centres[k, 2] - radii[k])
    x, y, z = centres[low]
    cube = SceneObject(
        name="cube", role="object", shape=Box((0.02, 0.02, 0.02)), pose=Pose((x, y, z - radii[low] - gap - 0.02))
    )
    return safety, state, Scene(robot="panda", stamp=0.0, version=1, objects=(cube,))


FINGERS, LOAD = PermittedContact("fingers", "cube", 0.05), PermittedContact("held", "table", 0.05)
ENDING = PermittedContact("fingers", "cube", 0.0)
"""FINGERS after the end of its phase: the pair may not approach."""


@pytest.mark.parametrize("gap", [-0.01, 0.0, 0.8 * CLEARANCE, 1.2 * CLEARANCE, 0.1])
def test_contacts_remain_until_they_are_clear(gap):
    safety, state, scene = cube_near(gap)
    residual = ResidualContacts(safety)
    residual.retain("descend", (FINGERS, LOAD), state, scene, 0.0)
    assert (residual.contacts == (FINGERS, LOAD)) == (gap < CLEARANCE)
    assert residual.closing_target == ""
    if gap >= CLEARANCE:
        assert residual.contacts == ()


def test_a_contact_with_an_object_that_is_not_perceived_remains():
    safety, state, scene = cube_near(0.0)
    residual = ResidualContacts(safety)
    residual.retain("close", (FINGERS,), state, scene, 0.0)
    assert residual.closing_target == "cube"
    assert not residual.update(state, Scene(robot="panda", stamp=0.1, version=2, objects=()), 0.1)
    assert residual.object_names == {"cube"}
    _, _, away = cube_near(0.1)
    assert residual.update(state, away, 0.0)
    assert (residual.contacts, residual.closing_target) == ((), "")


def test_a_pair_is_permitted_once():
    safety, state, scene = cube_near(0.0)
    residual = ResidualContacts(safety)
    residual.retain("close", (FINGERS,), state, scene, 0.0)
    wanted = (PermittedContact("fingers", "cube", 0.02), PermittedContact("hand", "cube", 0.02))
    assert residual.combine(wanted) == wanted
    assert residual.combine(()) == (FINGERS,)


@pytest.mark.parametrize(
    ("gap", "stays"), [(-0.01, True), (0.8 * INTACT_CLEARANCE, True), (1.2 * INTACT_CLEARANCE, False)]
)
def test_a_permit_that_ends_with_its_phase_remains_until_the_margin_is_intact(gap, stays):
    safety, state, scene = cube_near(gap)
    residual = ResidualContacts(safety)
    residual.keep_until_intact((FINGERS,), state, scene, 0.0, held=None)
    assert (residual.contacts == (ENDING,)) == stays
    if stays:
        _, _, away = cube_near(1.2 * INTACT_CLEARANCE)
        assert residual.update(state, away, 0.0)
    assert residual.contacts == ()


def test_a_permit_for_the_held_object_ends_with_its_phase():
    safety, state, scene = cube_near(0.0)
    residual = ResidualContacts(safety)
    residual.keep_until_intact((FINGERS,), state, scene, 0.0, held="cube")
    assert residual.contacts == ()


def test_a_stop_keeps_a_permit_that_was_ending_until_the_pair_is_clear():
    safety, state, scene = cube_near(0.0)
    residual = ResidualContacts(safety)
    residual.keep_until_intact((FINGERS,), state, scene, 0.0, held=None)
    residual.retain("descend", residual.combine(()), state, scene, 0.0)
    _, _, near = cube_near(0.8 * CLEARANCE)
    assert not residual.update(state, near, 0.0)
    assert residual.contacts == (ENDING,)


def test_a_permit_remains_while_the_estimate_in_force_or_the_load_is_not_intact():
    safety, state, scene = cube_near(2.0 * INTACT_CLEARANCE)
    (cube,) = scene.objects
    safety.observe([obstacle_from_checked_object(cube, 0.0, known=True, clearance=1.5 * INTACT_CLEARANCE)])
    residual = ResidualContacts(safety)
    residual.keep_until_intact((FINGERS,), state, scene, 0.0, held=None)
    assert residual.contacts == (ENDING,), "the filter has another estimate in force"
    safety.observe([obstacle_from_checked_object(cube, 0.0, known=True)])
    residual.update(state, scene, 0.0)
    assert residual.contacts == ()
    x, y, z = safety.tool(state.q).position.tolist()
    held = PermittedContact("held", "cube", 0.05)
    low = Pose((x, y, z - 0.02 - 0.02 - 1.5 * INTACT_CLEARANCE))
    cube = msgspec.structs.replace(cube, pose=low)
    scene = msgspec.structs.replace(scene, objects=(cube,))
    for error, stays in ((0.0, False), (0.009, True)):
        safety.attach([[0.0, 0.0, 0.0, 0.02]], error)
        residual = ResidualContacts(safety)
        residual.keep_until_intact((held,), state, scene, 0.0, held=None)
        assert (residual.contacts != ()) == stays, "the error of the load counts"


def test_the_end_of_a_permit_neither_makes_the_margin_short_nor_lets_the_pair_approach():
    """A low lift: the margin of the load over the table is short by millimetres when the load is carried on."""
    safety, state, scene = cube_near(-0.003, part="hand")
    (cube,) = scene.objects
    safety.observe([obstacle_from_checked_object(cube, 0.0, known=True)])
    residual = ResidualContacts(safety)
    residual.keep_until_intact((PermittedContact("hand", "cube", 0.05),), state, scene, 0.0, held=None)
    safety.permit([Contact(one.robot_part, one.obstacle, one.speed) for one in residual.combine(())])
    down = np.linalg.lstsq(safety.tool(state.q).jacobian[:3], np.array([0.0, 0.0, -0.1]), rcond=None)[0]
    result = None
    for k in range(300):
        result = safety(state.q, state.v, down, 0.001 * k, state.opening)
        assert result.h_min >= 0.0, "the pair is permitted"
    assert (safety.tool(state.q).jacobian @ result.u)[2] > -1e-3


def test_the_margin_of_an_obstacle_that_is_being_introduced_is_judged_at_its_age():
    """The margin in force grows at 2 cm/s from the stamp of the observation."""
    safety, state, scene = cube_near(1.5 * INTACT_CLEARANCE)
    (cube,) = scene.objects
    growing = msgspec.structs.replace(obstacle_from_checked_object(cube, 0.0, known=True), velocity_error=0.02)
    safety.observe([growing], 0.0)
    for now, stays in ((0.0, False), (0.05, True)):
        residual = ResidualContacts(safety)
        residual.keep_until_intact((FINGERS,), state, scene, now, held=None)
        assert (residual.contacts != ()) == stays
