"""A candidate in the champion's shadow: asked what the champion is asked, heard by nobody, written down.

Its answers move nothing; they tell how it does on real questions before it is promoted.
"""

from __future__ import annotations

from pathlib import Path
from statistics import median
from threading import Thread

import msgspec

from dualbrain.errors import InvalidSetup
from dualbrain.planner.protocol import STOP, Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal


class Glance(msgspec.Struct, frozen=True):
    """One question in the shadow: who answered it for good, and what the candidate would have said."""

    served: str
    candidate: str
    instruction: str
    served_text: str
    candidate_text: str
    finish: str
    seconds: float

    @property
    def same(self) -> bool:
        """Whether both answered alike."""
        return self.finish == STOP and self.candidate_text == self.served_text


class Shadowed:
    """Proposes with `serving`; `candidate` is asked afterwards, and what it says goes to `log`, one line each."""

    def __init__(self, serving: Planner, candidate: Planner, log: Path) -> None:
        """Let `candidate` stand in the shadow of `serving`."""
        self.serving, self._candidate, self._log = serving, candidate, log
        self._asking: Thread | None = None

    @property
    def name(self) -> str:
        """Who answers."""
        return self.serving.name

    def propose(self, request: PlanRequest) -> Proposal:
        """The answer of who serves; the robot need not wait for the shadow."""
        self._wait()
        proposal = self.serving.propose(request)
        self._asking = Thread(target=self._glance, args=(request, proposal), name="shadow", daemon=True)
        self._asking.start()
        return proposal

    def close(self) -> None:
        """End both, after the last answer of the candidate."""
        self._wait()
        self.serving.close()
        self._candidate.close()

    def _wait(self) -> None:
        if self._asking is not None:
            self._asking.join()

    def _glance(self, request: PlanRequest, served: Proposal) -> None:
        said = self._candidate.propose(request)
        glance = Glance(
            served.planner, said.planner, request.instruction, served.text, said.text, said.finish_reason,
            said.timings.get("total", 0.0),
        )  # fmt: skip
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("ab") as log:
            log.write(msgspec.json.encode(glance) + b"\n")


def glances(log: Path) -> tuple[Glance, ...]:
    """What was written down; a last line that a crash cut off never happened.

    Raises `InvalidSetup` for any other line that cannot be read.
    """
    if not log.is_file():
        return ()
    *lines, _torn = log.read_bytes().split(b"\n")
    try:
        return tuple(msgspec.json.decode(line, type=Glance) for line in lines)
    except msgspec.DecodeError as error:
        raise InvalidSetup("log of the shadow", got=str(error), allowed="as it was written", fix=str(log)) from error


def whole(seen: tuple[Glance, ...]) -> int:
    """How many answers came to their end."""
    return sum(one.finish == STOP for one in seen)


def summary(seen: tuple[Glance, ...]) -> str:
    """How a candidate did in the shadow, in words."""
    if not seen:
        return "never asked in the shadow"
    same = sum(one.same for one in seen)
    return (
        f"asked {len(seen)} times in the shadow: {whole(seen)} whole answers, {same} as who served, "
        f"{median(one.seconds for one in seen):.1f} s each (median)"
    )
