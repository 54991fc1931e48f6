"""A planner in transformers: the training twin of what serves, and for bases that the converter refuses.

Base and adapters in torch, in this process, float32; the same prompt, the same beginning and the same grammar as in
llama.cpp. Slower and larger (research: 2.4 times, 950 MB for the small model), so it is chosen by name only.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jsonschema_rs
import torch
from peft import PeftModel

from dualbrain.adaptation.bases import Base
from dualbrain.adaptation.fitting.base_model import open_base
from dualbrain.adaptation.fitting.batch import prompt_ids
from dualbrain.adaptation.serving.bound_decoding import BoundDecoding, OutOfTime, llguidance, vocabulary_of
from dualbrain.adaptation.serving.fitness import require_fit
from dualbrain.adaptation.serving.layers import Stack
from dualbrain.errors import InvalidSetup
from dualbrain.planner import protocol
from dualbrain.planner.asking import FREE_BY, Asking
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal
from dualbrain.weights import find_file


def dressed(stack: Stack, cache: Path) -> tuple[Any, Any]:
    """Model and tokenizer in float32; the top adapter is worn, what lies below is part of the base, as when fitted."""
    below = tuple(layer.folder for layer in stack.layers[:-1])
    base = Base(stack.base, stack.gguf, find_file(stack.base).sha256, below)
    model, tokenizer = open_base(base, cache, torch.float32)
    if stack.layers:
        model = PeftModel.from_pretrained(model, str(stack.layers[-1].folder)).eval()
    return model, tokenizer


@dataclass(frozen=True, slots=True)
class TorchConfig:
    """As `LlamaConfig`: processor threads, tokens of an answer, one time limit for a proposal with its load [s]."""

    threads: int = 1
    max_tokens: int = 640
    timeout_s: float = 600.0


class TorchPlanner:
    """Proposes with the adapters of `stack` on its dequantised base; loads with the first proposal."""

    def __init__(
        self, name: str, stack: Stack, cache: Path, asking: Asking, config: TorchConfig | None = None, *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """Nothing is read yet."""
        self.name, self.stack = name, stack
        self._cache, self._asking, self._config, self._clock = cache, asking, config or TorchConfig(), clock
        self._loaded: tuple[Any, Any, Any] | None = None

    @property
    def template(self) -> str:
        """Hash of the prompt's fixed text."""
        return self._asking.template()

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`. Raises `InvalidSetup` for a robot, vocabulary or schema that is not the adapter's."""
        if self.stack.layers:
            require_fit(self.stack.top, request.robot, request.registry_hash)
        grammar = self._grammar(request)
        begun = self._clock()
        model, tokenizer, vocabulary = self._load()
        loaded = self._clock()
        beginning = self._asking.beginning(request)
        turns = [{"role": turn["role"], "content": turn["content"]} for turn in self._asking.messages(request)]
        given = [*prompt_ids(tokenizer, turns)]
        given += tokenizer(beginning, add_special_tokens=False)["input_ids"] if beginning else []
        bound = [BoundDecoding(vocabulary, grammar, len(given))] if grammar else []
        until = OutOfTime(begun + self._config.timeout_s, self._clock)
        tokens = self._generate(model, tokenizer, given, bound, until, by_chance=self._by_chance(request))
        text = beginning + tokenizer.decode(tokens, skip_special_tokens=True)
        whole = bool(tokens) and tokens[-1] == tokenizer.eos_token_id
        finish = protocol.TIMEOUT if until.late and not whole else protocol.STOP if whole else protocol.LENGTH
        timings = {
            "load": loaded - begun, "decode": self._clock() - loaded, "prompt_tokens": float(len(given)),
            "output_tokens": float(len(tokens)), "total": self._clock() - begun,
        }  # fmt: skip
        said = text if finish != protocol.TIMEOUT else ""
        return Proposal(said, finish, self.name, self._constrained_by(request), timings)

    def close(self) -> None:
        """Let go of the model."""
        self._loaded = None

    @torch.no_grad()
    def _generate(
        self, model: Any, tokenizer: Any, given: list[int], bound: list[Any], until: OutOfTime, *, by_chance: bool
    ) -> list[int]:
        torch.set_num_threads(self._config.threads)
        torch.manual_seed(1)
        ids = torch.tensor([given])
        drawn = {"do_sample": True, "temperature": 1.0} if by_chance else {"do_sample": False, "temperature": None}
        padding = tokenizer.eos_token_id if tokenizer.pad_token_id is None else tokenizer.pad_token_id
        told = model.generate(
            input_ids=ids, attention_mask=torch.ones_like(ids), max_new_tokens=self._config.max_tokens, top_p=None,
            top_k=None, logits_processor=bound, stopping_criteria=[until], pad_token_id=padding,
            eos_token_id=tokenizer.eos_token_id, **drawn,
        )  # fmt: skip
        return told[0, len(given) :].tolist()

    def _load(self) -> tuple[Any, Any, Any]:
        if self._loaded is None:
            model, tokenizer = dressed(self.stack, self._cache)
            self._loaded = model, tokenizer, vocabulary_of(tokenizer)
        return self._loaded

    def _grammar(self, request: PlanRequest) -> str:
        if self._asking.grammar is None:
            return ""
        try:
            jsonschema_rs.validator_for(request.schema)
            return self._asking.grammar(request.schema)
        except (KeyError, TypeError, ValueError) as error:
            got = json.dumps(str(error))
            raise InvalidSetup("decoding schema", got=got, allowed="an object with action_sequence") from error

    def _by_chance(self, request: PlanRequest) -> bool:
        failed = request.refusal is not None or request.setback is not None
        return failed and not self._asking.hears_refusals

    def _constrained_by(self, request: PlanRequest) -> str:
        version = llguidance.get_version() if hasattr(llguidance, "get_version") else ""
        engine = f"llguidance {version} in transformers; header given".replace("  ", " ")
        engine = engine if self._asking.grammar is not None else FREE_BY
        return f"{engine}; drawn by chance after a failure" if self._by_chance(request) else engine
