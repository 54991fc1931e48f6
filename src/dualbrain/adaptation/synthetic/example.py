"""One synthetic example: a scene summary, an instruction about it, and a contract that answers it and passes the gate.

Names and their order follow from the instruction. All other parameters are drawn at random, or mostly copied from the
first exemplar if the prompt shows some; exemplars are random too. A model trained on these examples knows the language
of contracts and follows exemplars of memory, but knows nothing about the outcome of a contract on a robot.
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
from dualbrain.planner.prompt.full_prompt import ChatMessage
from dualbrain.planner.prompt.short_prompt import MAX_SHOWN_EXEMPLARS, exemplar_steps, render_short_with_steps
from dualbrain.records import Scene

SOURCE = "templates"
"""The source of these contracts in a data set: no planner proposed them."""
MAX_DRAWS = 40
"""Maximum number of parameter draws for one instruction: some objects cannot be grasped at all."""
EXEMPLAR_SHARE, FOLLOW_SHARE = 0.5, 0.8
"""Share of examples with exemplars, and share of those in which the answer copies its parameters from the first one."""
EXEMPLAR_COUNT_SHARES = (0.6, 0.25, 0.15)
"""Shares of one, two and three exemplars."""
SAME_SKILLS_SHARE = 0.6
"""Share of exemplars with the skills of the answer; the others are of another task."""
FOREIGN_CATEGORIES = ("tin", "block", "can", "box", "cube")
"""Categories of objects in exemplars from other scenes."""


@dataclass(frozen=True, kw_only=True)
class SceneContext:
    """The scene of an example: its name `scene`, the `perceived` objects, and their `summary` in symbols and `names`.

    `accepts` is the gate with the rules of the scene (reach, opening, hand); `mobile` states that the robot drives.
    """

    registry: SkillRegistry
    scene: str
    perceived: Scene
    summary: str
    summary_with_values: str
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
    """An example in this scene, None if the drawn task is impossible here.

    `exemplar_share` is the share of examples with exemplars in the prompt.
    """
    task = draw_instruction(context.names, context.mobile, book, phrasings, rng)
    if task is None:
        return None
    return next(filter(None, (_try_example(context, task, book, exemplar_share, rng) for _ in range(MAX_DRAWS))), None)


def free_parameters(registry: SkillRegistry, action: Action, decided: Sequence[str] = ()) -> dict[str, ParameterValue]:
    """The parameters of `action` that an instruction leaves open: numbers and choices, without those `decided`."""
    specs = registry.skill(action.skill).parameters
    open_names = {spec.name for spec in specs if isinstance(spec, NumberParameter | ChoiceParameter)} - set(decided)
    return {name: value for name, value in action.params.items() if name in open_names}


def _try_example(
    context: SceneContext, task: InstructionSample, book: TemplateBook, exemplar_share: float, rng: np.random.Generator
) -> Sample | None:
    """An example with one draw of all open parameters, None if the gate rejects it."""
    registry, shown = context.registry, [list[Action]() for _ in range(_draw_exemplar_count(exemplar_share, rng))]
    for exemplar in shown:
        exemplar += [
            draw_action(registry, skill, given, rng) for skill, given in _exemplar_steps(context, task, book, rng)
        ]
    follow = shown[0] if shown and rng.random() < FOLLOW_SHARE else []
    contract = Contract(
        CONTRACT_ID, Context(registry.robot, registry.hash), _draw_actions(registry, task.steps, follow, rng)
    )
    text = canonical_contract(contract, registry)
    if not context.accepts(text.encode()):
        return None
    steps = [exemplar_steps({"action_sequence": msgspec.to_builtins(exemplar)}) for exemplar in shown]
    prompt = render_short_with_steps(
        steps, context.summary, task.sentence, robot=registry.robot, registry=registry.hash, contract_id=CONTRACT_ID
    )
    return unexecuted_sample(prompt, text, scene=context.scene, names=context.names, source=SOURCE)


def unexecuted_sample(
    prompt: Sequence[ChatMessage], contract: str, *, scene: str, names: SceneNames, source: str
) -> Sample:
    """The sample of `contract` by `source` as the answer to `prompt`, without an episode: its weight is ½."""
    messages = [{"role": turn["role"], "content": turn["content"]} for turn in prompt]
    return Sample(
        id=content_id(messages, contract),
        prompt=messages,
        completion=assistant_turn(contract),
        weight=0.5,
        Delta=0.0,
        duration=0.0,
        repeats=1,
        scene=scene,
        memory="",
        events=(),
        source=source,
        graspable=names.graspable,
        receptive=names.receptive,
    )


def _draw_actions(
    registry: SkillRegistry, steps: SkillSteps, follow: Sequence[Action], rng: np.random.Generator
) -> tuple[Action, ...]:
    """The actions of `steps`, with open parameters copied from the same skill in `follow`.

    The n-th use of a skill copies from its n-th use in `follow`, else from the last one.
    """
    actions: list[Action] = []
    for skill, given in steps:
        models = [one for one in follow if one.skill == skill]
        turn = sum(one.skill == skill for one in actions)
        copied = free_parameters(registry, models[min(turn, len(models) - 1)], tuple(given)) if models else {}
        actions.append(draw_action(registry, skill, copied | given, rng))
    return tuple(actions)


def _exemplar_steps(
    context: SceneContext, task: InstructionSample, book: TemplateBook, rng: np.random.Generator
) -> SkillSteps:
    """The steps of an exemplar: those of the task or of a simple one, about objects of this scene or of another."""
    simple_task = book.kinds["go" if context.mobile else "put_in"].contract
    skills: list[str] = (
        [skill for skill, _ in task.steps] if task.is_possible and rng.random() < SAME_SKILLS_SHARE else []
    )
    skills = skills or [step["skill"] for step in simple_task]
    return tuple((skill, _draw_names(context, skill, book, rng)) for skill in skills)


def _draw_names(
    context: SceneContext, skill: str, book: TemplateBook, rng: np.random.Generator
) -> dict[str, ParameterValue]:
    """A value for every name parameter of `skill`."""
    given: dict[str, ParameterValue] = {}
    for spec in context.registry.skill(skill).parameters:
        if isinstance(spec, NameParameter):
            here = context.names.names_of_kind(spec.of)
            foreign = f"{rng.choice(book.absent.colours)}_{rng.choice(FOREIGN_CATEGORIES)}"
            given[spec.name] = (
                foreign if spec.of == "graspable" and rng.random() < SAME_SKILLS_SHARE else str(rng.choice(here))
            )
    return given


def _draw_exemplar_count(exemplar_share: float, rng: np.random.Generator) -> int:
    return (
        int(rng.choice(np.arange(1, MAX_SHOWN_EXEMPLARS + 1), p=EXEMPLAR_COUNT_SHARES))
        if rng.random() < exemplar_share
        else 0
    )
