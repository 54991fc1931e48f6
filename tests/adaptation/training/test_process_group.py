"""Training in several processes equals training in one, no process waits forever, and only the first one writes."""

import multiprocessing
import os
import signal
import socket
import tempfile

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, DualbrainError

torch = pytest.importorskip("torch", reason="the extra `adapt` is not installed")
pytest.importorskip("peft", reason="the extra `adapt` is not installed")

from dualbrain.adaptation.training.accelerate_group import join_process_group  # noqa: E402
from tests.adaptation.training.tiny_training import DEFAULT_CONFIG, TinyTraining, config_with  # noqa: E402

FORK = multiprocessing.get_context("fork")
TIMEOUT_S = 50.0
"""A process that has not answered after this time [s] hangs."""


def in_processes(n, work):
    """The results of `work(group)` in `n` processes: a value, the name and message of an error, or None if killed."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    ends = [FORK.Pipe(duplex=False) for _ in range(n)]
    children = [FORK.Process(target=run_process, args=(n, rank, port, ends[rank][1], work)) for rank in range(n)]
    try:
        for child, (_, theirs) in zip(children, ends, strict=True):
            child.start()
            theirs.close()
        return [receive(ours) for ours, _ in ends]
    finally:
        for child in children:
            child.kill()
            child.join()


def run_process(n, rank, port, end, work):
    environment = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": n, "LOCAL_WORLD_SIZE": n, "MASTER_PORT": port}
    os.environ |= {name: str(value) for name, value in environment.items()}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "OMP_NUM_THREADS": "1"}
    try:
        with join_process_group() as group:
            end.send(work(group))
    except DualbrainError as error:
        end.send(f"{type(error).__name__}: {error}")


def receive(end):
    assert end.poll(TIMEOUT_S), "a process hangs"
    try:
        return end.recv()
    except EOFError:
        return None


def trained_by(folder, config=DEFAULT_CONFIG, report=lambda bench, progress: None):
    """Training by a group: result and adapter of each process. Only the first process may write and ask questions."""

    def work(group):
        if group.rank:
            tempfile.mkstemp = forbidden
        bench = TinyTraining(folder, config=config, process_group=group)
        if group.rank:
            bench.lora_model.generate_answers = forbidden
        return run_training(bench, report)

    return work


def run_training(bench, report=lambda bench, progress: None):
    """Result and adapter of a run, and for each step the norm of the gradient, cross-entropy and divergence."""
    steps, norms, step = [], [], bench.trainer._master_weights.step

    def measured_step(rate, clip):
        norms.append(step(rate, clip))
        return norms[-1]

    def on_progress(progress):
        steps.append((norms[-1], progress.cross_entropy, progress.divergence))
        report(bench, progress)

    bench.trainer._master_weights.step = measured_step
    found = bench.run(on_progress)
    return found, {name: tensor.numpy() for name, tensor in bench.lora_model.adapter_tensors().items()}, steps


def forbidden(*args, **kwargs):
    raise AssertionError("only the first process does this")


@pytest.fixture(scope="module")
def two_processes(tmp_path_factory):
    """A run in two processes: their results, and the files of the run."""
    folder = tmp_path_factory.mktemp("two") / "fit"
    results = in_processes(2, trained_by(folder))
    return results, TinyTraining(folder).output_files()


def assert_alike(first, second):
    """Two runs agree up to rounding, which Adam amplifies while a gradient is small."""
    (found, adapter, steps), (other, other_adapter, other_steps) = first, second
    assert (found.step, found.compliance) == (other.step, other.compliance)
    assert found.loss == pytest.approx(other.loss, rel=1e-3)
    assert np.array(steps) == pytest.approx(np.array(other_steps), rel=1e-2, abs=1e-4)
    for name, tensor in adapter.items():
        assert tensor == pytest.approx(other_adapter[name], rel=2e-2, abs=2e-4)


def test_two_processes_train_the_same_adapter_as_one_and_agree_to_the_bit(two_processes, tmp_path):
    first, second = two_processes[0]
    assert_alike(first, run_training(TinyTraining(tmp_path / "alone")))
    assert first[0] == second[0]
    assert first[2] == second[2]
    assert all((first[1][name] == second[1][name]).all() for name in first[1])


def test_shares_of_a_step_may_be_unequal_and_in_parts(two_processes, tmp_path):
    for one in in_processes(3, trained_by(tmp_path / "fit", config_with(at_once=1))):
        assert_alike(two_processes[0][0], one)


def test_after_a_kill_two_processes_give_the_same_files(two_processes, tmp_path):
    def kill(bench, progress):
        if progress.step == 3:
            os.kill(os.getpid(), signal.SIGKILL)

    assert in_processes(2, trained_by(tmp_path / "fit", report=kill)) == [None, None]
    assert TinyTraining(tmp_path / "fit").trainer.step == 2
    in_processes(2, trained_by(tmp_path / "fit"))
    assert TinyTraining(tmp_path / "fit").output_files() == two_processes[1]


@pytest.mark.parametrize("quantity", ["loss", "gradient", "held-out loss"])
def test_a_value_that_is_not_finite_in_one_process_ends_all(tmp_path, quantity):
    def work(group):
        bench = TinyTraining(tmp_path / "fit", process_group=group)
        parameter = next(iter(bench.lora_model.parameters.values()))

        def poison(progress):
            if progress.step == 3 and quantity == "loss" and group.rank == 1:
                parameter.data.fill_(float("nan"))
            if progress.step == 3 and quantity == "gradient" and group.rank == 1:
                parameter.register_hook(lambda gradient: gradient * float("inf"))
            if progress.step == 3 and quantity == "held-out loss" and group.rank == 0:
                bench.trainer._compute_held_out_loss = lambda: float("nan")

        return bench.run(poison)

    for answer in in_processes(2, work):
        assert answer.startswith("TrainingDivergedError"), answer
        assert f"the {quantity} (" in answer
        assert "of step 4 " in answer
    assert TinyTraining(tmp_path / "fit").trainer.step == 2


def test_a_failure_of_the_first_process_ends_all():
    def work(group):
        return group.run_on_first(fail)

    def fail():
        raise ConfigurationError("folder", got="none", allowed="one")

    first, *others = in_processes(3, work)
    assert first.startswith("ConfigurationError: folder")
    assert all(answer.startswith("FirstProcessError: the first process failed: folder") for answer in others)


def test_only_the_first_process_works_and_all_receive_its_result():
    def work(group):
        return os.getpid(), group.run_on_first(os.getpid), group.run_on_first(lambda: group.rank)

    first, second = in_processes(2, work)
    assert first[0] != second[0]
    assert first[1] == second[1] == first[0]
    assert (first[2], second[2]) == (0, 0)


def test_a_process_without_a_sample_is_rejected(tmp_path):
    def work(group):
        return TinyTraining(tmp_path / "fit", config=config_with(batch=2, at_once=2), process_group=group).trainer.step

    assert all(answer.startswith("ConfigurationError: fit batch: got 2") for answer in in_processes(3, work))
