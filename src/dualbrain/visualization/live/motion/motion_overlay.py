"""Scene nodes that show the work of the filter: velocities, unfiltered motion, nearest pair, path of the plan."""

from __future__ import annotations

from math import dist, hypot
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Pose, Vector
from dualbrain.core.untrusted.visible_text import visible_text
from dualbrain.robots.model import RobotModel
from dualbrain.visualization.html.page import element
from dualbrain.visualization.live.motion.frame_pose import FramePose
from dualbrain.visualization.live.motion.link_frames import LinkFrames
from dualbrain.visualization.live.panel import panel_block
from dualbrain.visualization.live.robot_view import LinkMeshes, simplify_mesh
from dualbrain.visualization.live.view_state import PlanStep, ViewState

if TYPE_CHECKING:
    from viser import SceneApi, SceneNodeHandle

Colour = tuple[int, int, int]

NOMINAL_COLOUR: Colour = (230, 120, 20)
FILTERED_COLOUR: Colour = (20, 110, 200)
PAIR_COLOUR: Colour = (200, 20, 60)
PATH_COLOUR: Colour = (10, 127, 95)
GHOST_COLOUR: Colour = (230, 120, 20)
ARROW_SECONDS, MIN_ARROW_SPEED, MIN_ARROW_CHANGE = 0.8, 0.01, 0.002
"""Length of an arrow: the way of the tool in this time [s]; speed [m/s] below which no arrow is drawn, and the smallest
change of a velocity [m/s] that is drawn."""
GHOST_CELL_M, GHOST_OPACITY = 0.02, 0.35
"""Size [m] of the surface details of the translucent arm, and its opacity."""
PATH_HEIGHT_M = 0.15
"""Height [m] of the path of the plan between two steps, above them."""
LEGEND: tuple[tuple[str, str, str], ...] = (
    ("arrow", "#e67814", "velocity that the plan wants at the tool"),
    ("arrow", "#146ec8", "velocity after the safety filter"),
    ("ghost", "#e67814", "arm in half a second without the filter"),
    ("line", "#c8143c", "nearest pair of robot and object"),
    ("part", "#d2521e", "part of the robot that limits the motion"),
    ("halo", "#f0a03c", "safety margin: the filter keeps the robot out of it"),
    ("line", "#0a7f5f", "steps of the contract"),
)
"""Form, colour and meaning of every drawn sign."""


def legend_html() -> str:
    """The meaning of the drawn signs, as HTML."""
    rows = (
        element("li", element("span", "", class_=f"sign {form}", style=f"color: {colour}"), element("span", words))
        for form, colour, words in LEGEND
    )
    return panel_block(element("ul", *rows, class_="legend", id="legend"))


class MotionOverlay:
    """Scene nodes over robot and objects; a node without a value in a state is hidden."""

    def __init__(self, scene: SceneApi, robot_model: RobotModel, link_meshes: LinkMeshes) -> None:
        """Add the nodes, all hidden; a robot without meshes in `link_meshes` has no translucent arm."""
        self._scene = scene
        self._tool = FramePose(scene.add_frame("/motion/tool", show_axes=False))
        self._nominal = _Arrow(scene, "/motion/tool/nominal", NOMINAL_COLOUR, 0.007)
        self._filtered = _Arrow(scene, "/motion/tool/filtered", FILTERED_COLOUR, 0.009)
        segment = np.zeros((1, 2, 3))
        self._pair = scene.add_line_segments("/motion/pair", segment, PAIR_COLOUR, thickness=0.008, visible=False)
        self._ghost = scene.add_frame("/ghost", show_axes=False, visible=False)
        self._ghost_links = LinkFrames(scene, "/ghost", robot_model)
        for name in self._ghost_links.paths:
            self._add_ghost_link(name, link_meshes)
        self._plan: tuple[PlanStep, ...] = ()
        self._plan_nodes: list[SceneNodeHandle] = []

    def follow_tool(self, state: ViewState) -> None:
        """Move the arrows with the tool; their lengths do not change."""
        if state.tool is not None:
            self._tool.show(Pose(state.tool))

    def update(self, state: ViewState) -> None:
        """Show the signs of `state`."""
        self._nominal.show(state.nominal_velocity if state.tool is not None else None)
        self._filtered.show(state.filtered_velocity if state.tool is not None else None)
        self._pair.visible = state.nearest_pair is not None
        if state.nearest_pair is not None:
            self._pair.points = np.array([state.nearest_pair], np.float32)
        self._ghost.visible = bool(state.ghost)
        self._ghost_links.update(state.ghost)
        if state.plan != self._plan:
            self._plan = state.plan
            self._draw_plan()

    def _add_ghost_link(self, name: str, link_meshes: LinkMeshes) -> None:
        if patches := link_meshes.get(name):
            points, faces = _merged(patches)
            self._scene.add_mesh_simple(
                f"{self._ghost_links.paths[name]}/surface",
                *simplify_mesh(points, faces, GHOST_CELL_M),
                color=GHOST_COLOUR,
                opacity=GHOST_OPACITY,
                cast_shadow=False,
                receive_shadow=False,
            )

    def _draw_plan(self) -> None:
        for node in self._plan_nodes:
            node.remove()
        self._plan_nodes = []
        for k, step in enumerate(self._plan, start=1):
            mark = "✓" if step.is_done else "▶" if step.is_current else ""
            words = f"{mark} {k}. {visible_text(step.label)}".strip()
            label = self._scene.add_label(f"/plan/{k}", words, position=step.position, anchor="top-center")
            self._plan_nodes.append(label)
        if len(self._plan) > 1:
            points = _path([step.position for step in self._plan])
            line = self._scene.add_spline_catmull_rom("/plan/path", points, color=PATH_COLOUR, thickness=0.006)
            self._plan_nodes.append(line)


class _Arrow:
    """An arrow at the origin of its frame whose length shows a velocity."""

    def __init__(self, scene: SceneApi, name: str, colour: Colour, radius: float) -> None:
        self._velocity: Vector = (0.0, 0.0, 0.0)
        self._node = scene.add_arrows(
            name,
            np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]]),
            colour,
            shaft_radius=radius,
            head_radius=2.4 * radius,
            head_length=4.0 * radius,
            visible=False,
        )

    def show(self, velocity: Vector | None) -> None:
        """Show `velocity` [m/s]; nothing for None and for a slow one."""
        if velocity is None or hypot(*velocity) < MIN_ARROW_SPEED:
            self._node.visible = False
            return
        self._node.visible = True
        if dist(velocity, self._velocity) > MIN_ARROW_CHANGE:
            self._velocity = velocity
            self._node.points = np.array([[(0.0, 0.0, 0.0), [ARROW_SECONDS * one for one in velocity]]], np.float32)


def _path(places: list[Vector]) -> NDArray[np.float64]:
    """Points (k, 3) [m] of a path through `places`, raised between them; a sketch, not the trajectory of the arm."""
    corners = np.array(places)
    middles = 0.5 * (corners[:-1] + corners[1:]) + np.array([0.0, 0.0, PATH_HEIGHT_M])
    return np.concatenate([np.stack([corners[:-1], middles], axis=1).reshape(-1, 3), corners[-1:]])


def _merged(patches: Any) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """All patches of a link as one mesh: points (p, 3) [m] and faces (t, 3)."""
    offsets = np.cumsum([0, *(len(patch.points) for patch in patches[:-1])])
    points = np.concatenate([patch.points for patch in patches]).astype(np.float64)
    faces = np.concatenate([patch.faces + offset for patch, offset in zip(patches, offsets, strict=True)])
    return points, faces.astype(np.int64)
