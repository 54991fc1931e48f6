"""Live view without a browser: shapes, colours, ports, and its effect on the control loop."""

import socket
import sys
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.control.recording.trace import Trace
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, Sphere
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.records import Episode, Scene
from dualbrain.robots.loader import load_robot
from dualbrain.visualization.live.panel import final_html, lines_html, numbers_html
from dualbrain.visualization.live.robot_view import clearance_colours, simplify_mesh
from dualbrain.visualization.live.scene_view import shape_mesh
from dualbrain.visualization.live.view import HOST, LiveView, find_free_port
from tests.visualization.conftest import scene as sample_scene
from tests.visualization.sample_view_states import link_frames, view_state_at

SIZES = st.floats(0.01, 0.2)


@settings(deadline=None, max_examples=30)
@given(SIZES, SIZES, st.floats(0, 0.05))
def test_shapes_have_their_size_and_grow_by_the_margin(a: float, b: float, margin: float) -> None:
    extents = {
        Sphere(a): (a, a, a),
        Capsule(a, b): (a, a, a + b),
        Cylinder(a, b): (a, a, b),
        Box((a, b, a)): (a, b, a),
    }
    for shape, half in extents.items():
        low, high = shape_mesh(shape, margin).bounds
        assert high == pytest.approx(np.array(half) + margin, rel=5e-3)
        assert low == pytest.approx(-high, rel=5e-3)
    low, high = shape_mesh(Bowl(0.1, 0.06, 0.005), margin).bounds
    assert high == pytest.approx((0.1 + margin, 0.1 + margin, 0.06 + margin), rel=5e-3)
    assert low[2] == pytest.approx(-margin, abs=1e-9)


def test_colours_range_from_contact_to_free() -> None:
    red, amber, blue, far = clearance_colours(np.array([-0.01, 0.01, 0.08, np.inf])).astype(int)
    assert red[0] > 2 * red[1] > red[2]
    assert amber[0] > amber[1] > amber[2]
    assert blue.tolist() == far.tolist()
    assert blue[2] > blue[0]


def test_simplifying_a_mesh_keeps_its_shape() -> None:
    sphere = shape_mesh(Sphere(0.1))
    points, faces = simplify_mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces), cell=0.03)
    assert len(faces) < len(sphere.faces) / 3
    assert np.abs(np.linalg.norm(points, axis=1) - 0.1).max() < 0.01
    assert faces.max() < len(points)


def test_the_kinematics_of_the_tests_are_correct() -> None:
    robot_model = load_robot("panda")
    tip = link_frames(robot_model, np.array(robot_model.home), 0.04)["hand"] @ np.array(
        [*robot_model.tool.translation, 1.0]
    )
    assert tip[2] == pytest.approx(0.4, abs=0.3)
    stretched = link_frames(robot_model, np.zeros(7), 0.0)["link7"]
    assert stretched[:3, 3] == pytest.approx((0.088, 0.0, 0.333 + 0.316 + 0.384), abs=1e-9)


def test_untrusted_lines_are_escaped(episode: Episode) -> None:
    assert "<img" not in lines_html(("<img src=x onerror=alert(1)>",))
    assert repr(episode.outcome.h_min) in final_html(episode)


def test_a_port_in_use_is_reported() -> None:
    with socket.socket() as occupied:
        occupied.bind((HOST, 0))
        occupied.listen()
        port = occupied.getsockname()[1]
        assert find_free_port(port, 20) > port
        with pytest.raises(ConfigurationError, match="--port"):
            find_free_port(port, 1)
        with pytest.raises(ConfigurationError, match=str(port)):
            LiveView(load_robot("panda"), port, allow_other_port=False)


def test_without_viser_the_error_states_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingDependencyError, match="headless"):
        LiveView(load_robot("panda"), 18080)


def test_showing_a_state_does_not_block(trace: Trace, episode: Episode, capsys: pytest.CaptureFixture[str]) -> None:
    robot_model = load_robot("panda")
    perceived: Scene = sample_scene()
    view = LiveView(robot_model, 18090)
    try:
        states = [view_state_at(robot_model, trace, perceived, k) for k in (0, 9000, 10600)]
        start = time.perf_counter()
        for _ in range(2000):
            for state in states:
                view.show(state)
        assert (time.perf_counter() - start) / 6000 < 50e-6
        assert "carry" in numbers_html(states[-1])
        start = time.perf_counter()
        view.finish(episode, timeout=20.0)
        assert time.perf_counter() - start < 20.0
        with socket.socket() as other, pytest.raises(OSError, match="in use"):
            other.bind((HOST, view.port))
    finally:
        view.close()
        view.close()
    view.show(states[0])
    assert capsys.readouterr().out == ""
