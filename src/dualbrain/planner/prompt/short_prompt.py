"""The short prompt of an adapted planner: scene and instruction; the adapter has learned schema and rules.

Training and inference render the same messages. The short prompt is the main saving of adaptation at run time: 100 to
300 tokens instead of about 1500. Retrieved memories can precede the scene, reduced to the steps of their contracts
(about 90 tokens each), the most similar first.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

from dualbrain.contracts.verdict import Rejected
from dualbrain.planner.prompt.failure_feedback import format_failures
from dualbrain.planner.prompt.full_prompt import INSTRUCTION_LIMIT, SCENE_LIMIT, SCENE_LINES, ChatMessage
from dualbrain.planner.prompt.sanitize import compact_json, format_block
from dualbrain.records import Exemplar, FailureFeedback

SHORT_TEMPLATE_VERSION = 2
"""Increases with every change of text or order; an adapter is valid for one version only."""

SYSTEM = "You plan for a robot. Answer with one contract: one line of JSON."
EXAMPLE = "<example>\n{steps}\n</example>"
QUESTION = "Contract {contract_id} for {robot} {registry}:"
MAX_SHOWN_EXEMPLARS, STEPS_LIMIT = 3, 640
"""Largest number of exemplars, and largest length of each; a longer one is left out, because it cannot be cut."""


def render_short(
    scene: str,
    instruction: str,
    *,
    robot: str,
    registry: str,
    contract_id: str,
    exemplars: Iterable[Exemplar] = (),
    rejection: Rejected | None = None,
    failure_feedback: FailureFeedback | None = None,
) -> list[ChatMessage]:
    """The messages for `instruction` in `scene` (the summary in symbols), both untrusted; `registry` is a hash.

    Of the `exemplars`, best first, only those that succeeded are shown. The gate's `rejection` of the last contract and
    the `failure_feedback` on an earlier one are blocks of facts between scene and instruction.
    """
    shown = (exemplar_steps(one.contract) for one in exemplars if one.succeeded)
    return render_short_with_steps(
        list(shown),
        scene,
        instruction,
        robot=robot,
        registry=registry,
        contract_id=contract_id,
        failures=format_failures(rejection, failure_feedback),
    )


def render_short_with_steps(
    examples: list[str],
    scene: str,
    instruction: str,
    *,
    robot: str,
    registry: str,
    contract_id: str,
    failures: Iterable[str] = (),
) -> list[ChatMessage]:
    """The messages with at most `MAX_SHOWN_EXEMPLARS` non-empty `examples` (results of `exemplar_steps`).

    `failures` are the blocks of `format_failures`; the first request for an instruction has none.
    """
    question = QUESTION.format(contract_id=contract_id, robot=robot, registry=registry)
    parts = [
        *(EXAMPLE.format(steps=steps) for steps in [one for one in examples if one][:MAX_SHOWN_EXEMPLARS]),
        format_block("scene", scene, limit=SCENE_LIMIT, lines=SCENE_LINES),
        *failures,
        format_block("instruction", instruction, limit=INSTRUCTION_LIMIT),
        question,
    ]
    return [{"role": "system", "content": SYSTEM}, {"role": "user", "content": "\n".join(parts)}]


def exemplar_steps(contract: Mapping[str, Any]) -> str:
    """The steps of a `contract` on one line, with sanitised strings; "" if they are longer than `STEPS_LIMIT`.

    Numbers have the form of the canonical contract text (15, not 15.0), so that they can be copied token by token.
    """
    steps = contract.get("action_sequence")
    return (
        compact_json([_canonical_numbers(step) for step in steps], limit=STEPS_LIMIT)
        if isinstance(steps, list | tuple)
        else ""
    )


def _canonical_numbers(value: Any) -> Any:
    match value:
        case float() if value.is_integer():
            return int(value)
        case Mapping():
            return {name: _canonical_numbers(item) for name, item in value.items()}
        case _:
            return value


def short_template_hash() -> str:
    """First 16 hex digits of the SHA-256 of the fixed text of the short prompt and the limits of its variable parts."""
    fixed = [
        SHORT_TEMPLATE_VERSION,
        SYSTEM,
        EXAMPLE,
        QUESTION,
        SCENE_LIMIT,
        SCENE_LINES,
        INSTRUCTION_LIMIT,
        MAX_SHOWN_EXEMPLARS,
        STEPS_LIMIT,
    ]
    return hashlib.sha256(json.dumps(fixed).encode()).hexdigest()[:16]
