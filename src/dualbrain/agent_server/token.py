"""The bearer token of the HTTP server, in a file that only its user can read."""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from pathlib import Path

from dualbrain.core.storage.private_files import create_private_folder, open_private, tighten
from dualbrain.errors import ConfigurationError

TOKEN_VARIABLE = "DUALBRAIN_TOKEN"
"""Environment variable with a token, which has precedence over the file."""
MIN_LENGTH, MAX_LENGTH = 16, 512
"""Shortest and longest token [characters]."""


def load_token(path: Path, environ: Mapping[str, str]) -> str:
    """The token in the environment, else the one in the file `path`, which is created with a random token.

    Raises `ConfigurationError` for a token that is too short or not printable, and for a file that cannot be read.
    """
    if given := environ.get(TOKEN_VARIABLE, ""):
        return _checked(given, f"the environment variable {TOKEN_VARIABLE}", "Unset it, or set another one.")
    try:
        create_private_folder(path.parent)
        if not path.exists():
            with open_private(path, "xb") as file:
                file.write(secrets.token_urlsafe(32).encode() + b"\n")
                os.fsync(file.fileno())
        tighten(path)
        text = path.read_text(encoding="ascii")
    except (OSError, ValueError) as error:
        raise ConfigurationError.stating(
            f"The token file {path} cannot be used: {error}.", fix="Name another file with --token-file."
        ) from error
    return _checked(text.strip(), f"the file {path}", "Delete it; a new token is then made.")


def _checked(token: str, where: str, fix: str) -> str:
    if MIN_LENGTH <= len(token) <= MAX_LENGTH and token.isascii() and token.isprintable() and " " not in token:
        return token
    raise ConfigurationError.stating(
        f"The token in {where} is not {MIN_LENGTH} to {MAX_LENGTH} printable characters without spaces.",
        fix=fix,
    )
