"""A planner in transformers: the training twin of what serves, and for bases that the converter refuses.

Base and adapters in torch, in this process, float32; the same prompt, the same beginning and the same grammar as in
llama.cpp. Larger (950 MB for the small model), but many questions may be asked at once, and what is forced or foreseen
is given ahead (`ahead.py`). It is chosen by name only.
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
    """Model and tokenizer in float32, with all adapters of `stack` in its weights, read as they are for llama.cpp.

    Raises `InvalidSetup` for an adapter that has no place in the base, as the converter for llama.cpp does.
    """
    worn = tuple(layer.folder for layer in stack.layers)
    return load_base_model(
        BaseModel(name=stack.base, gguf=stack.gguf, gguf_sha256=find_weight_file(stack.base).sha256, stacked_on=worn),
        cache,
        torch.float32,
    )


@dataclass(frozen=True, slots=True)
class TorchConfig:
    """As `LlamaConfig`: processor threads, tokens of an answer, one time limit for a proposal with its load [s].

    `at_once`: questions that are asked side by side, where many are waiting; the time limit is that of all of these.
    """

    threads: int = 1
    max_tokens: int = 640
    timeout_s: float = 600.0
    batch_size: int = 8


class TorchPlanner:
    """Proposes with the adapters of `stack` on its dequantised base; loads with the first proposal.

    On a GPU where torch has one, else on the processor.
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
        """Nothing is read yet. An adapter also answers in the vocabularies of `narrowed`."""
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
        """The adapter that is served, None for a bare model."""
        return self.stack.top_card if self.stack.layers else None

    @property
    def template(self) -> str:
        """Hash of the prompt's fixed text."""
        return self._prompt_format.template_hash()

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`. Raises `InvalidSetup` for a robot, vocabulary or schema that is not the adapter's."""
        return self.propose_all([request])[0]

    def propose_all(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        """Answer each of `requests` as if it were the only one, `at_once` of them side by side."""
        step = self._config.batch_size
        return [
            answer
            for start in range(0, len(requests), step)
            for answer in self._propose_batch(requests[start : start + step])
        ]

    def messages(self, request: PlanRequest) -> list[ChatMessage]:
        """What the model reads for `request`, with the beginning of the answer that it is given."""
        beginning = self._prompt_format.answer_prefix(request)
        given: list[ChatMessage] = [{"role": "assistant", "content": beginning}] if beginning else []
        return [*self._prompt_format.messages(request), *given]

    def close(self) -> None:
        """Let go of the model."""
        self._loaded = None

    def _propose_batch(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        for request in requests:
            if self.stack.layers:
                require_compatible(self.stack.top_card, request.robot, request.registry_hash, self._narrowed_registries)
        grammars = [self._answer_grammar(request) for request in requests]
        begun = self._clock()
        model, tokenizer, vocabulary = self._load_model()
        loaded = self._clock()
        beginnings = [self._prompt_format.answer_prefix(request) for request in requests]
        replies = [
            self._make_stream(request, beginning, grammar, tokenizer, vocabulary)
            for request, beginning, grammar in zip(requests, beginnings, grammars, strict=True)
        ]
        torch.set_num_threads(self._config.threads)
        generate(model, replies, lambda: self._clock() > begun + self._config.timeout_s)
        took = {"load": loaded - begun, "decode": self._clock() - loaded, "total": self._clock() - begun}
        took["at_once"] = float(len(requests))
        return [
            self._proposal(request, reply, beginning, tokenizer, took)
            for request, reply, beginning in zip(requests, replies, beginnings, strict=True)
        ]

    def _make_stream(
        self, request: PlanRequest, beginning: str, grammar: str, tokenizer: Any, vocabulary: Any
    ) -> DecodingStream:
        turns = [{"role": turn["role"], "content": turn["content"]} for turn in self._prompt_format.messages(request)]
        given = [*tokenize_prompt(tokenizer, turns)]
        given += tokenizer(beginning, add_special_tokens=False)["input_ids"] if beginning else []
        bound = GrammarConstraint(vocabulary, grammar) if grammar else None
        guide = None if grammar else GrammarConstraint(vocabulary, contract_grammar(request.schema))
        seed = self._prompt_format.sampling_seed(request)
        longest = self._config.max_tokens
        return DecodingStream(
            given, end_token=tokenizer.eos_token_id, max_tokens=longest, constraint=bound, guide=guide, seed=seed
        )

    def _proposal(
        self, request: PlanRequest, reply: DecodingStream, beginning: str, tokenizer: Any, took: dict[str, float]
    ) -> Proposal:
        finish = protocol.STOP if reply.is_complete else protocol.LENGTH if reply.is_finished else protocol.TIMEOUT
        text = beginning + tokenizer.decode(reply.output_tokens, skip_special_tokens=True)
        counts = {"prompt_tokens": float(len(reply.prompt_tokens)), "output_tokens": float(len(reply.output_tokens))}
        said = text if finish != protocol.TIMEOUT else ""
        return Proposal(
            text=said,
            finish_reason=finish,
            planner=self.name,
            constrained_by=self._constrained_by(request),
            timings=took | counts,
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
            got = json.dumps(str(error))
            raise ConfigurationError("decoding schema", got=got, allowed="an object with action_sequence") from error

    def _constrained_by(self, request: PlanRequest) -> str:
        version = llguidance.get_version() if hasattr(llguidance, "get_version") else ""
        engine = f"llguidance {version} in transformers; header given".replace("  ", " ")
        engine = engine if self._prompt_format.grammar is not None else UNCONSTRAINED_BY
        seed = self._prompt_format.sampling_seed(request)
        return engine if seed is None else f"{engine}; drawn by chance after a failure, seed {seed}"
