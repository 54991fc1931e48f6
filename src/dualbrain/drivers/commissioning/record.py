"""Commissioning record: a gatekeeper opens no hardware without a record that fits the present robot and site.

    checksum = SHA-256(robot, driver, answers, SHA-256(robot model narrowed by the site), SHA-256(site file))

The checksum (the field `seal`) detects changes of the record since the commissioning. It is not a signature: any
process that may write the file can compute a new checksum.
"""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import msgspec

from dualbrain.core.storage.checksum import file_sha256
from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.drivers.catalogue import DriverKind
from dualbrain.drivers.commissioning.checklist import Checklist, find_limit_flaws
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.robots.loader import encode_robot
from dualbrain.robots.model import RobotModel

RECORD_VERSION = 1
MAX_RECORD_BYTES = 1 << 20
FIX_HINT = "Commission the arm: dualbrain robot commission CHECKLIST --driver … --site …"
FIELD_NAMES = {"robot": "robot", "driver": "driver", "body": "robot model", "site": "site file"}
"""Names of the compared fields of a record, for messages."""


class NotCommissionedError(ConfigurationError):
    """Hardware without a commissioning record, or with one that does not fit robot, site or driver."""


class CommissioningRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The answers, the robot, driver, and SHA-256 of robot model (`body`) and site file, and the checksum (`seal`)."""

    version: int
    robot: str
    driver: str
    answers: Checklist
    body: str
    site: str
    seal: str = ""


def make_record(answers: Checklist, robot_model: RobotModel, site: Path, kind: DriverKind) -> CommissioningRecord:
    """The record of acceptable `answers`; `robot_model` is the model after narrowing by the file `site`."""
    record = CommissioningRecord(
        version=RECORD_VERSION,
        robot=robot_model.name,
        driver=kind.name,
        answers=answers,
        body=model_hash(robot_model),
        site=_file_hash(site),
    )
    return msgspec.structs.replace(record, seal=_checksum(record))


def require_record(
    path: Path | None, robot_model: RobotModel, site: Path | None, kind: DriverKind
) -> CommissioningRecord:
    """The record in the file `path`, if it is unchanged and fits this robot model, site file and driver.

    Raises:
        NotCommissionedError: There is no record, it was changed, or robot model, site file or driver have changed.
    """
    if path is None or site is None:
        missing = "a commissioning record" if path is None else "a site file"
        raise NotCommissionedError.stating(f"The driver {kind.name!r} needs {missing}.", fix=FIX_HINT)
    record = _read_record(path)
    now = {
        "robot": robot_model.name,
        "driver": kind.name,
        "body": model_hash(robot_model),
        "site": _file_hash(site),
    }
    for name, value in now.items():
        if getattr(record, name) != value:
            raise NotCommissionedError(
                f"{FIELD_NAMES[name]} of the commissioning record {path}",
                got=value[:16],
                allowed=getattr(record, name)[:16],
                fix=f"It has changed since the commissioning. {FIX_HINT}",
            )
    if flaws := find_limit_flaws(robot_model, kind):
        raise NotCommissionedError(flaws[0].item, got=flaws[0].got, allowed=flaws[0].allowed, fix=FIX_HINT)
    return record


def model_hash(robot_model: RobotModel) -> str:
    """SHA-256 of the encoded robot model: limits, spheres, tool and all other entries."""
    return sha256(encode_robot(robot_model)).hexdigest()


def _read_record(path: Path) -> CommissioningRecord:
    content = read_regular_file(path, MAX_RECORD_BYTES)
    if isinstance(content, FileRefusal):
        raise NotCommissionedError.stating(
            f"The commissioning record {path} cannot be read: {content.sentence}", fix=FIX_HINT
        )
    try:
        record = msgspec.json.decode(content, type=CommissioningRecord)
    except DECODE_ERRORS as error:
        raise NotCommissionedError.stating(
            f"The commissioning record {path} cannot be read: {error}.", fix=FIX_HINT
        ) from error
    if record.version != RECORD_VERSION or record.seal != _checksum(record):
        raise NotCommissionedError.stating(
            f"The commissioning record {path} was changed: its checksum does not match.", fix=FIX_HINT
        )
    return record


def _checksum(record: CommissioningRecord) -> str:
    return sha256(msgspec.json.encode(msgspec.structs.replace(record, seal=""), order="deterministic")).hexdigest()


def _file_hash(path: Path) -> str:
    try:
        return file_sha256(path)
    except OSError as error:
        raise NotCommissionedError.stating(
            f"The site file {path} cannot be read: {error.strerror}.", fix="Give the site file of the commissioning."
        ) from error
