"""`dualbrain doctor --target`: robot and kernel of the firmware on an emulated board."""

import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.safety.cbf import kernel
from dualbrain.safety.target import emulated_board, target_filter


def test_doctor_compares_the_kernel_that_the_board_states_with_this_computer(run_command, monkeypatch):
    code, out, _ = run_command("doctor", "--target", "an386")
    assert code == ExitCode.SUCCESS, out
    assert f"source hash {kernel.kernel_hash()}, as on this computer" in " ".join(out.split())
    monkeypatch.setattr(kernel, "kernel_hash", lambda: "0123456789abcdef")  # a later kernel on the host
    code, out, _ = run_command("doctor", "--target", "an386")
    assert code == ExitCode.SETUP
    assert "this computer has 0123456789abcdef: build the firmware again" in " ".join(out.split())


@pytest.mark.parametrize(("board", "hint"), [("an9", "Known: an386, an500, an505"), ("an386", "qemu-system-arm")])
def test_doctor_states_why_a_board_cannot_be_checked(run_command, monkeypatch, board, hint):
    monkeypatch.setattr(emulated_board.shutil, "which", lambda name: None)
    monkeypatch.setattr(target_filter, "build_firmware", lambda *_: "unused")
    code, out, _ = run_command("doctor", "--target", board)
    assert code == ExitCode.SETUP
    assert hint in " ".join(out.split())
