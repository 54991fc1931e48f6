"""Image of a robot in its home posture: its collision spheres over the meshes that they were fitted to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.self_collision import chain_frames, sphere_centres
from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]

GROUP_COLOURS = {"base": "#888888", "arm": "#4878a8", "hand": "#d1813a", "fingers": "#3a9a5c"}
VIEW_ANGLES = ((18, -60), (12, 30))
MAX_TRIANGLES_PER_LINK = 1200
"""Maximum number of triangles drawn for a link; of a larger mesh a random subset is drawn."""


def draw_robot(
    robot_model: RobotModel, meshes: Mapping[str, Mesh], path: Path, size: tuple[float, float] = (11.0, 5.5)
) -> None:
    """Write two views of `robot_model` to the PNG file `path`; `meshes` are in the frames of the links."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  (heavy)
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=size, dpi=90)
    FigureCanvasAgg(figure)
    turns, origins = chain_frames(robot_model.joints, home_posture(robot_model))
    corners = _bounding_box(robot_model, turns, origins)
    for i, (elevation, azimuth) in enumerate(VIEW_ANGLES, start=1):
        axes = figure.add_subplot(1, 2, i, projection="3d", proj_type="ortho", computed_zorder=False)
        for link in robot_model.links:
            _draw_link(axes, robot_model, link.name, meshes.get(link.name), turns, origins)
        _set_axes(axes, corners, elevation, azimuth)
    figure.suptitle(f"{robot_model.name}: {len(robot_model.spheres)} spheres over its meshes, home posture")
    figure.savefig(path)


def home_posture(robot_model: RobotModel) -> Array:
    """Joint positions (1, n) of the home posture; zeros for a differential-drive base."""
    return np.zeros((1, robot_model.n)) if robot_model.base == "differential" else np.array([robot_model.home])


def _draw_link(axes, robot_model: RobotModel, name: str, shape: Mesh | None, turns: Array, origins: Array) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # noqa: PLC0415

    link = next(link for link in robot_model.links if link.name == name)
    if shape is not None:
        triangles = sphere_centres(link, shape.vertices, turns, origins, 0.0)[0][shape.faces]
        if len(triangles) > MAX_TRIANGLES_PER_LINK:
            triangles = np.random.default_rng(0).choice(triangles, MAX_TRIANGLES_PER_LINK, replace=False)
        axes.add_collection3d(Poly3DCollection(triangles, facecolor="#777777", edgecolor="#333333", lw=0.1))
    a, b = np.meshgrid(np.linspace(0, np.pi, 9), np.linspace(0, 2 * np.pi, 13))
    unit = np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])
    own = [sphere for sphere in robot_model.spheres if sphere.link == name]
    if not own:
        return
    centres = sphere_centres(link, np.array([sphere.centre for sphere in own]), turns, origins, 0.0)[0]
    for centre, sphere in zip(centres, own, strict=True):
        surface = centre[:, None, None] + sphere.radius * unit
        axes.plot_surface(*surface, color=GROUP_COLOURS.get(link.group, "#4878a8"), alpha=0.14, lw=0)


def _bounding_box(robot_model: RobotModel, turns: Array, origins: Array) -> Array:
    """Lowest and highest corner (2, 3) [m] of the box around all spheres."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for link in robot_model.links:
        own = [sphere for sphere in robot_model.spheres if sphere.link == link.name]
        if own:
            centres = sphere_centres(link, np.array([sphere.centre for sphere in own]), turns, origins, 0.0)[0]
            radii = np.array([sphere.radius for sphere in own])[:, None]
            low, high = np.minimum(low, (centres - radii).min(axis=0)), np.maximum(high, (centres + radii).max(axis=0))
    return np.array([low, high]) if np.isfinite(low).all() else np.array([[-1.0] * 3, [1.0] * 3])


def _set_axes(axes, corners: Array, elevation: float, azimuth: float) -> None:
    middle, half = corners.mean(axis=0), 0.5 * float(np.max(np.ptp(corners, axis=0)))
    for limit, value in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
        limit(value - half, value + half)
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(elev=elevation, azim=azimuth)
    axes.tick_params(labelsize=6)
