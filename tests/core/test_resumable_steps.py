import threading

import pytest

from dualbrain.core.storage.resumable_steps import exclusive_folder, run_steps
from dualbrain.errors import ConfigurationError


def note(number, here):
    file = here / "told"
    file.write_text((file.read_text() if file.exists() else "") + f"{number} ")


def test_each_step_goes_on_from_the_one_before(tmp_path):
    assert (run_steps(tmp_path, 3, note) / "told").read_text() == "0 1 2 "
    assert (run_steps(tmp_path, 5, note) / "told").read_text() == "0 1 2 3 4 "
    assert [path.name for path in tmp_path.glob("step-*")] == ["step-0005"]


def test_a_step_that_broke_is_done_again_and_nothing_of_it_stays(tmp_path):
    def breaks(number, here):
        note(number, here)
        if number == 2:
            raise RuntimeError

    with pytest.raises(RuntimeError):
        run_steps(tmp_path, 4, breaks)
    assert (run_steps(tmp_path, 4, note) / "told").read_text() == "0 1 2 3 "


def test_a_start_is_copied_and_stays_as_it_is(tmp_path):
    begun = run_steps(tmp_path / "start", 1, note)
    for name in ("one", "other"):
        assert (run_steps(tmp_path / name, 2, note, initial_folder=begun) / "told").read_text() == "0 0 1 "
    assert (begun / "told").read_text() == "0 "


def test_two_that_want_the_same_steps_do_them_once(tmp_path):
    done = []

    def slow(number, here):
        done.append(number)
        note(number, here)

    both = [threading.Thread(target=run_steps, args=(tmp_path, 20, slow)) for _ in range(2)]
    for one in both:
        one.start()
    for one in both:
        one.join()
    assert done == list(range(20))


def test_who_does_not_want_to_wait_is_told_that_somebody_is_there(tmp_path):
    with (
        exclusive_folder(tmp_path, wait=False),
        pytest.raises(ConfigurationError, match=r"another process works in it.*another folder"),
        exclusive_folder(tmp_path, wait=False),
    ):
        pass
    with exclusive_folder(tmp_path, wait=False):
        pass
