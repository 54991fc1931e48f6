"""The request to a planner: the content of the prompt, and the schema of the answer."""

from __future__ import annotations

from typing import Any

from dualbrain.contracts.verdict import Rejected
from dualbrain.planner.camera_image import CameraImage
from dualbrain.records import FailureFeedback, Record, RetrievedContext


class PlanRequest(Record, frozen=True, kw_only=True, rename={"rejection": "refusal", "failure_feedback": "setback"}):
    """One request to a planner.

    `instruction`, `scene` (the summary in symbols) and `recall` are untrusted text. `skills_text` is the registry in
    short form and `schema` its decoding schema for the names in this scene. `rejection` is the gate's rejection of the
    first proposal if this is the second attempt; `failure_feedback` describes the failure of an earlier contract for
    the same instruction, which the new contract is to complete. `contract_id` is the required id of the contract.
    `scene_with_values` is the summary with fitting parameter values, for adapters that were trained with it. `image` is
    the camera image of the scene, for a planner that takes one (`introspection.takes_images`); it is untrusted, too.
    """

    instruction: str
    scene: str
    recall: RetrievedContext
    robot: str
    registry_hash: str
    skills_text: str
    schema: dict[str, Any]
    contract_id: str
    rejection: Rejected | None = None
    failure_feedback: FailureFeedback | None = None
    scene_with_values: str = ""
    image: CameraImage | None = None
