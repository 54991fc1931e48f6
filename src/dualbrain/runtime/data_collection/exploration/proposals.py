"""Proposals of the value model: at each new place the alternative that it chooses, with an instruction for it.

`rollouts.run_proposals` executes them in the full simulation and stores the episodes in a ledger, from which D_clean is
curated. The twin selects the proposals and admits none of them.
"""

from __future__ import annotations

import numpy as np

from dualbrain.adaptation.curation.curate import CONTRACT_ID
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.synthetic.example import unexecuted_sample
from dualbrain.adaptation.synthetic.instruction import vary_punctuation
from dualbrain.adaptation.synthetic.split import Split
from dualbrain.adaptation.value_model.value_model import ValueModel
from dualbrain.grounding.alternatives import DEFAULT_ALTERNATIVE
from dualbrain.grounding.instruction.goals.goal import Goal
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.planner.prompt.short_prompt import render_short
from dualbrain.runtime.data_collection.exploration.explore import nth_place
from dualbrain.runtime.data_collection.exploration.place import Place
from dualbrain.runtime.data_collection.synthetic_scenes import load_phrasings
from dualbrain.simulation.scenes.generators.catalogue import is_mobile
from dualbrain.simulation.tasks.instructions import natural_name

SOURCE = "value-model"
"""The source of these contracts in a ledger: no planner proposed them."""

MAX_DRAWS = 20
"""Sentences that are drawn for one proposal until the goal of one can be read."""


def propose_best(
    value_model: ValueModel, turn: int, *, robot: str = "panda", part: Split = "teach", seed: int = 0
) -> Sample:
    """The proposal at place number `turn` of the sequence `seed`.

    The goal of its sentence can be read, so that the robot's senses can confirm the outcome; the training set has other
    sentences as well.
    """
    place = nth_place(robot, part, seed, turn)
    contracts = place.contracts()
    best = value_model.choose(place.placement, list(contracts), DEFAULT_ALTERNATIVE)
    rng = np.random.default_rng([seed, turn, 1])
    sentences = (draw_sentence(place, part, rng) for _ in range(MAX_DRAWS))
    readable = (one for one in sentences if isinstance(read_goal(one, place.scene), Goal))
    return make_sample(place, contracts[best], next(readable, None) or draw_sentence(place, part, rng))


def draw_sentence(place: Place, part: Split, rng: np.random.Generator) -> str:
    """A random phrasing of the placement at `place` that `part` may use."""
    placement = place.placement
    is_container = any(obj.name == placement.destination for obj in place.scene.objects)
    kind = "put_in" if is_container else "put_at"
    sentences = [
        one
        for one in load_phrasings(is_mobile(place.spec.robot), part).sentences[kind]
        if all(f"{{{slot}}}" not in one for slot in ("second", "second_target", "group", "number"))
    ]
    words = {"object": natural_name(placement.object_name), "target": natural_name(placement.destination)}
    return vary_punctuation(str(rng.choice(np.array(sentences, object))).format(**words), rng)


def make_sample(place: Place, contract: str, sentence: str, *, source: str = SOURCE) -> Sample:
    """`contract` of `source` as the answer to `sentence` at `place`, with fitting values in the prompt."""
    registry = place.registry
    prompt = render_short(
        place.summary, sentence, robot=registry.robot, registry=registry.hash, contract_id=CONTRACT_ID
    )
    return unexecuted_sample(prompt, contract, scene=place.scene_name, names=scene_names(place.scene), source=source)
