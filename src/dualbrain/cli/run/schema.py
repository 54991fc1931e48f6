"""dualbrain schema: print the contract schema of a robot."""

from __future__ import annotations

import json
from typing import Literal

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.contracts.schema import decoding_schema, validation_schema


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
        `validation`: enforced by the gate; `decoding`: for constrained decoders; `short`: text form of the prompt.
    """
    from dualbrain.grounding.vocabulary import load_skill_registry, scene_names_of_spec
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    registry = load_skill_registry(robot)
    names = scene_names_of_spec(open_scene(scene, robot))
    if form == "short":
        from dualbrain.contracts.schema import describe_skills

        print(describe_skills(registry, names))
    else:
        chosen = validation_schema(registry, names) if form == "validation" else decoding_schema(registry, names)
        print(json.dumps(chosen, indent=2, ensure_ascii=False))
    return ExitCode.SUCCESS
