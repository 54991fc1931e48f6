"""A base in a room with a map: it goes where only the map knows a place, and never leaves the map's floor."""

import msgspec
import numpy as np
import pytest

from dualbrain.grounding.map_overlay import with_floor
from dualbrain.knowledge.structured.maps import MapPlace, Region, RoomMap
from dualbrain.records import Place
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.mobile_base import controller
from tests.simulation.mobile_base_cell import MOBILE_BASE, MobileBaseCell, drive_to_action

HALL = ((-0.7, -1.4), (2.6, -1.4), (3.2, 0.9), (-0.7, 0.9))
CABLES = ((1.0, -0.3), (1.4, -0.3), (1.4, 0.4), (1.0, 0.4))
SPOT = (2.3, 0.0)
ROOM = msgspec.structs.replace(open_scene("empty_room:0", "base"), objects=(), places=())


def known(*regions):
    spot = MapPlace("waiting_spot", (*SPOT, 0.0))
    chart = RoomMap("map", "a hall", "start", places=(spot,), regions=(Region("hall", "traversable", HALL), *regions))
    return with_floor(ROOM, chart, "start", MOBILE_BASE)


class Surveyed(MobileBaseCell):
    """A hall in which the truth of every tick is written down: how far inside the map's floor the footprint is [m]."""

    def __init__(self, spec):
        super().__init__(spec=spec)
        corners = np.array(HALL)
        along = np.roll(corners, -1, axis=0) - corners
        self.corners, self.inward = corners, np.column_stack([-along[:, 1], along[:, 0]])
        self.inward /= np.linalg.norm(along, axis=1)[:, None]
        self.air, self.discs = [], []
        advance = self.world.advance

        def watched():
            advance()
            self.look()

        self.world.advance = watched

    def look(self):
        """The four discs of the footprint against the four edges, by hand."""
        x, y, theta = self.plant.read().q
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        discs = np.array([ball.centre[:2] for ball in MOBILE_BASE.spheres]) @ turn.T + (x, y)
        apart = np.einsum("ek,dek->de", self.inward, discs[:, None] - self.corners)
        self.air.append(float(np.min(apart - np.array([[ball.radius] for ball in MOBILE_BASE.spheres]))))
        self.discs.append(discs)


def test_a_base_drives_to_a_place_that_only_the_map_knows_round_what_the_map_closes():
    hall = Surveyed(known(Region("cables", "keep_out", CABLES)))
    outcome = hall.run(drive_to_action("waiting_spot"))
    assert outcome.kind == "succeeded", outcome
    assert hall.world.judgement().success
    assert np.linalg.norm(hall.plant.ground_position() - SPOT) < 0.2
    assert min(hall.air) > 0.0
    (low_x, low_y), (high_x, high_y) = CABLES[0], CABLES[2]
    for discs in hall.discs:
        out = np.maximum(np.maximum((low_x, low_y) - discs, discs - (high_x, high_y)), 0.0)
        assert np.all(np.linalg.norm(out, axis=1) > [ball.radius for ball in MOBILE_BASE.spheres])
    assert hall.monitor.violations() == ()


@pytest.mark.parametrize("beyond", [(4.2, 0.0), (1.0, -2.0), (3.4, 1.6)])
def test_a_base_that_is_driven_at_the_border_of_its_map_stays_inside(beyond, monkeypatch):
    """φ is made to forget the map: straight at a place on the other side, through a border that is no wall."""

    def straight(scene, start, end, radius):
        yield
        return [start, end]

    monkeypatch.setattr(controller, "floor_path", straight)
    spec = known()
    there = msgspec.structs.replace(spec, places=(*spec.places, Place("beyond", (*beyond, 0.0))))
    hall = Surveyed(there)
    assert hall.run(drive_to_action("beyond")).kind == "taken_over"
    assert min(hall.air) > 0.0
    assert min(hall.air) < 0.1  # it came to the border

    free = Surveyed(msgspec.structs.replace(there, chart=None))
    assert free.run(drive_to_action("beyond")).kind == "succeeded"
    assert min(free.air) < -0.3  # nothing but the map held it back
