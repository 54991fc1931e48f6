"""The default planner: a GGUF model in llama.cpp in a separate process, constrained by the contract grammar."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jsonschema_rs

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.planner import protocol
from dualbrain.planner.backends.http_chat import ChatResponse, post, request_completion
from dualbrain.planner.backends.llama_process import DEFAULT_CONFIG, LlamaConfig, LlamaProcess, LoadedAdapter
from dualbrain.planner.backends.prompt_cache import PromptCache
from dualbrain.planner.backends.token_server import TokenServer
from dualbrain.planner.decoding.jump_forward import JumpForwardDecoder, JumpForwardError
from dualbrain.planner.prompt.full_prompt import ChatMessage
from dualbrain.planner.prompt.prompt_format import CONSTRAINED_BY, LOCAL_FULL_PROMPT, UNCONSTRAINED_BY, PromptFormat
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal

__all__ = ["LlamaConfig", "LlamaPlanner", "LoadedAdapter"]

UNTRUNCATED_SAMPLING = {"top_k": 0, "top_p": 1.0, "min_p": 0.0}
"""Sampling from the full distribution of the model, as in torch; llama.cpp would cut off its tail."""


class LlamaPlanner:
    """Proposes with the GGUF model at `model` and LoRA `adapters` (GGUF files for this model).

    The worker process starts immediately and loads the model while the caller continues; after a crash or a timeout,
    the next request starts a new process. The worker listens on loopback only, with a random key. Every request lists
    all adapters with their scales. With adapters, no cached state is reused: answers from stale caches are a known
    fault (llama.cpp #26207), and the division of a prompt into batches decides near-ties. An answer therefore depends
    on model, adapters and request alone. Raises `MissingDependencyError` if xllamacpp or a file is missing.
    """

    def __init__(
        self,
        name: str,
        model: Path,
        config: LlamaConfig = DEFAULT_CONFIG,
        *,
        clock: Callable[[], float] = time.monotonic,
        prompt_format: PromptFormat = LOCAL_FULL_PROMPT,
        adapters: tuple[LoadedAdapter, ...] = (),
    ) -> None:
        if find_spec("xllamacpp") is None:
            raise MissingDependencyError(
                "The package xllamacpp", fix="Install it with `pip install 'dualbrain[planner]'`."
            )
        if not model.is_file():
            raise MissingDependencyError(f"The model file of {name!r}", fix=f"Name an existing GGUF file. {model}")
        for one in adapters:
            if not one.path.is_file():
                raise MissingDependencyError(
                    f"The adapter file of {name!r}", fix=f"Export the adapter again. {one.path}"
                )
        self._name, self._model, self._config, self._clock = name, model, config, clock
        self._prompt_format, self._adapters = prompt_format, adapters
        self._show: Callable[[str], None] = lambda text: None
        self._process: LlamaProcess | None = self._start()

    @property
    def name(self) -> str:
        """Name of the model."""
        return self._name

    @property
    def model(self) -> Path:
        """Path of the GGUF file."""
        return self._model

    @property
    def pid(self) -> int | None:
        """Process id of the worker, None without a worker."""
        return self._process.pid if self._process else None

    @property
    def template(self) -> str:
        """Hash of the fixed text of the prompt."""
        return self._prompt_format.template_hash()

    def show_answers(self, show: Callable[[str], None]) -> None:
        """Call `show` with the text of an answer while it is generated.

        The text is for display only: it is incomplete, unchecked, and may be replaced by another one.
        """
        self._show = show

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`; a worker that dies, hangs or cannot start becomes the finish reason.

        Raises `ConfigurationError` if `request.schema` is not the decoding schema of a contract.
        """
        start = self._clock()
        body = self._checked_request(request)
        worker = self._process = self._process or self._start()
        address, failure = worker.wait_for_address(self._config.timeout_s)
        cache = self._prompt_cache(worker, address)
        state = cache.state_path(request)
        if not failure and state != worker.state:
            cache.restore(request, worker.state)
        loaded = self._clock()
        deadline = start + self._config.timeout_s
        complete = partial(self._prompt_format.complete, request)
        response = failure or self._jump_forward(worker, address, body, complete, timeout_s=deadline - loaded)
        if response is None:
            url, remaining_s = f"{address}/v1/chat/completions", deadline - self._clock()
            response = request_completion(url, body, key=worker.key, timeout_s=remaining_s)
            response = replace(response, text=complete(response.text))
        response = self._check_response(worker, request, response)
        if response.finish_reason == protocol.STOP and state != worker.state:
            worker.state = state
            cache.save(request)
        timings = {"load": loaded - start, **response.metrics, "total": self._clock() - start}
        detail = f": {response.detail}" if response.detail else ""
        return Proposal(
            text=response.text,
            finish_reason=response.finish_reason + detail,
            planner=self._name,
            constrained_by=self._constrained_by(request),
            timings=timings,
        )

    def post_json(self, path: str, body: dict[str, Any]) -> dict[str, Any] | ChatResponse:
        """POST `body` with the adapters to `path` of the worker; returns its JSON, or the response for a failure."""
        worker = self._process = self._process or self._start()
        reply = self._post(worker, path, body)
        return self._discard_lost_process(worker, reply) if isinstance(reply, ChatResponse) else reply

    def chat_request(self, request: PlanRequest) -> dict[str, Any]:
        """The body of the HTTP request for `request`."""
        prefix = self._prompt_format.answer_prefix(request)
        prefill = [{"role": "assistant", "content": prefix}] if prefix else []
        body: dict[str, Any] = {"messages": [*self._prompt_format.messages(request), *prefill]}
        if self._prompt_format.grammar is not None:
            body["grammar"] = self._prompt_format.grammar(request.schema)
        cached = self._prompt_format.has_fixed_prefix and not self._adapters
        limits = {"max_tokens": self._config.max_tokens, "temperature": 0.0, "seed": 0, "cache_prompt": cached}
        if (seed := self._prompt_format.sampling_seed(request)) is not None:
            limits |= {"temperature": 1.0, "seed": seed, **UNTRUNCATED_SAMPLING}
        return body | limits | self._adapter_options()

    def messages(self, request: PlanRequest) -> list[ChatMessage]:
        """The messages for `request`, including the given beginning of the answer."""
        return self.chat_request(request)["messages"]

    def close(self) -> None:
        """Stop the worker process."""
        if self._process is not None:
            self._process.close()
            self._process = None

    def _start(self) -> LlamaProcess:
        return LlamaProcess(self._model, self._config, self._adapters)

    def _jump_forward(
        self,
        worker: LlamaProcess,
        address: str,
        body: dict[str, Any],
        complete: Callable[[str], str],
        *,
        timeout_s: float,
    ) -> ChatResponse | None:
        """The response to `body` by jump-forward decoding; None if it must be decoded token by token.

        `complete` converts the text of the model, with the given beginning, to that of a contract.
        """
        if not self._config.jump_forward or "grammar" not in body or body["temperature"] > 0.0:
            return None
        server = TokenServer(
            address, worker.key, self._adapter_options(), reuse_prompt=body["cache_prompt"], timeout_s=timeout_s
        )
        given = body["messages"][-1]["content"]
        decoder = JumpForwardDecoder(
            grammar=body["grammar"],
            tokenize=server.tokenize,
            candidates=server.candidates,
            max_tokens=body["max_tokens"],
            show=lambda text: self._show(complete(given + text)),
        )
        try:
            server.read_prompt(body["messages"])
            text = complete(given + decoder.decode())
        except TimeoutError:
            return ChatResponse(text="", finish_reason=protocol.TIMEOUT)
        except JumpForwardError:
            return None
        finally:
            server.close()
        finish_reason = protocol.STOP if decoder.is_complete else protocol.LENGTH
        metrics = server.metrics | {"output_tokens": float(len(decoder.tokens))}
        return ChatResponse(text=text, finish_reason=finish_reason, metrics=metrics)

    def _post(self, worker: LlamaProcess, path: str, body: dict[str, Any]) -> dict[str, Any] | ChatResponse:
        address, failure = worker.wait_for_address(self._config.timeout_s)
        if failure:
            return failure
        data = json.dumps(body | {"cache_prompt": False} | self._adapter_options()).encode()
        reply = post(f"{address}{path}", data, key=worker.key, timeout_s=self._config.timeout_s)
        if isinstance(reply, ChatResponse):
            return reply
        status, content = reply
        if status != 200:
            return ChatResponse(text="", finish_reason=protocol.ERROR, detail=f"status {status}")
        try:
            return json.loads(content)
        except ValueError:
            return ChatResponse(text="", finish_reason=protocol.ERROR, detail="no JSON")

    def _prompt_cache(self, worker: LlamaProcess, address: str) -> PromptCache:
        folder = self._config.prompt_cache if self._prompt_format.has_fixed_prefix else None
        return PromptCache(
            folder,
            self._model,
            self._config.n_ctx,
            address,
            worker.key,
            prompt_format=self._prompt_format,
            loaded_file=worker.loaded_file,
            adapters=self._adapters,
        )

    def _adapter_options(self) -> dict[str, Any]:
        """All adapters of the worker with their scales; each request lists them, instead of a global setting."""
        adapters = [{"id": number, "scale": one.scale} for number, one in enumerate(self._adapters)]
        return {"lora": adapters} if adapters else {}

    def _constrained_by(self, request: PlanRequest) -> str:
        constrained = f"{CONSTRAINED_BY}; {self._prompt_format.header_note}"
        engine = UNCONSTRAINED_BY if self._prompt_format.grammar is None else constrained
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

    def _check_response(self, worker: LlamaProcess, request: PlanRequest, response: ChatResponse) -> ChatResponse:
        """Discard a lost worker, and reject a response that does not satisfy the grammar that was sent."""
        response = self._discard_lost_process(worker, response)
        if (
            response.finish_reason == protocol.STOP
            and self._prompt_format.grammar
            and not _matches_schema(response.text, request.schema)
        ):
            return ChatResponse(
                text="", finish_reason=protocol.ERROR, detail="the grammar was not applied", metrics=response.metrics
            )
        return response

    def _discard_lost_process(self, worker: LlamaProcess, response: ChatResponse) -> ChatResponse:
        """`response`, or the crash of the worker; a lost worker is discarded, and the next request starts a new one."""
        if response.finish_reason == protocol.ERROR and worker.has_exited():
            response = worker.crash_response()
        if response.finish_reason in {protocol.TIMEOUT, protocol.CRASHED} or not worker.is_ready:
            self.close()
        return response


def _matches_schema(text: str, schema: dict[str, Any]) -> bool:
    """Whether `text` satisfies `schema`; if not, the server has dropped the grammar."""
    try:
        return jsonschema_rs.validator_for(schema).is_valid(json.loads(text))
    except (ValueError, RecursionError):
        return False
