"""Fuzzed input for the gatekeeper: frames with bytes changed, removed and added, and almost valid contracts."""

from __future__ import annotations

import re
from math import exp, log
from random import Random

import msgspec

from dualbrain.control.gatekeeper.protocol.authentication import contract_mac
from dualbrain.control.gatekeeper.protocol.frames import encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Heartbeat,
    Hello,
    Message,
    OperatorCommand,
    Propose,
    SceneRequest,
    encode_body,
    kind_code,
)
from dualbrain.grounding.vocabulary import load_skill_registry
from experiments.safety.closed_loop import pick_and_place_actions

TOKEN_PATTERN = re.compile(rb'"[^"]*"|-?\d+(?:\.\d+)?')
NUMBER_VALUES = (b"0", b"-1", b"0.05", b"0.2", b"0.35", b"0.9", b"30", b"1e308", b"1e999", b"-0.0", b"NaN")
STRING_VALUES = (
    b'""',
    b'"red_cube"',
    b'"green_tin"',
    b'"blue_bowl"',
    b'"table_left"',
    b'"across"',
    b'"tilted"',
    b'"until_clear"',
    b'"grasp"',
    b'"release"',
    b'"c-0002"',
    b'"\\ud800"',
    b'"' + b"x" * 300 + b'"',
)
OTHER_VALUES = (b"null", b"true", b"[]", b"{}", b"[" * 600)
SAME_TYPE_PROBABILITY = 0.8
"""Probability that a number replaces a number, and a string a string."""
MAX_NOISE_BYTES = 64
PADDED_SHARE, MAX_PADDING_BYTES = 0.1, 66_000
"""Share of contracts with white space added, and the largest amount: more than the gate and a frame allow."""


class Fuzzer:
    """Fuzzed contracts for the Panda, frames and messages, determined by a seed."""

    def __init__(self, seed: int) -> None:
        """Prepare the valid contracts that are mutated."""
        self.rng = Random(seed)
        registry = load_skill_registry("panda")
        context = {"robot": registry.robot, "registry": registry.hash}
        texts = [pick_and_place_actions(speed=speed) for speed in (0.1, 0.3)]
        texts.append([{"skill": "release", "params": {"speed": 0.1}}, {"skill": "hold", "params": {"duration": 0.5}}])
        self._texts = [
            msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": actions}) for actions in texts
        ]
        self._tokens = [[one.span() for one in TOKEN_PATTERN.finditer(text)] for text in self._texts]

    def contract(self) -> bytes:
        """Return a contract of `short_contract`; one in ten is padded to a length of up to 66 kB."""
        text = self.short_contract()
        if self.rng.random() >= PADDED_SHARE:
            return text
        padding = b" " * round(exp(self.rng.uniform(0.0, log(MAX_PADDING_BYTES))))
        place = self.rng.choice((0, 1, len(text)))
        return text[:place] + padding + text[place:]

    def short_contract(self) -> bytes:
        """Return a contract: 10 % valid, 60 % with strings or numbers replaced, 30 % with bytes changed or removed."""
        rng = self.rng
        k = rng.randrange(len(self._texts))
        text, share = self._texts[k], rng.random()
        if share < 0.1:
            return text
        if share < 0.7:
            for start, end in sorted(rng.sample(self._tokens[k], rng.choice((1, 1, 1, 2, 3))), reverse=True):
                same_type = STRING_VALUES if text[start : start + 1] == b'"' else NUMBER_VALUES
                text = (
                    text[:start]
                    + rng.choice(same_type if rng.random() < SAME_TYPE_PROBABILITY else OTHER_VALUES)
                    + text[end:]
                )
            return text
        return self._corrupt(bytearray(text), rng.randrange(1, 5))

    def frame(self, message: Message, sequence: int) -> bytes:
        """Return a frame of `message`: 40 % valid, 10 % random bytes, 50 % with bytes changed or removed."""
        rng = self.rng
        share = rng.random()
        if share < 0.1:
            return rng.randbytes(rng.randrange(1, MAX_NOISE_BYTES))
        data = encode(kind_code(message), sequence, encode_body(message))
        return data if share < 0.5 else self._corrupt(bytearray(data), rng.randrange(1, 4))

    def authenticated_proposal(self, secret: bytes, nonce: bytes, sequence: int, version: int, now: float) -> Propose:
        """Return a proposal of a fuzzed contract with a valid authentication code."""
        text = self.contract()
        tag = contract_mac(secret, nonce, sequence, text, issued=now, expires=now + 60.0, scene_version=version)
        return Propose(contract=text, issued=now, expires=now + 60.0, scene_version=version, mac=tag)

    def message(self) -> Message:
        """Return a message, allowed for a client or not; never the emergency stop, which any client may send."""
        rng = self.rng
        kind = rng.randrange(6)
        if kind == 0:
            return Propose(contract=self.contract(), issued=0.0, expires=1.0, scene_version=1, mac=b"0" * 32)
        if kind == 1:
            return OperatorCommand(
                act=rng.choice(("pause", "resume", "speed", "reset", "shut_down")), speed=rng.random()
            )
        if kind == 2:
            return Hello(principal=rng.choice(("", "planner", "operator", "x")), proof=rng.randbytes(32))
        return SceneRequest() if kind == 3 else Heartbeat()

    def _corrupt(self, data: bytearray, times: int) -> bytes:
        rng = self.rng
        for _ in range(times):
            if data:
                data[rng.randrange(len(data))] = rng.randrange(256)
        if data and rng.random() < 0.1:
            del data[rng.randrange(len(data)) :]
        elif rng.random() < 0.1:
            data += rng.randbytes(rng.randrange(1, 9))
        return bytes(data)
