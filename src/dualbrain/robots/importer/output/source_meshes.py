"""Loads the meshes to which the spheres of an imported robot were fitted, for rendering."""

from __future__ import annotations

from dualbrain.robots.assets.mesh_primitives import concatenate_meshes
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.importer.build_arm import rigid_parts
from dualbrain.robots.importer.build_mobile_base import base_meshes, find_axle
from dualbrain.robots.importer.kinematic_chain import find_chain, link_poses_at_rest
from dualbrain.robots.importer.kinematic_tree import KinematicTree
from dualbrain.robots.importer.output.robot_folder import ImportRecord


def load_source_meshes(tree: KinematicTree, record: ImportRecord) -> dict[str, Mesh]:
    """One mesh for each link of the robot model, in the link frame, chosen as in the import `record`."""
    if record.kind == "differential":
        poses, _ = link_poses_at_rest(tree, record.base or tree.root, record.lock)
        centre, _ = find_axle(tree, poses, record.wheels)
        return {"base": concatenate_meshes(base_meshes(tree, poses, centre))}
    chain = find_chain(tree, base=record.base, tip=record.tip, tool=record.tool, lock=record.lock)
    _, shapes = rigid_parts(tree, chain)
    return {name: concatenate_meshes(meshes) for name, meshes in shapes.items()}
