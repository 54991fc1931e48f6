"""Robot in the live view: its surface, and the spheres of the filter coloured by clearance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import RobotModel
from dualbrain.visualization.live.motion.link_frames import LinkFrames
from dualbrain.visualization.live.view_state import ViewState

if TYPE_CHECKING:
    from viser import BatchedMeshHandle, SceneApi

    from dualbrain.simulation.models.visual_meshes import ColouredMesh

Array = NDArray[np.float64]
Colour = tuple[int, int, int]
LinkMeshes = Mapping[str, "Sequence[ColouredMesh]"]
"""Coloured triangles by link, in the frame of the link."""

LIMITING_COLOUR: Colour = (210, 82, 30)
"""Colour of a link that limits the motion."""
MERGE_CELL_M = 0.008
"""Size [m] of the surface details that are not sent to the browser, which may have no graphics card."""

COLOUR_CLEARANCES_M = (0.0, 0.01, 0.03, 0.08)
"""Clearances [m] of the colours in `CLEARANCE_COLOURS`; colours between them are interpolated."""
CLEARANCE_COLOURS = np.array([[200, 60, 10], [235, 150, 30], [120, 170, 190], [70, 130, 190]], float)


def clearance_colours(clearances: Array) -> NDArray[np.uint8]:
    """RGB colours (k, 3) of clearances (k,) [m]: red at contact, amber at 1 cm, blue from 8 cm on."""
    return np.stack(
        [np.interp(clearances, COLOUR_CLEARANCES_M, CLEARANCE_COLOURS[:, c]) for c in range(3)], axis=1
    ).astype(np.uint8)


def simplify_mesh(
    points: NDArray[np.floating], faces: NDArray[np.integer], cell: float = MERGE_CELL_M
) -> tuple[Array, NDArray[np.int64]]:
    """A mesh whose points (n, 3) in the same `cell` [m] are merged into their mean; collapsed faces are dropped."""
    _, owner = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_inverse=True)
    owner = owner.ravel()
    merged = np.zeros((int(owner.max()) + 1, 3))
    np.add.at(merged, owner, points)
    merged /= np.bincount(owner)[:, None]
    corners = owner[faces]
    whole = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 2] != corners[:, 0])
    return merged, np.unique(corners[whole], axis=0)


class LiveRobot:
    """Scene nodes of one robot."""

    def __init__(self, scene: SceneApi, robot_model: RobotModel, link_meshes: LinkMeshes) -> None:
        """Add the meshes of the links, or for links without a mesh the spheres that cover them."""
        self._scene = scene
        self._spheres: BatchedMeshHandle | None = None
        self._show_spheres = False
        self.root = scene.add_frame("/robot", show_axes=False)
        self._links = LinkFrames(scene, "/robot", robot_model)
        self._surfaces: dict[str, list[tuple[Any, Colour]]] = {link.name: [] for link in robot_model.links}
        self._tinted: frozenset[str] = frozenset()
        for link in robot_model.links:
            self._add_link_meshes(link.name, link_meshes.get(link.name, ()))
        self._add_link_spheres(robot_model, link_meshes)

    def update(self, state: ViewState) -> None:
        """Set the poses of the links, and the positions and colours of the spheres if they are shown."""
        self._links.update(state.frames)
        if self._show_spheres and len(state.radii):
            self._update_spheres(state)
        elif self._spheres is not None:
            self._spheres.visible = False

    def tint(self, links: frozenset[str]) -> None:
        """Colour the surfaces of `links`, and give the others their own colour again."""
        for name in links ^ self._tinted:
            for surface, own in self._surfaces.get(name, ()):
                surface.color = LIMITING_COLOUR if name in links else own
        self._tinted = links

    def show_spheres(self, visible: bool) -> None:
        """Show or hide the spheres of the filter from the next update on."""
        self._show_spheres = visible

    def _update_spheres(self, state: ViewState) -> None:
        clearances = state.clearances if len(state.clearances) else np.full(len(state.radii), np.inf)
        colours = clearance_colours(clearances)
        if self._spheres is None or len(self._spheres.batched_positions) != len(state.radii):
            self._spheres = self._add_sphere_batch(state, colours)
        self._spheres.visible = True
        self._spheres.batched_positions = state.centres.astype(np.float32)
        self._spheres.batched_colors = colours

    def _add_link_meshes(self, link: str, patches: Sequence[ColouredMesh]) -> None:
        for k, patch in enumerate(patches):
            points, faces = simplify_mesh(patch.points, patch.faces)
            red, green, blue = np.round(255 * (0.86 * np.array(patch.colour) + 0.02)).astype(int).tolist()
            surface = self._scene.add_mesh_simple(
                f"{self._links.paths[link]}/{k}",
                points,
                faces,
                color=(red, green, blue),
                side="double",
                receive_shadow=False,
            )
            self._surfaces[link].append((surface, (red, green, blue)))

    def _add_link_spheres(self, robot_model: RobotModel, link_meshes: LinkMeshes) -> None:
        for k, sphere in enumerate(robot_model.spheres):
            if link_meshes.get(sphere.link):
                continue
            name, grey = f"{self._links.paths[sphere.link]}/{k}", (205, 208, 212)
            surface = self._scene.add_icosphere(name, sphere.radius, color=grey, subdivisions=2, position=sphere.centre)
            self._surfaces[sphere.link].append((surface, grey))

    def _add_sphere_batch(self, state: ViewState, colours: NDArray[np.uint8]) -> BatchedMeshHandle:
        import trimesh  # noqa: PLC0415  (comes with viser)

        sphere = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
        quaternions = np.tile([1.0, 0.0, 0.0, 0.0], (len(state.radii), 1))
        return self._scene.add_batched_meshes_simple(
            "/spheres",
            sphere.vertices,
            sphere.faces,
            quaternions,
            state.centres,
            batched_scales=state.radii.astype(np.float32),
            batched_colors=colours,
            opacity=0.45,
            cast_shadow=False,
            receive_shadow=False,
            lod="off",
        )
