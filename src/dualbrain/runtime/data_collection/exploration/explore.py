"""Exploration: alternatives are executed as siblings at the same places, in the kinematic twin.

Explore few, exploit many: without a value model every alternative is executed at each place, with one only its
choice. After any interruption the same call continues, and ends with the same trials.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from dualbrain.adaptation.synthetic.split import Split
from dualbrain.adaptation.value_model.value_model import ValueModel
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder, open_private
from dualbrain.grounding.alternatives import DEFAULT_ALTERNATIVE
from dualbrain.runtime.data_collection.exploration.place import Place, draw_place
from dualbrain.runtime.data_collection.exploration.trial import Trial, decode_trials, encode_trials, execute_siblings

TRIALS_FILE, PLACE_END = "trials.jsonl", b"\n\n"


def explore(
    folder: Path,
    n_places: int,
    *,
    robot: str = "panda",
    part: Split = "teach",
    seed: int = 0,
    value_model: ValueModel | None = None,
    on_place: Callable[[int, tuple[Trial, ...]], None] = lambda done, trials: None,
) -> tuple[Trial, ...]:
    """The trials at `n_places` places drawn from `seed`, stored in `folder`.

    All alternatives are executed at each place, or, with a `value_model`, only the one that it chooses. `on_place` gets
    the number of finished places and the trials of the last one.
    """
    create_private_folder(folder)
    path, trials = folder / TRIALS_FILE, list(read_trials(folder))
    if path.is_file():
        complete, separator, _ = path.read_bytes().rpartition(PLACE_END)
        write_atomically(path, complete + separator)  # without the place that a killed process was writing
    done = {(one.scene, one.object_name, one.destination) for one in trials}
    for index in range(n_places):
        place = nth_place(robot, part, seed, index)
        placement = place.placement
        if (place.scene_name, placement.object_name, placement.destination) in done:
            continue
        names = list(place.contracts())
        chosen = [value_model.choose(placement, names, DEFAULT_ALTERNATIVE)] if value_model else names
        new = execute_siblings(place, chosen)
        with open_private(path, "ab") as lines:
            lines.write(encode_trials(new) + b"\n")
        trials += new
        on_place(index + 1, new)
    return tuple(trials)


def nth_place(robot: str, part: Split, seed: int, index: int) -> Place:
    """Place number `index` of the sequence `seed`; it does not depend on the places before it."""
    return draw_place(robot, part, np.random.default_rng([seed, index, *part.encode()]))


def read_trials(folder: Path) -> tuple[Trial, ...]:
    """The trials of all places in `folder` that are complete; those of a place end with an empty line."""
    path = folder / TRIALS_FILE
    if not path.is_file():
        return ()
    complete, _, _ = path.read_bytes().rpartition(PLACE_END)
    return decode_trials(complete)
