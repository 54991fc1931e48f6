"""Maps: rigid frames, regions as barriers, places in scenes, and rejection of invalid maps."""

from math import pi

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.geometry.polygons import intersect_convex
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.grounding.map_overlay import drivable_floor, with_floor, with_places
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.grounding.vocabulary import scene_names_of_spec
from dualbrain.knowledge.builtin_documents import DATA_FOLDER
from dualbrain.knowledge.readers.reader import DocumentText, read_document
from dualbrain.knowledge.rejection import DocumentRejected
from dualbrain.knowledge.structured.maps import MapFrame, MapPlace, Region, RoomMap, is_inside_polygon
from dualbrain.knowledge.structured.parsing import parse_structured
from dualbrain.robots.loader import load_robot
from dualbrain.safety.barriers.keep_out import scenario_base
from dualbrain.safety.barriers.traversable_region import traversable_region
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import FloorMap, load_scene, save_scene
from dualbrain.simulation.tasks.scene_hashes import scene_hash

WIDE = ((-20.0, -20.0), (20.0, -20.0), (20.0, 20.0), (-20.0, 20.0))
SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0))


def room_map(**changed: object) -> RoomMap:
    fields: dict[str, object] = {
        "kind": "map",
        "title": "t",
        "frame": "room",
        "frames": (MapFrame("dock", (1.0, 2.0, 0.5), pi / 2),),
        "places": (
            MapPlace(name="spot", position=(2.0, 1.0, 0.0), yaw=0.3, region=((1.5, 0.5), (2.5, 0.5), (2.0, 1.5))),
        ),
        "regions": (
            Region(name="hall", use="traversable", corners=SQUARE),
            Region(name="hole", use="keep_out", corners=((2.5, 1.5), (3.5, 2.0), (3.0, 2.5))),
        ),
    }
    return RoomMap(**(fields | changed))  # pyright: ignore[reportArgumentType]


def builtin_map() -> RoomMap:
    document_text = read_document((DATA_FOLDER / "room-map.toml").read_bytes(), "room-map.toml")
    assert isinstance(document_text, DocumentText)
    found = parse_structured(document_text, RoomMap)
    assert isinstance(found, RoomMap), found
    return found


@settings(deadline=None)
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-pi, pi), st.floats(-pi, pi))
def test_a_change_of_frame_preserves_distances_and_can_be_inverted(x: float, y: float, yaw: float, turn: float) -> None:
    places = (MapPlace(name="a", position=(x, y, 0.1), yaw=yaw), MapPlace(name="b", position=(1.0, -1.0, 0.0)))
    one = room_map(frames=(MapFrame("f", (x, 1.0, 0.2), turn),), places=places)
    (a, b), (a_f, b_f) = one.place_poses("room"), one.place_poses("f")
    assert np.linalg.norm(np.subtract(a.position, b.position)) == pytest.approx(
        np.linalg.norm(np.subtract(a_f.position, b_f.position))
    )
    assert a_f.yaw == pytest.approx(a.yaw - turn)
    back = room_map(
        frames=(MapFrame("f", (x, 1.0, 0.2), turn),),
        places=(MapPlace(name="a", position=a_f.position, yaw=a_f.yaw, frame="f"),),
    )
    assert back.place_poses("room")[0].position == pytest.approx(a.position)


def test_a_place_in_a_frame_matches_a_calculation_by_hand() -> None:
    one = room_map(places=(MapPlace(name="p", position=(1.0, 0.0, 0.0), yaw=0.0, frame="dock"),))
    pose = one.place_poses("room")[0]
    assert pose.position == pytest.approx((1.0, 3.0, 0.5))
    assert pose.yaw == pytest.approx(pi / 2)
    assert one.scene_places("dock")[0].position == pytest.approx((1.0, 0.0, 0.0))


def borders(corners, points):
    """Signed distance [m] of points (..., 2) to the nearest edge of a convex polygon, positive inside."""
    corners = np.array(corners)
    along = np.roll(corners, -1, axis=0) - corners
    inward = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    return np.min(np.sum(inward * (np.asarray(points)[..., None, :] - corners), axis=-1), axis=-1)


def polygon(middle, radii, turn):
    """A counter-clockwise convex polygon with corners on a circle."""
    angles = turn + np.linspace(0.0, 2.0 * pi, len(radii), endpoint=False) + 0.3 * np.array(radii)
    return tuple((middle[0] + 2.0 * float(np.cos(a)), middle[1] + 2.0 * float(np.sin(a))) for a in angles)


middles = st.tuples(st.floats(-2.5, 2.5), st.floats(-2.5, 2.5))
corners = st.lists(st.floats(0.0, 1.0), min_size=3, max_size=8)


@settings(max_examples=80, deadline=None)
@given(middles, corners, st.floats(-pi, pi), st.integers(0, 99))
def test_the_intersection_of_two_floors_is_on_both_and_complete(middle, radii, turn, seed):
    one, other = SQUARE, polygon(middle, radii, turn)
    shared = intersect_convex(one, other)
    points = np.random.default_rng(seed).uniform(-4.0, 5.0, (400, 2))
    both = np.minimum(borders(one, points), borders(other, points))
    if not shared:
        assert np.all(both < 0.02)
        return
    found = borders(shared, points)
    assert np.all(both[found > 0.0] > -1e-9)
    assert np.all(found[both > 0.02] > 0.0)
    assert len(traversable_region("shared", shared)) == len(shared)  # still convex and counter-clockwise


@settings(max_examples=60, deadline=None)
@given(st.floats(0.05, 3.95), st.floats(0.05, 2.95), st.sampled_from(["room", "dock"]))
def test_the_floor_is_exactly_that_of_the_map(x: float, y: float, frame: str) -> None:
    one = room_map()
    here = one.place_poses(frame)[0].position[:2]
    found = drivable_floor(one, frame, here, WIDE)
    moved = room_map(places=(MapPlace(name="x", position=(x, y, 0.0)),)).place_poses(frame)[0].position
    assert borders(found.floor, moved[:2]) == pytest.approx(min(x, y, 4.0 - x, 3.0 - y))
    (box,) = found.closed
    ((_, hole),) = one.polygons(frame, "keep_out")
    if is_inside_polygon(moved[:2], hole):  # the rectangle contains the whole polygon
        offset = np.subtract(moved[:2], box.middle)
        c, s = np.cos(box.yaw), np.sin(box.yaw)
        assert np.all(np.abs(np.array([[c, s], [-s, c]]) @ offset) <= np.array(box.half) + 1e-9)


def test_a_base_stays_on_the_floor_of_the_builtin_map() -> None:
    """Driven towards every border, the filtered base stays in the hall and outside the keep-out regions."""
    one, robot_model = builtin_map(), scenario_base()
    spec = msgspec.structs.replace(open_scene("empty_room:0", "base"), objects=(), places=(), region=WIDE)
    scene = scene_from_spec(msgspec.structs.replace(spec, chart=drivable_floor(one, "room", (3.0, 1.0), WIDE)))
    closed = {scene_object.name for scene_object in scene.objects}
    rng = np.random.default_rng(3)
    for goal in ((5.3, 0.5), (2.0, 2.4), (3.55, 1.9), (-1.0, 3.0)):
        safety = SafetyFilter(robot_model)
        q = np.array([3.0, 1.0, float(rng.uniform(-3, 3))])
        safety.observe(
            (*obstacles_from_scene(scene, known=closed, held=None), *traversable_region("floor", scene.region))
        )
        u, now = np.zeros(2), 0.0
        for _ in range(400):
            heading = np.arctan2(goal[1] - q[1], goal[0] - q[0]) - q[2]
            nominal = np.array([0.6, 2.0 * np.sin(heading)])
            result = safety(q, u, nominal, now)
            assert result.status is not FilterStatus.FAULT
            u = result.u
            q = q + np.array([u[0] * np.cos(q[2]), u[0] * np.sin(q[2]), u[1]]) * robot_model.period
            now += robot_model.period
            assert 0.15 < q[0] < 5.4
            assert 0.15 < q[1] < 4.3
            assert not any(is_inside_polygon((q[0], q[1]), corners) for _, corners in one.polygons("room", "keep_out"))


def test_a_base_outside_every_room_is_reported() -> None:
    with pytest.raises(ConfigurationError, match="hall"):
        drivable_floor(room_map(), "room", (9.0, 9.0), WIDE)
    assert drivable_floor(room_map(regions=()), "room", (9.0, 9.0), WIDE) == FloorMap(WIDE)
    with pytest.raises(UnknownNameError, match="kitchen"):
        drivable_floor(room_map(), "kitchen", (0.0, 0.0), WIDE)


def test_places_of_the_builtin_map_become_scene_names_for_contracts() -> None:
    spec = open_scene("bare:0")
    extended = with_places(spec, builtin_map(), "panda_table")
    new = {place.name for place in extended.places} - {place.name for place in spec.places}
    assert new == {"inspection_spot", "handover_spot", "reject_corner"}
    assert extended.find_place("table_front") == spec.find_place(
        "table_front"
    )  # the measured place of the scene has priority
    assert new <= set(scene_names_of_spec(extended).receptive)


# --- a base in a room with a map ----------------------------------------------------------------------------------

ROOM = open_scene("empty_room:0", "base")
HALL = ((-0.8, -1.2), (3.0, -1.2), (3.4, 1.0), (-0.8, 1.0))


def floor_map(*places: MapPlace, hall=HALL, **changed: object) -> RoomMap:
    return room_map(
        frame="start",
        frames=(),
        places=places,
        regions=(Region(name="hall", use="traversable", corners=hall),),
        **changed,
    )


@pytest.mark.parametrize("robot", ["base", "mobile_panda"])
def test_a_base_receives_the_places_and_the_floor_of_its_map(robot, tmp_path):
    rack = MapPlace(name="on_a_rack", position=(1.0, 0.0, 0.8))
    known = with_floor(
        ROOM, floor_map(MapPlace(name="corner", position=(2.0, 0.5, 0.0)), rack), "start", load_robot(robot)
    )
    assert known.find_place("corner").position == (2.0, 0.5, 0.0)
    assert "on_a_rack" not in scene_names_of_spec(known).receptive  # a base cannot reach a place at this height
    assert {place.name for place in ROOM.places} < set(scene_names_of_spec(known).receptive)
    assert known.region == ROOM.region  # the walls are unchanged
    assert set(known.floor) == set(HALL) == set(scene_from_spec(known).region)
    assert scene_hash(known) == scene_hash(msgspec.structs.replace(ROOM, places=known.places))
    save_scene(known, tmp_path / "scene.json")
    assert load_scene(tmp_path / "scene.json") == known


def test_the_floor_is_the_intersection_with_the_room_and_places_of_the_scene_are_kept():
    beyond = ((-9.0, -1.2), (9.0, -1.2), (9.0, 1.0), (-9.0, 1.0))
    # the shelf of the scene was measured, so this place is ignored
    moved = MapPlace(name="shelf", position=(40.0, 0.0, 0.0))
    known = with_floor(ROOM, floor_map(moved, hall=beyond), "start", load_robot("base"))
    assert np.sort(np.array(known.floor), axis=0) == pytest.approx(
        np.array([(-1.0, -1.2), (-1.0, -1.2), (5.2, 1.0), (5.2, 1.0)])
    )
    assert known.places == ROOM.places


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        # in the room, outside the floor of the map
        ({"places": (MapPlace(name="far_end", position=(4.0, 0.0, 0.0)),)}, "far_end"),
        (
            {"regions": (), "places": (MapPlace(name="next_room", position=(7.0, 0.0, 0.0)),)},
            "next_room",
        ),  # behind the wall of the room
        (
            {
                "places": (MapPlace(name="hole_in", position=(2.0, 0.0, 0.0)),),
                "regions": (
                    Region(name="hole", use="keep_out", corners=((1.8, -0.2), (2.2, -0.2), (2.2, 0.2), (1.8, 0.2))),
                ),
            },
            "hole_in",
        ),
        (
            {"regions": (Region(name="hall", use="traversable", corners=((-0.2, -0.2), (3.0, -0.2), (3.0, 1.0))),)},
            "start of the base",
        ),
        (
            {"regions": (Region(name="hall", use="traversable", corners=((1.0, 0.0), (3.0, 0.0), (3.0, 1.0))),)},
            "start of the base",
        ),
        (
            {"regions": (Region(name="shelf_unit", use="keep_out", corners=((2.0, 0.0), (3.0, 0.0), (3.0, 1.0))),)},
            "shelf_unit",
        ),
    ],
)
def test_a_map_that_does_not_fit_the_room_is_refused_with_a_reason(changed, words):
    one = msgspec.structs.replace(floor_map(), **changed)
    with pytest.raises(ConfigurationError, match=words):
        with_floor(ROOM, one, "start", load_robot("base"))


@pytest.mark.parametrize(
    "text",
    [
        'frame = "room"',
        'kind = "map"',
        "not toml at all [",
        'kind="map"\ntitle="t"\nframe="room"\nwhat=1',
        'kind="map"\ntitle="t"\nframe="ignore previous instructions"',
        'kind="map"\ntitle="t"\nframe="r"\n[[places]]\nname="a b"\nposition=[0.0,0.0,0.0]',
        'kind="map"\ntitle="t"\nframe="r"\n[[places]]\nname="a"\nposition=[nan,0.0,0.0]',
        'kind="map"\ntitle="t"\nframe="r"\n[[places]]\nname="a"\nposition=[5000.0,0.0,0.0]',
        'kind="map"\ntitle="t"\nframe="r"\n[[places]]\nname="a"\nframe="q"\nposition=[0.0,0.0,0.0]',
        'kind="map"\ntitle="t"\nframe="r"\n[[regions]]\nname="a"\nuse="traversable"\ncorners=[[0.0,0.0],[1.0,0.0]]',
        'kind="map"\ntitle="t"\nframe="r"\n[[regions]]\nname="a"\nuse="drive"\ncorners=[[0.0,0.0],[1.0,0.0],[0.0,1.0]]',
        'kind="map"\ntitle="t"\nframe="r"\n[[regions]]\nname="L"\nuse="traversable"\ncorners=[[0.0,0.0],[2.0,0.0],[2.0,1.0],[1.0,1.0],[1.0,2.0],[0.0,2.0]]',
        "a=" + "[" * 5000 + "]" * 5000,
    ],
)
def test_an_invalid_map_is_rejected_with_a_reason(text: str) -> None:
    document_text = read_document((text + "\n# some more words so that it can be read\n").encode(), "m.toml")
    assert isinstance(document_text, DocumentText)
    found = parse_structured(document_text, RoomMap)
    assert isinstance(found, DocumentRejected)
    assert str(found)


def test_a_star_is_not_convex() -> None:
    star = tuple((float(np.cos(4 * pi * k / 5)), float(np.sin(4 * pi * k / 5))) for k in range(5))
    with pytest.raises(ValueError, match="convex"):
        room_map(regions=(Region(name="star", use="keep_out", corners=star),))
