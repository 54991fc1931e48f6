"""The shapes that a body's spheres were fitted to, read again for pictures."""

from __future__ import annotations

from dualbrain.embodiment.description.build import parts
from dualbrain.embodiment.description.build_base import axle, base_shapes
from dualbrain.embodiment.description.chain import find_chain, standing
from dualbrain.embodiment.description.folder import Recipe
from dualbrain.embodiment.description.shapes import joined
from dualbrain.embodiment.description.tree import Tree
from dualbrain.embodiment.meshes import Mesh


def shapes_of(tree: Tree, recipe: Recipe) -> dict[str, Mesh]:
    """Meshes in the frames of the body's links, as the recipe chose them."""
    if recipe.kind == "differential":
        poses, _ = standing(tree, recipe.base or tree.root, recipe.lock)
        centre, _ = axle(tree, poses, recipe.wheels)
        return {"base": joined(base_shapes(tree, poses, centre))}
    chain = find_chain(tree, base=recipe.base, tip=recipe.tip, tool=recipe.tool, lock=recipe.lock)
    _, shapes = parts(tree, chain)
    return {name: joined(meshes) for name, meshes in shapes.items()}
