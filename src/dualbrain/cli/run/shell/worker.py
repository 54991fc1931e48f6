"""The thread of the shell that loads the planner and carries out one instruction after another.

Every instruction is a run as of `dualbrain run`: planner, gate, filter, recording, ledger and a run folder of its own.
It begins where the one before ended. Everything that must stay on one thread (database, graphics) is opened here.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from threading import RLock, Thread
from time import monotonic
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.planner_threads import planner_threads
from dualbrain.cli.common.spinner import Spinner
from dualbrain.cli.run.shell.options import HistoryEntry, ShellOptions
from dualbrain.errors import DualbrainError

if TYPE_CHECKING:
    from dualbrain.cli.run.live_feed import LiveFeed
    from dualbrain.control.gatekeeper.protocol.messages import OperatorAction
    from dualbrain.planner.protocol import Planner
    from dualbrain.records import Episode
    from dualbrain.runtime.backends.gatekeeper import GatekeeperBackend
    from dualbrain.runtime.config import RunConfig
    from dualbrain.runtime.session import Session

BUSY = "not accepted: an instruction is being carried out; stop it first"
STOPPING_ACTIONS = ("abort", "takeover", "estop", "shut_down")
"""Operator actions after which an instruction that waits is not carried out."""


class InstructionWorker:
    """Loads in the background, then carries out instructions; every method may be called from any thread.

    `failure` is the exception that ended the thread, None while it works. `stops` counts the stops, from any source:
    an instruction that waited during a stop is not carried out.
    """

    def __init__(self, options: ShellOptions, console: Console, on_idle: Callable[[], None]) -> None:
        """Start to load. `on_idle` is called after loading, after each instruction, and after a failure."""
        self._options, self._console, self._on_idle = options, console, on_idle
        self._queue: SimpleQueue[str | None] = SimpleQueue()
        self._lock = RLock()  # a signal handler may call `interrupt` while the same thread is in `submit`
        self._busy = self.loading = True
        self._stop_requested = False
        self.stops = 0
        self._session: Session | None = None
        self._backend: GatekeeperBackend | None = None
        self._planner: Planner | None = None
        self._planner_name = ""
        self._feed: LiveFeed | None = None
        self.after: Path | None = options.after
        self.history: list[HistoryEntry] = []
        self.failure: BaseException | None = None
        self._thread = Thread(target=self._work, name="instructions", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether the planner is being loaded, or an instruction is being carried out."""
        return self._busy

    def submit(self, instruction: str) -> str:
        """Begin an instruction; returns "" or the reason why it was not accepted."""
        with self._lock:
            if self._busy:
                return BUSY
            self._stop_requested = False
            self._busy = True  # last: a signal from here on stops this instruction
        self._queue.put(instruction)
        return ""

    def submit_from_page(self, instruction: str) -> str:
        """Begin an instruction that was entered in the live page; a request to stop stops the present one."""
        from dualbrain.grounding.instruction.stop_commands import asks_to_stop, is_stop_command

        if asks_to_stop(instruction) if self._busy else is_stop_command(instruction):
            self.interrupt()
            return ""
        return self.submit(instruction)

    def interrupt(self) -> None:
        """Stop the present instruction: the arm brakes to rest. Without one, only `stops` is increased."""
        with self._lock:
            self._stop_requested = True
            self.stops += 1
            if self._session is not None:
                self._session.interrupt()

    def reset(self) -> None:
        """Begin the next instruction with the scene as it was at the start of the shell."""
        self.after = self._options.after

    def close(self) -> None:
        """End the thread after the present instruction, and close everything."""
        self._queue.put(None)
        self._thread.join()

    # --- on the thread ------------------------------------------------------------------------------------------

    def _work(self) -> None:
        try:
            with ExitStack() as stack:
                self._load(stack)
                self._become_idle()
                for instruction in iter(self._queue.get, None):
                    self._try_instruction(instruction)
                    self._become_idle()
        except BaseException as error:
            self.failure = error
        finally:
            self._become_idle()

    def _become_idle(self) -> None:
        with self._lock:
            self._session, self._backend, self._busy, self.loading = None, None, False, False
        self._on_idle()

    def _load(self, stack: ExitStack) -> None:
        """Import what every instruction needs, check robot and scene, open the planner and the live view."""
        started = monotonic()
        from dualbrain.cli.common.planner_choice import choose_planner
        from dualbrain.cli.run import execution
        from dualbrain.runtime.run_resources import open_beginning, open_configured_planner, open_site

        del execution  # imported for what follows
        config = self._configure("")
        model = open_site(config).robot_model
        open_beginning(config)
        self._planner_name, notice = choose_planner(config.planner, config.robot, config.cache)
        if self._options.live_view:
            self._feed = self._open_feed(config)
            stack.callback(self._feed.close)
        threads = planner_threads(control_loop=self._options.real_time or self._options.live_view)
        config = replace(config, planner=self._planner_name, planner_threads=threads)
        self._planner = open_configured_planner(config, model, os.environ)
        stack.callback(self._planner.close)
        if notice:
            self._console.print(f"[yellow]{escape(notice)}[/]")
        self._console.print(f"[dim]ready: planner {escape(self._planner.name)}, {monotonic() - started:.1f} s[/]")

    def _open_feed(self, config: RunConfig) -> LiveFeed:
        from dualbrain.cli.run.live_feed import LiveFeed
        from dualbrain.runtime.run_resources import open_beginning, open_site
        from dualbrain.simulation.tasks.true_episode import exact_scene
        from dualbrain.simulation.world import make_world

        model, (spec, start) = open_site(config).robot_model, open_beginning(config)
        plant = make_world(spec, model, visuals=True, start=start.robot if start else None).plant
        operate = self._operate if self._options.real_time else None
        port, submit = self._options.port, self.submit_from_page
        feed = LiveFeed(model, plant, port, self._console, operate=operate, submit=submit)
        feed.show_at_rest(exact_scene(plant))
        return feed

    def _operate(self, action: OperatorAction, speed: float = 1.0) -> str:
        """Send an operator action to the gatekeeper of the present instruction."""
        if action in STOPPING_ACTIONS:
            with self._lock:
                self.stops += 1
        backend = self._backend
        return (
            backend.operate(action, speed) if backend else "nothing moves: there is no gatekeeper between instructions"
        )

    def _configure(self, instruction: str) -> RunConfig:
        """The configuration of one instruction, with a new run folder."""
        from dualbrain.runtime.config import default_config

        options, config = self._options, default_config(instruction, ledger=self._options.ledger)
        return replace(
            config,
            out=options.out / config.out.name,
            robot=options.robot,
            scene=options.scene,
            after=self.after,
            planner=self._planner_name or options.planner,
            site=options.site,
            seed=options.seed,
            tries=options.tries,
            consult=options.consult,
            reuse_contracts=options.reuse_contracts,
            measured=options.live_view,
        )

    def _try_instruction(self, instruction: str) -> None:
        """Carry out an instruction; a set-up that is refused is printed, and the shell continues."""
        try:
            entry = self._carry_out(instruction)
        except (DualbrainError, OSError) as error:
            self._console.print(f"[red]{escape(str(error))}[/]")
            entry = HistoryEntry(instruction=instruction, outcome="not run", code=ExitCode.SETUP, folder=None)
            if self._feed:
                self._feed.show_line(f"not run: {error}", "bad")
        self.history.append(entry)

    def _carry_out(self, instruction: str) -> HistoryEntry:
        from dualbrain.cli.run.execution import RunView, make_backend, make_clocks, print_title, run_session
        from dualbrain.runtime.run_folder import END_STATE_FILE
        from dualbrain.runtime.session import Session

        options, config = self._options, self._configure(instruction)
        view = RunView(
            live_view=options.live_view, real_time=options.real_time, speed_scale=options.speed_scale, port=options.port
        )
        self._backend = backend = make_backend(view)
        with ExitStack() as stack:
            with Spinner(self._console, "preparing"):
                session = stack.enter_context(
                    Session(config, make_clocks(view), os.environ, self._planner, backend=backend)
                )
            self._enter(session)
            print_title(self._console, session)
            if self._feed:
                self._feed.follow(session.plant)
            result, report = run_session(session, backend, self._console, self._feed)
            report()
        if (config.out / END_STATE_FILE).exists():
            self.after = config.out
        return self._record(config, result.episode)

    def _enter(self, session: Session) -> None:
        """Make the session the present one, and stop it if that was requested meanwhile."""
        with self._lock:
            self._session = session
            if self._stop_requested:
                session.interrupt()

    def _record(self, config: RunConfig, episode: Episode) -> HistoryEntry:
        from dualbrain.cli.run.execution import describe_end, exit_code

        code, outcome = exit_code(episode), describe_end(episode)
        if self._feed:
            tone = "good" if code is ExitCode.SUCCESS else "bad"
            self._feed.show_line(f"{outcome}: {episode.outcome.reason}", tone)
        return HistoryEntry(instruction=config.instruction, outcome=outcome, code=code, folder=config.out)
