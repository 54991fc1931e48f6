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
from dualbrain.adaptation.curation.sample import Sample, answer
from dualbrain.adaptation.synthetic.instruction import Errand, Steps, draw_errand
from dualbrain.adaptation.synthetic.random_parameters import draw_action
from dualbrain.adaptation.synthetic.templates import Book, Speech
from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import Action, Context, Contract, Value
from dualbrain.contracts.registry import Registry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.skill_spec import Choice, Name, Number
from dualbrain.planner.prompt.short_prompt import MAX_SHOWN, exemplar_steps, render_with

SOURCE = "templates"
"""Who proposed these contracts: nobody that plans."""
TRIES = 40
"""How often parameters are drawn for one instruction before it is given up: some things cannot be grasped at all."""
SHOWN, FOLLOWED = 0.5, 0.8
"""How often exemplars are shown, and how often the answer then takes its open parameters from the first."""
COUNTS = (0.6, 0.25, 0.15)
"""How often one, two or three are shown."""
SAME = 0.6
"""How often an exemplar has the skills of the answer; else those of another errand."""
ELSEWHERE = ("tin", "block", "can", "box", "cube")
"""Kinds of things that exemplars from other scenes are about."""


@dataclass(frozen=True)
class Setting:
    """Where a lesson is taught: the `scene`'s name, its `summary` in symbols, the names in it.

    `accepts` is the gate with the scene's rules (reach, opening, hand); `mobile` says that the robot drives.
    """

    registry: Registry
    scene: str
    summary: str
    names: SceneNames
    mobile: bool
    accepts: Callable[[bytes], bool] = field(repr=False)


def lesson(
    setting: Setting, book: Book, speech: Speech, rng: np.random.Generator, *, exemplars: float = SHOWN
) -> Sample | None:
    """A lesson in this setting, None if what was drawn cannot be done here; `exemplars` is how often some are shown."""
    errand = draw_errand(setting.names, setting.mobile, book, speech, rng)
    if errand is None:
        return None
    return next(filter(None, (_attempt(setting, errand, book, exemplars, rng) for _ in range(TRIES))), None)


def free_parameters(registry: Registry, action: Action, decided: Sequence[str] = ()) -> dict[str, Value]:
    """The parameters of `action` that no sentence decides: all but names and texts, without the `decided`."""
    specs = registry.skill(action.skill).parameters
    open_ones = {spec.name for spec in specs if isinstance(spec, Number | Choice)} - set(decided)
    return {name: value for name, value in action.params.items() if name in open_ones}


def _attempt(setting: Setting, errand: Errand, book: Book, exemplars: float, rng: np.random.Generator) -> Sample | None:
    """The lesson with one draw of all that is open, None if the gate refuses it."""
    registry, shown = setting.registry, [list[Action]() for _ in range(_how_many(exemplars, rng))]
    for exemplar in shown:
        exemplar += [draw_action(registry, skill, given, rng) for skill, given in _other(setting, errand, book, rng)]
    follow = shown[0] if shown and rng.random() < FOLLOWED else []
    contract = Contract(
        CONTRACT_ID, Context(registry.robot, registry.hash), _following(registry, errand.steps, follow, rng)
    )  # fmt: skip
    text = canonical_contract(contract, registry)
    if not setting.accepts(text.encode()):
        return None
    steps = [exemplar_steps({"action_sequence": msgspec.to_builtins(exemplar)}) for exemplar in shown]
    prompt = render_with(
        steps, setting.summary, errand.sentence, robot=registry.robot, registry=registry.hash, contract_id=CONTRACT_ID
    )
    messages = [{"role": turn["role"], "content": turn["content"]} for turn in prompt]
    return Sample(
        content_id(messages, text), messages, answer(text), 0.5, 0.0, 0.0, 1, setting.scene, "", (), SOURCE,
        setting.names.graspable, setting.names.receptive,
    )  # fmt: skip


def _following(
    registry: Registry, steps: Steps, follow: Sequence[Action], rng: np.random.Generator
) -> tuple[Action, ...]:
    """The steps with what is open taken from the same skill in `follow` (its n-th for the n-th, else the last)."""
    actions: list[Action] = []
    for skill, given in steps:
        models = [one for one in follow if one.skill == skill]
        turn = sum(one.skill == skill for one in actions)
        habit = free_parameters(registry, models[min(turn, len(models) - 1)], tuple(given)) if models else {}
        actions.append(draw_action(registry, skill, habit | given, rng))
    return tuple(actions)


def _other(setting: Setting, errand: Errand, book: Book, rng: np.random.Generator) -> Steps:
    """The steps of an exemplar: those of the errand or of a plain one, about things of this scene or of another."""
    plain = book.kinds["go" if setting.mobile else "put_in"].contract
    skills: list[str] = [skill for skill, _ in errand.steps] if errand.possible and rng.random() < SAME else []
    skills = skills or [step["skill"] for step in plain]
    return tuple((skill, _given(setting, skill, book, rng)) for skill in skills)


def _given(setting: Setting, skill: str, book: Book, rng: np.random.Generator) -> dict[str, Value]:
    """A name for every name that `skill` wants."""
    given: dict[str, Value] = {}
    for spec in setting.registry.skill(skill).parameters:
        if isinstance(spec, Name):
            here = setting.names.offered(spec.of)
            foreign = f"{rng.choice(book.absent.colours)}_{rng.choice(ELSEWHERE)}"
            given[spec.name] = foreign if spec.of == "graspable" and rng.random() < SAME else str(rng.choice(here))
    return given


def _how_many(often: float, rng: np.random.Generator) -> int:
    return int(rng.choice(np.arange(1, MAX_SHOWN + 1), p=COUNTS)) if rng.random() < often else 0
