"""Keys and seals: who speaks, proven by HMAC-SHA256; each seal is good for one session, one sequence number, one time.

    proof = H(key, "hello" ‖ nonce ‖ principal)         seal = H(key, "contract" ‖ nonce ‖ sequence ‖ times ‖ contract)

A shared secret is enough here: both ends belong to one person on one machine, and the file that holds the keys is as
private as the process. The nonce is the gatekeeper's, fresh for each connection, so that nothing heard before is worth
anything. Bodies are compared in constant time.
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
PRINCIPALS = ("planner", "operator")
"""Principals that a fresh key file has: the commander's, and the person's."""


class Keys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Secrets by principal."""

    secrets: dict[str, bytes]


def load_or_create_keys(path: Path) -> Keys:
    """The keys in `path`, made anew (mode 0600) if there is no file; raises `InvalidSetup` if others could read it."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        made = Keys({role: secrets.token_bytes(SECRET_BYTES) for role in PRINCIPALS})
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(handle, "wb") as file:
            file.write(msgspec.json.encode(made))
        return made
    mode = path.stat().st_mode & 0o777
    if mode & 0o077:
        raise ConfigurationError("mode of the key file", got=oct(mode), allowed="0o600", fix=f"chmod 600 {path}")
    try:
        keys = msgspec.json.decode(path.read_bytes(), type=Keys)
    except DECODE_ERRORS as error:
        raise ConfigurationError("key file", got=str(error), allowed="what dualbrain wrote", fix=str(path)) from error
    if any(len(secret) < SECRET_BYTES for secret in keys.secrets.values()):
        raise ConfigurationError(
            "key file", got="a short secret", allowed=f"{SECRET_BYTES} bytes or more", fix=str(path)
        )
    return keys


def hello_proof(secret: bytes, nonce: bytes, principal: str) -> bytes:
    """The proof in a `Hello`."""
    return _mac(secret, b"hello", nonce, principal.encode())


def contract_mac(
    secret: bytes, nonce: bytes, sequence: int, contract: bytes, *, issued: float, expires: float, scene_version: int
) -> bytes:
    """The seal of a `Propose` in frame `sequence`."""
    return _mac(secret, b"contract", nonce, pack("<Qddq", sequence, issued, expires, scene_version), contract)


def verify_contract_mac(secret: bytes, nonce: bytes, sequence: int, message: Propose) -> bool:
    """Whether the seal is the holder's own, for this connection and this frame."""
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
    """Whether the proof is the principal's own, for this connection."""
    return hmac.compare_digest(hello_proof(secret, nonce, principal), proof)


def _mac(secret: bytes, *parts: bytes) -> bytes:
    """Every part goes in with its length before it, so that no two lists of parts are one message."""
    mac = hmac.new(secret, digestmod=sha256)
    for part in (b"dualbrain", *parts):
        mac.update(pack("<Q", len(part)))
        mac.update(part)
    return mac.digest()
