"""Bad values at every interface that takes bytes: no surprise, and a broken validator is one."""

import os
from contextlib import ExitStack
from unittest.mock import patch

import numpy as np
import pytest

from dualbrain.contracts.gate import envelope
from dualbrain.contracts.gate.syntax import SyntaxStage
from dualbrain.control.gatekeeper.operator_commands import OperatorCommands
from dualbrain.control.recording import channels
from dualbrain.planner.prompt import sanitize as sanitizing
from dualbrain.robots import site_config
from dualbrain.safety.supervisor.state_monitor import StateMonitor
from experiments.interfaces.untrusted_bytes import message_interfaces, record_interfaces
from experiments.interfaces.untrusted_bytes.bad_bytes import BadBytes, all_interfaces, run_case
from experiments.interfaces.untrusted_bytes.mutation import KINDS, VALID

CASES = int(os.environ.get("DUALBRAIN_BAD_BYTES", "1000"))
"""Number of random cases; `python -m experiments run bad_bytes` runs a million."""
SEED = 20261125
IN_PROCESS = [name for name, one in all_interfaces().items() if one.share > 0.01]


def test_random_bad_bytes_have_declared_outcomes():
    row = BadBytes().run({"seed": SEED, "cases": CASES})
    assert row["cases"] == CASES
    assert row["problems"] == []
    assert set(row["kinds"]) == {*KINDS, VALID}


@pytest.mark.parametrize("name", all_interfaces())
def test_every_interface_refuses_every_kind_and_takes_valid_bytes(name):
    rng, kinds = np.random.default_rng(SEED), (VALID, *KINDS) if name in IN_PROCESS else (VALID, "nan", "no bytes")
    outcomes = {kind: [run_case(all_interfaces()[name], kind, rng) for _ in range(2)] for kind in kinds}
    assert {kind: found for kind, found in outcomes.items() if any(found)} == {}
    assert outcomes[VALID] == ["", ""]
    assert sum(found != [None, None] for found in outcomes.values()) > len(kinds) // 2


def accept(answer):
    return lambda *given, **named: answer


BROKEN = {
    "a contract with hidden characters": (
        "contract at the gate",
        "unicode",
        [(SyntaxStage, "check", accept(None)), (envelope, "_is_in_domain", accept(True))],
    ),
    "a speed beyond its bounds": ("contract at the gate", "huge", [(envelope, "_is_in_domain", accept(True))]),
    "a speed scale that is NaN": ("frame of OperatorCommand", "nan", [(OperatorCommands, "apply", accept(""))]),
    "a joint state that is NaN": ("state packet", "nan", [(StateMonitor, "check_state", accept(0))]),
    "a request of a foreign page": (
        "request to the live view",
        "wrong type",
        [(message_interfaces, "refuse_request", accept(""))],
    ),
    "a site that is infinite": (
        "site file",
        "infinite",
        [(site_config, "_find_non_finite", accept(None)), (site_config, "_check_geometry", accept(None))],
    ),
    "a tick of too many digits": ("recording", "huge", [(channels, "_is_number", accept(True))]),
    "a ledger that is not verified": ("ledger", "wrong type", [(record_interfaces, "refuse_if", accept(None))]),
    "an instruction with a tag": ("instruction", "deep", [(sanitizing, "_REPLACEMENTS", ())]),
    "an instruction with hidden characters": (
        "instruction",
        "unicode",
        [(sanitizing, "remove_hidden_characters", lambda text, **named: text)],
    ),
}


@pytest.mark.parametrize("broken", BROKEN)
def test_a_broken_validator_is_a_surprise(broken):
    name, kind, patches = BROKEN[broken]
    interface, rng = all_interfaces()[name], np.random.default_rng(SEED)
    with ExitStack() as stack:
        for owner, attribute, replacement in patches:
            stack.enter_context(patch.object(owner, attribute, replacement))
        assert any(run_case(interface, kind, rng) for _ in range(200)), broken
    assert not any(run_case(interface, kind, rng) for _ in range(10))
