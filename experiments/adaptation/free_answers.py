"""A model with its adapters that answers freely, many questions side by side: in torch, which says what llama.cpp says.

`benchmarks/serving_equality.py` has the comparison. Nothing binds an answer; the grammar of the question's scene only
foresees it (`adaptation/serving/speculative_decoding.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from dualbrain.adaptation.adapters.stacking import Stack
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.cli.common import paths
from dualbrain.contracts.schema import decoding_schema
from dualbrain.planner.decoding.llguidance_grammar import contract_grammar
from dualbrain.runtime.data_collection.synthetic_scenes import setting_of

LONGEST = 400
"""Tokens of an answer: three things put away take some 330."""
SIDE_BY_SIDE = 8

Turns = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Chance:
    """Answers are drawn: at which temperature, and by which seed each."""

    temperature: float
    seeds: Sequence[int]


class Speaker:
    """The model of `stack`; it is loaded by the first question."""

    def __init__(self, stack: Stack, threads: int = 1) -> None:
        """Nothing is read yet."""
        self._stack, self._threads = stack, threads

    def answers(
        self, questions: Sequence[Sample], turns: Sequence[Turns] | None = None, chance: Chance | None = None
    ) -> list[str]:
        """The free answers to `questions`, each asked by its own prompt or its `turns`; greedy unless by `chance`."""
        import torch  # noqa: PLC0415  (only where it is asked)

        from dualbrain.adaptation.serving.constrained_decoding import Binding  # noqa: PLC0415
        from dualbrain.adaptation.serving.speculative_decoding import Reply, speak  # noqa: PLC0415
        from dualbrain.adaptation.training.model.batching import prompt_ids  # noqa: PLC0415

        model, tokenizer, vocabulary = self._loaded
        torch.set_num_threads(self._threads)
        prompts = [one.prompt for one in questions] if turns is None else turns
        replies = [
            Reply(
                [*prompt_ids(tokenizer, [{"role": turn["role"], "content": turn["content"]} for turn in prompt])],
                end=tokenizer.eos_token_id, longest=LONGEST, guide=Binding(vocabulary, grammar_of(one)),
                seed=chance.seeds[place] if chance else None, temperature=chance.temperature if chance else 1.0,
            )
            for place, (one, prompt) in enumerate(zip(questions, prompts, strict=True))
        ]  # fmt: skip
        for start in range(0, len(replies), SIDE_BY_SIDE):
            speak(model, replies[start : start + SIDE_BY_SIDE])
        return [tokenizer.decode(one.said, skip_special_tokens=True) for one in replies]

    def answer(self, question: Sample, chance: Chance | None = None) -> str:
        """The free answer to one question."""
        return self.answers([question], chance=chance)[0]

    @cached_property
    def _loaded(self) -> tuple[Any, Any, Any]:
        from dualbrain.adaptation.serving.constrained_decoding import vocabulary_of  # noqa: PLC0415
        from dualbrain.adaptation.serving.transformers_planner import dressed  # noqa: PLC0415

        model, tokenizer = dressed(self._stack, paths.cache())
        return model, tokenizer, vocabulary_of(tokenizer)


def grammar_of(question: Sample) -> str:
    """What a contract looks like in the scene of `question`."""
    setting = setting_of(question.scene)
    return contract_grammar(decoding_schema(setting.registry, setting.names))
