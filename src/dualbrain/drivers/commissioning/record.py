"""The sealed record of a commissioning: a gatekeeper opens no hardware without one that fits what is there now.

    seal = SHA-256(robot, driver, answers, SHA-256(body as the site narrows it), SHA-256(site file))

The seal tells that nothing was changed since somebody answered; it does not tell who did. Whoever may write the file
may seal it again.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import msgspec

from dualbrain.drivers.catalogue import DriverKind
from dualbrain.drivers.commissioning.checklist import Checklist, limit_flaws
from dualbrain.errors import UNREADABLE, InvalidSetup
from dualbrain.robots.loader import encode
from dualbrain.robots.model import Body

VERSION = 1
HOW = "Fill in a checklist at the arm: dualbrain robot commission CHECKLIST --driver … --site …"


class NotCommissioned(InvalidSetup):
    """Hardware that nobody has answered for, or that is not what was answered for."""


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What was answered, for which body and site, and the seal over all of it."""

    version: int
    robot: str
    driver: str
    answers: Checklist
    body: str
    site: str
    seal: str = ""


def sealed(answers: Checklist, body: Body, site: Path, kind: DriverKind) -> Record:
    """The record of `answers` that will do; `body` is the one that the site file has narrowed."""
    record = Record(VERSION, body.name, kind.name, answers, body_hash(body), _file_hash(site))
    return msgspec.structs.replace(record, seal=_seal(record))


def demand(path: Path | None, body: Body, site: Path | None, kind: DriverKind) -> Record:
    """The record in `path`, if it is whole and about this body, this site file and this driver.

    Raises:
        NotCommissioned: there is none, it was changed, or body, site or driver are not what they were.
    """
    if path is None or site is None:
        missing = "no commissioning record" if path is None else "no site file"
        raise NotCommissioned(f"hardware ({kind.name})", got=missing, allowed="a record and its site file", fix=HOW)
    record = _read(path)
    now = {
        "robot": body.name, "driver": kind.name, "body": body_hash(body), "site": _file_hash(site),
    }  # fmt: skip
    for name, value in now.items():
        if getattr(record, name) != value:
            what = "another" if name in ("robot", "driver") else "a changed"
            raise NotCommissioned(
                f"{name} of the commissioning", got=f"{what} {name} than was answered for: {value[:16]}",
                allowed=getattr(record, name)[:16], fix=HOW,
            )  # fmt: skip
    if wrong := limit_flaws(body, kind):
        raise NotCommissioned(wrong[0].item, got=wrong[0].got, allowed=wrong[0].allowed, fix=HOW)
    return record


def body_hash(body: Body) -> str:
    """SHA-256 of a body as it is encoded: limits, cover, tool and all."""
    return sha256(encode(body)).hexdigest()


def _read(path: Path) -> Record:
    try:
        record = msgspec.json.decode(path.read_bytes(), type=Record)
    except (OSError, *UNREADABLE) as error:
        raise NotCommissioned("commissioning record", got=str(error), allowed="what was sealed", fix=HOW) from error
    if record.version != VERSION or record.seal != _seal(record):
        raise NotCommissioned("commissioning record", got="a seal that is not its own", allowed="unchanged", fix=HOW)
    return record


def _seal(record: Record) -> str:
    return sha256(msgspec.json.encode(msgspec.structs.replace(record, seal=""), order="deterministic")).hexdigest()


def _file_hash(path: Path) -> str:
    try:
        return sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise NotCommissioned("site file", got=error.strerror, allowed="the one that was answered for") from error
