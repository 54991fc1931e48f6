"""Authentication of principals and contracts by HMAC-SHA256 (RFC 2104).

    proof = H(key, "hello" ‖ nonce ‖ principal)         mac = H(key, "contract" ‖ nonce ‖ sequence ‖ times ‖ contract)

A code is valid for one connection, one sequence number and one time. A shared secret is sufficient: both ends belong to
one user on one machine, and a key file is as private as the process. Each principal has a key file of its own, so that
the commander's process holds no key of the operator; only the gatekeeper reads both. The gatekeeper makes a fresh nonce
for each connection, so that a recorded message cannot be replayed. Codes are compared in constant time.
"""

from __future__ import annotations

import hmac
import os
import secrets
import stat
from collections.abc import Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from struct import error as struct_error
from struct import pack

import msgspec

from dualbrain.control.gatekeeper.protocol.messages import Propose
from dualbrain.core.storage.atomic_files import FileWriteError, fsync_entry, fsync_folder
from dualbrain.core.storage.private_files import (
    FILE_MODE,
    FOLDER_MODE,
    OTHERS,
    create_private_folder,
    describe_kind,
    open_private,
)
from dualbrain.errors import DECODE_ERRORS, ConfigurationError

NONCE_BYTES = 16
SECRET_BYTES = 32
"""Shortest secret that is accepted, and the length of new ones [bytes]."""
PRINCIPALS = ("planner", "operator")
"""Principals with a key: the commander and a person."""
KEY_SUFFIX = ".key"
MAX_KEY_FILE_BYTES = 1024
"""Longest key file that is read [bytes]."""


class Keys(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Secrets by principal. `notice` is a sentence for the user if an old key file was split, otherwise ""."""

    secrets: dict[str, bytes]
    notice: str = ""


class _OldKeyFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The single key file of earlier versions."""

    secrets: dict[str, bytes]


def load_keys(folder: Path, principals: Sequence[str]) -> Keys:
    """The secrets of `principals`, each from its own file `PRINCIPAL.key` in `folder`; missing ones are created.

    A process that names only its own principal never reads the secret of another one. Files have mode 0600, the folder
    0700. A single key file of an earlier version (at `folder`, or `folder` with the suffix .json) is split into one
    file per principal and removed, but only for a caller that may read all secrets in it.

    Raises `ConfigurationError` if other users can use the folder or a file, if one of them is a link or belongs to
    another user, or if a file holds no valid secret.
    """
    notice = _split_old_key_file(folder, principals)
    _check_private(_lstat(folder), folder, "key folder", stat.S_IFDIR, FOLDER_MODE)
    create_private_folder(folder)
    return Keys({name: _load_secret(folder / f"{name}{KEY_SUFFIX}") for name in principals}, notice)


def read_keys(folder: Path, principals: Sequence[str]) -> Keys:
    """The secrets of `principals` as `load_keys`, for a client: only the gatekeeper creates keys.

    Raises `ConfigurationError` also if a file is missing.
    """
    if missing := [name for name in principals if _lstat(folder / f"{name}{KEY_SUFFIX}") is None]:
        _split_old_key_file(folder, principals)  # explains an old key file
        raise ConfigurationError.stating(
            f"The key folder {folder} has no {missing[0]}{KEY_SUFFIX}: no gatekeeper was started with it.",
            fix="Start `dualbrain gatekeeper`, or name the socket and the key folder of a running one with --socket "
            "and --keys (`dualbrain doctor` lists them).",
        )
    return load_keys(folder, principals)


def _load_secret(path: Path) -> bytes:
    """The secret in the key file `path`, which is created if it is missing."""
    _check_private(_lstat(path), path, "key file", stat.S_IFREG, FILE_MODE)
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        _create_secret(path, secrets.token_bytes(SECRET_BYTES))
        return _load_secret(path)
    except OSError as error:
        raise _unreadable(path, error.strerror or str(error)) from error
    with os.fdopen(descriptor, "rb") as file:
        _check_private(os.fstat(descriptor), path, "key file", stat.S_IFREG, FILE_MODE)
        text = file.read(MAX_KEY_FILE_BYTES + 1)
    try:
        secret = bytes.fromhex(text.decode("ascii")) if len(text) <= MAX_KEY_FILE_BYTES else b""
    except ValueError as error:
        raise _unreadable(path, "it is not a hexadecimal number") from error
    if len(secret) < SECRET_BYTES:
        raise ConfigurationError.stating(
            f"The key file {path} has a secret of fewer than {SECRET_BYTES} bytes, or is longer than a key file.",
            fix="Delete it; a new key is then created.",
        )
    return secret


def _create_secret(path: Path, secret: bytes) -> None:
    """Write `secret` to the new file `path` in one atomic step; the file of a process that was faster stays."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with open_private(temporary, "xb") as file:
            file.write(secret.hex().encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        with suppress(FileExistsError):
            os.link(temporary, path)
        fsync_entry(path)
    except OSError as error:
        raise FileWriteError(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def _split_old_key_file(folder: Path, principals: Sequence[str]) -> str:
    """Split the single key file of an earlier version, if there is one; returns a sentence for the user, or ""."""
    renamed = folder.with_name(f"{folder.name}.old")
    candidates = (folder, folder.with_name(f"{folder.name}.json"), renamed)
    old = next((path for path in candidates if _is_regular(path)), None)
    if old is None:
        return ""
    if old != folder and folder.is_dir() and any(folder.iterdir()):
        return ""  # keys in the folder count; an old file beside it is unused
    _check_private(_lstat(old), old, "key file", stat.S_IFREG, FILE_MODE)
    if missing := [name for name in PRINCIPALS if name not in principals]:
        raise ConfigurationError.stating(
            f"The key file {old} is of an earlier version and holds the secrets of all principals, so the "
            f"{principals[0]} does not read it.",
            fix=f"Start `dualbrain gatekeeper` once: it moves the secret of the {missing[0]} into a file of its own.",
        )
    old_secrets = _read_old_key_file(old)
    if old == folder:
        old.replace(renamed)
        old = renamed
    create_private_folder(folder)
    for name, secret in old_secrets.items():
        _create_secret(folder / f"{name}{KEY_SUFFIX}", secret)
    old.unlink()
    fsync_folder(folder.parent)
    names = ", ".join(f"{name}{KEY_SUFFIX}" for name in old_secrets)
    return f"The key file of an earlier version was split into {names} and removed. Key folder: {folder}"


def _read_old_key_file(path: Path) -> dict[str, bytes]:
    """The secrets in a single key file; raises `ConfigurationError` if it is not a valid one."""
    try:
        found = msgspec.json.decode(path.read_bytes(), type=_OldKeyFile).secrets
    except (OSError, *DECODE_ERRORS) as error:
        raise _unreadable(path, str(error)) from error
    if unknown := sorted(set(found) - set(PRINCIPALS)):
        raise _unreadable(path, f"it names the unknown principal {unknown[0]!r}")
    if any(len(secret) < SECRET_BYTES for secret in found.values()):
        raise ConfigurationError.stating(
            f"The key file {path} has a secret of fewer than {SECRET_BYTES} bytes.",
            fix="Delete it; new keys are then created.",
        )
    return found


def _check_private(found: os.stat_result | None, path: Path, what: str, kind: int, mode: int) -> None:
    """Raise `ConfigurationError` unless `path` is missing, or has this kind and only this user can use it."""
    if found is None:
        return
    if stat.S_IFMT(found.st_mode) != kind:
        raise ConfigurationError.stating(
            f"The {what} {path} is {describe_kind(found.st_mode)}, not {describe_kind(kind)}.",
            fix="Name a folder of your own with --keys; it is created if it is missing.",
        )
    if found.st_uid != os.geteuid():
        raise ConfigurationError.stating(
            f"The {what} {path} belongs to another user (user id {found.st_uid}).",
            fix="Name a folder of your own with --keys; it is created if it is missing.",
        )
    if (bits := stat.S_IMODE(found.st_mode)) & OTHERS:
        problem = f"The {what} has the mode {bits:03o}, so other users can read it or write to it."
        raise ConfigurationError.stating(problem, fix=f"Run chmod {mode:o} {path}")


def _lstat(path: Path) -> os.stat_result | None:
    try:
        return path.lstat()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise _unreadable(path, error.strerror or str(error)) from error


def _is_regular(path: Path) -> bool:
    found = _lstat(path)
    return found is not None and stat.S_ISREG(found.st_mode)


def _unreadable(path: Path, reason: str) -> ConfigurationError:
    return ConfigurationError.stating(
        f"The key file {path} cannot be read: {reason}.", fix="Delete it; new keys are then created."
    )


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
    try:
        expected = contract_mac(
            secret,
            nonce,
            sequence,
            message.contract,
            issued=message.issued,
            expires=message.expires,
            scene_version=message.scene_version,
        )
    except struct_error:  # a number that no code represents
        return False
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
