"""Single mutations of a valid contract, each with the stage that must reject it."""

import copy
import math
from collections.abc import Callable
from typing import Any

from hypothesis import strategies as st

from dualbrain.contracts.skill_spec import ChoiceParameter, NameParameter, NumberParameter, TextParameter
from tests.contracts.contract_strategies import REGISTRY

Document = dict[str, Any]
Draw = Callable[[st.SearchStrategy[Any]], Any]

NOT_A_NUMBER = st.sampled_from([True, False, None, "0.2", [], {}, [0.2], {"value": 0.2}])
NOT_A_TEXT = st.sampled_from([True, None, 3, 0.5, [], {}, ["red_cube"]])
STRANGE_KEYS = st.sampled_from(
    ["__proto__", "constructor", "prototype", "", "speed ", "Speed", "comment", "x" * 300, "é"]
)


def _draw_step(document: Document, draw: Draw) -> Document:
    return draw(st.sampled_from(document["action_sequence"]))


def _draw_parameter(document: Document, draw: Draw, kind: Any) -> tuple[Document, Any] | None:
    """Params object and specification of one parameter of `kind`, or None if the contract has none."""
    found = [
        (step["params"], parameter)
        for step in document["action_sequence"]
        for parameter in REGISTRY.skill(step["skill"]).parameters
        if isinstance(parameter, kind)
    ]
    return draw(st.sampled_from(found)) if found else None


# --- syntax ---------------------------------------------------------------------------------------------------------


def drop_field(document: Document, draw: Draw) -> bool:
    step = _draw_step(document, draw)
    owner = draw(st.sampled_from([document, document["context"], step, step["params"]]))
    del owner[draw(st.sampled_from(sorted(owner)))]
    return True


def add_field(document: Document, draw: Draw) -> bool:
    step = _draw_step(document, draw)
    owner = draw(st.sampled_from([document, document["context"], step, step["params"]]))
    owner[draw(STRANGE_KEYS)] = draw(st.sampled_from([0.2, "text", None, {}, {"isAdmin": True}]))
    return True


def mistype_parameter(document: Document, draw: Draw) -> bool:
    params, parameter = _draw_parameter(
        document, draw, (NumberParameter, ChoiceParameter, NameParameter, TextParameter)
    ) or (None, None)
    wrong = NOT_A_NUMBER if isinstance(parameter, NumberParameter) else NOT_A_TEXT
    params[parameter.name] = draw(wrong)
    return True


def mistype_header(document: Document, draw: Draw) -> bool:
    owner, key = draw(
        st.sampled_from(
            [
                (document, "id"),
                (document["context"], "robot"),
                (document["context"], "registry"),
                (document["action_sequence"][0], "skill"),
            ]
        )
    )
    owner[key] = draw(NOT_A_TEXT)
    return True


def mistype_branch(document: Document, draw: Draw) -> bool:
    owner, key = draw(
        st.sampled_from(
            [
                (document, "context"),
                (document, "action_sequence"),
                (document["action_sequence"], 0),
                (document["action_sequence"][0], "params"),
            ]
        )
    )
    owner[key] = draw(st.sampled_from([None, 3, "text", True]))
    return True


def empty_sequence(document: Document, draw: Draw) -> bool:
    document["action_sequence"] = []
    return True


def long_sequence(document: Document, draw: Draw) -> bool:
    step = _draw_step(document, draw)
    document["action_sequence"] = [copy.deepcopy(step) for _ in range(draw(st.integers(9, 12)))]
    return True


def malformed_id(document: Document, draw: Draw) -> bool:
    document["id"] = draw(
        st.sampled_from(["", "c-1", "c-00001", "C-0001", "c-0001\n", "c-٠٠٠١", "c_0001", " c-0001", "x" * 99])
    )
    return True


# --- authorization --------------------------------------------------------------------------------------------------


def other_robot(document: Document, draw: Draw) -> bool:
    document["context"]["robot"] = draw(st.sampled_from(["ur5e", "", "Panda", "panda ", "раnda"]))
    return True


def other_registry(document: Document, draw: Draw) -> bool:
    known = document["context"]["registry"]
    document["context"]["registry"] = draw(
        st.sampled_from(["00000000", "", known.upper() + "x", known + "0", known[:7]])
    )
    return True


def unknown_skill(document: Document, draw: Draw) -> bool:
    step = _draw_step(document, draw)
    step["skill"] = draw(
        st.sampled_from(["grаsp", "Grasp", "grasp ", "push", "", "__class__", "motion_01", "move-to", "ɡrasp"])
    )
    return True


# --- envelope -------------------------------------------------------------------------------------------------------


def out_of_bounds(document: Document, draw: Draw) -> bool:
    found = _draw_parameter(document, draw, NumberParameter)
    if found is None:
        return False
    params, number = found
    above, below = math.nextafter(number.upper, math.inf), math.nextafter(number.lower, -math.inf)
    candidates = [above, below, number.upper + 1, number.lower - 1, number.upper * 1000, 0, 90, 1e300, -1e300, 10**14]
    params[number.name] = draw(st.sampled_from([x for x in candidates if not number.lower <= x <= number.upper]))
    return True


def unknown_word(document: Document, draw: Draw) -> bool:
    found = _draw_parameter(document, draw, (ChoiceParameter, NameParameter))
    if found is None:
        return False
    params, parameter = found
    params[parameter.name] = draw(st.sampled_from(["", "RED_CUBE", "red_cube ", "rеd_cube", "human", "*", "x" * 5000]))
    return True


def unsafe_text(document: Document, draw: Draw) -> bool:
    found = _draw_parameter(document, draw, TextParameter)
    if found is None:
        return False
    params, text = found
    params[text.name] = draw(
        st.sampled_from(
            ["x" * (text.max_length + 1), "\x1b[2J", "a\nb", "a\x00", "safe\u202egnp", "\U000e0041", "\ufeff"]
        )
    )
    return True


MUTATIONS: dict[str, list[Callable[[Document, Draw], bool]]] = {
    "syntax": [
        drop_field,
        add_field,
        mistype_parameter,
        mistype_header,
        mistype_branch,
        empty_sequence,
        long_sequence,
        malformed_id,
    ],
    "authorization": [other_robot, other_registry, unknown_skill],
    "envelope": [out_of_bounds, unknown_word, unsafe_text],
}
"""Mutations by stage; each changes the document in place and returns whether the document could be changed."""
