"""The experiment under a PREEMPT_RT kernel: the program on this machine, its output, the verdict, missing packages."""

import subprocess

import msgspec
import pytest

from dualbrain.errors import ConfigurationError, MissingDependencyError
from experiments.gatekeeper.preempt_rt import debian_kernel, virtual_machine
from experiments.gatekeeper.preempt_rt.build_program import build_program
from experiments.gatekeeper.preempt_rt.missed_periods import VARIANTS, PreemptRt, check_run
from experiments.gatekeeper.preempt_rt.punctuality import LINE_START, Punctuality, parse_console


def result(variant="idle", **changes):
    """A run as the claim wants it."""
    wanted = VARIANTS[variant]
    missed = 4000 if variant == "ordinary" else 0
    default = {
        "kernel": "6.12.1-rt",
        "realtime": True,
        "policy": "SCHED_FIFO" if wanted.priority else "SCHED_OTHER",
        "priority": wanted.priority,
        "memory_locked": True,
        "busy": wanted.busy,
        "periods": wanted.periods,
        "ticks": wanted.periods - missed,
        "missed": missed,
        "late": 0,
        "delay_median_us": 4,
        "delay_p999_us": 5,
        "delay_max_us": 6,
        "work_max_us": 190,
        "moving": 9999,
        "modified": 7,
        "dropped": 0,
    }
    return Punctuality(**default | changes)


def rows(**changes):
    """Two boots of each variant; `changes` are those of the second boot, by variant."""
    return [
        {"key": f"{name} {boot}", "variant": name, **msgspec.to_builtins(result(name, **given.get(name, {})))}
        for boot, given in enumerate(({}, changes))
        for name in VARIANTS
    ]


@pytest.mark.realtime
def test_the_program_runs_on_this_machine(tmp_path):
    program = build_program(tmp_path, optimisation="-O0")
    command = [str(program), "200", "0", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=30)
    assert done.returncode == 0, done.stderr
    found = parse_console(done.stdout)
    assert (found.policy, found.priority, found.busy) == ("SCHED_OTHER", 0, 1)
    assert found.ticks + found.missed == found.periods >= 200
    assert found.ticks >= found.moving > 0
    assert 0 <= found.delay_median_us <= found.delay_p999_us <= found.delay_max_us
    for arguments in ([], ["0", "0", "0"], ["10", "100", "0"], ["10", "0", "x"]):
        refused = subprocess.run([str(program), *arguments], capture_output=True, text=True, check=False)
        assert refused.returncode == 1
        assert "usage" in refused.stderr


def test_the_result_is_found_between_other_lines():
    line = msgspec.json.encode(result()).decode()
    assert line.startswith(LINE_START)
    assert parse_console(f"SeaBIOS\r\n[    1.2] a message\r\n{line}\r\n[    9.9] reboot: Power down\r\n") == result()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[    1.2] Kernel panic", "0 results.*Kernel panic"),
        (LINE_START + '"6.12"}', "damaged"),
        (LINE_START + '"6.1[   1.2] a message', "damaged"),
        ("{line}\n{line}", "2 results"),
        ('{open},"more":1}', "damaged"),
    ],
    ids=["none", "incomplete", "interrupted", "two", "longer"],
)
def test_an_output_without_one_whole_result_is_refused(text, message):
    line = msgspec.json.encode(result()).decode()
    with pytest.raises(ConfigurationError, match=f"(?s){message}"):
        parse_console(text.replace("{line}", line).replace("{open}", line.removesuffix("}")))


@pytest.mark.parametrize(
    "changes",
    [{"realtime": False}, {"policy": "SCHED_OTHER", "priority": 0}, {"memory_locked": False}, {"periods": 19_999}],
    ids=["kernel", "priority", "memory", "periods"],
)
def test_a_run_under_other_conditions_is_refused(changes):
    check_run(VARIANTS["idle"], result())
    with pytest.raises(ConfigurationError, match=next(iter(changes))):
        check_run(VARIANTS["idle"], result(**changes))


def test_the_verdict_needs_all_runs_no_missed_period_and_a_distinct_control():
    report = PreemptRt().report
    assert report(rows())[0] == "The claim holds."
    assert report(rows(loaded={"missed": 1}))[0] == "The claim does **not** hold."
    assert report(rows(idle={"missed": 1}))[0] == "The claim does **not** hold."
    assert report(rows(ordinary={"missed": 1000}))[0] == "The claim does **not** hold."
    assert report(rows()[:2])[0] == "Not all variants have run."
    counts = "2 | 20000 | 5100 | [1100, 4000] | 0 | 4 | 5 | 9 | 190 | 19998 | 14"
    text = "\n".join(report(rows(ordinary={"missed": 1100, "delay_max_us": 9})))
    assert f"| four busy processes, ordinary priority | {counts} |" in text
    assert "Kernel: 6.12.1-rt" in text


def test_a_missing_emulator_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingDependencyError, match="apt-get install qemu-system-x86"):
        virtual_machine.find_emulator()
    with pytest.raises(MissingDependencyError, match="apt-get install build-essential"):
        build_program(tmp_path)
    with pytest.raises(MissingDependencyError, match="on Debian"):
        debian_kernel.newest_package()


def test_the_kernel_is_the_newest_one_that_is_recent_enough():
    listed = "linux-image-6.12-rt-amd64\n  Depends: linux-image-6.12.117+deb12-rt-amd64\n"
    assert debian_kernel.find_image_package(listed) == "linux-image-6.12.117+deb12-rt-amd64"
    assert debian_kernel.find_image_package(listed.replace("6.12", "6.1")) == ""
    assert debian_kernel.find_image_package("") == ""


def test_the_archive_has_aligned_entries_and_an_end():
    packed = virtual_machine.pack_archive({"init": b"12345"})
    assert packed.count(b"070701") == 2
    assert len(packed) % 4 == 0
    assert packed.index(b"12345") % 4 == 0
    assert packed.endswith(b"TRAILER!!!\0" + bytes(-(110 + 11) % 4))
