"""The prompt of an adapted planner: scene and instruction, no schema and no examples; those it has learnt.

Training and asking render the same messages. A short prompt is most of what adaptation saves at run time: 135 tokens
where the full prompt has some 1500.
"""

from __future__ import annotations

import hashlib
import json

from dualbrain.planner.prompt import INSTRUCTION_LIMIT, SCENE_LIMIT, SCENE_LINES, Message
from dualbrain.planner.untrusted import block

SHORT_TEMPLATE_VERSION = 1
"""Rises with every change of wording or order; an adapter trained on one version refuses another."""

SYSTEM = "You plan for a robot. Answer with one contract: one line of JSON."
QUESTION = "Contract {contract_id} for {robot} {registry}:"


def render_short(scene: str, instruction: str, *, robot: str, registry: str, contract_id: str) -> list[Message]:
    """The messages for `instruction` in `scene` (the summary in symbols), both untrusted; `registry` is its hash."""
    question = QUESTION.format(contract_id=contract_id, robot=robot, registry=registry)
    parts = [
        block("scene", scene, limit=SCENE_LIMIT, lines=SCENE_LINES),
        block("instruction", instruction, limit=INSTRUCTION_LIMIT),
        question,
    ]
    return [{"role": "system", "content": SYSTEM}, {"role": "user", "content": "\n".join(parts)}]


def short_template_hash() -> str:
    """First 16 hex digits of the SHA-256 of all fixed text of the short prompt and the limits of what fills it."""
    fixed = [SHORT_TEMPLATE_VERSION, SYSTEM, QUESTION, SCENE_LIMIT, SCENE_LINES, INSTRUCTION_LIMIT]
    return hashlib.sha256(json.dumps(fixed).encode()).hexdigest()[:16]
