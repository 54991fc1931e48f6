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
from dualbrain.drivers.commissioning.checklist import Checklist, find_limit_flaws
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.robots.loader import encode_robot
from dualbrain.robots.model import RobotModel

RECORD_VERSION = 1
FIX_HINT = "Fill in a checklist at the arm: dualbrain robot commission CHECKLIST --driver … --site …"


class NotCommissionedError(ConfigurationError):
    """Hardware that nobody has answered for, or that is not what was answered for."""


class CommissioningRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What was answered, for which body and site, and the seal over all of it."""

    version: int
    robot: str
    driver: str
    answers: Checklist
    body: str
    site: str
    seal: str = ""


def make_record(answers: Checklist, robot_model: RobotModel, site: Path, kind: DriverKind) -> CommissioningRecord:
    """The record of `answers` that will do; `body` is the one that the site file has narrowed."""
    record = CommissioningRecord(
        version=RECORD_VERSION,
        robot=robot_model.name,
        driver=kind.name,
        answers=answers,
        body=model_hash(robot_model),
        site=_file_hash(site),
    )
    return msgspec.structs.replace(record, seal=_seal(record))


def require_record(
    path: Path | None, robot_model: RobotModel, site: Path | None, kind: DriverKind
) -> CommissioningRecord:
    """The record in `path`, if it is whole and about this body, this site file and this driver.

    Raises:
        NotCommissioned: there is none, it was changed, or body, site or driver are not what they were.
    """
    if path is None or site is None:
        missing = "no commissioning record" if path is None else "no site file"
        raise NotCommissionedError(
            f"hardware ({kind.name})", got=missing, allowed="a record and its site file", fix=FIX_HINT
        )
    record = _read_record(path)
    now = {
        "robot": robot_model.name,
        "driver": kind.name,
        "body": model_hash(robot_model),
        "site": _file_hash(site),
    }
    for name, value in now.items():
        if getattr(record, name) != value:
            what = "another" if name in ("robot", "driver") else "a changed"
            raise NotCommissionedError(
                f"{name} of the commissioning",
                got=f"{what} {name} than was answered for: {value[:16]}",
                allowed=getattr(record, name)[:16],
                fix=FIX_HINT,
            )
    if wrong := find_limit_flaws(robot_model, kind):
        raise NotCommissionedError(wrong[0].item, got=wrong[0].got, allowed=wrong[0].allowed, fix=FIX_HINT)
    return record


def model_hash(robot_model: RobotModel) -> str:
    """SHA-256 of a body as it is encoded: limits, cover, tool and all."""
    return sha256(encode_robot(robot_model)).hexdigest()


def _read_record(path: Path) -> CommissioningRecord:
    try:
        record = msgspec.json.decode(path.read_bytes(), type=CommissioningRecord)
    except (OSError, *DECODE_ERRORS) as error:
        raise NotCommissionedError(
            "commissioning record", got=str(error), allowed="what was sealed", fix=FIX_HINT
        ) from error
    if record.version != RECORD_VERSION or record.seal != _seal(record):
        raise NotCommissionedError(
            "commissioning record", got="a seal that is not its own", allowed="unchanged", fix=FIX_HINT
        )
    return record


def _seal(record: CommissioningRecord) -> str:
    return sha256(msgspec.json.encode(msgspec.structs.replace(record, seal=""), order="deterministic")).hexdigest()


def _file_hash(path: Path) -> str:
    try:
        return sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise NotCommissionedError("site file", got=error.strerror, allowed="the one that was answered for") from error
