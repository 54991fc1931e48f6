"""A disk that fills up during a run: the arm comes to rest, and episode, ledger and recording are complete."""

import json
import shutil

import pytest

from dualbrain.control.recording.channels import read_recording, recording_state
from dualbrain.control.recording.replay import replay
from dualbrain.control.recording.trace import Event
from dualbrain.errors import ConfigurationError
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.runtime.backends.gatekeeper import GatekeeperBackend
from dualbrain.runtime.config import RunObserver
from dualbrain.runtime.run_folder import RESERVED_BYTES
from dualbrain.runtime.session import Session
from tests.stories.story_session import (
    GRASP,
    PLACE,
    contract_text,
    ledger_episodes,
    ledger_kinds,
    make_clocks,
    run_config,
    run_session,
)
from tests.support.small_disk import fill, mounted_disk

DISK_MEGABYTES, FREE_MEGABYTES = 48, 24
"""Size of the disk, and its free space at the beginning of a run: the reserved space and that of a few seconds."""
PICK_AND_PLACE = contract_text(("grasp", GRASP), ("place", PLACE))


@pytest.fixture(autouse=True)
def encoder_without_weights(monkeypatch):
    monkeypatch.setattr(MiniLmEncoder, "from_cache", classmethod(lambda cls, cache: HashingEncoder()))


@pytest.fixture
def small_disk(tmp_path):
    with mounted_disk(tmp_path / "disk", DISK_MEGABYTES) as folder:
        yield folder


def filling_observer(folder):
    """An observer that fills the disk when the first action begins, and the list of its events.

    Most of the disk is filled before: the last part takes a few milliseconds, which no control loop notices.
    """
    events = []
    surplus = shutil.disk_usage(folder).free - FREE_MEGABYTES * 1024 * 1024
    if surplus > 0:
        (folder / "other").write_bytes(bytes(surplus))

    def on_event(event):
        if event.kind == "action" and not any(one.kind == "action" for one in events):
            fill(folder)
        events.append(event)

    return RunObserver(on_event=on_event), events


def check_run(config, episode, events):
    assert episode.outcome.kind == "stopped", (episode.outcome.reason, events)
    recording = config.out / "episode.mcap"
    for part in (str(recording), "No space left on device", "Free some space"):
        assert part in episode.outcome.reason
    assert any(one.kind == "fault" and str(recording) in one.text for one in events), "it is reported at once"
    stored = json.loads((config.out / "episode.json").read_bytes())
    assert stored["outcome"]["kind"] == "stopped"
    assert ledger_kinds(config.ledger) == ["run_started", "episode", "run_ended"]
    assert len(ledger_episodes(config.ledger)) == 1
    assert recording_state(recording).complete
    assert replay(recording).identical


def test_a_full_disk_loses_nothing_of_a_run(small_disk):
    config, (observer, events) = run_config(small_disk), filling_observer(small_disk)
    story = run_session(config, PICK_AND_PLACE, observer=observer)
    check_run(config, story.episode, events)
    recorded = [one for one in read_recording(config.out / "episode.mcap") if isinstance(one, Event)]
    assert any("recording_lost" in one.text for one in recorded)
    assert not [path.name for path in config.out.iterdir() if path.name.startswith(".")]


@pytest.mark.realtime
def test_a_full_disk_loses_nothing_of_a_run_behind_a_gatekeeper(small_disk):
    config, (observer, events) = run_config(small_disk), filling_observer(small_disk)
    with Session(config, make_clocks(), {}, ScriptedPlanner((PICK_AND_PLACE,)), GatekeeperBackend()) as session:
        result = session.run(observer)
    check_run(config, result.episode, events)


def test_a_run_does_not_start_without_reserved_space_and_leaves_no_trace(small_disk):
    (small_disk / "large").write_bytes(bytes(DISK_MEGABYTES * 1024 * 1024 - 2 * RESERVED_BYTES - 1_000_000))
    config = run_config(small_disk)
    with pytest.raises(ConfigurationError, match="8 MB for the end of the recording cannot be reserved") as raised:
        run_session(config, PICK_AND_PLACE)
    assert "Free some space" in str(raised.value)
    assert not config.out.exists()
    assert not config.ledger.exists()


def test_an_operator_may_choose_to_start_and_move_unrecorded(small_disk):
    (small_disk / "large").write_bytes(bytes(36 * 1024 * 1024))
    config = run_config(small_disk, unrecorded=True)
    story = run_session(config, PICK_AND_PLACE, observer=filling_observer(small_disk)[0])
    assert story.episode.outcome.kind == "succeeded"
    assert json.loads((config.out / "config.json").read_bytes())["unrecorded"] is True


def test_space_for_the_ledger_is_reserved_on_its_own_disk(tmp_path, small_disk):
    config = run_config(tmp_path, ledger=small_disk / "ledger.sqlite")
    observer, _ = filling_observer(small_disk)
    story = run_session(config, contract_text(("hold", {"duration": 0.5})), observer=observer)
    assert story.episode.outcome.kind == "succeeded"
    with LedgerReader(config.ledger) as ledger:
        assert ledger.verify().is_intact
    assert "episode" in ledger_kinds(config.ledger)
    assert ledger_kinds(config.ledger)[-1] == "run_ended"
