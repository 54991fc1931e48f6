"""Draws the collision spheres of the Panda over its meshes: `python scripts/draw_panda_spheres.py FILE.png`."""

import sys

import matplotlib as mpl
import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from dualbrain.robots.assets.meshes import collision_mesh
from dualbrain.robots.collision_model.self_collision import chain_frames, sphere_centres
from dualbrain.robots.loader import load_robot

mpl.use("Agg")
from matplotlib import pyplot as plt  # the backend is chosen first

PANDA = load_robot("panda")
COLOURS = {"arm": "#4878a8", "hand": "#d1813a", "fingers": "#3a9a5c"}
VIEWS = (
    ("the arm at home", lambda link: True, (0.24, 0.0, 0.40), 0.47, (14, -68)),
    ("hand and fingers, 20 mm open", lambda link: link.group != "arm", None, 0.105, (8, -50)),
    ("fingers from the side", lambda link: link.group == "fingers", None, 0.045, (4, -86)),
)


def placed_mesh(link, turns, origins, opening):
    """Triangles (f, 3, 3) of the mesh of a link in the world frame."""
    mesh = collision_mesh("panda", "finger" if link.group == "fingers" else link.name)
    vertices = mesh.vertices * ([-1, -1, 1] if link.name == "right_finger" else [1, 1, 1])
    return sphere_centres(link, vertices, turns, origins, opening)[0][mesh.faces]


def draw(axes, selected, opening):
    """Draw meshes in grey and spheres in the colour of their group, at the home posture."""
    turns, origins = chain_frames(PANDA.joints, np.array([PANDA.home]))
    a, b = np.meshgrid(np.linspace(0, np.pi, 13), np.linspace(0, 2 * np.pi, 21))
    unit = np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])
    points = []
    links = list(filter(selected, PANDA.links))
    for link in links:
        triangles = placed_mesh(link, turns, origins, opening)
        points.append(triangles.reshape(-1, 3))
        axes.add_collection3d(Poly3DCollection(triangles, facecolor="#777777", edgecolor="#222222", lw=0.15))
    for link in links:
        own = [sphere for sphere in PANDA.spheres if sphere.link == link.name]
        centres = sphere_centres(link, np.array([sphere.centre for sphere in own]), turns, origins, opening)[0]
        for centre, sphere in zip(centres, own, strict=True):
            surface = centre[:, None, None] + sphere.radius * unit
            axes.plot_surface(*surface, color=COLOURS[link.group], alpha=0.13, lw=0, shade=True)
    return np.concatenate(points)


def main(path):
    """Draw three views side by side."""
    figure = plt.figure(figsize=(13, 5.6), dpi=80)
    for i, (title, selected, centre, reach, (elevation, azimuth)) in enumerate(VIEWS, start=1):
        axes = figure.add_subplot(1, 3, i, projection="3d", proj_type="ortho", computed_zorder=False)
        points = draw(axes, selected, 0.02)
        middle = np.array(centre) if centre else 0.5 * (points.min(axis=0) + points.max(axis=0))
        for limit, value in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
            limit(value - reach, value + reach)
        axes.set_box_aspect((1, 1, 1), zoom=1.6)
        axes.view_init(elevation, azimuth)
        axes.set_axis_off()
        axes.set_title(title, fontsize=10, y=1.02)
    figure.subplots_adjust(0, 0, 1, 0.9, 0, 0)
    figure.savefig(path)


if __name__ == "__main__":
    main(sys.argv[1])
