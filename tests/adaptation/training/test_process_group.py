"""Several processes fit what one would, none of them is left waiting, and only the first one writes."""

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
PATIENCE = 50.0
"""Who has not answered after so many seconds hangs."""


def in_processes(n, work):
    """What `work(team)` gave in each of `n` processes: its value, the name of its error, or None if it was killed."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    ends = [FORK.Pipe(duplex=False) for _ in range(n)]
    children = [FORK.GatekeeperProcess(target=one_of, args=(n, rank, port, ends[rank][1], work)) for rank in range(n)]
    try:
        for child, (_, theirs) in zip(children, ends, strict=True):
            child.start()
            theirs.close()
        return [told(ours) for ours, _ in ends]
    finally:
        for child in children:
            child.kill()
            child.join()


def one_of(n, rank, port, end, work):
    places = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": n, "LOCAL_WORLD_SIZE": n, "MASTER_PORT": port}
    os.environ |= {name: str(value) for name, value in places.items()}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "OMP_NUM_THREADS": "1"}
    try:
        with join_process_group() as team:
            end.send(work(team))
    except DualbrainError as error:
        end.send(f"{type(error).__name__}: {error}")


def told(end):
    assert end.poll(PATIENCE), "a process hangs"
    try:
        return end.recv()
    except EOFError:
        return None


def fitted(folder, config=DEFAULT_CONFIG, tell=lambda bench, progress: None):
    """A fit by a team: what each found and wears at the end. Who is not the first can neither write nor ask."""

    def work(team):
        if team.rank:
            tempfile.mkstemp = forbidden
        bench = TinyTraining(folder, config=config, process_group=team)
        if team.rank:
            bench.lora_model.generate_answers = forbidden
        return carried_out(bench, tell)

    return work


def carried_out(bench, tell=lambda bench, progress: None):
    """What a fit found, what it wears, and of each step the norm of the gradient, cross-entropy and divergence."""
    steps, norms, take = [], [], bench.fit._masters.step

    def measured(rate, clip):
        norms.append(take(rate, clip))
        return norms[-1]

    def told(progress):
        steps.append((norms[-1], progress.cross_entropy, progress.divergence))
        tell(bench, progress)

    bench.fit._masters.step = measured
    found = bench.run(told)
    return found, {name: tensor.numpy() for name, tensor in bench.learner.adapter().items()}, steps


def forbidden(*told, **more):
    raise AssertionError("only the first process does this")


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A fit by two: what they wear, and what it leaves."""
    folder = tmp_path_factory.mktemp("two") / "fit"
    worn = in_processes(2, fitted(folder))
    return worn, TinyTraining(folder).output_files()


def alike(ours, theirs):
    """Two fits end alike and go alike, up to rounding, which Adam makes larger while a gradient is small."""
    (found, worn, steps), (other, theirs_worn, theirs_steps) = ours, theirs
    assert (found.step, found.compliance) == (other.step, other.compliance)
    assert found.loss == pytest.approx(other.loss, rel=1e-3)
    assert np.array(steps) == pytest.approx(np.array(theirs_steps), rel=1e-2, abs=1e-4)
    for name, tensor in worn.items():
        assert tensor == pytest.approx(theirs_worn[name], rel=2e-2, abs=2e-4)


def test_two_fit_what_one_fits_and_wear_the_same_to_the_bit(pair, tmp_path):
    first, second = pair[0]
    alike(first, carried_out(TinyTraining(tmp_path / "alone")))
    assert first[0] == second[0]
    assert first[2] == second[2]
    assert all((first[1][name] == second[1][name]).all() for name in first[1])


def test_shares_may_be_unequal_and_in_parts(pair, tmp_path):
    for one in in_processes(3, fitted(tmp_path / "fit", config_with(at_once=1))):
        alike(pair[0][0], one)


def test_after_kill_9_two_end_as_if_nothing_had_happened(pair, tmp_path):
    def kill(bench, progress):
        if progress.step == 3:
            os.kill(os.getpid(), signal.SIGKILL)

    assert in_processes(2, fitted(tmp_path / "fit", tell=kill)) == [None, None]
    assert TinyTraining(tmp_path / "fit").trainer.step == 2
    in_processes(2, fitted(tmp_path / "fit"))
    assert TinyTraining(tmp_path / "fit").output_files() == pair[1]


@pytest.mark.parametrize("what", ["loss", "gradient", "held-out loss"])
def test_what_is_no_number_in_one_ends_all(tmp_path, what):
    def work(team):
        bench = TinyTraining(tmp_path / "fit", process_group=team)
        parameter = next(iter(bench.lora_model.parameters.values()))

        def poison(progress):
            if progress.step == 3 and what == "loss" and team.rank == 1:
                parameter.data.fill_(float("nan"))
            if progress.step == 3 and what == "gradient" and team.rank == 1:
                parameter.register_hook(lambda gradient: gradient * float("inf"))
            if progress.step == 3 and what == "held-out loss" and team.rank == 0:
                bench.trainer._compute_held_out_loss = lambda: float("nan")

        return bench.run(poison)

    for answer in in_processes(2, work):
        assert answer.startswith("Diverged"), answer
        assert f"the {what} (" in answer
        assert "of step 4 " in answer
    assert TinyTraining(tmp_path / "fit").trainer.step == 2


def test_what_the_first_cannot_do_ends_all():
    def work(team):
        return team.once(refuse)

    def refuse():
        raise ConfigurationError("folder", got="none", allowed="one")

    first, *others = in_processes(3, work)
    assert first.startswith("InvalidSetup: folder")
    assert all(answer.startswith("FirstFailed: the first process failed: folder") for answer in others)


def test_only_the_first_works_and_all_get_what_it_made():
    def work(team):
        return os.getpid(), team.once(os.getpid), team.once(lambda: team.rank)

    first, second = in_processes(2, work)
    assert first[0] != second[0]
    assert first[1] == second[1] == first[0]
    assert (first[2], second[2]) == (0, 0)


def test_a_process_without_a_sample_is_refused(tmp_path):
    def work(team):
        return TinyTraining(tmp_path / "fit", config=config_with(batch=2, at_once=2), process_group=team).trainer.step

    assert all(answer.startswith("InvalidSetup: fit batch: got 2") for answer in in_processes(3, work))
