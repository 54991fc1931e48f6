"""Completed steps are kept, an interrupted step is repeated, and a folder has one user at a time."""

import os
import threading

import pytest

from dualbrain.core.storage.resumable_steps import exclusive_folder, run_steps
from dualbrain.errors import ConfigurationError


def append_number(number, here):
    file = here / "numbers"
    file.write_text((file.read_text() if file.exists() else "") + f"{number} ")


def test_each_step_continues_from_the_previous_one(tmp_path):
    assert (run_steps(tmp_path, 3, append_number) / "numbers").read_text() == "0 1 2 "
    assert (run_steps(tmp_path, 5, append_number) / "numbers").read_text() == "0 1 2 3 4 "
    assert [path.name for path in tmp_path.glob("step-*")] == ["step-0005"]


def test_a_failed_step_is_repeated_from_its_beginning(tmp_path):
    def fail_at_two(number, here):
        append_number(number, here)
        if number == 2:
            raise RuntimeError

    with pytest.raises(RuntimeError):
        run_steps(tmp_path, 4, fail_at_two)
    assert (run_steps(tmp_path, 4, append_number) / "numbers").read_text() == "0 1 2 3 "


def test_the_files_of_a_step_are_synced_before_it_is_completed(tmp_path, monkeypatch):
    synced, fsync = [], os.fsync

    def recording_fsync(descriptor):
        synced.append((os.fstat(descriptor).st_ino, bool(list(tmp_path.glob("step-*")))))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", recording_fsync)
    last = run_steps(tmp_path, 1, append_number)
    assert synced == [
        ((last / "numbers").stat().st_ino, False),
        (last.stat().st_ino, False),
        (tmp_path.stat().st_ino, True),
    ]


def test_the_initial_folder_is_copied_and_stays_unchanged(tmp_path):
    initial = run_steps(tmp_path / "start", 1, append_number)
    for name in ("one", "other"):
        last = run_steps(tmp_path / name, 2, append_number, initial_folder=initial)
        assert (last / "numbers").read_text() == "0 0 1 "
    assert (initial / "numbers").read_text() == "0 "


def test_two_threads_that_run_the_same_steps_run_each_step_once(tmp_path):
    done = []

    def record(number, here):
        done.append(number)
        append_number(number, here)

    threads = [threading.Thread(target=run_steps, args=(tmp_path, 20, record)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert done == list(range(20))


def test_without_waiting_a_folder_in_use_is_an_error(tmp_path):
    with (
        exclusive_folder(tmp_path, wait=False),
        pytest.raises(ConfigurationError, match=r"Another process works in this folder.*another folder"),
        exclusive_folder(tmp_path, wait=False),
    ):
        pass
    with exclusive_folder(tmp_path, wait=False):
        pass
