"""dualbrain schema: print the contract schema of a robot."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Literal

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.contracts.schema import Schema, decoding_schema, validation_schema

if TYPE_CHECKING:
    from dualbrain.contracts.registry import SkillRegistry
    from dualbrain.simulation.scenes.scene_spec import SceneSpec


def schema(
    *,
    robot: str = "panda",
    scene: str = "0",
    form: Literal["validation", "decoding", "short"] = "validation",
) -> int:
    """Print the Draft-07 JSON Schema of a robot's contracts, with the names of a scene.

    Parameters
    ----------
    robot
        The robot whose skills are described.
    scene
        The scene whose object and place names are allowed: a number, FAMILY:SEED or a scene file.
    form
        `validation`: enforced by the gate; `decoding`: for constrained decoders, with the grasps that fit the objects;
        `short`: text form of the prompt.
    """
    from dualbrain.grounding.vocabulary import load_skill_registry, scene_names_of_spec
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    registry = load_skill_registry(robot)
    spec = open_scene(scene, robot)
    names = scene_names_of_spec(spec)
    if form == "short":
        from dualbrain.contracts.schema import describe_skills

        print(describe_skills(registry, names))
    else:
        chosen = validation_schema(registry, names) if form == "validation" else _decoding_schema(registry, spec)
        print(json.dumps(chosen, indent=2, ensure_ascii=False))
    return ExitCode.SUCCESS


def _decoding_schema(registry: SkillRegistry, spec: SceneSpec) -> Schema:
    """The schema for constrained decoders in the scene `spec`."""
    from dualbrain.grounding.envelope.grasp_fit import parameter_domains
    from dualbrain.grounding.offline_gate import scene_from_spec
    from dualbrain.grounding.vocabulary import scene_names

    scene = scene_from_spec(spec)
    return decoding_schema(registry, scene_names(scene), domains=parameter_domains(scene, registry))
