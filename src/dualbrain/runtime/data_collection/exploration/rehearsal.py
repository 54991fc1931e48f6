"""Rehearsal examples: instructions of every kind with the contract of the fitting levels, or with a decline.

An adapter that is trained on placements alone would forget the other skills and when to decline. Nothing is executed:
the gate with the rules of the scene accepts each contract. Clauses that contracts cannot express are not among them:
the local check of instructions declines these before a planner is asked, and adapters that learned to decline clauses
declined plain instructions too (docs/results/LOG.md).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.synthetic.instruction import draw_instruction
from dualbrain.adaptation.synthetic.split import Split
from dualbrain.adaptation.synthetic.templates import Phrasings, load_templates
from dualbrain.grounding.alternatives import alternatives
from dualbrain.runtime.data_collection.exploration.place import Place
from dualbrain.runtime.data_collection.exploration.proposals import make_sample
from dualbrain.runtime.data_collection.synthetic_scenes import draw_scene, load_phrasings, make_scene_context

SOURCE = "templates"


def draw_rehearsal(robot: str, part: Split, seed: int, index: int) -> Sample:
    """Rehearsal example number `index` of the sequence `seed`; it does not depend on those before it."""
    rng = np.random.default_rng([seed, index, 2, *part.encode()])
    while True:
        if (example := _try_rehearsal(robot, part, rng)) is not None:
            return example


def _try_rehearsal(robot: str, part: Split, rng: np.random.Generator) -> Sample | None:
    """An example in a random scene; None if the drawn task is impossible there."""
    spec = draw_scene(robot, part, rng)
    context = make_scene_context(spec)
    phrasings = plain_phrasings(context.mobile, part)
    task = draw_instruction(context.names, context.mobile, load_templates(), phrasings, rng)
    if task is None:
        return None
    place = Place(context.scene, task.steps)
    for actions in alternatives(place.registry, place.scene, task.steps).values():
        text = place.contract_text(actions)
        if context.accepts(text.encode()):
            return make_sample(place, text, task.sentence, source=SOURCE)
    return None


@cache
def plain_phrasings(mobile: bool, part: Split) -> Phrasings:
    """The phrasings of `part` without kinds of instructions that have a clause."""
    found, kinds = load_phrasings(mobile, part), load_templates().kinds
    sentences = {name: some for name, some in found.sentences.items() if not kinds[name].clause}
    return replace(found, sentences=sentences)
