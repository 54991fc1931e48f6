"""Contracts that are chosen to cost the gate as much time as possible, each at most 64 KiB."""

import json
import random

from dualbrain.contracts.gate.strict_json import MAX_BYTES, MAX_COMMAS, MAX_DEPTH, MAX_FIELDS
from dualbrain.contracts.registry import SkillRegistry

SKILL = "grasp"


def _contract(registry: SkillRegistry, actions: object, **more: object) -> bytes:
    document = {"id": "c-0001", "context": {"robot": registry.robot, "registry": registry.hash}}
    return json.dumps({**document, "action_sequence": actions, **more}, ensure_ascii=False).encode()[: MAX_BYTES + 1]


def _nested(width: int, depth: int, leaf: object) -> object:
    """An array of `width` items in `depth` further arrays."""
    value: object = [leaf] * width
    for _ in range(depth):
        value = [value]
    return value


def _documents(registry: SkillRegistry) -> dict[str, bytes]:
    def unknown_fields(count: int, value: object, length: int = 3) -> bytes:
        return _contract(registry, [{"skill": SKILL, "params": {f"{k:0{length}d}": value for k in range(count)}}])

    per_field = MAX_COMMAS // 70
    found = {
        f"{count} unknown fields of {width} nested items": unknown_fields(count, _nested(width, 8, leaf))
        for count, width in ((60, 10), (60, per_field), (8, 120), (1, MAX_COMMAS - 80), (60, 45))
        for leaf in (0,)
    }
    found |= {
        "unknown fields of text": unknown_fields(60, "x" * 900),
        "unknown fields with long names": unknown_fields(60, 1, 1000),
        "unknown fields of escaped text": unknown_fields(60, '"\\' * 250),
        "one long unknown name": unknown_fields(1, 1, 60_000),
        "long skill name": _contract(registry, [{"skill": SKILL * 12_000, "params": {}}]),
        "eight actions of unknown fields": _contract(
            registry, [{"skill": SKILL, "params": {f"k{k}": [0] * 1 for k in range(60)}}] * 8
        ),
        "eight empty actions": _contract(registry, [{}] * 8),
        "wrong actions": _contract(registry, [[0]] * (MAX_COMMAS - 10)),
        "empty objects": _contract(registry, [{}] * (MAX_COMMAS - 10)),
        "numbers of forty characters": _contract(registry, _nested(MAX_COMMAS - 20, 1, 0.1234567890123456)),
        "long strings": _contract(registry, ["\u00e9" * 60] * 500),
        "unknown outer fields": _contract(registry, [], **{f"k{k}": [0] * 15 for k in range(MAX_FIELDS - 4)}),
        "brackets only": b"[]" * (MAX_BYTES // 2),
        "open brackets": b"[" * MAX_BYTES,
        "deep brackets": (b"[" * MAX_DEPTH + b"]" * MAX_DEPTH + b" ") * (MAX_BYTES // 33),
        "quotes": b'"' * MAX_BYTES,
        "short strings": b"[" + b'"{",' * (MAX_BYTES // 4 - 1) + b"0]",
        "escapes": b'["' + b"\\\\" * (MAX_BYTES // 2 - 3) + b'"]',
        "escaped code points": b'["' + b"\\u00e9" * (MAX_BYTES // 6 - 2) + b'"]',
        "white space": b"[" + b" " * (MAX_BYTES - 2) + b"]",
        "digits": b"[" + b"1" * (MAX_BYTES - 2) + b"]",
        "commas": b"[" + b"0," * (MAX_BYTES // 2 - 2) + b"0]",
        "invalid UTF-8": b'["' + b"\xff" * (MAX_BYTES - 10) + b'"]',
    }
    return found


def worst_contracts(registry: SkillRegistry, *, n_random: int = 0, seed: int = 0) -> dict[str, bytes]:
    """Contracts by description; `n_random` more nest unknown fields in random widths and depths."""
    rng, found = random.Random(seed), _documents(registry)
    for k in range(n_random):
        count, depth = rng.randint(1, MAX_FIELDS), rng.randint(0, MAX_DEPTH - 6)
        width = rng.randint(1, max(1, (MAX_COMMAS - 100) // count))
        leaf = rng.choice([0, "", "x" * rng.randint(0, 60), None, {}, [], True, 1e10])
        params = {f"{rng.random()}": _nested(width, depth, leaf) for _ in range(count)}
        found[f"random {k}"] = _contract(registry, [{"skill": SKILL, "params": params}] * rng.choice((1, 1, 1, 8)))
    return {name: data for name, data in found.items() if len(data) <= MAX_BYTES}
