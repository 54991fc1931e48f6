"""Robot viewer in the browser: spheres over meshes, a slider for each joint, distance of the nearest pair of links."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import matrix_to_quaternion
from dualbrain.core.untrusted.visible_text import visible_text
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.self_collision import chain_frames, link_clearance, sphere_centres
from dualbrain.robots.model import RobotModel
from dualbrain.visualization.html.page import element
from dualbrain.visualization.live.robot_view import simplify_mesh
from dualbrain.visualization.live.view import HOST, MAX_PORTS_TRIED, find_free_port, start_server
from dualbrain.visualization.robot.image import GROUP_COLOURS, home_posture

Array = NDArray[np.float64]


class RobotViewer:
    """A running viewer at `url` on the loopback address of this machine; it controls no robot."""

    def __init__(self, robot_model: RobotModel, meshes: Mapping[str, Mesh], port: int = 8081) -> None:
        """Serve on `port` or the next free port; `meshes` are in the frames of the links.

        Raises:
            MissingDependencyError: viser is not installed.
            ConfigurationError: no port is free.
        """
        self.port = find_free_port(port, MAX_PORTS_TRIED)
        self.url = f"http://{HOST}:{self.port}"
        self._robot_model = robot_model
        self._server = start_server(self.port)
        self._links = {
            link.name: self._server.scene.add_frame(f"/robot/{link.name}", show_axes=False)
            for link in robot_model.links
        }
        self._spheres = [self._add_sphere(k) for k in range(len(robot_model.spheres))]
        self._meshes = [self._add_mesh(name, mesh) for name, mesh in meshes.items() if name in self._links]
        self._q = home_posture(robot_model)[0].copy()
        self._add_controls()
        self.show_posture(self._q)

    def show_posture(self, q: Array) -> str:
        """Show the posture q (n,); returns the text about the nearest pair that the page shows."""
        self._q = np.asarray(q, float)
        turns, origins = chain_frames(self._robot_model.joints, self._q[None])
        for link in self._robot_model.links:
            handle = self._links[link.name]
            handle.position = tuple(sphere_centres(link, np.zeros((1, 3)), turns, origins, 0.0)[0, 0])
            columns = sphere_centres(link, np.eye(3), turns, origins, 0.0)[0] - np.asarray(handle.position)
            handle.wxyz = matrix_to_quaternion(columns.T)
        self._nearest_text = describe_nearest_pair(self._robot_model, turns, origins)
        self._nearest_label.content = element("p", self._nearest_text)
        return self._nearest_text

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()

    def _add_sphere(self, k: int) -> Any:
        sphere = self._robot_model.spheres[k]
        group = next(link.group for link in self._robot_model.links if link.name == sphere.link)
        red, green, blue = (int(GROUP_COLOURS.get(group, "#4878a8")[i : i + 2], 16) for i in (1, 3, 5))
        return self._server.scene.add_icosphere(
            f"/robot/{sphere.link}/sphere{k}",
            sphere.radius,
            color=(red, green, blue),
            subdivisions=2,
            position=sphere.centre,
            opacity=0.4,
        )

    def _add_mesh(self, name: str, mesh: Mesh) -> Any:
        points, faces = simplify_mesh(mesh.vertices, mesh.faces)
        return self._server.scene.add_mesh_simple(
            f"/robot/{name}/shape", points, faces, color=(205, 208, 212), side="double"
        )

    def _add_controls(self) -> None:
        gui = self._server.gui
        gui.add_html(element("p", element("b", self._robot_model.name), f": {len(self._robot_model.spheres)} spheres"))
        self._nearest_label = gui.add_html("")
        for label, handles in (("spheres", self._spheres), ("meshes", self._meshes)):
            box = gui.add_checkbox(label, initial_value=True)
            box.on_update(lambda event, handles=handles: _set_visible(handles, event.target.value))
        for i, joint in enumerate(self._robot_model.joints if self._robot_model.base == "fixed" else ()):
            low, high = max(joint.lower.value, -2 * np.pi), min(joint.upper.value, 2 * np.pi)
            slider = gui.add_slider(
                visible_text(joint.name), low, high, (high - low) / 200, float(np.clip(self._q[i], low, high))
            )
            slider.on_update(lambda event, i=i: self._set_joint(i, float(event.target.value)))

    def _set_joint(self, i: int, value: float) -> None:
        q = self._q.copy()
        q[i] = value
        self.show_posture(q)


def _set_visible(handles: list[Any], wanted: bool) -> None:
    for handle in handles:
        handle.visible = wanted


def describe_nearest_pair(robot_model: RobotModel, turns: Array, origins: Array) -> str:
    """Text about the checked pair of links with the smallest distance, for link frames `turns` and `origins`."""
    by_name = {link.name: link for link in robot_model.links}
    best = ("", "", np.inf)
    for a, b in robot_model.self_pairs.kept:
        placed = [_link_spheres(robot_model, by_name[name], turns, origins) for name in (a, b)]
        gap = float(link_clearance(placed[0][0], placed[1][0], placed[0][1], placed[1][1])[0])
        best = min(best, (a, b, gap), key=lambda pair: pair[2])
    return (
        "no pair of links is checked"
        if best[2] == np.inf
        else f"nearest links: {best[0]}–{best[1]}, {best[2] * 1e3:.0f} mm"
    )


def _link_spheres(robot_model: RobotModel, link: Any, turns: Array, origins: Array) -> tuple[Array, Array]:
    own = [sphere for sphere in robot_model.spheres if sphere.link == link.name]
    centres = np.array([sphere.centre for sphere in own]).reshape(-1, 3)
    return sphere_centres(link, centres, turns, origins, 0.0), np.array([sphere.radius for sphere in own])
