"""A mobile base with a map: it drives to places of the map, and never leaves the floor of the map."""

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


def room_with_map(*regions):
    spot = MapPlace(name="waiting_spot", position=(*SPOT, 0.0))
    chart = RoomMap(
        kind="map",
        title="a hall",
        frame="start",
        places=(spot,),
        regions=(Region(name="hall", use="traversable", corners=HALL), *regions),
    )
    return with_floor(ROOM, chart, "start", MOBILE_BASE)


class MonitoredCell(MobileBaseCell):
    """A cell that records in every control period how far the footprint is inside the floor of the map [m]."""

    def __init__(self, spec):
        super().__init__(spec=spec)
        corners = np.array(HALL)
        along = np.roll(corners, -1, axis=0) - corners
        self.corners, self.inward = corners, np.column_stack([-along[:, 1], along[:, 0]])
        self.inward /= np.linalg.norm(along, axis=1)[:, None]
        self.distances, self.discs = [], []
        advance = self.world.advance

        def advance_and_record():
            advance()
            self.record()

        self.world.advance = advance_and_record

    def record(self):
        """Record the discs of the footprint and their least distance to the four edges."""
        x, y, theta = self.plant.read().q
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        discs = np.array([sphere.centre[:2] for sphere in MOBILE_BASE.spheres]) @ turn.T + (x, y)
        apart = np.einsum("ek,dek->de", self.inward, discs[:, None] - self.corners)
        self.distances.append(float(np.min(apart - np.array([[sphere.radius] for sphere in MOBILE_BASE.spheres]))))
        self.discs.append(discs)


def test_a_base_drives_around_a_keep_out_area_to_a_place_of_the_map():
    cell = MonitoredCell(room_with_map(Region(name="cables", use="keep_out", corners=CABLES)))
    outcome = cell.run(drive_to_action("waiting_spot"))
    assert outcome.kind == "succeeded", outcome
    assert cell.world.judgement().success
    assert np.linalg.norm(cell.plant.ground_position() - SPOT) < 0.2
    assert min(cell.distances) > 0.0
    (low_x, low_y), (high_x, high_y) = CABLES[0], CABLES[2]
    for discs in cell.discs:
        out = np.maximum(np.maximum((low_x, low_y) - discs, discs - (high_x, high_y)), 0.0)
        assert np.all(np.linalg.norm(out, axis=1) > [sphere.radius for sphere in MOBILE_BASE.spheres])
    assert cell.monitor.violations() == ()


@pytest.mark.parametrize("beyond", [(4.2, 0.0), (1.0, -2.0), (3.4, 1.6)])
def test_the_filter_keeps_a_base_inside_the_floor_of_its_map(beyond, monkeypatch):
    """The path planner is replaced by a straight line to a place beyond a border of the map that is not a wall."""

    def straight(scene, start, end, radius):
        yield
        return [start, end]

    monkeypatch.setattr(controller, "plan_path", straight)
    spec = room_with_map()
    target = msgspec.structs.replace(spec, places=(*spec.places, Place("beyond", (*beyond, 0.0))))
    cell = MonitoredCell(target)
    assert cell.run(drive_to_action("beyond")).kind == "taken_over"
    assert min(cell.distances) > 0.0
    assert min(cell.distances) < 0.1  # the base reached the border

    free = MonitoredCell(msgspec.structs.replace(target, chart=None))
    assert free.run(drive_to_action("beyond")).kind == "succeeded"
    assert min(free.distances) < -0.3  # negative control: without the map the base crosses the border
