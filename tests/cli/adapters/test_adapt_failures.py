"""A night ends with an adapter that its card tells the truth of, or with a clear error; who serves is never touched."""

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
DIALS = "[fit]\nsteps = 4\nbatch = 2\nat_once = 2\nrank = 2\nalpha = 4\nsave_every = 2\nask_at_most = 0\nrate = 1e-2\n"
COMMAND = ["adapt", "--base", tiny_adapter.BASE, "--out", "fit", "--config", "dials.toml"]


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def flip(path):
    """Turn one bit over."""
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
    write_ledger(folder, distinct_episodes(8, by=tiny_adapter.BASE)).close()
    (folder / "dials.toml").write_text(DIALS)
    return SimpleNamespace(cache=cache, registry=registry, champion=card, folder=folder, fit=folder / "fit")


@pytest.fixture
def here(run_command, tmp_path, monkeypatch):
    """Such a home, and the command in it; whatever filled the disk, there is room when it has ended."""
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
    """The id of the adapter that such a night makes if nothing goes wrong."""
    with pytest.MonkeyPatch.context() as patch:
        home = home_in(tmp_path_factory.mktemp("undisturbed"), patch)
        assert run_command_line(COMMAND) == ExitCode.SUCCESS
        return home.registry.ids()[-1]


def test_what_a_fit_was_taught_is_not_lost_while_another_writes_the_ledger(here, undisturbed, monkeypatch):
    monkeypatch.setattr("dualbrain.cli.memory.open_memory.LOCK_TIMEOUT_S", 0.05)

    def noted():
        with LedgerReader(here.folder / "ledger.sqlite") as opened:
            return [event.subject for event in opened.events(f"kind = '{ADAPTER}'")]

    with Ledger(here.folder / "ledger.sqlite", holder="a run", now=3.0, timeout_s=1.0):
        code, _, err = here.adapt()
        assert (code, here.registry.ids()[-1], noted()) == (ExitCode.FAILED_SAFELY, undisturbed, [])
    told = " ".join(err.split())
    assert "not written into the ledger" in told
    assert "the same command again, with --out fit: it takes no further step" in told
    journal = here.registry.journal()
    for _ in range(2):
        code, _, err = here.adapt()
        assert (code, noted(), "step" in err) == (ExitCode.SUCCESS, [undisturbed], False)
    assert here.registry.journal() == journal


def empty_ledger(here, monkeypatch):
    (here.folder / "ledger.sqlite").unlink()
    write_ledger(here.folder, []).close()


def nothing_clean(here, monkeypatch):
    (here.folder / "ledger.sqlite").unlink()
    write_ledger(here.folder, [episode("a", "failed"), episode("b", Delta=0.5)]).close()


def changed_after_the_fit(here, monkeypatch):
    plain = train.adapt

    def adapt(*told, **more):
        card = plain(*told, **more)
        flip(here.fit / "adapter" / WEIGHTS_FILE)
        return card

    monkeypatch.setattr(train, "adapt", adapt)


def changed_during_the_fit(here, monkeypatch):
    """Between the end of the fit and its being taken up again."""
    plain = train.Trainer.run

    def run(fit, tell):
        plain(fit, tell)
        flip(here.fit / BEST_FILE)
        return plain(fit, tell)

    monkeypatch.setattr(train.Trainer, "run", run)


def wrong_base(here, monkeypatch):
    flip(here.cache / "tiny.gguf")


def no_number(here, monkeypatch):
    (here.folder / "dials.toml").write_text(DIALS.replace("rate = 1e-2", "rate = 1e38"))


FAILURES = {
    empty_ledger: "clean episodes: got 'none of 0 memories'",
    nothing_clean: "clean episodes: got 'none of 2 memories (1 outcome failed, 1 Δ above 0.003)'",
    changed_after_the_fit: "adapter weights",
    changed_during_the_fit: "best adapter of the fit: got 'damaged",
    wrong_base: "tiny: SHA-256 is",
    no_number: "is not finite",
}


@pytest.mark.parametrize("fail", FAILURES, ids=lambda fail: fail.__name__)
def test_a_night_that_fails_says_why_and_leaves_registry_and_champion(here, monkeypatch, fail):
    fail(here, monkeypatch)
    before = contents(here.registry.folder)
    code, out, err = here.adapt()
    assert (code, out) == (ExitCode.SETUP, "")
    assert FAILURES[fail] in err
    assert "Traceback" not in err
    untouched(here, before)


def untouched(here, before):
    assert contents(here.registry.folder) == before
    assert here.registry.verify() == {here.champion.id: ""}
    assert here.registry.champion(place_of_card(here.champion)) == here.champion.id


STAGES = {
    "base": ".{base}-",
    "data set": ".train.jsonl.",
    "states of the base": ".base_states.safetensors.",
    "best": ".best.safetensors.",
    "checkpoint": ".checkpoint.safetensors.",
    "adapter": ".adapter_model.safetensors.",
    "card": ".adapter.json.",
    "registry": ".{made}.",
}
"""What is being written, and how the name begins that it is written under."""


@pytest.mark.parametrize("stage", STAGES)
def test_on_a_full_disk_too_and_with_room_again_it_ends_as_if_there_had_been(here, undisturbed, monkeypatch, stage):
    prefix, full = STAGES[stage].format(base=find_weight_file(tiny_adapter.BASE).sha256[:32], made=undisturbed), [True]

    def filling(make):
        def begin(*told, **more):
            if full and more["prefix"] == prefix:
                full.clear()
                resource.setrlimit(resource.RLIMIT_FSIZE, (10, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
            return make(*told, **more)

        return begin

    for name in ("mkstemp", "mkdtemp"):
        monkeypatch.setattr(tempfile, name, filling(getattr(tempfile, name)))
    beside = filling(lambda path, prefix, real=atomic_files._temporary_sibling: real(path))
    monkeypatch.setattr(atomic_files, "_temporary_sibling", lambda path: beside(path, prefix=f".{path.name}."))
    before = contents(here.registry.folder)
    code, out, err = here.adapt()
    assert (code, out) == (ExitCode.SETUP, "")
    assert "not written: " in err
    assert "Traceback" not in err
    assert not full
    untouched(here, before)
    assert here.adapt()[0] == ExitCode.SUCCESS
    assert here.registry.ids() == (here.champion.id, undisturbed)


@pytest.mark.parametrize(("by", "bootstrapped"), [("tiny", False), ("tiny+0123abcd", True), ("templates", True)])
def test_a_night_that_ends_well_leaves_a_card_that_says_of_what_and_by_whom(here, by, bootstrapped):
    (here.folder / "ledger.sqlite").unlink()
    write_ledger(here.folder, distinct_episodes(8, by=by)).close()
    code, _, err = here.adapt()
    assert code == ExitCode.SUCCESS
    assert "used by nobody until" in err
    first, made = here.registry.ids()
    card = here.registry.card(made)
    assert (card.base, card.base_sha256) == (tiny_adapter.BASE, find_weight_file(tiny_adapter.BASE).sha256)
    assert (card.sources, card.bootstrapped) == ({by: 8}, bootstrapped)
    assert (card.steps, card.config.fit.rank) == (4, 2)
    assert here.registry.verify() == {first: "", made: ""}
    assert here.registry.champion(place_of_card(here.champion)) == first == here.champion.id
