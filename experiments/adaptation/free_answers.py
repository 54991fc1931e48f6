"""Unconstrained answers of a model with its adapters, in batches, by torch.

`benchmarks/serving_equality.py` compares the answers with those of llama.cpp. Decoding is unconstrained; the grammar of
the scene serves only for speculative decoding (`adaptation/serving/speculative_decoding.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from dualbrain.adaptation.adapters.stacking import AdapterStack
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.contracts.schema import decoding_schema
from dualbrain.core import paths
from dualbrain.planner.decoding.llguidance_grammar import contract_grammar
from dualbrain.runtime.data_collection.synthetic_scenes import scene_context_by_name

MAX_TOKENS = 400
"""Largest number of tokens of an answer; a contract for three goals takes about 330."""
BATCH_SIZE = 8

ChatTurns = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Sampling:
    """Sampled answers: the temperature, and a seed for each answer."""

    temperature: float
    seeds: Sequence[int]


class FreeAnswerModel:
    """The model of an adapter stack, loaded at the first request."""

    def __init__(self, stack: AdapterStack, threads: int = 1) -> None:
        """The model of `stack`, computed by `threads` threads."""
        self._stack, self._threads = stack, threads

    def generate(
        self, questions: Sequence[Sample], turns: Sequence[ChatTurns] | None = None, sampling: Sampling | None = None
    ) -> list[str]:
        """The answers to `questions`, by their own prompts or by `turns`; greedy without `sampling`."""
        import torch  # noqa: PLC0415  (heavy)

        from dualbrain.adaptation.serving.constrained_decoding import GrammarConstraint  # noqa: PLC0415
        from dualbrain.adaptation.serving.speculative_decoding import DecodingStream, generate  # noqa: PLC0415
        from dualbrain.adaptation.training.model.batching import tokenize_prompt  # noqa: PLC0415

        model, tokenizer, vocabulary = self._model
        torch.set_num_threads(self._threads)
        prompts = [one.prompt for one in questions] if turns is None else turns
        streams = [
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
        for start in range(0, len(streams), BATCH_SIZE):
            generate(model, streams[start : start + BATCH_SIZE])
        return [tokenizer.decode(one.output_tokens, skip_special_tokens=True) for one in streams]

    def generate_one(self, question: Sample, sampling: Sampling | None = None) -> str:
        """The answer to one request."""
        return self.generate([question], sampling=sampling)[0]

    @cached_property
    def _model(self) -> tuple[Any, Any, Any]:
        from dualbrain.adaptation.serving.constrained_decoding import llguidance_tokenizer  # noqa: PLC0415
        from dualbrain.adaptation.serving.transformers_planner import load_stacked_model  # noqa: PLC0415

        model, tokenizer = load_stacked_model(self._stack, paths.cache_folder())
        return model, tokenizer, llguidance_tokenizer(tokenizer)


def scene_grammar(question: Sample) -> str:
    """The grammar of contracts in the scene of `question`."""
    context = scene_context_by_name(question.scene)
    return contract_grammar(decoding_schema(context.registry, context.names))
