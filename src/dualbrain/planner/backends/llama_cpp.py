"""The default planner: a GGUF model in llama.cpp, in its own process, its answers bound to the contract's grammar."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jsonschema_rs

from dualbrain.errors import InvalidSetup, MissingPart
from dualbrain.planner import protocol
from dualbrain.planner.backends.http_chat import Answer, ask, post
from dualbrain.planner.backends.llama_process import DEFAULTS, LlamaConfig, LlamaProcess, Worn
from dualbrain.planner.backends.prompt_cache import PrefixStore
from dualbrain.planner.prompt.full_prompt import Message
from dualbrain.planner.prompt.prompt_format import CONSTRAINED_BY, FREE_BY, FULL, Asking
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal

__all__ = ["LlamaConfig", "LlamaPlanner", "Worn"]

WHOLE_DISTRIBUTION = {"top_k": 0, "top_p": 1.0, "min_p": 0.0}
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
        config: LlamaConfig = DEFAULTS,
        *,
        clock: Callable[[], float] = time.monotonic,
        asking: Asking = FULL,
        adapters: tuple[Worn, ...] = (),
    ) -> None:
        if find_spec("xllamacpp") is None:
            raise MissingPart("The package xllamacpp", fix="Install it with `pip install 'dualbrain[planner]'`.")
        if not model.is_file():
            raise MissingPart(f"The model file of {name!r}", fix=f"Name a GGUF file that exists. {model}")
        for one in adapters:
            if not one.path.is_file():
                raise MissingPart(f"The adapter file of {name!r}", fix=f"Make it again. {one.path}")
        self._name, self._model, self._config, self._clock = name, model, config, clock
        self._asking, self._adapters = asking, adapters
        self._child: LlamaProcess | None = self._start()

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
        return self._child.pid if self._child else None

    @property
    def template(self) -> str:
        """Hash of the prompt's fixed text."""
        return self._asking.template()

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`; a child that dies, hangs or cannot start becomes a finish reason.

        Raises `InvalidSetup` when `request.schema` is not the schema of a contract.
        """
        begun = self._clock()
        body = self._body(request)
        child = self._child = self._child or self._start()
        address, failure = child.address(self._config.timeout_s)
        store = self._store(child, address)
        rules = store.rules(request)
        if not failure and child.asked != rules:
            store.restore(request)
        loaded = self._clock()
        left = self._config.timeout_s - (loaded - begun)
        answer = failure or ask(f"{address}/v1/chat/completions", body, key=child.key, timeout_s=left)
        answer = self._after(child, request, answer)
        if answer.finish == protocol.STOP and child.asked != rules:
            child.asked = rules
            store.save(request)
        timings = {"load": loaded - begun, **answer.figures, "total": self._clock() - begun}
        finish = f"{answer.finish}: {answer.detail}" if answer.detail else answer.finish
        return Proposal(answer.text, finish, self._name, self._constrained_by(request), timings)

    def tell(self, path: str, body: dict[str, Any]) -> dict[str, Any] | Answer:
        """POST `body`, with the adapters, to `path` of the child's own interface; its answer, or why there is none."""
        child = self._child = self._child or self._start()
        told = self._told(child, path, body)
        return self._unless_lost(child, told) if isinstance(told, Answer) else told

    def question(self, request: PlanRequest) -> dict[str, Any]:
        """The body of the chat request that asks `request`."""
        beginning = self._asking.beginning(request)
        given = [{"role": "assistant", "content": beginning}] if beginning else []
        body: dict[str, Any] = {"messages": [*self._asking.messages(request), *given]}
        if self._asking.grammar is not None:
            body["grammar"] = self._asking.grammar(request.schema)
        kept = self._asking.steady and not self._adapters
        limits = {"max_tokens": self._config.max_tokens, "temperature": 0.0, "seed": 0, "cache_prompt": kept}
        if (seed := self._asking.draw(request)) is not None:
            limits |= {"temperature": 1.0, "seed": seed, **WHOLE_DISTRIBUTION}
        return body | limits | self._wearing()

    def messages(self, request: PlanRequest) -> list[Message]:
        """What the model reads for `request`, with the beginning of the answer that it is given."""
        return self.question(request)["messages"]

    def close(self) -> None:
        """End the child process."""
        if self._child is not None:
            self._child.close()
            self._child = None

    def _start(self) -> LlamaProcess:
        return LlamaProcess(self._model, self._config, self._adapters)

    def _told(self, child: LlamaProcess, path: str, body: dict[str, Any]) -> dict[str, Any] | Answer:
        address, failure = child.address(self._config.timeout_s)
        if failure:
            return failure
        data = json.dumps(body | {"cache_prompt": False} | self._wearing()).encode()
        reply = post(f"{address}{path}", data, key=child.key, timeout_s=self._config.timeout_s)
        if isinstance(reply, Answer):
            return reply
        status, said = reply
        if status != 200:
            return Answer("", protocol.ERROR, f"status {status}")
        try:
            return json.loads(said)
        except ValueError:
            return Answer("", protocol.ERROR, "no JSON")

    def _store(self, child: LlamaProcess, address: str) -> PrefixStore:
        folder = self._config.prefixes if self._asking.steady else None
        return PrefixStore(
            folder, self._model, self._config.n_ctx, address, child.key, asking=self._asking, adapters=self._adapters
        )  # fmt: skip

    def _wearing(self) -> dict[str, Any]:
        """All adapters of the process with their scales: an explicit list in each request, never a global switch."""
        told = [{"id": number, "scale": one.scale} for number, one in enumerate(self._adapters)]
        return {"lora": told} if told else {}

    def _constrained_by(self, request: PlanRequest) -> str:
        engine = FREE_BY if self._asking.grammar is None else CONSTRAINED_BY
        seed = self._asking.draw(request)
        return engine if seed is None else f"{engine}; drawn by chance after a failure, seed {seed}"

    def _body(self, request: PlanRequest) -> dict[str, Any]:
        try:
            body = self.question(request)
            jsonschema_rs.validator_for(request.schema)
        except (KeyError, TypeError, jsonschema_rs.ValidationError) as error:
            raise InvalidSetup("decoding schema", got=str(error), allowed="an object with action_sequence") from error
        return body

    def _after(self, child: LlamaProcess, request: PlanRequest, answer: Answer) -> Answer:
        """Put a lost child away, and refuse an answer that does not obey the grammar that was sent."""
        answer = self._unless_lost(child, answer)
        if answer.finish == protocol.STOP and self._asking.grammar and not _obeys(answer.text, request.schema):
            return Answer("", protocol.ERROR, "the grammar was not applied", answer.figures)
        return answer

    def _unless_lost(self, child: LlamaProcess, answer: Answer) -> Answer:
        """`answer`, or that the child died over it; a lost child is put away, so that the next question starts anew."""
        if answer.finish == protocol.ERROR and child.died():
            answer = child.crashed()
        if answer.finish in {protocol.TIMEOUT, protocol.CRASHED} or not child.ready:
            self.close()
        return answer


def _obeys(text: str, schema: dict[str, Any]) -> bool:
    """Whether `text` is what the grammar of `schema` admits; else the server has dropped the grammar."""
    try:
        return jsonschema_rs.validator_for(schema).is_valid(json.loads(text))
    except (ValueError, RecursionError):
        return False
