"""Execution of the contracts and instructions of an agent, one at a time, as episodes in a thread of their own."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from secrets import token_hex
from threading import Lock

from msgspec.structs import replace

from dualbrain.agent_api.agent_resources import AgentResources, open_agent_resources
from dualbrain.agent_api.connection import Connection
from dualbrain.agent_api.event_feed import EventFeed
from dualbrain.agent_api.retries import RetryLog, contract_identity
from dualbrain.agent_api.saved_runs import ReportingMemory
from dualbrain.agent_api.submission import State, Submission, SubmissionReport
from dualbrain.contracts.gate.strict_json import MAX_BYTES, parse
from dualbrain.contracts.verdict import Rejected
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError
from dualbrain.control.gatekeeper.remote_executor import RemoteExecutor
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.core.storage.atomic_files import FileWriteError
from dualbrain.core.text import PrintableValue, to_printable
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.instruction.review import refuse_hostile
from dualbrain.grounding.instruction.stop_commands import is_stop_command
from dualbrain.memory.embedding.posture_features import PostureLimits
from dualbrain.planner.protocol import Planner
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.records import Episode
from dualbrain.runtime.agent import Agent
from dualbrain.runtime.episode import GroundTruth, log_weight_changes, run_episode
from dualbrain.runtime.planning.episode_request import EpisodeRequest
from dualbrain.runtime.planning.planning_time import PlanningClock

VERDICT_TIMEOUT = 10.0
"""Longest wait for the gate's verdict on a contract [s]."""
DEFAULT_CLIENT = "agent"
"""The author of contracts that name no client."""
RECENT = 20
"""Number of submissions that `recent` reports."""
CLOSED = "the program that commands the robot ended"
"""Reason of an outcome that the end of this program caused."""
OUTCOME_TIMEOUT = 1.2
"""Longest wait for the outcome of a contract that is stopped because this program ends [s]."""
KEPT_SUBMISSIONS = 100
"""Number of submissions whose reports are kept."""


class Executions:
    """Runs one submission after another; every method may be called from any thread."""

    def __init__(
        self,
        connection: Connection,
        feed: EventFeed,
        retries: RetryLog,
        *,
        planner: str | Planner | None,
        ledger: Path | None,
        runs: Path | None,
    ) -> None:
        """Open planner and memory in the thread that uses them; see `open_agent_resources` for its errors."""
        self._connection, self._feed, self._retries = connection, feed, retries
        self._lock, self._submissions, self._newest = Lock(), dict[str, Submission](), ""
        self._closing = False
        self._asking = Lock()  # the planner may still answer a request that was stopped
        self._now = _steady_clock()
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="episode")
        try:
            self._resources: AgentResources = self._worker.submit(
                open_agent_resources,
                connection.robot_model,
                planner=planner,
                ledger=ledger,
                runs=runs,
                posture_limits=PostureLimits.from_model(connection.model_without_site),
            ).result()
        except BaseException:
            self._worker.shutdown()
            raise

    @property
    def has_planner(self) -> bool:
        """Whether instructions can be planned."""
        return self._resources.planner is not None

    def next_id(self) -> str:
        """An id for a new contract."""
        with self._lock:
            return self._retries.next_id(self._now())

    def submit(self, data: bytes, instruction: str, client: str) -> SubmissionReport:
        """Submit the contract in `data` for `client`, and return the report as soon as there is a verdict."""
        contract_id, digest = contract_identity(data)
        if len(data) > MAX_BYTES:
            rejected = parse(data)
            assert isinstance(rejected, Rejected)
            return SubmissionReport(id=contract_id, state="rejected", rejected=rejected)
        name = contract_id or f"unread-{token_hex(4)}"
        with self._lock:
            earlier = self._retries.find(contract_id, digest, self._now()) if contract_id else None
            submission = earlier or self._begin_contract(name, digest, instruction, contract_id)
        if isinstance(submission, Rejected):
            return SubmissionReport(id=name, state="rejected", rejected=submission)
        if earlier is not None:
            return replace(submission.wait_for_verdict(VERDICT_TIMEOUT), repeated=True)
        agent = Agent(FixedContractPlanner(client, data), self._resources.memory)
        if (unrecorded := self._record_start(contract_id, submission)) is not None:
            submission.reject(unrecorded)
            return submission.report
        refused = self._start(submission, self._request(instruction, given=True), agent, retried=contract_id)
        if refused is not None:
            submission.reject(refused)
            if contract_id:
                self._record_end(contract_id, submission)  # without an end it would count as lost after a restart
        return submission.wait_for_verdict(VERDICT_TIMEOUT)

    def plan_and_run(self, instruction: str) -> SubmissionReport:
        """Begin to plan `instruction` with the robot's own planner; raises `ConfigurationError` if there is none."""
        planner = self._resources.planner
        if planner is None:
            raise ConfigurationError.stating(
                "This robot has no planner, so it cannot plan an instruction.", fix="Open it with a planner."
            )
        with self._lock:
            name = f"i-{token_hex(4)}"
            if (refused := self._busy()) is not None:
                return SubmissionReport(id=name, state="rejected", rejected=refused)
            submission = self._begin(name, "planning", "")
        resources = self._resources
        agent = Agent(planner, resources.memory, clause_classifier=resources.clause_classifier)
        refused = self._start(submission, self._request(instruction, given=False), agent, retried="")
        if refused is not None:
            submission.reject(refused)
        return submission.report

    def wait(self, submission_id: str, timeout: float | None) -> SubmissionReport | None:
        """The report on a submission ("": the newest) after its end, or after `timeout` [s]; None for an unknown id."""
        with self._lock:
            found = self._submissions.get(submission_id or self._newest) or self._retries.get(submission_id)
        return found.wait_for_end(timeout) if found else None

    def recent(self) -> list[SubmissionReport]:
        """The reports on the newest submissions, the newest first."""
        with self._lock:
            found = list(self._submissions.values())
        return [one.report for one in reversed(found[-RECENT:])]

    @property
    def in_progress(self) -> str:
        """The id of the submission in progress; "" without one."""
        with self._lock:
            newest = self._submissions.get(self._newest)
            return self._newest if newest is not None and not newest.has_ended else ""

    def interrupt(self) -> None:
        """Make the robot stop if a submission is in progress, and drop an answer that the planner has not given yet."""
        with self._lock:
            newest = self._submissions.get(self._newest)
        if newest is not None:
            newest.interrupt()

    def begin_close(self) -> None:
        """Begin to end a submission in progress, and reject further ones, without waiting."""
        with self._lock:
            self._closing, newest = True, self._submissions.get(self._newest)
        if newest is not None:
            newest.interrupt(CLOSED)

    def close(self) -> None:
        """End a submission in progress, whose episode is completed, and close planner and memory."""
        self.begin_close()
        self.wait("", OUTCOME_TIMEOUT)  # the arm brakes to rest, and the gatekeeper reports the outcome
        self._connection.client.close()
        self._worker.submit(self._resources.close).result()
        self._worker.shutdown()

    def _busy(self) -> Rejected | None:
        """The rejection while a submission is in progress, and after the end has begun; None otherwise."""
        newest = self._submissions.get(self._newest)
        if self._closing:
            return _reject(CLOSED, "a contract for a robot that is not being closed", "open the robot again")
        if newest is not None and not newest.has_ended:
            return _reject(
                f"{self._newest} is in progress", "one contract at a time", "wait for its outcome, or stop it"
            )
        return None

    def _begin_contract(self, name: str, digest: str, instruction: str, contract_id: str) -> Submission | Rejected:
        """A new submission of a contract, or its rejection; the lock is held."""
        if (refused := _reject_instruction(instruction) or self._busy()) is not None:
            return refused
        submission = self._begin(name, "checking", digest)
        if contract_id:
            self._retries.keep(contract_id, submission)
        return submission

    def _record_start(self, contract_id: str, submission: Submission) -> Rejected | None:
        """Write a submission to the file of the contracts before it can move the robot; the rejection if that fails.

        A slow disk delays this call only: no lock is held that a stop, a report or the end of the program needs.
        """
        if not contract_id:
            return None
        try:
            self._retries.add(contract_id, submission)
        except FileWriteError as error:
            return _reject(
                f"{error.path} was not written: {error.reason}",
                "a contract that is recorded on disk before the robot moves",
                f"{error.remedy} Then submit the contract again.",
            )
        return None

    def _start(self, submission: Submission, request: EpisodeRequest, agent: Agent, *, retried: str) -> Rejected | None:
        """Begin the episode of a submission; the rejection if the end of this program has begun."""
        with self._lock:
            if self._closing:
                return self._busy()
            self._worker.submit(self._run, submission, request, agent, retried=retried)
        return None

    def _begin(self, name: str, state: State, digest: str) -> Submission:
        """A new submission, which is the newest; the oldest one is forgotten."""
        submission = Submission(SubmissionReport(id=name, state=state), digest, self._now())
        self._submissions.pop(name, None)  # an id that was rejected before moves to the end
        self._submissions[name], self._newest = submission, name
        while len(self._submissions) > KEPT_SUBMISSIONS:
            del self._submissions[next(iter(self._submissions))]
        return submission

    def _request(self, instruction: str, *, given: bool) -> EpisodeRequest:
        """The request of an episode: a given contract has one shot, and nothing is retrieved for it."""
        now = datetime.now(UTC)
        request = EpisodeRequest(
            id=f"{now:%Y%m%d-%H%M%S}-{token_hex(3)}",
            started=now.isoformat(timespec="seconds"),
            instruction=instruction,
            seed=0,
            now=now.timestamp(),
        )
        if not given:
            return request
        return dataclasses.replace(request, max_shots=1, max_exemplars=0, instruction_check="given_contract")

    def _run(self, submission: Submission, request: EpisodeRequest, agent: Agent, *, retried: str) -> None:
        """Run one episode to its end; an exception before its outcome is known ends the submission as lost.

        If the gatekeeper does not even send a scene, the submission is rejected: nothing of it was sent.
        """
        before = self._feed.newest
        try:
            if (executor := self._connect(submission)) is not None:
                self._run_episode(submission, request, agent, executor, before)
        except Exception as error:  # every failure is reported to the client; the robot stays behind its gatekeeper
            submission.lose(f"{type(error).__name__}: {error}")
        if retried:
            self._record_end(retried, submission)

    def _connect(self, submission: Submission) -> RemoteExecutor | None:
        """The executor of a submission, with the present scene; None if the submission is rejected without it."""
        model = self._connection.robot_model
        log = FlightLog(
            Trace(model.n),
            None,
            lambda event: self._feed.add(event.t, event.kind, event.text, event.data),
            submission.on_attempt,
        )
        try:
            return RemoteExecutor(
                model,
                self._connection.client,
                log,
                lambda: submission.interrupted,
                interruption=lambda: submission.interruption,
            )
        except ConnectionLostError as error:
            hint = "nothing was sent, and nothing moved; open the robot again before the next try"
            submission.reject(_reject(f"no scene from the gatekeeper: {error}", "a gatekeeper that answers", hint))
            return None

    def _run_episode(
        self, submission: Submission, request: EpisodeRequest, agent: Agent, executor: RemoteExecutor, before: int
    ) -> None:
        """Run one episode through `executor`; its report has the events after the one with the number `before`."""
        memory = ReportingMemory(agent.memory)
        truth = GroundTruth(start_contract=lambda contract: None, judge=lambda: None, versions=self._resources.versions)
        own = agent.planner is self._resources.planner
        clock = PlanningClock(time.monotonic, measured=True, exclusive=self._asking if own else nullcontext())
        episode, stored = run_episode(request, dataclasses.replace(agent, memory=memory), executor, clock, truth)
        log_weight_changes(executor.log, executor.state.stamp, stored)
        unsaved = self._save_report(episode, before, executor.state.stamp)
        if memory.problem:
            self._feed.add(executor.state.stamp, "memory", memory.problem)
        submission.finish(episode, " ".join(filter(None, (unsaved, memory.problem))))

    def _record_end(self, contract_id: str, submission: Submission) -> None:
        """Write the end of a submission to the file of the contracts; a failure changes no outcome, and is an event."""
        try:
            self._retries.finish(contract_id, submission)
        except FileWriteError as error:
            problem = f"The end of {contract_id} is not recorded, so it is unknown after a restart: {error}"
            self._feed.add(self._connection.client.now, "recorder", problem)

    def _save_report(self, episode: Episode, before: int, now: float) -> str:
        """Save the report, with the events after the one with the number `before`; a failure is an event, too.

        Returns why the episode is not saved, "" if it is.
        """
        runs = self._resources.runs
        if runs is None:
            return ""
        if problem := runs.problem or runs.save_report(episode, self._feed.events_after(before)):
            self._feed.add(now, "recorder", problem)
        return runs.problem


def _reject_instruction(instruction: str) -> Rejected | None:
    """The rejection of a contract for an instruction that no contract is to fulfil; None for any other one."""
    if is_stop_command(instruction):
        hint = "stop the robot instead of submitting a contract"
    elif (refusal := refuse_hostile(instruction)) is not None:
        hint = refusal.reason
    else:
        return None
    return _reject(to_printable(instruction), "an instruction that a contract can fulfil", hint)


def _reject(got: PrintableValue, allowed: str, hint: str) -> Rejected:
    """A rejection of a submission as a whole, before the gate."""
    return Rejected(stage="authorization", pointer="", got=got, allowed=allowed, hint=hint)


def _steady_clock() -> Callable[[], float]:
    """A clock [s, 1970 UTC] that does not follow later jumps of the system time, which would release the kept ids."""
    offset = time.time() - time.monotonic()
    return lambda: offset + time.monotonic()
