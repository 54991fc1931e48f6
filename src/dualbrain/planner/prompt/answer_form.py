"""The forms in which a full prompt shows contracts: whole, or without id and context.

Id and context of a contract are fixed by the program. A model in this process need not read them: in the question and
the given beginning of the answer they are about 30 tokens. A server receives no beginning of the answer, so that its
model must write them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dualbrain.planner.prompt.sanitize import compact_json
from dualbrain.planner.request import PlanRequest

CONTRACT_LIMIT = 1200
"""Largest length of the action sequence of a shown contract."""
ANSWER_FORMAT = (
    '{{"id":"c-0001","context":{{"robot":"{robot}","registry":"{registry}"}},'
    '"action_sequence":[{{"skill":"...","params":{{...}}}}]}}'
)


@dataclass(frozen=True, slots=True, kw_only=True)
class AnswerForm:
    """One form of contracts in a prompt.

    `answer_format` is the form of an answer in the system message, a template with {robot} and {registry}.
    `question_end` is the last line of each question, a template with {contract_id}. `has_header`: whether contracts
    are shown with id and context.
    """

    answer_format: str
    question_end: str
    has_header: bool

    def answer(self, request: PlanRequest, contract_id: str, actions: list[Any]) -> str:
        """The contract with `actions` for the robot of `request`, as JSON."""
        context = {"robot": request.robot, "registry": request.registry_hash}
        header = {"id": contract_id, "context": context} if self.has_header else {}
        return compact_json(header | {"action_sequence": actions}, limit=2 * CONTRACT_LIMIT)

    def answer_prefix(self, request: PlanRequest) -> str:
        """The beginning of every valid answer to `request`: the text before the action sequence."""
        return self.answer(request, request.contract_id, []).removesuffix("[]}")


WHOLE_CONTRACT = AnswerForm(answer_format=ANSWER_FORMAT, question_end="Contract {contract_id}:", has_header=True)
"""The form for a model behind a server, which writes every part of a contract."""
ACTIONS_ONLY = AnswerForm(
    answer_format='{{"action_sequence":[{{"skill":"...","params":{{...}}}}]}}',
    question_end="Contract:",
    has_header=False,
)
"""The form for a model in this process: a contract without id and context, which the program inserts."""
