"""Perceived scene in the live view: objects, the margins by which the filter inflates them, the target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from dualbrain.core.untrusted.visible_text import visible_text
from dualbrain.records import Place, SceneObject
from dualbrain.visualization.live.motion.frame_pose import FramePose
from dualbrain.visualization.live.robot_view import LinkMeshes
from dualbrain.visualization.live.view_state import ViewState

if TYPE_CHECKING:
    from viser import FrameHandle, MeshHandle, SceneApi

    from dualbrain.simulation.models.visual_meshes import ColouredMesh

MIN_VISIBLE_MARGIN_M = 1e-6
TABLE_EXTENT_M = (1.15, 1.30, 0.03)
"""Extent [m] that is drawn of a support; the support itself is an unbounded half space."""
TABLE_CENTRE_X_M = 0.375
TABLE_LEG_M = (0.06, 0.06, 0.68)
"""Extent [m] of a drawn leg of the table."""
COLOUR_LEG, GRID_COLOUR = (92, 84, 76), (150, 156, 163)
FLOOR_HEIGHT_M = -0.002
"""Height [m] at which a floor is drawn, just below the objects on it."""

COLOUR_BY_ROLE = {
    "object": (200, 60, 50),
    "container": (232, 230, 222),
    "support": (186, 156, 122),
    "obstacle": (133, 140, 148),
    "person": (222, 171, 140),
}
COLOUR_BY_NAME = {
    "red": (204, 33, 31),
    "blue": (33, 87, 179),
    "green": (61, 143, 84),
    "yellow": (237, 186, 41),
    "orange": (232, 120, 38),
    "purple": (117, 74, 153),
    "teal": (31, 138, 140),
    "white": (237, 235, 227),
    "brown": (115, 77, 51),
    "grey": (133, 140, 148),
    "pink": (222, 133, 153),
    "black": (41, 43, 48),
    "clear": (184, 224, 242),
    "oak": (158, 120, 82),
}
PLACE_COLOUR, PLACE_RADIUS, PLACE_HALF_HEIGHT = (10, 127, 95), 0.12, 0.003
"""Marker of a place on the floor: colour, radius and half height [m]."""
MARGIN_COLOUR, MARGIN_OPACITY = (240, 150, 40), 0.24


@dataclass(slots=True, kw_only=True)
class _ObjectNodes:
    """Scene nodes of one object, with the shape and the margin [m] that they show, and the pose of their frame."""

    shape: Shape
    margin: float
    frame: FrameHandle
    margin_mesh: MeshHandle | None
    pose: FramePose


class LiveScene:
    """Scene nodes of the perceived objects; rebuilt only if a shape changes, or a margin by more than 2 mm."""

    def __init__(self, scene: SceneApi, object_meshes: LinkMeshes | None = None) -> None:
        """Start without objects.

        An object with a mesh in `object_meshes` is drawn with it, in the frame of the object; others by their shape.
        """
        self._scene, self._object_meshes = scene, object_meshes or {}
        self._objects: dict[str, _ObjectNodes] = {}
        self._show_margins = True
        self._region: tuple[tuple[float, float], ...] = ()
        self._places: tuple[Place, ...] = ()
        self._target = scene.add_icosphere("/target", 0.012, color=(10, 127, 95), opacity=0.85, visible=False)

    def update(self, state: ViewState) -> None:
        """Show the objects, the floor, the places and the target of `state`."""
        names = {one.name for one in state.scene.objects}
        for name in self._objects.keys() - names:
            self._objects.pop(name).frame.remove()
        for one in state.scene.objects:
            self._update_object(one, state.margins.get(one.name, 0.0))
        if state.scene.region != self._region:
            self._region = state.scene.region
            self._add_floor(self._region)
        if state.scene.region and state.scene.places != self._places:
            self._places = state.scene.places
            self._add_place_markers(self._places)
        self._target.visible = state.target is not None
        if state.target is not None:
            self._target.position = state.target

    def show_margins(self, visible: bool) -> None:
        """Show or hide the inflated shapes from the next update on."""
        self._show_margins = visible

    def _add_floor(self, region: tuple[tuple[float, float], ...]) -> None:
        """Draw the convex region in which a base may drive as a floor."""
        corners = np.array([(x, y, FLOOR_HEIGHT_M) for x, y in region])
        faces = np.array([(0, k, k + 1) for k in range(1, len(region) - 1)])
        self._scene.add_mesh_simple(
            "/scene/floor", corners, faces, color=COLOUR_BY_ROLE["support"], side="double", cast_shadow=False
        )

    def _add_place_markers(self, places: tuple[Place, ...]) -> None:
        """Draw each place that a base can drive to as a disc with its name."""
        for place in places:
            path, (x, y, z) = f"/scene/place_{place.name}", place.position
            disc = shape_mesh(Cylinder(PLACE_RADIUS, PLACE_HALF_HEIGHT))
            self._scene.add_mesh_simple(
                path,
                np.asarray(disc.vertices),
                np.asarray(disc.faces),
                color=PLACE_COLOUR,
                position=(x, y, z + PLACE_HALF_HEIGHT),
                cast_shadow=False,
            )
            self._scene.add_label(
                f"{path}/name", visible_text(place.name), anchor="bottom-center", font_screen_scale=0.8
            )

    def _update_object(self, scene_object: SceneObject, margin: float) -> None:
        node = self._objects.get(scene_object.name)
        if node is None or node.shape != scene_object.shape or abs(node.margin - margin) > 0.002:
            if node is not None:
                node.frame.remove()
            node = self._objects[scene_object.name] = self._add_object(scene_object, margin)
        node.pose.show(scene_object.pose)
        if node.margin_mesh is not None:
            node.margin_mesh.visible = self._show_margins

    def _add_object(self, scene_object: SceneObject, margin: float) -> _ObjectNodes:
        path = f"/scene/{''.join(letter if letter.isalnum() else '_' for letter in scene_object.name)}"
        shape = scene_object.shape
        frame = self._scene.add_frame(path, show_axes=False)
        colour = COLOUR_BY_NAME.get(scene_object.colour, COLOUR_BY_ROLE[scene_object.role])
        if patches := self._object_meshes.get(scene_object.name):
            self._add_patches(path, patches)
        else:
            self._add_mesh(f"{path}/body", shape, 0.0, colour, None)
        if isinstance(shape, HalfSpace):
            self._add_table_legs(path)
        inflated = margin > MIN_VISIBLE_MARGIN_M and not isinstance(shape, HalfSpace)
        margin_mesh = (
            self._add_mesh(f"{path}/margin", shape, margin, MARGIN_COLOUR, MARGIN_OPACITY) if inflated else None
        )
        return _ObjectNodes(shape=shape, margin=margin, frame=frame, margin_mesh=margin_mesh, pose=FramePose(frame))

    def _add_patches(self, path: str, patches: Sequence[ColouredMesh]) -> None:
        for k, patch in enumerate(patches):
            red, green, blue = np.round(255 * np.array(patch.colour)).astype(int).tolist()
            self._scene.add_mesh_simple(f"{path}/{k}", patch.points, patch.faces, color=(red, green, blue))

    def _add_table_legs(self, path: str) -> None:
        """Draw four legs below the plate of the table, and the floor on which they stand."""
        length, width, thickness = TABLE_EXTENT_M
        for k, (side, end) in enumerate(product((-1, 1), (-1, 1))):
            x = TABLE_CENTRE_X_M + side * (0.5 * length - 0.06)
            y, z = end * (0.5 * width - 0.06), -thickness - 0.5 * TABLE_LEG_M[2]
            self._scene.add_box(f"{path}/leg{k}", COLOUR_LEG, TABLE_LEG_M, position=(x, y, z))
        self._scene.add_grid(
            f"{path}/floor",
            infinite_grid=True,
            cell_size=0.25,
            section_size=1.0,
            cell_color=GRID_COLOUR,
            section_color=GRID_COLOUR,
            cell_thickness=0.5,
            section_thickness=1.0,
            fade_distance=12.0,
            shadow_opacity=0.35,
            position=(TABLE_CENTRE_X_M, 0.0, -thickness - TABLE_LEG_M[2]),
        )

    def _add_mesh(
        self, path: str, shape: Shape, margin: float, colour: tuple[int, int, int], opacity: float | None
    ) -> MeshHandle:
        mesh = shape_mesh(shape, margin)
        flat = isinstance(shape, Box | HalfSpace)
        shadow = opacity is None
        return self._scene.add_mesh_simple(
            path,
            np.asarray(mesh.vertices),
            np.asarray(mesh.faces),
            color=colour,
            opacity=opacity,
            flat_shading=flat,
            side="front" if shadow else "double",
            cast_shadow=shadow,
            receive_shadow=shadow,
        )


def shape_mesh(shape: Shape, margin: float = 0.0) -> Any:
    """Triangle mesh (`trimesh.Trimesh`) of `shape`, grown by `margin` [m] on every side, in the frame of the shape."""
    from trimesh import creation  # noqa: PLC0415  (comes with viser)

    match shape:
        case Sphere(radius):
            return creation.icosphere(subdivisions=3, radius=radius + margin)
        case Capsule(radius, half):
            return creation.capsule(2 * half, radius + margin, count=(24, 24))
        case Cylinder(radius, half):
            return creation.cylinder(radius + margin, 2 * (half + margin), sections=48)
        case Box(half_extents):
            return creation.box(2 * (np.asarray(half_extents) + margin))
        case HalfSpace():
            return creation.box(TABLE_EXTENT_M).apply_translation((TABLE_CENTRE_X_M, 0, -TABLE_EXTENT_M[2] / 2))
        case Bowl(radius, height, wall):
            return creation.revolve(bowl_profile(radius + margin, height + margin, wall, -margin), sections=64)


def bowl_profile(radius: float, height: float, wall: float, bottom: float) -> list[tuple[float, float]]:
    """Cross section of a bowl as points (distance from the axis, height) [m], from its foot over the rim and back."""
    foot = 0.7 * radius
    outside = [(0.0, bottom), (foot, bottom), (radius, bottom + 0.45 * (height - bottom)), (radius, height)]
    return [
        *outside,
        (radius - wall, height),
        (radius - wall, bottom + 0.5 * (height - bottom)),
        (foot - wall, wall),
        (0.0, wall),
    ]
