"""Contract bytes at the gate, and answers of language models."""

from __future__ import annotations

import json
from functools import partial

import msgspec

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.gate.strict_json import parse
from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.control.gatekeeper.gate.contract_checker import ContractChecker
from dualbrain.control.gatekeeper.gate.exchange import GateRequest
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.grounding.vocabulary import load_skill_registry, planner_grants, scene_names
from dualbrain.planner import protocol
from dualbrain.planner.backends.http_chat import ChatResponse, parse_completion, strip_fence
from dualbrain.planner.backends.ollama import parse_chat
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.interfaces.untrusted_bytes.interface import (
    ALWAYS_REFUSED,
    ByteInterface,
    Surprise,
    refuse_if,
    require_usable,
)
from experiments.interfaces.untrusted_bytes.mutation import JSON, mutate_text
from experiments.safety.closed_loop import pick_and_place_actions

STRICT = ALWAYS_REFUSED | {"truncated", "empty", "wrong shape", "wrong type", "huge", "long", "unicode", "negative"}
"""Kinds that no place of a contract may take: every value has a domain."""


def contract_interfaces(checker: ContractChecker, request: GateRequest) -> dict[str, ByteInterface]:
    """Interfaces by name; `request` is valid apart from its contract."""
    registry = load_skill_registry("panda")
    context = {"robot": registry.robot, "registry": registry.hash}
    document = {"id": "c-0001", "context": context, "action_sequence": pick_and_place_actions(speed=0.2)}
    valid = msgspec.json.encode(document)
    names = scene_names(scene_from_spec(open_scene("tabletop:1")))
    gate = Gate(registry, planner_grants(registry))
    numbers = iter(range(1, 1 << 40))

    def at_gate(data: bytes) -> None:
        verdict = gate.check(data, names=names, principal=PLANNER, now=0.0)
        refuse_if(isinstance(verdict, Rejected), verdict)
        require_usable(verdict, visible=True)

    def at_checker(data: bytes) -> None:
        stamp = msgspec.structs.replace(request.stamp, sequence=next(numbers))
        verdict = checker.check(msgspec.structs.replace(request, contract=data, stamp=stamp))
        if isinstance(verdict, Rejected) and verdict.hint in ("the gate failed", "a rule failed"):
            raise Surprise(f"the gate raised: {verdict.got}")
        refuse_if(not isinstance(verdict, Accepted), verdict)
        require_usable(verdict, visible=True)

    def strict_json(data: bytes) -> None:
        found = parse(data)
        refuse_if(isinstance(found, Rejected), found)
        require_usable(found)

    bounds = partial(mutate_text, data=valid, syntax=JSON)
    return {
        "contract at the gate": ByteInterface(mutate=_keyed(bounds), read=at_gate, refuses=STRICT),
        "contract in the gate process": ByteInterface(
            mutate=_keyed(bounds), read=at_checker, refuses=STRICT, share=0.2
        ),
        "strict JSON": ByteInterface(
            mutate=_keyed(bounds),
            read=strict_json,
            refuses=frozenset({"infinite", "truncated", "compressed", "no bytes"}),
        ),
        **_answers(valid, at_gate),
    }


def _keyed(mutate: partial[bytes | None]):
    return lambda kind, rng: mutate(kind, rng=rng)


def _answers(contract: bytes, at_gate) -> dict[str, ByteInterface]:
    """Answers of servers: their text goes to the gate; everything else in them is read with bounds."""
    text = contract.decode()
    usage = {"prompt_tokens": 812, "completion_tokens": 96}
    timings = {"prompt_ms": 12.5, "predicted_ms": 300.0, "cache_n": 4}
    message = {"role": "assistant", "content": text}
    completion = {
        "choices": [{"message": message, "finish_reason": "stop"}],
        "usage": usage,
        "timings": timings,
        "system_fingerprint": "b1234",
    }
    chat = {"message": message, "done": True, "done_reason": "stop", "eval_count": 96, "eval_duration": 3_000_000}

    def answer(parse_answer):
        def read(data: bytes) -> None:
            found: ChatResponse = parse_answer(data)
            require_usable(found.metrics)
            refuse_if(found.finish_reason != protocol.STOP, found.finish_reason)
            at_gate(strip_fence(found.text)[0].encode("utf-8", "replace"))

        return read

    def fenced(data: bytes) -> None:
        at_gate(strip_fence(data.decode("utf-8", "replace"))[0].encode("utf-8", "replace"))

    not_contract = frozenset({"truncated", "compressed", "no bytes"})
    return {
        "completion of a server": ByteInterface(
            mutate=_keyed(partial(mutate_text, data=json.dumps(completion).encode(), syntax=JSON)),
            read=answer(parse_completion),
            refuses=not_contract,
        ),
        "chat of ollama": ByteInterface(
            mutate=_keyed(partial(mutate_text, data=json.dumps(chat).encode(), syntax=JSON)),
            read=answer(parse_chat),
            refuses=not_contract,
        ),
        "fenced answer": ByteInterface(
            mutate=_keyed(partial(mutate_text, data=b"```json\n" + contract + b"\n```", syntax=JSON)),
            read=fenced,
            refuses=STRICT,
        ),
    }
