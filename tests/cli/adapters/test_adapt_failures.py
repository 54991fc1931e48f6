"""`dualbrain adapt` ends with an adapter and a correct card, or with a clear error; the champion is never changed."""

import resource
import tempfile
from types import SimpleNamespace

import pytest

torch = pytest.importorskip("torch", reason="the extra `adapt` is not installed")
pytest.importorskip("peft", reason="the extra `adapt` is not installed")

from dualbrain.adaptation.adapters.card import WEIGHTS_FILE  # noqa: E402
from dualbrain.adaptation.adapters.promotion import PromotionDecision  # noqa: E402
from dualbrain.adaptation.adapters.registry import NO_ADAPTER, AdapterRegistry, place_of_card  # noqa: E402
from dualbrain.adaptation.training import train  # noqa: E402
from dualbrain.adaptation.training.trainer import BEST_FILE  # noqa: E402
from dualbrain.cli.common.exit_codes import ExitCode  # noqa: E402
from dualbrain.cli.main import run_command_line  # noqa: E402
from dualbrain.core.storage import atomic_files  # noqa: E402
from dualbrain.core.weights import find_weight_file  # noqa: E402
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder  # noqa: E402
from dualbrain.memory.ledger.events import ADAPTER  # noqa: E402
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader  # noqa: E402
from tests.adaptation import tiny_adapter, tiny_gguf  # noqa: E402
from tests.adaptation.sample_episodes import CONFIG, distinct_episodes, episode, write_ledger  # noqa: E402

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::UserWarning", "ignore::DeprecationWarning")
SETTINGS = (
    "[fit]\nsteps = 4\nbatch = 2\nat_once = 2\nrank = 2\nalpha = 4\nsave_every = 2\nask_at_most = 0\nrate = 1e-2\n"
)
COMMAND = ["adapt", "--base", tiny_adapter.BASE, "--out", "fit", "--config", "settings.toml"]


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def flip_bit(path):
    """Flip one bit of a file."""
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


def home_in(folder, patch):
    """A home with eight clean episodes, a tiny base in its cache, and a promoted adapter."""
    patch.chdir(folder)
    patch.setenv("DUALBRAIN_HOME", str(folder))
    patch.setenv("XDG_CACHE_HOME", str(folder / "xdg"))
    patch.setattr("dualbrain.cli.memory.open_memory.load_encoder", lambda: HashingEncoder(32))
    patch.setattr("dualbrain.cli.memory.open_memory.memory_config", lambda opened: CONFIG)
    tiny_gguf.patch_tokenizer(patch)
    cache = folder / "xdg" / "dualbrain"
    cache.mkdir(parents=True)
    _, card = tiny_adapter.write_adapter(tiny_adapter.install_base(cache, patch), folder / "serves")
    registry = AdapterRegistry(folder / "adapters")
    registry.add(folder / "serves", now=1.0)
    registry.promote(
        card.id, PromotionDecision(candidate=card.id, champion=NO_ADAPTER, measures={}, against=()), now=2.0
    )
    write_ledger(folder, distinct_episodes(8, proposer=tiny_adapter.BASE)).close()
    (folder / "settings.toml").write_text(SETTINGS)
    return SimpleNamespace(cache=cache, registry=registry, champion=card, folder=folder, fit=folder / "fit")


@pytest.fixture
def bench(run_command, tmp_path, monkeypatch):
    """Such a home with the command `adapt`; when it has ended, the disk has space again."""
    limits, home = resource.getrlimit(resource.RLIMIT_FSIZE), home_in(tmp_path, monkeypatch)

    def adapt():
        try:
            return run_command(*COMMAND)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    home.adapt = adapt
    yield home
    torch.use_deterministic_algorithms(mode=False)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The id of the adapter that the command makes without a failure."""
    with pytest.MonkeyPatch.context() as patch:
        home = home_in(tmp_path_factory.mktemp("undisturbed"), patch)
        assert run_command_line(COMMAND) == ExitCode.SUCCESS
        return home.registry.ids()[-1]


def test_training_data_is_recorded_later_if_the_ledger_is_locked(bench, undisturbed, monkeypatch):
    monkeypatch.setattr("dualbrain.cli.memory.open_memory.LOCK_TIMEOUT_S", 0.05)

    def recorded_adapters():
        with LedgerReader(bench.folder / "ledger.sqlite") as opened:
            return [event.subject for event in opened.events(ADAPTER)]

    with Ledger(bench.folder / "ledger.sqlite", holder="a run", now=3.0, timeout_s=1.0):
        code, _, err = bench.adapt()
        assert (code, bench.registry.ids()[-1], recorded_adapters()) == (ExitCode.FAILED_SAFELY, undisturbed, [])
    message = " ".join(err.split())
    assert "not recorded in the ledger" in message
    assert "Repeat the same command with --out fit: it takes no further step" in message
    log = bench.registry.entries()
    for _ in range(2):
        code, _, err = bench.adapt()
        assert (code, recorded_adapters(), "step" in err) == (ExitCode.SUCCESS, [undisturbed], False)
    assert bench.registry.entries() == log


def remove_ledger(bench):
    """Remove the ledger and its anchor, as if no run had been there."""
    for name in ("ledger.sqlite", "ledger.sqlite.anchor"):
        (bench.folder / name).unlink()


def empty_ledger(bench, monkeypatch):
    remove_ledger(bench)
    write_ledger(bench.folder, []).close()


def nothing_clean(bench, monkeypatch):
    remove_ledger(bench)
    write_ledger(bench.folder, [episode("a", "failed"), episode("b", Delta=0.5)]).close()


def changed_after_training(bench, monkeypatch):
    original = train.adapt

    def adapt(*args, **kwargs):
        card = original(*args, **kwargs)
        flip_bit(bench.fit / "adapter" / WEIGHTS_FILE)
        return card

    monkeypatch.setattr(train, "adapt", adapt)


def changed_during_training(bench, monkeypatch):
    """Between the end of training and its resumption."""
    original = train.Trainer.run

    def run(trainer, report):
        original(trainer, report)
        flip_bit(bench.fit / BEST_FILE)
        return original(trainer, report)

    monkeypatch.setattr(train.Trainer, "run", run)


def wrong_base(bench, monkeypatch):
    flip_bit(bench.cache / "tiny.gguf")


def not_finite(bench, monkeypatch):
    (bench.folder / "settings.toml").write_text(SETTINGS.replace("rate = 1e-2", "rate = 1e38"))


FAILURES = {
    empty_ledger: "no clean episode: none of 0 memories can be used",
    nothing_clean: "no clean episode: none of 2 memories (1 outcome failed, 1 Δ above 0.003) can be used",
    changed_after_training: "adapter weights",
    changed_during_training: "The best adapter of the run is damaged",
    wrong_base: "tiny: SHA-256 is",
    not_finite: "is not finite",
}


@pytest.mark.parametrize("fail", FAILURES, ids=lambda fail: fail.__name__)
def test_a_failure_is_reported_and_leaves_registry_and_champion_unchanged(bench, monkeypatch, fail):
    fail(bench, monkeypatch)
    before = contents(bench.registry.folder)
    code, out, err = bench.adapt()
    assert (code, out) == (ExitCode.SETUP, "")
    assert FAILURES[fail] in err
    assert "Traceback" not in err
    assert_unchanged(bench, before)


def assert_unchanged(bench, before):
    assert contents(bench.registry.folder) == before
    assert bench.registry.verify() == {bench.champion.id: ""}
    assert bench.registry.champion(place_of_card(bench.champion)) == bench.champion.id


STAGES = {
    "base": ".{base}.",
    "data set": ".train.jsonl.",
    "states of the base": ".base_states.safetensors.",
    "best": ".best.safetensors.",
    "checkpoint": ".checkpoint.safetensors.",
    "adapter": ".adapter_model.safetensors.",
    "card": ".adapter.json.",
    "registry": ".{made}.",
}
"""The output that is being written, and the prefix of its temporary name."""


@pytest.mark.parametrize("stage", STAGES)
def test_after_a_full_disk_the_run_resumes_and_gives_the_same_adapter(bench, undisturbed, monkeypatch, stage):
    prefix, full = STAGES[stage].format(base=find_weight_file(tiny_adapter.BASE).sha256[:32], made=undisturbed), [True]

    def filling(make):
        def begin(*args, **kwargs):
            if full and kwargs["prefix"] == prefix:
                full.clear()
                resource.setrlimit(resource.RLIMIT_FSIZE, (10, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
            return make(*args, **kwargs)

        return begin

    for name in ("mkstemp", "mkdtemp"):
        monkeypatch.setattr(tempfile, name, filling(getattr(tempfile, name)))
    beside = filling(lambda path, prefix, real=atomic_files._temporary_sibling: real(path))
    monkeypatch.setattr(atomic_files, "_temporary_sibling", lambda path: beside(path, prefix=f".{path.name}."))
    before = contents(bench.registry.folder)
    code, out, err = bench.adapt()
    assert (code, out) == (ExitCode.SETUP, "")
    assert "not written: " in err
    assert "Traceback" not in err
    assert not full
    assert_unchanged(bench, before)
    assert bench.adapt()[0] == ExitCode.SUCCESS
    assert bench.registry.ids() == (bench.champion.id, undisturbed)


@pytest.mark.parametrize(("by", "bootstrapped"), [("tiny", False), ("tiny+0123abcd", True), ("templates", True)])
def test_a_successful_run_leaves_a_card_with_the_sources_of_its_data(bench, by, bootstrapped):
    remove_ledger(bench)
    write_ledger(bench.folder, distinct_episodes(8, proposer=by)).close()
    code, _, err = bench.adapt()
    assert code == ExitCode.SUCCESS
    assert "it is not used until it is promoted" in err
    first, made = bench.registry.ids()
    card = bench.registry.card(made)
    assert (card.base, card.base_sha256) == (tiny_adapter.BASE, find_weight_file(tiny_adapter.BASE).sha256)
    assert (card.sources, card.bootstrapped) == ({by: 8}, bootstrapped)
    assert (card.steps, card.config.fit.rank) == (4, 2)
    assert bench.registry.verify() == {first: "", made: ""}
    assert bench.registry.champion(place_of_card(bench.champion)) == first == bench.champion.id
