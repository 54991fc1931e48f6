"""The shapes that a body's spheres were fitted to, read again for pictures."""

from __future__ import annotations

from dualbrain.robots.assets.mesh_primitives import joined
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.importer.build_arm import parts
from dualbrain.robots.importer.build_mobile_base import axle, base_shapes
from dualbrain.robots.importer.kinematic_chain import find_chain, standing
from dualbrain.robots.importer.kinematic_tree import Tree
from dualbrain.robots.importer.output.robot_folder import Recipe


def shapes_of(tree: Tree, recipe: Recipe) -> dict[str, Mesh]:
    """Meshes in the frames of the body's links, as the recipe chose them."""
    if recipe.kind == "differential":
        poses, _ = standing(tree, recipe.base or tree.root, recipe.lock)
        centre, _ = axle(tree, poses, recipe.wheels)
        return {"base": joined(base_shapes(tree, poses, centre))}
    chain = find_chain(tree, base=recipe.base, tip=recipe.tip, tool=recipe.tool, lock=recipe.lock)
    _, shapes = parts(tree, chain)
    return {name: joined(meshes) for name, meshes in shapes.items()}
