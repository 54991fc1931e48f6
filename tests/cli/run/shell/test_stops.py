"""Lines of the shell beside a motion: a stop cancels every line before it, and `quit` in a script keeps its place."""

from io import StringIO

import pytest
from rich.console import Console

from dualbrain.cli.run.shell import shell as module
from dualbrain.cli.run.shell.options import ShellOptions
from dualbrain.cli.run.shell.shell import Shell


class SlowWorker:
    """A worker whose loading and instructions last until `end`; `stops` and `submitted` record the calls."""

    def __init__(self, *_):
        self.busy = self.loading = True
        self.submitted, self.history, self.stops, self.failure = [], [], 0, None

    def submit(self, instruction):
        assert not self.busy
        self.submitted.append(instruction)
        self.busy = True
        return ""

    def interrupt(self):
        self.stops += 1

    def end(self):
        self.busy = self.loading = False

    def close(self):
        pass


@pytest.fixture
def play(monkeypatch):
    """Run a shell with scripted events: a line that arrives, or the name of a method that is called meanwhile."""

    def run(*events, terminal=False):
        class Reader:
            is_terminal = terminal

            def __init__(self):
                self.waiting = list(events)

            @property
            def ended(self):
                return not self.waiting

            def wait(self):
                event = self.waiting.pop(0)
                if callable(event):
                    event(shell)
                    return None
                return event

            def prompt(self):
                return self.waiting.pop(0) if self.waiting else None

            def wake(self):
                pass

            show_prompt = close = wake

        monkeypatch.setattr(module, "LineReader", Reader)
        monkeypatch.setattr(module, "InstructionWorker", SlowWorker)
        monkeypatch.setattr("dualbrain.cli.run.stop_command.stop_running_robots", lambda _: [])
        out = StringIO()
        shell = Shell(ShellOptions(), Console(file=out, width=200))
        shell.worker.exit_code = shell.run()
        return shell.worker, out.getvalue()

    return run


def end(shell):
    """Loading, or the present instruction, ends."""
    shell.worker.end()


def signal_stop(shell):
    """Ctrl-C is pressed."""
    shell._on_signal(2, None)


def test_quit_in_a_script_waits_for_the_instruction_before_it(play):
    worker, out = play(end, "rest", "quit", end)
    assert worker.submitted == ["rest"]
    assert "stopping" not in out


def test_quit_on_a_terminal_stops_at_once(play):
    worker, _ = play(end, "rest", "quit", end, terminal=True)
    assert worker.stops


@pytest.mark.parametrize("stop", ["stop", "Halt!", signal_stop, lambda shell: shell.worker.interrupt()])
def test_a_stop_cancels_the_lines_before_it_and_none_after_it(play, stop):
    worker, out = play("one", "two", end, "three", stop, "four", end, end)
    assert worker.submitted == ["one", "four"]
    assert "discarded, because a stop followed: two" in out
    assert "discarded, because a stop followed: three" in out


def test_a_stop_before_the_planner_is_loaded_cancels_the_instruction(play):
    worker, out = play("one", "stop", "two", end, end)
    assert worker.submitted == ["two"]
    assert "stopping" not in out


def test_the_exit_code_states_that_an_instruction_was_discarded(play):
    assert play("one", end, end)[0].exit_code == 0
    assert play("help", "stop", end)[0].exit_code == 0
    worker, _ = play("one", "stop", end)
    assert worker.submitted == []
    assert worker.exit_code == 130


@pytest.mark.parametrize("words", ["can you stop please", "stop, it hurts", "you must stop", "no!", "ouch"])
def test_a_person_at_the_terminal_stops_a_motion_in_any_words(play, words):
    assert "stopping" in play(end, "one", words, end, terminal=True)[1]
    assert "stopping" not in play(end, "one", "put the tin in the bowl", end, terminal=True)[1]


def test_help_is_a_command_and_during_a_motion_the_cry_of_a_person(play):
    worker, out = play("help", end, "one", "help!", end, terminal=True)
    assert worker.submitted == ["one"]
    assert out.count("An instruction in words") == 1
    assert "stopping: the arm brakes to rest" in out
    worker, out = play("help", end, "one", "help", end)
    assert worker.submitted == ["one"]
    assert out.count("An instruction in words") == 2
    assert "stopping" not in out
