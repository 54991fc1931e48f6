"""The data set on disk: identified by its bytes, read back as written, rejected if changed; settings from one file."""

import msgspec
import pytest

from dualbrain.adaptation.config import INTEGER_BOUNDS, MAX_SEED, AdaptConfig, FitConfig, ObjectiveConfig, read_config
from dualbrain.adaptation.curation.curate import CurationConfig, curate
from dualbrain.adaptation.curation.dataset import (
    CARD_FILE,
    HELD_OUT_FILE,
    TRAIN_FILE,
    assemble_dataset,
    dataset_hash,
    read_dataset,
    write_dataset,
)
from dualbrain.adaptation.training.schedule import plan_batches
from dualbrain.errors import ConfigurationError, MissingDependencyError
from tests.adaptation.sample_episodes import REGISTRY, distinct_episodes, episode, summary, write_ledger

SETTINGS = CurationConfig(held_out=0.3)


@pytest.fixture
def made(tmp_path):
    with write_ledger(
        tmp_path, [*distinct_episodes(12), episode("bad", "failed", scene_summary=summary(number=99))]
    ) as ledger:
        return assemble_dataset(curate(ledger, REGISTRY, SETTINGS), REGISTRY, SETTINGS)


def test_a_data_set_is_read_back_as_written(made, tmp_path):
    write_dataset(made, tmp_path / "set")
    assert read_dataset(tmp_path / "set") == made
    card = made.card
    assert (card.memories, card.train + card.held_out, card.left_out) == (13, 12, {"outcome failed": 1})
    assert card.sources == {"smollm2-135m-instruct": 12}
    assert (card.robot, card.registry) == ("panda", REGISTRY.hash)


def test_the_same_ledger_gives_the_same_hash_and_another_setting_another_hash(made, tmp_path):
    (tmp_path / "again").mkdir()
    with write_ledger(tmp_path / "again", distinct_episodes(12)) as ledger:
        same = assemble_dataset(curate(ledger, REGISTRY, SETTINGS), REGISTRY, SETTINGS)
        other = CurationConfig(held_out=0.3, salt="x")
        moved = assemble_dataset(curate(ledger, REGISTRY, other), REGISTRY, other)
    assert same.card.hash == made.card.hash
    assert moved.card.hash != made.card.hash


@pytest.mark.parametrize("name", [TRAIN_FILE, HELD_OUT_FILE])
def test_a_changed_byte_is_rejected(made, tmp_path, name):
    write_dataset(made, tmp_path / "set")
    path = tmp_path / "set" / name
    path.write_bytes(path.read_bytes().replace(b"0.15", b"0.16", 1))
    with pytest.raises(ConfigurationError, match="A file of the data set was changed"):
        read_dataset(tmp_path / "set")


def test_a_line_that_moves_to_the_other_file_is_rejected(made, tmp_path):
    write_dataset(made, tmp_path / "set")
    train, held_out = tmp_path / "set" / TRAIN_FILE, tmp_path / "set" / HELD_OUT_FILE
    first, rest = train.read_bytes().split(b"\n", 1)
    train.write_bytes(rest)
    held_out.write_bytes(first + b"\n" + held_out.read_bytes())
    with pytest.raises(ConfigurationError):
        read_dataset(tmp_path / "set")


def test_a_folder_with_another_data_set_is_unchanged(made, tmp_path):
    write_dataset(made, tmp_path / "set")
    before = (tmp_path / "set" / TRAIN_FILE).read_bytes()
    (tmp_path / "set" / CARD_FILE).write_bytes(
        (tmp_path / "set" / CARD_FILE).read_bytes().replace(b'"hash": "', b'"hash": "0')
    )
    with pytest.raises(ConfigurationError, match="another data set"):
        write_dataset(made, tmp_path / "set")
    assert (tmp_path / "set" / TRAIN_FILE).read_bytes() == before
    with pytest.raises(MissingDependencyError):
        read_dataset(tmp_path / "nothing")


def test_the_settings_are_read_from_one_file(tmp_path):
    path = tmp_path / "adapt.toml"
    path.write_text('[curation.rules]\nepsilon = 0.01\n[objective]\nentropy_gate = "token"\n[fit]\nsteps = 7\n')
    read = read_config(path)
    assert read.curation.rules.epsilon == 0.01
    assert read == AdaptConfig(read.curation, ObjectiveConfig(entropy_gate="token"), FitConfig(steps=7))


def test_all_random_generators_accept_the_largest_seed():
    torch = pytest.importorskip("torch", reason="the extra `adapt` is not installed")
    torch.manual_seed(FitConfig(seed=MAX_SEED).seed)
    assert len(plan_batches([1] * 9, FitConfig(seed=MAX_SEED))) == FitConfig().steps
    assert msgspec.json.decode(msgspec.json.encode(FitConfig(seed=MAX_SEED)), type=FitConfig).seed == MAX_SEED


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("[fit]\nstep = 7\n", "step"),
        ("[fit]\nsteps = 0\n", "steps"),
        ("[fit]\nbatch = 8\nat_once = 3\n", "divisor"),
        ("[objective]\nbeta = -1.0\n", "beta"),
        ("[objective]\nlambda_w = nan\n", "lambda_w"),
        ('[objective]\nentropy_gate = "all"\n', "entropy_gate"),
        *(
            (f"[fit]\n{name} = {least - 1}\n", f"{name}.*allowed: {least} to ")
            for name, (least, _) in INTEGER_BOUNDS.items()
        ),
        *((f"[fit]\n{name} = {most + 1}\n", f"{name}.*to {most}") for name, (_, most) in INTEGER_BOUNDS.items()),
        *((f"[fit]\n{name} = {value}\n", name) for name in ("rate", "clip") for value in ("0.0", "-1.0", "nan", "inf")),
        *((f"[objective]\n{name} = inf\n", name) for name in ("lambda_w", "lambda_h", "beta")),
        *(
            (f"[curation.rules]\n{name} = {value}\n", name)
            for name in ("epsilon", "slowest")
            for value in ("nan", "inf")
        ),
        *((f"[curation]\nheld_out = {value}\n", "held_out") for value in ("-0.1", "nan", "1.0")),
        ("[curation]\nheld_out = 1.5\n", "held_out"),
        ("fit = [", "adaptation config"),
    ],
)
def test_a_wrong_setting_is_named(tmp_path, text, word):
    path = tmp_path / "adapt.toml"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=word):
        read_config(path)


def test_an_interrupted_write_is_continued(made, tmp_path):
    write_dataset(made, tmp_path / "set")
    (tmp_path / "set" / CARD_FILE).unlink()
    (tmp_path / "set" / HELD_OUT_FILE).unlink()
    write_dataset(made, tmp_path / "set")
    assert read_dataset(tmp_path / "set") == made


@pytest.mark.parametrize("name", [TRAIN_FILE, HELD_OUT_FILE])
def test_a_file_of_the_user_with_the_same_name_is_unchanged(made, tmp_path, name):
    path = tmp_path / "set" / name
    path.parent.mkdir()
    path.write_text("mine\n")
    with pytest.raises(ConfigurationError, match="another data set"):
        write_dataset(made, tmp_path / "set")
    assert path.read_text() == "mine\n"
    assert [one.name for one in path.parent.iterdir()] == [name]


def test_samples_of_another_version_are_an_error_with_a_remedy(made, tmp_path):
    write_dataset(made, tmp_path / "set")
    train = b'{"prompt": 1}\n'
    (tmp_path / "set" / TRAIN_FILE).write_bytes(train)
    found = dataset_hash(train, (tmp_path / "set" / HELD_OUT_FILE).read_bytes())
    card = msgspec.structs.replace(made.card, hash=found)
    (tmp_path / "set" / CARD_FILE).write_bytes(msgspec.json.encode(card))
    with pytest.raises(ConfigurationError, match=r"cannot be read.*Make the data set again"):
        read_dataset(tmp_path / "set")
