"""Every attack is rejected at the predicted stage, and its rejection is safe to display."""

import json
from typing import Any

import msgspec
import pytest

from dualbrain.contracts.verdict import Accepted, Rejected
from tests.stories.contract_attacks import (
    ATTACKS,
    PAGE_FILE,
    STAGES,
    VALID_CONTRACT,
    count_by_class,
    rejecting_stage,
    render_page,
    run_attack,
)

MAX_REJECTION_BYTES = 1200


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: f"{attack['class']}: {attack['name']}")
def test_each_attack_ends_at_the_predicted_stage(attack: dict[str, Any]) -> None:
    verdict = run_attack(attack)
    assert rejecting_stage(verdict) == attack["expected"], verdict
    assert ("then" in attack) == (attack["expected"] == "accepted")
    if isinstance(verdict, Rejected):
        encoded = msgspec.json.encode(verdict).decode()
        assert encoded.isascii()
        assert str(verdict.got).isprintable()
        assert len(encoded) < MAX_REJECTION_BYTES
        assert verdict.hint


def test_the_contract_that_the_attacks_modify_is_valid() -> None:
    assert isinstance(run_attack({"text": "$GOOD"}), Accepted)
    assert isinstance(run_attack({"text": "$GOOD", "stamp": {}}), Accepted)
    assert json.loads(VALID_CONTRACT)["action_sequence"]


def test_there_are_enough_attacks_in_every_class_and_at_every_stage() -> None:
    table = count_by_class()
    assert len(ATTACKS) >= 70
    assert len({(attack["class"], attack["name"]) for attack in ATTACKS}) == len(ATTACKS)
    assert min(counts.total() for counts in table.values()) >= 5
    assert all(sum(counts[stage] for counts in table.values()) >= 10 for stage in STAGES)


def test_the_page_about_the_attacks_is_current() -> None:
    current = render_page([rejecting_stage(run_attack(attack)) for attack in ATTACKS])
    assert PAGE_FILE.read_text() == current, "run: python -m tests.stories.contract_attacks"
