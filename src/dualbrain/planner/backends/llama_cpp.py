"""The default planner: a GGUF model in llama.cpp, in its own process, its answers bound to the contract's grammar."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jsonschema_rs

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.planner import protocol
from dualbrain.planner.backends.http_chat import ChatResponse, post, request_completion
from dualbrain.planner.backends.llama_process import DEFAULT_CONFIG, LlamaConfig, LlamaProcess, LoadedAdapter
from dualbrain.planner.backends.prompt_cache import PromptCache
from dualbrain.planner.prompt.full_prompt import ChatMessage
from dualbrain.planner.prompt.prompt_format import CONSTRAINED_BY, FULL_PROMPT, UNCONSTRAINED_BY, PromptFormat
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal

__all__ = ["LlamaConfig", "LlamaPlanner", "LoadedAdapter"]

UNTRUNCATED_SAMPLING = {"top_k": 0, "top_p": 1.0, "min_p": 0.0}
"""What is drawn is drawn from what the model says, as in torch; llama.cpp would cut the tail off."""


class LlamaPlanner:
    """Proposes with the GGUF model at `model`, wearing `adapters` (GGUF-LoRA files made for it).

    The child process is started at once and loads while the caller goes on; one that has died or was killed after a
    timeout is started again by the next question. It listens on loopback only, behind a random key. Every request names
    every adapter and its scale, and nothing that was read before is used again with adapters: they are known to answer
    from stale caches (llama.cpp #26207), and how a prompt is cut into batches decides near-ties. So an answer depends
    on model, adapters and question alone. Raises `MissingPart` when xllamacpp is not installed or a file is not there.
    """

    def __init__(
        self,
        name: str,
        model: Path,
        config: LlamaConfig = DEFAULT_CONFIG,
        *,
        clock: Callable[[], float] = time.monotonic,
        prompt_format: PromptFormat = FULL_PROMPT,
        adapters: tuple[LoadedAdapter, ...] = (),
    ) -> None:
        if find_spec("xllamacpp") is None:
            raise MissingDependencyError(
                "The package xllamacpp", fix="Install it with `pip install 'dualbrain[planner]'`."
            )
        if not model.is_file():
            raise MissingDependencyError(f"The model file of {name!r}", fix=f"Name a GGUF file that exists. {model}")
        for one in adapters:
            if not one.path.is_file():
                raise MissingDependencyError(f"The adapter file of {name!r}", fix=f"Make it again. {one.path}")
        self._name, self._model, self._config, self._clock = name, model, config, clock
        self._prompt_format, self._adapters = prompt_format, adapters
        self._process: LlamaProcess | None = self._start()

    @property
    def name(self) -> str:
        """Name of the model."""
        return self._name

    @property
    def model(self) -> Path:
        """The GGUF file that it runs."""
        return self._model

    @property
    def pid(self) -> int | None:
        """Process id of the child, None while there is none."""
        return self._process.pid if self._process else None

    @property
    def template(self) -> str:
        """Hash of the prompt's fixed text."""
        return self._prompt_format.template_hash()

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`; a child that dies, hangs or cannot start becomes a finish reason.

        Raises `InvalidSetup` when `request.schema` is not the schema of a contract.
        """
        begun = self._clock()
        body = self._checked_request(request)
        child = self._process = self._process or self._start()
        address, failure = child.wait_for_address(self._config.timeout_s)
        store = self._prompt_cache(child, address)
        rules = store.rules_key(request)
        if not failure and child.cached_rules != rules:
            store.restore(request)
        loaded = self._clock()
        left = self._config.timeout_s - (loaded - begun)
        answer = failure or request_completion(f"{address}/v1/chat/completions", body, key=child.key, timeout_s=left)
        answer = self._check_response(child, request, answer)
        if answer.finish_reason == protocol.STOP and child.cached_rules != rules:
            child.cached_rules = rules
            store.save(request)
        timings = {"load": loaded - begun, **answer.metrics, "total": self._clock() - begun}
        finish = f"{answer.finish_reason}: {answer.detail}" if answer.detail else answer.finish_reason
        return Proposal(
            text=answer.text,
            finish_reason=finish,
            planner=self._name,
            constrained_by=self._constrained_by(request),
            timings=timings,
        )

    def post_json(self, path: str, body: dict[str, Any]) -> dict[str, Any] | ChatResponse:
        """POST `body`, with the adapters, to `path` of the child's own interface; its answer, or why there is none."""
        child = self._process = self._process or self._start()
        told = self._post(child, path, body)
        return self._replace_lost_process(child, told) if isinstance(told, ChatResponse) else told

    def chat_request(self, request: PlanRequest) -> dict[str, Any]:
        """The body of the chat request that asks `request`."""
        beginning = self._prompt_format.answer_prefix(request)
        given = [{"role": "assistant", "content": beginning}] if beginning else []
        body: dict[str, Any] = {"messages": [*self._prompt_format.messages(request), *given]}
        if self._prompt_format.grammar is not None:
            body["grammar"] = self._prompt_format.grammar(request.schema)
        kept = self._prompt_format.has_fixed_prefix and not self._adapters
        limits = {"max_tokens": self._config.max_tokens, "temperature": 0.0, "seed": 0, "cache_prompt": kept}
        if (seed := self._prompt_format.sampling_seed(request)) is not None:
            limits |= {"temperature": 1.0, "seed": seed, **UNTRUNCATED_SAMPLING}
        return body | limits | self._adapter_options()

    def messages(self, request: PlanRequest) -> list[ChatMessage]:
        """What the model reads for `request`, with the beginning of the answer that it is given."""
        return self.chat_request(request)["messages"]

    def close(self) -> None:
        """End the child process."""
        if self._process is not None:
            self._process.close()
            self._process = None

    def _start(self) -> LlamaProcess:
        return LlamaProcess(self._model, self._config, self._adapters)

    def _post(self, child: LlamaProcess, path: str, body: dict[str, Any]) -> dict[str, Any] | ChatResponse:
        address, failure = child.wait_for_address(self._config.timeout_s)
        if failure:
            return failure
        data = json.dumps(body | {"cache_prompt": False} | self._adapter_options()).encode()
        reply = post(f"{address}{path}", data, key=child.key, timeout_s=self._config.timeout_s)
        if isinstance(reply, ChatResponse):
            return reply
        status, said = reply
        if status != 200:
            return ChatResponse(text="", finish_reason=protocol.ERROR, detail=f"status {status}")
        try:
            return json.loads(said)
        except ValueError:
            return ChatResponse(text="", finish_reason=protocol.ERROR, detail="no JSON")

    def _prompt_cache(self, child: LlamaProcess, address: str) -> PromptCache:
        folder = self._config.prompt_cache if self._prompt_format.has_fixed_prefix else None
        return PromptCache(
            folder,
            self._model,
            self._config.n_ctx,
            address,
            child.key,
            prompt_format=self._prompt_format,
            adapters=self._adapters,
        )

    def _adapter_options(self) -> dict[str, Any]:
        """All adapters of the process with their scales: an explicit list in each request, never a global switch."""
        told = [{"id": number, "scale": one.scale} for number, one in enumerate(self._adapters)]
        return {"lora": told} if told else {}

    def _constrained_by(self, request: PlanRequest) -> str:
        engine = UNCONSTRAINED_BY if self._prompt_format.grammar is None else CONSTRAINED_BY
        seed = self._prompt_format.sampling_seed(request)
        return engine if seed is None else f"{engine}; drawn by chance after a failure, seed {seed}"

    def _checked_request(self, request: PlanRequest) -> dict[str, Any]:
        try:
            body = self.chat_request(request)
            jsonschema_rs.validator_for(request.schema)
        except (KeyError, TypeError, jsonschema_rs.ValidationError) as error:
            raise ConfigurationError(
                "decoding schema", got=str(error), allowed="an object with action_sequence"
            ) from error
        return body

    def _check_response(self, child: LlamaProcess, request: PlanRequest, answer: ChatResponse) -> ChatResponse:
        """Put a lost child away, and refuse an answer that does not obey the grammar that was sent."""
        answer = self._replace_lost_process(child, answer)
        if (
            answer.finish_reason == protocol.STOP
            and self._prompt_format.grammar
            and not _matches_schema(answer.text, request.schema)
        ):
            return ChatResponse(
                text="", finish_reason=protocol.ERROR, detail="the grammar was not applied", metrics=answer.metrics
            )
        return answer

    def _replace_lost_process(self, child: LlamaProcess, answer: ChatResponse) -> ChatResponse:
        """`answer`, or that the child died over it; a lost child is put away, so that the next question starts anew."""
        if answer.finish_reason == protocol.ERROR and child.has_exited():
            answer = child.crash_response()
        if answer.finish_reason in {protocol.TIMEOUT, protocol.CRASHED} or not child.is_ready:
            self.close()
        return answer


def _matches_schema(text: str, schema: dict[str, Any]) -> bool:
    """Whether `text` is what the grammar of `schema` admits; else the server has dropped the grammar."""
    try:
        return jsonschema_rs.validator_for(schema).is_valid(json.loads(text))
    except (ValueError, RecursionError):
        return False
