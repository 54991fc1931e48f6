"""Authentication of principals and contracts by HMAC-SHA256 (RFC 2104).

    proof = H(key, "hello" ‖ nonce ‖ principal)         mac = H(key, "contract" ‖ nonce ‖ sequence ‖ times ‖ contract)

A code is valid for one connection, one sequence number and one time. A shared secret is sufficient: both ends belong to
one user on one machine, and the key file is as private as the process. The gatekeeper makes a fresh nonce for each
connection, so that a recorded message cannot be replayed. Codes are compared in constant time.
"""

from __future__ import annotations

import hmac
import os
import secrets
from hashlib import sha256
from pathlib import Path
from struct import pack

import msgspec

from dualbrain.control.gatekeeper.protocol.messages import Propose
from dualbrain.errors import DECODE_ERRORS, ConfigurationError

NONCE_BYTES = 16
SECRET_BYTES = 32
"""Shortest secret that is accepted, and the length of new ones [bytes]."""
PRINCIPALS = ("planner", "operator")
"""Principals of a new key file: the commander and a person."""


class Keys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Secrets by principal."""

    secrets: dict[str, bytes]


def load_or_create_keys(path: Path) -> Keys:
    """The keys in the file `path`; without a file, new keys are created there (mode 0600).

    Raises `ConfigurationError` if other users may read the file, or if it is not a valid key file.
    """
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        new_keys = Keys({role: secrets.token_bytes(SECRET_BYTES) for role in PRINCIPALS})
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as file:
            file.write(msgspec.json.encode(new_keys))
        return new_keys
    mode = path.stat().st_mode & 0o777
    if mode & 0o077:
        problem = f"The key file has the mode {mode:03o}, so other users can read it or write to it."
        raise ConfigurationError.stating(problem, fix=f"Run chmod 600 {path}")
    try:
        keys = msgspec.json.decode(path.read_bytes(), type=Keys)
    except DECODE_ERRORS as error:
        raise ConfigurationError.stating(
            f"The key file {path} cannot be read: {error}.", fix="Delete it; new keys are then created."
        ) from error
    if any(len(secret) < SECRET_BYTES for secret in keys.secrets.values()):
        raise ConfigurationError.stating(
            f"The key file {path} has a secret of fewer than {SECRET_BYTES} bytes.",
            fix="Delete it; new keys are then created.",
        )
    return keys


def hello_proof(secret: bytes, nonce: bytes, principal: str) -> bytes:
    """The proof in a `Hello`."""
    return _mac(secret, b"hello", nonce, principal.encode())


def contract_mac(
    secret: bytes, nonce: bytes, sequence: int, contract: bytes, *, issued: float, expires: float, scene_version: int
) -> bytes:
    """The authentication code of a `Propose` in frame `sequence`; times in [s]."""
    return _mac(secret, b"contract", nonce, pack("<Qddq", sequence, issued, expires, scene_version), contract)


def verify_contract_mac(secret: bytes, nonce: bytes, sequence: int, message: Propose) -> bool:
    """Whether the code of `message` was made with `secret`, for this connection and this frame."""
    expected = contract_mac(
        secret,
        nonce,
        sequence,
        message.contract,
        issued=message.issued,
        expires=message.expires,
        scene_version=message.scene_version,
    )
    return hmac.compare_digest(expected, message.mac)


def verify_hello_proof(secret: bytes, nonce: bytes, principal: str, proof: bytes) -> bool:
    """Whether `proof` was made with the principal's `secret`, for this connection."""
    return hmac.compare_digest(hello_proof(secret, nonce, principal), proof)


def _mac(secret: bytes, *parts: bytes) -> bytes:
    """HMAC of `parts`, each preceded by its length, so that different lists of parts are different messages."""
    mac = hmac.new(secret, digestmod=sha256)
    for part in (b"dualbrain", *parts):
        mac.update(pack("<Q", len(part)))
        mac.update(part)
    return mac.digest()
