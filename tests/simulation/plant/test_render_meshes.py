"""Meshes for rendering: they coincide with the collision shapes of the plant, for every robot."""

import mujoco
import numpy as np
import pytest

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.robots.loader import SIMULATED_ROBOTS, load_robot
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.plant.render_meshes import COLLISION_GEOM_GROUP, link_meshes, object_meshes
from dualbrain.simulation.scenes.generators.catalogue import open_scene


@pytest.mark.parametrize("robot", SIMULATED_ROBOTS)
def test_every_collision_geom_is_within_the_mesh_of_its_link(robot):
    robot_model = load_robot(robot)
    plant = make_plant(open_scene("0", robot), robot_model)
    found, poses, model = link_meshes(plant), plant.link_poses(), plant.model
    for name, part in plant.link_body_names().items():
        owner = plant.data.body(part).id
        solid = [i for i in range(model.ngeom) if model.geom_bodyid[i] == owner and model.geom_contype[i]]
        if not solid:
            continue
        points = np.vstack([patch.points for patch in found[name]])
        assert all(patch.faces.max() < len(patch.points) for patch in found[name])
        drawn = points @ quaternion_to_matrix(poses[name].quaternion).T + np.array(poses[name].position)
        for i in solid:  # the centre of each collision geom is within the bounds of the mesh
            assert np.all(drawn.min(axis=0) - 0.02 < plant.data.geom_xpos[i])
            assert np.all(plant.data.geom_xpos[i] < drawn.max(axis=0) + 0.02)


def test_the_arm_of_a_person_is_drawn_inside_its_collision_capsule() -> None:
    plant = make_plant(open_scene("8", "panda"), load_robot("panda"))
    found, mover = object_meshes(plant), plant.spec.mover
    assert mover is not None
    points = np.vstack([patch.points for patch in found[mover.name]])
    assert signed_distance(Capsule(mover.radius, mover.half_length), Pose((0.0, 0.0, 0.0)), points).max() < 0.012
    assert np.ptp(points[:, 2]) > 1.8 * mover.half_length, "it has the length of the capsule"
    assert len(found[mover.name]) > 5, "sleeve, wrist, palm and fingers"


def test_a_bowl_is_drawn_in_its_own_colour() -> None:
    plant = make_plant(open_scene("8", "panda"), load_robot("panda"))
    (patch,) = object_meshes(plant)["blue_bowl"]
    red, _, blue = patch.colour
    assert blue > 2.0 * red


def test_meshes_have_the_right_size_and_outward_normals():
    plant = make_plant(open_scene("0", "base"), load_robot("base"))
    (drawn,) = link_meshes(plant).values()
    for patch in drawn:
        corners = patch.points[patch.faces].astype(float)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outward = corners.mean(axis=1) - patch.points.mean(axis=0)
        assert np.all(np.einsum("ij,ij->i", normals, outward) > 0.0)
    housing = mujoco.mj_name2id(plant.model, mujoco.mjtObj.mjOBJ_GEOM, "robot/housing")
    size = max((np.ptp(patch.points, axis=0) for patch in drawn), key=np.prod)
    assert size == pytest.approx(2 * plant.model.geom_size[housing], abs=1e-6)


def test_the_platform_of_an_arm_with_visual_meshes_is_drawn():
    """Renderers leave out collision geoms (group 3) of links with meshes; the platform has no meshes."""
    plant = make_plant(open_scene("workroom:0", "mobile_panda"), load_robot("mobile_panda"), visuals=True)
    platform = plant.data.body(plant.link_body_names()[plant.robot_model.links[0].name]).id
    shown = [i for i in range(plant.model.ngeom) if plant.model.geom_bodyid[i] == platform]
    assert shown
    assert all(plant.model.geom_group[i] != COLLISION_GEOM_GROUP for i in shown)
