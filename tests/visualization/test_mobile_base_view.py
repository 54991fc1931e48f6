"""Live view of a mobile base: camera, floor, places and speeds; and the formatting of token counts."""

import numpy as np
import pytest

from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.visualization.html.run_report import _format_timing
from dualbrain.visualization.live.panel import commanded_speeds, numbers_html, speed_rows
from dualbrain.visualization.live.scene_view import LiveScene
from dualbrain.visualization.live.view import ARM_CAMERA, BASE_CAMERA, LiveView, find_free_port
from dualbrain.visualization.live.view_state import ViewState


class Canvas:
    """Fake of viser's scene that records meshes and labels."""

    def __init__(self):
        self.meshes, self.labels = {}, {}

    def add_mesh_simple(self, name, vertices, faces, **_):
        self.meshes[name] = np.asarray(vertices), np.asarray(faces)

    def add_label(self, name, text, **_):
        self.labels[name] = text

    def add_frame(self, *_, **__):
        return self

    add_icosphere = add_box = add_grid = add_frame


def test_the_floor_is_the_region_in_which_the_base_may_drive():
    canvas, scene = Canvas(), scene_from_spec(open_scene("1", "base"))
    LiveScene(canvas).update(ViewState(t=0.0, frames={}, scene=scene, centres=np.empty((0, 3)), radii=np.empty(0)))
    points, faces = canvas.meshes["/scene/floor"]
    assert np.allclose(points[:, :2], scene.region)
    corners = points[faces]
    areas = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    x, y = np.transpose(scene.region)
    assert np.all(areas > 0.0)
    assert areas.sum() == pytest.approx(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def test_places_are_marked_and_named():
    canvas, scene = Canvas(), scene_from_spec(open_scene("workroom:1", "mobile_panda"))
    live = LiveScene(canvas)
    for _ in range(2):
        live.update(ViewState(t=0.0, frames={}, scene=scene, centres=np.empty((0, 3)), radii=np.empty(0)))
    assert sorted(canvas.labels.values()) == ["bench", "charger", "shelf"]
    for place in scene.places:
        points, _ = canvas.meshes[f"/scene/place_{place.name}"]
        assert np.ptp(points[:, 0]) == pytest.approx(0.24)


def test_the_panel_shows_the_speeds_of_the_moving_parts():
    base, arm, both = (load_robot(name) for name in ("base", "ur5e", "mobile_panda"))
    assert [row[2] for row in speed_rows(base)] == ["m/s", "rad/s"]
    assert [row[2] for row in speed_rows(arm)] == ["rad/s"]
    assert commanded_speeds(base, np.array([0.4, -0.2])) == {"drive": 0.4, "turn": -0.2}
    assert commanded_speeds(arm, np.array([0.3, 0.4, 0, 0, 0, 0])) == {"speed": pytest.approx(0.5)}
    u = np.array([0.1, 0.2, 0.3, 0.4, *np.zeros(5)])
    numbers = commanded_speeds(both, u)
    assert numbers == {"drive": 0.1, "turn": 0.2, "speed": pytest.approx(0.5)}
    state = ViewState(t=0.0, frames={}, scene=scene_from_spec(open_scene("1", "mobile_panda")), numbers=numbers)
    shown = numbers_html(state, speed_rows(both))
    for label, text in (("driving", "0.10"), ("turning", "0.20"), ("joint speed", "0.50")):
        assert label in shown
        assert f">{text}<" in shown
    assert "joint speed" not in numbers_html(state, speed_rows(base))


def test_a_scene_with_a_table_has_no_floor():
    canvas = Canvas()
    scene = scene_from_spec(open_scene("bare:0", "panda"))
    LiveScene(canvas).update(ViewState(t=0.0, frames={}, scene=scene, centres=np.empty((0, 3)), radii=np.empty(0)))
    assert "/scene/floor" not in canvas.meshes


@pytest.mark.parametrize(("robot", "camera"), [("base", BASE_CAMERA), ("ur5e", ARM_CAMERA)])
def test_the_initial_camera_shows_the_robot(robot, camera):
    view = LiveView(load_robot(robot), find_free_port(18400, 20))
    try:
        initial = view._server.initial_camera
        assert np.allclose(initial.position, camera[0])
        assert np.allclose(initial.look_at, camera[1])
    finally:
        view.close()


def test_a_token_count_is_not_formatted_as_a_time():
    assert _format_timing("prompt_tokens", 949.0) == "949 prompt tokens"
    assert _format_timing("prefill", 1.234) == "prefill 1.23 s"
