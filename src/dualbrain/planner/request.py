"""What a planner is asked: everything that stands in the prompt, and the schema that its answer must follow."""

from __future__ import annotations

from typing import Any

from dualbrain.contracts.verdict import Rejected
from dualbrain.records import FailureFeedback, Record, RetrievedContext


class PlanRequest(Record, frozen=True, kw_only=True):
    """One question to a planner.

    `instruction`, `scene` (the summary in symbols) and `recall` are untrusted text. `skills_text` is the registry in
    short form and `schema` its decoding schema for the names in this scene. `refusal` is the gate's answer to the first
    shot when this is the second; `setback` is what became of an earlier contract for the same instruction, when this is
    to do what that one did not. `contract_id` is the id that the contract must carry.
    """

    instruction: str
    scene: str
    recall: RetrievedContext
    robot: str
    registry_hash: str
    skills_text: str
    schema: dict[str, Any]
    contract_id: str
    refusal: Rejected | None = None
    setback: FailureFeedback | None = None
