"""A model with its adapters that answers freely, many questions side by side: in torch, which says what llama.cpp says.

`benchmarks/serving_equality.py` has the comparison. Nothing binds an answer; the grammar of the question's scene only
foresees it (`adaptation/serving/speculative_decoding.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from dualbrain.adaptation.adapters.stacking import AdapterStack
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.cli.common import paths
from dualbrain.contracts.schema import decoding_schema
from dualbrain.planner.decoding.llguidance_grammar import contract_grammar
from dualbrain.runtime.data_collection.synthetic_scenes import scene_context_by_name

MAX_TOKENS = 400
"""Tokens of an answer: three things put away take some 330."""
BATCH_SIZE = 8

ChatTurns = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Sampling:
    """Answers are drawn: at which temperature, and by which seed each."""

    temperature: float
    seeds: Sequence[int]


class FreeAnswerModel:
    """The model of `stack`; it is loaded by the first question."""

    def __init__(self, stack: AdapterStack, threads: int = 1) -> None:
        """Nothing is read yet."""
        self._stack, self._threads = stack, threads

    def generate(
        self, questions: Sequence[Sample], turns: Sequence[ChatTurns] | None = None, sampling: Sampling | None = None
    ) -> list[str]:
        """The free answers to `questions`, each asked by its own prompt or its `turns`; greedy unless by `chance`."""
        import torch  # noqa: PLC0415  (only where it is asked)

        from dualbrain.adaptation.serving.constrained_decoding import GrammarConstraint  # noqa: PLC0415
        from dualbrain.adaptation.serving.speculative_decoding import DecodingStream, generate  # noqa: PLC0415
        from dualbrain.adaptation.training.model.batching import tokenize_prompt  # noqa: PLC0415

        model, tokenizer, vocabulary = self._model
        torch.set_num_threads(self._threads)
        prompts = [one.prompt for one in questions] if turns is None else turns
        replies = [
            DecodingStream(
                [*tokenize_prompt(tokenizer, [{"role": turn["role"], "content": turn["content"]} for turn in prompt])],
                end_token=tokenizer.eos_token_id,
                max_tokens=MAX_TOKENS,
                guide=GrammarConstraint(vocabulary, scene_grammar(one)),
                seed=sampling.seeds[place] if sampling else None,
                temperature=sampling.temperature if sampling else 1.0,
            )
            for place, (one, prompt) in enumerate(zip(questions, prompts, strict=True))
        ]
        for start in range(0, len(replies), BATCH_SIZE):
            generate(model, replies[start : start + BATCH_SIZE])
        return [tokenizer.decode(one.output_tokens, skip_special_tokens=True) for one in replies]

    def generate_one(self, question: Sample, sampling: Sampling | None = None) -> str:
        """The free answer to one question."""
        return self.generate([question], sampling=sampling)[0]

    @cached_property
    def _model(self) -> tuple[Any, Any, Any]:
        from dualbrain.adaptation.serving.constrained_decoding import llguidance_tokenizer  # noqa: PLC0415
        from dualbrain.adaptation.serving.transformers_planner import load_stacked_model  # noqa: PLC0415

        model, tokenizer = load_stacked_model(self._stack, paths.cache_folder())
        return model, tokenizer, llguidance_tokenizer(tokenizer)


def scene_grammar(question: Sample) -> str:
    """What a contract looks like in the scene of `question`."""
    setting = scene_context_by_name(question.scene)
    return contract_grammar(decoding_schema(setting.registry, setting.names))
