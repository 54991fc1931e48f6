"""A planner in transformers: the model as in training, and for bases that the llama.cpp converter rejects.

Base and adapters run in torch in this process, in float32, with the same prompt, answer prefix and grammar as in
llama.cpp. It needs more memory (950 MB for the small model) but decodes many questions at once and uses
`speculative_decoding`. It is selected by name only.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jsonschema_rs
import torch

from dualbrain.adaptation.adapters.base_models import BaseModel
from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.adaptation.adapters.compatibility import require_compatible
from dualbrain.adaptation.adapters.stacking import AdapterStack
from dualbrain.adaptation.serving.constrained_decoding import GrammarConstraint, llguidance, llguidance_tokenizer
from dualbrain.adaptation.serving.speculative_decoding import DecodingStream, generate
from dualbrain.adaptation.training.model.base_model import load_base_model
from dualbrain.adaptation.training.model.batching import tokenize_prompt
from dualbrain.core.weights import find_weight_file
from dualbrain.errors import ConfigurationError
from dualbrain.planner import protocol
from dualbrain.planner.decoding.llguidance_grammar import contract_grammar
from dualbrain.planner.prompt.full_prompt import ChatMessage
from dualbrain.planner.prompt.prompt_format import UNCONSTRAINED_BY, PromptFormat
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal


def load_stacked_model(stack: AdapterStack, cache: Path) -> tuple[Any, Any]:
    """Model and tokenizer in float32, with all adapters of `stack` merged into the weights.

    Raises `ConfigurationError` for an adapter that does not match the base, as the converter for llama.cpp does.
    """
    folders = tuple(layer.folder for layer in stack.layers)
    return load_base_model(
        BaseModel(
            name=stack.base, gguf=stack.gguf, gguf_sha256=find_weight_file(stack.base).sha256, stacked_on=folders
        ),
        cache,
        torch.float32,
    )


@dataclass(frozen=True, slots=True)
class TorchConfig:
    """As `LlamaConfig`: processor threads, maximum tokens of an answer, time limit of a proposal including loading [s].

    `batch_size` questions are decoded side by side; the time limit applies to the batch.
    """

    threads: int = 1
    max_tokens: int = 640
    timeout_s: float = 600.0
    batch_size: int = 8


class TorchPlanner:
    """Proposes with the adapters of `stack` on its dequantised base; the first proposal loads the model.

    It runs on a GPU if torch has one, else on the CPU.
    """

    def __init__(
        self,
        name: str,
        stack: AdapterStack,
        cache: Path,
        prompt_format: PromptFormat,
        config: TorchConfig | None = None,
        *,
        clock: Callable[[], float] = time.monotonic,
        narrowed_registries: Mapping[str, str] = {},
    ) -> None:
        """Read nothing yet.

        `narrowed_registries` maps narrower vocabularies to wider ones (see `require_compatible`).
        """
        self.name, self.stack = name, stack
        self._cache, self._prompt_format, self._config, self._clock = (
            cache,
            prompt_format,
            config or TorchConfig(),
            clock,
        )
        self._narrowed_registries = narrowed_registries
        self._loaded: tuple[Any, Any, Any] | None = None

    @property
    def card(self) -> AdapterCard | None:
        """The adapter that is served, None for a model without adapter."""
        return self.stack.top_card if self.stack.layers else None

    @property
    def template(self) -> str:
        """Hash of the prompt template."""
        return self._prompt_format.template_hash()

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`. Raises `ConfigurationError` for another robot, vocabulary or schema than the adapter's."""
        return self.propose_all([request])[0]

    def propose_all(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        """Answer each of `requests` as if it were the only one, `batch_size` of them side by side."""
        step = self._config.batch_size
        return [
            answer
            for start in range(0, len(requests), step)
            for answer in self._propose_batch(requests[start : start + step])
        ]

    def messages(self, request: PlanRequest) -> list[ChatMessage]:
        """The messages that the model receives for `request`, with the prefix of the answer."""
        prefix = self._prompt_format.answer_prefix(request)
        prefix_turn: list[ChatMessage] = [{"role": "assistant", "content": prefix}] if prefix else []
        return [*self._prompt_format.messages(request), *prefix_turn]

    def close(self) -> None:
        """Release the model."""
        self._loaded = None

    def _propose_batch(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        for request in requests:
            if self.stack.layers:
                require_compatible(self.stack.top_card, request.robot, request.registry_hash, self._narrowed_registries)
        grammars = [self._answer_grammar(request) for request in requests]
        start = self._clock()
        model, tokenizer, vocabulary = self._load_model()
        loaded = self._clock()
        streams = [
            self._make_stream(request, grammar, tokenizer, vocabulary)
            for request, grammar in zip(requests, grammars, strict=True)
        ]
        torch.set_num_threads(self._config.threads)
        generate(model, streams, lambda: self._clock() > start + self._config.timeout_s)
        timings = {"load": loaded - start, "decode": self._clock() - loaded, "total": self._clock() - start}
        timings["at_once"] = float(len(requests))
        return [
            self._proposal(request, stream, tokenizer, timings)
            for request, stream in zip(requests, streams, strict=True)
        ]

    def _make_stream(self, request: PlanRequest, grammar: str, tokenizer: Any, vocabulary: Any) -> DecodingStream:
        prefix = self._prompt_format.answer_prefix(request)
        turns = [{"role": turn["role"], "content": turn["content"]} for turn in self._prompt_format.messages(request)]
        prompt_tokens = [*tokenize_prompt(tokenizer, turns)]
        prompt_tokens += tokenizer(prefix, add_special_tokens=False)["input_ids"] if prefix else []
        constraint = GrammarConstraint(vocabulary, grammar) if grammar else None
        guide = None if grammar else GrammarConstraint(vocabulary, contract_grammar(request.schema))
        seed = self._prompt_format.sampling_seed(request)
        max_tokens = self._config.max_tokens
        return DecodingStream(
            prompt_tokens,
            end_token=tokenizer.eos_token_id,
            max_tokens=max_tokens,
            constraint=constraint,
            guide=guide,
            seed=seed,
        )

    def _proposal(
        self, request: PlanRequest, stream: DecodingStream, tokenizer: Any, timings: dict[str, float]
    ) -> Proposal:
        finish = protocol.STOP if stream.is_complete else protocol.LENGTH if stream.is_finished else protocol.TIMEOUT
        decoded = tokenizer.decode(stream.output_tokens, skip_special_tokens=True)
        text = self._prompt_format.contract_prefix(request) + decoded
        counts = {"prompt_tokens": float(len(stream.prompt_tokens)), "output_tokens": float(len(stream.output_tokens))}
        answer = text if finish != protocol.TIMEOUT else ""
        return Proposal(
            text=answer,
            finish_reason=finish,
            planner=self.name,
            constrained_by=self._constrained_by(request),
            timings=timings | counts,
        )

    def _load_model(self) -> tuple[Any, Any, Any]:
        if self._loaded is None:
            model, tokenizer = load_stacked_model(self.stack, self._cache)
            device = "cuda" if torch.cuda.is_available() else "cpu"
            self._loaded = model.to(device), tokenizer, llguidance_tokenizer(tokenizer)
        return self._loaded

    def _answer_grammar(self, request: PlanRequest) -> str:
        if self._prompt_format.grammar is None:
            return ""
        try:
            jsonschema_rs.validator_for(request.schema)
            return self._prompt_format.grammar(request.schema)
        except (KeyError, TypeError, ValueError) as error:
            problem = f"The decoding schema must be an object with action_sequence: {json.dumps(str(error))}."
            raise ConfigurationError.stating(problem) from error

    def _constrained_by(self, request: PlanRequest) -> str:
        version = llguidance.get_version() if hasattr(llguidance, "get_version") else ""
        note = self._prompt_format.header_note
        engine = f"llguidance {version} in transformers; {note}".replace("  ", " ")
        engine = engine if self._prompt_format.grammar is not None else UNCONSTRAINED_BY
        seed = self._prompt_format.sampling_seed(request)
        return engine if seed is None else f"{engine}; drawn by chance after a failure, seed {seed}"
