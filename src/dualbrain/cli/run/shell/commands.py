"""Commands of the shell: help, scene, history, memory, home, undo, reset."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from dualbrain.cli.common.console import format_table

if TYPE_CHECKING:
    from dualbrain.cli.run.shell.shell import Shell

QUIT_WORDS = ("quit", "exit")
HELP = """\
An instruction in words, such as: put the red cube in the bowl
  scene     objects and places, and where they are now
  history   instructions of this shell with outcome and run folder
  memory    the newest memories: instruction, age, weight, outcome
  home      move the arm to its home position (an instruction)
  stop      stop the motion, at any time; so do Ctrl-C and words such as "halt" and "help"
  reset     begin the next instruction with the scene as it was at the start (a simulation only)
  undo      explains how to take a step back
  quit      leave (also Ctrl-D)
An instruction that is called like a command needs another word, such as: please go home"""
UNDO = """\
A motion cannot be undone: the world has changed, and the way back needs a plan of its own. Give an instruction, such as
"put the red cube to the left of the bowl", or `home`; in a simulation `reset` begins again."""
HOME_INSTRUCTION = "go home"
LISTED_MEMORIES = 10


def print_help(shell: Shell) -> None:
    """Print all commands."""
    shell.console.print(HELP, markup=False)


def print_scene(shell: Shell) -> None:
    """Print the objects at their present positions, and the places."""
    from dualbrain.cli.scenes.scene_table import scene_lines
    from dualbrain.runtime.run_folder import END_STATE_FILE
    from dualbrain.simulation.plant.end_state import load_end_state
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    after, held = shell.worker.after, ""
    if after is None:
        spec = open_scene(shell.options.scene, shell.options.robot)
    else:
        end = load_end_state(after / END_STATE_FILE)
        spec, held = end.scene, end.held
    for line in scene_lines(spec, held=held):
        shell.console.print(line, markup=False, soft_wrap=True)


def print_history(shell: Shell) -> None:
    """Print the instructions of this shell."""
    entries = shell.worker.history
    if not entries:
        shell.console.print("No instruction was given yet.")
        return
    rows = [(str(k), one.instruction, one.outcome, str(one.folder or "")) for k, one in enumerate(entries, 1)]
    heads = ("#", "instruction", "outcome", "run folder")
    shell.console.print(format_table(heads, rows, wrap_columns=("instruction",)), markup=False, soft_wrap=True)


def print_memory(shell: Shell) -> None:
    """Print the newest memories."""
    from dualbrain.cli.memory.browse import list_memories

    list_memories(limit=LISTED_MEMORIES, ledger=shell.options.ledger)


def go_home(shell: Shell) -> None:
    """Give the instruction to go home."""
    if reason := shell.worker.submit(HOME_INSTRUCTION):
        shell.console.print(reason)


def explain_undo(shell: Shell) -> None:
    """Print why a motion cannot be undone, and the alternatives."""
    shell.console.print(UNDO, markup=False)


def reset(shell: Shell) -> None:
    """Begin again with the scene of the start."""
    shell.worker.reset()
    shell.console.print("The next instruction begins with the scene as it was at the start.")


SHELL_COMMANDS: Mapping[str, Callable[[Shell], None]] = {
    "help": print_help,
    "scene": print_scene,
    "history": print_history,
    "memory": print_memory,
    "home": go_home,
    "undo": explain_undo,
    "reset": reset,
}
"""Commands by the line that calls them; everything else is an instruction."""
