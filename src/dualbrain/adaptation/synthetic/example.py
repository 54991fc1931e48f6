"""One lesson: a scene in symbols, an instruction about it, and a contract that answers it and that the gate accepts.

Names and their order follow from the instruction. All that it leaves open is drawn at random, or mostly taken from the
first exemplar, where the prompt shows some: exemplars are drawn at random too. So a model that is taught this speaks
the language of contracts and follows what memory shows it; it knows nothing of what a body makes of a contract.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from dualbrain.adaptation.curation.curate import CONTRACT_ID, content_id
from dualbrain.adaptation.curation.sample import Sample, assistant_turn
from dualbrain.adaptation.synthetic.instruction import InstructionSample, SkillSteps, draw_instruction
from dualbrain.adaptation.synthetic.random_parameters import draw_action
from dualbrain.adaptation.synthetic.templates import Phrasings, TemplateBook
from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import Action, Context, Contract, ParameterValue
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.skill_spec import ChoiceParameter, NameParameter, NumberParameter
from dualbrain.planner.prompt.short_prompt import MAX_SHOWN_EXEMPLARS, exemplar_steps, render_short_with_steps

SOURCE = "templates"
"""Who proposed these contracts: nobody that plans."""
MAX_DRAWS = 40
"""How often parameters are drawn for one instruction before it is given up: some things cannot be grasped at all."""
EXEMPLAR_SHARE, FOLLOW_SHARE = 0.5, 0.8
"""How often exemplars are shown, and how often the answer then takes its open parameters from the first."""
EXEMPLAR_COUNT_SHARES = (0.6, 0.25, 0.15)
"""How often one, two or three are shown."""
SAME_SKILLS_SHARE = 0.6
"""How often an exemplar has the skills of the answer; else those of another errand."""
FOREIGN_CATEGORIES = ("tin", "block", "can", "box", "cube")
"""Kinds of things that exemplars from other scenes are about."""


@dataclass(frozen=True, kw_only=True)
class SceneContext:
    """Where a lesson is taught: the `scene`'s name, its `summary` in symbols, the names in it.

    `accepts` is the gate with the scene's rules (reach, opening, hand); `mobile` says that the robot drives.
    """

    registry: SkillRegistry
    scene: str
    summary: str
    names: SceneNames
    mobile: bool
    accepts: Callable[[bytes], bool] = field(repr=False)


def generate_example(
    context: SceneContext,
    book: TemplateBook,
    phrasings: Phrasings,
    rng: np.random.Generator,
    *,
    exemplar_share: float = EXEMPLAR_SHARE,
) -> Sample | None:
    """A lesson in this setting, None if what was drawn cannot be done here; `exemplars` is how often some are shown."""
    errand = draw_instruction(context.names, context.mobile, book, phrasings, rng)
    if errand is None:
        return None
    return next(
        filter(None, (_try_example(context, errand, book, exemplar_share, rng) for _ in range(MAX_DRAWS))), None
    )


def free_parameters(registry: SkillRegistry, action: Action, decided: Sequence[str] = ()) -> dict[str, ParameterValue]:
    """The parameters of `action` that no sentence decides: all but names and texts, without the `decided`."""
    specs = registry.skill(action.skill).parameters
    open_ones = {spec.name for spec in specs if isinstance(spec, NumberParameter | ChoiceParameter)} - set(decided)
    return {name: value for name, value in action.params.items() if name in open_ones}


def _try_example(
    setting: SceneContext, errand: InstructionSample, book: TemplateBook, exemplars: float, rng: np.random.Generator
) -> Sample | None:
    """The lesson with one draw of all that is open, None if the gate refuses it."""
    registry, shown = setting.registry, [list[Action]() for _ in range(_draw_exemplar_count(exemplars, rng))]
    for exemplar in shown:
        exemplar += [
            draw_action(registry, skill, given, rng) for skill, given in _exemplar_steps(setting, errand, book, rng)
        ]
    follow = shown[0] if shown and rng.random() < FOLLOW_SHARE else []
    contract = Contract(
        CONTRACT_ID, Context(registry.robot, registry.hash), _draw_actions(registry, errand.steps, follow, rng)
    )
    text = canonical_contract(contract, registry)
    if not setting.accepts(text.encode()):
        return None
    steps = [exemplar_steps({"action_sequence": msgspec.to_builtins(exemplar)}) for exemplar in shown]
    prompt = render_short_with_steps(
        steps, setting.summary, errand.sentence, robot=registry.robot, registry=registry.hash, contract_id=CONTRACT_ID
    )
    messages = [{"role": turn["role"], "content": turn["content"]} for turn in prompt]
    return Sample(
        id=content_id(messages, text),
        prompt=messages,
        completion=assistant_turn(text),
        weight=0.5,
        Delta=0.0,
        duration=0.0,
        repeats=1,
        scene=setting.scene,
        memory="",
        events=(),
        source=SOURCE,
        graspable=setting.names.graspable,
        receptive=setting.names.receptive,
    )


def _draw_actions(
    registry: SkillRegistry, steps: SkillSteps, follow: Sequence[Action], rng: np.random.Generator
) -> tuple[Action, ...]:
    """The steps with what is open taken from the same skill in `follow` (its n-th for the n-th, else the last)."""
    actions: list[Action] = []
    for skill, given in steps:
        models = [one for one in follow if one.skill == skill]
        turn = sum(one.skill == skill for one in actions)
        habit = free_parameters(registry, models[min(turn, len(models) - 1)], tuple(given)) if models else {}
        actions.append(draw_action(registry, skill, habit | given, rng))
    return tuple(actions)


def _exemplar_steps(
    setting: SceneContext, errand: InstructionSample, book: TemplateBook, rng: np.random.Generator
) -> SkillSteps:
    """The steps of an exemplar: those of the errand or of a plain one, about things of this scene or of another."""
    plain = book.kinds["go" if setting.mobile else "put_in"].contract
    skills: list[str] = (
        [skill for skill, _ in errand.steps] if errand.is_possible and rng.random() < SAME_SKILLS_SHARE else []
    )
    skills = skills or [step["skill"] for step in plain]
    return tuple((skill, _draw_names(setting, skill, book, rng)) for skill in skills)


def _draw_names(
    setting: SceneContext, skill: str, book: TemplateBook, rng: np.random.Generator
) -> dict[str, ParameterValue]:
    """A name for every name that `skill` wants."""
    given: dict[str, ParameterValue] = {}
    for spec in setting.registry.skill(skill).parameters:
        if isinstance(spec, NameParameter):
            here = setting.names.names_of_kind(spec.of)
            foreign = f"{rng.choice(book.absent.colours)}_{rng.choice(FOREIGN_CATEGORIES)}"
            given[spec.name] = (
                foreign if spec.of == "graspable" and rng.random() < SAME_SKILLS_SHARE else str(rng.choice(here))
            )
    return given


def _draw_exemplar_count(often: float, rng: np.random.Generator) -> int:
    return (
        int(rng.choice(np.arange(1, MAX_SHOWN_EXEMPLARS + 1), p=EXEMPLAR_COUNT_SHARES)) if rng.random() < often else 0
    )
