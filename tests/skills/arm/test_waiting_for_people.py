"""Waiting for a person who rests over the place: long enough for people, not for ever, and without motion."""

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.records import FailureCause, Scene, SceneObject
from dualbrain.skills.arm.controller import PERSON_WAIT_TIMEOUT
from dualbrain.skills.arm.waypoints import wait_for_people
from dualbrain.skills.skill import Observation
from tests.skills.arm.test_blocked_waypoints import TABLE, KinematicCell

ALONG_X = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)


class CellWithPerson(KinematicCell):
    """An arm above a place over which a forearm rests until `person_until` [s], then is far away."""

    def __init__(self, person_until):
        self.person_until = person_until
        super().__init__()

    def observe(self):
        tool = self.safety.tool(self.state.q)
        self.spot = tool.position.copy() if self.now == 0.0 else self.spot
        y = float(self.spot[1]) + (0.0 if self.now < self.person_until else 0.8)
        forearm = SceneObject(
            name="forearm", role="person", shape=Capsule(0.045, 0.25), pose=Pose((float(self.spot[0]), y, 0.1), ALONG_X)
        )
        scene = Scene(robot="panda", stamp=self.now, version=1, objects=(TABLE, forearm))
        observation = Observation(state=self.state, scene=scene, now=self.now, tool=tool, paused_time=self.paused)
        self.controller.observe(observation)
        self.path.append(tool.position.copy())

    def wait(self):
        here = self.controller.current_goal()
        return self.carry_out(wait_for_people(self.controller, here, self.spot, 2.0, "carry", 0.2), limit=60.0)


@pytest.mark.parametrize("rest", [5.0, 35.0])
def test_a_person_who_rests_over_the_place_is_waited_for(rest):
    cell = CellWithPerson(rest)
    assert cell.wait() is None
    assert rest <= cell.now < rest + 0.5
    assert np.abs(np.array(cell.path) - cell.path[0]).max() < 1e-3


def test_the_wait_for_a_person_who_stays_ends():
    cell = CellWithPerson(np.inf)
    result = cell.wait()
    assert result.cause is FailureCause.PERSON
    assert result.reason == f"carry: a person stayed over the place for {PERSON_WAIT_TIMEOUT:.0f} s"
    assert PERSON_WAIT_TIMEOUT <= cell.now < PERSON_WAIT_TIMEOUT + 0.5
